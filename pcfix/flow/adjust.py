"""Refractive bundle adjustment from files into a folder, for all doors."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.adjust.block import (
    LEAST_VIEWS,
    WATER,
    Material,
    gnss_with_sigma,
    usable_ties,
    with_places,
)
from pcfix.adjust.block import taken as taken_ties
from pcfix.adjust.methods import LEAST_TIES, adjust_block, check_control, check_images, check_marks
from pcfix.adjust.result import Adjusted, adjustment_dict, before_of
from pcfix.adjust.solve import Progress
from pcfix.errors import InputError, PcfixError, PcfixWarning, SettingError, bad_file
from pcfix.flow.diagnosis import flags_of, water_word
from pcfix.flow.inputs import Inputs, mask_of, paths_in
from pcfix.flow.runner import check_folder
from pcfix.flow.surfaces import sample_of, view_of
from pcfix.io.atomic import temporary_output
from pcfix.io.cameras.colmap import write_colmap
from pcfix.io.cameras.table import read_sensor, write_table
from pcfix.io.crs import is_topocentric, parse_crs
from pcfix.io.files import write_members, write_text
from pcfix.io.gnss_positions import gnss_in_frame_of, read_gnss
from pcfix.io.ground_control import read_ground_control
from pcfix.io.tiles import Clouds, cloud_of
from pcfix.io.water import write_water_raster
from pcfix.model import (
    Cameras,
    GnssPositions,
    GroundControl,
    Lens,
    TiePoints,
    Views,
    WaterDimension,
    WaterMesh,
    WaterPlane,
    WaterRaster,
    WaterSurface,
)
from pcfix.options.correct import WATER_UNKNOWNS, AdjustOptions
from pcfix.options.declare import File, taken
from pcfix.port.shapes import FlatPort, Port
from pcfix.report.adjustment import adjustment_page
from pcfix.running import threads
from pcfix.water.index import index_of

if TYPE_CHECKING:
    from pyproj import CRS

SUMMARY = "adjustment.json"
FOLDER = "adjusted"
"""The folder of an adjustment in that of a run."""
MODELS = ("colmap", "cameras.csv")
"""The models that an adjustment writes, the preferred one first."""
WATER_FILE = "water.tif"
"""The water of an adjustment, where it is not a plane and was adjusted."""

CLOUD_POINTS = 6000
"""Points of the cloud that stand for tie points."""

_EXPORTS = (
    "Tie points are in COLMAP's model with points3D, OpenSfM's reconstruction with tracks.csv, a"
    " Metashape project (.psx, .psz) or its BlocksExchange export, Pix4D's params folder with its"
    " tp_ file, and Bundler's .out."
)


def adjust_cameras(
    model: File | Cameras,
    out_dir: File | None = None,
    *,
    options: AdjustOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> Adjusted:
    """Adjust the poses and lens of a block with refraction; ``pcfix adjust``.

    Parameters
    ----------
    model : path or Cameras
        See `pcfix.read_cameras`; with tie points, or together with the cloud that it made.
    out_dir : path, optional
        A new folder for the adjusted model as ``colmap/``, for blocks with one simple lens as
        ``cameras.csv`` too, ``ensemble.npz`` (see `pcfix.adjust.precision.Members`),
        ``adjustment.json`` and ``report.html``, and for free water that is no plane ``water.tif``.
        Nothing is written without it.
    options : AdjustOptions, optional
        Or its attributes as keywords, as of ``pcfix adjust``: water (or port), cloud (apparent;
        some of its points replace missing tie points), gcps, gnss, lens (fixed unless
        lens_unknowns are given) and others.
    progress : callable, optional
        Called with a line of text after each step.

    Raises
    ------
    PcfixError
        If an input cannot be read or does not fit, the block has no datum, or unknowns cannot be
        separated. Nothing is written then.
    """
    given = taken(AdjustOptions, options, keywords, "adjust_cameras")
    inputs = replace(given.part(Inputs), cameras=model)
    target = None if out_dir is None else Path(out_dir)
    with threads(given.jobs):
        return adjust_into(target, inputs, given, given.cloud, progress)


def adjust_into(
    folder: Path | None, inputs: Inputs, given: AdjustOptions, cloud: Clouds | None,
    progress: Progress | None = None,
) -> Adjusted:  # fmt: skip
    """Adjust the cameras of some inputs; of the options all others count. See `adjust_cameras`."""
    # 1. The block, its water, and what was surveyed
    if folder is not None:
        known = [*paths_in(inputs), *paths_in(given)]
        check_folder(folder, known, mark=SUMMARY, overwrite=given.overwrite)
    view = None if cloud is None else view_of(cloud_of(cloud))
    name = str(inputs.cameras) if isinstance(inputs.cameras, str | Path) else "cameras"
    read = inputs.read()
    crs: str | CRS | None = None if view is None else view.crs
    if view is None and read.crs is not None and not is_topocentric(read.crs):
        crs = read.crs if parse_crs(read.crs, "cameras").is_projected else None
    original, _ = replace(inputs, views=None).block(crs, read)
    if original.rotations is None or original.lenses is None:
        words = (
            f"{name}: an adjustment needs angles and a lens of every image. Give the project or"
            " model of the software, or --sensor."
        )
        raise InputError("cameras.no_angles", words, path=name)
    water = None if inputs.port is not None else inputs.surface(view).surface
    if isinstance(water, WaterDimension):
        words = (
            f"The water {water} is known at points of the cloud only. For an adjustment, give it as"
            " a level, plane, raster, mesh or shoreline."
        )
        raise SettingError("water.dimension", words, value=str(water))
    check_images(name, original, water, given.fixed_images)
    _check_free(given, water, inputs.port)
    gnss, reason, notes = _gnss(original, name, given)
    control = given.gcps
    gcps = "gcps" if isinstance(control, GroundControl) else str(control)
    if control is not None and not isinstance(control, GroundControl):
        control = read_ground_control(control, original, crs=given.gcps_crs)
    if control is not None and water is not None:
        check_marks(control, original, gcps, is_placed=gnss is not None)
    _check_surfaces(given.parallel, control, water, gcps)
    mask = mask_of(inputs.water_mask, crs or original.crs)
    material = Material(
        name, original, water, index_of(given.index, given.index_formula)[0], gnss, control,
        inputs.port, None if given.lens is None else _calibration(given.lens, original),
        None if mask is None else mask.inside, reason, given.parallel,
    )  # fmt: skip

    # 2. Tie points as they were measured, or points of the cloud
    ties = None if given.ties == "cloud" else inputs.tie_points(crs, placed=False)
    if ties is not None:
        ties = usable_ties(with_places(ties, original), original)
    count = 0 if ties is None else len(ties.xyz)
    if ties is not None and count >= LEAST_TIES:
        found = adjust_block(material, given, ties=ties, progress=progress)
    elif view is None or given.ties == "measured":
        cloud_too = "" if given.ties == "measured" else ", and there is no --cloud"
        words = (
            f"{name}: has {count} usable tie points ({LEAST_TIES} are needed){cloud_too}."
            f" {_EXPORTS}"
        )
        raise InputError("cameras.no_ties", words, path=name, ties=count, least=LEAST_TIES)
    else:
        count = min(CLOUD_POINTS, view.points)  # random points of the cloud
        rows = np.sort(np.random.default_rng(0).choice(view.points, count, replace=False))
        xyz = sample_of(view, rows).xyz
        found = adjust_block(material, given, cloud_xyz=xyz, progress=progress)

    # 3. The result
    if control is not None:
        check_control(found, gcps)
    found = replace(found, notes=[*notes, *found.notes])
    if folder is not None:
        _write(folder, found, str(inputs.cameras))
    return found


def _check_free(given: AdjustOptions, water: WaterSurface | None, port: Port | None) -> None:
    """Refuse unknowns that water or port do not have."""
    what, known = "the water", [*WATER_UNKNOWNS[:4]]
    if isinstance(water, WaterMesh | WaterRaster):
        what, known = "a mesh or raster of water", ["index"]
    if port is not None:
        is_flat = isinstance(port, FlatPort)
        what = "a flat port" if is_flat else "a dome"
        known = ["index", "distance" if is_flat else "centre"]
    stated = {"level": given.sigma_level, "tilt": given.sigma_tilt}
    for name in (*given.free, *(name for name, sigma in stated.items() if sigma)):
        if name not in known:
            raise SettingError(
                "option.choice",
                f"--free {name}: {what} has no free {name}. Use {', '.join(known)}.",
                option="free",
                value=name,
            )


def _check_surfaces(
    parallel: tuple[str, ...], control: GroundControl | None, water: WaterSurface | None, name: str
) -> None:
    """Refuse points on water that does not exist, and unknown planes."""
    on = () if control is None else control.on
    if WATER in on and water is None:
        sentence = "points have the role waterline, but there is no --water."
        raise bad_file(name, "gcps.no_water", sentence)
    known = list(dict.fromkeys(one for one in on if one and one != WATER))
    known += [WATER] if isinstance(water, WaterPlane) else []
    if parallel and (len(parallel) < 2 or not set(parallel) <= set(known)):
        words = (
            f"--parallel {','.join(parallel)}: give at least two of the planes"
            f" {', '.join(known) or '(none)'}. Mark points of --gcps with the role on:NAME."
        )
        raise SettingError("adjust.parallel", words, value=list(parallel), planes=known)


def _gnss(
    original: Cameras, name: str, given: AdjustOptions
) -> tuple[GnssPositions | None, str, list[PcfixWarning]]:
    """Return GNSS positions in the block's frame, why they are not used, and warnings."""
    cameras = original
    if given.gnss is not None:
        cameras, name = read_gnss(given.gnss, original, crs=given.gnss_crs), str(given.gnss)
    if cameras.gnss is None:
        return None, "", []
    try:
        found, reason = gnss_in_frame_of(cameras, name)
    except PcfixError as error:
        if given.gnss is not None:
            raise
        words = f"{error} The GNSS positions of the camera file are not used."
        return None, "", [PcfixWarning(error.code or "gnss.not_used", words, **error.values)]
    gnss, notes = gnss_with_sigma(original.centres, found, name, given.gnss_sigma)
    if reason:
        notes = [PcfixWarning("gnss.not_used", reason, path=name), *notes]
    return gnss, reason, notes


def _calibration(path: File, cameras: Cameras) -> Lens:
    """Return a calibration of images of this size."""
    one = read_sensor(Path(path))
    for lens in set(cameras.lenses or ()):
        if (lens.width, lens.height, lens.unit) != (one.width, one.height, one.unit):
            words = (
                f"{path}: the calibration is of images of {one.width:g} x {one.height:g}"
                f" {one.unit}, the model has {lens.width:g} x {lens.height:g} {lens.unit}. Give the"
                " one of these images."
            )
            raise InputError("sensor.size", words, path=path)
    return one


# Writing


def _write(folder: Path, found: Adjusted, model: str) -> None:
    """Write an adjusted block: model, camera files, summary, report; all or nothing."""
    with temporary_output(folder, is_folder=True) as draft:
        _write_models(draft, found)
        if found.unknowns.surface.get("shape") and isinstance(found.water, WaterRaster):
            write_water_raster(draft / WATER_FILE, found.water, found.cameras.crs)
        if found.precision.members is not None:
            write_members(draft, found.precision.members)
        summary = {"model": model, **adjustment_dict(found, before_of(found))}
        text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
        write_text(draft / SUMMARY, text, overwrite=False)
        write_text(draft / "report.html", adjustment_page(summary), overwrite=False)


def _write_models(folder: Path, found: Adjusted) -> None:
    """Write the model in each format that holds its lenses exactly."""
    ties, cameras = None, found.cameras
    if found.source != "cloud":  # the adjusted tie points without outliers
        block, m = found.block, found.block.tie_points
        used = found.used & (block.owner < m)
        counts = np.bincount(block.owner[used], minlength=m)[:m]
        start = np.concatenate([[0], np.cumsum(counts)])
        ties = TiePoints(found.xyz[:m], Views(start, block.camera[used]), block.image_xy[used])
        ties = taken_ties(ties, np.flatnonzero(counts >= LEAST_VIEWS))
    writers = {
        "colmap": partial(write_colmap, folder / "colmap", cameras, ties),
        "cameras.csv": partial(write_table, folder, cameras),
    }
    failed = []
    for name, write in writers.items():
        try:
            write()
        except InputError as error:
            failed.append(str(error).replace(f"{folder}/", ""))
            if name != "cameras.csv":  # which is for blocks with one simple lens
                words = f"{name} was not written: {failed[-1]}"
                found.notes.append(PcfixWarning("output.format", words, name=name))
    if len(failed) == len(writers):
        raise InputError(
            "output.format", "No camera format can hold these lenses: " + " ".join(failed)
        )


def correct_words(found: Adjusted, model: File, out_dir: File, options: AdjustOptions) -> str:
    """Return the command that transfers the cloud to the adjusted poses, and corrects it."""
    out = Path(out_dir)
    cameras = next((one for one in MODELS if (out / one).exists()), MODELS[0])
    head = ["pcfix", "correct", str(options.cloud or "CLOUD.laz"), "corrected.laz"]
    words = [*head, "--cameras", str(out / cameras)]
    if options.port is not None:  # before a port no cloud is transferred: it is reconstructed
        moved = found.port if {"distance", "centre"} & set(options.free) else None
        words[2] = "CLOUD.laz"
        return shlex.join([*words, "--port", str(moved or options.port)])
    water = water_word(options.water)
    if isinstance(found.water, WaterPlane) or (out / WATER_FILE).exists():
        water, plane = str(out / WATER_FILE), found.water
        if isinstance(plane, WaterPlane):
            water = f"plane:{plane.a:.15g},{plane.b:.15g},{plane.c:.15g}"
            water = f"{plane.a:.3f}" if plane.b == plane.c == 0.0 else water
        options = replace(options, water_model="auto", water_crs=None)
    words += ["--adjusted-from", str(model), "--water", water]
    if "index" in options.free or options.sigma_index is not None:
        words += ["--index", f"{found.refractive_index:.6g}"]
    elif options.index is not None:
        words += ["--index", f"{options.index}"]
    return shlex.join([*words, *flags_of(options)])

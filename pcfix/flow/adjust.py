"""Refractive bundle adjustment from files into a folder, for all doors."""

import json
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.adjust.block import (
    NO_CONTROL,
    WATER,
    block_of,
    ties_of_cloud,
    usable_ties,
    well_observed,
)
from pcfix.adjust.methods import (
    adjust_block,
    check_control,
    check_datum,
    check_marks,
    gnss_with_sigma,
)
from pcfix.adjust.parameters import Unknowns, default_lens
from pcfix.adjust.result import Adjusted, adjustment_dict
from pcfix.errors import (
    GeometryError,
    InputError,
    PcfixError,
    PcfixWarning,
    SettingError,
    bad_file,
    silently,
)
from pcfix.flow.inputs import Inputs, mask_of, paths_in
from pcfix.flow.poses import flags_of, water_word
from pcfix.flow.runner import check_folder
from pcfix.flow.surfaces import CloudView, sample_of, view_of
from pcfix.io.cameras.colmap import write_colmap
from pcfix.io.cameras.table import read_sensor, write_table
from pcfix.io.clouds import Clouds, cloud_of
from pcfix.io.crs import is_topocentric, parse_crs
from pcfix.io.files import temporary_output, write_members, write_text
from pcfix.io.ground_control import gnss_in_frame_of, read_gnss, read_ground_control
from pcfix.io.views import ViewList, ViewMatch
from pcfix.io.water import write_water_raster
from pcfix.model import (
    Cameras,
    GnssPositions,
    GroundControl,
    TiePoints,
    Views,
    WaterDimension,
    WaterPlane,
    WaterRaster,
    WaterSurface,
)
from pcfix.options.correct import AdjustOptions
from pcfix.options.declare import File, taken
from pcfix.port.housing import DomePort, FlatPort, Port
from pcfix.refract.choice import views_in_frame
from pcfix.report.adjustment import adjustment_page
from pcfix.running import running, threads
from pcfix.water.checks import check_above_water
from pcfix.water.index import index_of

if TYPE_CHECKING:
    from pyproj import CRS

SUMMARY = "adjustment.json"
FOLDER = "adjusted"  # the folder of an adjustment in that of a run
MODELS = ("colmap", "cameras.csv")  # the models that an adjustment writes, the preferred one first
WATER_FILE = "water.tif"  # the water of an adjustment, where it is not a plane and was adjusted
LEAST_TIES, CLOUD_POINTS = 100, 6000  # measured tie points needed; points of the cloud otherwise

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
    progress: Callable[[str], None] | None = None,
    **keywords: Any,
) -> Adjusted:
    """Adjust the poses and lens of a block with refraction; ``pcfix adjust``.

    Parameters
    ----------
    model : path or Cameras
        See `pcfix.read_cameras`; with tie points, or together with its cloud.
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
    with threads(given.jobs), running(say=progress):
        return adjust_into(target, inputs, given, given.cloud)


def adjust_into(
    folder: Path | None, inputs: Inputs, given: AdjustOptions, cloud: Clouds | None
) -> Adjusted:
    """Adjust the cameras of some inputs; of the options all others count. See `adjust_cameras`."""
    # 1. The cameras, their water, and what was surveyed
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
    if water is not None:
        check_above_water(original, water)
    unknowns = _unknowns(given, original)
    _check_free(unknowns, water, inputs.port)
    gnss, reason, notes = _gnss(original, name, given)
    control, gcps = given.gcps or NO_CONTROL, "gcps"
    if not isinstance(control, GroundControl):
        control, gcps = read_ground_control(control, original, crs=given.gcps_crs), str(control)
    if water is not None:
        check_marks(control, original, gcps, is_placed=gnss is not None)
    _check_surfaces(given.parallel, control, water, gcps)
    mask = mask_of(inputs.water_mask, crs or original.crs)

    # 2. The block, by tie points as they were measured or by points of the cloud
    guesses, by_cloud = list[TiePoints](), True
    if given.ties != "cloud" and (measured := inputs.tie_points(crs, placed=False)) is not None:
        guesses = [usable_ties(measured, original)]
        by_cloud = len(guesses[0].xyz) < LEAST_TIES
    if by_cloud:
        with silently():  # the notes on the cameras were shown
            listed = inputs.block(crs, read)[1]
        guesses = _ties_of_cloud(view, original, listed, name, sum(len(one.xyz) for one in guesses))
    cameras = original if given.lens is None else _calibrated(given.lens, original)
    index, level_sigma_m = index_of(given.index, given.index_formula)[0], unknowns.water_sigma[0]
    chooses_lens = given.lens_unknowns is None and given.lens is None
    adjusted = list[Adjusted]()
    for ties in guesses:
        block = block_of(
            cameras, ties, water, index, inside=None if mask is None else mask.inside,
            control=control, level_sigma_m=level_sigma_m,
        )  # fmt: skip
        block = replace(block, port=inputs.port, parallel=given.parallel, gnss=gnss or block.gnss)
        check_datum(block, unknowns, reason)
        cloud_points = (original, ties.xyz) if by_cloud else None
        adjusted.append(adjust_block(block, unknowns, cloud=cloud_points, choose_lens=chooses_lens))
    # of two guesses with as many images, the one that GNSS and control points fit with less noise
    found = min(adjusted, key=lambda x: (-len(x.cameras), x.block.sigma_px[0], x.sigma0))

    # 3. The result
    check_control(found, gcps)
    found = replace(found, notes=[*notes, *found.notes])
    if folder is not None:
        _write(folder, found, str(inputs.cameras))
    return found


def _check_free(unknowns: Unknowns, water: WaterSurface | None, port: Port | None) -> None:
    """Refuse unknowns that water or port do not have."""
    match port or water:
        case FlatPort():
            what, known = "a flat port", ["index", "distance"]
        case DomePort():
            what, known = "a dome", ["index", "centre"]
        case WaterPlane():
            what, known = "the water", ["level", "tilt", "index", "shape"]
        case _:
            what, known = "a mesh or raster of water", ["index"]
    for name in unknowns.surface:
        if name not in known:
            words = f"--free {name}: {what} has no free {name}. Use {', '.join(known)}."
            raise SettingError("option.choice", words, option="free", value=name)


def _check_surfaces(
    parallel: tuple[str, ...], control: GroundControl, water: WaterSurface | None, name: str
) -> None:
    """Refuse points on water that does not exist, and unknown planes."""
    if WATER in control.on and water is None:
        sentence = "points have the role waterline, but there is no --water."
        raise bad_file(name, "gcps.no_water", sentence)
    known = list(dict.fromkeys(one for one in control.on if one and one != WATER))
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


def _calibrated(path: File, cameras: Cameras) -> Cameras:
    """Return cameras with the lens of a calibration, which is of images of their size."""
    one = read_sensor(Path(path))
    for lens in set(cameras.lenses or ()):
        if (lens.width, lens.height, lens.unit) != (one.width, one.height, one.unit):
            words = (
                f"{path}: the calibration is of images of {one.width:g} x {one.height:g}"
                f" {one.unit}, the model has {lens.width:g} x {lens.height:g} {lens.unit}. Give the"
                " one of these images."
            )
            raise InputError("sensor.size", words, path=path)
    return replace(cameras, lenses=(one,) * len(cameras))


def _unknowns(given: AdjustOptions, cameras: Cameras) -> Unknowns:
    """Return what is estimated; of a lens that is not calibrated all parameters that it has."""
    tilt = None if given.sigma_tilt is None else float(np.tan(np.radians(given.sigma_tilt)))
    stated = {"level": given.sigma_level, "tilt": tilt, "index": given.sigma_index}
    surface: dict[str, float] = dict.fromkeys(given.free, np.inf)
    surface |= {name: sigma for name, sigma in stated.items() if sigma is not None}
    lens: tuple[str, ...] | None = given.lens_unknowns
    if lens is None:
        lens = () if given.lens is not None else default_lens(cameras.lenses or ())
    return Unknowns(given.poses, lens, surface, free_network=given.datum == "free")


def _ties_of_cloud(
    view: CloudView | None, cameras: Cameras, listed: ViewList | None, name: str, measured: int
) -> list[TiePoints]:
    """Return points of the cloud as tie points, in all images that show them, then as listed."""
    if view is None:
        words = (
            f"{name}: has {measured} usable tie points ({LEAST_TIES} are needed), and there is no"
            f" --cloud. {_EXPORTS}"
        )
        raise InputError("cameras.no_ties", words, path=name, ties=measured, least=LEAST_TIES)
    count, match = min(CLOUD_POINTS, view.points), None
    rows = np.sort(np.random.default_rng(0).choice(view.points, count, replace=False))
    if listed is not None:
        match = ViewMatch(listed, cameras, points=view.points, step_m=view.step_m)
    sample = sample_of(view, rows, match=match)
    guesses = [views_in_frame(sample.xyz, cameras)]
    guesses += [] if sample.views is None else [sample.views]
    found = [ties_of_cloud(sample.xyz, views, cameras) for views in guesses]
    found = [ties for ties in found if len(ties.xyz) >= LEAST_TIES]
    if not found:
        words = f"{name}: no image shows the cloud. Check the poses with 'pcfix cameras --cloud'."
        raise GeometryError("cameras.no_overlap", words, path=name)
    return found


# Writing


def _write(folder: Path, found: Adjusted, model: str) -> None:
    """Write an adjusted block: model, camera files, summary, report; all or nothing."""
    ties, cameras = None, found.cameras
    if found.source != "cloud":  # the adjusted tie points without outliers
        block, m = found.block, found.block.tie_points
        o = block.start[m]
        views = Views(block.start[: m + 1], block.camera[:o])
        ties = TiePoints(found.xyz[:m], views, block.image_xy[:o])
        ties = well_observed(ties, found.used[:o])
    with temporary_output(folder, is_folder=True) as draft:
        # the model in each format that holds its lenses exactly
        failed = ""
        try:
            write_colmap(draft / MODELS[0], cameras, ties)
        except InputError as error:
            failed = f"{MODELS[0]} was not written: {str(error).replace(f'{draft}/', '')}"
            found.notes.append(PcfixWarning("output.format", failed, name=MODELS[0]))
        try:
            write_table(draft, cameras)
        except InputError:  # the table is for blocks with one simple lens
            if failed:
                raise
        if found.unknowns.surface.get("shape") and isinstance(found.water, WaterRaster):
            write_water_raster(draft / WATER_FILE, found.water, found.cameras.crs)
        if found.precision.members is not None:
            write_members(draft, found.precision.members)
        summary = {"model": model, **adjustment_dict(found)}
        text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
        write_text(draft / SUMMARY, text, overwrite=False)
        write_text(draft / "report.html", adjustment_page(summary), overwrite=False)


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

"""What an adjustment is made of, read and checked, and by which observations it goes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.adjust.block import WATER
from pcfix.adjust.gather import (
    Datum,
    Material,
    check_surface,
    datum_of,
    no_datum,
    usable_ties,
    with_places,
)
from pcfix.adjust.problem import Progress
from pcfix.adjust.result import Adjusted
from pcfix.adjust.ways import (
    LEAST_TIES,
    by_cloud,
    by_ties,
    check_control,
    check_images,
    check_marks,
    unknowns_of,
)
from pcfix.errors import GeometryError, InputError, SettingError
from pcfix.flow.inputs import Inputs, mask_of
from pcfix.flow.surfaces import CloudView
from pcfix.io.cameras.table.sensor import read_sensor
from pcfix.io.crs import is_topocentric, parse_crs
from pcfix.io.files import check_input
from pcfix.io.gnss_positions import gnss_in_frame_of, read_gnss
from pcfix.io.ground_control import read_ground_control
from pcfix.io.views import ViewList, ViewMatch
from pcfix.model import Cameras, FloatArray, GroundControl, Lens, Views, WaterPlane, WaterSurface
from pcfix.options.declare import File
from pcfix.options.survey import WATER_UNKNOWNS, AdjustRules
from pcfix.port.shapes import FlatPort, Port
from pcfix.refract.choice import views_in_frame
from pcfix.water.index import index_of

if TYPE_CHECKING:
    from pyproj import CRS

CLOUD_POINTS = 6000
"""Points of the cloud that stand for tie points."""


class Survey(NamedTuple):
    """What was measured besides the images; see `pcfix.adjust_cameras`."""

    gcps: File | GroundControl | None = None
    gnss: File | None = None
    lens: File | None = None
    gcps_crs: str | None = None
    gnss_crs: str | None = None

    @property
    def gcps_name(self) -> str:
        """Of the control points, for messages."""
        return "gcps" if isinstance(self.gcps, GroundControl) else str(self.gcps)


class Job(NamedTuple):
    """One adjustment, its inputs read."""

    inputs: Inputs
    rules: AdjustRules
    view: CloudView | None
    crs: str | CRS | None
    material: Material
    views: ViewList | None
    control_name: str
    notes: list[str]


def read_job(inputs: Inputs, rules: AdjustRules, view: CloudView | None, survey: Survey) -> Job:
    """Read and check what goes into an adjustment.

    Raises
    ------
    PcfixError
        If a file cannot be read, or does not fit.
    """
    name = str(inputs.cameras) if isinstance(inputs.cameras, str | Path) else "cameras"
    found = inputs.read()
    crs = _map_of(found.crs) if view is None else view.crs
    old, views = inputs.block(crs, found)
    if old.rotations is None or old.lenses is None:
        raise InputError(
            f"{name}: an adjustment needs angles and a lens of every image; give the"
            " project or model of the software, or --sensor."
        )
    water = None if inputs.water is None else inputs.surface(view).surface
    check_surface(water)
    check_images(name, old, water, rules.fixed_images)
    _check_free(rules, inputs.port)
    index = index_of(rules.index, rules.index_formula)[0]
    gnss, no_gnss, notes = _datum(old, name, survey, rules.gnss_sigma)
    control = _control(old, water, survey, gnss)
    _check_surfaces(rules.parallel, control, water, survey.gcps_name)
    calibrated = None if survey.lens is None else _calibration(survey.lens, old)
    low, high = old.centres.min(axis=0), old.centres.max(axis=0)
    if view is not None:
        low, high = view.low, view.high
    mask = mask_of(inputs.water_mask, crs or old.crs, low[:2], high[:2])
    inside = None if mask is None else mask.inside
    material = Material(
        name, old, water, index, gnss, control, inputs.port, calibrated, inside,
        unknowns_of(rules, ()).level_sigma_m, no_gnss, rules.parallel,
    )  # fmt: skip
    return Job(inputs, rules, view, crs, material, views, survey.gcps_name, notes)


def _check_free(rules: AdjustRules, port: Port | None) -> None:
    """Refuse unknowns that what bends the light does not have."""
    what, known = "the water", [*WATER_UNKNOWNS[:4]]
    if port is not None:
        is_flat = isinstance(port, FlatPort)
        what = "a flat port" if is_flat else "a dome"
        known = ["index", "distance" if is_flat else "centre"]
    given = {"level": rules.sigma_level, "tilt": rules.sigma_tilt}
    for name in (*rules.free, *(name for name, sigma in given.items() if sigma)):
        if name not in known:
            raise SettingError(
                f"free '{name}': {what} has no {name}; what can be free of it is"
                f" {', '.join(known)}."
            )


def _check_surfaces(
    parallel: tuple[str, ...], control: GroundControl | None, water: WaterSurface | None, name: str
) -> None:
    """Refuse points on water that is not there, and planes that nobody knows."""
    on = () if control is None else control.on
    planes = list(dict.fromkeys(one for one in on if one and one != WATER))
    if WATER in on and water is None:
        raise InputError(f"{name}: points have the role waterline, but there is no --water.")
    known = planes + ([WATER] if isinstance(water, WaterPlane) else [])
    for one in parallel:
        if one not in known or len(parallel) < 2:
            raise SettingError(
                f"parallel '{','.join(parallel)}' needs two planes at least, of"
                f" {', '.join(known) or 'none'}: mark points of --gcps with the role on:NAME."
            )


def _map_of(crs: str | None) -> str | None:
    """Return the CRS of cameras where a cloud could be in it: one on a map."""
    if crs is None or is_topocentric(crs) or not parse_crs(crs, "cameras").is_projected:
        return None
    return crs


def _datum(
    old: Cameras, name: str, survey: Survey, sigma_m: float | None
) -> tuple[Datum, str, list[str]]:
    """Return GNSS positions in the block's frame, why they do not count, and notes."""
    cameras = old if survey.gnss is None else read_gnss(survey.gnss, old, crs=survey.gnss_crs)
    if cameras.gnss is None:
        return no_datum(len(cameras)), "", []
    name = name if survey.gnss is None else str(survey.gnss)
    try:
        found = gnss_in_frame_of(cameras, name)
    except (InputError, GeometryError, SettingError) as error:
        if survey.gnss is not None:
            raise
        return no_datum(len(cameras)), "", [f"{error} The GNSS positions are left out."]
    datum, notes = datum_of(old.centres, Datum(found.xyz, found.sigma_m), name, sigma_m)
    return datum, found.reason, ([found.reason] if found.reason else []) + notes


def _control(
    old: Cameras, water: WaterSurface | None, survey: Survey, gnss: Datum
) -> GroundControl | None:
    control = survey.gcps
    if control is None:
        return None
    if not isinstance(control, GroundControl):
        control = read_ground_control(control, old, crs=survey.gcps_crs)
    if water is not None:
        is_placed = bool(np.isfinite(gnss.xyz).any())
        check_marks(control, old, survey.gcps_name, is_placed=is_placed)
    return control


def _calibration(path: File, cameras: Cameras) -> Lens:
    """Return a calibration of images of this size."""
    one = read_sensor(check_input(path))
    for old in set(cameras.lenses or ()):
        if (old.width, old.height, old.unit) != (one.width, one.height, one.unit):
            raise InputError(
                f"the calibration is of images of {one.width:g} x {one.height:g} {one.unit},"
                f" the model has {old.width:g} x {old.height:g} {old.unit}; give that of these"
                " images."
            )
    return one


def adjusted(job: Job, progress: Progress | None = None) -> Adjusted:
    """Adjust by tie points where there are enough, else by the cloud.

    Raises
    ------
    PcfixError
        If there is neither, or the block cannot be adjusted.
    """
    material, rules = job.material, job.rules
    ties = None
    if rules.ties != "cloud":
        ties = job.inputs.tie_points(job.crs, placed=False)
    if ties is not None:
        ties = usable_ties(with_places(ties, material.old), material.old)
    if ties is not None and len(ties.xyz) >= LEAST_TIES:
        found = by_ties(material, ties, rules, progress)
    elif rules.ties == "measured":
        count = 0 if ties is None else len(ties.xyz)
        raise InputError(
            f"{material.name}: has {count} usable tie points, {LEAST_TIES} are needed: {_EXPORTS}"
        )
    elif job.view is None:
        raise InputError(
            f"{material.name}: has no tie points, and there is no cloud: give --cloud with the"
            f" cloud that these cameras made, or a model with tie points: {_EXPORTS}"
        )
    else:
        xyz, listed = _sample(job.view, job.views, material.old)
        guesses = {"all images in frame": views_in_frame(xyz, material.old)}
        if listed is not None:
            guesses["the images of the view list"] = listed
        found = by_cloud(material, xyz, guesses, rules, progress)
    if material.control is not None:
        check_control(found, job.control_name)
    return replace(found, notes=[*job.notes, *found.notes])


def _sample(
    view: CloudView, views: ViewList | None, cameras: Cameras
) -> tuple[FloatArray, Views | None]:
    """Return points evenly drawn from the cloud, and their lists where there is one."""
    count = min(CLOUD_POINTS, view.points)
    rows = np.sort(np.random.default_rng(0).choice(view.points, count, replace=False))
    match = None if views is None else ViewMatch(views, cameras, points=view.points)
    parts: list[Views] = []
    xyz, first = [], 0
    for seen in view.chunks():
        inside = rows[(rows >= first) & (rows < first + len(seen.xyz))] - first
        xyz.append(seen.xyz[inside])
        if match is not None:
            parts.append(match.for_chunk(seen.xyz, first).take(inside))
        first += len(seen.xyz)
    if match is None:
        return np.vstack(xyz), None
    start = np.cumsum(np.concatenate([[0], *(np.diff(part.start) for part in parts)]))
    return np.vstack(xyz), Views(start, np.concatenate([part.camera for part in parts]))


_EXPORTS = (
    "COLMAP's model with points3D, OpenSfM's reconstruction with tracks.csv, a Metashape project"
    " (.psx, .psz) or its BlocksExchange export with tie points, Pix4D's params folder with"
    " its tp_ file, or Bundler's .out have them."
)

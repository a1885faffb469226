"""What an adjustment is made of, read and checked, and by which observations it goes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.adjust.gather import (
    Datum,
    Material,
    check_surface,
    datum_of,
    no_datum,
    usable_ties,
    with_places,
)
from pcfix.adjust.problem import LogRow
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
from pcfix.io.crs import is_topocentric
from pcfix.io.files import check_input
from pcfix.io.gnss_positions import gnss_in_frame_of, read_gnss
from pcfix.io.ground_control import read_ground_control
from pcfix.io.views import ViewList, ViewMatch
from pcfix.model import Cameras, FloatArray, GroundControl, Lens, TiePoints, Views, WaterSurface
from pcfix.options.survey import AdjustRules
from pcfix.refract.choice import views_in_frame
from pcfix.water.index import index_of

if TYPE_CHECKING:
    from pyproj import CRS

AnyPath = str | PathLike[str]

CLOUD_POINTS = 6000
"""Points of the cloud that stand for tie points."""


class Survey(NamedTuple):
    """What was measured besides the images; see `pcfix.adjust_cameras`."""

    gcps: AnyPath | GroundControl | None = None
    gnss: AnyPath | None = None
    lens: AnyPath | None = None
    gcps_crs: str | None = None
    gnss_crs: str | None = None


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
    crs = _own_crs(found) if view is None else view.crs
    old, views = inputs.block(crs, found)
    if old.rotations is None or old.lenses is None:
        raise InputError(
            f"{name}: an adjustment needs angles and a lens of every image; give the"
            " project or model of the software, or --sensor."
        )
    water = None if inputs.water is None else inputs.surface(view).surface
    check_surface(water)
    check_images(name, old, water, rules.fixed_images)
    index = index_of(rules.index)[0]
    gnss, no_gnss, notes = _datum(old, name, survey, rules.gnss_sigma)
    control = _control(old, water, survey, gnss)
    calibrated = None if survey.lens is None else _calibration(survey.lens, old)
    inside = None
    if inputs.water_mask is not None:
        low, high = old.centres.min(axis=0), old.centres.max(axis=0)
        if view is not None:
            low, high = view.low, view.high
        mask = mask_of(inputs.water_mask, crs or old.crs, low[:2], high[:2])
        inside = None if mask is None else mask.inside
    level_sigma_m = unknowns_of(rules, ()).level_sigma_m
    material = Material(
        name, old, water, index, gnss, control, inputs.port, calibrated, inside, level_sigma_m,
        no_gnss,
    )  # fmt: skip
    return Job(inputs, rules, view, crs, material, views, _control_name(survey), notes)


def _own_crs(cameras: Cameras) -> str | None:
    """Return the CRS in which a model without a cloud is adjusted: its own, where it is one."""
    own = cameras.crs
    return None if own is None or is_topocentric(own) else own


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
        check_marks(control, old, _control_name(survey), is_placed=is_placed)
    return control


def _control_name(survey: Survey) -> str:
    return "gcps" if isinstance(survey.gcps, GroundControl) else str(survey.gcps)


def _calibration(path: AnyPath, cameras: Cameras) -> Lens:
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


def adjusted(job: Job, progress: Callable[[LogRow], None] | None = None) -> Adjusted:
    """Adjust by tie points where there are enough, else by the cloud.

    Raises
    ------
    PcfixError
        If there is neither, or the block cannot be adjusted.
    """
    material, rules = job.material, job.rules
    ties = None if rules.ties == "cloud" else _tie_points(job)
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


def _tie_points(job: Job) -> TiePoints | None:
    found, old = job.inputs.tie_points(job.crs, placed=False), job.material.old
    return None if found is None else usable_ties(with_places(found, old), old)


def _sample(
    view: CloudView, views: ViewList | None, cameras: Cameras
) -> tuple[FloatArray, Views | None]:
    """Return points evenly drawn from the cloud, and their lists where there is one."""
    count = min(CLOUD_POINTS, view.points)
    rows = np.sort(np.random.default_rng(0).choice(view.points, count, replace=False))
    match = None if views is None else ViewMatch(views, cameras, points=view.points)
    xyz, parts, first = [], [], 0
    for seen in view.chunks():
        mine = rows[(rows >= first) & (rows < first + len(seen.xyz))] - first
        xyz.append(seen.xyz[mine])
        if match is not None:
            parts.append(match.for_chunk(seen.xyz, first).take(mine))
        first += len(seen.xyz)
    if match is None:
        return np.vstack(xyz), None
    counts = np.concatenate([np.diff(part.start) for part in parts])
    start = np.concatenate([[0], np.cumsum(counts)])
    return np.vstack(xyz), Views(start, np.concatenate([part.camera for part in parts]))


_EXPORTS = (
    "COLMAP's model with points3D, OpenSfM's reconstruction with tracks.csv, a Metashape project"
    " (.psx, .psz) or its BlocksExchange export with tie points, Pix4D's params folder with"
    " its tp_ file, or Bundler's .out have them."
)

"""Inspect a camera file or a water surface, alone and against a cloud."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.adjust.diagnosis import Evidence
from pcfix.errors import InputError, SettingError, shown_once
from pcfix.flow.diagnosis import (
    diagnose,
    focal_length_of,
    given_focal_lengths,
    has_datum,
    quick_ties,
)
from pcfix.flow.inputs import Inputs, ties_of
from pcfix.flow.next_steps import adjust_words
from pcfix.flow.plausibility import plausible
from pcfix.flow.runner import check_summary, write_summary
from pcfix.flow.shore import check_shoreline, write_shoreline
from pcfix.flow.surfaces import CloudView, file_points, find_surface, view_of
from pcfix.grid.shoreline import NearWater
from pcfix.io.cameras.georeference import adjusted_minus_gnss
from pcfix.io.cameras.mistakes import UNDULATION_M, likely_mistake
from pcfix.io.clouds import check_same_crs, read_reference
from pcfix.io.files import check_input, check_output, write_bytes
from pcfix.io.gnss_positions import read_gnss
from pcfix.io.ground_control import read_ground_control
from pcfix.lens.frames import cameras_in_sight
from pcfix.lens.imaging import unproject
from pcfix.model import Cameras, FloatArray, Lens, TiePoints, WaterDimension, WaterSurface
from pcfix.options.declare import File, taken
from pcfix.options.survey import CamerasCheckOptions, WaterCheckOptions
from pcfix.report.cameras import CamerasReport, Fit, GnssResiduals, Sensor, block_figure
from pcfix.report.page import png_of
from pcfix.report.water import WaterReport, water_figure
from pcfix.water.index import index_of
from pcfix.water.surface import surface_above

MOST_SENSORS = 8
"""Lines on lenses; if there are more, they are grouped by sensor and frame, or by kind."""
SAMPLE_POINTS, WATER_SAMPLE_POINTS = 50_000, 200_000
"""Points of the cloud that are tested in the frames, and below the water; evenly spread."""


def check_cameras(
    path: File, options: CamerasCheckOptions | None = None, **keywords: Any
) -> CamerasReport:
    """Inspect a camera file: contents, fit to a cloud, absorbed refraction; ``pcfix cameras``.

    Parameters
    ----------
    path : path
        See `pcfix.read_cameras`.
    options : CamerasCheckOptions, optional
        Or its attributes as keywords. With a cloud and water it is tested whether the poses have
        absorbed refraction, see `pcfix.adjust.diagnosis`.
    """
    given = taken(CamerasCheckOptions, options, keywords, "check_cameras")
    cloud, plot = given.cloud, given.plot
    check_summary(given, [path])
    if plot is not None:
        files = [path, cloud, given.gnss, given.gcps, given.lens, given.reference]
        known = [file for file in files if file is not None]
        check_output(plot, overwrite=given.overwrite, inputs=known)
    if cloud is None or given.water is None:
        for name in ("gcps", "lens", "reference"):
            if getattr(given, name) is not None:
                sentence = f"{name} needs cloud and water, to test for absorbed refraction."
                raise SettingError("option.needs", sentence, options=[name, "cloud", "water"])
    water = 0.0 if given.water is None else given.water
    inputs = replace(replace(given, water=water).part(Inputs), cameras=path)
    read = shown_once(inputs.read, lambda cameras: cameras.notes)
    view = None if cloud is None else view_of(check_input(cloud))
    surface = None if given.water is None else inputs.surface(view).surface
    xyz, heights, problem = np.zeros((0, 3)), None, ""
    if view is not None:
        xyz, heights = _sample(view, SAMPLE_POINTS, surface)
        cameras = inputs.block(view.crs, read)[0]
    else:
        try:
            cameras = inputs.block(None, read)[0]
        except InputError as error:
            cameras, problem = read, str(error)
    if given.gnss is not None:
        cameras = read_gnss(given.gnss, cameras)
    diagnosis, remedy = None, ("", "")
    if view is not None and surface is not None:
        diagnosis = diagnose(_evidence(given, inputs, cameras, view, surface))
        surveys = {name: getattr(given, name) for name in ("gnss", "gcps", "lens", "index")}
        remedy = adjust_words(inputs, view.name, has_datum=has_datum(cameras, str(path)), **surveys)
    level = None
    if surface is not None and not (isinstance(surface, WaterDimension) and heights is None):
        at = cameras.centres if heights is None else xyz
        known_m = surface_above(surface, at, heights).height_m
        level = float(np.nanmean(known_m)) if np.isfinite(known_m).any() else None
    above = range_m = tilt_deg = None
    if level is not None and not problem:  # geocentric cameras have no heights
        above = cameras.centres[:, 2] - level
        range_m = float(above.min()), float(above.mean()), float(above.max())
    if cameras.rotations is not None and not problem:
        tilt = np.degrees(np.arccos(np.clip(-cameras.rotations[:, 2, 2], -1.0, 1.0)))
        tilt_deg = float(np.median(tilt)), float(tilt.max())
    gnss, fit = _gnss(cameras, str(path)), None
    if view is not None:
        flight = {"file": path, "water_m": level, "every": view.points / max(len(xyz), 1)}
        fit = _fit(cameras, view, xyz, quick_ties(inputs, view.crs), flight)
        up = None if gnss is None or inputs.cameras_crs is None else gnss.mean_m[2]
        if up is not None and abs(up) >= UNDULATION_M[0] and not fit.verdict:
            verdict = (
                f"With --cameras-crs the cameras are {abs(up):.1f} m"
                f" {'above' if up > 0.0 else 'below'} their GNSS heights. One of them is likely"
                " above the ellipsoid and the other above the geoid; check the vertical CRS."
            )
            fit = replace(fit, verdict=verdict)
    report = CamerasReport(
        path=str(path),
        cameras=cameras,
        crs_read=read.crs,
        sensors=_sensors(cameras, above),
        height_above_water_m=range_m,
        tilt_deg=tilt_deg,
        gnss=gnss,
        fit=fit,
        sample_xyz=xyz,
        level_m=level,
        problem=problem,
        diagnosis=diagnosis,
        remedy=remedy,
    )
    if plot is not None:
        write_bytes(plot, png_of(block_figure(report)), overwrite=given.overwrite)
    write_summary(given, report.as_dict())
    return report


def check_water(
    spec: Any, options: WaterCheckOptions | None = None, **keywords: Any
) -> WaterReport:
    """Read, fit or find a water surface, and describe it; ``pcfix water``.

    Parameters
    ----------
    spec : WaterSurface, float, str or path
        See `pcfix.flow.surfaces.find_surface`.
    options : WaterCheckOptions, optional
        Or its attributes as keywords.
    """
    given = taken(WaterCheckOptions, options, keywords, "check_water")
    cloud, plot = given.cloud, given.plot
    check_summary(given)
    inputs = [] if cloud is None else [cloud]
    if plot is not None:
        check_output(plot, overwrite=given.overwrite, inputs=inputs)
    check_shoreline(given.shoreline, overwrite=given.overwrite, inputs=inputs)
    view = None if cloud is None else view_of(check_input(cloud))
    found = shown_once(lambda: find_surface(spec, given, view), lambda found: found.notes)
    sample, below, unknown, shoreline = np.zeros((0, 3)), None, None, None
    if view is not None:
        sample, _ = _sample(view, WATER_SAMPLE_POINTS)
        if not isinstance(found.surface, WaterDimension):
            height = surface_above(found.surface, sample, None).height_m
            unknown = float(np.mean(~np.isfinite(height)))
            below = float(np.mean(sample[:, 2] < height))
    if view is not None and given.shoreline is not None:
        points = NearWater()
        for one in file_points(Path(view.name), found.surface):
            above = surface_above(found.surface, one.xyz, one.heights)
            points += NearWater.of(one.xyz, one.xyz[:, 2] - above.height_m)
        shoreline = write_shoreline(
            given.shoreline, points, found.sigma_level_m, view.crs, overwrite=given.overwrite
        )
    name = None if view is None else view.name
    report = WaterReport(str(spec), found, name, below, unknown, sample, shoreline)
    if plot is not None:
        write_bytes(plot, png_of(water_figure(report)), overwrite=given.overwrite)
    write_summary(given, report.as_dict())
    return report


def _evidence(
    given: CamerasCheckOptions,
    inputs: Inputs,
    cameras: Cameras,
    view: CloudView,
    surface: WaterSurface,
) -> Evidence:
    """Collect all evidence on whether the poses have absorbed refraction."""
    path, lens, gcps = str(inputs.cameras), given.lens, given.gcps
    reference = None if given.reference is None else read_reference(given.reference)
    if reference is not None:
        crs = None if isinstance(view.crs, str) else view.crs
        check_same_crs(view.name, crs, reference.name, reference.crs)
    return Evidence(
        cameras, path, surface, index_of(given.index, given.index_formula)[0],
        view=view, reference=reference,
        control=None if gcps is None else read_ground_control(gcps, cameras).surveyed,
        calibrated=given_focal_lengths(path) if lens is None else focal_length_of(lens),
        ties=ties_of(inputs, view.crs),
    )  # fmt: skip


def _sample(
    view: CloudView, most: int, water: WaterSurface | None = None
) -> tuple[FloatArray, FloatArray | None]:
    """Return points evenly spread over the file, and their water heights if it has any."""
    every = max(1, view.points // most)
    parts, heights = [], []
    for xyz, height, *_ in file_points(Path(view.name), water):
        parts.append(xyz[::every])
        if height is not None:
            heights.append(height[::every])
    return np.vstack(parts), np.concatenate(heights) if heights else None


def _sensors(cameras: Cameras, above_m: FloatArray | None) -> tuple[Sensor, ...]:
    """Return the lenses of a block: each separately, or grouped by frame or kind if many."""
    lenses = cameras.lenses
    if lenses is None:
        return ()
    keys: list[Callable[[Lens], Any]] = [
        lambda lens: lens,
        lambda lens: (lens.sensor, lens.width, lens.height, lens.unit, lens.projection),
        lambda lens: (lens.unit, lens.projection, _is_distorted(lens)),
    ]
    groups: dict[Any, list[int]] = {}
    for key in keys:
        groups = {}
        for row, lens in enumerate(lenses):
            groups.setdefault(key(lens), []).append(row)
        # separately only if most lenses have several images
        if len(groups) <= MOST_SENSORS and (key is not keys[0] or len(groups) <= len(lenses) // 2):
            break
    calibrated = any(_is_distorted(lens) for lens in lenses)
    return tuple(_sensor(lenses, rows, above_m, calibrated) for rows in groups.values())


def _is_distorted(lens: Lens) -> bool:
    return any((*lens.radial, *lens.denominator, *lens.tangential, *lens.thin_prism))


def _sensor(
    lenses: tuple[Lens, ...], rows: list[int], above_m: FloatArray | None, calibrated: bool
) -> Sensor:
    lens, alike = lenses[rows[0]], list(dict.fromkeys(lenses[row] for row in rows))
    pixel = lens.pixel_size_mm
    focal_px = lens.focal if lens.unit == "px" else None if pixel is None else lens.focal / pixel
    above = None if above_m is None else float(np.mean(above_m[rows]))
    middle = (lens.principal_x, lens.principal_y) == (lens.width / 2.0, lens.height / 2.0)
    return Sensor(
        name=lens.sensor if all(one.sensor == lens.sensor for one in alike) else "several",
        images=len(rows),
        width=lens.width,
        height=lens.height,
        focal=min(one.focal for one in alike),
        unit=lens.unit,
        focal_mm=lens.focal if lens.unit == "mm" else None if pixel is None else lens.focal * pixel,
        pixel_size_um=None if pixel is None else 1000.0 * pixel,
        projection=lens.projection,
        distorted=_is_distorted(lens),
        gsd_m=above / focal_px if above is not None and above > 0.0 and focal_px else None,
        lenses=len(alike),
        focal_most=max(one.focal for one in alike),
        frames=len({(one.width, one.height) for one in alike}),
        folded=max(_folded(one) for one in alike[:: 1 + len(alike) // 20]),
        nominal=calibrated and middle and not _is_distorted(lens),
    )


def _folded(lens: Lens) -> float:
    """Return the share of the frame that no direction is imaged to, beyond the fold of the lens."""
    if not _is_distorted(lens):  # the border of a fisheye's image is none
        return 0.0
    across = np.linspace(0.0, 1.0, 41)
    places = np.stack(np.meshgrid(across * lens.width, across * lens.height), axis=-1)
    return float(np.mean(np.isnan(unproject(lens, places.reshape(-1, 2))).any(axis=1)))


def _gnss(cameras: Cameras, name: str) -> GnssResiduals | None:
    if cameras.gnss is None:
        return None
    found = adjusted_minus_gnss(cameras, name)
    rows = np.flatnonzero(np.isfinite(found.enu_m[:, 0]))
    if len(rows) == 0:
        return GnssResiduals(0, (None,) * 3, (None,) * 3, 0.0, "", found.reason)
    enu = found.enu_m[rows]
    length = np.sqrt(np.nansum(enu * enu, axis=1))
    worst = int(np.argmax(length))
    mean, sd = (
        tuple(float(one) if np.isfinite(one) else None for one in values)
        for values in (enu.mean(axis=0), enu.std(axis=0))
    )
    image = cameras.labels[rows[worst]]
    return GnssResiduals(len(rows), mean, sd, float(length[worst]), image, found.reason)


def _fit(
    cameras: Cameras,
    view: CloudView,
    xyz: FloatArray,
    ties: TiePoints | None,
    flight: dict[str, Any],
) -> Fit:
    """Test cameras against a sample of the cloud."""
    from scipy.spatial import cKDTree

    visible = cameras_in_sight(xyz, cameras)
    shares = {str(k): float(np.mean(visible == k)) for k in (0, 1, 2)}
    shares["3 or more"] = float(np.mean(visible >= 3))
    low, high, centres = xyz.min(axis=0), xyz.max(axis=0), cameras.centres
    apart = np.maximum(np.maximum(low - centres.max(axis=0), centres.min(axis=0) - high), 0.0)[:2]
    # cameras lower than the nearest point of the cloud in plan
    reach = float(np.hypot(*np.ptp(xyz[:, :2], axis=0))) * 0.1 + 1.0
    distance, row = (np.asarray(one) for one in cKDTree(xyz[:, :2]).query(centres[:, :2]))
    below = int(np.count_nonzero((distance < reach) & (centres[:, 2] <= xyz[row, 2])))
    verdict = likely_mistake(centres, low, high, view.crs) or ""
    if not verdict and below:
        verdict = (
            f"{below} of {len(cameras)} cameras are below the ground. Check the vertical datum and"
            " the order of the axes."
        )
    found = plausible(cameras, xyz, ties, **flight)
    verdict = verdict or " ".join(map(str, found.doubts))
    return Fit(view.name, len(xyz), shares, float(np.hypot(*apart)), below, verdict, str(found))

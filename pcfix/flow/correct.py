"""Correct a LAS or LAZ cloud, or arrays, for refraction: two doors to one calculation.

A plan is made for the whole cloud (`pcfix.flow.planning`), each chunk is corrected by it
(`pcfix.flow.correction`), and the statistics are checked and summarized.
"""

from __future__ import annotations

import warnings
from dataclasses import fields
from itertools import compress
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError, PcfixWarning, SettingError, coded
from pcfix.flow.correction import CloudTally, Plan, correct_chunk
from pcfix.flow.diagnosis import diagnose_in_passing, quick_ties
from pcfix.flow.inputs import CameraInputs, Inputs, paths_in, transfer_between
from pcfix.flow.planning import plan_correction, plan_of, read_inputs
from pcfix.flow.plausibility import CloudSample, Plausible, likely_mistake, plausible
from pcfix.flow.raster import check_heights
from pcfix.flow.runner import Chunk, FileTask, FileWork, Progress, run_command
from pcfix.flow.surfaces import CloudView, Points, corners, points_of, view_of
from pcfix.io.las import columns
from pcfix.io.las.source import LasSource
from pcfix.io.las.writing import output_header
from pcfix.io.tiles import Clouds, is_raster
from pcfix.io.views import ViewReport
from pcfix.label.labelling import Labelling
from pcfix.lens.frames import count_outside_frames
from pcfix.model import (
    BATHYMETRIC_POINT,
    NO_CAMERAS,
    Cameras,
    Correction,
    FloatArray,
    Outcome,
    TiePoints,
    Views,
    WaterDimension,
    WaterSurface,
)
from pcfix.options.correct import CorrectOptions, PointsOptions, RefractionOptions, ScienceOptions
from pcfix.options.declare import File, taken
from pcfix.options.shared import LandRules
from pcfix.refract.regression import DepthRegression
from pcfix.refract.tally import Tally
from pcfix.report.text import Summary
from pcfix.version import __version__
from pcfix.water.auto import WaterProposal
from pcfix.water.checks import as_surface, check_submerged, checked_points, refuse_under_water
from pcfix.water.index import with_index
from pcfix.water.surface import FoundSurface


def correct_file(
    input: Clouds,
    output: File,
    *,
    options: CorrectOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> Summary:
    """Correct a LAS or LAZ cloud, of one file or many, or a DSM; what ``pcfix correct`` runs.

    Parameters
    ----------
    input, output : path
        The names end in ``.las`` or ``.laz``; the output is LAS 1.4, point format 6, 7 or 8 (9
        or 10 for inputs with waveforms). For many files (a list of paths; see
        `pcfix.io.tiles.tiles_of`) the output is a folder, and every point is corrected as in one
        file of all points. A GeoTIFF of heights is corrected as the cloud of the centres of its
        cells; an output that ends in ``.tif`` has the same grid, see `pcfix.flow.raster`.
    options : CorrectOptions, optional
        Or its attributes as keywords, as of ``pcfix correct``: ``cameras`` (a path or
        `pcfix.Cameras`), ``water`` (what `pcfix.read_water` takes, a `pcfix.WaterSurface`,
        shoreline points in a vector file, or ``auto``) and many more. Every command takes its
        options so.
    progress : callable, optional
        Called with (points done, points in all) after each chunk, or each of many files.

    Raises
    ------
    PcfixError
        With one sentence on what to change. No output is left behind. Every command raises it.
    """
    given = taken(CorrectOptions, options, keywords, "correct_file")

    def plan(task: FileTask) -> Plan:
        """Return the plan for a file, or for many as one cloud."""
        planned = plan_correction(read_inputs(given, view_of(task.source, given.jobs)))
        check_heights(task.source, planned.found.surface)
        return planned

    return run_command(
        "correct", input, output, given, plan=plan, work=_correcting, finish=finish,
        reads=paths_in(given), progress=progress,
    )  # fmt: skip


def _correcting(plan: Plan, source: LasSource) -> FileWork:
    """Return the correction of one file: its header, and each chunk."""
    written = columns.columns_for(plan.options.dimensions)
    if is_raster(source.path):
        written = (*columns.COLUMNS, columns.OUTCOME)
    header = output_header(source, "settings", plan.provenance(), written)

    def compute(points: Chunk, row: int) -> tuple[Correction, CloudTally]:
        return correct_chunk(plan, points_of(points, source, plan.found.surface), row)

    def apply(points: Chunk, correction: Correction) -> Chunk:
        """Move points, and write their new dimensions, classes and flags."""
        new = columns.convert(points, header.point_format)
        # whole steps of the file's own scale, so that 'pcfix restore' gets back every bit
        classes = np.array(new["classification"])
        withheld = np.asarray(new["withheld"]).astype(bool)
        changes = columns.changes_of(written, correction, classes, withheld, new.scales)
        columns.move(new, changes.steps, source.path)
        columns.fill(new, changes)
        new.array["classification"][correction.corrected] = BATHYMETRIC_POINT
        new["withheld"][:] = (withheld | changes.flagged).astype(np.uint8)
        return new

    return FileWork(header, compute, apply)


def finish(plan: Plan, task: FileTask, tally: CloudTally) -> Summary:
    """Refuse a result in which cloud, water and cameras do not fit, else summarize it.

    Warns of what is uncertain.
    """
    options, figures = plan.options, tally.figures
    water_notes = _check_counts(plan, tally, tally.views)
    counts, uncertainty = figures.as_dict(), figures.uncertainty(plan.reconstruction)
    tested, poses, absorbed = None, None, None
    if plan.inputs.port is None:
        ties = quick_ties(plan.inputs, plan.view.crs) if len(plan.cameras) else None
        tested = check_fit(plan, tally, ties)
        poses, absorbed = diagnose_in_passing(plan, ties)
        water, moved = str(plan.found.surface), plan.survey.level_offset_m
        if moved is not None:
            times = f"{moved.min():+.3f} to {moved.max():+.3f} m at the times of the images"
            water = f"{water}, {times}"
        by_poses = plan.survey.learned.poses
        if uncertainty is not None and by_poses is not None:
            uncertainty["poses_m"] = round(by_poses.middle_m, 4)
    else:  # no depths, and no orders by depth
        counts["depth_m"], uncertainty = {}, None
        water = f"all around, seen through a {plan.inputs.port}"
    unused = list(compress(plan.cameras.labels, np.logical_not(figures.camera_used)))
    reconstruction = plan.reconstruction
    notes = [
        *plan.input_notes,
        *([] if tally.views is None else tally.views.notes()),
        *(() if tested is None else tested.problems),
        *plan.notes,
        *coded("water.extent", water_notes),
        *([] if absorbed is None else [absorbed]),
    ]
    return Summary(
        input=str(task.source),
        output=str(task.target),
        pcfix=__version__,
        **counts,
        cameras=len(plan.cameras),
        cameras_used=len(plan.cameras) - len(unused),
        cameras_unused=unused,  # labels of those without corrected points
        seconds=task.seconds,
        views=None if tally.views is None else vars(tally.views),
        warnings=[one.as_dict() for one in notes],
        labelling=plan.labelling.report(tally.labels),
        settings={**options.part(ScienceOptions).as_dict(), **plan.settings},
        water=water,
        water_fit=plan.found.as_dict(),
        uncertainty=uncertainty,
        transfer=None if tally.transfer is None else tally.transfer.as_dict(),
        reconstruction=reconstruction,  # its type, and why
        # other notes on the cloud, also in `warnings`
        notes=[
            one
            for one in map(str, plan.notes)
            if reconstruction is None or one not in reconstruction["because"]
        ],
        poses=poses,  # whether they have absorbed the refraction
        fit=None if tested is None else tested.as_dict(),
    )


def _check_counts(plan: Plan, tally: CloudTally, report: ViewReport | None) -> list[str]:
    """Refuse a cloud of which nothing can be corrected; return notes on the extent of the water."""
    # From the general to the particular: a view list of another cloud, or a mask elsewhere, would
    # also leave points without cameras.
    name, figures = plan.view.name, tally.figures
    if report is not None:
        for note in report.notes():
            warnings.warn(note, stacklevel=2)
    if tally.transfer is not None:
        tally.transfer.check(name)
    plan.labelling.check(name, tally.labels)
    water_notes, water = list[str](), plan.found.surface
    if tally.water is not None:
        check_submerged(tally.water.submerged, name, water, tally.water.heights())
        if isinstance(water, WaterDimension):
            refuse_under_water(plan.cameras, figures.lowest_water_m, str(water))
        water_notes = tally.water.check_reach(name, water, deep=plan.options.deep)
    elif figures.submerged == 0:
        raise GeometryError(
            "cloud.none_submerged", f"{name}: no point is left to correct. Check the mask."
        )
    flat = int(figures.outcomes[Outcome.FLAT_RAYS])
    if figures.outcomes[Outcome.NO_CAMERA] + flat == figures.submerged:
        raise GeometryError(
            "cameras.max_angle" if flat else "cameras.no_overlap",
            f"{name}: {_no_visible_camera(plan, figures, flat)}",
            submerged=figures.submerged,
            flat=flat,
        )
    if not figures.corrected and figures.submerged:
        reasons = {why: n for why, n in figures.uncorrected().items() if n}
        listed = "; ".join(f"{n:,}: {why}" for why, n in reasons.items())
        raise GeometryError(
            "cameras.none_corrected",
            f"{name}: none of {figures.submerged:,} submerged points can be corrected ({listed})."
            " Check that cameras and cloud belong together.",
            reasons=reasons,
        )
    return water_notes


def _no_visible_camera(plan: Plan, figures: Tally, flat: int) -> str:
    """Return the sentence for a cloud of which no camera sees a submerged point."""
    limit = plan.survey.limit_deg
    if flat:
        return (
            f"no submerged point has two rays within {limit or 90.0:g} deg of the surface"
            f" normal; {flat:,} points have rays at larger angles. Increase --max-angle."
        )
    middle = (figures.low + figures.high) / 2.0
    distance = float(np.hypot(*(plan.cameras.centres - middle)[:, :2].T).min())
    within = f" within {limit:g} degrees" if limit else ""
    sentence = (
        f"no image shows a submerged point{within}; the nearest is {distance:,.1f} m in"
        f" plan from the middle of the {figures.submerged:,} submerged points. Check that cameras"
        " and cloud have the same CRS, and that pitch 0 is straight down."
    )
    mistake = likely_mistake(plan.cameras.centres, figures.low, figures.high)
    return f"{sentence} {mistake or ''}".strip()


def check_fit(plan: Plan, tally: CloudTally, ties: TiePoints | None = None) -> Plausible:
    """Test cameras, cloud and water against each other; warn of what does not fit."""
    sample, given = tally.sample or CloudSample(), plan.inputs.cameras
    problems = () if isinstance(plan.found, WaterProposal) else sample.level_notes()
    tested = plausible(
        plan.cameras, sample.rows[:, :3], ties, problems,
        file="" if isinstance(given, Cameras) else given or "", water_m=sample.water_m,
        listed=plan.kind is not None,
    )  # fmt: skip
    for warning in tested.problems:
        warnings.warn(warning, stacklevel=3)
    return tested


def correct_points(
    xyz: npt.ArrayLike,
    cameras: Cameras | None,
    water: WaterSurface | float | npt.ArrayLike,
    *,
    options: RefractionOptions | None = None,
    views: Views | None = None,
    level_offset_m: npt.ArrayLike | None = None,
    adjusted_from: Cameras | None = None,
    regression: DepthRegression | None = None,
    **keywords: Any,
) -> Correction:
    """Correct apparent points for refraction at the water surface.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Apparent points, metres, world frame: the whole cloud, else set ``occlusion="off"``. Points
        above the water surface are returned bit for bit.
    cameras : Cameras or None
        Poses in the same frame; see `pcfix.read_cameras`. The methods factor and regression need
        none.
    water : WaterSurface, float, or array of shape (n,)
        The water surface (see `pcfix.read_water`), its level in metres, or its height above
        each point, NaN for land and where it is unknown.
    options : RefractionOptions, optional
        Or its attributes as keywords, as of ``pcfix correct``: index, method, max_angle (degrees
        from the surface normal), camera_set, matcher, depth_factor, sigma_image and the other
        standard deviations. With water_per_image, `water` still decides which points are submerged,
        and how deep.
    views : Views, optional
        The view list: the images that contributed to each point, as rows of `adjusted_from` if it
        is given, else of `cameras`. Default: as the option `camera_set` says.
    level_offset_m : array, shape (k,), optional
        Height of the water above `water` when each image was taken; see
        `pcfix.io.tides.level_offsets`. Each ray is refracted at its own surface; `water` decides
        which points are submerged, and how deep. Default: zero.
    adjusted_from : Cameras, optional
        The original cameras, in the same frame, if `cameras` are the same images (matched by their
        labels) after an adjustment. All points are first transferred to the adjusted cameras; see
        `pcfix.adjust.transfer`.
    regression : DepthRegression, optional
        For the method regression; see `pcfix.refract.regression`.

    Returns
    -------
    Correction
        One row per input point, in the same order.

    Raises
    ------
    SettingError
        If an argument is outside its range, or a coordinate is not finite.
    GeometryError
        If a camera is below the water.

    Examples
    --------
    Two cameras 100 m above a bed that looks 2 m deep:

    >>> import numpy as np, pcfix
    >>> cameras = pcfix.Cameras(("a", "b"), np.array([[-20.0, 0, 100], [20.0, 0, 100]]))
    >>> result = pcfix.correct_points([[0.0, 0.0, -2.0]], cameras, 0.0)
    >>> result.xyz.round(3).tolist()
    [[0.0, 0.0, -2.703]]
    """
    given = taken(PointsOptions, options, keywords, "correct_points")
    xyz = checked_points(xyz)
    surface, heights = as_surface(water, len(xyz))
    values = {one.name: getattr(given, one.name) for one in fields(given)}
    all_options = CorrectOptions(water=surface, **values)
    if not cameras:
        all_options.check_no_cameras()
        if not (views is None and level_offset_m is None and adjusted_from is None):
            raise SettingError(
                "option.needs",
                "views, level_offset_m and adjusted_from have no effect without cameras. Give both,"
                " or neither.",
                needs="cameras",
            )
    cameras = cameras or NO_CAMERAS
    offset: FloatArray | None = None
    if level_offset_m is not None:
        offset = np.ascontiguousarray(level_offset_m, dtype=np.float64)
        if offset.shape != (len(cameras),) or not np.isfinite(offset).all():
            sentence = f"level_offset_m must be {len(cameras)} finite numbers, one per camera."
            raise SettingError("array.shape", sentence, shape=offset.shape)
    original = cameras if adjusted_from is None else adjusted_from
    if views is not None:
        _check_views(views, xyz, original)
    points = Points(xyz, heights, np.zeros(len(xyz), np.uint8), views=views)
    view = CloudView(
        "xyz", None, *corners(*xyz[:, :2].T), len(xyz), lambda water=None: iter([points])
    )
    transfer = None if adjusted_from is None else transfer_between(adjusted_from, cameras)
    plan = plan_of(
        with_index(all_options),
        Inputs(cameras=cameras, water=surface),
        view,
        CameraInputs(cameras, None, original, transfer),
        FoundSurface(surface),
        offset,
        views,
        Labelling(LandRules()),
        regression,
    )
    plan = plan_correction(plan)
    correction, tally = correct_chunk(plan, points, 0, covariances=True)
    if tally.water is not None:
        tally.water.check_reach("xyz", surface, deep=given.deep)
    check_fit(plan, tally)
    for note in plan.input_notes:
        warnings.warn(note, stacklevel=2)
    return correction


def _check_views(views: Views, points: FloatArray, cameras: Cameras) -> None:
    """Refuse views that are no table of these points, and warn of points outside their images."""
    n, start, camera = len(points), views.start, views.camera
    is_table = len(start) == n + 1 and start[0] == 0 and start[-1] == len(camera)
    if not is_table or (np.diff(start) < 0).any():
        raise SettingError(
            "views.table",
            f"views must have {n + 1} starts that do not decrease, from 0 to the number of"
            " entries.",
        )
    if len(camera) and not 0 <= camera.min() <= camera.max() < len(cameras):
        raise SettingError(
            "views.camera", f"views name camera {camera.max()}, but there are {len(cameras)}."
        )
    counts = count_outside_frames(points, views, cameras)
    if counts.any():
        entries, outside = int(counts.sum()), int(np.count_nonzero(counts))
        sentence = f"views: {entries:,} entries of {outside:,} points are ignored: their cameras"
        note = PcfixWarning("views.outside", f"{sentence} face elsewhere.", entries=entries)
        warnings.warn(note, stacklevel=3)

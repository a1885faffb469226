"""Correct a LAS or LAZ cloud, or arrays, for refraction: two doors to one calculation.

A plan is made for the whole cloud (`pcfix.flow.planning`), each chunk is corrected by it
(`pcfix.flow.correction`), and the statistics are checked and summarized (`pcfix.flow.outcome`).
"""

from __future__ import annotations

import warnings
from dataclasses import fields
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.flow.correction import CloudTally, Plan, correct_chunk
from pcfix.flow.inputs import CameraInputs, Inputs, paths_in, transfer_between
from pcfix.flow.outcome import check, check_fit, summarize
from pcfix.flow.planning import plan_correction, plan_of, read_inputs
from pcfix.flow.runner import Check, Chunk, Command, FileTask, Progress, stream
from pcfix.flow.surfaces import CloudView, Points, corners, points_of, view_of
from pcfix.flow.tiles import run_command
from pcfix.io.las import columns
from pcfix.io.las.source import LasSource, centring_steps
from pcfix.io.las.writing import corrected_header, corrected_identity
from pcfix.io.tiles import CloudFiles, Clouds, open_cloud
from pcfix.label.labelling import Labelling
from pcfix.model import (
    BATHYMETRIC_POINT,
    NO_CAMERAS,
    Cameras,
    Correction,
    FloatArray,
    Views,
    WaterSurface,
)
from pcfix.options.correct import CorrectOptions, LabelRules, PointsOptions, RefractionOptions
from pcfix.options.declare import File, taken
from pcfix.report.summary import Summary
from pcfix.water.checks import as_surface, checked_points
from pcfix.water.index import with_index
from pcfix.water.surface import FoundSurface

if TYPE_CHECKING:
    from pcfix.refract.regression import DepthRegression


def correct_file(
    input: Clouds,
    output: File,
    *,
    options: CorrectOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> Summary:
    """Correct a LAS or LAZ cloud, of one file or many; what ``pcfix correct`` runs.

    Parameters
    ----------
    input, output : path
        The names end in ``.las`` or ``.laz``; the output is LAS 1.4, point format 6, 7 or 8 (9
        or 10 for inputs with waveforms). For many files (a list of paths; see
        `pcfix.io.tiles.tiles_of`) the output is a folder, and every point is corrected as in one
        file of all points.
    options : CorrectOptions, optional
        Or its attributes as keywords, as of ``pcfix correct``: ``cameras`` (a path or
        `pcfix.Cameras`), ``water`` (what `pcfix.read_water` takes, a `pcfix.WaterSurface`,
        shoreline points in a vector file, or ``auto``) and many more.
    progress : callable, optional
        Called with (points done, points in all) after each chunk, or each of many files.

    Returns
    -------
    Summary
        Of all files.

    Raises
    ------
    PcfixError
        With one sentence on what to change. No output is left behind.
    """
    given = taken(CorrectOptions, options, keywords, "correct_file")
    command = Command("correct", partial(plan_file, given), correct_cloud, check, summarize)
    result: Summary = run_command(
        command, input, output, given, reads=paths_in(given), progress=progress
    )
    return result


def plan_file(
    options: CorrectOptions, cloud: CloudFiles, target: Path, kept: list[Chunk] | None = None
) -> Plan:
    """Return the plan for a file, or for many as one cloud."""
    return plan_correction(read_inputs(options, view_of(cloud, options.jobs, kept)))


def correct_cloud(
    plan: Plan, task: FileTask, row: int = 0, check: Check | None = None
) -> tuple[Any, Any]:
    """Correct a file from a row of the cloud on; return statistics, and what a check finds.

    It is written with the offsets of the input, and again if a coordinate does not fit: with
    offsets in the middle of the cloud.
    """
    steps = tuple[int, ...]((0, 0, 0))
    while True:
        try:
            return stream(partial(Correcting, steps=steps), plan, task, row, check)
        except columns.OutOfRangeError as axis:
            old = steps
            with open_cloud(task.source, task.jobs) as source:
                steps = centring_steps(source)
            if steps == old:
                raise InputError(
                    "cloud.scale",
                    f"{task.source}: the scale of {axis} is too fine for the result in 32 bits."
                    " Write the cloud with a coarser scale first.",
                    path=str(task.source),
                ) from axis


class Correcting:
    """The correction of one file: its header, and each chunk."""

    def __init__(self, plan: Plan, source: LasSource, steps: tuple[int, ...]) -> None:
        self._plan, self._source, self._steps = plan, source, np.array(steps)
        self._columns = columns.columns_for(plan.options.dimensions, plan.options.unsure)
        record = plan.provenance()
        self.header = corrected_header(source, self._columns, record, steps)
        self.identity = corrected_identity(source)

    def compute(self, points: Chunk, row: int) -> tuple[Correction, CloudTally]:
        """Correct the points of a chunk."""
        some = points_of(points, self._source, self._plan.found.surface)
        return correct_chunk(self._plan, some, row)

    def apply(self, points: Chunk, correction: Correction) -> Chunk:
        """Move points, and write their new dimensions, classes and flags."""
        new = columns.convert(points, self.header.point_format)
        new.offsets = self.header.offsets
        withhold = self._plan.options.uncorrected == "withhold"
        for rows, part in correction.parts():
            some = new[rows]
            # whole steps of the file's own scale, so that 'pcfix restore' gets back every bit
            classes = np.array(some["classification"])
            withheld = np.asarray(some["withheld"]).astype(bool)
            changes = columns.changes_of(
                self._columns, part, classes, withheld, some.scales, withhold=withhold
            )
            columns.move(some, changes.steps + self._steps)
            columns.fill(some, changes)
            some.array["classification"][part.corrected] = BATHYMETRIC_POINT
            some["withheld"][:] = (withheld | changes.flagged).astype(np.uint8)
        drops = self._plan.options.uncorrected == "drop"
        return new[~correction.uncorrected] if drops else new


def correct_points(
    xyz: npt.ArrayLike,
    cameras: Cameras | None,
    water: WaterSurface | float | npt.ArrayLike,
    *,
    options: RefractionOptions | None = None,
    views: Views | None = None,
    may_be_submerged: npt.ArrayLike | None = None,
    level_offset_m: npt.ArrayLike | None = None,
    adjusted_from: Cameras | None = None,
    regression: DepthRegression | File | None = None,
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
        each point, NaN where it is unknown.
    options : RefractionOptions, optional
        Or its attributes as keywords, as of ``pcfix correct``: index, method, max_angle (degrees
        from the surface normal), max_cameras, camera_set, matcher, depth_factor, unsure (with
        ``"withhold"`` the result has a flag), sigma_image and the other standard deviations. With
        water_per_image, `water` still decides which points are submerged, and how deep.
    views : Views, optional
        The view list: the images that contributed to each point, as rows of `adjusted_from` if it
        is given, else of `cameras`. Default: as the option `camera_set` says.
    may_be_submerged : array of bool, shape (n,), optional
        The other points are land, even below the surface; `pcfix.label_points` finds them.
        Default: all.
    level_offset_m : array, shape (k,), optional
        Height of the water above `water` when each image was taken; see
        `pcfix.io.tides.level_offsets`. Each ray is refracted at its own surface; `water` decides
        which points are submerged, and how deep. Default: zero.
    adjusted_from : Cameras, optional
        The original cameras, in the same frame, if `cameras` are the same images (matched by their
        labels) after an adjustment. All points are first transferred to the adjusted cameras; see
        `pcfix.adjust.transfer`.
    regression : DepthRegression or path, optional
        For the method regression: see `pcfix.refract.regression`, or the file of a line.

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
            raise SettingError(
                "array.shape",
                f"level_offset_m must be {len(cameras)} finite numbers, one per camera, not of"
                f" shape {offset.shape}.",
            )
    original = cameras if adjusted_from is None else adjusted_from
    if views is not None:
        _check_views(views, xyz, original)
    classes = np.zeros(len(xyz), np.uint8)
    if may_be_submerged is not None:
        allowed = np.asarray(may_be_submerged)
        if allowed.shape != classes.shape or allowed.dtype != np.bool_:
            raise SettingError(
                "array.shape",
                f"may_be_submerged must be {len(xyz)} booleans, not {allowed.dtype} of shape"
                f" {allowed.shape}.",
            )
        classes[~allowed] = NOT_SUBMERGED
    points = Points(xyz, heights, classes)
    view = CloudView(
        "xyz", None, *corners(*xyz[:, :2].T), len(xyz), lambda water=None: iter([points])
    )
    transfer = None if adjusted_from is None else transfer_between(adjusted_from, cameras)
    line, notes = regression, list[str]()
    if isinstance(line, str | PathLike):
        from pcfix.io.regressions import read_regression

        line = read_regression(line)
        notes = list(line.notes)
    plan = plan_of(
        with_index(all_options),
        Inputs(cameras=cameras, water=surface),
        view,
        CameraInputs(cameras, None, original, transfer),
        FoundSurface(surface),
        views,
        offset,
        Labelling(LabelRules(respect_classes=(NOT_SUBMERGED,))),
        line,
    )
    plan = plan_correction(plan)
    correction, tally = correct_chunk(plan, points, 0, covariances=True)
    if tally.water is not None:
        tally.water.check_reach("xyz", surface, deep=given.deep)
    check_fit(plan, tally)
    if line is not None and line is not regression and tally.beyond is not None:
        notes += tally.beyond.notes(line)
    for note in (*plan.own_notes, *notes):
        warnings.warn(PcfixWarning("points.note", note), stacklevel=2)
    return correction


NOT_SUBMERGED = 255
"""The class of points that may not be submerged, for the rules of a labelling."""


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
    from pcfix.io.views import beside
    from pcfix.lens.frames import beside_frames

    counts = beside_frames(points, views, cameras)
    if counts.any():
        entries, outside = int(counts.sum()), int(np.count_nonzero(counts))
        note = PcfixWarning("views.outside", f"views: {beside(entries, outside)}", entries=entries)
        warnings.warn(note, stacklevel=3)

"""Correct a LAS or LAZ cloud, or arrays, for refraction: two doors to one calculation."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.adjust.transfer import CloudTransfer
from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.flow.inputs import paths_in
from pcfix.flow.job import Job
from pcfix.flow.old_cameras import paired
from pcfix.flow.plausibility import CloudSample, Flight, plausible
from pcfix.flow.runner import Chunk, FileTask, Header, Progress, Step, file_task
from pcfix.flow.surfaces import (
    Points,
    corners,
    file_points,
    first_points,
    own_water_of,
    points_of,
    view_of,
)
from pcfix.flow.through_water import Label, correct_checked
from pcfix.flow.tiles import TiledRun
from pcfix.io.atomic import all_or_none
from pcfix.io.files import path_of
from pcfix.io.las import columns
from pcfix.io.las.part import part_report
from pcfix.io.las.source import LasSource, centring_steps
from pcfix.io.las.writing import corrected_header
from pcfix.io.regressions import read_regression
from pcfix.io.tiles import Clouds, Tiles, open_cloud, single, tiles_of
from pcfix.io.views.matching import beside
from pcfix.kernels import threads
from pcfix.lens.frames import beside_frames
from pcfix.model import (
    BATHYMETRIC_POINT,
    NO_CAMERAS,
    Cameras,
    Correction,
    FloatArray,
    Views,
    WaterSurface,
)
from pcfix.options.correct import CorrectOptions, PointsOptions, RefractionOptions, ScienceOptions
from pcfix.options.declare import File, taken
from pcfix.refract.batch import Batch, OriginalModel, Survey
from pcfix.refract.learning import for_own_water, learn_of_points
from pcfix.refract.regression import BeyondRange, DepthRegression
from pcfix.refract.tally import Summary
from pcfix.sums import Sums
from pcfix.water.checks import WaterMeeting, as_surface, check_above_water, checked_points
from pcfix.water.index import with_index
from pcfix.water.surface import is_submerged, surface_above


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
        Points as the SfM software placed them, metres, world frame. Those below the water
        surface are moved, the others come back bit for bit.
    cameras : Cameras or None
        Poses in the same frame; see `pcfix.read_cameras`. The methods factor and regression do
        without: then no point has rays, an incidence or, with factor, a standard error.
    water : WaterSurface, float, or array of shape (n,)
        The water surface (see `pcfix.read_water`), its level in metres, or its height above
        each point, NaN where it is not known.
    options : RefractionOptions, optional
        Or its attributes as keywords, as of ``pcfix correct``: index, method, max_angle (degrees
        from the surface normal), max_cameras, camera_set, matcher, depth_factor, unsure (with
        ``"withhold"`` the result says which are), sigma_image and the other standard errors;
        `xyz` is taken for the whole cloud, so with a part of one set ``occlusion="off"``. With
        water_per_image, rasters in the frame of the points, what is submerged, and how deep, goes
        by `water`.
    views : Views, optional
        Which cameras made each point, rows of `adjusted_from` where that is given, else of
        `cameras`. Default: as the option `camera_set` says.
    may_be_submerged : array of bool, shape (n,), optional
        The other points are land, even below the surface; `pcfix.label_points` finds them.
        Default: all.
    level_offset_m : array, shape (k,), optional
        How much higher than `water` the surface stood when each camera took its image, as
        `pcfix.io.tides.level_offsets` finds it. Each ray bends at its own surface; which points
        are submerged, and how deep, goes by `water`. Default: zero.
    adjusted_from : Cameras, optional
        Those that the points were made with, in the same frame, where `cameras` are the same
        images (matched by their labels) adjusted since. All points, land too, are first taken
        from those to these; see `pcfix.adjust.transfer`.
    regression : DepthRegression or path, optional
        With the method regression: see `pcfix.refract.regression`, or the file of a line.

    Returns
    -------
    Correction
        One row per input point, in the same order.

    Raises
    ------
    SettingError
        If an argument is outside its rule, or a coordinate is not finite.
    GeometryError
        If a camera stands under the water.

    Notes
    -----
    With the method snell, for each camera the line from the projection centre to the apparent
    point is bent where it pierces the surface (Snell in vector form, Skarlatos & Agrafiotis
    2018, eq 10); the true point is the one nearest to all bent rays in the sense of least squares
    (eq 11, for any number of rays). Nothing is iterated and no sum depends on the number of
    threads.

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
    settings = with_index(given.part(ScienceOptions))
    if not cameras:
        given.check_no_cameras()
        if not (views is None and level_offset_m is None and adjusted_from is None):
            raise SettingError(
                "option.needs",
                "views, level_offset_m and adjusted_from have no effect without cameras. Give both,"
                " or neither.",
                needs="cameras",
            )
    cameras = cameras or NO_CAMERAS
    if given.water_per_image is not None:
        settings = for_own_water(settings, cameras, None if views is None else views.kind)
    points = checked_points(xyz)
    surface, dimension = as_surface(water, len(points))
    offset = None if level_offset_m is None else _offsets(level_offset_m, len(cameras))
    check_above_water(cameras, surface, offset)
    if views is not None:
        _check_views(views, points, adjusted_from or cameras)
    label = None if may_be_submerged is None else _label_of(may_be_submerged, len(points))
    step, original_model = None, None
    if adjusted_from is not None:  # transfer the points to the adjusted poses
        pair = paired(adjusted_from, cameras)
        step = CloudTransfer(pair).step(points, views)
        original_model = OriginalModel(points, pair.original)
        points, views, label = step.xyz, step.views, step.rule(label)
    above = surface_above(surface, points, dimension)
    place = None, *corners(points[:, 0], points[:, 1])
    own, notes = own_water_of(given.water_per_image, cameras, surface, place, offset)
    survey = Survey(surface, cameras, settings, offset, own_water=own)
    batch = Batch(points, above, survey, views, original_model)
    line = read_regression(regression) if isinstance(regression, str | PathLike) else regression
    found = correct_checked(learn_of_points(batch, line), label)
    # refuse or warn of what does not fit together, as for a file
    meeting, sample = WaterMeeting(surface, deep=settings.deep), CloudSample(len(points))
    meeting.add(points, found)
    meeting.check_reach("xyz")
    sample.add(Points(points, None, np.zeros(len(points), np.uint8)), above.height_m)
    flight = Flight(water_m=sample.water_m, every=sample.every)
    plausible(cameras, sample.xyz, None, sample.level_doubts(), flight).warn()
    if line is not None and line is not regression:
        beyond = BeyondRange(line)
        beyond.add((above.height_m - points[:, 2])[found.submerged])
        notes = (*notes, *line.notes, *beyond.notes())
    for note in notes:
        warnings.warn(note, PcfixWarning, stacklevel=2)
    return found if step is None else step.whole(found)


def _offsets(level_offset_m: npt.ArrayLike, k: int) -> FloatArray:
    offset = np.ascontiguousarray(level_offset_m, dtype=np.float64)
    if offset.shape != (k,) or not np.isfinite(offset).all():
        raise SettingError(
            "array.shape",
            f"level_offset_m must be {k} finite numbers, one per camera, not of shape"
            f" {offset.shape}.",
        )
    return offset


def _label_of(may_be_submerged: npt.ArrayLike, n: int) -> Label:
    """Return the rule that only some of the points below the surface are submerged."""
    allowed = np.asarray(may_be_submerged)
    if allowed.shape != (n,) or allowed.dtype != np.bool_:
        raise SettingError(
            "array.shape",
            f"may_be_submerged must be {n} booleans, not {allowed.dtype} of shape {allowed.shape}.",
        )
    return lambda xyz, surface: is_submerged(xyz[:, 2], surface) & allowed


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
    counts = beside_frames(points, views, cameras)
    if counts.any():
        entries, outside = int(counts.sum()), int(np.count_nonzero(counts))
        note = PcfixWarning("views.outside", f"views: {beside(entries, outside)}", entries=entries)
        warnings.warn(note, stacklevel=3)


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
        or 10 for inputs with waveforms). For many files (a list of paths, or what else
        `pcfix.io.tiles.tiles_of` takes) the output is a folder, and every point becomes what it
        would in one file of them all.
    options : CorrectOptions, optional
        Or its attributes as keywords, as of ``pcfix correct``: ``cameras`` (a path or
        `pcfix.Cameras`), ``water`` (what `pcfix.read_water` takes, a `pcfix.WaterSurface`,
        shoreline points in a vector file, or ``auto``) and many more.
    progress : callable, optional
        Called with (points done, points in all) after each chunk, or each of many files.

    Returns
    -------
    Summary
        Of them all.

    Raises
    ------
    PcfixError
        With one sentence on what to mend; no output is left behind.
    """
    given = taken(CorrectOptions, options, keywords, "correct_file")
    tiles = tiles_of(input)
    if tiles is not None:
        run = TiledRun("correct", tiles, path_of(output), given, progress)
        return run.run(
            partial(_step_for, options=given),
            lambda step: step.result(str(tiles), str(output), run.seconds),
        )
    task = file_task(single(input), output, given, reads=paths_in(given), progress=progress)
    with threads(given.jobs), all_or_none():
        step = _step_for(task.source, given, task.kept)
        step.run(task)
        result = step.result(str(task.source), str(task.target), task.seconds)
        result = replace(result, part=part_report(task.source))
        task.tell(result.as_dict())
    return result


def _step_for(
    cloud: Path | Tiles, options: CorrectOptions, kept: list[Chunk] | None = None
) -> Correcting:
    """Return the step, with what is estimated from the whole cloud."""
    job = job_for(cloud, options)
    chunks = partial(file_points, cloud, job.water, options.jobs, kept)
    job.look_around(chunks)
    if isinstance(cloud, Tiles) and job.views.list is not None:
        job.correct(first_points(chunks()))  # it shows of which type the view list is
    return Correcting(job)


def job_for(cloud: Path | Tiles, options: CorrectOptions) -> Job:
    """Return the job of correcting a LAS or LAZ file, or many as one cloud."""
    with open_cloud(cloud) as source:
        step_m = float(max(source.header.scales))
    return Job(str(cloud), options, view_of(cloud), step_m)


class Correcting(Sums, Step):
    """The step that corrects points."""

    added = ("job",)

    def __init__(self, job: Job) -> None:
        self.job = job
        self._columns = columns.columns_for(job.options.dimensions, job.options.unsure)
        self.begin(0)

    def begin(self, first_row: int) -> None:
        """Forget the chunks so far; the next one starts at a row of the whole cloud."""
        self.wide = False
        self.steps: tuple[int, ...] = (0, 0, 0)
        self.job.restart(first_row)

    def run(self, task: FileTask) -> None:
        """Write with narrow types and the input's offsets, and again if the values do not fit."""
        while True:
            try:
                return task.run(self)
            except columns.TooNarrowError:
                self.wide = True
            except columns.OutOfRangeError as axis:
                old, self.steps = self.steps, centring_steps(task.source, task.jobs)
                if self.steps == old:
                    raise InputError(
                        "cloud.scale",
                        f"{task.source}: the scale of {axis} is too fine for the result in 32 bits."
                        " Write the cloud with a coarser scale first.",
                        path=task.source,
                    ) from axis
            self.job.restart(self.job.first_row)

    def header(self, source: LasSource) -> Header:
        """Return the header with the new dimensions and the record of what is done."""
        return corrected_header(
            source, self._columns, self.job.provenance(), wide=self.wide, steps=self.steps
        )

    def chunk(self, points: Chunk, source: LasSource, header: Header) -> Callable[[], Chunk]:
        """Return what gives corrected points their new dimensions, classes and flags."""
        correction = self.job.correct(points_of(points, source, self.job.water))
        return partial(self._written, points, header, correction)

    def _written(self, points: Chunk, header: Header, correction: Correction) -> Chunk:
        """Move points, and write their new dimensions, classes and flags."""
        new = columns.convert(points, header.point_format)
        new.offsets = header.offsets
        withhold = self.job.options.uncorrected == "withhold"
        for rows, part in correction.parts():
            some = new[rows]
            moved = columns.shift_steps(part, some.scales)
            columns.move(some, moved + np.array(self.steps))
            withheld = np.asarray(some["withheld"]).astype(bool)
            part = columns.unsure_anew(part, withheld)
            changed = columns.changed_rows(part, withheld, withhold=withhold)
            columns.fill(some, self._columns, part, moved, changed)
            some.array["classification"][part.corrected] = BATHYMETRIC_POINT
            flagged = withheld | columns.to_withhold(part, withhold=withhold)
            some["withheld"][:] = flagged.astype(np.uint8)
        return new[~correction.uncorrected] if self.job.options.uncorrected == "drop" else new

    def finish(self) -> None:
        """Refuse a result in which cloud, water and cameras do not fit together."""
        self.job.check_fit()

    def result(self, input: str, output: str, seconds: float) -> Summary:
        """Write the line of a regression, if asked, and return the summary of all chunks."""
        self.job.save_regression()
        return self.job.summary(input, output, seconds)

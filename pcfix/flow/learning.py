"""Estimate everything that a correction needs to know about the whole cloud of a file."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from importlib import import_module
from itertools import repeat
from pathlib import Path
from threading import Thread

import numpy as np

from pcfix.errors import GeometryError, PcfixWarning, SettingError
from pcfix.flow.inputs import Inputs
from pcfix.flow.surfaces import CloudView, Points, parts_of
from pcfix.io.regressions import read_regression
from pcfix.io.tables import CheckDepths, read_check_depths
from pcfix.label.labelling import Part
from pcfix.model import NOISE_CLASSES, BoolArray, FloatArray, IntArray, TiePoints, ViewKind
from pcfix.options.correct import ScienceOptions
from pcfix.options.declare import File
from pcfix.refract.batch import FLAT_DEG, UNLISTED, Batch, Learned, OriginalModel, Survey, stacked
from pcfix.refract.learning import (
    CORRECTED_RATIO,
    Near,
    check_method,
    depth_ratio,
    learn_of_sample,
    learn_of_unlisted,
    resolved,
    submerged_of,
    wants_sample,
    with_factor,
    with_matcher,
)
from pcfix.refract.methods import with_rays
from pcfix.refract.occlusion import Occluder, OccluderBuilder, wants_occlusion
from pcfix.refract.patches import PATCH_WIDTH, Squares
from pcfix.refract.reconstructions import Verdict, hint_of
from pcfix.refract.regression import (
    LEAST_COUNT,
    LEAST_NEIGHBOURS,
    REACH,
    ApparentDepths,
    DepthRegression,
    fit_depths,
)
from pcfix.water.surface import SurfaceAbove, is_submerged, surface_above


class Learning:
    """Everything that is learned for one job.

    Parameters
    ----------
    survey : Survey
        With nothing learned.
    inputs : Inputs
    view : CloudView
        Of the whole cloud.
    views : {"tracks", "depth-maps"} or None
        Kind of the view list, if there is one.
    ties : callable, optional
        Returns the tie points of the original model; default: those of the camera file.

    Raises
    ------
    SettingError
        If the method lacks something that it needs.
    """

    def __init__(
        self,
        survey: Survey,
        inputs: Inputs,
        view: CloudView,
        views: ViewKind | None,
        ties: Callable[[], TiePoints | None] | None = None,
    ) -> None:
        self._ties = ties or partial(_ties_of, inputs, view)
        self._inputs, self._view, self._views = inputs, view, views
        self.notes: list[str] = []
        self.verdicts: tuple[Verdict, ...] = ()
        self.of_unlisted: tuple[Verdict, ...] = ()
        self._given = survey.settings
        settings = resolved(survey.settings, survey.cameras, views)
        self.survey = replace(survey, settings=settings)
        check_method(settings, survey.cameras)
        _check_regression(settings.method, inputs)

    def of_cloud(
        self,
        chunks: Callable[[], Iterable[Points]],
        makers: Callable[[], Iterable[OriginalModel]] | None = None,
        *,
        all_listed: bool = True,
    ) -> Survey:
        """Return the survey with what is learned from the whole cloud.

        Its chunks are read several times, with the original model of each if the cameras were
        adjusted. Unless all points are listed, the others are corrected without a list.
        """
        occluder = self._occluder(chunks, listed=self._views is not None)
        learned = Learned(regression=self._regression(chunks), occluder=occluder)
        self.survey = replace(self.survey, learned=learned)
        some_listed = self._views is not None and not all_listed
        if not (some_listed or wants_sample(self.survey, self._views)):
            return self.survey
        (sample, near), ties = self._sample(chunks, makers), self._ties()
        sample, factor = with_factor(sample)
        if factor is not None:
            self.notes.append(str(factor))
            self.survey = sample.survey
            self._given = replace(self._given, depth_factor=factor.factor)
        self._note_corrected(sample, ties)
        points, hint = self._view.points, hint_of((self._view.software, self.survey.cameras.source))
        if self._views is None:
            self.survey, self.verdicts = learn_of_sample(sample, points, ties, hint, near)
            self._note_flat(sample)
            return self.survey
        self.survey = with_matcher(sample, ties)
        if some_listed:
            learned = learned._replace(occluder=self._occluder(chunks, listed=False))
            bare = replace(self.survey, settings=self._given, learned=learned)
            unlisted, self.of_unlisted = learn_of_unlisted(
                replace(sample, survey=bare), points, ties, hint, near
            )
            self.survey = replace(self.survey, parts={UNLISTED: unlisted})
        return self.survey

    def _note_corrected(self, sample: Batch, ties: TiePoints | None) -> None:
        """Note a cloud that is deeper than the tie points of its cameras."""
        wet = sample.take(np.flatnonzero(is_submerged(sample.xyz[:, 2], sample.surface)))
        ratio = None if ties is None else depth_ratio(wet, ties)
        if ratio is not None and ratio > CORRECTED_RATIO:
            self.notes.append(
                f"The cloud is {ratio:.2f} times as deep as the tie points of its cameras, as if it"
                " had been corrected before. Give the cloud as the matcher wrote it."
            )

    def _note_flat(self, sample: Batch) -> None:
        """Note how many points only obliques see, and where."""
        rows = np.flatnonzero(is_submerged(sample.xyz[:, 2], sample.surface))
        wet = replace(sample.take(rows[:: 1 + len(rows) // FLAT_SAMPLE]), survey=self.survey)
        flat = with_rays(wet).seen_flat() if len(wet) else np.zeros(0, np.bool_)
        if flat.sum() <= FLAT_SHARE * len(flat):
            return
        low, high = np.percentile(wet.xyz[flat, :2], (2.0, 98.0), axis=0)
        unsure = self.survey.settings.unsure
        self.notes.append(
            f"About {100.0 * flat.mean():.0f} % of the submerged points have only rays beyond"
            f" {FLAT_DEG:g} degrees, nearly all between {low[0]:.0f}, {low[1]:.0f} and"
            f" {high[0]:.0f}, {high[1]:.0f}. Their depths are the least certain; add nadir images"
            + (", or flag them with --unsure withhold." if unsure == "keep" else ".")
        )

    def of_unlisted_notes(self) -> list[str]:
        """Return the note on points that are in no view list."""
        if UNLISTED not in self.survey.parts:
            return []
        so = " ".join(str(one) for one in self.of_unlisted)
        return [f"Points in no view list are corrected as without a list. {so}"]

    def _regression(self, chunks: Callable[[], Iterable[Points]]) -> DepthRegression | None:
        path, water, where = self._inputs.check_depths, self.survey.water, ""
        if self._inputs.regression is not None:
            found = read_regression(self._inputs.regression)
            fitted = f", fitted to {found.source}" if found.source else ""
            where = (
                f" It comes from {self._inputs.regression}{fitted}; whether it holds for this cloud"
                " is not checked."
            )
        elif path is not None:
            found = learn_regression(path, parts_of(chunks(), water), self.survey.settings)
            source = f"{Path(path).name} on {Path(self._view.name).name}, water {water}"
            found = replace(found, source=source)
        else:
            return None
        again = "" if found.cv_rmse_m is None else f", cross-validated {found.cv_rmse_m:.3f} m"
        self.notes += [
            f"Regression: {found}; standard errors {found.intercept_se_m:.3f} m and"
            f" {found.slope_se:.3f}, RMSE {found.rmse_m:.3f} m{again}.{where}",
            *found.notes,
        ]
        return found

    def _occluder(self, chunks: Callable[[], Iterable[Points]], *, listed: bool) -> Occluder | None:
        listed = listed and self.survey.settings.occlusion == "auto"
        if listed or not wants_occlusion(self.survey.cameras, self.survey.settings):
            return None  # listed cameras saw their points
        builder = OccluderBuilder(self._view.low, self._view.high, self._view.points)
        for points in chunks():
            builder.add(points.xyz, points.classes)
        return builder.build()

    def _sample(
        self,
        chunks: Callable[[], Iterable[Points]],
        makers: Callable[[], Iterable[OriginalModel]] | None,
    ) -> tuple[Batch, Near | None]:
        """Return points of the whole cloud, evenly spread over its order, without noise.

        If these may be too far apart to detect the reconstruction type, submerged points in squares
        too.
        """
        area_m2 = np.prod(np.maximum(np.subtract(self._view.high, self._view.low)[:2], 1.0))
        dense = BED_POINTS_A_M2 * float(area_m2)
        dense = dense if np.isfinite(dense) else MOST_BED_POINTS  # unknown bounds
        wanted = np.clip(dense, FEWEST_BED_POINTS, MOST_BED_POINTS)
        step = max(1, self._view.points // int(wanted))
        near_step = max(1, self._view.points // int(max(dense, FEWEST_BED_POINTS)))
        squares = Squares(PATCH_WIDTH * self._flying_height_m()) if near_step < step else None
        survey, taken = self.survey, list[Batch]()
        # import it while the cloud is read
        Thread(target=import_module, args=("scipy.spatial",), daemon=True).start()
        done = 0
        of_chunks = repeat(None) if makers is None else makers()
        for points, original_model in zip(chunks(), of_chunks, strict=False):
            taken.append(_every(step, done, points, survey, original_model))
            if squares is not None:
                squares.add(submerged_of(_every(near_step, done, points, survey, original_model)))
            done += len(points.xyz)
        return stacked(taken), None if squares is None else Near(squares.all(), near_step)

    def _flying_height_m(self) -> float:
        """Return the median height of the cameras above the water below them."""
        centres = self.survey.cameras.centres
        unknown = np.full(len(centres), np.nan)
        above = centres[:, 2] - surface_above(self.survey.water, centres, unknown).height_m
        above = above[above > 0.0]
        return float(np.median(above)) if len(above) else FLYING_HEIGHT_M


def _every(
    step: int, done: int, points: Points, survey: Survey, original_model: OriginalModel | None
) -> Batch:
    """Return every n-th point of a cloud (n = `step`) from a chunk after `done` points."""
    rows = np.arange(-done % step, len(points.xyz), step)
    rows = rows[~np.isin(points.classes[rows], NOISE_CLASSES)]
    heights = None if points.heights is None else points.heights[rows]
    xyz = points.xyz[rows]
    return Batch(
        xyz,
        surface_above(survey.water, xyz, heights),
        survey,
        original_model=None if original_model is None else original_model.take(rows),
        source=None if points.sources is None else points.sources[rows],
    )


def _check_regression(method: str, inputs: Inputs) -> None:
    """Raise SettingError unless the method regression has check depths or a line, and no other."""
    given = [n for n in ("check_depths", "regression") if getattr(inputs, n) is not None]
    if len(given) == 2:
        raise SettingError(
            "option.exclusive",
            "check-depths and regression exclude each other: a line is fitted, or read from a file."
            " Give one of the two.",
            options=given,
        )
    if (method == "regression") != bool(given):
        raise SettingError(
            "option.together",
            "Method regression needs check-depths (a CSV of measured depths) or regression (the"
            " line of another cloud), and only it uses them. Give both, or neither.",
            method=method,
            options=given,
        )


def _ties_of(inputs: Inputs, view: CloudView) -> TiePoints | None:
    """Return the tie points of the camera file; its warnings came with the cameras."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PcfixWarning)
        return inputs.tie_points(view.crs)


FLAT_SHARE, FLAT_SAMPLE = 0.01, 20_000
"""Share of the submerged points above which it is noted, and size of the sample for it."""

FLYING_HEIGHT_M = 100.0
"""If the water below the cameras is unknown, for the width of squares."""

BED_POINTS_A_M2 = 5.0
FEWEST_BED_POINTS, MOST_BED_POINTS = 125_000, 1_000_000
"""Size of the sample of the cloud that the bed of the surroundings is estimated from."""


def learn_regression(
    path: File, parts: Iterable[Part], settings: ScienceOptions
) -> DepthRegression:
    """Fit true depth = a + b * apparent depth to the check depths of a file.

    The parts are the whole apparent cloud, each point with the water above it; they are read once,
    in bounded memory. Points of noise (classes 7 and 18) do not count.

    Raises
    ------
    InputError
        If the file cannot be read or is not one of check depths.
    GeometryError
        If a height lies above the water, fewer than three check depths lie on submerged points,
        the depths leave the line open, or it explains too little of them (`least_r2`).

    Notes
    -----
    The apparent depth at a check depth is the median of the nearest submerged points, 3 to 16,
    within four times the distance between neighbouring points there. Check depths with fewer are
    excluded, with a note; an outlier is noted too, but used.
    """
    checks = read_check_depths(path)
    around = ApparentDepths(checks.xy)
    for part in parts:
        rows = np.flatnonzero(~np.isin(part.classes, NOISE_CLASSES))
        surface = SurfaceAbove(part.surface.height_m[rows], part.surface.slope[rows])
        around.add(part.xyz[rows], surface)
    radius = REACH * around.spacing_m
    apparent, level, covered = around.medians(radius)
    left_out = _left_out(checks, around.distance_m[:, 0], covered, radius)
    if left_out and covered.sum() < LEAST_COUNT:
        raise GeometryError("check_depths.no_bed", left_out, covered=int(covered.sum()))
    rows = np.flatnonzero(covered)
    true = _true_depths(checks, level, rows)
    try:
        found = fit_depths(apparent[rows], true)
    except GeometryError as error:
        raise GeometryError(error.code, f"{checks.name}: {error}", **error.values) from error
    if found.r2 < settings.least_r2:
        raise GeometryError(
            "check_depths.low_r2",
            f"{checks.name}: r2 {found.r2:.3f} of the regression over {found.count} check depths is"
            f" below {settings.least_r2:g}. Check their CRS and the water level, or lower"
            " --least-r2.",
            r2=found.r2,
            least=settings.least_r2,
        )
    notes = (left_out,) if left_out else ()
    return replace(found, notes=(*notes, *found.notes, *_outlier_notes(checks, found, rows)))


def _left_out(
    checks: CheckDepths, nearest_m: FloatArray, covered: BoolArray, radius_m: float
) -> str:
    """Describe the check depths where the cloud has no bed; empty if there are none."""
    if covered.all():
        return ""
    first = int(np.argmin(covered))
    there = "the cloud has no submerged point"
    if np.isfinite(nearest_m[first]):
        there = (
            f"the nearest submerged point is {nearest_m[first]:,.2f} m away, and {LEAST_NEIGHBOURS}"
            f" are needed within {radius_m:.2f} m"
        )
    return (
        f"{checks.where(first)}: {int((~covered).sum())} of {len(checks)} check depths have no bed"
        f" around them: {there}. Check that they have the cloud's CRS and lie in the water."
    )


def _true_depths(checks: CheckDepths, level_m: FloatArray, rows: IntArray) -> FloatArray:
    """Return the true depths, metres; heights are subtracted from the water above them."""
    if not checks.are_heights:
        return checks.value_m[rows]
    depth = level_m[rows] - checks.value_m[rows]
    above = np.flatnonzero(depth < 0.0)
    if len(above):
        first = int(rows[above[0]])
        raise GeometryError(
            "check_depths.above_water",
            f"{checks.where(first)}: the height {checks.value_m[first]:.2f} m is above the water,"
            f" {level_m[first]:.2f} m there ({len(above)} of {len(rows)} are). Give heights of the"
            " bed in the cloud's vertical datum, or depths in a column depth.",
            height_m=float(checks.value_m[first]),
            count=len(above),
        )
    return np.asarray(depth)


def _outlier_notes(checks: CheckDepths, found: DepthRegression, rows: IntArray) -> tuple[str, ...]:
    """Return a note on check depths far off the line, if there are any."""
    if not found.outliers:
        return ()
    first = int(rows[found.outliers[0]])
    lines = ", ".join(str(checks.line[rows[i]]) for i in found.outliers[:5])
    return (
        f"{checks.where(first)}: {len(found.outliers)} check depths are outliers (lines {lines})"
        " and were used. Correct or remove them.",
    )

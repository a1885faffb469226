"""Estimate everything that a correction needs to know about a whole cloud."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import GeometryError, PcfixWarning, SettingError, coded
from pcfix.flow.surfaces import CloudView, Points, parts_of
from pcfix.io.regressions import read_regression
from pcfix.io.tables import CheckDepths, read_check_depths
from pcfix.label.labelling import Part
from pcfix.model import NOISE_CLASSES, BoolArray, Cameras, FloatArray, IntArray, TiePoints, ViewKind
from pcfix.options.correct import ScienceOptions
from pcfix.options.declare import File
from pcfix.refract.batch import FLAT_DEG, UNLISTED, Batch, Learned, OriginalModel, Survey, stacked
from pcfix.refract.learning import (
    CORRECTED_RATIO,
    Near,
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
from pcfix.refract.reconstructions import Hint, Verdict
from pcfix.refract.regression import (
    LEAST_COUNT,
    LEAST_NEIGHBOURS,
    REACH,
    ApparentDepths,
    DepthRegression,
    fit_depths,
)
from pcfix.water.surface import SurfaceAbove, is_submerged, surface_above

FLAT_SHARE, FLAT_SAMPLE = 0.01, 20_000
"""Share of the submerged points above which it is noted, and size of the sample for it."""
FLYING_HEIGHT_M = 100.0
"""If the water below the cameras is unknown, for the width of squares."""
BED_POINTS_A_M2 = 5.0
FEWEST_BED_POINTS, MOST_BED_POINTS = 125_000, 1_000_000
"""Size of the sample of the cloud that the bed of the surroundings is estimated from."""


class CloudFacts(NamedTuple):
    """What a whole cloud shows.

    survey : everything that all its points have in common; verdicts : on its reconstruction type;
    of_unlisted : the same for points in no view list; notes : for the user.
    """

    survey: Survey
    verdicts: tuple[Verdict, ...] = ()
    of_unlisted: tuple[Verdict, ...] = ()
    notes: tuple[PcfixWarning, ...] = ()


def learn_of_cloud(
    survey: Survey,
    view: CloudView,
    chunks: Callable[[], Iterable[Points]],
    *,
    original: Cameras | None = None,
    views: ViewKind | None = None,
    all_listed: bool = True,
    ties: Callable[[], TiePoints | None] = lambda: None,
    hint: Hint | None = None,
    regression: DepthRegression | None = None,
) -> CloudFacts:
    """Resolve every option that is ``auto``, and estimate what the points have in common.

    Parameters
    ----------
    survey : Survey
        With the options as given.
    view : CloudView
    chunks : callable
        Returns the whole cloud, chunk by chunk, transferred to the adjusted cameras if there are
        any; it is called once or twice.
    original : Cameras, optional
        The original cameras, if they were adjusted since.
    views : {"tracks", "depth-maps", ...}, optional
        Type of the view list, if there is one.
    all_listed : bool
        Whether every point can have views. If not, the others are corrected as without a list.
    ties : callable, optional
        Returns the tie points of the original cameras.
    hint : Hint, optional
        The reconstruction type that the software is known for.
    regression : DepthRegression, optional
    """
    given = survey.settings
    survey = replace(survey, settings=resolved(given, survey.cameras, views))
    occluder = _occluder(survey, view, chunks, listed=views is not None)
    learned = Learned(regression=regression, occluder=occluder)
    survey = replace(survey, learned=learned)
    some_listed = views is not None and not all_listed
    if not (some_listed or wants_sample(survey, views)):
        return CloudFacts(survey)
    (sample, near), tie_points = _sample(survey, view, chunks, original), ties()
    sample, factor = with_factor(sample)
    notes = coded("cloud.depth_factor", [] if factor is None else [factor])
    if factor is not None:
        survey, given = sample.survey, replace(given, depth_factor=factor.factor)
    notes += _note_corrected(sample, tie_points)
    if views is None:
        survey, verdicts = learn_of_sample(sample, view.points, tie_points, hint, near)
        return CloudFacts(survey, verdicts, notes=(*notes, *_note_flat(sample, survey)))
    survey, of_unlisted = with_matcher(sample, tie_points), tuple[Verdict, ...]()
    if some_listed:
        learned = learned._replace(occluder=_occluder(survey, view, chunks, listed=False))
        bare = replace(sample, survey=replace(survey, settings=given, learned=learned))
        unlisted, of_unlisted = learn_of_unlisted(bare, view.points, tie_points, hint, near)
        survey = replace(survey, parts={UNLISTED: unlisted})
    return CloudFacts(survey, (), of_unlisted, tuple(notes))


def _note_corrected(sample: Batch, ties: TiePoints | None) -> list[PcfixWarning]:
    """Note a cloud that is deeper than the tie points of its cameras."""
    ratio = None if ties is None else depth_ratio(submerged_of(sample), ties)
    if ratio is None or ratio <= CORRECTED_RATIO:
        return []
    sentence = (
        f"The cloud is {ratio:.2f} times as deep as the tie points of its cameras, as if it"
        " had been corrected before. Give the cloud as the matcher wrote it."
    )
    return [PcfixWarning("cloud.corrected_before", sentence, ratio=ratio)]


def _note_flat(sample: Batch, survey: Survey) -> list[PcfixWarning]:
    """Note how many points only oblique images see, and where."""
    rows = np.flatnonzero(is_submerged(sample.xyz[:, 2], sample.surface))
    wet = replace(sample.take(rows[:: 1 + len(rows) // FLAT_SAMPLE]), survey=survey)
    flat = with_rays(wet).seen_flat() if len(wet) else np.zeros(0, np.bool_)
    if flat.sum() <= FLAT_SHARE * len(flat):
        return []
    low, high = np.percentile(wet.xyz[flat, :2], (2.0, 98.0), axis=0)
    keeps = survey.settings.unsure == "keep"
    sentence = (
        f"About {100.0 * flat.mean():.0f} % of the submerged points have only rays beyond"
        f" {FLAT_DEG:g} degrees, nearly all between {low[0]:.0f}, {low[1]:.0f} and"
        f" {high[0]:.0f}, {high[1]:.0f}. Their depths are the least certain; add nadir images"
        + (", or flag them with --unsure withhold." if keeps else ".")
    )
    return [PcfixWarning("cloud.obliques_only", sentence, share=float(flat.mean()))]


def _occluder(
    survey: Survey, view: CloudView, chunks: Callable[[], Iterable[Points]], *, listed: bool
) -> Occluder | None:
    """Return the surface of the cloud, if it may hide points from cameras."""
    if listed and survey.settings.occlusion == "auto":
        return None  # listed cameras saw their points
    if not (view.points and wants_occlusion(survey.cameras, survey.settings)):
        return None
    builder = OccluderBuilder(view.low, view.high, view.points)
    for points in chunks():
        builder.add(points.xyz, points.classes)
    return builder.build()


def _sample(
    survey: Survey,
    view: CloudView,
    chunks: Callable[[], Iterable[Points]],
    original: Cameras | None,
) -> tuple[Batch, Near | None]:
    """Return points of the whole cloud, evenly spread over its order, without noise.

    If these may be too far apart to detect the reconstruction type, submerged points in squares
    too.
    """
    area_m2 = np.prod(np.maximum(np.subtract(view.high, view.low)[:2], 1.0))
    dense = BED_POINTS_A_M2 * float(area_m2)
    dense = dense if np.isfinite(dense) else MOST_BED_POINTS  # unknown bounds
    step = max(1, view.points // int(np.clip(dense, FEWEST_BED_POINTS, MOST_BED_POINTS)))
    near_step = max(1, view.points // int(max(dense, FEWEST_BED_POINTS)))
    squares = Squares(PATCH_WIDTH * _flying_height_m(survey)) if near_step < step else None
    taken, row = list[Batch](), 0
    for points in chunks():
        taken.append(_every(step, row, points, survey, original))
        if squares is not None:
            squares.add(submerged_of(_every(near_step, row, points, survey, original)))
        row += len(points.xyz)
    return stacked(taken), None if squares is None else Near(squares.all(), near_step)


def _flying_height_m(survey: Survey) -> float:
    """Return the median height of the cameras above the water below them."""
    centres = survey.cameras.centres
    unknown = np.full(len(centres), np.nan)
    above = centres[:, 2] - surface_above(survey.water, centres, unknown).height_m
    above = above[above > 0.0]
    return float(np.median(above)) if len(above) else FLYING_HEIGHT_M


def _every(step: int, row: int, points: Points, survey: Survey, original: Cameras | None) -> Batch:
    """Return every n-th point of a cloud (n = `step`) from a chunk that begins at a row."""
    rows = np.arange(-row % step, len(points.xyz), step)
    return batch_of(
        points.take(rows[~np.isin(points.classes[rows], NOISE_CLASSES)]), survey, original
    )


def batch_of(points: Points, survey: Survey, original: Cameras | None) -> Batch:
    """Return points of a cloud, without views, as the methods of correction take them."""
    model = None
    if original is not None and points.original_xyz is not None:
        model = OriginalModel(points.original_xyz, original)
    above = surface_above(survey.water, points.xyz, points.heights)
    return Batch(points.xyz, above, survey, original_model=model, source=points.sources)


def regression_of(
    inputs: Any, view: CloudView, chunks: Callable[[], Iterable[Points]], survey: Survey
) -> tuple[DepthRegression | None, tuple[str, ...]]:
    """Read the line of a regression, or fit it to check depths; return it with notes."""
    path, where = inputs.check_depths, ""
    if inputs.regression is not None:
        found = read_regression(inputs.regression)
        fitted = f", fitted to {found.source}" if found.source else ""
        where = (
            f" It comes from {inputs.regression}{fitted}; whether it holds for this cloud"
            " is not checked."
        )
    elif path is not None:
        found = learn_regression(path, parts_of(chunks(), survey.water), survey.settings)
        source = f"{Path(path).name} on {Path(view.name).name}, water {survey.water}"
        found = replace(found, source=source)
    else:
        return None, ()
    again = "" if found.cv_rmse_m is None else f", cross-validated {found.cv_rmse_m:.3f} m"
    return found, (
        f"Regression: {found}; standard errors {found.intercept_se_m:.3f} m and"
        f" {found.slope_se:.3f}, RMSE {found.rmse_m:.3f} m{again}.{where}",
        *found.notes,
    )


def check_regression(method: str, inputs: Any) -> None:
    """Raise SettingError unless the method regression, and no other, has check depths or a line."""
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


def learn_regression(
    path: File, parts: Iterable[Part], settings: ScienceOptions
) -> DepthRegression:
    """Fit true depth = a + b * apparent depth to the check depths of a file.

    The parts are the whole apparent cloud, each point with the water above it; they are read once,
    in bounded memory. Points of noise (classes 7 and 18) do not count.

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

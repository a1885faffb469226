"""The line of the method regression: read from a file, or fitted to check depths."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.errors import GeometryError, SettingError
from pcfix.flow.surfaces import CloudView, Points, parts_of
from pcfix.io.regressions import read_regression
from pcfix.io.tables import CheckDepths, read_check_depths
from pcfix.label.labelling import Part
from pcfix.model import NOISE_CLASSES, BoolArray, FloatArray, IntArray
from pcfix.options.correct import ScienceOptions
from pcfix.options.declare import File
from pcfix.refract.batch import Survey
from pcfix.refract.regression import (
    LEAST_COUNT,
    LEAST_NEIGHBOURS,
    REACH,
    ApparentDepths,
    DepthRegression,
    fit_depths,
)
from pcfix.water.surface import SurfaceAbove


def regression_of(
    inputs: Any, view: CloudView, chunks: Iterable[Points], survey: Survey
) -> tuple[DepthRegression, tuple[str, ...]]:
    """Read the line of a regression, or fit it to check depths; return it with notes."""
    path, where = inputs.check_depths, ""
    if inputs.regression is not None:
        found = read_regression(inputs.regression)
        fitted = f", fitted to {found.source}" if found.source else ""
        where = (
            f" It comes from {inputs.regression}{fitted}; whether it holds for this cloud"
            " is not checked."
        )
    else:
        found = learn_regression(path, parts_of(chunks, survey.water), survey.settings)
        source = f"{Path(path).name} on {Path(view.name).name}, water {survey.water}"
        found = replace(found, source=source)
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

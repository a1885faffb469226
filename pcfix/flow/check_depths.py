"""The line of the method regression: read from a file, or fitted to check depths."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.errors import GeometryError, SettingError
from pcfix.flow.surfaces import CloudView, Points, parts_of
from pcfix.io.saved import read_regression
from pcfix.io.tables import read_check_depths
from pcfix.label.labelling import Part
from pcfix.options.correct import ScienceOptions
from pcfix.options.declare import File
from pcfix.refract.batch import Survey
from pcfix.refract.regression import LEAST_COUNT, DepthRegression, apparent_depths, fit_depths
from pcfix.water.fit import FEWEST


def regression_of(
    inputs: Any, view: CloudView, chunks: Iterable[Points], survey: Survey
) -> tuple[DepthRegression, tuple[str, ...]]:
    """Read the line of a regression, or fit it to check depths; return it with notes."""
    path, where = inputs.check_depths, ""
    if inputs.regression is not None:
        found = read_regression(inputs.regression)
        fitted = f", fitted to {found.source}" if found.source else ""
        where = (
            f" It comes from {inputs.regression}{fitted}; whether it fits this cloud is not"
            " checked."
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


def check_regression(inputs: Any) -> None:
    """Raise SettingError unless the method regression has either check depths or a line."""
    given = [n for n in ("check_depths", "regression") if getattr(inputs, n) is not None]
    if len(given) != 1:
        raise SettingError(
            "option.together",
            "Method regression needs check-depths (a CSV of measured depths) or regression (the"
            " line of another cloud). Give one of the two.",
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
    checks, notes = read_check_depths(path), list[str]()
    apparent, level, nearest_m, radius = apparent_depths(checks.xy, parts)
    covered = ~np.isnan(apparent)
    if not covered.all():
        first = int(np.argmin(covered))
        notes.append(
            f"{checks.where(first)}: {int((~covered).sum())} of {len(checks)} check depths have no"
            f" bed around them: {FEWEST} submerged points are needed within {radius:.2f} m, the"
            f" nearest is {nearest_m[first]:,.2f} m away. Check that they have the cloud's CRS and"
            " are in the water."
        )
        if covered.sum() < LEAST_COUNT:
            raise GeometryError("check_depths.no_bed", notes[0], covered=int(covered.sum()))
    rows = np.flatnonzero(covered)
    true = np.asarray(checks.value_m[rows])
    if checks.are_heights:  # they are subtracted from the water above them
        true = level[rows] - true
        above = np.flatnonzero(true < 0.0)
        if len(above):
            first = int(rows[above[0]])
            raise GeometryError(
                "check_depths.above_water",
                f"{checks.where(first)}: the height {checks.value_m[first]:.2f} m is above the"
                f" water, {level[first]:.2f} m there ({len(above)} of {len(rows)} are). Give"
                " heights of the bed in the cloud's vertical datum, or depths in a column depth.",
                height_m=float(checks.value_m[first]),
                count=len(above),
            )
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
    notes += found.notes
    if found.outliers:
        lines = ", ".join(str(checks.line[rows[i]]) for i in found.outliers[:5])
        notes.append(
            f"{checks.where(int(rows[found.outliers[0]]))}: {len(found.outliers)} check depths are"
            f" outliers (lines {lines}) and were used. Correct or remove them."
        )
    return replace(found, notes=tuple(notes))

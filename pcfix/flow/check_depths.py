"""The line of the method regression, fitted to check depths."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from pcfix.errors import GeometryError
from pcfix.io.tables import read_check_depths
from pcfix.label.labelling import Part
from pcfix.options.declare import File
from pcfix.refract.regression import LEAST_COUNT, DepthRegression, apparent_depths, fit_depths
from pcfix.water.fit import FEWEST

LEAST_R2 = 0.5
"""Smallest coefficient of determination of a fit that is used."""


def fit_check_depths(path: File, parts: Iterable[Part]) -> DepthRegression:
    """Fit true depth = a + b * apparent depth to the check depths of a file.

    The parts are the entire apparent cloud, each point with the water above it; they are read once,
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
    if found.r2 < LEAST_R2:
        raise GeometryError(
            "check_depths.low_r2",
            f"{checks.name}: r2 {found.r2:.3f} of the regression over {found.count} check depths is"
            f" below {LEAST_R2:g}. Check their CRS and the water level.",
            r2=found.r2,
            least=LEAST_R2,
        )
    notes += found.notes
    if found.outliers:
        lines = ", ".join(str(checks.line[rows[i]]) for i in found.outliers[:5])
        notes.append(
            f"{checks.where(int(rows[found.outliers[0]]))}: {len(found.outliers)} check depths are"
            f" outliers (lines {lines}) and were used. Correct or remove them."
        )
    return replace(found, notes=tuple(notes))

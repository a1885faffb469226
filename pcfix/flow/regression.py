"""The regression of a cloud's depths on check depths, from a file and the cloud's chunks."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from pcfix.errors import GeometryError
from pcfix.io.tables import CheckDepths, read_check_depths
from pcfix.label.labelling import Part
from pcfix.model import NOISE_CLASSES, BoolArray, FloatArray, IntArray
from pcfix.options.correct import ScienceOptions
from pcfix.refract.regression import (
    LEAST_COUNT,
    LEAST_NEIGHBOURS,
    REACH,
    ApparentDepths,
    DepthRegression,
    fit_depths,
)
from pcfix.water.surface import SurfaceAbove


def learn_regression(
    path: str | os.PathLike[str],
    parts: Iterable[Part],
    settings: ScienceOptions,
) -> DepthRegression:
    """Fit true depth = a + b * apparent depth to the check depths of a file.

    Parameters
    ----------
    path : path
        See `pcfix.io.tables.read_check_depths`.
    parts : iterable of Part
        The whole cloud as it came, each point with the water above it; gone through once, in
        bounded memory. Points of noise (classes 7 and 18) do not count.
    settings : ScienceOptions
        For `least_r2`.

    Returns
    -------
    DepthRegression

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
    left out, and a note says how many; an outlier is noted too, but stays in.
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
        raise GeometryError(left_out)
    rows = np.flatnonzero(covered)
    true = _true_depths(checks, level, rows)
    try:
        found = fit_depths(apparent[rows], true)
    except GeometryError as error:
        raise GeometryError(f"{checks.name}: {error}") from error
    if found.r2 < settings.least_r2:
        raise GeometryError(
            f"{checks.name}: the regression explains too little: r2 {found.r2:.3f} of"
            f" {found.count} check depths is below {settings.least_r2:g}; check their CRS and the"
            " water's height, or accept it with a lower --least-r2."
        )
    notes = (left_out,) if left_out else ()
    return replace(found, notes=(*notes, *found.notes, *_outlier_notes(checks, found, rows)))


def _left_out(
    checks: CheckDepths, nearest_m: FloatArray, covered: BoolArray, radius_m: float
) -> str:
    """Return how many check depths lie where the cloud has no bed, in words; empty if none."""
    if covered.all():
        return ""
    first = int(np.argmin(covered))
    away = nearest_m[first]
    there = (
        f"{away:,.2f} m from the nearest submerged point; {LEAST_NEIGHBOURS} are wanted within"
        f" {radius_m:.2f} m"
        if np.isfinite(away)
        else "and the cloud has no submerged point"
    )
    enough = int(covered.sum()) >= LEAST_COUNT
    return (
        f"{checks.where(first)}: the check depth is {there}"
        f" ({int((~covered).sum())} of {len(checks)} are like that and"
        + (" are left out)." if enough else f" cannot be used; a regression needs {LEAST_COUNT}).")
        + " Check that they have the cloud's CRS and lie in the water."
    )


def _true_depths(checks: CheckDepths, level_m: FloatArray, rows: IntArray) -> FloatArray:
    """Return the true depths, metres; a height is turned over at the water above its place."""
    if not checks.are_heights:
        return checks.value_m[rows]
    depth = level_m[rows] - checks.value_m[rows]
    above = np.flatnonzero(depth < 0.0)
    if len(above):
        first = int(rows[above[0]])
        raise GeometryError(
            f"{checks.where(first)}: the height {checks.value_m[first]:.2f} m is above the water,"
            f" {level_m[first]:.2f} m there ({len(above)} of {len(rows)} are); give heights of"
            " the bed with the cloud's vertical datum, or depths in a column depth."
        )
    return np.asarray(depth)


def _outlier_notes(checks: CheckDepths, found: DepthRegression, rows: IntArray) -> tuple[str, ...]:
    """Return a sentence on check depths far off the line, if any."""
    if not found.outliers:
        return ()
    first = int(rows[found.outliers[0]])
    lines = ", ".join(str(checks.line[rows[i]]) for i in found.outliers[:5])
    return (
        f"{checks.where(first)}: the check depth lies too far off the line to be of one set with"
        f" the rest (lines {lines}; {len(found.outliers)} in all); it was kept: mend it or take it"
        " out.",
    )

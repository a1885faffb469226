"""Contours of a raster, at an interval that fits its range and accuracy."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcfix.grid.maps import smoothed
from pcfix.model import FloatArray

MOST_LEVELS = 15
SMOOTH_CELLS = 1.0
"""Standard deviation of the filter before the lines are drawn."""
LEAST_CELLS = 12.0
"""Shorter lines are dropped."""


class Contour(NamedTuple):
    """A line, shape (n, 2): columns and rows from the centre of the first cell; and its level."""

    level: float
    place: FloatArray


def interval_of(height: float, least: float) -> float:
    """Return 1, 2 or 5 times a power of ten that divides a height into few levels.

    It is at least `least`, such as the uncertainty.
    """
    wanted = max(height / MOST_LEVELS, least, 1e-3)
    power = 10.0 ** math.floor(math.log10(wanted) + 1e-9)
    return next(s * power for s in (1.0, 2.0, 5.0, 10.0) if s * power >= wanted * (1.0 - 1e-9))


def depth_interval(depth_m: FloatArray, uncertainty_m: FloatArray) -> float:
    """Return the interval for a map of depths; both NaN if unknown, of any shape."""
    known = uncertainty_m[np.isfinite(uncertainty_m)]
    deepest = np.max(depth_m, where=np.isfinite(depth_m), initial=0.0)
    return interval_of(float(deepest), float(np.median(known)) if known.size else 0.0)


def contours(values: FloatArray, interval: float) -> list[Contour]:
    """Return the contours of cells (rows, columns), NaN if unknown, at whole intervals.

    The lowest and the highest value have no contour.
    """
    from contourpy import contour_generator

    if min(values.shape) < 2 or not np.isfinite(values).any():
        return []
    maker = contour_generator(z=np.ma.masked_invalid(smoothed(values, SMOOTH_CELLS)))
    first = math.floor(float(np.nanmin(values)) / interval) + 1
    last = math.ceil(float(np.nanmax(values)) / interval)
    lines = [
        Contour(round(step * interval, 6), np.asarray(line))
        for step in range(first, last)
        for line in maker.lines(step * interval)
    ]
    return [
        one for one in lines if float(np.hypot(*np.diff(one.place, axis=0).T).sum()) >= LEAST_CELLS
    ]

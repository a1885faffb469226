"""Contours of a raster, at an interval that fits its range and accuracy."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcfix.adjust.result import nice_step
from pcfix.grid.maps import smoothed
from pcfix.model import FloatArray

MOST_LEVELS, LEAST_INTERVAL_M = 15, 1e-3
SMOOTH_CELLS = 1.0
"""Standard deviation of the filter before the lines are drawn."""
LEAST_CELLS = 12.0
"""Shorter lines are dropped."""


class Contour(NamedTuple):
    """A line, shape (n, 2): columns and rows from the centre of the first cell; and its level."""

    level: float
    place: FloatArray


def depth_interval(depth_m: FloatArray, uncertainty_m: FloatArray) -> float:
    """Return the interval for a map of depths: few levels, and not finer than the uncertainty.

    It is 1, 2 or 5 times a power of ten, metres. Both arrays are NaN if unknown, of any shape.
    """
    known = uncertainty_m[np.isfinite(uncertainty_m)]
    deepest = np.max(depth_m, where=np.isfinite(depth_m), initial=0.0)
    sigma = float(np.median(known)) if known.size else 0.0
    return nice_step(max(float(deepest) / MOST_LEVELS, sigma, LEAST_INTERVAL_M))


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

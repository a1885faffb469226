"""Contours of a raster, at an interval that it can bear."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcfix.model import FloatArray

MOST_LEVELS = 15
SMOOTH_CELLS = 1.0
"""Standard deviation of the filter before the lines are drawn."""
LEAST_CELLS = 12.0
"""Shorter lines are scraps."""


class Contour(NamedTuple):
    """A line, shape (n, 2): columns and rows from the centre of the first cell; and its level."""

    level: float
    place: FloatArray


def interval_of(height: float, least: float) -> float:
    """Return 1, 2 or 5 times a power of ten, so that few levels go into a height.

    It is at least `least`, such as the uncertainty: finer lines would draw what is not known.
    """
    wanted = max(height / MOST_LEVELS, least, 1e-3)
    power = 10.0 ** math.floor(math.log10(wanted) + 1e-9)
    return next(s * power for s in (1.0, 2.0, 5.0, 10.0) if s * power >= wanted * (1.0 - 1e-9))


def contours(values: FloatArray, interval: float) -> list[Contour]:
    """Return the contours of cells (rows, columns), NaN where not known, at whole intervals.

    The lowest and the highest value are no levels.
    """
    from contourpy import contour_generator
    from scipy.ndimage import gaussian_filter

    known = np.isfinite(values)
    if not known.any():
        return []
    weight = gaussian_filter(known.astype(np.float64), SMOOTH_CELLS)
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = gaussian_filter(np.where(known, values, 0.0), SMOOTH_CELLS) / weight
    maker = contour_generator(z=np.ma.array(smooth, mask=~known))
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

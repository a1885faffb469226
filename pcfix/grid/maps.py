"""Contours of rasters, and their interval."""

from __future__ import annotations

import math

import numpy as np

from pcfix.model import FloatArray
from pcfix.sums import nice_step

Extent = tuple[float, float, float, float]
"""West, east, south and north, metres."""


def smoothed(values: FloatArray, sigma_cells: float) -> FloatArray:
    """Return a map smoothed by a Gaussian filter; NaN stays NaN."""
    from scipy.ndimage import gaussian_filter

    known = np.isfinite(values)
    weight = gaussian_filter(known.astype(np.float64), sigma_cells)
    total = gaussian_filter(np.where(known, values, 0.0), sigma_cells)
    return np.where(known, total / np.maximum(weight, 1e-9), np.nan)


MOST_LEVELS, LEAST_INTERVAL_M = 15, 1e-3
SMOOTH_CELLS = 1.0
"""Standard deviation of the filter before the lines are drawn."""
LEAST_CELLS = 12.0
"""Shorter lines are dropped."""


def depth_interval(depth_m: FloatArray, uncertainty_m: FloatArray) -> float:
    """Return the interval for a map of depths: few levels, and not finer than the uncertainty.

    It is 1, 2 or 5 times a power of ten, metres. Both arrays are NaN if unknown, of any shape.
    """
    known = uncertainty_m[np.isfinite(uncertainty_m)]
    deepest = np.max(depth_m, where=np.isfinite(depth_m), initial=0.0)
    sigma = float(np.median(known)) if known.size else 0.0
    return nice_step(max(float(deepest) / MOST_LEVELS, sigma, LEAST_INTERVAL_M))


def contours(values: FloatArray, interval: float) -> list[tuple[float, FloatArray]]:
    """Return levels and lines of the contours of cells (rows, columns), NaN if unknown.

    The levels are whole intervals; the lowest and the highest value have no contour. A line, shape
    (n, 2), has columns and rows from the centre of the first cell.
    """
    from contourpy import contour_generator

    if min(values.shape) < 2 or not np.isfinite(values).any():
        return []
    maker = contour_generator(z=np.ma.masked_invalid(smoothed(values, SMOOTH_CELLS)))
    first = math.floor(float(np.nanmin(values)) / interval) + 1
    last = math.ceil(float(np.nanmax(values)) / interval)
    return [
        (round(step * interval, 6), line)
        for step in range(first, last)
        for line in map(np.asarray, maker.lines(step * interval))
        if np.hypot(*np.diff(line, axis=0).T).sum() >= LEAST_CELLS
    ]

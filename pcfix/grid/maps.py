"""Maps: a colour ramp for each quantity in pictures, pages and GIS styles, shades, and contours.

All ramps are of matplotlib and keep their order for colour-blind readers and in print: shallow
water is light, and positive differences are red.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from pcfix.model import FloatArray
from pcfix.sums import nice_step

DEPTH = "YlGnBu"
HEIGHT = "cividis"
UNCERTAINTY = "OrRd"
DIFFERENCE = "RdBu_r"


def stops_of(ramp: str, steps: int = 9) -> list[tuple[float, tuple[int, ...]]]:
    """Return positions along a ramp, 0 to 1, and their colours (red, green, blue; 0 to 255)."""
    from matplotlib import colormaps

    shares = [step / (steps - 1) for step in range(steps)]
    colours = colormaps[ramp](shares)[:, :3]
    return [
        (share, tuple(round(255 * part) for part in colour))
        for share, colour in zip(shares, colours.tolist(), strict=True)
    ]


LAND = (214, 205, 188)
DARKEST = 0.35
"""Share of the colour without light."""
SUN = np.array([-0.5, 0.5, 0.5**0.5])
"""Direction of the sun, east, north and up: in the north-west, 45 degrees above the horizon."""


def relief_colours(
    light: FloatArray, depth_m: FloatArray, deepest_m: float
) -> npt.NDArray[np.uint8]:
    """Return red, green, blue and alpha, shape (4, rows, columns), of a shaded bed and its land.

    `light`, shape (rows, columns), is that of `hillshade`; level ground keeps its colour. Depths
    are NaN on land; `deepest_m` has the last colour of the ramp.
    """
    stops = stops_of(DEPTH, 33)
    at = np.array([share for share, _ in stops]) * deepest_m
    lit = DARKEST + (1.0 - DARKEST) * light / SUN[2]
    colours = [
        np.where(np.isnan(depth_m), land, np.interp(np.nan_to_num(depth_m), at, ramp))
        for land, ramp in zip(LAND, np.array([colour for _, colour in stops]).T, strict=True)
    ]
    alpha = np.full(light.shape, 255.0)
    bands = [np.clip(np.rint(band * lit), 0, 255) for band in colours]
    return np.where(np.isnan(light), 0.0, [*bands, alpha]).astype(np.uint8)


def hillshade(height: FloatArray, resolution_m: float) -> FloatArray:
    """Return the brightness of each cell, 0 (dark) to 1 in 254 steps; NaN without a height.

    The slope of a cell comes from its eight neighbours, the four nearest counting twice (B. K. P.
    Horn, Hill shading and the reflectance map, 1981); the light is the cosine of the angle between
    the normal and `SUN`. A neighbour without a height gets the cell's own.

    Heights have the shape (rows + 2, columns + 2), metres, NaN if unknown, with a margin of one
    cell; the first row is the northernmost. The result has the shape (rows, columns).
    """
    rows, columns = height.shape[0] - 2, height.shape[1] - 2
    own = height[1:-1, 1:-1]

    def near(down: int, right: int) -> FloatArray:
        there = height[1 + down : 1 + down + rows, 1 + right : 1 + right + columns]
        return np.where(np.isnan(there), own, there)

    east = near(-1, 1) + 2.0 * near(0, 1) + near(1, 1)
    west = near(-1, -1) + 2.0 * near(0, -1) + near(1, -1)
    north = near(-1, -1) + 2.0 * near(-1, 0) + near(-1, 1)
    south = near(1, -1) + 2.0 * near(1, 0) + near(1, 1)
    slope_x, slope_y = (east - west) / (8.0 * resolution_m), (north - south) / (8.0 * resolution_m)
    cosine = SUN[2] - SUN[0] * slope_x - SUN[1] * slope_y
    cosine /= np.sqrt(1.0 + slope_x**2 + slope_y**2)
    light = np.rint(254.0 * np.clip(cosine, 0.0, 1.0)) / 254.0
    return np.where(np.isnan(own), np.nan, light)


def smoothed(values: FloatArray, sigma_cells: float) -> FloatArray:
    """Return a map smoothed by a Gaussian filter; NaN stays NaN."""
    from scipy.ndimage import gaussian_filter

    known = np.isfinite(values)
    weight = gaussian_filter(known.astype(np.float64), sigma_cells)
    total = gaussian_filter(np.where(known, values, 0.0), sigma_cells)
    return np.where(known, total / np.maximum(weight, 1e-9), np.nan)


def depth_interval(depth_m: FloatArray, uncertainty_m: FloatArray) -> float:
    """Return the interval for a map of depths: few levels, and not finer than the uncertainty.

    It is 1, 2 or 5 times a power of ten, metres. Both arrays are NaN if unknown, of any shape.
    """
    known = uncertainty_m[np.isfinite(uncertainty_m)]
    deepest = np.max(depth_m, where=np.isfinite(depth_m), initial=0.0)
    sigma = float(np.median(known)) if known.size else 0.0
    return nice_step(max(float(deepest) / 15, sigma, 1e-3))


def contours(values: FloatArray, interval: float) -> list[tuple[float, FloatArray]]:
    """Return levels and lines of the contours of cells (rows, columns), NaN if unknown.

    The levels are whole intervals; the lowest and the highest value have no contour. A line, shape
    (n, 2), has columns and rows from the centre of the first cell.
    """
    from contourpy import contour_generator

    if min(values.shape) < 2 or not np.isfinite(values).any():
        return []
    maker = contour_generator(z=np.ma.masked_invalid(smoothed(values, 1.0)))
    first = math.floor(float(np.nanmin(values)) / interval) + 1
    last = math.ceil(float(np.nanmax(values)) / interval)
    return [
        (round(step * interval, 6), line)
        for step in range(first, last)
        for line in map(np.asarray, maker.lines(step * interval))
        if np.hypot(*np.diff(line, axis=0).T).sum() >= 12.0  # cells
    ]

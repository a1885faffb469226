"""Maps: a colour ramp for each quantity in pictures, pages and GIS styles, shades, and lines.

All ramps are of matplotlib and keep their order for colour-blind readers and in print: shallow
water is light, and positive differences are red.

The waterline of a cloud is the zero contour of the heights above the water, averaged in cells. An
error in height moves it by the error over the slope of the bed.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

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
    return [
        (share, tuple(round(255 * part) for part in colour))
        for share, colour in zip(shares, colormaps[ramp](shares)[:, :3].tolist(), strict=True)
    ]


LAND = (214, 205, 188)
DARKEST = 0.35  # share of the colour without light
# Direction of the sun, east, north and up: in the north-west, 45 degrees above the horizon.
SUN = np.array([-0.5, 0.5, 0.5**0.5])


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
    bands = [np.clip(np.rint(band * lit), 0, 255) for band in colours]
    return np.where(np.isnan(light), 0.0, [*bands, np.full(light.shape, 255.0)]).astype(np.uint8)


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


# The waterline

MOST_POINTS = 2_000_000  # maximum number of points in memory, evenly spread
POINTS_PER_CELL = 4.0
MAX_CELLS = 25_000_000
SMOOTH_CELLS = 1.0  # standard deviation of the filter over the cells; it averages about 50 points
FLATTEST = 0.01  # least slope for the standard error: on flat ground the line may be anywhere


@dataclass(frozen=True, eq=False)
class Waterline:
    """A line and its accuracy."""

    xy: FloatArray  # (n, 2), world frame, metres; closed for an island or a pool
    level_m: float  # mean height of the water along it
    sigma_m: float  # standard error in plan across the line, root mean square along it
    length_m: float  # in plan


def waterlines(chunks: Iterable[FloatArray], sigma_level_m: float) -> list[Waterline]:
    """Return where a cloud meets the water, the longest line first; several for islands and pools.

    Chunks of points have the shape (n, 5): x, y, z, world frame, metres; the height above the water
    surface, NaN if unknown; and the standard error of z, zero if unknown. `sigma_level_m` is the
    standard error of the water's height.
    """
    from contourpy import contour_generator

    near, every = [np.empty((0, 5))], 1
    for chunk in chunks:
        near.append(chunk[np.abs(chunk[:, 3]) <= 2.0][::every])  # metres
        while sum(map(len, near)) > MOST_POINTS:
            near, every = [part[::2] for part in near], 2 * every
    points = np.concatenate(near)
    if not len(points) or not points[:, 3].min() < 0.0 < points[:, 3].max():
        return []
    field = _field_of(points, _cell_m(points[:, :2]))
    wanted_m = math.sqrt(2.0 / 7.0 * field.blur_m * field.cell_m)
    if wanted_m > field.cell_m:  # so that the line's own scatter is half a cell
        field = _field_of(points, wanted_m)
    found = []
    for line in contour_generator(z=np.ma.masked_invalid(field.above_m)).lines(0.0):
        xy = field.low + np.asarray(line) * field.cell_m
        # the standard error of the heights over the slope, rms along the line
        slope = np.maximum(np.nan_to_num(_at(field, field.slope, xy)), FLATTEST)
        height_m = np.hypot(sigma_level_m, _at(field, field.sigma_z_m, xy))
        step = np.hypot(*np.diff(xy, axis=0).T)
        weight = np.append(step, 0.0) + np.append(0.0, step)
        sigma = math.sqrt(float(np.average((height_m / slope) ** 2, weights=weight)))
        level = float(np.nanmean(_at(field, field.water_m, xy)))
        found.append(Waterline(xy, level, sigma, float(step.sum())))
    least_m = 12.0 * field.cell_m  # shorter lines are noise
    long = [one for one in found if one.length_m >= max(least_m, 4.0 * one.sigma_m)]
    return sorted(long, key=lambda one: -one.length_m)


def _cell_m(xy: FloatArray) -> float:
    """Return the side of cells with `POINTS_PER_CELL` points within the area they fill."""
    extent = np.maximum(np.ptp(xy, axis=0), 1e-3)
    side = math.sqrt(float(extent.prod()) * POINTS_PER_CELL / len(xy))
    for _ in range(2):  # a strip along a shore fills little of its box
        cells = np.unique(((xy - xy.min(axis=0)) / side).astype(np.int64), axis=0)
        side *= math.sqrt(len(cells) * POINTS_PER_CELL / len(xy))
    return max(side, math.sqrt(float(extent.prod()) / MAX_CELLS))


class _Field(NamedTuple):
    """Smoothed cells, each (rows, columns); NaN if unknown."""

    low: FloatArray  # (2,), the centre of the first cell
    cell_m: float
    above_m: FloatArray
    water_m: FloatArray
    sigma_z_m: FloatArray  # of a point
    slope: FloatArray
    blur_m: float  # median shift of the line by the scatter of one point's height


def _field_of(points: FloatArray, cell_m: float) -> _Field:
    """Average points (n, 5), x, y, z, height above the water and standard error, in cells."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    low = points[:, :2].min(axis=0) - 2.0 * cell_m
    column, row = ((points[:, :2] - low) / cell_m).astype(np.int64).T
    shape = int(row.max()) + 3, int(column.max()) + 3
    number = row * shape[1] + column

    def summed(values: npt.ArrayLike) -> FloatArray:
        total = np.bincount(number, np.broadcast_to(values, len(number)), shape[0] * shape[1])
        return np.asarray(gaussian_filter(total.reshape(shape), SMOOTH_CELLS))

    z, above, sigma = points[:, 2:].T
    counts = summed(1.0)
    held = np.bincount(number, minlength=counts.size).reshape(shape) > 0
    # where enough of the filter's weight is on cells with points: gaps of two cells are bridged
    known = gaussian_filter(held.astype(np.float64), SMOOTH_CELLS) >= 0.4
    with np.errstate(invalid="ignore", divide="ignore"):
        height = np.where(known, summed(above) / counts, np.nan)
        water = summed(z - above) / counts
        errors = summed(sigma) / summed(sigma > 0.0)
    slope = np.hypot(*np.gradient(height, cell_m))
    steep = np.isfinite(slope)
    if steep.any():  # at the edge of the cloud, that of the nearest cell inside
        nearest = distance_transform_edt(~steep, return_distances=False, return_indices=True)
        slope = slope[tuple(nearest)]
    field = _Field(low + cell_m / 2.0, cell_m, height, water, errors, slope, 0.0)
    off = above - _at(field, height, points[:, :2])
    scatter = 1.4826 * float(np.nanmedian(np.abs(off - np.nanmedian(off))))
    near = np.abs(height) < np.nanmedian(np.abs(above))
    flat = float(np.nanmedian(slope[near])) if np.isfinite(slope[near]).any() else FLATTEST
    return field._replace(
        sigma_z_m=np.where(np.isfinite(errors), errors, scatter),
        blur_m=scatter / max(flat, FLATTEST),
    )


def _at(field: _Field, values: FloatArray, xy: FloatArray) -> FloatArray:
    """Return a field at places (n, 2), bilinear."""
    from scipy.ndimage import map_coordinates

    place = ((xy - field.low) / field.cell_m)[:, ::-1].T
    return np.asarray(map_coordinates(values, place, order=1, mode="nearest"))

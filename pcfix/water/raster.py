"""A water raster, and its height and slope above a place.

Between the centres of four cells the surface is bilinear, z = z00 + s dx + t dy + k s t with s and
t from 0 to 1; its slope is the gradient of that. An unknown cell is NaN and makes the four patches
around it unknown, by arithmetic alone. Coordinates inside are counted from the centre of the upper
left cell, so that nothing is lost at UTM northings of five million.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit, prange

if TYPE_CHECKING:
    from pcfix.model import FloatArray, WaterRaster


class Field(NamedTuple):
    """The numbers of the lookup; see `build_field`.

    heights : shape (rows, columns), metres, northern row first.
    west_x, north_y : the centre of the upper left cell, world frame.
    cell_x, cell_y : width and height of a cell, metres.
    """

    heights: FloatArray
    west_x: float
    north_y: float
    cell_x: float
    cell_y: float


@lru_cache(maxsize=4)
def build_field(raster: WaterRaster) -> Field:
    """Return a raster as the kernels take it."""
    width, height = (float(side) for side in raster.cell_m)
    return Field(
        np.ascontiguousarray(raster.height_m, np.float64),
        float(raster.left_m) + width / 2.0,
        float(raster.top_m) - height / 2.0,
        width,
        height,
    )


@njit(cache=True, error_model="numpy", nogil=True)
def height_at(field: Field, x: float, y: float) -> tuple[float, float, float]:
    """Return height, dz/dx and dz/dy at a plan position (world frame); NaN where not known.

    In the outer half of the cells at the edge the outermost patch goes on.
    """
    rows, columns = field.heights.shape
    u, v = (x - field.west_x) / field.cell_x, (field.north_y - y) / field.cell_y
    if not (-0.5 <= u <= columns - 0.5 and -0.5 <= v <= rows - 0.5):
        return np.nan, 0.0, 0.0
    column = min(max(int(np.floor(u)), 0), columns - 2)
    row = min(max(int(np.floor(v)), 0), rows - 2)
    s, t = u - column, v - row
    z = field.heights[row, column]
    east = field.heights[row, column + 1] - z
    south = field.heights[row + 1, column] - z
    twist = field.heights[row + 1, column + 1] - z - east - south
    height = z + s * east + t * south + s * t * twist
    return height, (east + t * twist) / field.cell_x, -(south + s * twist) / field.cell_y


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def heights_above(
    field: Field, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:  # pragma: no cover - compiled
    """Return `height_at` for n positions: heights, shape (n,), and slopes, shape (n, 2)."""
    height, slope = np.empty(x.size), np.empty((x.size, 2))
    for i in prange(x.size):
        height[i], slope[i, 0], slope[i, 1] = height_at(field, x[i], y[i])
    return height, slope

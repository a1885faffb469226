"""Heights of a raster in one CRS, sampled on a north-up grid in another."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.model import WaterRaster

if TYPE_CHECKING:
    from collections.abc import Callable

    from rasterio.transform import Affine

    from pcfix.model import FloatArray

    Bounds = tuple[float, float, float, float]
    Points = Callable[[FloatArray], FloatArray]

MOST_CELLS = 50_000_000
_EDGE_POINTS = 33
_AT_ONCE = 1_000_000


class Part(NamedTuple):
    """Part of a raster: heights, and the transform from (column, row) of it to its CRS."""

    heights: FloatArray
    transform: Affine


def place_of(transform: Affine, column: Any, row: Any) -> tuple[Any, Any]:
    """Return the place of a column and row: numbers or arrays of them."""
    t = transform
    return t.a * column + t.b * row + t.c, t.d * column + t.e * row + t.f


def check_size(cells: int, name: str) -> None:
    """Refuse more cells than memory should hold.

    Raises
    ------
    InputError
    """
    if cells > MOST_CELLS:
        raise InputError(
            f"{name}: {cells:,} cells are too many ({MOST_CELLS:,} at most); water is smooth, so"
            " resample it to coarser cells, 1 m for instance."
        )


def sampled(
    part: Part,
    to_cloud: Points,
    from_cloud: Points,
    bounds: Bounds | None,
    names: tuple[str, str],
) -> WaterRaster:
    """Sample on a grid in the cloud's CRS with square cells as fine as the raster's finest.

    Parameters
    ----------
    part : Part
        In metres, in its own CRS.
    to_cloud, from_cloud : callable
        From points (n, 3) to points (n, 3); the way back is of the plan alone.
    bounds : tuple of 4 float, or None
        West, south, east and north end of what is wanted, in the cloud's CRS.
    names : tuple of 2 str
        Of the raster, for messages and as its title.

    Raises
    ------
    InputError
        If it holds no height there, is too large, or reaches where the cloud's CRS does not.
    """
    cell, (west, south, east, north) = _extent(part, to_cloud, names[0])
    if bounds is not None:
        west, south = max(west, bounds[0]), max(south, bounds[1])
        east, north = min(east, bounds[2]), min(north, bounds[3])
    left, top = np.floor(west / cell) * cell, np.ceil(north / cell) * cell
    columns, rows = int(np.ceil((east - left) / cell)), int(np.ceil((top - south) / cell))
    check_size(columns * rows, names[0])
    heights = np.empty((max(rows, 2), max(columns, 2)))
    x = left + (np.arange(heights.shape[1]) + 0.5) * cell
    for first in range(0, len(heights), max(1, _AT_ONCE // len(x))):
        some = heights[first : first + max(1, _AT_ONCE // len(x))]
        y = top - (first + np.arange(len(some)) + 0.5) * cell
        plan = np.column_stack([np.tile(x, len(y)), np.repeat(y, len(x)), np.zeros(some.size)])
        some[:] = _heights_at(part, from_cloud(plan), to_cloud).reshape(some.shape)
    if not np.isfinite(heights).any():
        raise InputError(f"{names[0]}: holds no height near the cloud; check its CRS.")
    return WaterRaster(heights, float(left), float(top), (float(cell), float(cell)), names[1])


def _extent(part: Part, to_cloud: Points, name: str) -> tuple[float, Bounds]:
    """Return the smaller side of a cell amid a raster, and the raster's bounds, in the cloud's."""
    rows, columns = part.heights.shape
    share = np.linspace(0.0, 1.0, _EDGE_POINTS)
    c, r = (grid.ravel() for grid in np.meshgrid(share * columns, share * rows))
    amid = columns / 2.0 + np.array([0.0, 1.0, 0.0]), rows / 2.0 + np.array([0.0, 0.0, 1.0])
    x, y = place_of(part.transform, np.append(c, amid[0]), np.append(r, amid[1]))
    level = np.full(len(x), np.nanmean(part.heights))
    placed = to_cloud(np.column_stack([x, y, level]))
    if not np.isfinite(placed).all():
        raise InputError(f"{name}: reaches beyond where the cloud's CRS can be used; clip it.")
    sides = np.hypot(*(placed[-2:] - placed[-3])[:, :2].T)
    (west, south, _), (east, north, _) = placed.min(axis=0), placed.max(axis=0)
    return float(sides.min()), (float(west), float(south), float(east), float(north))


def _heights_at(part: Part, places: FloatArray, to_cloud: Points) -> FloatArray:
    """Return heights in the cloud's system at places in the raster's CRS; NaN where unknown."""
    from pcfix.water.raster import Field, heights_above

    column, row = place_of(~part.transform, places[:, 0], places[:, 1])
    cells = Field(np.ascontiguousarray(part.heights), 0.5, -0.5, 1.0, 1.0)
    height, _ = heights_above(cells, np.ascontiguousarray(column), np.ascontiguousarray(-row))
    known = np.isfinite(height)
    height[known] = to_cloud(np.column_stack([places[known, :2], height[known]]))[:, 2]
    height[~np.isfinite(height)] = np.nan
    return np.asarray(height)

"""One height for each cell, from the points in and around it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pcfix.grid.delaunay import triangulated
from pcfix.grid.lattice import Lattice, Window
from pcfix.kernels import kernel
from pcfix.model import FloatArray, IntArray
from pcfix.options.steps import DsmMethod

TO_95 = 1.959964
"""From a standard deviation to the half-width that holds 95 % of a normal distribution."""


class Gridding(NamedTuple):
    """How heights are made: the raster, the key of `HEIGHTS`, and distances in metres.

    reach_m : width of the widest circle around a triangle of the TIN.
    spacing_m : of the points; see `pcfix.grid.lattice.Occupancy`.
    """

    lattice: Lattice
    method: DsmMethod
    reach_m: float
    spacing_m: float

    @property
    def margin_cells(self) -> int:
        """How many cells around a window hold points that decide on it."""
        return HEIGHTS[self.method].margin(self.reach_m / self.lattice.resolution_m)


class Block(NamedTuple):
    """What a height of the cells of a window is made from.

    position : shape (n, 2), columns and rows, in cells from the top left corner of the raster.
    cell : shape (n, 2), column and row of each point's cell; they reach `Gridding.margin_cells`
        beyond the window.
    z : shape (n,), metres.
    numbers : of the window's cells.
    """

    position: FloatArray
    cell: IntArray
    z: FloatArray
    window: Window
    numbers: Cells
    reach: float
    spacing: float


class Gridded(NamedTuple):
    """The bands of a window, each of its shape; NaN where nothing is known."""

    height: FloatArray
    points: IntArray
    spread: FloatArray


def grid_window(points: FloatArray, cell: IntArray, window: Window, how: Gridding) -> Gridded:
    """Return the bands of a part of a raster.

    Parameters
    ----------
    points : array, shape (n, 3)
        x and y, world frame, metres, and the height, or what else the raster is made of.
    cell : array of int, shape (n, 2)
        Column and row of each point in the raster.
    window : Window
    how : Gridding
    """
    inner, shape = window.holds(cell), (window.height, window.width)
    code = (cell[inner, 1] - window.row) * window.width + cell[inner, 0] - window.column
    numbers = cell_numbers(code, points[inner, 2], window.height * window.width)
    size = how.lattice.resolution_m
    block = Block(
        how.lattice.positions(points), cell, points[:, 2], window, numbers,
        how.reach_m / size, how.spacing_m / size,
    )  # fmt: skip
    height = HEIGHTS[how.method].of(block).reshape(shape)
    return Gridded(height, numbers.points.reshape(shape), numbers.spread.reshape(shape))


class Cells(NamedTuple):
    """The points of n cells in numbers, each of shape (n,); NaN where a cell has none."""

    points: IntArray
    mean: FloatArray
    median: FloatArray
    min: FloatArray
    max: FloatArray
    spread: FloatArray


def cell_numbers(cell: IntArray, z: FloatArray, size: int) -> Cells:
    """Return the numbers of each cell.

    Heights are summed in ascending order, as differences from the lowest of their cell, so that
    neither the order of the points nor the height above the datum touches the result. `spread` is
    the root mean square distance of the heights from their mean (their population standard
    deviation): 0 in a cell with one point.

    Parameters
    ----------
    cell : array of int, shape (k,)
        The cell of each point, from 0 to size - 1.
    z : array, shape (k,)
        Heights, metres.
    size : int
        Number of cells, n.
    """
    order = np.lexsort((z, cell))
    z, count = z[order], np.bincount(cell, minlength=size)
    filled = np.flatnonzero(count)
    n = count[filled]
    first = np.cumsum(n) - n
    low = z[first]
    above = z - np.repeat(low, n)
    offset = _sums(above, first) / n
    scatter = np.sqrt(_sums((above - np.repeat(offset, n)) ** 2, first) / n)
    median = (z[first + (n - 1) // 2] + z[first + n // 2]) / 2.0
    columns = (low + offset, median, low, z[first + n - 1], scatter)
    return Cells(count, *(_spread_out(values, filled, size) for values in columns))


def as_uncertainty(bands: Gridded) -> Gridded:
    """Return the vertical uncertainty (m) at 95 % of cells whose bands are of standard errors.

    It is the root mean square of the points', and not divided by the square root of their number.
    What the points of a cell are wrong by comes in good part from level, index and tilt of the
    water and from poses, which they share, and which more points do not average out; to take all
    of it as shared is the cautious side.
    """
    return bands._replace(height=TO_95 * np.hypot(bands.height, bands.spread))


def _sums(values: FloatArray, first: IntArray) -> FloatArray:
    """Return the sum of each run of values; runs begin at `first`."""
    return np.asarray(np.add.reduceat(values, first))


def _spread_out(values: FloatArray, where: IntArray, size: int) -> FloatArray:
    out = np.full(size, np.nan)
    out[where] = values
    return out


REACH_CELLS = 2.0**0.5
"""Points this far from a centre count; they lie in its cell and the eight around it."""
NEAREST_CELLS = 1e-4
"""A point nearer to a centre weighs as if it were this far from it."""


def inverse_distance(block: Block) -> FloatArray:
    """Return the mean of the heights around each centre, weighted with 1 / distance squared.

    The nearer a point, the more it counts; points farther than `REACH_CELLS` do not count, and
    cells without a point of their own get NaN. The points cover the window with a margin of a cell.
    """
    wide = block.window.grown(1)
    code = (block.cell[:, 1] - wide.row) * wide.width + block.cell[:, 0] - wide.column
    order = np.lexsort((block.z, code))
    start = np.searchsorted(code[order], np.arange(wide.height * wide.width + 1))
    return np.asarray(_weighted(block.position[order], block.z[order], start, *block.window))


@kernel(allocates=True)
def _weighted(
    position: FloatArray,
    z: FloatArray,
    start: IntArray,
    row_first: int,
    row_stop: int,
    column_first: int,
    column_stop: int,
) -> FloatArray:
    """Return the weighted means; `start` indexes the points of cells with a margin of one."""
    height, width = row_stop - row_first, column_stop - column_first
    out = np.full((height, width), np.nan)
    for row in range(height):
        for column in range(width):
            own = (row + 1) * (width + 2) + column + 1
            if start[own] == start[own + 1]:
                continue
            weights, total, base = 0.0, 0.0, z[start[own]]
            for r in range(row, row + 3):
                for c in range(column, column + 3):
                    code = r * (width + 2) + c
                    for k in range(start[code], start[code + 1]):
                        across = position[k, 0] - (column_first + column) - 0.5
                        down = position[k, 1] - (row_first + row) - 0.5
                        square = across * across + down * down
                        if square <= REACH_CELLS * REACH_CELLS:
                            weight = 1.0 / max(square, NEAREST_CELLS * NEAREST_CELLS)
                            weights += weight
                            total += weight * (z[k] - base)
            out[row, column] = base + total / weights
    return out


class Height(NamedTuple):
    """One way to give cells a height; and how many cells around a window it needs, by `reach`."""

    of: Callable[[Block], FloatArray]
    margin: Callable[[float], int] = lambda reach: 0


HEIGHTS: dict[DsmMethod, Height] = {
    "mean": Height(lambda block: block.numbers.mean),
    "median": Height(lambda block: block.numbers.median),
    "min": Height(lambda block: block.numbers.min),
    "max": Height(lambda block: block.numbers.max),
    "idw": Height(inverse_distance, lambda reach: 1),
    "tin": Height(
        lambda b: triangulated(b.position, b.z, b.window, b.reach, b.spacing),
        lambda reach: int(np.ceil(reach)) + 1,
    ),
}
"""The statistics of a DSM. One more is an entry here and a word in `DsmMethod`."""

"""Heights at the centres of cells by inverse distance weighting."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from pcfix.grid.lattice import Window
    from pcfix.model import FloatArray, IntArray

REACH_CELLS = 2.0**0.5
"""Points this far from a centre count; they lie in its cell and the eight around it."""
NEAREST_CELLS = 1e-4
"""A point nearer to a centre weighs as if it were this far from it."""


def inverse_distance(
    position: FloatArray, cell: IntArray, z: FloatArray, window: Window
) -> FloatArray:
    """Return the mean of the heights around each centre, weighted with 1 / distance squared.

    The nearer a point, the more it counts; points farther than `REACH_CELLS` do not count, and
    cells without a point of their own get NaN.

    Parameters
    ----------
    position : array, shape (n, 2)
        Columns and rows, in cells from the top left corner of the raster.
    cell : array of int, shape (n, 2)
        Column and row of the cell of each point, in the same frame. They must cover the window
        with a margin of one cell.
    z : array, shape (n,)
        Heights, metres.
    window : Window

    Returns
    -------
    array, shape (window.height, window.width)
        Metres.
    """
    wide = window.grown(1)
    code = (cell[:, 1] - wide.row) * wide.width + cell[:, 0] - wide.column
    order = np.lexsort((z, code))
    start = np.searchsorted(code[order], np.arange(wide.height * wide.width + 1))
    return np.asarray(_weighted(position[order], z[order], start, *window))


@njit(cache=True, error_model="numpy", nogil=True)
def _weighted(
    position: FloatArray,
    z: FloatArray,
    start: IntArray,
    row_first: int,
    row_stop: int,
    column_first: int,
    column_stop: int,
) -> FloatArray:  # pragma: no cover - compiled
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

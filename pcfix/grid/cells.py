"""One height for each cell, from the points inside it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray


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
    neither the order of the points nor the height above the datum touches the result.

    Parameters
    ----------
    cell : array of int, shape (k,)
        The cell of each point, from 0 to size - 1.
    z : array, shape (k,)
        Heights, metres.
    size : int
        Number of cells, n.

    Returns
    -------
    Cells
        Heights in metres. `spread` is the root mean square distance of the heights from their
        mean (their population standard deviation): 0 in a cell with one point.
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


def _sums(values: FloatArray, first: IntArray) -> FloatArray:
    """Return the sum of each run of values; runs begin at `first`."""
    if not len(values):
        return np.empty(0)
    return np.asarray(np.add.reduceat(values, first))


def _spread_out(values: FloatArray, where: IntArray, size: int) -> FloatArray:
    out = np.full(size, np.nan)
    out[where] = values
    return out

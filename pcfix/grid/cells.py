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


def cell_uncertainty(cell: IntArray, sigma_m: FloatArray, size: int) -> FloatArray:
    """Return the standard uncertainty of each cell: the root mean square of its points'.

    It is not divided by the square root of their number. What the points of a cell are wrong by
    comes in good part from level, index and tilt of the water and from poses, which they share,
    and which more points do not average out; to take all of it as shared is the cautious side.

    Parameters
    ----------
    cell : array of int, shape (k,)
        The cell of each point, from 0 to size - 1.
    sigma_m : array, shape (k,)
        Standard errors, metres; points with none have 0 and do not count.
    size : int
        Number of cells, n.

    Returns
    -------
    array, shape (n,)
        Metres; NaN where no point has a standard error.
    """
    known = sigma_m > 0.0
    cell, sigma_m = cell[known], sigma_m[known]
    order = np.lexsort((sigma_m, cell))
    count = np.bincount(cell, minlength=size)
    filled = np.flatnonzero(count)
    n = count[filled]
    mean_square = _sums(sigma_m[order] ** 2, np.cumsum(n) - n) / n
    return _spread_out(np.sqrt(mean_square), filled, size)


def _sums(values: FloatArray, first: IntArray) -> FloatArray:
    """Return the sum of each run of values; runs begin at `first`."""
    if not len(values):
        return np.empty(0)
    return np.asarray(np.add.reduceat(values, first))


def _spread_out(values: FloatArray, where: IntArray, size: int) -> FloatArray:
    out = np.full(size, np.nan)
    out[where] = values
    return out

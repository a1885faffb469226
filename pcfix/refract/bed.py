"""The bed of the surroundings: the height that most points around can have come from.

See `pcfix.refract.fusion`. It is a raster that only helps to choose among the likely beds of a
point; no point is put onto it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit, prange

from pcfix.threads import one_caller

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray

POINTS_A_CELL = 20.0
WIDTH_M = 0.2
"""Standard deviation of the likely beds of one place: relief within a cell, and noise."""

FAR_OFF_M = 0.4
REACH = 2
MOST_CELLS = 4_000_000
_STEPS = 2.0


class Bed(NamedTuple):
    """Heights on a grid; NaN where nothing is known.

    Attributes
    ----------
    height_m : array, shape (rows, columns)
        World frame; the first row is the southern one.
    left_m, bottom_m, cell_m : float
    """

    height_m: FloatArray
    left_m: float
    bottom_m: float
    cell_m: float

    def height_at(self, xy: FloatArray) -> FloatArray:
        """Return the height of the cell of each place, shape (n,)."""
        rows, columns = self.height_m.shape
        column = np.floor((xy[:, 0] - self.left_m) / self.cell_m).astype(int)
        row = np.floor((xy[:, 1] - self.bottom_m) / self.cell_m).astype(int)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        height = np.full(len(xy), np.nan)
        height[inside] = self.height_m[row[inside], column[inside]]
        return height


def bed_of(xyz: FloatArray, likely_m: FloatArray) -> Bed:
    """Return the bed that most points can have come from, cell by cell.

    Parameters
    ----------
    xyz : array, shape (m, 3)
        Apparent points, world frame, metres.
    likely_m : array, shape (m, h)
        See `pcfix.refract.fusion.likely_beds`.
    """
    low, high = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    cell = _cell_m(xyz[:, :2], low, high)
    columns, rows = (int(n) + 1 for n in (high - low) / cell)
    at = np.floor((xyz[:, :2] - low) / cell).astype(np.int64)
    key = at[:, 1] * columns + at[:, 0]
    order = np.argsort(key, kind="stable")
    filled, counts = np.unique(key, return_counts=True)
    start = np.concatenate([[0], np.cumsum(counts)])
    found = np.empty(len(filled))
    with one_caller():
        _vote(order, start, np.ascontiguousarray(xyz[:, 2]), likely_m, found)
    height = np.full(rows * columns, np.nan)
    height[filled] = found
    grid = _without_outliers(height.reshape(rows, columns))
    return Bed(grid, float(low[0]), float(low[1]), cell)


@njit(cache=True, error_model="numpy", nogil=True)
def _without_outliers(height: FloatArray) -> FloatArray:
    """Return heights in which a cell far off the median of its 5 x 5 surroundings is that median.

    Where only one group of images sees the bed, several heights have all votes.
    """
    rows, columns = height.shape
    smooth = height.copy()
    around = np.empty((2 * REACH + 1) ** 2)
    for r in range(rows):
        for c in range(columns):
            if height[r, c] != height[r, c]:
                continue
            count = 0
            for i in range(max(0, r - REACH), min(rows, r + REACH + 1)):
                for j in range(max(0, c - REACH), min(columns, c + REACH + 1)):
                    if height[i, j] == height[i, j]:
                        around[count] = height[i, j]
                        count += 1
            middle = np.median(around[:count])
            if abs(height[r, c] - middle) > FAR_OFF_M:
                smooth[r, c] = middle
    return smooth


def _cell_m(xy: FloatArray, low: FloatArray, high: FloatArray) -> float:
    """Return the side of cells that hold so many points on average where there are any."""
    least = float(np.sqrt(np.prod(np.maximum(high - low, 1.0)) / MOST_CELLS))
    side = max(
        float(np.sqrt(np.prod(np.maximum(high - low, 1.0)) * POINTS_A_CELL / len(xy))), least
    )
    for _ in range(3):
        at = np.floor((xy - low) / side).astype(np.int64)
        filled = len(np.unique(at[:, 1] * (at[:, 0].max() + 1) + at[:, 0]))
        side = max(side * float(np.sqrt(POINTS_A_CELL * filled / len(xy))), least)
    return side


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _vote(
    order: IntArray, start: IntArray, z: FloatArray, likely: FloatArray, found: FloatArray
) -> None:
    """Find in each cell the height with the most votes; a point votes for all its likely beds."""
    for c in prange(start.size - 1):
        rows = order[start[c] : start[c + 1]]
        low, high = np.inf, -np.inf
        for i in rows:
            for h in range(likely.shape[1]):
                if likely[i, h] == likely[i, h]:
                    low = min(low, likely[i, h] + z[i])
                    high = max(high, likely[i, h] + z[i])
        found[c] = np.nan
        if not high >= low:
            continue
        step = max(WIDTH_M / _STEPS, (high - low) / 2000.0)
        votes = np.zeros(int((high - low) / step) + 2)
        mine = np.empty(votes.size)
        for i in rows:
            mine[:] = 0.0
            for h in range(likely.shape[1]):
                if likely[i, h] == likely[i, h]:
                    _add_vote(mine, (likely[i, h] + z[i] - low) / step)
            votes += mine
        found[c] = low + np.argmax(votes) * step


@njit(cache=True, error_model="numpy", nogil=True)
def _add_vote(mine: FloatArray, at: float) -> None:
    """Vote once for every height at which a point can be, however many groups say so."""
    reach = int(3.0 * _STEPS)
    for k in range(max(0, int(at) - reach), min(mine.size, int(at) + reach + 2)):
        off = (k - at) / _STEPS
        mine[k] = max(mine[k], np.exp(-0.5 * off * off))

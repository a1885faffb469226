"""Where two clouds lie over each other in plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pcfix.model import BoolArray, FloatArray, IntArray


MAX_TABLE = 50_000_000
"""Squares up to which each has a place of its own in memory."""


def near_in_plan(xy: FloatArray, other_xy: FloatArray, limit_m: float) -> BoolArray:
    """Return which points have a point of the other cloud about them in plan.

    The plan is cut into squares of side `limit_m`; a point counts when its own square or one of
    the eight around it holds a point of the other cloud. So all within the limit count, and none
    beyond 2.83 times the limit.

    Parameters
    ----------
    xy : array, shape (n, 2)
        Metres, world frame.
    other_xy : array, shape (m, 2)
        The same frame.
    limit_m : float

    Returns
    -------
    array of bool, shape (n,)
    """
    low = np.array([other_xy[:, 0].min(), other_xy[:, 1].min()]) - 2.0 * limit_m
    columns = int(np.ptp(other_xy[:, 0]) / limit_m) + 6
    rows = int(np.ptp(other_xy[:, 1]) / limit_m) + 6
    near = np.zeros(len(xy), np.bool_)
    high = low + np.array([columns, rows]) * limit_m
    x, y = xy[:, 0], xy[:, 1]
    inside = np.flatnonzero((x >= low[0]) & (x < high[0]) & (y >= low[1]) & (y < high[1]))
    steps = np.array([-1, 0, 1])
    around = (steps[:, np.newaxis] * columns + steps).ravel()
    asked, held = (_codes(p, low, limit_m, columns) for p in (xy[inside], other_xy))
    if columns * rows > MAX_TABLE:
        near[inside] = np.isin(asked, (np.unique(held)[:, np.newaxis] + around).ravel())
        return near
    table = np.zeros(columns * rows, np.bool_)
    table[held] = True
    table[(np.flatnonzero(table)[:, np.newaxis] + around).ravel()] = True
    near[inside] = table[asked]
    return near


def _codes(xy: FloatArray, low: FloatArray, side_m: float, columns: int) -> IntArray:
    column = ((xy[:, 0] - low[0]) / side_m).astype(np.int64)
    row = ((xy[:, 1] - low[1]) / side_m).astype(np.int64)
    return np.asarray(row * columns + column)

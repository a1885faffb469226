"""How close together the points of a cloud lie."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray

POINTS_A_SQUARE = 6.0
MOST_SQUARES = 4_000_000


class Occupancy:
    """The extent of a cloud, and in which squares of the plan it has points.

    Parameters
    ----------
    area_m2 : float
        Of the rectangle around the cloud.
    points : int
        How many there are in all; with the area, this sets the size of the squares.
    finest_m : float
        The squares are not smaller than this.

    Attributes
    ----------
    points : int
        So far.
    low, high : array, shape (2,)
        South-west and north-east corner of their extent, metres, world frame.
    """

    def __init__(self, area_m2: float, points: int, finest_m: float) -> None:
        wanted = max(POINTS_A_SQUARE / points, 1.0 / MOST_SQUARES) * area_m2
        self.side_m = max(float(np.sqrt(wanted)), finest_m)
        self.points = 0
        self.low, self.high = np.full(2, np.inf), np.full(2, -np.inf)
        self._squares: IntArray = np.empty(0, np.int64)

    def add(self, xyz: FloatArray) -> None:
        """Count points, shape (n, 3), metres, world frame."""
        if not len(xyz):
            return
        self.points += len(xyz)
        self.low = np.minimum(self.low, xyz[:, :2].min(axis=0))
        self.high = np.maximum(self.high, xyz[:, :2].max(axis=0))
        column, row = np.floor(xyz[:, :2] / self.side_m).astype(np.int64).T
        self._squares = np.union1d(self._squares, (row << 32) + column)

    @property
    def spacing_m(self) -> float:
        """Side of the square that each point has for itself; 0 if all are on one line."""
        row = self._squares >> 32
        corner = np.column_stack([self._squares - (row << 32), row]) * self.side_m
        sides = np.minimum(corner + self.side_m, self.high) - np.maximum(corner, self.low)
        return float(np.sqrt(np.maximum(sides, 0.0).prod(axis=1).sum() / self.points))

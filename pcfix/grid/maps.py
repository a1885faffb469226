"""What a run did, cell by cell: small maps for the report, added up chunk by chunk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.model import BoolArray, FloatArray, IntArray

LONG_SIDE_CELLS = 360
POINTS_PER_CELL = 6.0
"""A sparse cloud gets larger cells, so that its maps have few holes."""


@dataclass(frozen=True, eq=False)
class Maps:
    """Means of the points of each cell, shape (rows, columns); NaN where there are none.

    The first row lies in the north. Depth, shift and number of rays are of the corrected points.
    """

    west_m: float  # the outer corner of the upper left cell, in the cloud's CRS
    north_m: float
    cell_m: float  # side of a cell
    height_m: FloatArray
    depth_m: FloatArray
    shift_z_m: FloatArray
    shift_xy_m: FloatArray
    rays: FloatArray

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """West, east, south and north."""
        rows, columns = self.height_m.shape
        east = self.west_m + columns * self.cell_m
        return self.west_m, east, self.north_m - rows * self.cell_m, self.north_m


class MapsBuilder:
    """Sums per cell.

    Parameters
    ----------
    low, high : array, shape (2,)
        Corners of the area in plan, metres.
    points : int
        How many there will be.
    """

    def __init__(self, low: FloatArray, high: FloatArray, points: int) -> None:
        size = np.maximum(high - low, 1e-3)
        sparse_m = np.sqrt(POINTS_PER_CELL * size.prod() / max(points, 1))
        self._cell_m = float(max(size.max() / LONG_SIDE_CELLS, sparse_m))
        self._low = low
        self._columns, self._rows = (max(1, round(s / self._cell_m)) for s in size)
        cells = self._rows * self._columns
        self._all = np.zeros((2, cells))
        self._moved = np.zeros((5, cells))

    def add(
        self,
        xyz: FloatArray,
        depth_m: FloatArray,
        shift_m: FloatArray,
        ray_count: IntArray,
        moved: BoolArray,
    ) -> None:
        """Add n points; coordinates and shift have the shape (n, 3), the others (n,)."""
        column, row = ((xyz[:, :2] - self._low) / self._cell_m).astype(np.int64).T
        column = np.clip(column, 0, self._columns - 1)
        row = np.clip(row, 0, self._rows - 1)
        cell = (self._rows - 1 - row) * self._columns + column
        self._sum(self._all, cell, xyz[:, 2])
        plan = np.hypot(shift_m[moved, 0], shift_m[moved, 1])
        self._sum(
            self._moved, cell[moved], depth_m[moved], shift_m[moved, 2], plan, ray_count[moved]
        )

    @staticmethod
    def _sum(sums: FloatArray, cell: IntArray, *values: FloatArray | IntArray) -> None:
        cells = sums.shape[1]
        sums[0] += np.bincount(cell, minlength=cells)
        for i, value in enumerate(values, start=1):
            sums[i] += np.bincount(cell, weights=value, minlength=cells)

    def maps(self) -> Maps:
        """Return the means."""
        shape = self._rows, self._columns
        with np.errstate(invalid="ignore"):
            heights = (self._all[1] / self._all[0]).reshape(shape)
            depth, shift_z, shift_xy, rays = (
                (sums / self._moved[0]).reshape(shape) for sums in self._moved[1:]
            )
        north = float(self._low[1]) + self._rows * self._cell_m
        return Maps(
            float(self._low[0]), north, self._cell_m, heights, depth, shift_z, shift_xy, rays
        )

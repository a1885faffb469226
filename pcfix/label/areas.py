"""Areas in plan: the polygons of a mask, and connected water bodies.

Connected water is found in a grid over the cloud, filled chunk by chunk. Its cells have sides of a
power of two, in metres, and count from the origin of the world frame, so that the cell of a point
does not depend on other points. All sums are of whole numbers, for the same reason.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.model import BoolArray, FloatArray, IntArray

Flags = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class WaterMask:
    """The polygons inside which points may be submerged.

    A point on the border, of a hole too, is inside.
    """

    area: Any  # shapely Polygon or MultiPolygon, valid, in the cloud's CRS, metres
    name: str = "mask"  # for messages
    notes: tuple[str, ...] = ()  # of the reader, for the summary

    def inside(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Return which of n plan positions, metres, world frame, are inside."""
        import shapely

        shapely.prepare(self.area)  # does nothing the second time
        return np.asarray(shapely.intersects_xy(self.area, x, y))


MOST_CELLS = 2**24
"""Limits the memory; a larger cloud has larger cells."""
POINTS_A_CELL = 4.0
"""Least mean number of points per water cell; cells are the smallest that have it."""
FINEST_M = 2.0**-10
SHARE_OF_LARGEST = 0.1
"""Pools of at least this share of the area of the largest water body count as water."""
_VOTE = 1000
_AROUND = np.ones((3, 3), np.bool_)

PRESENT, BELOW, UNDECIDED = 1, 2, 4
"""A cell has points; points below the surface; points within the dead band."""


class Lattice(NamedTuple):
    """Square cells; the first column and row count from the origin of the world frame."""

    side_m: float
    first_column: int
    first_row: int
    columns: int
    rows: int

    def cells(self, x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
        """Return row and column of n plan positions."""
        column = np.floor(x / self.side_m).astype(np.int64) - self.first_column
        row = np.floor(y / self.side_m).astype(np.int64) - self.first_row
        return row, column


def lattice_over(low: FloatArray, high: FloatArray) -> Lattice:
    """Return the finest lattice with at most `MOST_CELLS` over a rectangle, shapes (2,), metres."""
    side = FINEST_M
    while True:
        first, last = np.floor(low / side), np.floor(high / side)
        columns, rows = last - first + 1.0
        if columns * rows <= MOST_CELLS:
            return Lattice(side, int(first[0]), int(first[1]), int(columns), int(rows))
        side *= 2.0


class Surroundings(NamedTuple):
    """What a grid knows about the cells of points; the rest is None without connected water."""

    lattice: Lattice
    is_wet: BoolArray  # (rows, columns), whether an undecided point in the cell is submerged
    pool: npt.NDArray[np.int32] | None = None  # (rows, columns), 0 for none, else an index below
    area_m2: FloatArray | None = None  # of the cells with submerged points of each pool
    stays: BoolArray | None = None  # whether a pool counts as water
    joined: BoolArray | None = None  # (rows, columns), a pool of water is in or next to the cell


class Grid:
    """Points per cell, added chunk by chunk.

    It is made with the south-west and north-east corner of the cloud, metres, shape (2,). If these
    turn out to be wrong, `fits` is False, `low` and `high` are those of the points so far, and the
    points must be added again. Points within the dead band of the surface are undecided.
    """

    def __init__(self, low: FloatArray, high: FloatArray, dead_band_m: float) -> None:
        self.lattice = lattice_over(low, high)
        self.low, self.high = np.full(2, np.inf), np.full(2, -np.inf)
        self._dead_m, self._water_points, self._overflows = dead_band_m, 0, False
        shape = self.lattice.rows, self.lattice.columns
        self._flags: Flags = np.zeros(shape, np.uint8)
        self._votes: IntArray = np.zeros(shape, np.int64)

    def add(self, x: FloatArray, y: FloatArray, height_m: FloatArray, counts: BoolArray) -> None:
        """Add n points with their heights above the water surface, NaN if unknown.

        Points that do not count cannot be submerged; they only show that there is no gap.
        """
        if not x.size:
            return
        self.low = np.minimum(self.low, [x.min(), y.min()])
        self.high = np.maximum(self.high, [x.max(), y.max()])
        row, column = self.lattice.cells(x, y)
        rows, columns = self._flags.shape
        if row.min() < 0 or row.max() >= rows or column.min() < 0 or column.max() >= columns:
            self._overflows = True
            return
        cell = row * self.lattice.columns + column
        counts = counts & ~np.isnan(height_m)
        below = counts & (height_m < -self._dead_m)
        unsure = counts & ~below & (height_m <= self._dead_m) & (self._dead_m > 0.0)
        self._water_points += int(np.count_nonzero(below | unsure))
        bits = PRESENT + BELOW * below + UNDECIDED * unsure
        np.bitwise_or.at(self._flags.reshape(-1), cell, bits.astype(np.uint8))
        if self._dead_m:
            vote = np.clip(height_m[counts] / self._dead_m, -1.0, 1.0)
            vote = np.rint(_VOTE * vote).astype(np.int64)
            np.add.at(self._votes.reshape(-1), cell[counts], vote)

    @property
    def fits(self) -> bool:
        """Whether the points so far would have the same grid."""
        return (
            not self._overflows and lattice_over(self.low, self.high).side_m == self.lattice.side_m
        )

    def surroundings(self, *, connected: bool, least_pool_m2: float | None) -> Surroundings:
        """Coarsen the grid until its cells have enough points, and find the water bodies.

        Water is connected over sides, corners, and gaps of at most two cells.
        """
        from scipy.ndimage import binary_dilation, convolve, label

        lattice, flags, votes = self.lattice, self._flags, self._votes
        while max(flags.shape) > 2:
            water_cells = np.count_nonzero(flags & (BELOW | UNDECIDED))
            if self._water_points >= POINTS_A_CELL * water_cells:
                break
            lattice, flags, votes = _halved(lattice, flags, votes)
        # the votes of a cell and its eight neighbours together
        is_wet = convolve(votes, np.ones((3, 3)), mode="constant") < 0
        if not connected:
            return Surroundings(lattice, is_wet)
        water = (flags & BELOW) > 0
        if self._dead_m:
            water |= ((flags & UNDECIDED) > 0) & is_wet
        found, count = label(water | (binary_dilation(water, _AROUND) & (flags == 0)), _AROUND)
        pool = np.where(water, found, 0).astype(np.int32)
        cells = np.bincount(pool[water], minlength=count + 1)
        area = cells.astype(np.float64) * lattice.side_m**2
        least = SHARE_OF_LARGEST * area.max() if least_pool_m2 is None else least_pool_m2
        stays = (area >= least) | (area == area.max())
        stays[0] = False
        joined = binary_dilation(stays[pool], _AROUND)
        return Surroundings(lattice, is_wet, pool, area, stays, joined)


def _halved(lattice: Lattice, flags: Flags, votes: IntArray) -> tuple[Lattice, Flags, IntArray]:
    """Return the same in cells of twice the side, which begin at even columns and rows."""
    _, column, row, columns, rows = lattice
    for axis, (first, count) in enumerate(((row, rows), (column, columns))):
        pairs = np.maximum(np.arange(-(first % 2), count, 2), 0)
        flags = np.bitwise_or.reduceat(flags, pairs, axis)
        votes = np.add.reduceat(votes, pairs, axis)
    rows, columns = flags.shape
    return Lattice(lattice.side_m * 2.0, column // 2, row // 2, columns, rows), flags, votes

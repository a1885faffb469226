"""Areas in plan: the polygons of a mask, and connected water bodies.

Connected water is found in a grid over the cloud, filled chunk by chunk. All sums are of whole
numbers, so that they do not depend on the order of the points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.cells import CellFrame, Cells, Layer
from pcfix.model import BoolArray, FloatArray


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


SHARE_OF_LARGEST = 0.1
"""Pools of at least this share of the area of the largest water body count as water."""
_VOTE = 1000
_AROUND = np.ones((3, 3), np.bool_)

PRESENT, BELOW, UNDECIDED = 1, 2, 4
"""A cell has points; points below the surface; points within the dead band."""


class Surroundings(NamedTuple):
    """What a grid knows about the cells of points; the rest is None without connected water."""

    frame: CellFrame
    is_wet: BoolArray  # (rows, columns), whether an undecided point in the cell is submerged
    pool: npt.NDArray[np.int32] | None = None  # (rows, columns), 0 for none, else an index below
    area_m2: FloatArray | None = None  # of the cells with submerged points of each pool
    stays: BoolArray | None = None  # whether a pool counts as water
    joined: BoolArray | None = None  # (rows, columns), a pool of water is in or next to the cell


class Grid:
    """Points per cell, added chunk by chunk.

    It is made with the south-west and north-east corner of the cloud, metres, shape (2,), if they
    are known. Points within the dead band of the surface are undecided.
    """

    def __init__(self, low: FloatArray, high: FloatArray, dead_band_m: float) -> None:
        flags = Layer(np.zeros((), np.uint8), np.bitwise_or)
        votes = Layer(np.zeros((), np.int64), np.add)
        self._cells = Cells(low, high, flags, votes)
        self._dead_m, self._water_points = dead_band_m, 0

    def add(self, x: FloatArray, y: FloatArray, height_m: FloatArray, counts: BoolArray) -> None:
        """Add n points with their heights above the water surface, NaN if unknown.

        Points that do not count cannot be submerged; they only show that there is no gap.
        """
        if not x.size:
            return
        self._cells.cover(np.array([x.min(), y.min()]), np.array([x.max(), y.max()]))
        row, column = self._cells.frame.cells(x, y)
        flags, votes = self._cells.values
        cell = row * flags.shape[1] + column
        counts = counts & ~np.isnan(height_m)
        below = counts & (height_m < -self._dead_m)
        unsure = counts & ~below & (height_m <= self._dead_m) & (self._dead_m > 0.0)
        self._water_points += int(np.count_nonzero(below | unsure))
        bits = PRESENT + BELOW * below + UNDECIDED * unsure
        np.bitwise_or.at(flags.reshape(-1), cell, bits.astype(np.uint8))
        if self._dead_m:
            vote = np.clip(height_m[counts] / self._dead_m, -1.0, 1.0)
            vote = np.rint(_VOTE * vote).astype(np.int64)
            np.add.at(votes.reshape(-1), cell[counts], vote)

    def surroundings(self, *, connected: bool, least_pool_m2: float | None) -> Surroundings:
        """Coarsen the grid until its cells have enough points, and find the water bodies.

        Water is connected over sides, corners, and gaps of at most two cells.
        """
        from scipy.ndimage import binary_dilation, convolve, label

        cells = self._cells
        if not cells.values[0].size:  # no points
            cells.cover(np.zeros(2), np.zeros(2))
        cells.coarsen(self._water_points, lambda flags: (flags & (BELOW | UNDECIDED)) > 0)
        frame, (flags, votes) = cells.frame, cells.values
        # the votes of a cell and its eight neighbours together
        is_wet = convolve(votes, np.ones((3, 3)), mode="constant") < 0
        if not connected:
            return Surroundings(frame, is_wet)
        water = (flags & BELOW) > 0
        if self._dead_m:
            water |= ((flags & UNDECIDED) > 0) & is_wet
        found, count = label(water | (binary_dilation(water, _AROUND) & (flags == 0)), _AROUND)
        pool = np.where(water, found, 0).astype(np.int32)
        area = frame.side_m**2 * np.bincount(pool[water], minlength=count + 1).astype(np.float64)
        least = SHARE_OF_LARGEST * area.max() if least_pool_m2 is None else least_pool_m2
        stays = (area >= least) | (area == area.max())
        stays[0] = False
        joined = binary_dilation(stays[pool], _AROUND)
        return Surroundings(frame, is_wet, pool, area, stays, joined)

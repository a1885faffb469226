"""Areas in plan: the polygons of a mask, and connected water bodies.

Connected water is found in a grid over the cloud, filled chunk by chunk. All sums are of whole
numbers, so that they do not depend on the order of the points.
"""

from __future__ import annotations

from collections.abc import Iterable
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


def surroundings_of(
    parts: Iterable[tuple[FloatArray, FloatArray, FloatArray, BoolArray]],
    low: FloatArray,
    high: FloatArray,
    dead_m: float,
    *,
    connected: bool,
    least_pool_m2: float | None,
) -> Surroundings:
    """Collect points in cells, coarsen these until they have enough points, and find the water.

    Parts have x, y and height above the water surface of their points, (n,), NaN if unknown, and
    which of them count; the others cannot be submerged, and only show that there is no gap. Points
    within `dead_m` of the surface are undecided. `low` and `high` are the corners of the cloud,
    metres, shape (2,), if they are known. Water is connected over sides, corners, and gaps of at
    most two cells.
    """
    from scipy.ndimage import binary_dilation, convolve, label

    none = Layer(np.zeros((), np.uint8), np.bitwise_or), Layer(np.zeros((), np.int64), np.add)
    cells, water_points = Cells(low, high, *none), 0
    for x, y, height_m, counts in parts:
        if not x.size:
            continue
        cells.cover(np.array([x.min(), y.min()]), np.array([x.max(), y.max()]))
        row, column = cells.frame.cells(x, y)
        flags, votes = cells.values
        cell = row * flags.shape[1] + column
        counts = counts & ~np.isnan(height_m)
        below = counts & (height_m < -dead_m)
        unsure = counts & ~below & (height_m <= dead_m) & (dead_m > 0.0)
        water_points += int(np.count_nonzero(below | unsure))
        bits = PRESENT + BELOW * below + UNDECIDED * unsure
        np.bitwise_or.at(flags.reshape(-1), cell, bits.astype(np.uint8))
        if dead_m:
            vote = np.rint(_VOTE * np.clip(height_m[counts] / dead_m, -1.0, 1.0))
            np.add.at(votes.reshape(-1), cell[counts], vote.astype(np.int64))
    if not cells.values[0].size:  # no points
        cells.cover(np.zeros(2), np.zeros(2))
    cells.coarsen(water_points, lambda flags: (flags & (BELOW | UNDECIDED)) > 0)
    frame, (flags, votes) = cells.frame, cells.values
    # the votes of a cell and its eight neighbours together
    is_wet = convolve(votes, np.ones((3, 3)), mode="constant") < 0
    if not connected:
        return Surroundings(frame, is_wet)
    water = (flags & BELOW) > 0
    if dead_m:
        water |= ((flags & UNDECIDED) > 0) & is_wet
    found, count = label(water | (binary_dilation(water, _AROUND) & (flags == 0)), _AROUND)
    pool = np.where(water, found, 0).astype(np.int32)
    area = frame.side_m**2 * np.bincount(pool[water], minlength=count + 1).astype(np.float64)
    least = SHARE_OF_LARGEST * area.max() if least_pool_m2 is None else least_pool_m2
    stays = (area >= least) | (area == area.max())
    stays[0] = False
    joined = binary_dilation(stays[pool], _AROUND)
    return Surroundings(frame, is_wet, pool, area, stays, joined)

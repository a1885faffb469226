"""A cloud in square tiles, so that only a few of them need be in memory."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy.typing as npt

    from pcfix.model import BoolArray, FloatArray, IntArray

POINTS_PER_TILE = 250_000
BLOCK_ROWS = 1_000_000
"""Rows looked at together; sums are made by these blocks, whatever the tiles."""
_MOST_TILES_A_SIDE = 300
_SAMPLE = 100_000


class Empty(Protocol):
    """`numpy.empty`, or a maker of arrays on disk."""

    def __call__(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """Return an array whose values are not set."""
        ...


def in_memory(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return an array in memory: the usual `Empty`."""
    return np.empty(shape, dtype)


@dataclass(frozen=True, eq=False)
class Tiles:
    """The m used points of a cloud, tile by tile; the points of a tile keep their order.

    Attributes
    ----------
    xyz : array, shape (m, 3)
        Metres, world frame.
    row : array, shape (m,)
        Where each point stands in the cloud.
    start : array, shape (t + 1,)
        Tile i holds the places ``start[i]`` to ``start[i + 1]``. No tile is empty.
    low, high : array, shape (t, 3)
        The smallest box about the points of each tile.
    """

    xyz: FloatArray
    row: IntArray
    start: IntArray
    low: FloatArray
    high: FloatArray

    def __len__(self) -> int:
        return len(self.start) - 1

    def pieces(self, size: int) -> Iterator[slice]:
        """Yield all places, at most `size` at a time and of one tile."""
        for first, last in pairwise(self.start):
            for begin in range(int(first), int(last), size):
                yield slice(begin, min(begin + size, int(last)))


def used_rows(used: BoolArray) -> Iterator[IntArray]:
    """Yield the rows that are used, block by block."""
    for first in range(0, len(used), BLOCK_ROWS):
        yield first + np.flatnonzero(used[first : first + BLOCK_ROWS])


def make_tiles(
    xyz: FloatArray, used: BoolArray, tile_m: float | None = None, empty: Empty = in_memory
) -> Tiles:
    """Sort the used points into square tiles.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Metres, world frame.
    used : array of bool, shape (n,)
        At least one is true.
    tile_m : float, optional
        Side of a tile; default such that a tile holds about `POINTS_PER_TILE` points.
    empty : callable
        Makes the arrays.
    """
    lattice = _Lattice.over(xyz, used, tile_m)
    counts = np.zeros(lattice.columns * lattice.rows, np.int64)
    for rows in used_rows(used):
        counts += np.bincount(lattice.tile_of(xyz[rows]), minlength=len(counts))
    place = np.cumsum(counts) - counts
    start = np.append(place[counts > 0], counts.sum())
    sorted_xyz, row = empty((int(start[-1]), 3), np.float64), empty((int(start[-1]),), np.int64)
    for rows in used_rows(used):
        points = xyz[rows]
        tile = lattice.tile_of(points)
        order = np.argsort(tile, kind="stable")
        tile = tile[order]
        to = place[tile] + np.arange(len(tile)) - np.searchsorted(tile, tile)
        sorted_xyz[to], row[to] = points[order], rows[order]
        place += np.bincount(tile, minlength=len(place))
    parts = [sorted_xyz[a:b] for a, b in pairwise(start)]
    low, high = (np.array([f(p, axis=0) for p in parts]) for f in (np.min, np.max))
    return Tiles(sorted_xyz, row, start, low, high)


@dataclass(frozen=True)
class _Lattice:
    """Where the tiles lie; points beyond its edges belong to the tile at the edge."""

    origin: FloatArray
    side_m: float
    columns: int
    rows: int

    @classmethod
    def over(cls, xyz: FloatArray, used: BoolArray, tile_m: float | None) -> _Lattice:
        """Cover all but the outermost hundredth of the points, so that no outlier stretches it."""
        step = max(1, len(used) // _SAMPLE)
        sample = xyz[::step][used[::step]]
        if not len(sample):
            sample = np.array(xyz[int(np.argmax(used))])[None, :]
        low, high = np.percentile(sample[:, :2], (1.0, 99.0), axis=0)
        extent = np.maximum(high - low, 1e-3)
        share = POINTS_PER_TILE / int(used.sum())
        side = math.sqrt(float(extent.prod()) * share) if tile_m is None else tile_m
        side = max(side, float(extent.max()) / _MOST_TILES_A_SIDE)
        columns, rows = np.ceil(extent / side).astype(int).tolist()
        return cls(low, side, columns, rows)

    def tile_of(self, xyz: FloatArray) -> IntArray:
        """Return the number of the tile of each point, shape (n,)."""
        cell = np.floor((xyz[:, :2] - self.origin) / self.side_m)
        column, row = np.clip(cell, 0, (self.columns - 1, self.rows - 1)).astype(np.int64).T
        return np.asarray(column * self.rows + row)

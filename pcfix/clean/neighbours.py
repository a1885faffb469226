"""The nearest neighbours of points, exact across the borders of tiles.

A point's neighbours are looked for in its own tile, then in every other tile whose box is nearer
than the farthest neighbour so far; the k nearest of all that were found are kept. So the result is
that of one tree over the whole cloud, however the tiles lie, and an outlier far from everything
costs a few queries, not a tree of everything.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from pcfix.blocks import blocks, bounds, empty, grouped, let_go, mapped, row_numbers
from pcfix.model import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

PIECE_ROWS = 65_536
SLACK = 1.0 + 1e-9
"""Distances nearer to each other than this count as equal: more than rounding, less than any
step of a LAS file at the distance of neighbours."""
_TREES = 16
_SPARE, _MOST_COLUMNS = 8, 1024
_ENTRIES = 4_000_000


class Neighbours:
    """Finds neighbours among the points of tiles.

    Parameters
    ----------
    tiles : Tiles
    axes : {3, 2}
        Distances in space, or in plan.
    jobs : int, optional
        Threads; default all cores.
    """

    def __init__(self, tiles: Tiles, axes: int, jobs: int | None = None) -> None:
        self.tiles, self.axes, self.workers = tiles, axes, -1 if jobs is None else jobs
        self._low, self._high = tiles.low[:, :axes], tiles.high[:, :axes]
        self._tree = _trees(tiles, axes)

    def nearest(self, xyz: FloatArray, k: int) -> tuple[FloatArray, IntArray]:
        """Return the k nearest points of the tiles, which hold at least k.

        Parameters
        ----------
        xyz : array, shape (q, 3)
            Best near to each other.
        k : int

        Returns
        -------
        distance_m : array, shape (q, k)
            Ascending.
        place : array of int, shape (q, k)
            In the arrays of the tiles. Which of equally far points comes first, or comes at all
            where the last are equally far, is not defined.
        """
        points = np.ascontiguousarray(xyz[:, : self.axes])
        distance = np.full((len(points), k), np.inf)
        place = np.zeros((len(points), k), np.int64)
        rest = np.arange(len(points))
        if len(self.tiles) == 1:
            self._add(0, points, rest, distance, place)
            return distance, place
        low, high = bounds(points)
        gaps = _gap(low, high, self._low, self._high)
        middle = (low + high - self._low - self._high) / 2.0
        for tile in np.lexsort((np.hypot(*middle[:, :2].T), gaps)):
            rest = rest[distance[rest, -1] * SLACK >= gaps[tile]]
            if not rest.size:
                break
            rows = rest
            for axis in range(self.axes):  # most lie beyond a side of it, which is quick to see
                at, reach = points[rows, axis], distance[rows, -1] * SLACK
                low, high = self._low[tile, axis], self._high[tile, axis]
                rows = rows[(low - at <= reach) & (at - high <= reach)]
            gap = _gap(points[rows], points[rows], self._low[tile], self._high[tile])
            rows = rows[distance[rows, -1] * SLACK >= gap]
            if rows.size:
                self._add(int(tile), points, rows, distance, place)
        return distance, place

    def _add(
        self, tile: int, points: FloatArray, rows: IntArray, distance: FloatArray, place: IntArray
    ) -> None:
        """Merge the neighbours in one tile into those of the given rows."""
        tree, k = self._tree(tile), distance.shape[1]
        found = tree.query(
            points[rows],
            k=list(range(1, min(k, tree.n) + 1)),
            distance_upper_bound=float(distance[rows, -1].max()) * SLACK,
            workers=self.workers,
        )
        new, where = np.asarray(found[0]), np.asarray(found[1])
        places = where + self.tiles.start[tile]
        if np.isinf(distance[rows, 0]).all():  # nothing to merge with
            distance[rows, : new.shape[1]], place[rows, : new.shape[1]] = new, places
            return
        both, places = np.hstack([distance[rows], new]), np.hstack([place[rows], places])
        order = np.argsort(both, axis=1, kind="stable")[:, :k]
        distance[rows] = np.take_along_axis(both, order, axis=1)
        place[rows] = np.take_along_axis(places, order, axis=1)


def nearest_of(
    places: FloatArray, points: FloatArray, k: int, axes: int
) -> Iterator[tuple[IntArray, FloatArray, FloatArray, FloatArray]]:
    """Yield rows (c,) of places, these, and distances (c, k) and places of their k nearest points.

    Places and points, (n, 2) or (n, 3), are in one frame, metres; there are at least k points. The
    nearest comes first, and of equally far ones the first of the cloud, whatever the tiles.
    """
    near = Neighbours(make_tiles(points), axes)
    asked = make_tiles(places)
    for piece in asked.pieces(PIECE_ROWS):
        xyz = asked.xyz[piece]
        distance, place = _first_nearest(near, xyz, k, k + 1)
        yield asked.row[piece], xyz, distance, near.tiles.xyz[place]


def _first_nearest(
    near: Neighbours, xyz: FloatArray, k: int, columns: int
) -> tuple[FloatArray, IntArray]:
    """Return distance and place of the k nearest, looking at more until all that tie are seen."""
    columns = min(columns, len(near.tiles.row))
    distance, place = near.nearest(xyz, columns)
    tied = np.flatnonzero(distance[:, -1] == distance[:, k - 1])
    order = np.lexsort((near.tiles.row[place], distance), axis=1)[:, :k]
    distance = np.take_along_axis(distance, order, axis=1)
    place = np.take_along_axis(place, order, axis=1)
    if tied.size and columns < min(len(near.tiles.row), _MOST_COLUMNS):
        size = max(1, _ENTRIES // (2 * columns))
        for rows in (tied[a : a + size] for a in range(0, len(tied), size)):
            distance[rows], place[rows] = _first_nearest(near, xyz[rows], k, 2 * columns)
    return distance, place


def nearest_distance(places: FloatArray, points: FloatArray, axes: int) -> FloatArray:
    """Return the distance (m) of each place, (n,), to the nearest point; see `nearest_of`."""
    near, asked = Neighbours(make_tiles(points), axes), make_tiles(places)
    distance = empty((len(places),))
    for piece in asked.pieces(PIECE_ROWS):
        distance[asked.row[piece]] = near.nearest(asked.xyz[piece], 1)[0][:, 0]
    return distance


def _trees(tiles: Tiles, axes: int) -> Callable[[int], cKDTree]:
    """Return what grows the tree of a tile, and keeps the last few."""

    @lru_cache(maxsize=_TREES)
    def tree(tile: int) -> cKDTree:
        from scipy.spatial import cKDTree  # not quick to load, and C2C seldom needs it

        first, last = tiles.start[tile : tile + 2]
        return cKDTree(np.array(tiles.xyz[first:last, :axes]), balanced_tree=False)

    return tree


def _gap(
    low: FloatArray, high: FloatArray, other_low: FloatArray, other_high: FloatArray
) -> FloatArray:
    """Return the distance between boxes, zero where they touch; the last axis is x, y(, z)."""
    apart = np.maximum(np.maximum(other_low - high, low - other_high), 0.0)
    return np.asarray(np.sqrt((apart * apart).sum(axis=-1)))


def mean_of_first(distance: FloatArray, k: int) -> FloatArray:
    """Return the mean of the first k columns, shape (q,), summed from the left."""
    total = np.zeros(len(distance))
    for column in range(k):
        total += distance[:, column]
    return total / k


def height_quartiles(
    neighbours: Neighbours, xyz: FloatArray, k: int, columns: int | None = None
) -> FloatArray:
    """Return the lower and upper quartile of the neighbours' heights, shape (q, 2), metres.

    The neighbours are the k nearest in plan and all that are as far as the last of them, so that
    the result does not depend on the order of the points. (Where more than a thousand are equally
    far, any thousand of them.)

    Parameters
    ----------
    neighbours : Neighbours
        With two axes.
    xyz : array, shape (q, 3)
        Metres, world frame.
    k : int
    columns : int, optional
        How many to look at; grows until all that are equally far are among them.
    """
    count = len(neighbours.tiles.row)
    columns = min(columns or k + _SPARE, count)
    distance, place = neighbours.nearest(xyz, columns)
    near = distance <= distance[:, k - 1 : k] * SLACK
    heights = np.where(near, neighbours.tiles.xyz[:, 2][place], np.inf)
    quartiles = _quartiles(np.sort(heights, axis=1), near.sum(axis=1))
    if columns < min(count, _MOST_COLUMNS):
        tied = np.flatnonzero(near[:, -1])
        size = max(1, _ENTRIES // (2 * columns))
        for first in range(0, len(tied), size):
            rows = tied[first : first + size]
            quartiles[rows] = height_quartiles(neighbours, xyz[rows], k, 2 * columns)
    return quartiles


def _quartiles(ascending: FloatArray, count: IntArray) -> FloatArray:
    """Return the quartiles of the first `count` entries of each row, between two of them linear."""
    position = (count[:, None] - 1) * np.array([0.25, 0.75])
    left = np.floor(position).astype(np.int64)
    right = np.minimum(left + 1, count[:, None] - 1)
    a, b = (np.take_along_axis(ascending, at, axis=1) for at in (left, right))
    return np.asarray(a + (position - left) * (b - a))


POINTS_PER_TILE = 250_000
_MOST_TILES_A_SIDE = 200
_SAMPLE = 100_000
_SPACINGS_ACROSS = 8


@dataclass(frozen=True, eq=False)
class Tiles:
    """The m used points of a cloud, tile by tile, neighbours in a tile near to each other.

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
                let_go()

    def within(self, low: FloatArray, high: FloatArray) -> IntArray:
        """Return the places of the points in a box, (3,) each, those of the cloud's order."""
        touched = np.flatnonzero(((self.low <= high) & (self.high >= low)).all(axis=1))
        found = [np.empty(0, np.int64)]
        for first, last in ((int(self.start[i]), int(self.start[i + 1])) for i in touched):
            some = self.xyz[first:last]
            found.append(first + np.flatnonzero(((some >= low) & (some <= high)).all(axis=1)))
        places = np.concatenate(found)
        return np.asarray(places[np.argsort(self.row[places])])


def used_rows(used: BoolArray) -> Iterator[IntArray]:
    """Yield the rows that are used, block by block."""
    for rows in blocks(len(used)):
        yield rows.start + np.flatnonzero(used[rows])


def make_tiles(
    xyz: FloatArray,
    used: BoolArray | None = None,
    tile_m: float | None = None,
    points: int = POINTS_PER_TILE,
    *,
    strips: bool = True,
) -> Tiles:
    """Sort the used points into square tiles.

    Parameters
    ----------
    xyz : array, shape (n, 3), or (n, 2) in plan
        Metres, world frame.
    used : array of bool, shape (n,), optional
        At least one is true; default all.
    tile_m : float, optional
        Side of a tile; default such that a tile holds about so many `points`.
    strips : bool
        Whether the points of a tile are put in an order that trees are quick in.
    """
    lattice = _Lattice(xyz, used, tile_m, points)
    tiles = lattice.columns * lattice.rows
    number = mapped(lattice.tile_of, xyz)
    if used is not None:
        number[~used] = tiles
    start, (sorted_xyz, row) = grouped(number, tiles + 1, xyz, row_numbers(len(xyz)))
    start = np.unique(start[:-1])
    boxes = []
    for a, b in pairwise(start):
        if strips:
            order = _along_strips(sorted_xyz[a:b], lattice.side_m)
            sorted_xyz[a:b], row[a:b] = sorted_xyz[a:b][order], row[a:b][order]
        boxes.append(bounds(sorted_xyz[a:b]))
        let_go()
    low, high = np.swapaxes(np.array(boxes), 0, 1)
    return Tiles(sorted_xyz[: start[-1]], row[: start[-1]], start, low, high)


def one_tile(xyz: FloatArray) -> Tiles:
    """Return the points of a cloud, (n, 3), as they are, as a single tile."""
    low, high = bounds(xyz)
    return Tiles(xyz, row_numbers(len(xyz)), np.array([0, len(xyz)]), low[None], high[None])


def _along_strips(xyz: FloatArray, side_m: float) -> IntArray:
    """Return the rows of a tile's points along narrow strips of the plan.

    A tree is asked twice as fast in this order as in a random one: each point finds in the
    processor's cache what its predecessor needed.
    """
    strip = np.floor(xyz[:, 1] * (math.sqrt(len(xyz)) / (_SPACINGS_ACROSS * side_m)))
    return np.lexsort((xyz[:, 0], strip))


class _Lattice:
    """Where the tiles lie; points beyond its edges belong to the tile at the edge.

    It covers all but the outermost hundredth of the points, so that no outlier stretches it.
    """

    def __init__(
        self, xyz: FloatArray, used: BoolArray | None, tile_m: float | None, points: int
    ) -> None:
        step = max(1, len(xyz) // _SAMPLE)
        sample = xyz[::step] if used is None else xyz[::step][used[::step]]
        if used is not None and not len(sample):
            sample = np.array(xyz[int(np.argmax(used))])[None, :]
        self.origin, high = np.percentile(sample[:, :2], (1.0, 99.0), axis=0)
        extent = np.maximum(high - self.origin, 1e-3)
        share = points / (len(xyz) if used is None else int(used.sum()))
        side = math.sqrt(float(extent.prod()) * share) if tile_m is None else tile_m
        self.side_m = max(side, float(extent.max()) / _MOST_TILES_A_SIDE)
        self.columns, self.rows = np.ceil(extent / self.side_m).astype(int).tolist()

    def tile_of(self, xyz: FloatArray) -> IntArray:
        """Return the number of the tile of each point, shape (n,)."""
        cell = np.floor((xyz[:, :2] - self.origin) / self.side_m)
        column, row = np.clip(cell, 0, (self.columns - 1, self.rows - 1)).astype(np.uint16).T
        return np.asarray(column * np.uint16(self.rows) + row)

"""The nearest neighbour by a grid of columns: for clouds that are surfaces, seen from above.

The plan is cut into square cells of a few points each, and each cell knows how low and how high
its points lie. A search walks outwards over rings of cells, passes over cells that lie farther
than the best point so far, and ends when the next ring does. It is quick where two clouds are
close together, and gives up where a neighbour is many rings away.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, in_tiles, kernel, lean, lean_kernel
from pcfix.model import FloatArray, IntArray

POINTS_PER_CELL = 3.0
MAX_CELLS = 20_000_000
MAX_RINGS = 10
"""How many rings a search walks before it gives up."""


class Cells(NamedTuple):
    """Points by cell; the points of cell i are ``points[start[i]:start[i + 1]]``."""

    low: FloatArray  # (2,), the corner of the first cell
    side_m: float
    columns: int
    rows: int
    start: IntArray
    points: FloatArray  # (m, 3), in the order of the cells
    z_range: FloatArray  # (cells, 2)


def build_cells(points: FloatArray) -> Cells:
    """Sort points (m, 3), metres, into cells."""
    low, extent, side = _lattice(points)
    columns, rows = (int(n) + 1 for n in extent / side)
    start, order = sorted_by_cell(cell_of(points, low, side, columns, rows), columns * rows)
    arranged = np.empty((len(order), 3))
    in_tiles(_gather, len(order), points, order, arranged)
    return Cells(low, side, columns, rows, start, arranged, _z_range(start, arranged))


def _lattice(points: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return the corner and the extent of points, and the side of their cells."""
    low = np.array([points[:, 0].min(), points[:, 1].min()])
    extent = np.array([points[:, 0].max(), points[:, 1].max()]) - low
    side = _side(extent, len(points) / POINTS_PER_CELL)
    columns, rows = (int(n) + 1 for n in extent / side)
    taken = np.count_nonzero(np.bincount(cell_of(points, low, side, columns, rows)))
    # a cloud that fills little of its bounding box gets smaller cells
    side = max(side * np.sqrt(taken * POINTS_PER_CELL / len(points)), _side(extent, MAX_CELLS))
    return low, extent, float(side)


def spacing_m(points: FloatArray) -> float:
    """Return the side of the square that each point (n, 3) has, where there are points, metres."""
    return _lattice(points)[2] / math.sqrt(POINTS_PER_CELL)


def _side(extent: FloatArray, cells: float) -> float:
    """Return the side of so many squares over a rectangle, or along it where it is narrow."""
    area, length = float(extent.prod()), float(extent.max())
    return max(float(np.sqrt(area / cells)), length / cells, length * 1e-6, 1e-9)


@kernel
def cell_of(
    points: FloatArray, low: FloatArray, side_m: float, columns: int, rows: int
) -> IntArray:
    """Return the number of each point's cell, or of the nearest cell to a point outside."""
    cell = np.empty(len(points), np.int64)
    for i in range(len(points)):
        u = min(max((points[i, 0] - low[0]) / side_m, 0.0), columns - 1.0)
        v = min(max((points[i, 1] - low[1]) / side_m, 0.0), rows - 1.0)
        cell[i] = int(v) * columns + int(u)
    return cell


@kernel
def sorted_by_cell(cell: IntArray, count: int) -> tuple[IntArray, IntArray]:
    """Return where each cell starts, and the rows in the order of their cells."""
    start = np.zeros(count + 1, np.int64)
    for i in range(len(cell)):
        start[cell[i] + 1] += 1
    for k in range(count):
        start[k + 1] += start[k]
    place = start[:-1].copy()
    order = np.empty(len(cell), np.int64)
    for i in range(len(cell)):
        order[place[cell[i]]] = i
        place[cell[i]] += 1
    return start, order


@lean_kernel
def _gather(span: Span, points: FloatArray, order: IntArray, arranged: FloatArray) -> None:
    """Set ``points[order]``, with all cores: the jumps through memory are what takes time."""
    for i in range(*span):
        for axis in range(3):
            arranged[i, axis] = points[order[i], axis]


@kernel
def _z_range(start: IntArray, points: FloatArray) -> FloatArray:
    """Return lowest and highest Z of each cell; of an empty one, infinitely far apart."""
    z_range = np.empty((len(start) - 1, 2))
    z_range[:, 0], z_range[:, 1] = np.inf, -np.inf
    for k in range(len(start) - 1):
        for i in range(start[k], start[k + 1]):
            z_range[k, 0] = min(z_range[k, 0], points[i, 2])
            z_range[k, 1] = max(z_range[k, 1], points[i, 2])
    return z_range


@lean
def _gap(x: float, cell: int, side_m: float) -> float:
    """Return how far x lies outside the cell, along one axis."""
    return max(cell * side_m - x, x - (cell + 1) * side_m, 0.0)


@lean
def _best_in_cell(
    grid: Cells, column: int, row: int, x: float, y: float, z: float, best: float
) -> float:
    """Return the least squared distance to the points of a cell, or `best` where that is less."""
    cell = row * grid.columns + column
    dx, dy = _gap(x, column, grid.side_m), _gap(y, row, grid.side_m)
    dz = max(grid.z_range[cell, 0] - z, z - grid.z_range[cell, 1], 0.0)
    if dx * dx + dy * dy + dz * dz >= best:
        return best
    for i in range(grid.start[cell], grid.start[cell + 1]):
        u = grid.points[i, 0] - grid.low[0] - x
        v = grid.points[i, 1] - grid.low[1] - y
        w = grid.points[i, 2] - z
        best = min(best, u * u + v * v + w * w)
    return best


@lean
def _nearest_one(grid: Cells, place: FloatArray) -> float:
    """Return the distance to the nearest point; NaN where it is too many rings away."""
    x, y, z = place[0] - grid.low[0], place[1] - grid.low[1], place[2]
    column = int(min(max(x / grid.side_m, 0.0), grid.columns - 1.0))
    row = int(min(max(y / grid.side_m, 0.0), grid.rows - 1.0))
    best = np.inf
    for ring in range(MAX_RINGS + 1):
        left, right = column - ring, column + ring
        bottom, top = row - ring, row + ring
        for j in range(max(bottom, 0), min(top, grid.rows - 1) + 1):
            if j in (bottom, top):
                for i in range(max(left, 0), min(right, grid.columns - 1) + 1):
                    best = _best_in_cell(grid, i, j, x, y, z, best)
            else:
                if left >= 0:
                    best = _best_in_cell(grid, left, j, x, y, z, best)
                if right < grid.columns:
                    best = _best_in_cell(grid, right, j, x, y, z, best)
        clear = np.inf  # nothing beyond the rings so far is nearer than this
        if left > 0:
            clear = min(clear, x - left * grid.side_m)
        if right < grid.columns - 1:
            clear = min(clear, (right + 1) * grid.side_m - x)
        if bottom > 0:
            clear = min(clear, y - bottom * grid.side_m)
        if top < grid.rows - 1:
            clear = min(clear, (top + 1) * grid.side_m - y)
        if clear > 0.0 and best <= clear * clear:
            return float(np.sqrt(best))
    return float(np.nan)


@lean_kernel
def nearest_distances(
    span: Span, grid: Cells, places: FloatArray, order: IntArray, distance: FloatArray
) -> None:
    """Set the distance of each place (n, 3) to its nearest point.

    NaN where that is more than `MAX_RINGS` cells away. Places are visited in the given order,
    which changes the time and nothing else.
    """
    for k in range(*span):
        distance[order[k]] = _nearest_one(grid, places[order[k]])


CHUNK_POINTS = 200_000
POINTS_ACROSS = 8
"""Width of the strips of `strip_order`, in mean distances between points."""
MAX_STRIPS = 30_000
"""So that the number of a cell fits 32 bits."""


def mean_spacing_m(xy: FloatArray) -> float:
    """Return the side of the square that each point (n, 2) has in the cloud's bounding box, m."""
    extent = np.array([np.ptp(xy[:, 0]), np.ptp(xy[:, 1])])
    if extent.min() <= 0.0:
        return float(extent.max() / len(xy))
    return float(np.sqrt(extent.prod() / len(xy)))


def strip_order(xy: FloatArray) -> IntArray:
    """Return the row numbers of points in the order of a walk along narrow strips of the plan.

    A tree is built and asked several times faster in this order than in a random one, as each
    point, (n, 2) or (n, 3) in metres, finds in the processor's cache what its predecessor needed.
    """
    longest = max(np.ptp(xy[:, 0]), np.ptp(xy[:, 1]))
    width = max(mean_spacing_m(xy[:, :2]) * POINTS_ACROSS, longest / MAX_STRIPS, 1e-9)
    column = ((xy[:, 0] - xy[:, 0].min()) / width).astype(np.int32)
    row = ((xy[:, 1] - xy[:, 1].min()) / width).astype(np.int32)
    backwards = row % 2 == 1
    column[backwards] = column.max() - column[backwards]
    return np.argsort(row * (column.max() + 1) + column, kind="stable")


class Neighbours:
    """The nearest of m points, shape (m, 2) in plan or (m, 3) in space, metres, to any place.

    `row`, shape (m,), has the row in `points` of each number that `find` returns.
    """

    def __init__(self, points: FloatArray) -> None:
        from scipy.spatial import cKDTree  # not quick to load, and C2C seldom needs it

        self.origin = np.floor(points.mean(axis=0))
        self.row = strip_order(points)
        self._tree = cKDTree(points[self.row] - self.origin, balanced_tree=False)

    def find(
        self, places: FloatArray, count: int = 1
    ) -> Iterator[tuple[IntArray, FloatArray, IntArray]]:
        """Yield c row numbers of places, and distance and number of their nearest points.

        Places (n, d) are in the frame of the points. Distances (m) and numbers, into `row`, have
        the shape (c, count), the nearest first; there are at least `count` points.
        """
        order = strip_order(places)
        for start in range(0, len(order), CHUNK_POINTS):
            rows = order[start : start + CHUNK_POINTS]
            found = self._tree.query(
                places[rows] - self.origin, k=np.arange(1, count + 1), workers=-1
            )
            yield rows, np.asarray(found[0]), np.asarray(found[1], np.int64)

    def nearest(self, places: FloatArray) -> tuple[FloatArray, IntArray]:
        """Return distance (m) to the nearest point, and its row, both of shape (n,)."""
        distance, row = np.empty(len(places)), np.empty(len(places), np.int64)
        for rows, far, number in self.find(places):
            distance[rows], row[rows] = far[:, 0], self.row[number[:, 0]]
        return distance, row


def cloud_to_cloud(xyz: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the distance from each point to the nearest point of the reference.

    Both have the shape (n, 3), metres, world frame. The distance has no sign, and is never zero
    where the two clouds sample a surface at different places: half the spacing of the reference is
    its floor. See `vertical` for a signed difference.
    """
    origin = np.floor(reference[0])
    places, grid = xyz - origin, build_cells(reference - origin)
    cell = cell_of(places, grid.low, grid.side_m, grid.columns, grid.rows)
    _, order = sorted_by_cell(cell, grid.columns * grid.rows)
    distance = np.empty(len(places))
    in_tiles(nearest_distances, len(order), grid, places, order, distance)
    far = np.isnan(distance)
    if far.any():
        distance[far], _ = Neighbours(grid.points).nearest(places[far])
    return np.asarray(distance)

"""The nearest neighbour by a grid of columns: for clouds that are surfaces, seen from above.

The plan is cut into square cells of a few points each, and each cell knows how low and how high
its points lie. A search walks outwards over rings of cells, passes over cells that lie farther
than the best point so far, and ends when the next ring does. It is quick where two clouds are
close together, and gives up where a neighbour is many rings away.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from pcfix.blocks import blocks, bounds, empty
from pcfix.clean.neighbours import SLACK, Neighbours, Tiles, make_tiles, one_tile
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
    slack_m: float  # more than rounding


def build_cells(points: FloatArray) -> Cells:
    """Sort points (m, 3), metres, into cells."""
    low, extent, side = _lattice(points)
    columns, rows = (int(n) + 1 for n in extent / side)
    start, order = sorted_by_cell(cell_of(points, low, side, columns, rows), columns * rows)
    arranged = np.empty((len(order), 3))
    in_tiles(_gather, len(order), points, order, arranged)
    slack = 1e-12 * float(extent.max()) + 1e-15 * float(np.abs(low).max() + extent.max())
    return Cells(low, side, columns, rows, start, arranged, _z_range(start, arranged), slack)


def _lattice(points: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return the corner and the extent of points, and the side of their cells."""
    low, high = bounds(points[:, :2])
    extent = high - low
    side = _side(extent, len(points) / POINTS_PER_CELL)
    columns, rows = (int(n) + 1 for n in extent / side)
    taken = np.zeros(columns * rows, np.bool_)
    for some in blocks(len(points)):
        taken[cell_of(points[some], low, side, columns, rows)] = True
    # a cloud that fills little of its bounding box gets smaller cells
    share = np.count_nonzero(taken) * POINTS_PER_CELL / len(points)
    side = max(side * np.sqrt(share), _side(extent, MAX_CELLS))
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
def _gap(x: float, cell: int, grid: Cells) -> float:
    """Return how far x lies outside the cell at least, along one axis."""
    return max(cell * grid.side_m - x, x - (cell + 1) * grid.side_m, grid.slack_m) - grid.slack_m


@lean
def _best_in_cell(grid: Cells, column: int, row: int, place: FloatArray, best: float) -> float:
    """Return the least squared distance to the points of a cell, or `best` where that is less.

    It goes by the coordinates as they came, so that it does not depend on the cells.
    """
    cell = row * grid.columns + column
    x, y, z = place
    dx, dy = _gap(x - grid.low[0], column, grid), _gap(y - grid.low[1], row, grid)
    dz = max(grid.z_range[cell, 0] - z, z - grid.z_range[cell, 1], 0.0)
    if dx * dx + dy * dy + dz * dz >= best:
        return best
    for i in range(grid.start[cell], grid.start[cell + 1]):
        u = grid.points[i, 0] - x
        v = grid.points[i, 1] - y
        w = grid.points[i, 2] - z
        best = min(best, u * u + v * v + w * w)
    return best


@lean
def _nearest_one(grid: Cells, place: FloatArray, best: float) -> float:
    """Return the distance to the nearest point, NaN where it is too many rings away.

    `best` is a squared distance; where nothing is nearer its root is returned.
    """
    x, y = place[0] - grid.low[0], place[1] - grid.low[1]
    column = int(min(max(x / grid.side_m, 0.0), grid.columns - 1.0))
    row = int(min(max(y / grid.side_m, 0.0), grid.rows - 1.0))
    for ring in range(MAX_RINGS + 1):
        left, right = column - ring, column + ring
        bottom, top = row - ring, row + ring
        for j in range(max(bottom, 0), min(top, grid.rows - 1) + 1):
            if j in (bottom, top):
                for i in range(max(left, 0), min(right, grid.columns - 1) + 1):
                    best = _best_in_cell(grid, i, j, place, best)
            else:
                if left >= 0:
                    best = _best_in_cell(grid, left, j, place, best)
                if right < grid.columns:
                    best = _best_in_cell(grid, right, j, place, best)
        clear = np.inf  # nothing beyond the rings so far is nearer than this
        if left > 0:
            clear = min(clear, x - left * grid.side_m)
        if right < grid.columns - 1:
            clear = min(clear, (right + 1) * grid.side_m - x)
        if bottom > 0:
            clear = min(clear, y - bottom * grid.side_m)
        if top < grid.rows - 1:
            clear = min(clear, (top + 1) * grid.side_m - y)
        clear -= grid.slack_m
        if clear > 0.0 and best <= clear * clear:
            return float(np.sqrt(best))
    return float(np.nan)


@lean_kernel
def nearest_distances(
    span: Span, grid: Cells, places: FloatArray, order: IntArray, distance: FloatArray
) -> None:
    """Set the distance of each place (n, 3) to its nearest point where it was larger.

    NaN where that is more than `MAX_RINGS` cells away. Places are visited in the given order,
    which changes the time and nothing else.
    """
    for k in range(*span):
        i = order[k]
        known = distance[i]
        found = _nearest_one(grid, places[i], known * known * SLACK)
        distance[i] = known if found > known else found


TILE_POINTS = 1_000_000
"""Points of a tile of cells; up to twice as many are one tile."""
CELL_TILES = 6
"""Tiles whose cells are kept."""


def mean_spacing_m(xy: FloatArray) -> float:
    """Return the side of the square that each point (n, 2) has in the cloud's bounding box, m."""
    low, high = bounds(xy[:, :2])
    extent = high - low
    if extent.min() <= 0.0:
        return float(extent.max() / len(xy))
    return float(np.sqrt(extent.prod() / len(xy)))


class CellSearch(Neighbours):
    """Finds the distance to the nearest point by cells, and by trees what is far away."""

    def __init__(self, tiles: Tiles) -> None:
        super().__init__(tiles, 3)

        @lru_cache(maxsize=CELL_TILES)
        def cells(tile: int) -> Cells:
            first, last = tiles.start[tile : tile + 2]
            return build_cells(tiles.xyz[first:last])

        self._cells = cells

    def _add(
        self, tile: int, points: FloatArray, rows: IntArray, distance: FloatArray, place: IntArray
    ) -> None:
        grid = self._cells(tile)
        some = points if len(rows) == len(points) else points[rows]
        _, order = sorted_by_cell(
            cell_of(some, grid.low, grid.side_m, grid.columns, grid.rows), grid.columns * grid.rows
        )
        best = distance[rows, 0]
        in_tiles(nearest_distances, len(order), grid, some, order, best)
        far = np.isnan(best)
        distance[rows, 0] = np.where(far, distance[rows, 0], best)
        if far.any():
            super()._add(tile, points, rows[far], distance, place)


def cloud_to_cloud(xyz: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the distance from each point to the nearest point of the reference.

    Both have the shape (n, 3), metres, world frame. The distance has no sign, and is never zero
    where the two clouds sample a surface at different places: half the spacing of the reference is
    its floor. See `vertical` for a signed difference.
    """
    near, asked = CellSearch(_tiles(reference)), _tiles(xyz)
    distance = empty((len(xyz),))
    for piece in asked.pieces(2 * TILE_POINTS):
        found = near.nearest(asked.xyz[piece], 1)[0][:, 0]
        distance[asked.row[piece]] = found
    return distance


def _tiles(xyz: FloatArray) -> Tiles:
    few = len(xyz) <= 2 * TILE_POINTS
    return one_tile(xyz) if few else make_tiles(xyz, points=TILE_POINTS, strips=False)

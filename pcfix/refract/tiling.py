"""Tiles of neighbouring points, and the cameras whose frames may hold one of them.

Kernels process points tile by tile: a tile of neighbours needs few cameras, and inner loops over
its points are vectorised.
"""

from itertools import accumulate

import numpy as np

from pcfix.kernels import device
from pcfix.lens.algebra import Nine, Vector, row_of
from pcfix.lens.imaging import Frames, may_hold
from pcfix.model import FloatArray, IntArray
from pcfix.refract.batch import Batch, Chosen, normal_above

TILE = 128  # points of a tile: its sums (11 numbers a point) stay in the processor's first cache


def tiles_of(batch: Batch) -> int:
    """Return how many tiles of neighbours the points of a batch fill."""
    return (len(batch) + TILE - 1) // TILE


def spatial_order(xyz: FloatArray) -> IntArray:
    """Return an order that brings neighbours together, about `TILE` points to a cell.

    Only speed depends on it: a tile of neighbours needs few cameras.
    """
    if len(xyz) <= TILE:
        return np.arange(len(xyz))
    x, y = xyz[:, 0], xyz[:, 1]
    width, height = max(np.ptp(x), 1e-6), max(np.ptp(y), 1e-6)
    cells = min(len(xyz) / TILE, 2.0**14)
    cell_m = max(np.sqrt(width * height / cells), max(width, height) / cells)
    columns, rows = int(width / cell_m) + 1, int(height / cell_m) + 1
    column = np.minimum(((x - x.min()) * (1.0 / cell_m)).astype(np.int64), columns - 1)
    row = np.minimum(((y - y.min()) * (1.0 / cell_m)).astype(np.int64), rows - 1)
    # row after row to and fro, so that the next cell is always a neighbour
    within = np.where(row & 1, columns - 1 - column, column)
    # there are fewer than 2^16 cells, and numpy sorts numbers of 16 bits in two passes
    return np.argsort((row * columns + within).astype(np.uint16), kind="stable")


@device
def are_same(a: IntArray, b: IntArray) -> bool:
    """Whether two lists of cameras are the same."""
    same = a.size == b.size
    for j in range(min(a.size, b.size)):
        same = same and a[j] == b[j]
    return same


@device(allocates=True)
def gather(tile: FloatArray, rows: IntArray, points: Chosen) -> tuple[FloatArray, FloatArray]:
    """Fill a tile with runs of x, y, z, surface height and unit normal; return its box.

    The runs, of `TILE` numbers each, lie in one array: with one base address and fixed distances
    the compiler sees that they cannot overlap.
    """
    for j in range(rows.size):
        i = rows[j]
        put(tile, j, row_of(points.xyz, i))
        tile[3 * TILE + j] = points.height[i]
        put(tile, 4 * TILE + j, normal_above(points, i))
    return corners_of(rows, points.xyz)


@device
def gather_three(runs: FloatArray, rows: IntArray, values: FloatArray) -> None:
    """Fill three runs with the rows of an array of three columns."""
    for j in range(rows.size):
        put(runs, j, row_of(values, rows[j]))


def slots(*widths: int) -> tuple[int, ...]:
    """Return the first slot of quantities with these numbers of values, and the total."""
    return (0, *accumulate(widths))


@device(forceinline=True)
def three(runs: FloatArray, at: int) -> Vector:
    """Return the numbers of a point from three runs that follow each other."""
    return runs[at], runs[at + TILE], runs[at + 2 * TILE]


@device(forceinline=True)
def put(runs: FloatArray, at: int, a: Vector) -> None:
    """Write the numbers of a point into three runs that follow each other."""
    runs[at], runs[at + TILE], runs[at + 2 * TILE] = a


@device(forceinline=True)
def add_three(runs: FloatArray, at: int, c: float, a: Vector) -> None:
    """Add c a to the numbers of a point in three runs that follow each other."""
    runs[at] += c * a[0]
    runs[at + TILE] += c * a[1]
    runs[at + 2 * TILE] += c * a[2]


@device(forceinline=True)
def nine(runs: FloatArray, at: int) -> Nine:
    """Return the numbers of a point from nine runs that follow each other."""
    a, b, c = three(runs, at), three(runs, at + 3 * TILE), three(runs, at + 6 * TILE)
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@device(allocates=True)
def corners_of(rows: IntArray, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the corners of an upright box around some points."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in rows:
        for axis in range(3):
            value = xyz[i, axis]
            low[axis], high[axis] = min(low[axis], value), max(high[axis], value)
    return low, high


@device(allocates=True)
def near_cameras(
    around: IntArray, frames: Frames, centres: FloatArray, low: FloatArray, high: FloatArray
) -> IntArray:
    """Return those of some cameras whose frames may hold a point of an upright box."""
    near = np.empty(len(around), np.int64)
    count = 0
    for c in around:
        if may_hold(frames, c, centres[c], low, high):
            near[count] = c
            count += 1
    return near[:count]


@device(allocates=True)
def marks_of_lists(
    start: IntArray, camera: IntArray, rows: IntArray, k: int
) -> tuple[IntArray, FloatArray]:
    """Return the cameras that view lists name for some points, in order, and how often for each.

    Of k cameras; the marks have a row for each camera returned and a column for each point.
    """
    place, named, count = np.zeros(k, np.int64), np.empty(k, np.int64), 0
    # mark the cameras that are named at all, then number them in order
    for i in rows:
        for at in range(start[i], start[i + 1]):
            place[camera[at]] = 1
    for c in range(k):
        if place[c]:
            place[c], named[count] = count, c
            count += 1
    marks = np.zeros((count, rows.size))
    for j in range(rows.size):
        for at in range(start[rows[j]], start[rows[j] + 1]):
            marks[place[camera[at]], j] += 1.0
    return named[:count], marks


@device(forceinline=True)
def product_of(m: Nine, x: Vector) -> Vector:
    """Return a matrix times a vector."""
    return (
        m[0] * x[0] + m[1] * x[1] + m[2] * x[2],
        m[3] * x[0] + m[4] * x[1] + m[5] * x[2],
        m[6] * x[0] + m[7] * x[1] + m[8] * x[2],
    )


@device(forceinline=True)
def inverse_of(m: Nine) -> tuple[float, Nine]:
    """Return the determinant of a matrix and its inverse, meaningless if that is 0."""
    a, b, c, d, e, f, g, h, i = m
    # cofactors of the first row
    x, y, z = e * i - f * h, f * g - d * i, d * h - e * g
    det = a * x + b * y + c * z
    inv = 1.0 / det
    return det, (
        inv * x, inv * (c * h - b * i), inv * (b * f - c * e),
        inv * y, inv * (a * i - c * g), inv * (c * d - a * f),
        inv * z, inv * (b * g - a * h), inv * (a * e - b * d),
    )  # fmt: skip

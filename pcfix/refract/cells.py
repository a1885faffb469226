"""Cells of neighbouring points, in which smooth functions are replaced by polynomials.

Each cell has a box in x, y and the height over the water, which is a plane above the cell. The
coordinates in the box go from -1 to 1.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from pcfix.kernels import device
from pcfix.lens.algebra import Vector, normal_of, row_of
from pcfix.model import FloatArray, IntArray, WaterMesh, WaterRaster
from pcfix.refract.batch import Batch, Chosen, Survey
from pcfix.refract.tiling import TILE

CELLS_A_HEIGHT = 8.0
LEAST_LENGTH_M = 1e-3
SAME_PLANE = 1e-6
"""Metres of height, and of slope."""


class Box(NamedTuple):
    """The box of a cell, for kernels.

    Attributes
    ----------
    middle, half : array, shape (3,)
        In x, y and the height over the water, metres.
    scale : array, shape (3,)
        One by `half`.
    water : array, shape (3,)
        Height of the water over the middle, world frame, and its slope.
    """

    middle: FloatArray
    half: FloatArray
    scale: FloatArray
    water: FloatArray


def _basis_of(x: FloatArray) -> FloatArray:
    """Return the powers of coordinates, shape (n, 3), one column for each term."""
    u, v, w = x.T
    uu, uv, vv, ww = u * u, u * v, v * v, w * w
    return np.column_stack(
        [np.ones(len(x)), u, v, w, uu, uv, u * w, vv, v * w, ww,
         uu * u, uu * v, uu * w, uv * v, uv * w, u * ww, vv * v, vv * w, v * ww]
    )  # fmt: skip


def _fit_at(basis: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.pinv(basis), np.float64)


QUADRATIC, CUBIC = 10, 19
"""Terms of polynomials; the cubic one has no w^3, as the height varies least."""

# Chebyshev nodes: polynomials through these are off most at the corners, where this is tested.
_FOUR, _THREE = np.cos(np.pi / 8.0 * np.arange(1, 8, 2)), np.sqrt(0.75) * np.arange(-1.0, 2.0)
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
NODES = np.vstack([np.array(list(product(_FOUR, _FOUR, _THREE))), _CORNERS])
INSIDE, AT_CORNERS = len(NODES) - len(_CORNERS), len(_CORNERS)
BASIS = _basis_of(NODES)
FIT_CUBIC = _fit_at(BASIS[:INSIDE])
FIT_QUADRATIC = _fit_at(BASIS[:INSIDE, :QUADRATIC])
SOME = np.concatenate([np.arange(0, INSIDE, 5), np.arange(INSIDE, len(NODES))])
FIT_SOME = _fit_at(BASIS[SOME, :QUADRATIC])


def is_bent(survey: Survey) -> bool:
    """Whether the rays of a point may pierce the water under different slopes."""
    return isinstance(survey.water, WaterMesh | WaterRaster) or survey.own_water is not None


def is_quick(batch: Batch) -> bool:
    """Whether polynomials may replace the exact functions."""
    return not (batch.survey.settings.exact or is_bent(batch.survey))


def cells_of(batch: Batch) -> tuple[IntArray, IntArray]:
    """Return the order of the points cell by cell, and the first of each cell.

    Within a cell, points with the same cameras follow each other.
    """
    if not len(batch):
        return np.zeros(0, np.int64), np.zeros(1, np.int64)
    cell = np.floor(batch.xyz[:, :2] / _size_of(batch)).astype(np.int64)
    cell -= cell.min(axis=0)
    key = cell[:, 1] * (cell[:, 0].max() + 1) + cell[:, 0]
    # a random number stands for each camera, so that a sum stands for a list of cameras
    names = np.random.default_rng(0).integers(2**40, size=len(batch.survey.cameras))
    total = np.concatenate([[0], np.cumsum(names[batch.rays.camera])])
    order = np.lexsort((np.diff(total[batch.rays.start]), key))
    new = np.flatnonzero(np.diff(key[order])) + 1
    return order, np.concatenate([[0], new, [len(order)]])


def _size_of(batch: Batch) -> float:
    """Return the side of the cells, metres: a power of two, so that other chunks have the same."""
    height = np.median(batch.survey.cameras.centres[:, 2]) - np.median(batch.surface.height_m)
    return float(2.0 ** np.rint(np.log2(max(height, LEAST_LENGTH_M) / CELLS_A_HEIGHT)))


def neighbours_in_cells(batch: Batch) -> tuple[IntArray, IntArray]:
    """Return the order of the points cell by cell, and the first of each cell.

    Within a cell the points come quarter by quarter of its side, to and fro.
    """
    if not len(batch):
        return np.zeros(0, np.int64), np.zeros(1, np.int64)
    x, y = np.floor(batch.xyz[:, :2].T * (_QUARTERS / _size_of(batch))).astype(np.int64)
    x, y = (quarter - quarter.min() // _QUARTERS * _QUARTERS for quarter in (x, y))
    column, row = x % _QUARTERS, y % _QUARTERS
    within = _QUARTERS * row + np.where(row & 1, _QUARTERS - 1 - column, column)
    cell = y // _QUARTERS * (x.max() // _QUARTERS + 1) + x // _QUARTERS
    order = np.argsort(cell * _QUARTERS**2 + within, kind="stable")
    new = np.flatnonzero(np.diff(cell[order])) + 1
    return order, np.concatenate([[0], new, [len(order)]])


_QUARTERS = 4


@device(allocates=True)
def cameras_of(points: Chosen, i: int) -> IntArray:
    """Return the cameras of a point."""
    return points.camera[points.start[i] : points.start[i + 1]]


@device
def are_same(a: IntArray, b: IntArray) -> bool:
    """Whether two lists of cameras are the same."""
    same = a.size == b.size
    for j in range(min(a.size, b.size)):
        same = same and a[j] == b[j]
    return same


@device(allocates=True)
def counts_of(rows: IntArray, points: Chosen) -> IntArray:
    """Return how many of some points each camera sees, by their lists."""
    seen = np.zeros(len(points.centres), np.int64)
    for i in rows:
        for c in cameras_of(points, i):
            seen[c] += 1
    return seen


@device(allocates=True)
def no_box() -> Box:
    """Return a box that nothing is in."""
    return Box(np.zeros(3), np.ones(3), np.ones(3), np.zeros(3))


@device(allocates=True)
def box_of(rows: IntArray, points: Chosen) -> Box:
    """Return the box of some points; the water is that of the first of them."""
    i, low, high = rows[0], np.full(3, np.inf), np.full(3, -np.inf)
    # the plane of the water is a + b x + c y
    b, c = points.slope[i, 0], points.slope[i, 1]
    a = points.height[i] - b * points.xyz[i, 0] - c * points.xyz[i, 1]
    for j in rows:
        # the third axis is the height over the water
        x, y, z = row_of(points.xyz, j)
        at = x, y, z - (a + b * x + c * y)
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], at[axis]), max(high[axis], at[axis])
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), LEAST_LENGTH_M)
    return Box(middle, half, 1.0 / half, np.array([a + b * middle[0] + c * middle[1], b, c]))


@device
def water_at(box: Box, x: float, y: float) -> float:
    """Return the height of the water at a place."""
    return box.water[0] + box.water[1] * (x - box.middle[0]) + box.water[2] * (y - box.middle[1])


@device(allocates=True)
def nodes_of(box: Box, points: Chosen) -> Chosen:
    """Return the nodes of a box as points."""
    # from coordinates of -1 to 1 to the world
    xyz, height = box.middle + box.half * NODES, np.empty(len(NODES))
    slope, normals = np.empty((len(NODES), 2)), np.empty((len(NODES), 3))
    for k in range(len(NODES)):
        slope[k, 0], slope[k, 1] = box.water[1], box.water[2]
        height[k] = water_at(box, xyz[k, 0], xyz[k, 1])
        xyz[k, 2] += height[k]
        normals[k, 0], normals[k, 1], normals[k, 2] = normal_of(box.water[1], box.water[2])
    return Chosen(
        xyz, xyz, height, slope, normals, points.centres, points.offset, points.start,
        points.camera, points.n,
    )  # fmt: skip


@device
def is_under(points: Chosen, i: int, box: Box) -> bool:
    """Whether the water over a point is the plane of the cell."""
    off = points.height[i] - water_at(box, points.xyz[i, 0], points.xyz[i, 1])
    b, c = points.slope[i, 0] - box.water[1], points.slope[i, 1] - box.water[2]
    return bool(max(abs(off), max(abs(b), abs(c))) <= SAME_PLANE)


@device
def in_box(box: Box, place: Vector) -> Vector:
    """Return the coordinates of a place of the world."""
    x, y, z = place
    return (
        (x - box.middle[0]) * box.scale[0],
        (y - box.middle[1]) * box.scale[1],
        (z - water_at(box, x, y) - box.middle[2]) * box.scale[2],
    )


@device
def set_powers(basis: FloatArray, at: Vector) -> None:
    """Write the powers of coordinates, one for each term, in the order of `BASIS`."""
    u, v, w = at
    uu, uv, vv, ww = u * u, u * v, v * v, w * w
    powers = (
        1.0, u, v, w, uu, uv, u * w, vv, v * w, ww,
        uu * u, uu * v, uu * w, uv * v, uv * w, u * ww, vv * v, vv * w, v * ww,
    )  # fmt: skip
    for j in range(CUBIC):
        basis[j] = powers[j]


@device
def fit(terms: FloatArray, by: FloatArray, values: FloatArray) -> None:
    """Fit polynomials by least squares to values at the nodes, shape (nodes, values).

    Writes them term by term: those of all values for the first power, and so on.
    """
    many = values.shape[1]
    # `by` is the pseudo-inverse of the basis, so that the fit is one product
    for j in range(len(by)):
        for f in range(many):
            terms[j * many + f] = 0.0
        for k in range(INSIDE):
            for f in range(many):
                terms[j * many + f] += by[j, k] * values[k, f]


@device
def add_cubic(room: FloatArray, at: int, c: FloatArray, marks: FloatArray) -> None:
    """Add a cubic polynomial to run `at` of a tile, for the points that have a mark.

    The first three runs are the coordinates in the box; the powers are those of `BASIS`.
    """
    # as plain numbers the coefficients stay in registers, and the loop is vectorised
    one, u1, v1, w1, uu, uv, uw, vv, vw, ww = (
        c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9]
    )  # fmt: skip
    uuu, uuv, uuw, uvv, uvw, uww, vvv, vvw, vww = (
        c[10], c[11], c[12], c[13], c[14], c[15], c[16], c[17], c[18]
    )  # fmt: skip
    for j in range(marks.size):
        u, v, w = room[j], room[TILE + j], room[2 * TILE + j]
        # Horner's scheme
        value = one + w * (w1 + ww * w)
        value += u * (u1 + w * (uw + uww * w) + u * (uu + uuu * u + uuv * v + uuw * w))
        value += v * (v1 + w * (vw + vww * w) + v * (vv + vvv * v + vvw * w))
        value += u * v * (uv + uvv * v + uvw * w)
        room[at * TILE + j] += value if marks[j] > 0.0 else 0.0


@device
def add_quadratic(room: FloatArray, at: int, c: FloatArray, marks: FloatArray) -> None:
    """Do as `add_cubic` with a quadratic polynomial."""
    one, u1, v1, w1, uu, uv, uw, vv, vw, ww = (
        c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9]
    )  # fmt: skip
    for j in range(marks.size):
        u, v, w = room[j], room[TILE + j], room[2 * TILE + j]
        value = one + w * (w1 + ww * w) + u * (u1 + uu * u + uv * v + uw * w)
        value += v * (v1 + vv * v + vw * w)
        room[at * TILE + j] += value if marks[j] > 0.0 else 0.0

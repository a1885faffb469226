"""Correct many neighbours by `consistent` without a search for each: g as polynomials.

What each camera adds to g(Q) and to its derivative (see `pcfix.refract.consistent`) is a smooth
function of where the apparent point lies. In a cell of some metres it is taken at nodes and becomes
a polynomial, one for each camera. A point adds up those of its own cameras, whichever they are, and
takes one Newton step from a true point Q0 that is a polynomial too, the same for all cameras.

How much the polynomials lack is known at the corners of the cell, where it is most; like the
polynomials it adds up over the cameras. Where that or the Newton step is too large for a share of
the point's ground pixel, the point is solved as by `consistent`.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np

from pcfix.kernels import Span, in_tiles, kernel, lean
from pcfix.lens.algebra import Vector, dot, inverted, normal_of, plus, row_of, scaled, times, vector
from pcfix.model import FloatArray, IntArray
from pcfix.refract.batch import CORRECTED, Batch, Chosen, Intersection, Optics, optics_of
from pcfix.refract.choice import rig_of
from pcfix.refract.consistent import (
    COLUMNS,
    COSINE2,
    FOUND,
    MISS,
    OUTCOME,
    RAY_WIDTH,
    Room,
    add_image,
    add_residual,
    begin,
    check_consistent,
    correct_one,
    intersection_of,
    miss,
    room_for,
)
from pcfix.refract.rays import nearest_point

TOLERANCE_PX = 0.02
"""What may be lacking, in ground pixels: of the polynomials, and of the one Newton step."""

CELLS_A_HEIGHT = 8.0
LEAST_POINTS = 150
"""Of a cell that a camera gives rays to, on average: its polynomials cost as much as those rays."""

LEAST_LENGTH_M = 1e-3
SAME_PLANE = 1e-6
"""Metres of height, and of slope."""


def _basis_of(x: FloatArray) -> FloatArray:
    u, v, w = x.T
    uu, uv, vv, ww = u * u, u * v, v * v, w * w
    return np.column_stack(
        [np.ones(len(x)), u, v, w, uu, uv, u * w, vv, v * w, ww,
         uu * u, uu * v, uu * w, uv * v, uv * w, u * ww, vv * v, vv * w, v * ww]
    )  # fmt: skip


def _fit_at(basis: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.pinv(basis), np.float64)


_QUADRATIC, _CUBIC = 10, 19
"""Terms of polynomials; the cubic one has no power of three of the height, that spreads least."""

# Polynomials through these nodes are off most at the corners, where it is asked how much.
_FOUR, _THREE = np.cos(np.pi / 8.0 * np.arange(1, 8, 2)), np.sqrt(0.75) * np.arange(-1.0, 2.0)
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
_NODES = np.vstack([np.array(list(product(_FOUR, _FOUR, _THREE))), _CORNERS])
_INSIDE, _AT_CORNERS = len(_NODES) - len(_CORNERS), len(_CORNERS)
_BASIS = _basis_of(_NODES)
_FIT_CUBIC = _fit_at(_BASIS[:_INSIDE])
_FIT_QUADRATIC = _fit_at(_BASIS[:_INSIDE, :_QUADRATIC])
_SOME = np.concatenate([np.arange(0, _INSIDE, 5), np.arange(_INSIDE, len(_NODES))])
_FIT_SOME = _fit_at(_BASIS[_SOME, :_QUADRATIC])

# What a camera adds: g, cubic; its derivative, quadratic; and how much the polynomials of g lack at
# each corner.
_SLOPE, _VALUES = 3, 12
_REST = _SLOPE * _CUBIC
_LACK = _REST + (_VALUES - _SLOPE) * _QUADRATIC
_WIDTH = _LACK + 3 * _AT_CORNERS


class _Cell(NamedTuple):
    """The polynomials of a cell, for kernels.

    Attributes
    ----------
    box : array, shape (2, 3)
        Middle and half the size of the cell in x, y and the height over the water, metres.
    water : array, shape (3,)
        Height of the water over the middle, and its slope.
    middle : array, shape (3, 10)
        Q0, relative to the apparent point.
    place : array, shape (k,)
        The row of each camera in `terms`, or -1.
    terms : array, shape (cameras, 171)
        What each of them adds.
    """

    box: FloatArray
    water: FloatArray
    middle: FloatArray
    place: IntArray
    terms: FloatArray


_Work: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""Of one point: terms, their values, powers, the sums of lines, a ray, a matrix."""


def consistent_in_cells(batch: Batch) -> Intersection:
    """Correct points as `pcfix.refract.consistent.consistent` does, within 0.05 ground pixels.

    The water is a plane above the points of a cell, or they are solved one by one. Cells are
    fixed in the world; the polynomials also depend on how far its points spread in a cell, so
    that chunks of other sizes give other results, within the same tolerance.
    """
    cameras = batch.survey.cameras
    check_consistent(cameras)
    result, points = np.zeros((len(batch), COLUMNS)), batch.chosen()
    order, first = _cells(batch)
    in_tiles(
        _correct_cells, len(first) - 1, (order, first), points, optics_of(cameras),
        1.0 / rig_of(batch.survey).focal_px, result,
    )  # fmt: skip
    return intersection_of(batch, result)


def _cells(batch: Batch) -> tuple[IntArray, IntArray]:
    """Return the order of the points cell by cell, and the first of each cell.

    Those of a cell with the same cameras come one after the other.
    """
    if not len(batch):
        return np.zeros(0, np.int64), np.zeros(1, np.int64)
    height = np.median(batch.survey.cameras.centres[:, 2]) - np.median(batch.surface.height_m)
    # a power of two, so that other chunks have the same cells
    size = 2.0 ** np.rint(np.log2(max(height, LEAST_LENGTH_M) / CELLS_A_HEIGHT))
    cell = np.floor(batch.xyz[:, :2] / size).astype(np.int64)
    cell -= cell.min(axis=0)
    key = cell[:, 1] * (cell[:, 0].max() + 1) + cell[:, 0]
    names = np.random.default_rng(0).integers(2**40, size=len(batch.survey.cameras))
    sums = np.concatenate([[0], np.cumsum(names[batch.rays.camera])])
    order = np.lexsort((np.diff(sums[batch.rays.start]), key))
    new = np.flatnonzero(np.diff(key[order])) + 1
    return order, np.concatenate([[0], new, [len(order)]])


@kernel
def _correct_cells(
    span: Span, cells: tuple[IntArray, IntArray], points: Chosen, optics: Optics,
    pixel: FloatArray, result: FloatArray,
) -> None:  # fmt: skip
    """Correct the points of each cell; `pixel` is the size (rad) of one of each camera."""
    order, first = cells
    for t in range(*span):
        rows = order[first[t] : first[t + 1]]
        seen = _counts(rows, points)
        room = room_for(len(points.centres))
        work = (
            np.empty(_WIDTH), np.empty(_VALUES), np.empty(_CUBIC), np.empty(10),
            np.empty(RAY_WIDTH), np.empty((3, 3)),
        )  # fmt: skip
        known, few = False, seen.sum() <= LEAST_POINTS * np.count_nonzero(seen)
        cell = _empty_cell() if few else _cell_of(rows, seen, points, optics, room)
        for at in range(rows.size):
            i, last = rows[at], rows[max(at - 1, 0)]
            cameras, out = _cameras_of(points, i), result[i]
            if not few and (at == 0 or not _are_same(cameras, _cameras_of(points, last))):
                known = _add_up(work[0], cameras, cell)
            if few or not (known and _predict(out, i, cameras, points, cell, pixel, work)):
                if cameras.size > len(room[0]):
                    room = room_for(cameras.size)
                correct_one(out, points, i, cameras, optics, None, None, room)


@kernel
def _cameras_of(points: Chosen, i: int) -> IntArray:
    return points.camera[points.start[i] : points.start[i + 1]]


@lean
def _are_same(a: IntArray, b: IntArray) -> bool:
    same = a.size == b.size
    for j in range(min(a.size, b.size)):
        same = same and a[j] == b[j]
    return same


@kernel
def _counts(rows: IntArray, points: Chosen) -> IntArray:
    """Return how many of some points each camera sees."""
    seen = np.zeros(len(points.centres), np.int64)
    for i in rows:
        for c in _cameras_of(points, i):
            seen[c] += 1
    return seen


@kernel
def _empty_cell() -> _Cell:
    none, no_row = np.empty((0, 0)), np.empty(0, np.int64)
    return _Cell(none, none[0:0].ravel(), none, no_row, none)


@kernel
def _cell_of(rows: IntArray, seen: IntArray, points: Chosen, optics: Optics, room: Room) -> _Cell:
    """Fit the polynomials of a cell."""
    named = np.flatnonzero(seen)
    box, water = _box_of(rows, points)
    nodes = _nodes_of(box, water, points)
    shift = np.zeros((len(_SOME), COLUMNS))
    common = np.flatnonzero(2 * seen >= seen.max())
    for k in range(len(_SOME)):
        correct_one(shift[k], nodes, _SOME[k], common, optics, None, None, room)
    middle = np.ascontiguousarray((_FIT_SOME @ shift[:, :3].copy()).T)
    place = np.full(len(points.centres), -1)
    terms, values = np.empty((named.size, _WIDTH)), np.empty((_VALUES, len(_NODES)))
    for at in range(named.size):
        for k in range(len(_NODES)):
            q = _place(middle, _BASIS[k])
            _look(values[:, k], q, nodes, k, named[at], optics, room)
        _fit(terms[at], values)
        if np.isfinite(terms[at]).all():
            place[named[at]] = at
    return _Cell(box, water, middle, place, terms)


@lean
def _fit(terms: FloatArray, values: FloatArray) -> None:
    """Write the polynomials through the values, shape (12, nodes), of one camera."""
    _fit_some(terms, _FIT_CUBIC, values[:_SLOPE])
    _fit_some(terms[_REST:], _FIT_QUADRATIC, values[_SLOPE:])
    for k in range(_AT_CORNERS):
        for i in range(3):
            there = _value(terms[_CUBIC * i : _CUBIC * (i + 1)], _BASIS[_INSIDE + k])
            terms[_LACK + 3 * k + i] = there - values[i, _INSIDE + k]


@lean
def _fit_some(terms: FloatArray, fit: FloatArray, values: FloatArray) -> None:
    for f in range(len(values)):
        for j in range(len(fit)):
            total = 0.0
            for k in range(_INSIDE):
                total += fit[j, k] * values[f, k]
            terms[f * len(fit) + j] = total


@kernel
def _box_of(rows: IntArray, points: Chosen) -> tuple[FloatArray, FloatArray]:
    """Return the box of some points and the water over its middle, that of the first of them."""
    i, low, high = rows[0], np.full(3, np.inf), np.full(3, -np.inf)
    b, c = points.slope[i]
    a = points.height[i] - b * points.xyz[i, 0] - c * points.xyz[i, 1]
    for j in rows:
        x, y, z = row_of(points.xyz, j)
        at = x, y, z - (a + b * x + c * y)
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], at[axis]), max(high[axis], at[axis])
    box = np.empty((2, 3))
    box[0], box[1] = 0.5 * (low + high), np.maximum(0.5 * (high - low), LEAST_LENGTH_M)
    return box, np.array([a + b * box[0, 0] + c * box[0, 1], b, c])


@kernel
def _nodes_of(box: FloatArray, water: FloatArray, points: Chosen) -> Chosen:
    """Return the nodes of a box as points."""
    xyz, height = box[0] + box[1] * _NODES, np.empty(len(_NODES))
    slope, normals = np.empty((len(_NODES), 2)), np.empty((len(_NODES), 3))
    for k in range(len(_NODES)):
        slope[k] = water[1:]
        height[k] = _water_at(water, box, xyz[k, 0], xyz[k, 1])
        xyz[k, 2] += height[k]
        normals[k, 0], normals[k, 1], normals[k, 2] = normal_of(water[1], water[2])
    return Chosen(
        xyz, xyz, height, slope, normals, points.centres, points.offset, points.start,
        points.camera, points.n,
    )  # fmt: skip


@lean
def _water_at(water: FloatArray, box: FloatArray, x: float, y: float) -> float:
    return water[0] + water[1] * (x - box[0, 0]) + water[2] * (y - box[0, 1])


@lean
def _value(a: FloatArray, b: FloatArray) -> float:
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@lean
def _look(
    out: FloatArray, q: Vector, nodes: Chosen, k: int, c: int, optics: Optics, room: Room
) -> None:
    """Write what camera c adds at a node: g and its derivative."""
    ray, sums, g, slope = room[0][0], room[1], room[2], room[3]
    g[:], slope[:] = 0.0, 0.0
    begin(ray, sums, nodes, k, c, None, None, -1)
    add_image(ray, optics, c)
    add_residual(g, slope, q, ray, c, optics, nodes.n, None, None)
    for i in range(3):
        out[i] = g[i]
        for j in range(3):
            out[_SLOPE + 3 * i + j] = slope[i, j]


@lean
def _predict(
    out: FloatArray, i: int, cameras: IntArray, points: Chosen, cell: _Cell, pixel: FloatArray,
    room: _Work,
) -> bool:  # fmt: skip
    """Write the row of a point by the terms of its cameras; False where they do not serve."""
    terms, values, basis, lines, ray, inverse = room
    if not _is_under(points, i, cell):
        return False
    _set_basis(basis, points, i, cell)
    _evaluate(values, terms, basis)
    for j in range(9):
        inverse[j // 3, j % 3] = values[_SLOPE + j]
    k, (distance, gsd) = float(cameras.size), _lines(lines, ray, points, i, cameras, pixel)
    if not (inverted(inverse, 0.0) and nearest_point(k, lines)[0]):
        return False
    step, allowed = scaled(-1.0, times(inverse, vector(values))), TOLERANCE_PX * gsd
    if not (dot(step, step) <= allowed * distance and _lack2(terms, inverse) <= allowed * allowed):
        return False
    q = plus(_place(cell.middle, basis), step)
    out[0], out[1], out[2] = q
    out[MISS], out[COSINE2] = miss(k, lines, q), lines[9]
    out[OUTCOME], out[FOUND] = CORRECTED, 1.0
    return True


@lean
def _evaluate(values: FloatArray, sums: FloatArray, basis: FloatArray) -> None:
    """Write what the polynomials of `sums` are at a point."""
    for f in range(_SLOPE):
        values[f] = _value(sums[_CUBIC * f : _CUBIC * (f + 1)], basis)
    for f in range(_VALUES - _SLOPE):
        values[_SLOPE + f] = _value(sums[_REST + _QUADRATIC * f :][:_QUADRATIC], basis)


@lean
def _place(middle: FloatArray, basis: FloatArray) -> Vector:
    """Return Q0 relative to the apparent point."""
    return _value(middle[0], basis), _value(middle[1], basis), _value(middle[2], basis)


@lean
def _is_under(points: Chosen, i: int, cell: _Cell) -> bool:
    """Whether the water over a point is the plane of the cell."""
    off = points.height[i] - _water_at(cell.water, cell.box, points.xyz[i, 0], points.xyz[i, 1])
    b, c = points.slope[i, 0] - cell.water[1], points.slope[i, 1] - cell.water[2]
    return bool(max(abs(off), max(abs(b), abs(c))) <= SAME_PLANE)


@lean
def _add_up(sums: FloatArray, cameras: IntArray, cell: _Cell) -> bool:
    """Add up the terms of cameras; False where one has none."""
    sums[:] = 0.0
    for c in cameras:
        at = cell.place[c]
        if at < 0:
            return False
        for i in range(_WIDTH):
            sums[i] += cell.terms[at, i]
    return True


@lean
def _set_basis(basis: FloatArray, points: Chosen, i: int, cell: _Cell) -> None:
    """Write the powers of where a point lies in the cell."""
    x, y, z = row_of(points.xyz, i)
    middle, half = row_of(cell.box, 0), row_of(cell.box, 1)
    u, v = (x - middle[0]) / half[0], (y - middle[1]) / half[1]
    w = (z - _water_at(cell.water, cell.box, x, y) - middle[2]) / half[2]
    uu, uv, vv, ww = u * u, u * v, v * v, w * w
    powers = (
        1.0, u, v, w, uu, uv, u * w, vv, v * w, ww,
        uu * u, uu * v, uu * w, uv * v, uv * w, u * ww, vv * v, vv * w, v * ww,
    )  # fmt: skip
    for j in range(_CUBIC):
        basis[j] = powers[j]


@lean
def _lines(
    sums: FloatArray, ray: FloatArray, points: Chosen, i: int, cameras: IntArray, pixel: FloatArray
) -> tuple[float, float]:
    """Sum up the refracted lines of a point; return how far its nearest camera is, and its pixel.

    Both in metres, the pixel on the ground.
    """
    sums[:9], sums[9] = 0.0, 1.0
    least, width = np.inf, 0.0
    for c in cameras:
        begin(ray, sums, points, i, c, None, None, -1)
        length2 = dot(vector(ray), vector(ray))
        if length2 < least:
            least, width = length2, pixel[c]
    distance = np.sqrt(least)
    return distance, width * distance


@lean
def _lack2(sums: FloatArray, inverse: FloatArray) -> float:
    """Return how far off (squared, m) the polynomials put the point at the worst corner."""
    most = 0.0
    for corner in range(_AT_CORNERS):
        off = times(inverse, vector(sums, _LACK + 3 * corner))
        most = max(most, dot(off, off))
    return most

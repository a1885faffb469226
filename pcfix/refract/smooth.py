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

from typing import NamedTuple, TypeAlias

import numpy as np

from pcfix.kernels import Span, in_tiles, kernel, lean, part
from pcfix.lens.algebra import (
    Vector,
    beyond,
    dot,
    inverted,
    normal_of,
    plus,
    row_of,
    scaled,
    times,
    vector,
)
from pcfix.model import FloatArray, IntArray
from pcfix.refract.batch import CORRECTED, Batch, Chosen, Intersection, Optics, optics_of
from pcfix.refract.cells import (
    AT_CORNERS,
    BASIS,
    CUBIC,
    FIT_CUBIC,
    FIT_QUADRATIC,
    FIT_SOME,
    INSIDE,
    NODES,
    QUADRATIC,
    SOME,
    Box,
    are_same,
    box_of,
    cameras_of,
    cells_of,
    counts_of,
    fit,
    in_box,
    is_under,
    no_box,
    set_powers,
    water_at,
)
from pcfix.refract.choice import Rig, Rule, rig_of, rule_of
from pcfix.refract.consistent import (
    COLUMNS,
    COSINE2,
    FOUND,
    MISS,
    OUTCOME,
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
from pcfix.refract.intersect import add_camera
from pcfix.refract.rays import nearest_point
from pcfix.refract.tiling import TILE, Points, gather

TOLERANCE_PX = 0.02
"""What may be lacking, in ground pixels: of the polynomials, and of the one Newton step."""

LEAST_POINTS = 150
"""Of a cell that a camera gives rays to, on average: its polynomials cost as much as those rays."""

# What a camera adds: g, cubic; its derivative, quadratic; and how much the polynomials of g lack at
# each corner.
_SLOPE, _VALUES = 3, 12
_REST, _REST_VALUES = _SLOPE * CUBIC, _VALUES - _SLOPE
_LACK = _REST + _REST_VALUES * QUADRATIC
_WIDTH = _LACK + 3 * AT_CORNERS


class _Cell(NamedTuple):
    """The polynomials of a cell, for kernels.

    Attributes
    ----------
    box : Box
    middle : array, shape (10, 3)
        Q0, relative to the apparent point.
    place : array, shape (k,)
        The row of each camera in `terms`, or -1.
    terms : array, shape (cameras, 171)
        What each of them adds.
    """

    box: Box
    middle: FloatArray
    place: IntArray
    terms: FloatArray


_Work: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Of points with the same cameras: terms; of one point: their values, powers, a matrix."""

_Run: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Of points with the same cameras: see `gather`; ones; see `add_camera`; squared distance from the
nearest camera (m^2) and the size of its pixel (rad)."""


def consistent_in_cells(batch: Batch) -> Intersection:
    """Correct points as `pcfix.refract.consistent.consistent` does, within 0.05 ground pixels.

    The water is a plane above the points of a cell, or they are solved one by one. Cells are
    fixed in the world; the polynomials also depend on how far its points spread in a cell, so
    that chunks of other sizes give other results, within the same tolerance.
    """
    cameras = batch.survey.cameras
    check_consistent(cameras)
    result, points = np.zeros((len(batch), COLUMNS)), batch.chosen()
    order, first = cells_of(batch)
    in_tiles(
        _correct_cells, len(first) - 1, (order, first), points, rig_of(batch.survey),
        rule_of(batch.survey)._replace(least_cosine2=0.0), optics_of(cameras), result,
        points=len(batch),
    )  # fmt: skip
    return intersection_of(batch, result)


@kernel
def _correct_cells(
    span: Span, cells: tuple[IntArray, IntArray], points: Chosen, rig: Rig, rule: Rule,
    optics: Optics, result: FloatArray,
) -> None:  # fmt: skip
    """Correct the points of each cell, those with the same cameras together."""
    order, first = cells
    run = np.empty(7 * TILE), np.ones(TILE), np.empty(11 * TILE), np.empty(2 * TILE)
    work = np.empty(_WIDTH), np.empty(_VALUES), np.empty(CUBIC), np.empty((3, 3))
    for t in range(*span):
        rows = order[first[t] : first[t + 1]]
        seen = counts_of(rows, points)
        room = room_for(len(points.centres))
        few = seen.sum() <= LEAST_POINTS * np.count_nonzero(seen)
        cell = _empty_cell() if few else _cell_of(rows, seen, points, optics, room)
        at = 0
        while at < rows.size:
            end, cameras = _end_of_run(rows, at, points), cameras_of(points, rows[at])
            known = not few and _add_up(work[0], cameras, cell)
            if known:
                _add_lines(run, rows[at:end], cameras, points, rig, rule)
            for j in range(end - at):
                i, k = rows[at + j], float(cameras.size)
                if not (known and _predict(result[i], (i, j), k, points, cell, run, work)):
                    if cameras.size > len(room[0]):
                        room = room_for(cameras.size)
                    correct_one(result[i], points, i, cameras, optics, None, None, room)
            at = end


@part
def _end_of_run(rows: IntArray, at: int, points: Chosen) -> int:
    """Return where the points end that have the same cameras, and are a tile at most."""
    end, cameras = at + 1, cameras_of(points, rows[at])
    while end < min(rows.size, at + TILE) and are_same(cameras, cameras_of(points, rows[end])):
        end += 1
    return end


@part
def _add_lines(
    run: _Run, rows: IntArray, cameras: IntArray, points: Chosen, rig: Rig, rule: Rule
) -> None:
    """Sum up the refracted lines of points with the same cameras; find the nearest camera."""
    tile, ones, lines, near = run
    gather(tile, rows, Points(rows, points.xyz, points.height, points.slope))
    for at in range(11):
        lines[at * TILE : at * TILE + rows.size] = 0.0 if at < 10 else 1.0
    near[: rows.size] = np.inf
    for c in cameras:
        add_camera(lines, tile, ones[: rows.size], None, rig, c, rule)
        x, y, z = row_of(rig.centres, c)
        pixel = 1.0 / rig.focal_px[c]
        for j in range(rows.size):
            dx, dy, dz = x - tile[j], y - tile[TILE + j], z - tile[2 * TILE + j]
            length2 = dx * dx + dy * dy + dz * dz
            near[TILE + j] = pixel if length2 < near[j] else near[TILE + j]
            near[j] = min(near[j], length2)


@part
def _empty_cell() -> _Cell:
    none = np.empty((0, 0))
    return _Cell(no_box(), none, np.empty(0, np.int64), none)


@part
def _cell_of(rows: IntArray, seen: IntArray, points: Chosen, optics: Optics, room: Room) -> _Cell:
    """Fit the polynomials of a cell."""
    named = np.flatnonzero(seen)
    box = box_of(rows, points)
    nodes = _nodes_of(box, points)
    shift = np.zeros((len(SOME), COLUMNS))
    common = np.flatnonzero(2 * seen >= seen.max())
    for k in range(len(SOME)):
        correct_one(shift[k], nodes, SOME[k], common, optics, None, None, room)
    middle = FIT_SOME @ shift[:, :3].copy()
    place = np.full(len(points.centres), -1)
    terms, values = np.empty((named.size, _WIDTH)), np.empty((len(NODES), _VALUES))
    for at in range(named.size):
        for k in range(len(NODES)):
            q = _place(middle, BASIS[k])
            _look(values[k], q, nodes, k, named[at], optics, room)
        _fit(terms[at], values)
        if np.isfinite(terms[at]).all():
            place[named[at]] = at
    return _Cell(box, middle, place, terms)


@lean
def _fit(terms: FloatArray, values: FloatArray) -> None:
    """Write the polynomials through the values, shape (nodes, 12), of one camera."""
    fit(terms, FIT_CUBIC, values[:, :_SLOPE])
    fit(terms[_REST:], FIT_QUADRATIC, values[:, _SLOPE:])
    for k in range(AT_CORNERS):
        for i in range(_SLOPE):
            lack = -values[INSIDE + k, i]
            for j in range(CUBIC):
                lack += BASIS[INSIDE + k, j] * terms[_SLOPE * j + i]
            terms[_LACK + _SLOPE * k + i] = lack


@part
def _nodes_of(box: Box, points: Chosen) -> Chosen:
    """Return the nodes of a box as points."""
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
    out: FloatArray, at: tuple[int, int], k: float, points: Chosen, cell: _Cell, run: _Run,
    room: _Work,
) -> bool:  # fmt: skip
    """Write the row of a point with k cameras; False where they do not serve.

    It is point `at[0]`, and the one at `at[1]` of those with the same cameras.
    """
    (i, j), (terms, values, basis, inverse) = at, room
    if not is_under(points, i, cell.box):
        return False
    set_powers(basis, in_box(cell.box, row_of(points.xyz, i)))
    _evaluate(values, terms, basis)
    for v in range(9):
        inverse[v // 3, v % 3] = values[_SLOPE + v]
    lines, distance = run[2][j::TILE], np.sqrt(run[3][j])
    if not (inverted(inverse, 0.0) and nearest_point(k, lines)[0]):
        return False
    step = scaled(-1.0, times(inverse, vector(values)))
    allowed = TOLERANCE_PX * run[3][TILE + j] * distance
    if not (dot(step, step) <= allowed * distance and _lack2(terms, inverse) <= allowed * allowed):
        return False
    q = plus(_place(cell.middle, basis), step)
    out[0], out[1], out[2] = q
    out[MISS], out[COSINE2] = miss(k, lines, q), lines[10]
    out[OUTCOME], out[FOUND] = CORRECTED, 1.0
    return True


@lean
def _evaluate(values: FloatArray, sums: FloatArray, basis: FloatArray) -> None:
    """Write what the polynomials of `sums` are at a point."""
    values[:] = 0.0
    for j in range(CUBIC):
        for f in range(_SLOPE):
            values[f] += basis[j] * sums[_SLOPE * j + f]
    for j in range(QUADRATIC):
        for f in range(_REST_VALUES):
            values[_SLOPE + f] += basis[j] * sums[_REST + _REST_VALUES * j + f]


@lean
def _place(middle: FloatArray, basis: FloatArray) -> Vector:
    """Return Q0 relative to the apparent point."""
    x, y, z = 0.0, 0.0, 0.0
    for j in range(QUADRATIC):
        x, y, z = beyond((x, y, z), basis[j], row_of(middle, j))
    return x, y, z


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
def _lack2(sums: FloatArray, inverse: FloatArray) -> float:
    """Return how far off (squared, m) the polynomials put the point at the worst corner."""
    most = 0.0
    for corner in range(AT_CORNERS):
        off = times(inverse, vector(sums, _LACK + 3 * corner))
        most = max(most, dot(off, off))
    return most

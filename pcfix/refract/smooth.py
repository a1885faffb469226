"""Correct many neighbours by `consistent` without a search for each: g as polynomials.

What each camera adds to g(Q) and to its derivative (see `pcfix.refract.consistent`) is a smooth
function of where the apparent point lies. In a cell of some metres it is taken at nodes and becomes
a polynomial, one for each camera. A point adds up those of its own cameras, whichever they are, and
takes one Newton step from a true point Q0 that is a polynomial too, the same for all cameras.

How much the polynomials lack is known at the corners of the cell, where it is most; like the
polynomials it adds up over the cameras. Where that or the Newton step is too large for a share of
the point's ground pixel, the point is solved as by `consistent`.

A cell is worked on a tile at a time, as in `pcfix.refract.intersect`: its cameras, their lines,
the polynomials and the errors, so that no list of cameras is made.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Nine, Vector, beyond, cofactors, minus, row_of
from pcfix.lens.frames import Frames, frames_of, no_frames
from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.refract.batch import Batch, Chosen, Intersection, Optics, optics_of
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
    SAME_PLANE,
    SOME,
    Box,
    add_cubic,
    add_quadratic,
    box_of,
    cameras_of,
    fit,
    in_box,
    neighbours_in_cells,
    nodes_of,
    water_at,
)
from pcfix.refract.choice import Rig, Rule, rig_of, rule_of
from pcfix.refract.consistent import (
    COLUMNS,
    RAYS,
    Room,
    add_image,
    add_residual,
    begin,
    check_consistent,
    correct_one,
    intersection_of,
    miss,
    room_for,
    write_row,
)
from pcfix.refract.intersect import add_camera
from pcfix.refract.rays import MIN_DETERMINANT
from pcfix.refract.sensitivity import Budget, room_of
from pcfix.refract.tiling import (
    TILE,
    Points,
    cameras_around,
    corners_of,
    gather,
    marks_in_frame,
    marks_of_lists,
)
from pcfix.refract.uncertainty import (
    add_errors,
    budget_of,
    finish_tile,
    inverse_of,
    level_sigma_of,
    product_of,
    with_errors,
)

LACK_PX, STEP_PX = 0.02, 0.03
"""What may be lacking, in ground pixels: of the polynomials, and of the one Newton step.

Where cameras of few points are flatter than most, the steps are long: of a nadir block with 80 %
overlap 3 % of the points would be solved one by one at 0.02, a seventh of the whole time.
"""

LEAST_POINTS = 150
"""Of a cell that a camera gives rays to, on average: its polynomials cost as much as those rays."""

# What a camera adds: g, cubic; its derivative, quadratic; and how much the polynomials of g lack at
# each corner.
_SLOPE, _VALUES = 3, 12
_REST, _REST_VALUES = _SLOPE * CUBIC, _VALUES - _SLOPE
_LACK = _REST + _REST_VALUES * QUADRATIC
_WIDTH = _LACK + 3 * AT_CORNERS

# Runs of `TILE` numbers in the room of a tile: where its points lie in the box of the cell, the
# values, the lacks; Q, its distance from the lines, and whether it serves.
_G, _BY_Q, _LACKS, _Q, _MISS, _SERVES, _RUNS = 3, 6, 15, 39, 42, 43, 44


class _Cell(NamedTuple):
    """The polynomials of a cell, for kernels.

    Attributes
    ----------
    box : Box
    nodes : Chosen
        Its nodes as points.
    middle : array, shape (10, 3)
        Q0, relative to the apparent point.
    """

    box: Box
    nodes: Chosen
    middle: FloatArray


def consistent_in_cells(batch: Batch) -> Intersection:
    """Correct points as `pcfix.refract.consistent.consistent` does, within 0.05 ground pixels.

    The water is a plane above the points of a cell, or they are solved one by one. Cells are
    fixed in the world; the polynomials also depend on how far its points spread in a cell, so
    that chunks of other sizes give other results, within the same tolerance.

    A batch without lists of cameras gets all those whose frames hold a point, and its covariances.
    """
    survey, views = batch.survey, batch.views
    check_consistent(survey.cameras)
    result, used = np.zeros((len(batch), COLUMNS)), np.zeros(len(survey.cameras), np.bool_)
    rule, frames, asked = rule_of(survey), frames_of(survey.cameras), 0
    if views is not None:
        rule, frames = rule._replace(least_cosine2=0.0), no_frames(len(survey.cameras))
    elif survey.settings.dimensions == "all":
        asked = len(batch)
    covariance, (order, first) = np.zeros((asked, 6)), neighbours_in_cells(batch)
    in_tiles(
        _correct_cells, len(first) - 1, (order, first), _points_of(batch), rig_of(survey),
        frames, rule, optics_of(survey.cameras), (budget_of(survey), level_sigma_of(batch)),
        (result, used, covariance), points=len(batch),
    )  # fmt: skip
    found = intersection_of(result, used)
    return found if views is not None else with_errors(found, covariance if asked else None)


def _points_of(batch: Batch) -> Chosen:
    """Return the points and, where they have lists, their cameras for kernels, without normals."""
    xyz, none, views = np.ascontiguousarray(batch.xyz), np.zeros(0, np.int64), batch.views
    return Chosen(
        xyz, xyz,
        np.ascontiguousarray(batch.surface.height_m),
        np.ascontiguousarray(batch.surface.slope),
        np.zeros((0, 3)),
        np.ascontiguousarray(batch.survey.cameras.centres),
        batch.survey.offset_m,
        none if views is None else np.ascontiguousarray(views.start, np.int64),
        none if views is None else np.ascontiguousarray(views.camera, np.int64),
        batch.survey.settings.refractive_index,
    )  # fmt: skip


@kernel(allocates=True)
def _correct_cells(
    span: Span, cells: tuple[IntArray, IntArray], points: Chosen, rig: Rig, frames: Frames,
    rule: Rule, optics: Optics, errors: tuple[Budget, FloatArray],
    found: tuple[FloatArray, BoolArray, FloatArray],
) -> None:  # fmt: skip
    """Correct the points of each cell, a tile of them at a time."""
    (order, first), (budget, level_sigma), (result, used, covariance) = cells, errors, found
    low, high = corners_of(order[first[span[0]] : first[span[1]]], points.xyz)
    around = cameras_around(frames, rig.centres, low, high)
    tile, lines, room = np.empty(7 * TILE), np.empty(11 * TILE), np.empty(_RUNS * TILE)
    terms, of = np.empty((len(rig.centres), _WIDTH)), np.full(len(rig.centres), -1)
    alone = room_for(len(rig.centres))
    for t in range(*span):
        inside = order[first[t] : first[t + 1]]
        every = (inside.size + TILE - 1) // TILE
        near, marks = _seen(lines, tile, inside[::every], points, rig, frames, rule, around)
        seen = np.array([marks[k].sum() for k in range(near.size)])
        few = every * seen.sum() <= LEAST_POINTS * np.count_nonzero(seen)
        if not few:
            cell = _cell_of(inside, near[2.0 * seen >= seen.max()], points, optics, alone)
        for at in range(0, inside.size, TILE):
            rows = inside[at : at + TILE]
            near, marks = _seen(lines, tile, rows, points, rig, frames, rule, around)
            room[_SERVES * TILE :] = 0.0
            if not few:
                for k in range(near.size):
                    if of[near[k]] != t:
                        _fit_camera(terms[near[k]], near[k], cell, optics, alone)
                        of[near[k]] = t
                _place(room, tile, rows.size, cell.box)
                _add_cameras(room, marks, near, terms)
                _step(room, lines, rows.size, cell.middle, *_nearest(cell.box, near, rig))
            alone = _write(result, rows, room, lines, marks, near, points, optics, alone)
            _use(used, result, rows, marks, near)
            if len(covariance):
                sums = room_of(tile, result, rows)
                for k in range(near.size):
                    add_errors(sums, tile, marks[k], rig, near[k], rule, budget)
                finish_tile(covariance, rows, sums, tile, level_sigma, budget)


@device(allocates=True)
def _seen(
    lines: FloatArray, tile: FloatArray, rows: IntArray, points: Chosen, rig: Rig, frames: Frames,
    rule: Rule, around: IntArray,
) -> tuple[IntArray, FloatArray]:  # fmt: skip
    """Gather a tile, sum up its refracted lines; return its cameras, and the marks of their rays.

    A camera that the list of a point names twice counts once here.
    """
    low, high = gather(tile, rows, Points(rows, points.xyz, points.height, points.slope))
    if points.start.size:
        near, marks = marks_of_lists(points.start, points.camera, rows, len(rig.centres))
    else:
        near, marks = marks_in_frame(around, tile, frames, rig.centres, low, high, rows.size)
    lines[: 10 * TILE], lines[10 * TILE :] = 0.0, 1.0
    seeing = 0
    for k in range(near.size):
        if add_camera(lines, tile, marks[k], None, rig, near[k], rule):
            near[seeing], marks[seeing] = near[k], marks[k]
            seeing += 1
    return near[:seeing], marks[:seeing]


@device(allocates=True)
def _cell_of(rows: IntArray, common: IntArray, points: Chosen, optics: Optics, room: Room) -> _Cell:
    """Return a cell, with the Q0 of those cameras that most of its points have in common."""
    box = box_of(rows, points)
    nodes, shift = nodes_of(box, points), np.zeros((len(SOME), COLUMNS))
    for k in range(len(SOME)):
        correct_one(shift[k], nodes, SOME[k], common, optics, None, None, room)
    return _Cell(box, nodes, FIT_SOME @ shift[:, :3].copy())


@device(allocates=True)
def _fit_camera(terms: FloatArray, c: int, cell: _Cell, optics: Optics, room: Room) -> None:
    """Write what camera c adds in a cell; NaN where some of it has no image."""
    values = np.empty((len(NODES), _VALUES))
    for k in range(len(NODES)):
        q = 0.0, 0.0, 0.0
        for j in range(QUADRATIC):
            q = beyond(q, BASIS[k, j], row_of(cell.middle, j))
        _look(values[k], q, cell.nodes, k, c, optics, room)
    fit(terms, FIT_CUBIC, values[:, :_SLOPE])
    fit(terms[_REST:], FIT_QUADRATIC, values[:, _SLOPE:])
    for k in range(AT_CORNERS):
        for i in range(_SLOPE):
            lack = -values[INSIDE + k, i]
            for j in range(CUBIC):
                lack += BASIS[INSIDE + k, j] * terms[_SLOPE * j + i]
            terms[_LACK + _SLOPE * k + i] = lack
    if not np.isfinite(terms).all():
        terms[:] = np.nan


@device
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


@device
def _place(room: FloatArray, tile: FloatArray, count: int, box: Box) -> None:
    """Set where the points of a tile lie in the box, and whether its water is above them."""
    for j in range(count):
        x, y, z = tile[j], tile[TILE + j], tile[2 * TILE + j]
        room[j], room[TILE + j], room[2 * TILE + j] = in_box(box, (x, y, z))
        off = abs(tile[3 * TILE + j] - water_at(box, x, y))
        up = tile[6 * TILE + j]
        b, c = tile[4 * TILE + j] + up * box.water[1], tile[5 * TILE + j] + up * box.water[2]
        under = max(off, max(abs(b), abs(c))) <= SAME_PLANE
        room[_SERVES * TILE + j] = 1.0 if under else 0.0


@device(allocates=True)
def _add_cameras(room: FloatArray, marks: FloatArray, near: IntArray, terms: FloatArray) -> None:
    """Set the values at the points of a tile: of the cameras of all at once, then of each other."""
    room[_G * TILE : _MISS * TILE] = 0.0
    sums, count = np.zeros(_WIDTH), marks.shape[1]
    for k in range(near.size):
        if marks[k].sum() == count:
            for i in range(_WIDTH):
                sums[i] += terms[near[k], i]
        else:
            _add(room, terms[near[k]], marks[k])
    _add(room, sums, np.ones(count))


@device
def _add(room: FloatArray, terms: FloatArray, marks: FloatArray) -> None:
    """Add values to those of the points that have a mark."""
    for f in range(_SLOPE):
        add_cubic(room, _G + f, terms[f:_REST:_SLOPE], marks)
    for f in range(_REST_VALUES):
        add_quadratic(room, _BY_Q + f, terms[_REST + f : _LACK : _REST_VALUES], marks)
    for f in range(3 * AT_CORNERS):
        lack = terms[_LACK + f]
        for j in range(marks.size):
            room[(_LACKS + f) * TILE + j] += lack if marks[j] > 0.0 else 0.0


@device
def _nearest(box: Box, near: IntArray, rig: Rig) -> tuple[float, float]:
    """Return how far the nearest camera is from a box, metres, and the size of its pixel, rad."""
    least, pixel = np.inf, 0.0
    for c in near:
        away2 = 0.0
        for axis in range(3):
            middle = box.middle[axis] + (box.water[0] if axis == 2 else 0.0)
            away = max(abs(rig.centres[c, axis] - middle) - box.half[axis], 0.0)
            away2 += away * away
        if away2 < least:
            least, pixel = away2, 1.0 / rig.focal_px[c]
    return np.sqrt(least), pixel


@device
def _step(
    room: FloatArray, lines: FloatArray, count: int, middle: FloatArray, distance: float,
    pixel: float,
) -> None:  # fmt: skip
    """Take the step from Q0; the points serve where little is lacking and their rays meet."""
    for axis in range(3):
        add_quadratic(room, _Q + axis, middle[:, axis], room[_SERVES * TILE :][:count])
    lack2, step2 = (LACK_PX * pixel * distance) ** 2, STEP_PX * pixel * distance * distance
    for j in range(count):
        _, inverse = inverse_of(_nine(room, j))
        for i in range(9):
            room[(_BY_Q + i) * TILE + j] = inverse[i]
    for corner in range(AT_CORNERS):
        for j in range(count):
            x, y, z = product_of(_nine(room, j), _three(room, _LACKS + 3 * corner, j))
            serves = x * x + y * y + z * z <= lack2
            room[_SERVES * TILE + j] = room[_SERVES * TILE + j] if serves else 0.0
    for j in range(count):
        x, y, z = product_of(_nine(room, j), _three(room, _G, j))
        k, s = lines[9 * TILE + j], _sums(lines, j)
        m00, m11 = k - s[0], k - s[3]
        det, _ = cofactors((m00, -s[1], -s[2], m11, -s[4], 2.0 * k - m00 - m11))
        q = minus(_three(room, _Q, j), (x, y, z))
        serves = (x * x + y * y + z * z <= step2) & (det >= MIN_DETERMINANT * k * k * k)
        room[_SERVES * TILE + j] = room[_SERVES * TILE + j] if serves else 0.0
        room[_Q * TILE + j], room[(_Q + 1) * TILE + j], room[(_Q + 2) * TILE + j] = q
        room[_MISS * TILE + j] = miss(k, s, q)


@device
def _three(room: FloatArray, run: int, j: int) -> Vector:
    at = run * TILE + j
    return room[at], room[at + TILE], room[at + 2 * TILE]


@device
def _nine(room: FloatArray, j: int) -> Nine:
    a, b, c = _three(room, _BY_Q, j), _three(room, _BY_Q + 3, j), _three(room, _BY_Q + 6, j)
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@device
def _sums(s: FloatArray, j: int) -> Nine:
    a, b, c = _three(s, 0, j), _three(s, 3, j), _three(s, 6, j)
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@device(allocates=True)
def _write(
    result: FloatArray, rows: IntArray, room: FloatArray, lines: FloatArray, marks: FloatArray,
    near: IntArray, points: Chosen, optics: Optics, alone: Room,
) -> Room:  # fmt: skip
    """Write the rows of a tile: the points that do not serve are solved alone."""
    listed = points.start.size > 0
    for j in range(rows.size):
        i, k = rows[j], lines[9 * TILE + j]
        named = cameras_of(points, i) if listed else near[:0]
        if room[_SERVES * TILE + j] > 0.0 and not (listed and named.size != k):
            cosine2 = lines[10 * TILE + j]
            write_row(result[i], _three(room, _Q, j), room[_MISS * TILE + j], k, cosine2)
        else:
            cameras = named if listed else near[marks[:, j] > 0.0]
            if cameras.size > len(alone[0]):
                alone = room_for(cameras.size)
            correct_one(result[i], points, i, cameras, optics, None, None, alone)
    return alone


@device(allocates=True)
def _use(
    used: BoolArray, result: FloatArray, rows: IntArray, marks: FloatArray, near: IntArray
) -> None:
    """Mark the cameras of the points that are moved; threads write the same value."""
    for k in range(near.size):
        for j in range(0 if used[near[k]] else rows.size):
            if marks[k, j] > 0.0 and result[rows[j], RAYS] > 0.0:
                used[near[k]] = True

"""Correct many neighbours by `consistent` with polynomials instead of a search for each point.

What each camera adds to g(Q) and to its derivative (see `pcfix.refract.consistent`) is a smooth
function of the place of the apparent point. In a cell of some metres it is evaluated at nodes and
replaced by a polynomial, one for each camera. A point adds up the polynomials of its own cameras
and takes one Newton step from a true point Q0, which is a polynomial too, common to all cameras.

The error of the polynomials is known at the corners of the cell, where it is largest, and adds up
over the cameras. Where it, or the Newton step, exceeds a share of the ground pixel, the point is
solved as by `consistent`.

A cell is processed a tile at a time, as in `pcfix.refract.intersect`: cameras, lines, polynomials
and errors together, so that no lists of cameras are needed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import beyond, cofactors, minus, row_of
from pcfix.lens.frames import Frames, frames_of, no_frames
from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.refract import cells, consistent, tiling, uncertainty
from pcfix.refract.batch import Batch, Chosen, Intersection, Optics, optics_of
from pcfix.refract.cells import BASIS, CUBIC, INSIDE, NODES, QUADRATIC, Box
from pcfix.refract.choice import Rig, Rule, rig_of, rule_of
from pcfix.refract.consistent import Room
from pcfix.refract.intersect import add_camera
from pcfix.refract.rays import MIN_DETERMINANT
from pcfix.refract.tiling import TILE, nine, three
from pcfix.refract.uncertainty import Budget, room_of

LACK_PX, STEP_PX = 0.02, 0.03
"""Largest errors of the polynomials and of the one Newton step, in ground pixels.

With 0.02 for the step, 3 % of the points of a nadir block with 80 % overlap would be solved one by
one, a seventh of the whole time.
"""

LEAST_POINTS = 150
"""Least points of a cell per camera, on average: its polynomials cost as much as so many rays."""

# Terms of a camera: g, cubic; its derivative, quadratic; what the polynomials of g lack at each
# corner.
_SLOPE, _VALUES = 3, 12
_REST, _REST_VALUES = _SLOPE * CUBIC, _VALUES - _SLOPE
_LACK = _REST + _REST_VALUES * QUADRATIC
_WIDTH = _LACK + 3 * cells.AT_CORNERS

# Runs of `TILE` numbers in the room of a tile: where its points lie in the box of the cell, the
# values, the lacks; Q, its distance from the lines, and whether it serves.
_G, _BY_Q, _LACKS, _Q, _DISTANCE, _SERVES, _RUNS = 3, 6, 15, 39, 42, 43, 44


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

    Cells need a plane of water above them, or their points are solved one by one. They are fixed
    in the world, but their polynomials depend on the extent of the points in them: chunks of other
    sizes give other results, within the same tolerance.

    A batch without view lists gets all cameras whose frames hold a point, and its covariances.
    """
    survey, views = batch.survey, batch.views
    consistent.check_consistent(survey.cameras)
    result = np.zeros((len(batch), consistent.COLUMNS))
    used = np.zeros(len(survey.cameras), np.bool_)
    rule, frames, asked = rule_of(survey), frames_of(survey.cameras), 0
    if views is not None:
        rule, frames = rule._replace(least_cosine2=0.0), no_frames(len(survey.cameras))
    elif survey.settings.dimensions == "all":
        asked = len(batch)
    errors = uncertainty.budget_of(survey), uncertainty.level_sigma_of(batch)
    covariance, (order, first) = np.zeros((asked, 6)), cells.neighbours_in_cells(batch)
    in_tiles(
        _correct_cells, len(first) - 1, (order, first), batch.chosen(), rig_of(survey), frames,
        rule, optics_of(survey.cameras), errors, (result, used, covariance), points=len(batch),
    )  # fmt: skip
    found = consistent.intersection_of(result, used)
    if views is not None:  # the covariances follow for all methods alike
        return found
    return uncertainty.with_errors(found, covariance if asked else None)


@kernel(allocates=True)
def _correct_cells(
    span: Span, in_cells: tuple[IntArray, IntArray], points: Chosen, rig: Rig, frames: Frames,
    rule: Rule, optics: Optics, errors: tuple[Budget, FloatArray],
    found: tuple[FloatArray, BoolArray, FloatArray],
) -> None:  # fmt: skip
    """Correct the points of each cell, a tile at a time."""
    (order, first), (budget, level_sigma), (result, used, covariance) = in_cells, errors, found
    low, high = tiling.corners_of(order[first[span[0]] : first[span[1]]], points.xyz)
    around = tiling.cameras_around(frames, rig.centres, low, high)
    tile, lines, room = np.empty(7 * TILE), np.empty(11 * TILE), np.empty(_RUNS * TILE)
    # the polynomials of each camera, and the cell that they are of
    terms, of = np.empty((len(rig.centres), _WIDTH)), np.full(len(rig.centres), -1)
    single = consistent.room_for(len(rig.centres))
    for t in range(*span):
        inside = order[first[t] : first[t + 1]]
        # a first look at a tile spread over the cell: which cameras see how many of its points
        every = (inside.size + TILE - 1) // TILE
        near, marks = _look(
            lines, tile, inside[::every].copy(), points, rig, frames, rule, around
        )  # fmt: skip
        seen = np.array([marks[k].sum() for k in range(near.size)])
        few = every * seen.sum() <= LEAST_POINTS * np.count_nonzero(seen)
        if not few:
            cell = _cell_of(inside, near[2.0 * seen >= seen.max()], points, optics, single)
        for at in range(0, inside.size, TILE):
            rows = inside[at : at + TILE]
            near, marks = _look(lines, tile, rows, points, rig, frames, rule, around)
            room[_SERVES * TILE :] = 0.0
            if not few:
                for c in near:
                    if of[c] != t:
                        _fit_camera(terms[c], c, cell, optics, single)
                        of[c] = t
                _place(room, tile, rows.size, cell.box)
                _add_cameras(room, marks, near, terms)
                distance, pixel = _nearest(cell.box, near, rig)
                _step(room, lines, rows.size, cell.middle, distance, pixel)
            single = _write(
                result, used, rows, room, lines, marks, near, (points, optics), single
            )  # fmt: skip
            if len(covariance):
                sums = room_of(tile, result, rows)
                for k in range(near.size):
                    uncertainty.add_errors(sums, tile, marks[k], rig, near[k], rule, budget)
                uncertainty.finish_tile(covariance, rows, sums, tile, level_sigma, budget)


@device(allocates=True)
def _look(
    lines: FloatArray, tile: FloatArray, rows: IntArray, points: Chosen, rig: Rig, frames: Frames,
    rule: Rule, around: IntArray,
) -> tuple[IntArray, FloatArray]:  # fmt: skip
    """Fill a tile and the sums of its refracted lines; return its cameras and their marks.

    A camera that the view list of a point names twice counts once here.
    """
    low, high = tiling.gather(tile, rows, points)
    if points.start.size:
        near, marks = tiling.marks_of_lists(points.start, points.camera, rows, len(rig.centres))
        marks = np.minimum(marks, 1.0)
    else:
        near, marks = tiling.marks_in_frame(
            around, tile, frames, rig.centres, low, high, rows.size
        )  # fmt: skip
    # the last run is the least squared cosine of the incidence angles
    lines[: 10 * TILE], lines[10 * TILE :] = 0.0, 1.0
    seeing = 0
    for k in range(near.size):
        if add_camera(lines, tile, marks[k], None, rig, near[k], rule, None, None, near):
            near[seeing], marks[seeing] = near[k], marks[k]
            seeing += 1
    return near[:seeing], marks[:seeing]


@device(allocates=True)
def _cell_of(rows: IntArray, common: IntArray, points: Chosen, optics: Optics, room: Room) -> _Cell:
    """Return a cell, with the Q0 of the cameras that most of its points have in common."""
    box = cells.box_of(rows, points)
    nodes, shift = cells.nodes_of(box, points), np.zeros((len(cells.SOME), consistent.COLUMNS))
    for k in range(len(cells.SOME)):
        consistent.correct_one(
            shift[k], nodes, cells.SOME[k], common, optics, None, None, room
        )  # fmt: skip
    return _Cell(box, nodes, cells.FIT_SOME @ shift[:, :3].copy())


@device(allocates=True)
def _fit_camera(terms: FloatArray, c: int, cell: _Cell, optics: Optics, room: Room) -> None:
    """Write what camera c adds in a cell; NaN where it has no image of some of it."""
    values = np.empty((len(NODES), _VALUES))
    ray, sums, g, slope = room[0][0], room[1], room[2], room[3]
    for k in range(len(NODES)):
        q = 0.0, 0.0, 0.0
        for j in range(QUADRATIC):
            q = beyond(q, BASIS[k, j], row_of(cell.middle, j))
        # g and its derivative by Q, for this camera only
        g[:], slope[:] = 0.0, 0.0
        consistent.begin(ray, sums, cell.nodes, k, c, None, None, -1)
        consistent.add_image(ray, optics, c)
        consistent.add_residual(g, slope, q, ray, c, optics, cell.nodes.n, None, None)
        for i in range(3):
            values[k, i] = g[i]
            for j in range(3):
                values[k, _SLOPE + 3 * i + j] = slope[i, j]
    cells.fit(terms, cells.FIT_CUBIC, values[:, :_SLOPE])
    cells.fit(terms[_REST:], cells.FIT_QUADRATIC, values[:, _SLOPE:])
    # the corners were not fitted: there the polynomials are off most
    for k in range(cells.AT_CORNERS):
        for i in range(_SLOPE):
            lack = -values[INSIDE + k, i]
            for j in range(CUBIC):
                lack += BASIS[INSIDE + k, j] * terms[_SLOPE * j + i]
            terms[_LACK + _SLOPE * k + i] = lack
    if not np.isfinite(terms).all():
        terms[:] = np.nan


@device
def _place(room: FloatArray, tile: FloatArray, count: int, box: Box) -> None:
    """Set where the points of a tile lie in the box, and whether its plane of water is theirs."""
    for j in range(count):
        x, y, z = tile[j], tile[TILE + j], tile[2 * TILE + j]
        room[j], room[TILE + j], room[2 * TILE + j] = cells.in_box(box, (x, y, z))
        off = abs(tile[3 * TILE + j] - cells.water_at(box, x, y))
        up = tile[6 * TILE + j]
        b, c = tile[4 * TILE + j] + up * box.water[1], tile[5 * TILE + j] + up * box.water[2]
        under = max(off, max(abs(b), abs(c))) <= cells.SAME_PLANE
        room[_SERVES * TILE + j] = 1.0 if under else 0.0


@device(allocates=True)
def _add_cameras(room: FloatArray, marks: FloatArray, near: IntArray, terms: FloatArray) -> None:
    """Set the values of the polynomials at the points of a tile.

    Cameras that see all points are added up first and evaluated once.
    """
    room[_G * TILE : _DISTANCE * TILE] = 0.0
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
        cells.add_cubic(room, _G + f, terms[f:_REST:_SLOPE], marks)
    for f in range(_REST_VALUES):
        cells.add_quadratic(room, _BY_Q + f, terms[_REST + f : _LACK : _REST_VALUES], marks)
    for f in range(3 * cells.AT_CORNERS):
        lack = terms[_LACK + f]
        for j in range(marks.size):
            room[(_LACKS + f) * TILE + j] += lack if marks[j] > 0.0 else 0.0


@device
def _nearest(box: Box, near: IntArray, rig: Rig) -> tuple[float, float]:
    """Return the distance of the nearest camera from a box, metres, and its pixel size, rad."""
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
    """Take the Newton step from Q0; a point serves where it lacks little and its rays meet."""
    for axis in range(3):
        cells.add_quadratic(room, _Q + axis, middle[:, axis], room[_SERVES * TILE :][:count])
    lack2, step2 = (LACK_PX * pixel * distance) ** 2, STEP_PX * pixel * distance * distance
    for j in range(count):
        _, inverse = uncertainty.inverse_of(nine(room, _BY_Q * TILE + j))
        for i in range(9):
            room[(_BY_Q + i) * TILE + j] = inverse[i]
    # what g lacks at a corner moves Q by (d g / d Q)^-1 of it
    for corner in range(cells.AT_CORNERS):
        for j in range(count):
            lack = three(room, (_LACKS + 3 * corner) * TILE + j)
            x, y, z = uncertainty.product_of(nine(room, _BY_Q * TILE + j), lack)
            serves = x * x + y * y + z * z <= lack2
            room[_SERVES * TILE + j] = room[_SERVES * TILE + j] if serves else 0.0
    for j in range(count):
        g = three(room, _G * TILE + j)
        x, y, z = uncertainty.product_of(nine(room, _BY_Q * TILE + j), g)
        k, s = lines[9 * TILE + j], nine(lines, j)
        m00, m11 = k - s[0], k - s[3]
        det, _ = cofactors((m00, -s[1], -s[2], m11, -s[4], 2.0 * k - m00 - m11))
        q = minus(three(room, _Q * TILE + j), (x, y, z))
        # after a step s the error is about s^2 by the distance
        serves = (x * x + y * y + z * z <= step2) & (det >= MIN_DETERMINANT * k * k * k)
        room[_SERVES * TILE + j] = room[_SERVES * TILE + j] if serves else 0.0
        room[_Q * TILE + j], room[(_Q + 1) * TILE + j], room[(_Q + 2) * TILE + j] = q
        room[_DISTANCE * TILE + j] = consistent.ray_distance(k, s, q)


@device(allocates=True)
def _write(
    result: FloatArray, used: BoolArray, rows: IntArray, room: FloatArray, lines: FloatArray,
    marks: FloatArray, near: IntArray, given: tuple[Chosen, Optics], single: Room,
) -> Room:  # fmt: skip
    """Write the rows of a tile, and mark the cameras of the points that move.

    A point that does not serve is solved by itself. Returns the room for that, which may have
    grown.
    """
    points, optics = given
    listed = points.start.size > 0
    for j in range(rows.size):
        i, k = rows[j], lines[9 * TILE + j]
        named = cells.cameras_of(points, i) if listed else near[:0]
        if room[_SERVES * TILE + j] > 0.0 and not (listed and named.size != k):
            cosine2 = lines[10 * TILE + j]
            q, distance = three(room, _Q * TILE + j), room[_DISTANCE * TILE + j]
            consistent.write_row(result[i], q, distance, k, cosine2)
        else:
            cameras = named if listed else near[marks[:, j] > 0.0]
            if cameras.size > len(single[0]):
                single = consistent.room_for(cameras.size)
            consistent.correct_one(result[i], points, i, cameras, optics, None, None, single)
        for at in range(near.size):
            # threads may write it at once: always the same value
            if marks[at, j] > 0.0 and result[i, consistent.RAYS] > 0.0 and not used[near[at]]:
                used[near[at]] = True
    return single

r"""Poses mended from nothing but the cloud that they made: an unaware adjustment undone.

An ordinary bundle adjustment that knew nothing of the water came to rest where its residuals r no
longer pulled at any of its unknowns:

    sum J'r = 0 for every image,   sum G'r = 0 for the lens,   sum B'r = 0 for every point

with the Jacobians J, G and B of its own straight collinearity, at its own solution. That is all
that is known of the images where tie points are missing: not the residuals, but that they are
orthogonal to these columns. So the true poses and points are looked for whose images through the
water, pi(Q), give r = pi(Q) - pi_old(P) with

    J_old' r = 0,   G_old' r = 0,   B_old' r = 0

as many equations as unknowns (Petrov and Galerkin's way: the residual is tested with other columns
than those that move it). They leave out the shift, turn and scale of the block, which GNSS
positions or control points decide. Taking pi_old(P) for measurements instead, and minimising r,
pulls the solution back to where the old one was, the more the better the images count.

Points of the apparent cloud stand for the tie points of that adjustment, which were spread in much
the same way.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pcfix.adjust.block import LEAST_SQUARES, Given, State
from pcfix.adjust.normal import PARTS, Workspace, in_parts, linearise, point_block, solved
from pcfix.adjust.observe import POINT, WATER, WIDTH, scratch
from pcfix.adjust.problem import (
    LogRow,
    Problem,
    Progress,
    Solution,
    counts_of,
    priors_at,
    survey_cost,
)
from pcfix.adjust.solve import moved_by
from pcfix.errors import GeometryError
from pcfix.kernels import Span, device, kernel
from pcfix.lens.algebra import inverted
from pcfix.model import BoolArray, FloatArray, IntArray

MAX_STEPS = 25
CLOSE_M = 1e-7
LARGE_STEP_M = 1e4


class _Rows(NamedTuple):
    """The observations of one point: columns of both sides, residuals, cameras, V and its side."""

    right: FloatArray
    left: FloatArray
    r: FloatArray
    who: IntArray
    v: FloatArray
    rhs: FloatArray


def straight_columns(problem: Problem, start: Solution, apparent_xyz: FloatArray) -> FloatArray:
    """Return the Jacobians of the straight collinearity at the old solution.

    Parameters
    ----------
    apparent_xyz : array, shape (m, 3)
        The points that the old adjustment saw, block frame.

    Returns
    -------
    array, shape (o, 2, 9 + g)
        By pose, point and what all share; the residuals are orthogonal to these columns.
    """
    seen, o = problem.seen, len(problem.seen.camera)
    tests = np.zeros((o, 2, WATER + problem.columns.total))
    dry = seen._replace(wet=np.zeros(len(seen.wet), np.bool_), weight=np.ones(o))
    state = start.state._replace(xyz=np.ascontiguousarray(apparent_xyz))
    _columns(state, problem.given._replace(seen=dry), tests)
    return tests


@kernel(allocates=True)
def _columns(state: State, given: Given, tests: FloatArray) -> None:
    room, own, r, start = scratch(), np.empty((2, WIDTH)), np.empty(2), given.seen.start
    shared = np.zeros((2, given.columns.total))
    for p in range(len(state.xyz)):
        for o in range(start[p], start[p + 1]):
            if linearise(state, given, LEAST_SQUARES, p, o, room, own, shared, r):
                tests[o, :, :WATER], tests[o, :, WATER:] = own[:, :WATER], shared


def solve_unaware(
    problem: Problem,
    start: Solution,
    tests: FloatArray,
    is_tested: BoolArray,
    progress: Progress | None = None,
) -> Solution:
    """Find poses, lens and points at which the residuals are orthogonal to the old columns.

    Parameters
    ----------
    problem, start : Problem, Solution
        Of `pcfix.adjust.problem.prepare`; observations of the cloud are where the old cameras image
        the apparent points.
    tests : array, shape (o, 2, 9 + g)
        Of `straight_columns`.
    is_tested : array of bool, shape (m,)
        Points of the cloud. The others, control points, are adjusted by least squares.

    Raises
    ------
    GeometryError
        If the equations are singular or Newton's steps do not shrink.
    """
    now, log, before = start, list(start.log), np.inf
    for number in range(1, MAX_STEPS + 1):
        step, points = _newton(problem, now, tests, is_tested)
        moved = moved_by(problem, now, step, points)
        size = float(np.abs(points).max(initial=0.0)) if np.isfinite(points).all() else np.inf
        if moved is None or not size < LARGE_STEP_M:
            raise GeometryError(
                "the poses cannot be mended from the cloud: the steps grow without bound; give"
                " tie points, GNSS positions of more images, or control points."
            )
        now = moved
        cost = survey_cost(problem, now) + priors_at(problem, now).cost
        row = LogRow(1, number, cost, 0.0, *counts_of(problem, now))
        log.append(row)
        if progress is not None:
            progress(row)
        if size < CLOSE_M:
            return replace(now, cost=cost, log=log)
        before = size
    raise GeometryError(
        f"the poses cannot be mended from the cloud: after {MAX_STEPS} steps points still move by"
        f" {before:.2g} m; give tie points, GNSS positions of more images, or control points."
    )


def _newton(
    problem: Problem, now: Solution, tests: FloatArray, is_tested: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the step of all that are not points, shape (6 k + g,), and that of the points."""
    from scipy.linalg import solve as solve_full

    size = len(problem.moves)
    parts = PARTS if size <= 3000 else 2
    matrix, right = np.zeros((parts, size, size)), np.zeros((parts, size))
    common = now.state, problem.given, tests, is_tested
    seen, g = problem.given.seen, problem.given.columns.total
    in_parts(_sum_tested, seen, g, *common, matrix, right, parts=parts)
    total, side = matrix.sum(axis=0), right.sum(axis=0)
    del matrix
    extra = priors_at(problem, now)
    total += extra.matrix if extra.matrix.ndim == 2 else np.diag(extra.matrix)
    side += extra.right
    step = np.zeros(size)
    active = np.flatnonzero(problem.moves)
    scale = 1.0 / np.sqrt(np.maximum(np.abs(total.diagonal()[active]), 1e-300))
    part = total[np.ix_(active, active)] * scale * scale[:, None]
    try:
        step[active] = scale * solve_full(part, scale * side[active])
    except np.linalg.LinAlgError:
        raise GeometryError(
            "the poses cannot be mended from the cloud: the equations are singular; GNSS positions"
            " of three images or more, or three control points, are needed."
        ) from None
    points = np.zeros((len(now.state.xyz), 3))
    in_parts(_tested_points, seen, g, *common, step, points)
    return step, points


@device(allocates=True)
def _rows(most: int, g: int) -> _Rows:
    """Return room for so many observations."""
    right, left = np.empty((most, 2, WATER + g)), np.empty((most, 2, WATER + g))
    r, who = np.empty((most, 2)), np.empty(most, np.int64)
    return _Rows(right, left, r, who, np.empty((3, 3)), np.empty(3))


@device(allocates=True)
def _gather(
    state: State, given: Given, tests: FloatArray, tested: bool, p: int, rows: _Rows,
    work: Workspace,
) -> int:  # fmt: skip
    """Fill in the columns of a point's observations and V, inverted; how many count.

    Columns of `right` and `left`: pose, point, shared. The block V and its right side are B_l'B
    and B_l'r.
    """
    right, left, r, who, v, rhs = rows
    seen, own, common = given.seen, work.own[0], work.shared[0]
    v[:], rhs[:], count = 0.0, 0.0, 0
    for o in range(seen.start[p], seen.start[p + 1]):
        if not linearise(state, given, LEAST_SQUARES, p, o, work.room, own, common, r[count]):
            continue
        right[count, :, :WATER] = own[:, :WATER]
        right[count, :, WATER:] = common
        if tested:
            left[count] = seen.weight[o] * tests[o]
        else:
            left[count] = right[count]
        for i in range(3):
            for a in range(2):
                rhs[i] += left[count, a, POINT + i] * r[count, a]
                for j in range(3):
                    v[i, j] += left[count, a, POINT + i] * right[count, a, POINT + j]
        who[count] = seen.camera[o]
        count += 1
    if count == 0:
        return 0
    if tested:
        return count if inverted(v, 1e-12) else 0
    return count if point_block(v, rhs, given.priors, state.xyz[p], p, 0.0) else 0


@kernel(allocates=True)
def _sum_tested(
    span: Span, part: int, state: State, given: Given, tests: FloatArray, is_tested: BoolArray,
    matrix: FloatArray, side: FloatArray, work: Workspace,
) -> None:  # fmt: skip
    g, k, most = given.columns.total, len(state.centres), len(work.own)
    rows = _rows(most, g)
    right, left, r, who, v, rhs = rows
    size = 6 * most + g
    column = np.empty(size, np.int64)
    w_right, w_left = np.empty((3, size)), np.empty((size, 3))
    for p in range(*span):
        count = _gather(state, given, tests, is_tested[p], p, rows, work)
        if count == 0:
            continue
        used = 6 * count + g
        w_right[:, :used], w_left[:used] = 0.0, 0.0
        for i in range(g):
            column[6 * count + i] = 6 * k + i
        for o in range(count):
            for i in range(6):
                column[6 * o + i] = 6 * who[o] + i
            _add_direct(matrix[part], side[part], right[o], left[o], r[o], 6 * who[o], 6 * k, g)
            for a in range(2):
                for j in range(3):
                    bl, br = left[o, a, POINT + j], right[o, a, POINT + j]
                    for i in range(6):
                        w_left[6 * o + i, j] += left[o, a, i] * br
                        w_right[j, 6 * o + i] += bl * right[o, a, i]
                    for i in range(g):
                        w_left[6 * count + i, j] += left[o, a, WATER + i] * br
                        w_right[j, 6 * count + i] += bl * right[o, a, WATER + i]
        for i in range(used):
            y0 = w_left[i, 0] * v[0, 0] + w_left[i, 1] * v[1, 0] + w_left[i, 2] * v[2, 0]
            y1 = w_left[i, 0] * v[0, 1] + w_left[i, 1] * v[1, 1] + w_left[i, 2] * v[2, 1]
            y2 = w_left[i, 0] * v[0, 2] + w_left[i, 1] * v[1, 2] + w_left[i, 2] * v[2, 2]
            side[part, column[i]] -= y0 * rhs[0] + y1 * rhs[1] + y2 * rhs[2]
            row = matrix[part, column[i]]
            for j in range(used):
                row[column[j]] -= y0 * w_right[0, j] + y1 * w_right[1, j] + y2 * w_right[2, j]


@device
def _add_direct(
    matrix: FloatArray, side: FloatArray, right: FloatArray, left: FloatArray, r: FloatArray,
    at: int, border: int, g: int,
) -> None:  # fmt: skip
    """Add what one observation gives to the unknowns that are not its point."""
    for a in range(2):
        for i in range(6 + g):
            row, value = (at + i, left[a, i]) if i < 6 else (border + i - 6, left[a, WATER + i - 6])
            side[row] += value * r[a]
            for j in range(6):
                matrix[row, at + j] += value * right[a, j]
            for j in range(g):
                matrix[row, border + j] += value * right[a, WATER + j]


@kernel(allocates=True)
def _tested_points(
    span: Span, part: int, state: State, given: Given, tests: FloatArray, is_tested: BoolArray,
    moved: FloatArray, steps: FloatArray, work: Workspace,
) -> None:  # fmt: skip
    g, k = given.columns.total, len(state.centres)
    rows = _rows(len(work.own), g)
    right, left, _, who, v, rhs = rows
    for p in range(*span):
        count = _gather(state, given, tests, is_tested[p], p, rows, work)
        for o in range(count):
            for a in range(2):
                change = 0.0
                for i in range(6):
                    change += right[o, a, i] * moved[6 * who[o] + i]
                for i in range(g):
                    change += right[o, a, WATER + i] * moved[6 * k + i]
                for i in range(3):
                    rhs[i] -= left[o, a, POINT + i] * change
        if count:
            solved(v, rhs, steps[p])

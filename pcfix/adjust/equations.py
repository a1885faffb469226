"""The reduced normal equations as a matrix: put together, solved, and as they are at a solution.

`undamped` has them without damping and robust loss. A point that its observations do not fix, as
one image's or one of parallel rays, tells nothing of the cameras; without damping it cannot be
eliminated, and is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.adjust.block import LEAST_SQUARES, Given, Loss, State
from pcfix.adjust.conditions import condition
from pcfix.adjust.normal import (
    Sums,
    Workspace,
    add_point,
    in_parts,
    linearise,
    normal_equations,
    point_block,
)
from pcfix.adjust.observe import POINT, WIDTH, scratch
from pcfix.adjust.problem import Problem, Solution, priors_at
from pcfix.kernels import Span, device, kernel
from pcfix.lens.algebra import inverted
from pcfix.model import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from scipy.sparse import csc_array


DENSE_UP_TO = 6000
"""Unknowns up to which a full matrix is quicker than a sparse one, and small (288 MB)."""


class Reduced(NamedTuple):
    """The system of the unknowns that are not points.

    matrix : dense array or scipy's sparse one, shape (a, a), of the active unknowns.
    right : shape (a,).
    active : rows, of poses and then of what is shared, that move.
    """

    matrix: FloatArray | csc_array
    right: FloatArray
    active: IntArray


def reduced_at(
    problem: Problem, found: Solution, loss: Loss = LEAST_SQUARES, damping: float = 0.0
) -> Reduced:
    """Return the normal equations at a solution, without the points, priors included.

    The damping is a factor on the diagonal before the points were eliminated.
    """
    k, g, pairs = len(found.state.centres), problem.columns.total, problem.slots[1]
    size, active = 6 * k + g, np.flatnonzero(problem.moves)
    sums = normal_equations(found.state, problem.given, loss, damping, problem.slots)
    _, extra, extra_right = priors_at(problem, found)
    right = np.concatenate([sums.poses.ravel(), sums.shared]) + extra_right
    diagonal = np.concatenate([sums.diagonal.ravel(), sums.shared_diagonal])
    own = np.diag(extra) if extra.ndim == 2 else extra
    if size <= DENSE_UP_TO:
        matrix = np.zeros((size, size))
        blocks = matrix[: 6 * k, : 6 * k].reshape(k, 6, k, 6)
        blocks[pairs[:, 0], :, pairs[:, 1], :] = sums.blocks
        blocks[pairs[:, 1], :, pairs[:, 0], :] = sums.blocks.transpose(0, 2, 1)
        matrix[: 6 * k, 6 * k :] = sums.border.reshape(6 * k, g)
        matrix[6 * k :, : 6 * k] = matrix[: 6 * k, 6 * k :].T
        matrix[6 * k :, 6 * k :] = sums.corner
        if extra.ndim == 2:
            matrix += extra
        else:
            matrix[np.diag_indices(size)] += extra
        matrix[np.diag_indices(size)] += damping * (diagonal + own)
        return Reduced(matrix[np.ix_(active, active)], right[active], active)
    from scipy import sparse

    total = _sparse(sums, pairs, k, g)
    total += sparse.csc_array(extra) if extra.ndim == 2 else sparse.diags_array(extra)
    total += sparse.diags_array(damping * (diagonal + own))
    return Reduced(total.tocsc()[active][:, active], right[active], active)


def _sparse(sums: Sums, pairs: IntArray, k: int, g: int) -> Any:
    from scipy import sparse

    i, j = pairs[:, 0], pairs[:, 1]
    six = np.arange(6)
    rows = np.broadcast_to((6 * i)[:, None, None] + six[:, None], sums.blocks.shape)
    cols = np.broadcast_to((6 * j)[:, None, None] + six[None, :], sums.blocks.shape)
    off = i != j
    values = [sums.blocks.ravel(), sums.blocks[off].ravel()]
    r = [rows.ravel(), cols[off].ravel()]
    c = [cols.ravel(), rows[off].ravel()]
    body = sparse.coo_array(
        (np.concatenate(values), (np.concatenate(r), np.concatenate(c))), (6 * k, 6 * k)
    )
    if g == 0:
        return body.tocsc()
    border = sparse.csc_array(sums.border.reshape(6 * k, g))
    parts: Any = [[body, border], [border.T, sparse.csc_array(sums.corner)]]
    return sparse.block_array(parts).tocsc()


def solver(reduced: Reduced) -> Callable[[FloatArray], FloatArray] | None:
    """Return a function that solves for a right side; None where the matrix is not definite."""
    if reduced.matrix.shape[0] == 0:
        return lambda right: right
    diagonal = reduced.matrix.diagonal()
    if not (diagonal > 0.0).all():
        return None
    scale = 1.0 / np.sqrt(diagonal)
    solve = (
        _dense(reduced.matrix * scale * scale[:, None])
        if isinstance(reduced.matrix, np.ndarray)
        else _factored(reduced.matrix, scale)
    )
    if solve is None:
        return None
    return lambda right: (solve((right.T * scale).T).T * scale).T


def _dense(scaled: FloatArray) -> Callable[[FloatArray], FloatArray] | None:
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    try:
        factor = cho_factor(scaled, lower=True)
    except LinAlgError:
        return None
    return lambda right: np.asarray(cho_solve(factor, right))


def _factored(matrix: csc_array, scale: FloatArray) -> Callable[[FloatArray], FloatArray] | None:
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    scaled = diags_array(scale) @ matrix @ diags_array(scale)
    try:
        lu = splu(
            scaled.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )  # fmt: skip
    except RuntimeError:
        return None
    return lambda right: np.asarray(lu.solve(right))


FLAT = 1e-11
"""Of a point's normal matrix: determinant over product of the diagonal, below which it counts as
singular; rays at less than about 1e-5 rad."""


class Undamped(NamedTuple):
    """The equations, and what they were made of.

    problem : observations of points that are not fixed have no weight.
    is_fixed : shape (m,), points that their observations, or their survey, fix.
    """

    reduced: Reduced
    problem: Problem
    is_fixed: BoolArray


def undamped(problem: Problem, found: Solution) -> Undamped:
    """Return the reduced normal equations at a solution."""
    is_fixed = np.zeros(len(found.state.xyz), np.bool_)
    _find_fixed(found.state, problem.given, is_fixed)
    counts = np.repeat(is_fixed, np.diff(problem.seen.start))
    weight = np.where(counts, problem.seen.weight, 0.0)
    problem = replace(problem, seen=problem.seen._replace(weight=weight))
    return Undamped(reduced_at(problem, found), problem, is_fixed)


def point_covariances(equations: Undamped, found: Solution, inverse: FloatArray) -> FloatArray:
    """Return the covariances of the points: V^-1 + V^-1 W' S^-1 W V^-1, shape (m, 6).

    They are xx, xy, xz, yy, yz, zz in square metres for observations of unit weight; NaN of points
    that are not fixed. The inverse S^-1, shape (a, a), is of the active unknowns.
    """
    problem = equations.problem
    place = np.full(len(problem.moves), -1, np.int64)
    place[equations.reduced.active] = np.arange(len(equations.reduced.active))
    out = np.full((len(found.state.xyz), 6), np.nan)
    given = problem.given
    fixed = equations.is_fixed, place
    in_parts(
        _point_covariances, given.seen, given.columns.total, found.state, given, fixed, inverse, out
    )
    return out


@kernel(allocates=True)
def _find_fixed(state: State, given: Given, is_fixed: BoolArray) -> None:
    """Find the points whose normal matrix V, priors included, is not singular."""
    room, seen = scratch(), given.seen
    own, shared, r = np.empty((2, WIDTH)), np.zeros((2, given.columns.total)), np.empty(2)
    v, rhs = np.empty((3, 3)), np.zeros(3)
    for p in range(len(state.xyz)):
        v[:] = 0.0
        for o in range(seen.start[p], seen.start[p + 1]):
            if linearise(state, given, LEAST_SQUARES, p, o, room, own, shared, r):
                add_point(v, rhs, own, r)
        if condition(state, given, p, own, shared, r):
            add_point(v, rhs, own, r)
        for i in range(3):
            v[i, i] += given.priors.weight[p, i]
        is_fixed[p] = inverted(v, FLAT)


@kernel(allocates=True)
def _point_covariances(
    span: Span, part: int, state: State, given: Given, fixed: tuple[BoolArray, IntArray],
    inverse: FloatArray, out: FloatArray, work: Workspace,
) -> None:  # fmt: skip
    g, poses, seen, most = given.columns.total, 6 * len(state.centres), given.seen, len(work.own)
    room, own, shared, r = work.room, work.own[0], work.shared[0], work.r[0]
    (is_fixed, place), v, rhs = fixed, work.v, work.rhs
    w, at = np.empty((6 * most + g, 3)), np.empty(6 * most + g, np.int64)
    for p in range(*span):
        if not is_fixed[p]:
            continue
        v[:], w[:g], size = 0.0, 0.0, g
        for i in range(g):
            at[i] = place[poses + i]
        for o in range(seen.start[p], seen.start[p + 1]):
            if not linearise(state, given, LEAST_SQUARES, p, o, room, own, shared, r):
                continue
            add_point(v, rhs, own, r)
            for j in range(3):
                b0, b1 = own[0, POINT + j], own[1, POINT + j]
                for i in range(g):
                    w[i, j] += shared[0, i] * b0 + shared[1, i] * b1
                for i in range(6):
                    w[size + i, j] = own[0, i] * b0 + own[1, i] * b1
            for i in range(6):
                at[size + i] = place[6 * seen.camera[o] + i]
            size += 6
        if size > g and condition(state, given, p, own, shared, r):
            add_point(v, rhs, own, r)
            for i in range(g):
                for j in range(3):
                    w[i, j] += shared[0, i] * own[0, POINT + j]
        point_block(v, rhs, given.priors, state.xyz[p], p, 0.0)
        _add_up(v, w[:size], at[:size], inverse, out[p])


@device(allocates=True)
def _add_up(
    v: FloatArray, w: FloatArray, at: IntArray, inverse: FloatArray, out: FloatArray
) -> None:
    """Fill in V^-1 + Y' S^-1 Y with Y = W V^-1, of the unknowns that move."""
    y = np.empty((len(at), 3))
    count = 0
    for i in range(len(at)):
        if at[i] < 0:
            continue
        at[count] = at[i]
        for j in range(3):
            y[count, j] = w[i, 0] * v[0, j] + w[i, 1] * v[1, j] + w[i, 2] * v[2, j]
        count += 1
    total = v.copy()
    for i in range(count):
        s0, s1, s2 = 0.0, 0.0, 0.0
        for j in range(count):
            q = inverse[at[i], at[j]]
            s0, s1, s2 = s0 + q * y[j, 0], s1 + q * y[j, 1], s2 + q * y[j, 2]
        for j in range(3):
            total[j, 0] += y[i, j] * s0
            total[j, 1] += y[i, j] * s1
            total[j, 2] += y[i, j] * s2
    out[0], out[1], out[2] = total[0, 0], total[0, 1], total[0, 2]
    out[3], out[4], out[5] = total[1, 1], total[1, 2], total[2, 2]

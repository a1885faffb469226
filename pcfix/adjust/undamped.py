"""The reduced normal equations at a solution as they are: no damping, no robust loss.

A point that its observations do not fix, as one image's or one of parallel rays, tells nothing of
the cameras; without damping it cannot be eliminated, and is left out.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit, prange

from pcfix.adjust.normal import PARTS, SQUARES, Loss, linearise, normal_equations, point_block
from pcfix.adjust.observe import POINT, WIDTH
from pcfix.adjust.reduced import Reduced, assemble
from pcfix.adjust.solve import priors_at
from pcfix.threads import one_caller

if TYPE_CHECKING:
    from pcfix.adjust.normal import PointPriors
    from pcfix.adjust.solve import Problem, Solution
    from pcfix.adjust.state import Columns, Seen, State, Surface
    from pcfix.model import BoolArray, FloatArray, IntArray

FLAT = 1e-11
"""Of a point's normal matrix: determinant over product of the diagonal, below which it counts as
singular; rays at less than about 1e-5 rad."""


class Undamped(NamedTuple):
    """The equations, and what they were made of.

    reduced : Reduced
    problem : Problem
        Observations of points that are not fixed have no weight.
    is_fixed : array of bool, shape (m,)
        Points that their observations, or their survey, fix.
    """

    reduced: Reduced
    problem: Problem
    is_fixed: BoolArray


def undamped(problem: Problem, found: Solution) -> Undamped:
    """Return the reduced normal equations at a solution."""
    is_fixed = np.zeros(len(found.state.xyz), np.bool_)
    with one_caller():
        _find_fixed(
            found.state, problem.seen, problem.surface, problem.columns, problem.priors,
            problem.pivot, is_fixed,
        )  # fmt: skip
    counts = np.repeat(is_fixed, np.diff(problem.seen.start))
    weight = np.where(counts, problem.seen.weight, 0.0)
    problem = replace(problem, seen=problem.seen._replace(weight=weight))
    sums = normal_equations(
        found.state, problem.seen, problem.surface, problem.columns, problem.priors,
        Loss(SQUARES), 0.0, problem.slots, problem.pivot,
    )  # fmt: skip
    extra = priors_at(problem, found)
    reduced = assemble(sums, problem.slots[1], 0.0, extra.matrix, extra.right, problem.moves)
    return Undamped(reduced, problem, is_fixed)


def point_covariances(equations: Undamped, found: Solution, inverse: FloatArray) -> FloatArray:
    """Return the covariances of the points: V^-1 + V^-1 W' S^-1 W V^-1.

    Parameters
    ----------
    equations : Undamped
    found : Solution
    inverse : array, shape (a, a)
        S^-1, of the active unknowns.

    Returns
    -------
    array, shape (m, 6)
        xx, xy, xz, yy, yz, zz in square metres for observations of unit weight; NaN of points
        that are not fixed.
    """
    problem = equations.problem
    place = np.full(len(problem.moves), -1, np.int64)
    place[equations.reduced.active] = np.arange(len(equations.reduced.active))
    out = np.full((len(found.state.xyz), 6), np.nan)
    with one_caller():
        _point_covariances(
            found.state, problem.seen, problem.surface, problem.columns, problem.priors,
            problem.pivot, equations.is_fixed, place, inverse, out,
        )  # fmt: skip
    return out


@njit(cache=True, error_model="numpy", nogil=True)
def _find_fixed(
    state: State, seen: Seen, surface: Surface, columns: Columns, priors: PointPriors,
    pivot: FloatArray, is_fixed: BoolArray,
) -> None:  # fmt: skip
    """Find the points whose normal matrix V, priors included, is not singular."""
    light, plane, ahead = np.empty((3, 12)), np.empty(4), np.empty(3)
    own, shared, r = np.empty((2, WIDTH)), np.zeros((2, columns.total)), np.empty(2)
    v = np.empty((3, 3))
    for p in range(len(state.xyz)):
        v[:] = 0.0
        for o in range(seen.start[p], seen.start[p + 1]):
            if linearise(
                state, seen, surface, columns, SQUARES, 1.0, pivot, p, o,
                light, plane, ahead, own, shared, r,
            ):  # fmt: skip
                b = own[:, POINT : POINT + 3]
                for i in range(3):
                    for j in range(3):
                        v[i, j] += b[0, i] * b[0, j] + b[1, i] * b[1, j]
        for i in range(3):
            v[i, i] += priors.weight[p, i]
        det = (
            v[0, 0] * (v[1, 1] * v[2, 2] - v[1, 2] * v[1, 2])
            - v[0, 1] * (v[0, 1] * v[2, 2] - v[0, 2] * v[1, 2])
            + v[0, 2] * (v[0, 1] * v[1, 2] - v[0, 2] * v[1, 1])
        )
        is_fixed[p] = det > FLAT * v[0, 0] * v[1, 1] * v[2, 2]


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _point_covariances(
    state: State, seen: Seen, surface: Surface, columns: Columns, priors: PointPriors,
    pivot: FloatArray, is_fixed: BoolArray, place: IntArray, inverse: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    for part in prange(PARTS):
        m, g, poses = len(state.xyz), columns.total, 6 * len(state.centres)
        most = 0
        for p in range(part * m // PARTS, (part + 1) * m // PARTS):
            most = max(most, seen.start[p + 1] - seen.start[p])
        light, plane, ahead = np.empty((3, 12)), np.empty(4), np.empty(3)
        own, shared, r = np.empty((2, WIDTH)), np.zeros((2, g)), np.empty(2)
        v, nothing = np.empty((3, 3)), np.zeros(3)
        w, at = np.empty((6 * most + g, 3)), np.empty(6 * most + g, np.int64)
        for p in range(part * m // PARTS, (part + 1) * m // PARTS):
            if not is_fixed[p]:
                continue
            v[:], w[:g], size = 0.0, 0.0, g
            for i in range(g):
                at[i] = place[poses + i]
            for o in range(seen.start[p], seen.start[p + 1]):
                if not linearise(
                    state, seen, surface, columns, SQUARES, 1.0, pivot, p, o,
                    light, plane, ahead, own, shared, r,
                ):  # fmt: skip
                    continue
                for j in range(3):
                    b0, b1 = own[0, POINT + j], own[1, POINT + j]
                    for i in range(3):
                        v[i, j] += own[0, POINT + i] * b0 + own[1, POINT + i] * b1
                    for i in range(g):
                        w[i, j] += shared[0, i] * b0 + shared[1, i] * b1
                    for i in range(6):
                        w[size + i, j] = own[0, i] * b0 + own[1, i] * b1
                for i in range(6):
                    at[size + i] = place[6 * seen.camera[o] + i]
                size += 6
            point_block(v, nothing, priors, state.xyz[p], p, 0.0)
            _add_up(v, w[:size], at[:size], inverse, out[p])


@njit(cache=True, error_model="numpy", nogil=True)
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

r"""The normal equations of a block, reduced to poses and shared unknowns.

With the residual r = measured minus computed image, weighted, and the Jacobians J (pose), G (shared
unknowns: lens, water, similarity) and B (point) of one observation, a point contributes

    U = J'J,  U_g = J'G,  U_gg = G'G,  V = sum B'B,  W = J'B,  W_g = sum G'B

As each point is seen by few cameras, it is eliminated at once (Schur complement):

    S_ij -= W_i V^-1 W_j',   S_ig -= W_i V^-1 W_g',   S_gg -= W_g V^-1 W_g'

Only pairs of cameras that share a point have a block in S, so the cost is linear in the points. The
points are summed in a fixed number of parts, so that the result does not depend on the threads.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pcfix.adjust.block import PLANES
from pcfix.adjust.collinearity import (
    POINT,
    SURFACE,
    Given,
    State,
    Workspace,
    condition,
    image,
    image_and_all_gradients,
    lens_gradients,
    workspace,
)
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import inverted
from pcfix.model import BoolArray, FloatArray, IntArray

PARTS = 8
LOST = 1e6
"""Cost of an observation whose point has left its image, as a weighted square."""

SQUARES, HUBER, CAUCHY = range(3)


class Rule(NamedTuple):
    """How normal equations are summed.

    kind : loss function; scale : where it departs from least squares, in standard deviations.
    damping : Levenberg-Marquardt's factor on the diagonal of V (that of the poses is added later).
    singular : determinant of V over the product of its diagonal, below which a point is left out.
    """

    kind: int = SQUARES
    scale: float = 1.0
    damping: float = 0.0
    singular: float = 1e-14


PLAIN = Rule()
UNDAMPED = Rule(singular=1e-11)
"""Leaves out points whose rays meet at less than about 1e-5 rad, which have no finite covariance.
"""


def in_parts(run: Callable[[Span, int, Workspace], None], given: Given, parts: int = PARTS) -> None:
    """Call ``run((first, last), part, workspace)`` for all parts of the points, in threads."""
    m = len(given.start) - 1

    def run_all(span: Span) -> None:
        work = workspace(given)
        for part in range(*span):
            run((part * m // parts, (part + 1) * m // parts), part, work)

    in_tiles(run_all, parts)


# One point


@device
def linearise(
    state: State, given: Given, rule: Rule, p: int, o: int, work: Workspace, at: int
) -> bool:
    """Fill a row of the workspace with an observation's weighted residual and derivatives.

    Returns whether the observation counts.
    """
    own, shared, r = work.own[at], work.shared[at], work.r[at]
    c, w = given.camera[o], given.weight[o]
    if w == 0.0:
        return False
    u, v = image_and_all_gradients(state, given, p, c, work, own)
    r[0], r[1] = given.image_xy[o, 0] - u, given.image_xy[o, 1] - v
    square = w * w * (r[0] * r[0] + r[1] * r[1])
    if not square < np.inf:
        return False
    # a robust loss is least squares with the derivative of the loss as weight
    if rule.kind == HUBER and square > rule.scale * rule.scale:
        w *= np.sqrt(rule.scale / np.sqrt(square))
    elif rule.kind == CAUCHY:
        w *= np.sqrt(1.0 / (1.0 + square / (rule.scale * rule.scale)))
    group = given.group[c]
    first, last = given.first_lens[group], given.first_lens[group + 1]
    shared[:] = 0.0
    if last > first:
        lens, codes = state.lenses[given.lens_row[c]], given.code[first:last]
        lens_gradients(lens, work.ahead, codes, shared[:, first:last])
    for i in range(min(PLANES, given.column.size)):
        if given.column[i] >= 0:
            shared[0, given.column[i]] = own[0, SURFACE + i]
            shared[1, given.column[i]] = own[1, SURFACE + i]
    if given.similarity >= 0:
        _similarity_gradients(state, given, c, own, shared)
    r *= w
    own *= w
    shared *= w
    return True


@device
def _similarity_gradients(
    state: State, given: Given, c: int, own: FloatArray, shared: FloatArray
) -> None:
    """Fill in the derivatives by a shift t, a turn phi and a scale s of all poses together.

    C moves by t + phi x d + s d with d = C - pivot, and R by exp(-R phi) R. Single poses do not
    move then.
    """
    r, pivot, at = state.rotations[c], given.pivot, given.similarity
    dx = state.centres[c, 0] - pivot[0]
    dy = state.centres[c, 1] - pivot[1]
    dz = state.centres[c, 2] - pivot[2]
    for row in range(2):
        cx, cy, cz = own[row, 3], own[row, 4], own[row, 5]
        shared[row, at], shared[row, at + 1], shared[row, at + 2] = cx, cy, cz
        turn = (dy * cz - dz * cy, dz * cx - dx * cz, dx * cy - dy * cx)
        for i in range(3):
            rolled = r[0, i] * own[row, 0] + r[1, i] * own[row, 1] + r[2, i] * own[row, 2]
            shared[row, at + 3 + i] = turn[i] - rolled
        shared[row, at + 6] = dx * cx + dy * cy + dz * cz
        for i in range(6):
            own[row, i] = 0.0


@device
def linearise_point(
    state: State, given: Given, rule: Rule, p: int, work: Workspace
) -> tuple[int, int]:
    """Linearise all observations of a point; invert its normal matrix V = sum B'B in place.

    Returns how many rows of the workspace count, and how many of them are images (the other one is
    a condition). Zero if the rays do not fix the point: then it tells nothing about the cameras.
    """
    v, rhs, count = work.v, work.rhs, 0
    v[:], rhs[:] = 0.0, 0.0
    for o in range(given.start[p], given.start[p + 1]):
        if linearise(state, given, rule, p, o, work, count):
            work.row[count] = o
            _add_point(work, count)
            count += 1
    images = count
    if count and condition(state, given, p, work, count):
        work.row[count] = work.row[0]  # any camera will do: the derivatives by its pose are zero
        _add_point(work, count)
        count += 1
    for i in range(3):
        weight = given.surveyed_weight[p, i]
        v[i, i] += weight
        if weight > 0.0:
            rhs[i] += weight * (given.surveyed_xyz[p, i] - state.xyz[p, i])
    for i in range(3):
        v[i, i] += rule.damping * v[i, i]
    if count == 0 or not inverted(v, rule.singular):
        return 0, 0
    return count, images


@device
def _add_point(work: Workspace, at: int) -> None:
    """Add B'B and B'r of a row."""
    v, rhs, own, r = work.v, work.rhs, work.own[at], work.r[at]
    for i in range(3):
        for j in range(3):
            v[i, j] += own[0, POINT + i] * own[0, POINT + j] + own[1, POINT + i] * own[1, POINT + j]
        rhs[i] += own[0, POINT + i] * r[0] + own[1, POINT + i] * r[1]


@device
def step_of_point(work: Workspace, step: FloatArray) -> None:
    """Fill in V^-1 times the right side."""
    v, rhs = work.v, work.rhs
    for i in range(3):
        step[i] = v[i, 0] * rhs[0] + v[i, 1] * rhs[1] + v[i, 2] * rhs[2]


# Residuals


def residuals(state: State, given: Given) -> FloatArray:
    """Return measured minus computed image coordinates, shape (o, 2), in their unit.

    NaN where the camera does not image the point.
    """
    found = np.empty((len(given.camera), 2))
    in_parts(lambda span, _, work: _residuals(span, state, given, found, work), given)
    return found


@kernel
def _residuals(span: Span, state: State, given: Given, found: FloatArray, work: Workspace) -> None:
    for p in range(*span):
        for o in range(given.start[p], given.start[p + 1]):
            u, v = image(state, given, p, given.camera[o], work)
            found[o, 0], found[o, 1] = given.image_xy[o, 0] - u, given.image_xy[o, 1] - v


def cost_of(squares: FloatArray, rule: Rule) -> float:
    """Return the sum of the loss of weighted squared residuals; NaN ones cost `LOST`."""
    lost = np.isnan(squares)
    s, c2 = np.where(lost, 0.0, squares), rule.scale * rule.scale
    if rule.kind == HUBER:
        s = np.where(s <= c2, s, 2.0 * rule.scale * np.sqrt(s) - c2)
    elif rule.kind == CAUCHY:
        s = c2 * np.log1p(s / c2)
    return float(s.sum() + LOST * lost.sum())


# All points


class Sums(NamedTuple):
    """The reduced normal equations.

    blocks : shape (slots, 6, 6), S_ij of the pairs of cameras of `pair_slots`, i <= j.
    border : shape (k, 6, g); corner : shape (g, g).
    poses, shared : shape (k, 6) and (g,), the right sides.
    diagonal, shared_diagonal : diagonals of U and U_gg, for the damping.
    """

    blocks: FloatArray
    border: FloatArray
    corner: FloatArray
    poses: FloatArray
    shared: FloatArray
    diagonal: FloatArray
    shared_diagonal: FloatArray


def pair_slots(start: IntArray, camera: IntArray, cameras: int) -> tuple[IntArray, IntArray]:
    """Return the block of each pair of cameras, shape (k, k), and the pairs i <= j of the blocks.

    It is -1 for two cameras that share no point.
    """
    from scipy.sparse import csr_array

    sees = csr_array((np.ones(len(camera)), camera, start), (len(start) - 1, cameras))
    share = (sees.T @ sees).toarray() > 0.0
    np.fill_diagonal(share, True)
    i, j = np.nonzero(np.triu(share))
    slot = np.full((cameras, cameras), -1)
    slot[i, j] = slot[j, i] = np.arange(len(i))
    return slot, np.column_stack([i, j])


def normal_equations(
    state: State, given: Given, rule: Rule, slots: tuple[IntArray, IntArray]
) -> Sums:
    """Return the reduced normal equations at a state, `slots` as of `pair_slots`."""
    slot, pairs = slots
    k, g = len(state.centres), given.shared
    shapes = (len(pairs), 6, 6), (k, 6, g), (g, g), (k, 6), (g,), (k, 6), (g,)
    sums = [Sums(*map(np.zeros, shapes)) for _ in range(PARTS)]
    in_parts(
        lambda span, part, work: _sum_up(span, state, given, rule, slot, sums[part], work), given
    )
    return Sums(*(np.sum(each, axis=0) for each in zip(*sums, strict=True)))


@kernel
def _sum_up(
    span: Span, state: State, given: Given, rule: Rule, slot: IntArray, sums: Sums, work: Workspace
) -> None:
    """Add up the reduced normal equations of some points."""
    for p in range(*span):
        count, _ = linearise_point(state, given, rule, p, work)
        work.w_shared[:] = 0.0
        for a in range(count):
            _add_row(sums, given.camera[work.row[a]], slot, work, a)
        for a in range(count):
            _eliminate(sums, given, slot, work, a, count)
        if count:
            _eliminate_shared(sums, work)


@device
def _add_row(sums: Sums, c: int, slot: IntArray, work: Workspace, a: int) -> None:
    """Add U and right sides of one row, of camera c, and keep its W and W_g."""
    own, shared, r, w, w_shared = work.own[a], work.shared[a], work.r[a], work.w[a], work.w_shared
    u, border = sums.blocks[slot[c, c]], sums.border[c]
    g = shared.shape[1]
    for i in range(6):
        for j in range(6):
            u[i, j] += own[0, i] * own[0, j] + own[1, i] * own[1, j]
        for j in range(g):
            border[i, j] += own[0, i] * shared[0, j] + own[1, i] * shared[1, j]
        for j in range(3):
            w[i, j] = own[0, i] * own[0, POINT + j] + own[1, i] * own[1, POINT + j]
        sums.diagonal[c, i] += own[0, i] * own[0, i] + own[1, i] * own[1, i]
        sums.poses[c, i] += own[0, i] * r[0] + own[1, i] * r[1]
    for i in range(g):
        for j in range(g):
            sums.corner[i, j] += shared[0, i] * shared[0, j] + shared[1, i] * shared[1, j]
        for j in range(3):
            w_shared[i, j] += shared[0, i] * own[0, POINT + j] + shared[1, i] * own[1, POINT + j]
        sums.shared_diagonal[i] += shared[0, i] ** 2 + shared[1, i] ** 2
        sums.shared[i] += shared[0, i] * r[0] + shared[1, i] * r[1]


@device
def _eliminate(
    sums: Sums, given: Given, slot: IntArray, work: Workspace, a: int, count: int
) -> None:
    """Subtract the terms of row a with V^-1 from the equations, W_a V^-1 W_b' for all b."""
    v, rhs, w, w_shared, y = work.v, work.rhs, work.w, work.w_shared, work.y
    c = given.camera[work.row[a]]
    for i in range(6):
        for j in range(3):
            y[i, j] = w[a, i, 0] * v[0, j] + w[a, i, 1] * v[1, j] + w[a, i, 2] * v[2, j]
        sums.poses[c, i] -= y[i, 0] * rhs[0] + y[i, 1] * rhs[1] + y[i, 2] * rhs[2]
        for j in range(len(w_shared)):
            sums.border[c, i, j] -= (
                y[i, 0] * w_shared[j, 0] + y[i, 1] * w_shared[j, 1] + y[i, 2] * w_shared[j, 2]
            )
    for b in range(count):
        # each pair of cameras once, the smaller first; both orders if one sees the point twice
        if given.camera[work.row[b]] >= c:
            s = sums.blocks[slot[c, given.camera[work.row[b]]]]
            for i in range(6):
                for j in range(6):
                    s[i, j] -= y[i, 0] * w[b, j, 0] + y[i, 1] * w[b, j, 1] + y[i, 2] * w[b, j, 2]


@device
def _eliminate_shared(sums: Sums, work: Workspace) -> None:
    """Subtract W_g V^-1 W_g' and its right side."""
    v, rhs, w = work.v, work.rhs, work.w_shared
    for i in range(len(w)):
        y0 = w[i, 0] * v[0, 0] + w[i, 1] * v[1, 0] + w[i, 2] * v[2, 0]
        y1 = w[i, 0] * v[0, 1] + w[i, 1] * v[1, 1] + w[i, 2] * v[2, 1]
        y2 = w[i, 0] * v[0, 2] + w[i, 1] * v[1, 2] + w[i, 2] * v[2, 2]
        sums.shared[i] -= y0 * rhs[0] + y1 * rhs[1] + y2 * rhs[2]
        for j in range(len(w)):
            sums.corner[i, j] -= y0 * w[j, 0] + y1 * w[j, 1] + y2 * w[j, 2]


def point_steps(state: State, given: Given, rule: Rule, moved: FloatArray) -> FloatArray:
    """Return the steps of the points, shape (m, 3), given those of all others, (6 k + g,)."""
    steps = np.zeros((len(state.xyz), 3))
    in_parts(
        lambda span, _, work: _point_steps(span, state, given, rule, moved, steps, work), given
    )
    return steps


@kernel
def _point_steps(
    span: Span, state: State, given: Given, rule: Rule, moved: FloatArray, steps: FloatArray,
    work: Workspace,
) -> None:  # fmt: skip
    for p in range(*span):
        count, _ = linearise_point(state, given, rule, p, work)
        for a in range(count):
            own, change = work.own[a], change_of(given, work, a, moved)
            for i in range(3):
                work.rhs[i] -= own[0, POINT + i] * change[0] + own[1, POINT + i] * change[1]
        if count:
            step_of_point(work, steps[p])


@device
def change_of(given: Given, work: Workspace, a: int, moved: FloatArray) -> tuple[float, float]:
    """Return by how much a step of poses and shared unknowns changes row a."""
    own, shared, camera = work.own[a], work.shared[a], 6 * given.camera[work.row[a]]
    first, by_u, by_v = len(moved) - given.shared, 0.0, 0.0
    for i in range(6):
        by_u += own[0, i] * moved[camera + i]
        by_v += own[1, i] * moved[camera + i]
    for i in range(given.shared):
        by_u += shared[0, i] * moved[first + i]
        by_v += shared[1, i] * moved[first + i]
    return by_u, by_v


# Undamped equations at a solution


def fixed_points(state: State, given: Given) -> BoolArray:
    """Return which points are fixed by their observations and their survey, shape (m,)."""
    is_fixed = np.zeros(len(state.xyz), np.bool_)
    in_parts(lambda span, _, work: _fixed_points(span, state, given, is_fixed, work), given)
    return is_fixed


@kernel
def _fixed_points(
    span: Span, state: State, given: Given, is_fixed: BoolArray, work: Workspace
) -> None:
    for p in range(*span):
        is_fixed[p] = linearise_point(state, given, UNDAMPED, p, work)[0] > 0


def point_covariances(
    state: State, given: Given, active: IntArray, inverse: FloatArray
) -> FloatArray:
    """Return the covariances of the points: V^-1 + V^-1 W' S^-1 W V^-1, shape (m, 6).

    They are xx, xy, xz, yy, yz, zz in square metres for observations of unit weight, NaN for points
    that are not fixed. The inverse S^-1, shape (a, a), is that of the active unknowns.
    """
    place = np.full(6 * len(state.centres) + given.shared, -1, np.int64)
    place[active] = np.arange(len(active))
    out = np.full((len(state.xyz), 6), np.nan)
    in_parts(
        lambda span, _, work: _point_covariances(span, state, given, place, inverse, out, work),
        given,
    )
    return out


@kernel(allocates=True)
def _point_covariances(
    span: Span, state: State, given: Given, place: IntArray, inverse: FloatArray, out: FloatArray,
    work: Workspace,
) -> None:  # fmt: skip
    g, v, poses = given.shared, work.v, 6 * len(state.centres)
    y, at = np.empty((6 * len(work.own) + g, 3)), np.empty(6 * len(work.own) + g, np.int64)
    w, total = np.empty(3), np.empty((3, 3))
    for p in range(*span):
        count, _ = linearise_point(state, given, UNDAMPED, p, work)
        if count == 0:
            continue
        # y: rows of W V^-1, of the unknowns that move
        used = 0
        for a in range(count):
            own, camera = work.own[a], 6 * given.camera[work.row[a]]
            for i in range(6):
                if place[camera + i] >= 0:
                    for j in range(3):
                        w[j] = own[0, i] * own[0, POINT + j] + own[1, i] * own[1, POINT + j]
                    at[used], used = place[camera + i], used + 1
                    _times_inverse(w, v, y[used - 1])
        for i in range(g):
            if place[poses + i] >= 0:
                w[:] = 0.0
                for a in range(count):
                    own, by = work.own[a], work.shared[a, :, i]
                    for j in range(3):
                        w[j] += by[0] * own[0, POINT + j] + by[1] * own[1, POINT + j]
                at[used], used = place[poses + i], used + 1
                _times_inverse(w, v, y[used - 1])
        total[:] = v
        for i in range(used):
            s0, s1, s2 = 0.0, 0.0, 0.0
            for j in range(used):
                q = inverse[at[i], at[j]]
                s0, s1, s2 = s0 + q * y[j, 0], s1 + q * y[j, 1], s2 + q * y[j, 2]
            for j in range(3):
                total[j, 0] += y[i, j] * s0
                total[j, 1] += y[i, j] * s1
                total[j, 2] += y[i, j] * s2
        out[p, 0], out[p, 1], out[p, 2] = total[0, 0], total[0, 1], total[0, 2]
        out[p, 3], out[p, 4], out[p, 5] = total[1, 1], total[1, 2], total[2, 2]


@device
def _times_inverse(w: FloatArray, v: FloatArray, y: FloatArray) -> None:
    """Fill in y = w V^-1."""
    for j in range(3):
        y[j] = w[0] * v[0, j] + w[1] * v[1, j] + w[2] * v[2, j]

r"""The normal equations of a block, reduced to the poses: what the kernels sum up.

With the residual r = image measured minus computed, weighted, and the Jacobians J (pose), G (what
all share: lens, water, similarity) and B (point) of one observation, a point contributes

    U = J'J,  U_g = J'G,  U_gg = G'G,  V = sum B'B,  W = J'B,  W_g = sum G'B

and, as each point is seen by few cameras, it is eliminated where it is met (Schur):

    S_ij -= W_i V^-1 W_j',   S_ig -= W_i V^-1 W_g',   S_gg -= W_g V^-1 W_g'

Only pairs of cameras that share a point have a block in S; the cost is linear in the points. The
points go in a fixed number of parts with sums of their own, so that the bits do not depend on the
number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from pcfix.adjust.block import CAUCHY, HUBER, PLANES, Given, Loss, PointPriors, Seen, State, Surface
from pcfix.adjust.conditions import condition
from pcfix.adjust.observe import (
    POINT,
    WATER,
    WIDTH,
    Scratch,
    image,
    image_and_all_gradients,
    lens_gradients,
    scratch,
)
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import inverted
from pcfix.model import FloatArray, IntArray

PARTS = 8
LOST = 1e6
"""What an observation costs whose point got out of sight, in its weighted square."""


class Sums(NamedTuple):
    """The reduced normal equations before damping.

    blocks : shape (slots, 6, 6), S_ij of the pairs of `slot`, i <= j.
    border : shape (k, 6, g); corner : shape (g, g).
    poses, shared : shape (k, 6) and (g,), the right sides.
    diagonal, shared_diagonal : of U and U_gg, for the damping.
    """

    blocks: FloatArray
    border: FloatArray
    corner: FloatArray
    poses: FloatArray
    shared: FloatArray
    diagonal: FloatArray
    shared_diagonal: FloatArray


def pair_slots(seen: Seen, cameras: int) -> tuple[IntArray, IntArray]:
    """Return which block each pair of cameras has.

    Returns
    -------
    slot : array, shape (k, k)
        -1 where two cameras share no point.
    pairs : array, shape (slots, 2)
        i <= j.
    """
    from scipy.sparse import csr_array

    images = np.ones(len(seen.camera)), seen.camera, seen.start
    sees = csr_array(images, (len(seen.start) - 1, cameras))
    share = (sees.T @ sees).toarray() > 0.0
    np.fill_diagonal(share, True)
    i, j = np.nonzero(np.triu(share))
    slot = np.full((cameras, cameras), -1)
    slot[i, j] = slot[j, i] = np.arange(len(i))
    return slot, np.column_stack([i, j])


class Workspace(NamedTuple):
    """Room for the observations of a point, at most `most`, and g unknowns that all share.

    room : of `pcfix.adjust.observe`.
    own, shared, r : shapes (most, 2, `WIDTH`), (most, 2, g) and (most, 2), of `linearise`.
    who : shape (most,), their cameras.
    v, rhs : shapes (3, 3) and (3,), of the point.
    w, w_g : shapes (most, 6, 3) and (g, 3).
    y : shape (6, 3).
    """

    room: Scratch
    own: FloatArray
    shared: FloatArray
    r: FloatArray
    who: IntArray
    v: FloatArray
    rhs: FloatArray
    w: FloatArray
    w_g: FloatArray
    y: FloatArray


def workspace(seen: Seen, g: int) -> Workspace:
    """Return new room."""
    most = int(np.diff(seen.start).max(initial=0)) + 1  # the last for a `condition`
    shapes = (most, 2, WIDTH), (most, 2, g), (most, 2)
    own, shared, r = (np.zeros(shape) for shape in shapes)
    v, rhs, w, w_g, y = (np.zeros(shape) for shape in ((3, 3), 3, (most, 6, 3), (g, 3), (6, 3)))
    return Workspace(scratch(), own, shared, r, np.empty(most, np.int64), v, rhs, w, w_g, y)


def in_parts(run: Callable[..., None], seen: Seen, g: int, *given: Any, parts: int = PARTS) -> None:
    """Run a kernel for each part of the points, as many at a time as there are threads.

    Called is ``run((first, last), part, *given, workspace)`` with the points of the part.
    """
    m = len(seen.start) - 1

    def run_all(span: Span) -> None:
        work = workspace(seen, g)
        for part in range(*span):
            run((part * m // parts, (part + 1) * m // parts), part, *given, work)

    in_tiles(run_all, parts)


def normal_equations(
    state: State, given: Given, loss: Loss, damping: float, slots: tuple[IntArray, IntArray]
) -> Sums:
    """Return the reduced normal equations at a state, `slots` as of `pair_slots`.

    The damping is Levenberg-Marquardt's factor on the diagonal of V; that of the poses is added
    later.
    """
    slot, pairs = slots
    k, g = len(state.centres), given.columns.total
    shapes = (len(pairs), 6, 6), (k, 6, g), (g, g), (k, 6), (g,), (k, 6), (g,)
    sums = Sums(*(np.zeros((PARTS, *shape)) for shape in shapes))
    in_parts(_sum_up, given.seen, g, state, given, (loss, damping), slot, sums)
    return Sums(*(part.sum(axis=0) for part in sums))


def point_steps(
    state: State, given: Given, loss: Loss, damping: float, moved: FloatArray
) -> FloatArray:
    """Return the steps of the points, shape (m, 3), given those of all the rest, (6 k + g,)."""
    steps = np.zeros((len(state.xyz), 3))
    seen, g = given.seen, given.columns.total
    in_parts(_point_steps, seen, g, state, given, (loss, damping), moved, steps)
    return steps


def residuals(state: State, seen: Seen, surface: Surface) -> FloatArray:
    """Return measured minus computed places in the images, shape (o, 2), in their unit.

    NaN where the camera does not image the point.
    """
    found = np.empty((len(seen.camera), 2))
    in_parts(_residuals, seen, 0, state, seen, surface, found)
    return found


def cost_of(squares: FloatArray, loss: Loss) -> float:
    """Return the sum of what weighted squared residuals cost; NaN ones cost `LOST`."""
    lost = np.isnan(squares)
    s = np.where(lost, 0.0, squares)
    c2 = loss.scale * loss.scale
    if loss.kind == HUBER:
        s = np.where(s <= c2, s, 2.0 * loss.scale * np.sqrt(s) - c2)
    elif loss.kind == CAUCHY:
        s = c2 * np.log1p(s / c2)
    return float(s.sum() + LOST * lost.sum())


@device
def _influence(square: float, loss: Loss) -> float:
    """Return the derivative of the loss by the square: the weight of the observation."""
    if loss.kind == HUBER:
        return 1.0 if square <= loss.scale * loss.scale else loss.scale / np.sqrt(square)
    if loss.kind == CAUCHY:
        return 1.0 / (1.0 + square / (loss.scale * loss.scale))
    return 1.0


@kernel
def _residuals(
    span: Span, part: int, state: State, seen: Seen, surface: Surface, found: FloatArray,
    work: Workspace,
) -> None:  # fmt: skip
    for p in range(*span):
        for o in range(seen.start[p], seen.start[p + 1]):
            u, v = image(state, seen, surface, p, seen.camera[o], work.room)
            found[o, 0], found[o, 1] = seen.image_xy[o, 0] - u, seen.image_xy[o, 1] - v


@device
def linearise(
    state: State, given: Given, loss: Loss, p: int, o: int, room: Scratch,
    own: FloatArray, shared: FloatArray, r: FloatArray,
) -> bool:  # fmt: skip
    """Fill in the weighted residual and Jacobians of one observation; whether it counts.

    `own`, shape (2, `WIDTH`), by pose, point and water; `shared`, shape (2, g); `r`, shape (2,).
    """
    seen, columns = given.seen, given.columns
    c = seen.camera[o]
    if seen.weight[o] == 0.0:
        return False
    u, v = image_and_all_gradients(state, seen, given.surface, p, c, room, own)
    r[0], r[1] = seen.image_xy[o, 0] - u, seen.image_xy[o, 1] - v
    w = seen.weight[o]
    square = w * w * (r[0] * r[0] + r[1] * r[1])
    if not square < np.inf:
        return False
    w *= np.sqrt(_influence(square, loss))
    group = seen.group[c]
    first, last = columns.lens[group], columns.lens[group + 1]
    shared[:] = 0.0
    if last > first:
        lens, codes = state.lenses[seen.lens_row[c]], columns.code[first:last]
        lens_gradients(lens, room.ahead, codes, shared[:, first:last])
    for i in range(min(PLANES, columns.water.size)):
        if columns.water[i] >= 0:
            shared[0, columns.water[i]] = own[0, WATER + i]
            shared[1, columns.water[i]] = own[1, WATER + i]
    if columns.similarity >= 0:
        _similarity_gradients(state, c, own, columns.pivot, shared, columns.similarity)
    r *= w
    own *= w
    shared *= w
    return True


@device
def _similarity_gradients(
    state: State, c: int, own: FloatArray, pivot: FloatArray, shared: FloatArray, at: int
) -> None:
    """Fill in the derivatives by a shift, a turn phi and a scale of all poses together.

    C moves by t + phi x d + s d with d = C - pivot, and R by exp(-R phi) R. The poses do not move
    on their own then.
    """
    r = state.rotations[c]
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
def point_block(
    v: FloatArray, rhs: FloatArray, priors: PointPriors, xyz: FloatArray, p: int, damping: float
) -> bool:
    """Add prior and damping to V and its right side, and invert V in place."""
    for i in range(3):
        weight = priors.weight[p, i]
        v[i, i] += weight
        if weight > 0.0:
            rhs[i] += weight * (priors.xyz[p, i] - xyz[i])
    for i in range(3):
        v[i, i] += damping * v[i, i]
    return inverted(v, 1e-14)


@kernel
def _sum_up(
    span: Span, part: int, state: State, given: Given, rule: tuple[Loss, float], slot: IntArray,
    sums: Sums, work: Workspace,
) -> None:  # fmt: skip
    """Add up the equations of the points of a part in its row of the sums."""
    of_part = Sums(
        sums.blocks[part], sums.border[part], sums.corner[part], sums.poses[part],
        sums.shared[part], sums.diagonal[part], sums.shared_diagonal[part],
    )  # fmt: skip
    start, (loss, damping) = given.seen.start, rule
    room, own, shared, r, who, v, rhs, w, w_g, _ = work
    for p in range(*span):
        v[:], rhs[:], count = 0.0, 0.0, 0
        for o in range(start[p], start[p + 1]):
            if linearise(state, given, loss, p, o, room, own[count], shared[count], r[count]):
                who[count] = given.seen.camera[o]
                add_point(v, rhs, own[count], r[count])
                count += 1
        if count and condition(state, given, p, own[count], shared[count], r[count]):
            who[count] = who[0]  # of whose pose it says nothing
            add_point(v, rhs, own[count], r[count])
            count += 1
        # a point that its rays do not fix says nothing of the cameras either
        if count == 0 or not point_block(v, rhs, given.priors, state.xyz[p], p, damping):
            continue
        w_g[:] = 0.0
        for a in range(count):
            _add_pose(of_part, who[a], slot, w[a], own[a], shared[a], r[a])
            _add_shared(of_part, w_g, own[a], shared[a], r[a])
        _eliminate(of_part, slot, who[:count], work)


@device
def add_point(v: FloatArray, rhs: FloatArray, own: FloatArray, r: FloatArray) -> None:
    """Add B'B and B'r."""
    for i in range(3):
        for j in range(3):
            v[i, j] += own[0, POINT + i] * own[0, POINT + j] + own[1, POINT + i] * own[1, POINT + j]
        rhs[i] += own[0, POINT + i] * r[0] + own[1, POINT + i] * r[1]


@device
def _add_pose(
    sums: Sums, c: int, slot: IntArray, w: FloatArray,
    own: FloatArray, shared: FloatArray, r: FloatArray,
) -> None:  # fmt: skip
    """Add J'J, J'G and J'r of camera c, and set W = J'B."""
    u, border = sums.blocks[slot[c, c]], sums.border[c]
    right, diagonal = sums.poses[c], sums.diagonal[c]
    for i in range(6):
        for j in range(6):
            u[i, j] += own[0, i] * own[0, j] + own[1, i] * own[1, j]
        for j in range(shared.shape[1]):
            border[i, j] += own[0, i] * shared[0, j] + own[1, i] * shared[1, j]
        for j in range(3):
            w[i, j] = own[0, i] * own[0, POINT + j] + own[1, i] * own[1, POINT + j]
        diagonal[i] += own[0, i] * own[0, i] + own[1, i] * own[1, i]
        right[i] += own[0, i] * r[0] + own[1, i] * r[1]


@device
def _add_shared(
    sums: Sums, w_g: FloatArray, own: FloatArray, shared: FloatArray, r: FloatArray
) -> None:
    """Add G'G, G'r and G'B."""
    corner, right, diagonal = sums.corner, sums.shared, sums.shared_diagonal
    for i in range(shared.shape[1]):
        for j in range(shared.shape[1]):
            corner[i, j] += shared[0, i] * shared[0, j] + shared[1, i] * shared[1, j]
        for j in range(3):
            w_g[i, j] += shared[0, i] * own[0, POINT + j] + shared[1, i] * own[1, POINT + j]
        diagonal[i] += shared[0, i] ** 2 + shared[1, i] ** 2
        right[i] += shared[0, i] * r[0] + shared[1, i] * r[1]


@device
def _eliminate(sums: Sums, slot: IntArray, who: IntArray, work: Workspace) -> None:
    """Take a point out of the equations, with V inverted."""
    blocks, border, corner, poses, shared_right, _, _ = sums
    v, rhs, w, w_g, y = work.v, work.rhs, work.w, work.w_g, work.y
    g = len(w_g)
    for a in range(who.size):
        c = who[a]
        for i in range(6):
            for j in range(3):
                y[i, j] = w[a, i, 0] * v[0, j] + w[a, i, 1] * v[1, j] + w[a, i, 2] * v[2, j]
            poses[c, i] -= y[i, 0] * rhs[0] + y[i, 1] * rhs[1] + y[i, 2] * rhs[2]
            for j in range(g):
                border[c, i, j] -= y[i, 0] * w_g[j, 0] + y[i, 1] * w_g[j, 1] + y[i, 2] * w_g[j, 2]
        for b in range(who.size):
            # each pair once, the smaller camera first; one that sees the point twice, all ways
            if who[b] >= c:
                s = blocks[slot[c, who[b]]]
                for i in range(6):
                    for j in range(6):
                        s[i, j] -= (
                            y[i, 0] * w[b, j, 0] + y[i, 1] * w[b, j, 1] + y[i, 2] * w[b, j, 2]
                        )
    for i in range(g):
        y0 = w_g[i, 0] * v[0, 0] + w_g[i, 1] * v[1, 0] + w_g[i, 2] * v[2, 0]
        y1 = w_g[i, 0] * v[0, 1] + w_g[i, 1] * v[1, 1] + w_g[i, 2] * v[2, 1]
        y2 = w_g[i, 0] * v[0, 2] + w_g[i, 1] * v[1, 2] + w_g[i, 2] * v[2, 2]
        shared_right[i] -= y0 * rhs[0] + y1 * rhs[1] + y2 * rhs[2]
        for j in range(g):
            corner[i, j] -= y0 * w_g[j, 0] + y1 * w_g[j, 1] + y2 * w_g[j, 2]


@kernel
def _point_steps(
    span: Span, part: int, state: State, given: Given, rule: tuple[Loss, float],
    moved: FloatArray, steps: FloatArray, work: Workspace,
) -> None:  # fmt: skip
    g, seen, poses = given.columns.total, given.seen, 6 * len(state.centres)
    own, shared, r, v, rhs = work.own[0], work.shared[0], work.r[0], work.v, work.rhs
    loss, damping = rule
    for p in range(*span):
        v[:], rhs[:], count = 0.0, 0.0, 0
        for o in range(seen.start[p], seen.start[p + 1]):
            if not linearise(state, given, loss, p, o, work.room, own, shared, r):
                continue
            for row in range(2):
                for i in range(6):
                    r[row] -= own[row, i] * moved[6 * seen.camera[o] + i]
                for i in range(g):
                    r[row] -= shared[row, i] * moved[poses + i]
            add_point(v, rhs, own, r)
            count += 1
        if count and condition(state, given, p, own, shared, r):
            for i in range(g):
                r[0] -= shared[0, i] * moved[poses + i]
            add_point(v, rhs, own, r)
        if count and point_block(v, rhs, given.priors, state.xyz[p], p, damping):
            solved(v, rhs, steps[p])


@device
def solved(v: FloatArray, rhs: FloatArray, step: FloatArray) -> None:
    """Fill in the step of a point, with V inverted."""
    for i in range(3):
        step[i] = v[i, 0] * rhs[0] + v[i, 1] * rhs[1] + v[i, 2] * rhs[2]

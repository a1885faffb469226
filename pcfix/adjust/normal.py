r"""The normal equations of a block, reduced to poses and shared unknowns.

With the residual r = measured minus computed image, weighted, and the Jacobians J (pose), G (shared
unknowns: lens and water) and B (point) of one observation, a point contributes

    U = J'J,  U_g = J'G,  U_gg = G'G,  V = sum B'B,  W = J'B,  W_g = sum G'B

As each point is seen by few cameras, it is eliminated at once (Schur complement):

    S_ij -= W_i V^-1 W_j',   S_ig -= W_i V^-1 W_g',   S_gg -= W_g V^-1 W_g'

so that the cost is linear in the points. They are summed in a fixed number of parts, so that the
result does not depend on the threads.

If the residuals shall be orthogonal to other columns than their own derivatives (`Given.tests`),
the first factor of each product has those columns, and S is not symmetric.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from pcfix.adjust.collinearity import (
    POINT,
    SHARED,
    SURFACE,
    Given,
    State,
    Workspace,
    condition,
    image_and_all_gradients,
    lens_gradients,
    workspace,
)
from pcfix.adjust.parameters import PLANES
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import dot, inverted, row_of, times, transposed_times, vector
from pcfix.model import BoolArray, FloatArray, IntArray

PARTS, PARTS_BYTES = 8, 100_000_000  # parts in which points are summed, bytes of their matrices
DENSE_UP_TO = 6000  # unknowns up to which a full matrix (288 MB) is faster than a sparse one
POINTS_AT_ONCE = 5000
LOST = 1e6  # cost of an observation whose point has left its image, as a weighted square

SQUARES, HUBER, CAUCHY = range(3)
LOSS_SCALE = 2.0  # where a robust loss departs from least squares, in standard deviations


class Rule(NamedTuple):
    """How normal equations are summed."""

    loss: int = SQUARES
    # Levenberg-Marquardt's factor on the diagonal of V; that of the poses is added later
    damping: float = 0.0


UNDAMPED = Rule()
# Determinant of V over the product of its diagonal, below which a point does not count: its rays
# meet at less than about 1e-5 rad, so that it has no finite covariance.
SINGULAR = 1e-11


def in_parts(
    run: Callable[..., None], state: State, given: Given, *more: Any, sums: Sequence[Any] = ()
) -> None:
    """Call ``run((first, last), state, given, *more, workspace)`` for parts of the points.

    With `sums` there are as many parts, and each call gets its own after the others.
    """
    m, parts = len(given.start) - 1, len(sums) or PARTS

    def run_all(span: Span) -> None:
        work = workspace(given)
        for part in range(*span):
            first, last = part * m // parts, (part + 1) * m // parts
            run((first, last), state, given, *more, *sums[part : part + 1], work)

    in_tiles(run_all, parts)


# One point


@device
def linearise_point(
    state: State, given: Given, rule: Rule, p: int, work: Workspace
) -> tuple[int, int]:
    """Linearise all observations of a point; invert its normal matrix V = sum B'B in place.

    Returns how many rows of the workspace count, and how many of them are images (the other one is
    a condition). Zero if the rays do not fix the point: then it does not constrain the cameras.
    """
    v, rhs, own, count = work.v, work.rhs, work.own, 0
    v[:], rhs[:] = 0.0, 0.0
    for o in range(given.start[p], given.start[p + 1]):
        c, w, row, r = given.camera[o], given.weight[o], work.right[count], work.r[count]
        if w == 0.0:
            continue
        u_found, v_found = image_and_all_gradients(state, given, p, c, work, own)
        r[0], r[1] = given.image_xy[o, 0] - u_found, given.image_xy[o, 1] - v_found
        square = w * w * (r[0] * r[0] + r[1] * r[1])
        if not square < np.inf:
            continue
        # a robust loss is least squares with the derivative of the loss as weight
        if rule.loss == HUBER and square > LOSS_SCALE * LOSS_SCALE:
            w *= np.sqrt(LOSS_SCALE / np.sqrt(square))
        elif rule.loss == CAUCHY:
            w *= np.sqrt(1.0 / (1.0 + square / (LOSS_SCALE * LOSS_SCALE)))
        # derivatives by pose and point, then by shared unknowns: lens, water and port
        first, last = given.first_lens[given.group[c]], given.first_lens[given.group[c] + 1]
        shared = row[:, SHARED:]
        shared[:] = 0.0
        if last > first:
            lens, codes = state.lenses[given.lens_row[c]], given.code[first:last]
            lens_gradients(lens, work.ahead, codes, shared[:, first:last])
        for axis in range(2):
            for i in range(SURFACE):
                row[axis, i] = own[axis, i]
            for i in range(min(PLANES, given.column.size)):
                if given.column[i] >= 0:
                    shared[axis, given.column[i]] = own[axis, SURFACE + i]
        r *= w
        row *= w
        work.row[count] = o
        _add_point(given, work, count)
        count += 1
    images = count
    if count and condition(state, given, p, work, count):
        work.row[count] = work.row[0]  # any camera will do: the derivatives by its pose are zero
        _add_point(given, work, count)
        count += 1
    for i in range(3):
        weight = given.surveyed_weight[p, i]
        v[i, i] += weight
        if weight > 0.0:
            rhs[i] += weight * (given.surveyed_xyz[p, i] - state.xyz[p, i])
        v[i, i] += rule.damping * v[i, i]
    if count == 0 or not inverted(v, SINGULAR):
        return 0, 0
    return count, images


@device
def _add_point(given: Given, work: Workspace, at: int) -> None:
    """Set what tests a row, and add its B'B and B'r."""
    v, rhs, right, left, r = work.v, work.rhs, work.right[at], work.left[at], work.r[at]
    o = work.row[at]
    # in least squares `left` and `right` are one array; tests exist for the images of the cloud
    if len(given.tests):
        for axis in range(2):
            for i in range(left.shape[1]):
                is_tested = o < len(given.tests)
                test = given.weight[o] * given.tests[o, axis, i] if is_tested else right[axis, i]
                left[axis, i] = test
    for i in range(POINT, POINT + 3):
        for j in range(3):
            v[i - POINT, j] += left[0, i] * right[0, POINT + j] + left[1, i] * right[1, POINT + j]
        rhs[i - POINT] += left[0, i] * r[0] + left[1, i] * r[1]


# Residuals


def residuals(state: State, given: Given) -> FloatArray:
    """Return measured minus computed image coordinates, shape (o, 2), in their unit.

    NaN where the camera does not image the point.
    """
    found = np.empty((len(given.camera), 2))
    in_parts(_residuals, state, given, found)
    return found


@kernel
def _residuals(span: Span, state: State, given: Given, found: FloatArray, work: Workspace) -> None:
    for p in range(*span):
        for o in range(given.start[p], given.start[p + 1]):
            u, v = image_and_all_gradients(state, given, p, given.camera[o], work, work.own)
            found[o, 0], found[o, 1] = given.image_xy[o, 0] - u, given.image_xy[o, 1] - v


def cost_of(state: State, given: Given, loss: int) -> float:
    """Return the sum of the loss of the weighted squared residuals; NaN ones cost `LOST`."""
    used = given.weight > 0.0
    squares = (residuals(state, given)[used] ** 2).sum(axis=1) * given.weight[used] ** 2
    lost = np.isnan(squares)
    s, c2 = np.where(lost, 0.0, squares), LOSS_SCALE * LOSS_SCALE
    if loss == HUBER:
        s = np.where(s <= c2, s, 2.0 * LOSS_SCALE * np.sqrt(s) - c2)
    elif loss == CAUCHY:
        s = c2 * np.log1p(s / c2)
    return float(s.sum() + LOST * lost.sum())


# All points


class Equations(NamedTuple):
    """The reduced normal equations of poses and shared unknowns, u = 6 k + g."""

    matrix: Any  # (u, u), dense or scipy's sparse one
    right: FloatArray  # (u,)
    diagonal: FloatArray  # (u,), that of U and U_gg, for the damping


def normal_equations(state: State, given: Given, rule: Rule) -> Equations:
    """Return the reduced normal equations at a state."""
    size = 6 * len(state.centres) + given.shared
    if size > DENSE_UP_TO and not len(given.tests):
        total: Any = 0
        right, diagonal = np.zeros((2, size))
        for some in sparse_rows_of(state, given, rule):
            total = some.product(some.others) + total
            right += some.others.T @ some.left_over()
            diagonal += some.others.power(2).sum(axis=0)
        return Equations(total, right, diagonal)
    parts = min(max(PARTS_BYTES // (8 * size * size), 1), PARTS)
    sums = [Equations(np.zeros((size, size)), np.zeros(size), np.zeros(size)) for _ in range(parts)]
    in_parts(_sum_up, state, given, rule, sums=sums)
    for other in sums[1:]:
        for mine, more in zip(sums[0], other, strict=True):
            mine += more
    if not len(given.tests):  # the upper triangle is that below
        for i in range(1, size):
            sums[0].matrix[:i, i] = sums[0].matrix[i, :i]
    return sums[0]


@kernel(allocates=True)
def _sum_up(
    span: Span, state: State, given: Given, rule: Rule, sums: Equations, work: Workspace
) -> None:
    """Add up the reduced normal equations of some points: the lower triangle if symmetric."""
    g, poses, is_tested = given.shared, 6 * len(state.centres), len(given.tests) > 0
    most = 6 * len(work.row) + g
    w, w_right, unknown = np.empty((most, 3)), np.empty((most, 3)), np.empty(most, np.int64)
    for p in range(*span):
        count, _ = linearise_point(state, given, rule, p, work)
        if count == 0:
            continue
        # J'J and J'r of each row
        for a in range(count):
            camera = 6 * given.camera[work.row[a]]
            for axis in range(2):
                left, row, r = work.left[a, axis], work.right[a, axis], work.r[a, axis]
                for i in range(6 + g):
                    # a column of the pose, or a shared one: its row of the matrix
                    column, at = (i, camera + i) if i < 6 else (SHARED + i - 6, poses + i - 6)
                    line, by = sums.matrix[at], left[column]
                    sums.right[at] += by * r
                    sums.diagonal[at] += by * row[column]
                    for j in range(6):
                        line[camera + j] += by * row[j]
                    for j in range(g):
                        line[poses + j] += by * row[SHARED + j]
        # W = J'B of the unknowns: six of each camera, then the shared ones; left and right are
        # exchanged in `w_right`
        used = 6 * count + g
        for i in range(used):
            is_pose = i < 6 * count
            column = i % 6 if is_pose else SHARED + i - 6 * count
            unknown[i] = poses + i - 6 * count
            if is_pose:
                unknown[i] = 6 * given.camera[work.row[i // 6]] + column
            for j in range(3):
                w[i, j], w_right[i, j] = 0.0, 0.0
                # a pose is in one row, a shared unknown in all of them
                for a in range(i // 6 if is_pose else 0, i // 6 + 1 if is_pose else count):
                    left, right = work.left[a], work.right[a]
                    for axis in range(2):
                        w[i, j] += left[axis, column] * right[axis, POINT + j]
                        w_right[i, j] += right[axis, column] * left[axis, POINT + j]
        # minus W V^-1 W' and W V^-1 B'r
        for i in range(used):
            y, line = transposed_times(work.v, vector(w[i])), sums.matrix[unknown[i]]
            sums.right[unknown[i]] -= dot(y, vector(work.rhs))
            for b in range(count + 1):
                # the six columns of a camera, or all shared ones; if S is symmetric, those of the
                # lower triangle
                at, width = 6 * b, 6 if b < count else g
                first = unknown[at] if width else 0
                if first <= unknown[i] or is_tested:
                    for j in range(width):
                        line[first + j] -= dot(y, row_of(w_right, at + j))


def point_steps(state: State, given: Given, rule: Rule, moved: FloatArray) -> FloatArray:
    """Return the steps of the points, shape (m, 3), given those of all others, (6 k + g,)."""
    steps = np.zeros((len(state.xyz), 3))
    in_parts(_point_steps, state, given, rule, moved, steps)
    return steps


@kernel
def _point_steps(
    span: Span, state: State, given: Given, rule: Rule, moved: FloatArray, steps: FloatArray,
    work: Workspace,
) -> None:  # fmt: skip
    # V^-1 B'(r - A x) for the steps x of poses and shared unknowns
    first, v, rhs = len(moved) - given.shared, work.v, work.rhs
    for p in range(*span):
        count, _ = linearise_point(state, given, rule, p, work)
        for a in range(count):
            # by how much the other unknowns change this row
            camera = 6 * given.camera[work.row[a]]
            for axis in range(2):
                row, change = work.right[a, axis], 0.0
                for i in range(6):
                    change += row[i] * moved[camera + i]
                for i in range(given.shared):
                    change += row[SHARED + i] * moved[first + i]
                for i in range(3):
                    rhs[i] -= work.left[a, axis, POINT + i] * change
        if count:
            steps[p, 0], steps[p, 1], steps[p, 2] = times(v, vector(rhs))


# The equations of single observations


class LinearisedRows(NamedTuple):
    """Observations of m points, weighted and linearised; rows that do not count are zero.

    Each point has a row for each observation, and one more for a condition.
    """

    columns: FloatArray  # (n, 2, 9 + g), derivatives by pose, point and shared unknowns
    r: FloatArray  # (n, 2), residuals
    observation: IntArray  # (n,), of a condition any observation of its point
    is_image: BoolArray  # (n,), whether the row is an image, not a condition
    inverse: FloatArray  # (m, 3, 3), V^-1 of each point
    rhs: FloatArray  # (m, 3), and its right side


def linearised(state: State, given: Given, rule: Rule, first: int, last: int) -> LinearisedRows:
    """Return the rows of the points first to last."""
    m = last - first
    n = int(given.start[last] - given.start[first]) + m
    rows = LinearisedRows(
        np.zeros((n, 2, SHARED + given.shared)), np.zeros((n, 2)), np.zeros(n, np.int64),
        np.zeros(n, np.bool_), np.zeros((m, 3, 3)), np.zeros((m, 3)),
    )  # fmt: skip
    _linearised((first, last), state, given, rule, rows, workspace(given))
    return rows


@kernel(allocates=True)
def _linearised(
    span: Span, state: State, given: Given, rule: Rule, rows: LinearisedRows, work: Workspace
) -> None:
    for p in range(*span):
        count, images = linearise_point(state, given, rule, p, work)
        point = p - span[0]
        # each point before has had a row more than observations, for its condition
        first = given.start[p] - given.start[span[0]] + point
        for a in range(count):
            at = first + a
            rows.observation[at], rows.is_image[at] = work.row[a], a < images
            rows.r[at], rows.columns[at] = work.r[a], work.right[a]
        if count:
            rows.rhs[point], rows.inverse[point] = work.rhs, work.v


class SparseRows(NamedTuple):
    """Linearised observations of some points: u and v of each row, as sparse matrices."""

    rows: LinearisedRows
    others: Any  # columns A of poses and shared unknowns
    points: Any  # columns B of the points
    inverse: Any  # V^-1 of all points, a block diagonal matrix
    coupling: Any  # V^-1 B'A

    def product(self, x: Any) -> Any:
        """Return X'A with the points eliminated, X'A - X'B V^-1 B'A."""
        return x.T @ self.others - (x.T @ self.points) @ self.coupling

    def left_over(self) -> FloatArray:
        """Return the residuals of u and v after a step of the points only."""
        step = self.inverse @ self.rows.rhs.ravel()
        return np.asarray(self.rows.r.ravel() - self.points @ step)


def sparse_matrix(values: FloatArray, columns: IntArray, count: int) -> Any:
    """Return a sparse matrix with equally many values in each row, at these columns."""
    from scipy.sparse import csr_array

    first = np.arange(0, columns.size + 1, columns.shape[1])
    return csr_array((values.ravel(), columns.ravel(), first), (len(columns), count))


def sparse_rows_of(state: State, given: Given, rule: Rule) -> Iterator[SparseRows]:
    """Yield the observations of all points, of some thousands at a time to save memory."""
    from scipy.sparse import bsr_array

    k, g, m = len(state.centres), given.shared, len(state.xyz)
    for first in range(0, m, POINTS_AT_ONCE):
        last = min(first + POINTS_AT_ONCE, m)
        rows, numbers = linearised(state, given, rule, first, last), np.arange(last - first)
        # one row more than observations in each point
        owner = np.repeat(numbers, np.diff(given.start[first : last + 1]) + 1)
        pose = 6 * given.camera[rows.observation][:, None] + np.arange(6)
        shared = np.broadcast_to(6 * k + np.arange(g), (len(pose), g))
        of_others = np.repeat(np.hstack([pose, shared]), 2, axis=0)
        of_points = np.repeat(3 * owner[:, None] + np.arange(3), 2, axis=0)
        columns = np.delete(rows.columns, np.s_[POINT:SHARED], axis=2)
        others = sparse_matrix(columns, of_others, 6 * k + g)
        points = sparse_matrix(rows.columns[:, :, POINT:SHARED], of_points, 3 * len(numbers))
        inverse = bsr_array((rows.inverse, numbers, np.arange(len(numbers) + 1))).tocsr()
        yield SparseRows(rows, others, points, inverse, inverse @ (points.T @ others))

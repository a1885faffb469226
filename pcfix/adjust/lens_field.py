"""What a lens does beyond its formula, and what that costs: a smooth field over the frame.

Terms that the formula lacks, or that tests did not find, shift the image alike wherever a feature
falls on the same place of the frame. Most of such a field is taken up by lens, angles and centres;
only the rest shows in the residuals, and says how large the field is. It is thought of as drawn by
chance, smooth over some part of the frame, with a standard deviation s in pixels. With the shifts
e of tiles of the frame as candidates beside the unknowns, R = C - B' A^-1 B and c their pull (see
`pcfix.adjust.lens_choice`), c has the covariance sigma0^2 R + s^2 R K R, where K is what tiles have
in common. Its likelihood says s. The mean over all s and ranges counts, so that a field too small
to be found counts as well. A^-1 B e is by how much the unknowns are off then.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.adjust.block import LEAST_SQUARES, Given, Seen, State
from pcfix.adjust.conditions import condition
from pcfix.adjust.equations import Undamped, solver
from pcfix.adjust.normal import Workspace, add_point, in_parts, linearise, point_block
from pcfix.adjust.observe import POINT
from pcfix.adjust.problem import Solution
from pcfix.kernels import Span, kernel
from pcfix.model import FloatArray, IntArray, Lens

RANGES = (0.2, 0.4, 0.8)
"""Over which parts of half the diagonal a field is smooth: waves of the plate to whole frames."""

LARGEST_PX, STEPS = 2.0, np.linspace(0.0, 1.0, 200)
"""What s may be; a lens that is off by more is another lens."""

NO_FIELD = 1e-9
"""Share of the largest eigenvalue below which a field leaves nothing in the residuals."""


class _Tiles(NamedTuple):
    """Candidates: shifts along u and v of each tile of the frame, 2 t of them.

    pulls : B', shape (2 t, u); matrix : C, shape (2 t, 2 t); right : shape (2 t,).
    """

    pulls: FloatArray
    matrix: FloatArray
    right: FloatArray


def pulls_of_field(
    equations: Undamped, found: Solution, tile: IntArray, sigma0: float
) -> FloatArray:
    """Return how fields as the residuals have them pull at the unknowns, shape (2 t, u).

    The sum of the squares of what these rows move an unknown by is its variance by the field.

    Parameters
    ----------
    tile : array of int, shape (o,)
        Of the frame, from zero on, none without observations; other sensors have others.
    sigma0 : float
        A-posteriori standard deviation of unit weight.
    """
    problem, reduced = equations.problem, equations.reduced
    seen, size, count = problem.seen, len(problem.moves), int(tile.max()) + 1
    tiles = _Tiles(np.zeros((2 * count, size)), np.zeros((2 * count,) * 2), np.zeros(2 * count))
    rows, g = np.ascontiguousarray(tile, np.int64), problem.columns.total
    in_parts(_sum_tiles, seen, g, found.state, problem.given, rows, tiles, parts=1)
    solve_for = solver(reduced)
    if solve_for is None:
        return np.zeros((0, size))
    taken_up = solve_for(np.column_stack([tiles.pulls[:, reduced.active].T, reduced.right]))
    rest = np.column_stack([tiles.matrix, tiles.right])
    rest -= tiles.pulls[:, reduced.active] @ taken_up
    likely, halves = np.zeros((len(RANGES), len(STEPS))), []
    square = (LARGEST_PX * STEPS**3) ** 2  # close where s is small
    for i, common in enumerate(_common(problem.block.cameras.lenses or (), seen, tile)):
        half = np.linalg.cholesky(common + 1e-9 * np.eye(2 * count))
        halves.append(half)
        value, vector = np.linalg.eigh(half.T @ rest[:, :-1] @ half)
        shows = value > NO_FIELD * value[-1]
        pull2 = (vector[:, shows].T @ half.T @ rest[:, -1]) ** 2 / value[shows]
        variance = sigma0**2 + square[:, None] * value[shows]
        likely[i] = -0.5 * (np.log(variance) + pull2 / variance).sum(axis=1)
    weight = np.exp(likely - likely.max()) * STEPS**2  # every s as likely as another before
    s2_of = (weight * square).sum(axis=1) / weight.sum()
    of_all = np.sum([s2 * half @ half.T for s2, half in zip(s2_of, halves, strict=True)], axis=0)
    whole = np.linalg.cholesky(of_all + 1e-12 * np.eye(2 * count))  # rounding must not matter
    return np.asarray(whole.T @ tiles.pulls)


def _common(lenses: tuple[Lens, ...], seen: Seen, tile: IntArray) -> list[FloatArray]:
    """Return what shifts of tiles have in common for each range, shape (2 t, 2 t)."""
    half = 0.5 * np.array([np.hypot(lens.width, lens.height) for lens in lenses])[seen.camera]
    count = np.bincount(tile)
    middle = [np.bincount(tile, seen.image_xy[:, i] / half) / count for i in range(2)]
    sensor = np.bincount(tile, seen.group[seen.camera]) / count
    apart = np.sum([(axis - axis[:, None]) ** 2 for axis in middle], axis=0)
    alike = sensor == sensor[:, None]
    return [
        np.asarray(np.kron(np.where(alike, np.exp(-0.5 * apart / length**2), 0.0), np.eye(2)))
        for length in RANGES
    ]


@kernel(allocates=True)
def _sum_tiles(
    span: Span, part: int, state: State, given: Given, tile: IntArray, sums: _Tiles,
    work: Workspace,
) -> None:  # fmt: skip
    """Add what each observation, shifted by a pixel, and its residual pull, without the points."""
    seen, g, last = given.seen, given.columns.total, 6 * len(state.centres)
    room, own, shared, r, who, v, rhs = work[:7]
    moved, left = np.empty(3), np.empty(2)
    for p in range(*span):
        v[:], rhs[:], count = 0.0, 0.0, 0
        for o in range(seen.start[p], seen.start[p + 1]):
            if linearise(
                state, given, LEAST_SQUARES, p, o, room, own[count], shared[count], r[count]
            ):
                add_point(v, rhs, own[count], r[count])
                who[count] = o
                count += 1
        images = count
        if count and condition(state, given, p, own[count], shared[count], r[count]):
            add_point(v, rhs, own[count], r[count])
            who[count] = who[0]
            count += 1
        if count == 0 or not point_block(v, rhs, given.priors, state.xyz[p], p, 0.0):
            continue
        for a in range(images):
            for row in range(2):
                at, weight, rest = 2 * tile[who[a]] + row, seen.weight[who[a]], r[a, row]
                for i in range(3):
                    moved[i] = 0.0
                    for j in range(3):
                        moved[i] += weight * v[i, j] * own[a, row, POINT + j]
                    rest -= moved[i] * rhs[i] / weight
                sums.right[at] += weight * rest
                for b in range(count):
                    to, camera = 2 * tile[who[b]], 6 * seen.camera[who[b]]
                    for k in range(2):
                        left[k] = weight if a == b and k == row else 0.0
                        for i in range(3):
                            left[k] -= own[b, k, POINT + i] * moved[i]
                        if b < images:
                            sums.matrix[at, to + k] += seen.weight[who[b]] * left[k]
                        for i in range(6):
                            sums.pulls[at, camera + i] += own[b, k, i] * left[k]
                        for i in range(g):
                            sums.pulls[at, last + i] += shared[b, k, i] * left[k]

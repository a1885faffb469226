"""Errors that observations have in common, from how groups of them disagree.

Standard errors by the inverse of the normal matrix hold for errors that know nothing of each other.
Those of matching and of the model do: of neighbouring points, of one image, of one place in the
frame. A group g of observations pulls at the unknowns by its part h of the right side; all together
pull at nothing. Freed of the others it would move them by S^-1 h, and the sum of these squares over
the groups is a variance that holds under errors shared within a group (the sandwich of White 1980
and Liang & Zeger 1986, a delete-a-group jackknife to the first order). Points drawn together by
chance say what it is where points share nothing, and residuals drawn by chance what it is where all
observations are equally good besides. What one exceeds the other by, where an F-test says that it
does, is added to the variances. Places in the frame are too few for that, and the unknowns take up
most of what these share: there a smooth field is looked for (`pcfix.adjust.lens_field`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import fdtri

from pcfix.adjust.block import CX, CY, FOCAL, LEAST_SQUARES, Given, State
from pcfix.adjust.conditions import condition
from pcfix.adjust.equations import Undamped, solver, undamped
from pcfix.adjust.lens_choice import effect_at_corner
from pcfix.adjust.lens_field import pulls_of_field
from pcfix.adjust.normal import Workspace, add_point, in_parts, linearise, point_block
from pcfix.adjust.observe import POINT
from pcfix.adjust.precision import Precision
from pcfix.adjust.problem import Problem, Solution
from pcfix.kernels import Span, kernel
from pcfix.model import FloatArray, IntArray

MOST_TILES, POINTS_PER_TILE, FRAME_TILES = 400, 25, 48
ALONE, FRAME = "observations of different quality", "places in the frame"
NOTED = 0.44
"""Variance by the frame, over the formal one, of which a note is due: standard errors 1.2 times."""

LEAST_GROUPS = 10
"""Fewer say too little of a variance."""
SURE = 0.99
"""Probability at which groups that share nothing would not disagree by so much."""

COMMON_SHARE = 0.5
"""Of the noise of an observation, what all may have in common at the corner of the frame: matching
draws features to the same side by their slant, and what an unaware adjustment threw out is missing
on one side. Focal length and principal point take it up, so that poses and bed are none the worse,
and no residual shows it. Rendered blocks, whose lens is known, had up to 1.5 of this."""

POSE = ("angle about x", "angle about y", "angle about z", "centre x", "centre y", "centre z")


class Disagreement(NamedTuple):
    """By what standard errors grow: of the kinds of `POSE` and the shared unknowns, (6 + g,).

    The notes say which groups disagree.
    """

    factor: FloatArray
    notes: list[str]


def disagreement_of(problem: Problem, found: Solution, formal: Precision) -> Disagreement:
    """Return by what groups of observations say that the standard errors must grow.

    Parameters
    ----------
    formal : Precision
        By the normal matrix.
    """
    groups, added = _groups(problem, found), np.zeros(6 + problem.columns.total)
    counts = {words: len(np.unique(group)) for words, group in groups.items()}
    if counts[ALONE] < LEAST_GROUPS:
        return Disagreement(1.0 + added, [])
    drawn = np.random.default_rng(1).normal(0.0, formal.sigma0, problem.seen.image_xy.shape)
    equations, notes = undamped(problem, found), []
    by_chance = _spread(equations, found, formal, groups[ALONE], drawn)
    for words, count in counts.items():
        if count < LEAST_GROUPS:
            continue
        if words == FRAME:
            field = pulls_of_field(equations, found, groups[words], formal.sigma0)
            more = _share_of(equations, found, formal, field)
            is_more = more > NOTED
        else:
            together = _spread(equations, found, formal, groups[words], np.zeros((0, 2)))
            is_more = together > fdtri(count - 1, counts[ALONE] - 1, SURE) * by_chance
            more = np.where(is_more, together - by_chance, 0.0)
        added += more
        if is_more.any():
            worst = float(np.sqrt((1.0 + more).max()))
            notes.append(f"{words} (up to {worst:.1f} times)")
        if words == ALONE:
            by_chance = by_chance + more
    factor = np.sqrt(1.0 + added)
    if notes:
        notes = [
            f"errors are shared by {', '.join(notes)}; standard errors are larger for it, up to"
            f" {factor.max():.1f} times: {(*POSE, *problem.names)[int(np.argmax(factor))]}."
        ]
    return Disagreement(factor, notes)


def _spread(
    equations: Undamped, found: Solution, formal: Precision, group: IntArray, drawn: FloatArray
) -> FloatArray:
    """Return what groups say of the variances, over the formal ones, by kinds of unknowns."""
    pulls = pulls_of(equations.problem, found, group, drawn)
    return _share_of(equations, found, formal, pulls)


def _share_of(
    equations: Undamped, found: Solution, formal: Precision, pulls: FloatArray
) -> FloatArray:
    """Return the variances of what moves the unknowns by these pulls, over the formal ones."""
    k, active = len(found.state.centres), equations.reduced.active
    poses = np.einsum("kii->ki", formal.pose_covariance)
    variance = np.concatenate([poses.ravel(), [row.sigma**2 for row in formal.shared]])
    solve_for = solver(equations.reduced)
    moved = np.zeros(len(variance))
    moved[active] = 0.0 if solve_for is None else (solve_for(pulls[:, active].T) ** 2).sum(axis=1)
    share = np.divide(moved, variance, out=np.zeros(len(variance)), where=variance > 0.0)
    free = max(int((poses > 0.0).any(axis=1).sum()), 1)
    return np.concatenate([share[: 6 * k].reshape(k, 6).sum(axis=0) / free, share[6 * k :]])


def common_errors(problem: Problem, formal: Precision) -> FloatArray:
    """Return by what standard errors of the lens grow with what all images share, (6 + g,)."""
    factor = np.ones(6 + len(formal.shared))
    ties = problem.seen.weight[problem.seen.weight > 0.0]
    noise_px = formal.sigma0 / float(np.median(ties))
    at = 6
    for rows, codes in zip(problem.groups, problem.codes, strict=True):
        lens = (problem.block.cameras.lenses or ())[rows[0]]
        for code in codes:
            if code in (FOCAL, CX, CY):
                common = COMMON_SHARE * noise_px / effect_at_corner(lens, code)
                factor[at] = np.hypot(1.0, common / formal.shared[at - 6].sigma)
            at += 1
    return factor


def _groups(problem: Problem, found: Solution) -> dict[str, IntArray]:
    """Return the groups of the observations by what they share; `ALONE` is by chance."""
    seen, owner, lenses = problem.seen, problem.block.owner, problem.block.cameras.lenses or ()
    m = len(problem.block.xyz)
    tiles = min(MOST_TILES, m // POINTS_PER_TILE)
    size = np.array([(lens.width, lens.height) for lens in lenses])[seen.camera]
    alone = np.random.default_rng(0).integers(0, max(tiles, 1), m)
    place = _tiles(seen.image_xy / size, FRAME_TILES)
    place += seen.group[seen.camera] * (place.max(initial=0) + 1)
    return {
        ALONE: alone[owner],
        "neighbouring points": _tiles(found.state.xyz[:, :2], tiles)[owner],
        "points of an image": seen.camera,
        FRAME: np.unique(place, return_inverse=True)[1],
    }


def _tiles(xy: FloatArray, count: int) -> IntArray:
    """Return the tile of each place, of about so many square ones over nearly all places."""
    low, high = np.nanpercentile(xy, [1.0, 99.0], axis=0)
    side = max(float(np.sqrt(np.prod(high - low) / max(count, 1))), 1e-9)
    last = np.maximum(np.ceil((high - low) / side) - 1.0, 0.0)
    place = np.clip(np.floor((np.nan_to_num(xy) - low) / side), 0.0, last).astype(np.int64)
    return np.asarray(place[:, 0] * int(last[1] + 1.0) + place[:, 1])


def pulls_of(problem: Problem, found: Solution, group: IntArray, drawn: FloatArray) -> FloatArray:
    """Return the right side of the reduced equations by groups, shape (groups, 6 k + g).

    Parameters
    ----------
    group : array of int, shape (o,)
        Of each observation, from zero on.
    drawn : array, shape (o, 2) or (0, 2)
        Weighted residuals instead of those that there are.
    """
    pulls, given = np.zeros((int(group.max(initial=0)) + 1, len(problem.moves))), problem.given
    rows, g = np.ascontiguousarray(group, np.int64), given.columns.total
    in_parts(_sum_pulls, given.seen, g, found.state, given, rows, drawn, pulls, parts=1)
    return pulls


@kernel(allocates=True)
def _sum_pulls(
    span: Span, part: int, state: State, given: Given, group: IntArray, drawn: FloatArray,
    pulls: FloatArray, work: Workspace,
) -> None:  # fmt: skip
    """Add what each observation pulls: J'r of its own, and J'B V^-1 B'r by its point of all."""
    seen, g, last = given.seen, given.columns.total, 6 * len(state.centres)
    room, own, shared, r, who, v, rhs = work[:7]
    mine, moved = np.empty(3), np.empty(3)
    for p in range(*span):
        v[:], rhs[:], count = 0.0, 0.0, 0
        for o in range(seen.start[p], seen.start[p + 1]):
            if linearise(
                state, given, LEAST_SQUARES, p, o, room, own[count], shared[count], r[count]
            ):
                if len(drawn):
                    r[count, 0], r[count, 1] = drawn[o, 0], drawn[o, 1]
                add_point(v, rhs, own[count], r[count])
                who[count] = o
                count += 1
        if count and condition(state, given, p, own[count], shared[count], r[count]):
            add_point(v, rhs, own[count], r[count])
            who[count] = who[0]
            count += 1
        if count == 0 or not point_block(v, rhs, given.priors, state.xyz[p], p, 0.0):
            continue
        for a in range(count):
            sums = pulls[group[who[a]]]
            for i in range(3):
                mine[i] = own[a, 0, POINT + i] * r[a, 0] + own[a, 1, POINT + i] * r[a, 1]
            for i in range(3):
                moved[i] = v[i, 0] * mine[0] + v[i, 1] * mine[1] + v[i, 2] * mine[2]
            for b in range(count):
                at = 6 * seen.camera[who[b]]
                for row in range(2):
                    left = r[a, row] if a == b else 0.0
                    for i in range(3):
                        left -= own[b, row, POINT + i] * moved[i]
                    for i in range(6):
                        sums[at + i] += own[b, row, i] * left
                    for i in range(g):
                        sums[last + i] += shared[b, row, i] * left

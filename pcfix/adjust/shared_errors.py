"""Errors that observations share, which make standard errors larger.

Standard errors from the inverse normal matrix hold for independent errors. Errors of matching and
of the lens model are shared: by neighbouring points, by one image, by one place in the frame. A
group of observations contributes a part h of the right side; all parts together are zero. Without
the other parts it would move the unknowns by S^-1 h, and the sum of the squares over the groups is
a variance that allows for errors shared within a group (sandwich estimator: White 1980, Liang &
Zeger 1986; to first order a delete-a-group jackknife). Random groups of points give that variance
without shared errors, and random residuals that of observations of equal quality. The excess, if an
F-test confirms it, is added to the variances.

Places in the frame are too few for that, and lens, angles and centres absorb most of what they
share. There a smooth field of image shifts is estimated, as of terms that the lens model lacks: a
random field with standard deviation s in pixels, smooth over some part of the frame. With shifts e
of tiles of the frame as candidates besides the unknowns, R = C - B' A^-1 B and their right sides c
(see `pcfix.adjust.from_ties`), c has the covariance sigma0^2 R + s^2 R K R, where K is the
covariance of the tiles. That gives the likelihood of s. The mean over all s and ranges is used, so
that fields too small to be found count too. The unknowns move by A^-1 B e.
"""

from __future__ import annotations

import numpy as np
from scipy.special import fdtri

from pcfix.adjust.normal import UNDAMPED, sparse_matrix, sparse_rows_of
from pcfix.adjust.parameters import CX, CY, FOCAL
from pcfix.adjust.precision import Precision
from pcfix.adjust.problem import Problem, Solution
from pcfix.adjust.solve import reduced_at, solver
from pcfix.model import FloatArray, IntArray

SURE = 0.99
"""Probability with which equal groups would not differ by as much."""

# Errors in common


MOST_TILES, POINTS_PER_TILE, FRAME_TILES = 400, 25, 48
LEAST_GROUPS = 10
"""Fewer groups do not give a variance."""

COMMON_SHARE = 0.5
"""Error in common to all images at the corner of the frame, as a share of the image noise: matching
shifts features with their slope, and outliers of the original adjustment are missing on one side.
Focal length and principal point absorb it, so that poses and bed are right, and residuals do not
show it. Rendered blocks, whose lens is known, had up to 1.5 times this."""


def disagreement_of(problem: Problem, found: Solution, formal: Precision) -> FloatArray:
    """Return by which factors standard errors must grow for shared errors, shape (6 + g,).

    They are those of the angles and centres of all poses, and of the shared unknowns; `formal` is
    the precision by the normal matrix.
    """
    given, block, added = problem.given, problem.block, np.zeros(6 + len(problem.names))
    # random groups of points, neighbouring points, points of an image, and places in the frame
    tiles = min(MOST_TILES, len(block.xyz) // POINTS_PER_TILE)
    randomly = np.random.default_rng(0).integers(0, max(tiles, 1), len(block.xyz))[block.owner]
    near = _tiles(found.state.xyz[:, :2], tiles)[block.owner]
    size = np.array([(lens.width, lens.height) for lens in block.cameras.lenses or ()])
    place = _tiles(given.image_xy / size[given.camera], FRAME_TILES)
    place += given.group[given.camera] * (place.max(initial=0) + 1)
    frame = np.unique(place, return_inverse=True)[1]
    matrix, right = reduced_at(problem, found)
    solve_for, free = solver(matrix), slice(problem.fixed, None)
    least = len(np.unique(randomly))
    if least < LEAST_GROUPS or solve_for is None:
        return 1.0 + added
    # the first group has drawn residuals: the variances that random groups have by chance
    drawn = np.random.default_rng(1).normal(0.0, formal.sigma0, given.image_xy.shape)
    groups = [randomly, randomly, near, given.camera]
    *pulls, field, rest = _pulls_of(problem, found, groups, frame, drawn)
    by_chance, *shares = (_share_of(formal, solve_for(p[:, free].T)) for p in pulls)
    for group, share in zip(groups[1:], shares, strict=True):
        count = len(np.unique(group))
        is_more = share > fdtri(count - 1, least - 1, SURE) * by_chance
        more = np.where(is_more & (count >= LEAST_GROUPS), share - by_chance, 0.0)
        added = added + more
        if group is randomly:
            by_chance = by_chance + more
    if frame.max() + 1 >= LEAST_GROUPS:
        field = field[:, free]
        rest -= field @ solve_for(np.column_stack([field.T, right]))
        likely = _likely_field(problem, frame, formal.sigma0, rest) @ field
        added = added + _share_of(formal, solve_for(likely.T))
    return np.sqrt(1.0 + added)


def common_errors(problem: Problem, formal: Precision) -> FloatArray:
    """Return factors of the standard errors for an error that all images share, (6 + g,)."""
    factor = np.ones(6 + len(formal.shared))
    noise_px = formal.sigma0 / float(np.median(problem.given.weight[problem.used]))
    rows = np.flatnonzero(np.isin(problem.given.code, (FOCAL, CX, CY)))
    sigma = np.array([formal.shared[i].sigma for i in rows])
    factor[6 + rows] = np.hypot(1.0, COMMON_SHARE * noise_px / problem.lens_effects[rows] / sigma)
    return factor


def _tiles(xy: FloatArray, count: int) -> IntArray:
    """Return the tile of each place, of about `count` square ones that cover nearly all places."""
    low, high = np.nanpercentile(xy, [1.0, 99.0], axis=0)
    side = max(float(np.sqrt(np.prod(high - low) / max(count, 1))), 1e-9)
    last = np.maximum(np.ceil((high - low) / side) - 1.0, 0.0)
    place = np.clip(np.floor((np.nan_to_num(xy) - low) / side), 0.0, last).astype(np.int64)
    return np.asarray(place[:, 0] * int(last[1] + 1.0) + place[:, 1])


def _share_of(formal: Precision, moved: FloatArray) -> FloatArray:
    """Return variances over the formal ones, (6 + g,), for poses their mean.

    `moved`, shape (u, n), are the movements of the free unknowns by each of n groups.
    """
    of_poses, of_shared = np.split((moved**2).sum(axis=1), [len(moved) - len(formal.shared)])
    share = of_shared / [row.sigma**2 for row in formal.shared]
    if not len(of_poses):
        return np.append(np.zeros(6), share)
    poses = np.einsum("kii->ki", formal.pose_covariance)
    return np.append((of_poses.reshape(-1, 6) / poses).mean(axis=0), share)


def _pulls_of(
    problem: Problem, found: Solution, groups: list[IntArray], frame: IntArray, drawn: FloatArray
) -> list[FloatArray]:
    """Return the right side of the reduced equations by groups, each of shape (groups, 6 k + g).

    The first is that with the weighted residuals `drawn`, shape (o, 2), instead of those found.
    Then, for shifts along u and v of the t tiles of the frame: B', shape (2 t, 6 k + g), and C
    with their right sides, shape (2 t, 2 t + 1).
    """
    size, count = 6 * len(found.lenses) + problem.given.shared, 2 * (int(frame.max(initial=0)) + 1)
    pulls = [np.zeros((int(group.max(initial=0)) + 1, size)) for group in groups]
    field, rest = np.zeros((count, size)), np.zeros((count, count + 1))
    for part in sparse_rows_of(found.state, problem.given, UNDAMPED):
        at, is_image = part.rows.observation, part.rows.is_image
        r = np.where(is_image[:, None], drawn[at], part.rows.r)
        for group, total in zip(groups, pulls, strict=True):
            grouped = sparse_matrix(r, np.repeat(group[at], 2)[:, None], len(total))
            total += part.product(grouped).toarray()
            r = part.rows.r
        weight = np.repeat(np.where(is_image, problem.given.weight[at], 0.0), 2)
        column = (2 * frame[at][:, None] + np.arange(2)).reshape(-1, 1)
        shifts = sparse_matrix(weight, column, count)
        field += part.product(shifts).toarray()
        by_points = shifts.T @ part.points
        rest[:, :-1] += (shifts.T @ shifts - by_points @ part.inverse @ by_points.T).toarray()
        rest[:, -1] += shifts.T @ part.left_over()
    return [*pulls, field, rest]


# A smooth field over the frame


RANGES = (0.2, 0.4, 0.8)
"""Ranges of smoothness, over half the diagonal: from waves of the sensor to whole frames."""

LARGEST_PX, STEPS = 2.0, np.linspace(0.0, 1.0, 200)
"""Range of s; a lens with larger errors is another lens."""

NO_FIELD = 1e-9
"""Share of the largest eigenvalue below which a field leaves nothing in the residuals."""


def _likely_field(problem: Problem, tile: IntArray, sigma0: float, rest: FloatArray) -> FloatArray:
    """Return the transposed root of the covariance of the likely field, shape (2 t, 2 t).

    `tile` numbers the parts of the frame, none without observations; each sensor has its own.
    `rest` are R and the right sides c of their shifts, shape (2 t, 2 t + 1).
    """
    given, lenses, one = problem.given, problem.block.cameras.lenses or (), np.eye(len(rest))
    half_px = 0.5 * np.array([np.hypot(lens.width, lens.height) for lens in lenses])[given.camera]
    count = np.bincount(tile)
    middle = [np.bincount(tile, given.image_xy[:, i] / half_px) / count for i in range(2)]
    sensor = np.bincount(tile, given.group[given.camera]) / count
    apart = np.sum([(axis - axis[:, None]) ** 2 for axis in middle], axis=0)
    is_same_sensor = sensor == sensor[:, None]
    # in the eigenvectors of K R K' the pulls are independent, so that the likelihood is a product
    likely, halves = np.zeros((len(RANGES), len(STEPS))), []
    square = (LARGEST_PX * STEPS**3) ** 2  # dense where s is small
    for i, length in enumerate(RANGES):
        common = np.where(is_same_sensor, np.exp(-0.5 * apart / length**2), 0.0)
        half = np.linalg.cholesky(np.kron(common, np.eye(2)) + 1e-9 * one)
        halves.append(half)
        value, vector = np.linalg.eigh(half.T @ rest[:, :-1] @ half)
        shows = value > NO_FIELD * value[-1]
        pull2 = (vector[:, shows].T @ half.T @ rest[:, -1]) ** 2 / value[shows]
        variance = sigma0**2 + square[:, None] * value[shows]
        likely[i] = -0.5 * (np.log(variance) + pull2 / variance).sum(axis=1)
    weight = np.exp(likely - likely.max()) * STEPS**2  # a uniform prior of s
    s2_of = (weight * square).sum(axis=1) / weight.sum()
    of_all = np.sum([s2 * half @ half.T for s2, half in zip(s2_of, halves, strict=True)], axis=0)
    return np.asarray(np.linalg.cholesky(of_all + 1e-12 * one).T)

"""Adjustment by tie points: noise, outliers, and which lens parameters are free.

An adjustment without water changes its lens to absorb refraction: square pixels get an aspect, a
lens without distortion some of it. Changed terms must be free to return, and missing ones be found.
So the block is adjusted with the parameters that its lenses have, and each other parameter
is tested: by how much would it lower the weighted squares?

That needs no further adjustment. With the normal equations [[A, B], [B', C]] of all unknowns and of
the candidates, at a solution with right sides 0 and c, freed candidates take R^-1 c with
R = C - B' A^-1 B, and lower the squares by c' R^-1 c.
"""

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from pcfix.adjust.block import LEAST_VIEWS, Block
from pcfix.adjust.normal import CAUCHY, HUBER, SQUARES, residuals
from pcfix.adjust.parameters import CODES, NAMES, Unknowns
from pcfix.adjust.precision import Precision, common_errors, disagreement_of, precision_of
from pcfix.adjust.problem import Problem, Solution, prepare
from pcfix.adjust.result import Adjusted, adjusted_of, sigma0_of
from pcfix.adjust.solve import reduced_at, solve, solver
from pcfix.errors import GeometryError, PcfixWarning
from pcfix.model import FloatArray

ROUGHLY = 1e-4  # relative gain of a step that ends the first, robust rounds
OUTLIER_SIGMAS = 4.0  # longer residuals are outliers: three good ones in 10,000
LEAST_SHARE = 0.5  # share of the observations that must be in front of their cameras and good
OUTLIER_ROUNDS = 3


def adjust_ties(block: Block, unknowns: Unknowns, *, choose_lens: bool = True) -> Adjusted:
    """Adjust a block of measured tie points; their noise is estimated from the residuals.

    With `choose_lens`, lens parameters that the block does not determine are fixed, and those that
    lower the residuals are freed; else exactly those of the unknowns are free.
    """
    problem, now = prepare(block, unknowns)
    counted = np.isfinite(block.sigma_px) & problem.of_ties
    is_ahead = np.isfinite(residuals(now.state, problem.given)).all(axis=1)
    ahead, total = int((counted & is_ahead).sum()), int(counted.sum())
    if ahead < LEAST_SHARE * total:
        words = (
            f"Only {ahead:,} of {total:,} tie point observations are in front of their cameras at"
            " the start. Check that poses and tie points belong to one model, and the camera axes."
        )
        raise GeometryError("adjust.behind", words, good=ahead, observations=total)
    # robust rounds estimate the noise, then exclude outliers
    now = solve(problem, now, HUBER, ROUGHLY)
    clean = with_noise(problem, now)
    for number in range(OUTLIER_ROUNDS):
        now = solve(clean, now, CAUCHY if number == 0 else SQUARES, ROUGHLY)
        before = clean.used
        clean = with_noise(without_outliers(clean, now), now)
        if number and (clean.used == before).all():
            break
    if clean.used[counted].mean() < LEAST_SHARE:
        words = (
            "Most tie point observations fit no poses near the given ones. Check that tie points"
            " and poses belong to one model, and the water level; or align the images again."
        )
        raise GeometryError("adjust.not_converged", words)
    problem, now, precision = _final_solution(clean, now)
    notes = list[PcfixWarning]()
    if choose_lens:
        weak = weak_lens_parameters(problem, now, precision)
        more = missing_lens_parameters(problem, now, sigma0_of(problem, now))
        if more:
            words = f"Tests of the residuals freed {', '.join(more)} of the lens."
            notes.append(PcfixWarning("adjust.lens", words, found=more))
        if weak:
            words = f"The block does not determine {', '.join(weak)} of the lens; they were fixed."
            notes.append(PcfixWarning("adjust.weak_lens", words, fixed=weak))
        if weak or more:
            lens = (*(name for name in unknowns.lens if name not in weak), *more)
            wide, start = prepare(block, replace(unknowns, lens=lens))
            start = replace(start, state=start.state._replace(xyz=now.state.xyz))
            now = solve(wide.weighted(clean.given.weight), start, close=ROUGHLY)
            # outliers are chosen again
            typical = clean.given.weight[clean.of_ties].max(initial=0.0)
            wide = wide.weighted(np.where(counted, typical, clean.given.weight))
            problem, now, precision = _final_solution(without_outliers(wide, now), now)
    factor = disagreement_of(problem, now, precision) * common_errors(problem, precision)
    precision = precision_of(problem, now, precision.sigma0, factor)
    return adjusted_of(problem, now, precision, notes, "tie points")


# Noise and outliers


def _final_solution(problem: Problem, now: Solution) -> tuple[Problem, Solution, Precision]:
    """Return the least squares solution without outliers, and its precision.

    The noise is now estimated from all residuals, long tails included, so that GNSS and control
    points, whose standard deviations are given, get the right weight relative to the images.
    """
    problem = with_noise(problem, now, robust=False)
    now = solve(problem, now)
    return problem, now, precision_of(problem, now, sigma0_of(problem, now), only_poses=True)


def with_noise(problem: Problem, now: Solution, *, robust: bool = True) -> Problem:
    """Return the problem with the noise of its tie points as their residuals show it.

    Robust is by the median, which outliers do not move, else by the mean square. The share of the
    redundancy corrects for what the points absorb.
    """
    rows = problem.of_ties & problem.used
    r = residuals(now.state, problem.given)[rows]
    r = r[np.isfinite(r).all(axis=1)]
    points = len(np.unique(problem.block.owner[rows]))
    share = max(1.0 - 3.0 * points / max(2.0 * len(r), 1.0), 0.05)
    typical = 1.4826 * np.median(np.abs(r)) if robust else np.sqrt(np.mean(r * r))
    sigma_px = max(typical / np.sqrt(share), 1e-6)
    return problem.weighted(np.where(rows, 1.0 / sigma_px, problem.given.weight))


def without_outliers(problem: Problem, now: Solution) -> Problem:
    """Return the problem without observations whose residuals are too long.

    A point with fewer than two observations is excluded altogether. Marks of control points stay:
    the surveyor should see them.
    """
    given, owner, ties = problem.given, problem.block.owner, problem.of_ties
    length = np.linalg.norm(residuals(now.state, given), axis=1) * given.weight
    weight = np.where(ties & problem.used & ~(length <= OUTLIER_SIGMAS), 0.0, given.weight)
    left = np.bincount(owner, weight > 0.0, minlength=len(problem.block.xyz))
    weight[ties & (left[owner] < LEAST_VIEWS)] = 0.0
    return problem.weighted(weight)


# Which lens parameters are free


SURE = 1e-3  # probability that a further lens parameter lowers the squares as much by chance

# Standard error of the image at the corner of the frame above which a lens parameter is fixed, if
# the residuals permit; the focal length is always free.
WEAK_PX = 2.0

# Probability that weak parameters move as far by chance. An adjustment without water changes them
# too: fixing them there deforms the block instead, which no standard error shows.
CHANGED = 0.05

TRIED = ("b1", "k1", "k2", "k3", "p1", "p2")  # a lens may lack them; no sensor has skew b2


def weak_lens_parameters(problem: Problem, found: Solution, precision: Precision) -> list[str]:
    """Return lens parameters, except the focal length, that the block hardly determines.

    None are returned if all of them moved further together than chance allows.
    """
    names = [NAMES[code] for code in problem.given.code.tolist()]
    sigma = precision.shared_sigma[: len(names)]
    by_px = zip(names, sigma * problem.lens_effects, strict=True)
    weak = list(dict.fromkeys(name for name, by in by_px if name != "f" and by > WEAK_PX))
    rows = np.flatnonzero(np.isin(names, weak))
    went = found.shared[rows] / sigma[rows]
    squares = went @ np.linalg.pinv(precision.correlation[np.ix_(rows, rows)]) @ went
    return [] if squares > chdtri(max(len(rows), 1), CHANGED) else weak


def missing_lens_parameters(problem: Problem, now: Solution, sigma0: float) -> list[str]:
    """Return lens parameters that lower the squares by more than chance does, the best first.

    The solution is adjusted with the parameters that the lenses have.
    """
    names = problem.unknowns.lens
    if any(lens.projection != "perspective" for lens in problem.block.cameras.lenses or ()):
        return []  # other projections have terms of their own with the same effect
    more = tuple(name for name in TRIED if name not in names)
    wide, start = prepare(problem.block, replace(problem.unknowns, lens=names + more))
    wide, given = wide.weighted(problem.given.weight), wide.given
    is_tried = np.zeros(len(wide.names), np.bool_)
    is_tried[: len(given.code)] = np.isin(given.code, [CODES[name] for name in more])
    shared = np.zeros(len(wide.names))
    shared[~is_tried] = now.shared
    start = replace(start, state=now.state, lenses=now.lenses, shared=shared)
    matrix, right = reduced_at(wide, start)
    mine = np.append(np.zeros(len(right) - len(shared), np.bool_), is_tried)
    solve_for = solver(matrix[~mine][:, ~mine])
    if not mine.any() or solve_for is None:
        return []
    border, own = matrix[~mine][:, mine], matrix[mine][:, mine]
    if not isinstance(matrix, np.ndarray):
        border, own = border.toarray(), own.toarray()
    # R and its right side c
    rest = np.column_stack([own, right[mine]])
    rest -= border.T @ solve_for(np.column_stack([border, right[~mine]]))
    tried = np.flatnonzero(is_tried)
    code, effect = given.code[tried], wide.lens_effects[tried]

    def squares(codes: list[int]) -> tuple[float, FloatArray]:
        """Return by how much these lower the squares, and their effects' standard errors."""
        rows = np.isin(code, codes)
        covariance, pull = np.linalg.inv(rest[rows][:, :-1][:, rows]), rest[rows, -1]
        gain = float(pull @ covariance @ pull) / max(sigma0, 1.0) ** 2
        return gain, sigma0 * np.sqrt(covariance.diagonal()) * effect[rows]

    chosen: list[int] = []
    while True:
        before, gains = squares(chosen)[0], dict[int, float]()
        for one in np.unique(code[~np.isin(code, chosen)]).tolist():
            after, sigma_px = squares([*chosen, one])
            limit = chdtri(int((code == one).sum()), SURE)
            if (sigma_px <= WEAK_PX).all() and after - before > limit:
                gains[one] = after - before
        if not gains:
            return [NAMES[one] for one in chosen]
        chosen.append(max(gains, key=gains.__getitem__))

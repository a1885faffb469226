"""Tie points adjusted: their noise estimated, outliers out, which lens parameters may move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcfix.adjust.block import Block, Robust, Unknowns
from pcfix.adjust.disagreement import common_errors, disagreement_of
from pcfix.adjust.gather import LEAST_VIEWS
from pcfix.adjust.lens_choice import missing_lens_parameters, weak_lens_parameters
from pcfix.adjust.normal import residuals
from pcfix.adjust.precision import Precision, precision_of
from pcfix.adjust.problem import Problem, Progress, Solution, gnss_weights, prepare
from pcfix.adjust.quality import weighed
from pcfix.adjust.result import Adjusted, adjusted_of, sigma0_of
from pcfix.adjust.solve import solve
from pcfix.errors import GeometryError
from pcfix.model import BoolArray

ROUGHLY = 1e-4
"""Gain of a step, relative, below which the first, robust rounds end."""

OUTLIER_SIGMAS = 4.0
"""Residuals longer than this many standard deviations are left out: three good ones in 10,000."""

LEAST_SHARE = 0.5
"""Of the observations that fit, else nothing was found."""

MAD_TO_SIGMA = 1.4826
OUTLIER_ROUNDS = 3
MANY_OUT = 0.05
"""Share of outliers that deserves a word."""

LAST_ROUND = 2 + OUTLIER_ROUNDS


def adjust_ties(
    block: Block,
    unknowns: Unknowns,
    progress: Progress | None = None,
    *,
    sigma_px: float | None = None,
    outliers: bool = True,
    choose_lens: bool = True,
) -> Adjusted:
    """Adjust a block of measured tie points.

    Parameters
    ----------
    sigma_px : float, optional
        Of the tie points; it is estimated without.
    outliers : bool
        Whether to look for them.
    choose_lens : bool
        Whether lens parameters that the block does not determine are left as they were, and those
        that lower the residuals are freed; else those of the unknowns move and no others.

    Raises
    ------
    GeometryError
        If the block lacks a datum, does not converge, or its unknowns cannot be told apart.
    """
    check_datum(block, unknowns)
    problem, now = prepare(block, unknowns)
    _check_sight(problem, now)
    problem, now = _cleaned(problem, now, sigma_px, outliers, progress)
    estimate, clean = sigma_px is None, problem
    problem, now, precision = _settled(clean, now, LAST_ROUND, estimate, progress)
    notes: list[str] = []
    if choose_lens:
        weak = weak_lens_parameters(problem, now, precision)
        kept = [name for name in unknowns.lens if name not in weak]
        more = missing_lens_parameters(problem, now, sigma0_of(problem, now))
        notes = _lens_notes([*kept, *more], weak, more)
        if weak or more:
            clean, now = _with_lens(clean, now, (*kept, *more), outliers, progress)
            problem, now, precision = _settled(clean, now, LAST_ROUND + 2, estimate, progress)
    shared_errors = disagreement_of(problem, now, precision)
    factor = shared_errors.factor * common_errors(problem, precision)
    precision = precision_of(problem, now, precision.sigma0, factor)
    quality = weighed(clean, now, _of_ties(clean))[1] if estimate else []
    notes += [*quality, *shared_errors.notes, *_left_out(problem)]
    return adjusted_of(problem, now, precision, notes, "tie points", "direct")


def _left_out(problem: Problem) -> list[str]:
    """Say what it may mean where many observations are left out."""
    counted = np.isfinite(problem.block.sigma_px) & _of_ties(problem)
    share = 1.0 - (problem.seen.weight > 0.0)[counted].mean()
    if share < MANY_OUT:
        return []
    return [
        f"{100.0 * share:.0f} % of the observations of tie points are left out, being off by more"
        f" than {OUTLIER_SIGMAS:g} standard deviations: wrong matches, waves, what moved between"
        " the images, or a lens or water surface of another shape than assumed. If it is not the"
        " matching, standard errors are too small."
    ]


def _with_lens(
    problem: Problem, now: Solution, lens: tuple[str, ...], outliers: bool,
    progress: Progress | None,
) -> tuple[Problem, Solution]:  # fmt: skip
    """Return the problem with other lens parameters, all observations judged anew by them."""
    wide, start = prepare(problem.block, replace(problem.unknowns, lens=lens))
    wide.seen = problem.seen
    state = start.state._replace(xyz=now.state.xyz)
    start = replace(start, state=state, log=now.log)
    start = solve(wide, start, "squares", number=LAST_ROUND + 1, progress=progress, close=ROUGHLY)
    if not outliers:
        return wide, start
    used = problem.seen.weight[_of_ties(problem)].max(initial=0.0)
    ties = _of_ties(problem) & np.isfinite(problem.block.sigma_px)
    wide.seen = wide.seen._replace(weight=np.where(ties, used, wide.seen.weight))
    return without_outliers(wide, start)[0], start


def _lens_notes(free: list[str], weak: list[str], more: list[str]) -> list[str]:
    """Say which lens parameters move, and what the tests came to."""
    tests = f" (tests of the residuals: {', '.join(more)} too)" if more else ""
    notes = [f"lens parameters free: {', '.join(free)}{tests}."]
    if weak:
        notes.append(
            f"the block does not determine {', '.join(weak)} of the lens; left as they were."
        )
    return notes


def _settled(
    problem: Problem, now: Solution, number: int, estimate: bool, progress: Progress | None
) -> tuple[Problem, Solution, Precision]:
    """Return the least squares without outliers, and how well they are known.

    The estimate of the noise is now that of all residuals, long tails included, so that GNSS and
    control points, whose standard deviations are given, count as they should beside the images.
    """
    if estimate:
        problem = with_sigma(problem, noise_px(problem, now, robust=False))
        problem = weighed(problem, now, _of_ties(problem))[0]
    now = solve(problem, now, "squares", number=number, progress=progress)
    return problem, now, precision_of(problem, now, sigma0_of(problem, now))


def _cleaned(
    problem: Problem, now: Solution, sigma_px: float | None, outliers: bool,
    progress: Progress | None,
) -> tuple[Problem, Solution]:  # fmt: skip
    """Return the problem with the noise of its tie points estimated and outliers left out."""
    estimate = sigma_px is None
    if outliers or estimate:
        now = solve(problem, now, "huber", number=1, progress=progress, close=ROUGHLY)
    if estimate:
        problem = with_sigma(problem, noise_px(problem, now))
    if not outliers:
        return problem, now
    for number in range(OUTLIER_ROUNDS):
        robust: Robust = "cauchy" if number == 0 else "squares"
        now = solve(problem, now, robust, number=2 + number, progress=progress, close=ROUGHLY)
        problem, dropped = without_outliers(problem, now)
        _check_share(problem)
        if estimate:
            problem = with_sigma(problem, noise_px(problem, now))
        if number and not dropped:
            break
    return problem, now


def check_datum(block: Block, unknowns: Unknowns, reason: str = "") -> None:
    """Check that something says where the block is; `reason` is why GNSS positions do not count.

    Raises
    ------
    GeometryError
        If neither GNSS, nor control points, nor fixed images, nor the wish for a free network do.
    """
    if unknowns.free_network or unknowns.poses == "fixed":
        return
    gnss = int((gnss_weights(block) > 0.0).all(axis=1).sum())
    control = int((block.is_surveyed & (np.diff(block.start) >= LEAST_VIEWS)).sum())
    fixed = len(set(unknowns.fixed_images) & set(block.cameras.labels))
    if gnss + control >= 3 or fixed >= 2:
        return
    raise GeometryError(
        "nothing says where the block is, how it lies and how large it is: there are"
        f" {gnss} GNSS positions, {control} control points in two images or more and {fixed} fixed"
        " images; shift in plan, turn and scale stay undetermined, and with them the heights."
        " Give --gnss or --gcps with three points at least, or --datum free to keep mean place,"
        " direction and scale of the old projection centres." + (f" {reason}" if reason else "")
    )


def noise_px(problem: Problem, now: Solution, *, robust: bool = True) -> float:
    """Return the standard deviation of the tie points' image places, from their residuals.

    The median is not moved by outliers, the mean square (not robust) has all that count; what the
    points themselves take up is put back by the share of the redundancy.
    """
    ties, used = _of_ties(problem), problem.seen.weight > 0.0
    rows = ties & used
    r = residuals(now.state, problem.seen, problem.surface)[rows]
    r = r[np.isfinite(r).all(axis=1)]
    points = len(np.unique(problem.block.owner[rows]))
    share = max(1.0 - 3.0 * points / max(2.0 * len(r), 1.0), 0.05)
    typical = MAD_TO_SIGMA * np.median(np.abs(r)) if robust else np.sqrt(np.mean(r * r))
    return float(max(typical / np.sqrt(share), 1e-6))


def _of_ties(problem: Problem) -> BoolArray:
    """Return which observations are of tie points."""
    m = len(problem.block.xyz) - len(problem.block.control_names)
    return np.asarray(problem.block.owner < m)


def with_sigma(problem: Problem, sigma_px: float) -> Problem:
    """Return the problem with another standard deviation of the tie points."""
    weight = problem.seen.weight.copy()
    tie_rows = _of_ties(problem) & (weight > 0.0)
    weight[tie_rows] = 1.0 / sigma_px
    return replace(problem, seen=problem.seen._replace(weight=weight))


def without_outliers(problem: Problem, now: Solution) -> tuple[Problem, int]:
    """Return the problem without observations that are too far off, and how many they are.

    Residuals are counted in their own standard deviation. A point that keeps fewer than two
    observations is left out whole. Marks of control points stay: a surveyor should see them.
    """
    seen = problem.seen
    r = residuals(now.state, seen, problem.surface)
    length = np.hypot(r[:, 0], r[:, 1]) * seen.weight
    ties = _of_ties(problem)
    bad = ties & (seen.weight > 0.0) & ~(length <= OUTLIER_SIGMAS)
    weight = np.where(bad, 0.0, seen.weight)
    left = np.bincount(problem.block.owner, weight > 0.0, minlength=len(problem.block.xyz))
    weight[ties & (left[problem.block.owner] < LEAST_VIEWS)] = 0.0
    dropped = int(((seen.weight > 0.0) & (weight == 0.0)).sum())
    return replace(problem, seen=seen._replace(weight=weight)), dropped


def _check_sight(problem: Problem, start: Solution) -> None:
    """Refuse a start from which most tie points are not in front of their cameras."""
    r = residuals(start.state, problem.seen, problem.surface)
    _check_most(
        problem, np.asarray(np.isfinite(r).all(axis=1)), "at the start, only",
        "are of points in front of their cameras; check that the poses and the tie points are of"
        " one model, and the axes of the camera file.",
    )  # fmt: skip


def _check_share(problem: Problem) -> None:
    """Refuse a block of which more is left out than fits: it has come to rest at a wrong place."""
    _check_most(
        problem, problem.seen.weight > 0.0, "only",
        "of tie points fit any poses near the given ones; check that the tie points and the poses"
        " are of one model, and the water level, or align the images anew.",
    )  # fmt: skip


def _check_most(problem: Problem, good: BoolArray, only: str, what: str) -> None:
    """Refuse a block where too few observations of tie points are good."""
    counts = np.isfinite(problem.block.sigma_px) & _of_ties(problem)
    n, most = int((counts & good).sum()), int(counts.sum())
    if n < LEAST_SHARE * most:
        raise GeometryError(
            f"the adjustment does not converge: {only} {n:,} of {most:,} observations {what}"
        )

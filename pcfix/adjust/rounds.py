"""Tie points adjusted: their noise estimated, outliers out, which lens parameters may move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pcfix.adjust.block import CODES, K1, Block, Robust, Unknowns, usable_codes
from pcfix.adjust.gather import LEAST_VIEWS
from pcfix.adjust.normal import residuals
from pcfix.adjust.precision import Precision, precision_of
from pcfix.adjust.problem import (
    LogRow,
    Problem,
    Solution,
    gnss_weights,
    prepare,
)
from pcfix.adjust.result import Adjusted, adjusted_of, sigma0_of
from pcfix.adjust.solve import solve
from pcfix.errors import GeometryError
from pcfix.model import BoolArray, Lens

Progress = Callable[[LogRow], None]

ROUGHLY = 1e-4
"""Gain of a step, relative, below which the first, robust rounds end."""

OUTLIER_SIGMAS = 4.0
"""Residuals longer than this many standard deviations are left out: three good ones in 10,000."""

LEAST_SHARE = 0.5
"""Of the observations that fit, else nothing was found."""

MAD_TO_SIGMA = 1.4826
OUTLIER_ROUNDS = 3
LAST_ROUND = 2 + OUTLIER_ROUNDS
WEAK_PX = 2.0
"""Standard error of the image at the corner of the frame above which a lens parameter is left as
it was; the focal length always moves."""


@dataclass(frozen=True)
class Rounds:
    """How the rounds go.

    Attributes
    ----------
    sigma_px : float or None
        Of the tie points; None to estimate it.
    outliers : bool
        Whether to look for them.
    drop_weak : bool
        Whether lens parameters that the block does not determine are left as they were.
    """

    sigma_px: float | None = None
    outliers: bool = True
    drop_weak: bool = True


def adjust_ties(
    block: Block,
    unknowns: Unknowns,
    rounds: Rounds | None = None,
    progress: Progress | None = None,
) -> Adjusted:
    """Adjust a block of measured tie points.

    Parameters
    ----------
    block : Block
    unknowns : Unknowns
    rounds : Rounds, optional
    progress : callable, optional
        Called with each `LogRow`.

    Raises
    ------
    GeometryError
        If the block lacks a datum, does not converge, or its unknowns cannot be told apart.
    """
    rounds = rounds or Rounds()
    check_datum(block, unknowns)
    problem, now = prepare(block, unknowns)
    _check_sight(problem, now)
    problem, now = _cleaned(problem, now, rounds, progress)
    now = solve(problem, now, "squares", number=LAST_ROUND, progress=progress)
    precision = precision_of(problem, now, sigma0_of(problem, now))
    weak = weak_lens_parameters(problem, precision) if rounds.drop_weak else []
    notes = []
    if weak:
        notes.append(
            f"the block does not determine {', '.join(weak)} of the lens; left as they were."
        )
        problem, start = _with_less_lens(problem, now, weak)
        now = solve(problem, start, "squares", number=LAST_ROUND + 1, progress=progress)
        precision = precision_of(problem, now, sigma0_of(problem, now))
    return adjusted_of(problem, now, precision, notes, "tie points", "direct")


def _cleaned(
    problem: Problem, now: Solution, rounds: Rounds, progress: Progress | None
) -> tuple[Problem, Solution]:
    """Return the problem with the noise of its tie points estimated and outliers left out."""
    estimate = rounds.sigma_px is None
    if rounds.outliers or estimate:
        now = solve(problem, now, "huber", number=1, progress=progress, close=ROUGHLY)
    if estimate:
        problem = with_sigma(problem, noise_px(problem, now))
    if not rounds.outliers:
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


def _with_less_lens(problem: Problem, now: Solution, weak: list[str]) -> tuple[Problem, Solution]:
    """Return the problem with some lens parameters as they came, and where to start from."""
    unknowns = problem.unknowns
    kept = tuple(name for name in unknowns.lens if name not in weak)
    fewer, start = prepare(problem.block, replace(unknowns, lens=kept))
    fewer.seen = fewer.seen._replace(weight=problem.seen.weight)
    return fewer, replace(start, state=start.state._replace(xyz=now.state.xyz), log=now.log)


def check_datum(block: Block, unknowns: Unknowns, reason: str = "") -> None:
    """Check that something says where the block is.

    Parameters
    ----------
    block : Block
    unknowns : Unknowns
    reason : str
        Why GNSS positions that there are do not count.

    Raises
    ------
    GeometryError
        If neither GNSS, nor control points, nor fixed images, nor the wish for a free network do.
    """
    if unknowns.free_network or unknowns.poses == "fixed":
        return
    gnss = int((gnss_weights(block) > 0.0).all(axis=1).sum())
    control = _control_in_images(block)
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


def _control_in_images(block: Block) -> int:
    counts = np.diff(block.start)
    return int((block.is_surveyed & (counts >= LEAST_VIEWS)).sum())


def noise_px(problem: Problem, now: Solution) -> float:
    """Return the standard deviation of the tie points' image places, from their residuals.

    The median is not moved by outliers; what the points themselves take up is put back by the
    share of the redundancy.
    """
    ties, used = _of_ties(problem), problem.seen.weight > 0.0
    rows = ties & used
    r = residuals(now.state, problem.seen, problem.surface)[rows]
    r = r[np.isfinite(r).all(axis=1)]
    points = len(np.unique(problem.block.owner[rows]))
    share = max(1.0 - 3.0 * points / max(2.0 * len(r), 1.0), 0.05)
    return float(max(MAD_TO_SIGMA * np.median(np.abs(r)) / np.sqrt(share), 1e-6))


def _of_ties(problem: Problem) -> BoolArray:
    """Return which observations are of tie points."""
    m = len(problem.block.xyz) - len(problem.block.control_names)
    return np.asarray(problem.block.owner < m)


def with_sigma(problem: Problem, sigma_px: float) -> Problem:
    """Return the problem with another standard deviation of the tie points."""
    weight = problem.seen.weight.copy()
    mine = _of_ties(problem) & (weight > 0.0)
    weight[mine] = 1.0 / sigma_px
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
    counts = np.isfinite(problem.block.sigma_px) & _of_ties(problem)
    r = residuals(start.state, problem.seen, problem.surface)[counts]
    ahead = int(np.isfinite(r).all(axis=1).sum())
    if ahead < LEAST_SHARE * len(r):
        raise GeometryError(
            f"the adjustment does not converge: at the start, only {ahead:,} of {len(r):,}"
            " observations are of points in front of their cameras; check that the poses and the"
            " tie points are of one model, and the axes of the camera file."
        )


def _check_share(problem: Problem) -> None:
    """Refuse a block of which more is left out than fits: it has come to rest at a wrong place."""
    counts = np.isfinite(problem.block.sigma_px) & _of_ties(problem)
    used = counts & (problem.seen.weight > 0.0)
    if used.sum() >= LEAST_SHARE * counts.sum():
        return
    raise GeometryError(
        f"the adjustment does not converge: only {int(used.sum()):,} of {int(counts.sum()):,}"
        " observations of tie points fit any poses near the given ones; check that the tie points"
        " and the poses are of one model, and the water level, or align the images anew."
    )


def weak_lens_parameters(problem: Problem, precision: Precision) -> list[str]:
    """Return which lens parameters, the focal length apart, the block hardly determines."""
    weak = []
    columns = problem.columns
    lenses = problem.block.cameras.lenses or ()
    for i, rows in enumerate(problem.groups):
        for at in range(columns.lens[i], columns.lens[i + 1]):
            code = int(columns.code[at])
            name = next(name for name, value in CODES.items() if value == code)
            effect = precision.shared[at].sigma * effect_at_corner(lenses[rows[0]], code)
            if name != "f" and effect > WEAK_PX and name not in weak:
                weak.append(name)
    return weak


def effect_at_corner(lens: Lens, code: int) -> float:
    """Return by how much the image moves at the corner of the frame with a lens parameter."""
    r = 0.5 * np.hypot(lens.width, lens.height) / lens.focal
    if code in (CODES["cx"], CODES["cy"]):
        return 1.0
    if code >= K1:
        return float(lens.focal * r ** (2 * (code - K1) + 3))
    if code in (CODES["p1"], CODES["p2"]):
        return float(3.0 * lens.focal * r * r)
    return float(r)


def default_lens(lenses: tuple[Lens, ...]) -> tuple[str, ...]:
    """Return the parameters that may move where the user names none: those that the lenses have."""
    names = ["f", "cx", "cy"]
    for lens in lenses:
        for i, value in enumerate(lens.radial[:4]):
            if value and f"k{i + 1}" not in names:
                names.append(f"k{i + 1}")
        for i, value in enumerate(lens.tangential[:2]):
            if value and f"p{i + 1}" not in names:
                names.append(f"p{i + 1}")
    known = {
        name
        for name, code in CODES.items()
        if any(code in usable_codes(one, (name,)) for one in lenses)
    }
    return tuple(name for name in names if name in known)

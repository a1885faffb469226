"""Poses mended from the cloud alone: which images made it, what may move, how much it counts.

See `pcfix.adjust.unaware` for the equations. What the points of the cloud say is not noise but how
well they stand for the tie points of the old adjustment. GNSS positions and control points tell it:
the points count as much as lets these fit within their standard deviations, and of several choices
the one under which they fit best is taken.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.stats import chi2

from pcfix.adjust.normal import residuals
from pcfix.adjust.problem import Problem, Solution, gnss_weights, prepare
from pcfix.adjust.rounds import adjusted_of, check_datum
from pcfix.adjust.unaware import solve_unaware, straight_columns
from pcfix.errors import GeometryError

if TYPE_CHECKING:
    from collections.abc import Callable

    from pcfix.adjust.block import Block, Unknowns
    from pcfix.adjust.problem import LogRow
    from pcfix.adjust.result import Adjusted
    from pcfix.model import Cameras, FloatArray

    Progress = Callable[[LogRow], None]

SIGMAS_PX = (0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 3.0, 5.0, 10.0)
"""How far the points of the cloud may be from images of tie points: tried in this order."""

POOR_PX = 5.0
"""Of `SIGMAS_PX`, from where the result deserves a warning."""

FITS = 1.15
"""Mean square of GNSS and control residuals, in variances, up to which they fit."""

SURE = 1e-3
"""Probability that further lens parameters lower the misfit by so much for nothing."""


class Trial(NamedTuple):
    """One choice and how GNSS and control points fit it."""

    name: str
    block: Block
    problem: Problem
    found: Solution
    sigma_px: float
    misfit: float
    observations: int

    @property
    def mean(self) -> float:
        """Misfit per observation that is free to differ."""
        return self.misfit / max(self.observations - 7, 1)


class Candidate(NamedTuple):
    """A block whose tie points are points of the cloud, and where these were seen.

    `old` are the cameras that made the cloud; those of the block are the start. `apparent_xyz` has
    a row per point of the block, control points included.
    """

    name: str
    block: Block
    old: Cameras
    apparent_xyz: FloatArray


def mend(
    candidates: list[Candidate],
    unknowns: Unknowns,
    lens_sets: tuple[tuple[str, ...], ...],
    progress: Progress | None = None,
) -> Adjusted:
    """Mend the poses of a block from the cloud that they made.

    Parameters
    ----------
    candidates : list of Candidate
        The same cloud with different guesses which images made each point.
    unknowns : Unknowns
        Its lens parameters are those of `lens_sets` that are chosen.
    lens_sets : tuple of tuple of str
        Each has those before it and some more.
    progress : callable, optional

    Raises
    ------
    GeometryError
        If there is no datum, or no choice converges.
    """
    first = candidates[0].block
    check_datum(first, unknowns)
    if (unknowns.free_network and not _observed(first)) or unknowns.poses != "free":
        raise GeometryError(
            "poses can be mended from the cloud only with GNSS positions or control points that"
            " decide how much it counts; give --gnss or --gcps, or a model with tie points."
        )
    if any(unknowns.water_sigma):
        raise GeometryError(
            "level, tilt and refractive index can be found from measured tie points only: points"
            " of the cloud say of the images what the old adjustment left, not what they showed;"
            " give a model with tie points, or leave the water fixed."
        )
    best = min(
        (_fitting(one, replace(unknowns, lens=lens_sets[0]), progress) for one in candidates),
        key=lambda trial: (trial.sigma_px, trial.misfit),
    )
    chosen, notes = best, []
    for names in lens_sets[1:]:
        one = next(c for c in candidates if c.name == best.name)
        try:
            more = _trial(one, replace(unknowns, lens=names), best.sigma_px, progress)
        except GeometryError:
            continue
        extra = len(names) - len(chosen.problem.unknowns.lens)
        gain = (chosen.misfit - more.misfit) / max(chosen.mean, 1.0)
        if gain > chi2.isf(SURE, extra * len(chosen.problem.groups)):
            chosen = more
    notes.append(_said(chosen, candidates, lens_sets))
    if chosen.sigma_px >= POOR_PX:
        notes.append(
            f"the points of the cloud fit GNSS and control points only if they count as"
            f" {chosen.sigma_px:g} px: they stand poorly for the old tie points, and bed and focal"
            " length may be off by more than all figures here say; give tie points, control points"
            " or a calibrated lens."
        )
    found = adjusted_of(chosen.problem, chosen.found, None, notes, "cloud", "unaware")
    # the points of the cloud say nothing of noise: GNSS and control points are all there is
    free = max(chosen.observations - 7, 1)
    return replace(found, sigma0=float(np.sqrt(chosen.mean)), redundancy=free)


def _said(
    chosen: Trial, candidates: list[Candidate], lens_sets: tuple[tuple[str, ...], ...]
) -> str:
    free = chosen.problem.unknowns.lens
    text = (
        f"without tie points: {chosen.block.start[-1]:,} image places of points of the cloud"
        f" ({chosen.name}), counting as {chosen.sigma_px:g} px"
    )
    text += f"; lens parameters free: {', '.join(free) or 'none'}"
    left = [name for names in lens_sets for name in names if name not in free]
    if left:
        text += f" (the block does not tell {', '.join(dict.fromkeys(left))})"
    return text + "."


def _observed(block: Block) -> int:
    return int((gnss_weights(block) > 0.0).sum())


def _fitting(one: Candidate, unknowns: Unknowns, progress: Progress | None) -> Trial:
    """Return the trial in which the cloud counts most while GNSS and control points still fit."""
    last: Trial | None = None
    failed: GeometryError | None = None
    for sigma in SIGMAS_PX:
        try:
            last = _trial(one, unknowns, sigma, progress)
        except GeometryError as error:
            failed = error
            continue
        if last.mean <= FITS:
            return last
    if last is None:
        raise failed or GeometryError("the poses cannot be mended from the cloud.")
    return last


def _trial(one: Candidate, unknowns: Unknowns, sigma_px: float, progress: Progress | None) -> Trial:
    block = one.block
    m = len(block.xyz) - len(block.control_names)
    sigma = np.where(block.owner < m, sigma_px, block.sigma_px)
    block = replace(block, sigma_px=sigma)
    problem, start = prepare(block, unknowns)
    before, at_rest = prepare(replace(block, cameras=one.old), unknowns)
    tests = straight_columns(before, at_rest, one.apparent_xyz - before.origin)
    is_tested = np.arange(len(block.xyz)) < m
    found = solve_unaware(problem, start, tests, is_tested, progress)
    marks = (problem.seen.weight > 0.0) & ~is_tested[block.owner]
    r = residuals(found.state, problem.seen, problem.surface)[marks]
    in_images = float((r * r * problem.seen.weight[marks][:, None] ** 2).sum())
    surveyed = problem.priors.weight > 0.0
    count = _observed(block) + 2 * int(marks.sum()) + int(surveyed.sum())
    count -= 3 * int(surveyed.any(axis=1).sum())
    return Trial(one.name, block, problem, found, sigma_px, found.cost + in_images, count)

"""Poses mended from the cloud alone, and what it is likely to cost where they are not.

See `pcfix.adjust.unaware` for the equations. `mend` decides which images made the cloud, what may
move, and how much it counts. What the points of the cloud say is not noise but how
well they stand for the tie points of the old adjustment. GNSS positions and control points tell it:
the points count as much as lets these fit within their standard deviations, and of several choices
the one under which they fit best is taken.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from pcfix.adjust.block import Block, Unknowns, plain_block
from pcfix.adjust.gather import deeper, some_cameras, straight_images
from pcfix.adjust.normal import residuals
from pcfix.adjust.precision import precision_of
from pcfix.adjust.problem import (
    Problem,
    Progress,
    Solution,
    gnss_weights,
    intersect_fixed,
    prepare,
    solved_cameras,
)
from pcfix.adjust.result import Adjusted, adjusted_of
from pcfix.adjust.rounds import check_datum
from pcfix.adjust.unaware import solve_unaware, straight_columns
from pcfix.errors import GeometryError
from pcfix.model import Cameras, FloatArray, IntArray, TiePoints, WaterSurface
from pcfix.refract.choice import views_in_frame
from pcfix.water.surface import is_submerged, surface_above

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
    lens_sets: list[tuple[str, ...]],
    progress: Progress | None = None,
) -> Adjusted:
    """Mend the poses of a block from the cloud that they made.

    Parameters
    ----------
    candidates : list of Candidate
        The same cloud with different guesses which images made each point.
    unknowns : Unknowns
        Its lens parameters are those of `lens_sets` that are chosen.
    lens_sets : list of tuple of str
        Each has those before it and some more.

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
    if first.conditions is not None:
        raise GeometryError(
            "points that lie on the water or on a plane count beside measured tie points only; give"
            " a model with tie points, or take the roles waterline and on:... out of --gcps."
        )
    best = min(
        (_fitting(one, replace(unknowns, lens=lens_sets[0]), progress) for one in candidates),
        key=lambda trial: (trial.sigma_px, trial.misfit),
    )
    chosen = best
    one = next(c for c in candidates if c.name == best.name)
    for names in lens_sets[1:]:
        try:
            more = _trial(one, replace(unknowns, lens=names), best.sigma_px, progress)
        except GeometryError:
            continue
        extra = len(names) - len(chosen.problem.unknowns.lens)
        gain = (chosen.misfit - more.misfit) / max(chosen.mean, 1.0)
        if gain > chdtri(extra * len(chosen.problem.groups), SURE):
            chosen = more
    notes = [_what_counts(chosen, lens_sets)]
    if chosen.sigma_px >= POOR_PX:
        notes.append(
            f"the points of the cloud fit GNSS and control points only if they count as"
            f" {chosen.sigma_px:g} px: they stand poorly for the old tie points, and bed and focal"
            " length may be off by more than all figures here say; give tie points, control points"
            " or a calibrated lens."
        )
    # the points of the cloud say nothing of noise: GNSS and control points are all there is
    free, sigma0 = max(chosen.observations - 7, 1), float(np.sqrt(chosen.mean))
    try:  # about as well as by tie points that are as good as the points of the cloud count
        known = precision_of(chosen.problem, chosen.found, max(sigma0, 1.0))
    except GeometryError as error:
        known = None
        notes.append(f"how well the poses are known is not: {error} SigmaZ goes without.")
    found = adjusted_of(chosen.problem, chosen.found, known, notes, "cloud", "unaware")
    return replace(found, sigma0=sigma0, redundancy=free)


def _what_counts(chosen: Trial, lens_sets: list[tuple[str, ...]]) -> str:
    block, free = chosen.problem.block, chosen.problem.unknowns.lens
    left = dict.fromkeys(name for names in lens_sets for name in names if name not in free)
    return (
        f"without tie points: {block.start[-1]:,} image places of points of the cloud"
        f" ({chosen.name}), counting as {chosen.sigma_px:g} px"
        f"; lens parameters free: {', '.join(free) or 'none'}"
        + (f" (the block does not tell {', '.join(left)})." if left else ".")
    )


def _observed(block: Block) -> int:
    return int((gnss_weights(block) > 0.0).sum())


def _fitting(one: Candidate, unknowns: Unknowns, progress: Progress | None) -> Trial:
    """Return the trial in which the cloud counts most while GNSS and control points still fit."""
    trials: list[Trial] = []
    for sigma in SIGMAS_PX:
        try:
            trials.append(_trial(one, unknowns, sigma, progress))
        except GeometryError:
            if not trials and sigma == SIGMAS_PX[-1]:
                raise
        else:
            if trials[-1].mean <= FITS:
                break
    return trials[-1]


def _trial(one: Candidate, unknowns: Unknowns, sigma_px: float, progress: Progress | None) -> Trial:
    m = len(one.block.xyz) - len(one.block.control_names)
    sigma = np.where(one.block.owner < m, sigma_px, one.block.sigma_px)
    block = replace(one.block, sigma_px=sigma)
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
    return Trial(one.name, problem, found, sigma_px, found.cost + in_images, count)


SIGMA_PX = 0.25
"""Of a place in the image; small, so that the centres only decide where the block lies."""
OWN_SIGMA_M = 1.0
"""Of a projection centre, which holds the block as a whole where it is."""
LEAST_VIEWS, LEAST_POINTS, LEAST_IMAGES = 3, 10, 5


class Mended(NamedTuple):
    """What the poses would be if they had absorbed the refraction, and what that changes.

    cameras : Cameras
        Those of the images that enough points lie in.
    row : shape (k,), of each of them among all.
    land_m, bed_m : shape (m,) and (w,)
        By how much land and bed lie too low now, the bed after its correction with the poses as
        they are.
    """

    cameras: Cameras
    row: IntArray
    land_m: FloatArray
    bed_m: FloatArray


def images_of(xyz: FloatArray, cameras: Cameras) -> TiePoints:
    """Return those points, shape (m, 3), that lie in `LEAST_VIEWS` frames, and their images there.

    The images are those of straight rays.
    """
    views = views_in_frame(xyz, cameras)
    rows = np.flatnonzero(np.diff(views.start) >= LEAST_VIEWS)
    views = views.take(rows)
    owner = np.repeat(rows, np.diff(views.start))
    return TiePoints(xyz[rows], views, straight_images(xyz[owner], views.camera, cameras))


def mended(
    xyz: FloatArray, cameras: Cameras, water: WaterSurface, refractive_index: float
) -> Mended:
    """Return the poses as an adjustment that knows of the water would have them.

    The block stays as a whole where its cameras are.

    Parameters
    ----------
    xyz : array, shape (m, 3)
        Points of the apparent cloud, or tie points, spread over it; a thousand or two.

    Raises
    ------
    GeometryError
        If the cloud does not determine the poses.
    """
    counts = np.bincount(images_of(xyz, cameras).views.camera, minlength=len(cameras))
    row = np.flatnonzero(counts >= LEAST_POINTS)
    if len(row) < LEAST_IMAGES:
        raise GeometryError(f"only {len(row)} images hold {LEAST_POINTS} points of the cloud.")
    cameras = some_cameras(cameras, row)
    ties = images_of(xyz, cameras)
    above = surface_above(water, ties.xyz)
    wet = is_submerged(ties.xyz[:, 2], above)
    if not wet.any():
        raise GeometryError("no point of the cloud under water lies in three images.")
    true = deeper(ties.xyz, above.height_m, wet, refractive_index)
    block = replace(
        plain_block(cameras, replace(ties, xyz=true), water, refractive_index, wet),
        sigma_px=np.full(len(ties.image_xy), SIGMA_PX),
        gnss_xyz=cameras.centres,
        gnss_sigma_m=np.full((len(cameras), 3), OWN_SIGMA_M),
    )
    problem, begin = prepare(block, Unknowns(lens=("f",)))
    tests = straight_columns(problem, begin, ties.xyz - problem.origin)
    found = solve_unaware(problem, begin, tests, np.ones(len(wet), np.bool_))
    higher = found.state.xyz[:, 2] + problem.origin[2] - intersect_fixed(block).xyz[:, 2]
    known = np.isfinite(higher)
    return Mended(solved_cameras(problem, found), row, higher[~wet & known], higher[wet & known])

r"""Adjustment without tie points: an adjustment without water is undone from its cloud only.

An ordinary bundle adjustment that did not know of the water stopped where its residuals r were
orthogonal to all its unknowns:

    sum J'r = 0 for every image,   sum G'r = 0 for the lens,   sum B'r = 0 for every point

with the Jacobians J, G and B of its own straight collinearity at its own solution. Without tie
points the residuals are unknown, but not that they are orthogonal to these columns. So those true
poses and points are found whose images through the water, pi(Q), give r = pi(Q) - pi_original(P)
with

    J_original' r = 0,   G_original' r = 0,   B_original' r = 0

These are as many equations as unknowns (a Petrov-Galerkin method: the columns that test the
residual are not those that change it). Shift, turn and scale of the block are left to GNSS
positions or control points. Taking pi_original(P) as measurements and minimising r would pull the
solution back to the original one instead.

Points of the apparent cloud replace the tie points of that adjustment, which were spread in much
the same way. They have no noise; their weight is how well they represent the tie points. It is the
largest with which GNSS positions and control points fit within their standard deviations. They
count in every image in whose frame they are, or in those of the view list; `pcfix.flow.adjust`
takes what fits better.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from pcfix.adjust.block import Block, plain_block, some_cameras, ties_of_cloud, true_start
from pcfix.adjust.collinearity import SHARED
from pcfix.adjust.normal import UNDAMPED, linearised, point_steps, residuals
from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.precision import precision_of
from pcfix.adjust.problem import Problem, Solution, intersect_fixed, prepare, survey_cost
from pcfix.adjust.result import Adjusted, adjusted_of
from pcfix.adjust.solve import moved_by, reduced_at, show
from pcfix.errors import GeometryError, PcfixWarning
from pcfix.model import Cameras, FloatArray, GnssPositions, IntArray, WaterSurface
from pcfix.refract.choice import views_in_frame
from pcfix.water.surface import is_submerged, surface_above

# Standard deviations of points of the cloud as tie points, tried in this order.
SIGMAS_PX = (0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 3.0, 5.0, 10.0)

POOR_PX = 5.0  # of `SIGMAS_PX`, from which bed and focal length may be less accurate than stated
FITS = 1.15  # mean squared residual of GNSS and control points, in variances, with which they fit
SURE = 1e-3  # probability that further lens parameters lower the misfit as much by chance

MAX_STEPS = 25
CLOSE_M = 1e-7
LARGE_STEP_M = 1e4


class Trial(NamedTuple):
    """The adjustment with one weight of the cloud, and how GNSS and control points fit it.

    The misfit is the weighted sum of squares of their observations, of which seven are the datum.
    """

    problem: Problem
    found: Solution
    sigma_px: float
    misfit: float
    redundancy: int


def adjust_cloud(
    block: Block,
    original: Cameras,
    apparent_xyz: FloatArray,
    unknowns: Unknowns,
    *,
    choose_lens: bool = False,
) -> Adjusted:
    """Adjust a block by points of the cloud that was reconstructed with its original cameras.

    The cameras of the block are the start. `apparent_xyz`, shape (m, 3), is where the cloud has the
    points of the block; control points as surveyed. With `choose_lens`, of the lens only the focal
    length is free, unless all parameters of the unknowns lower the misfit of GNSS and control
    points by more than chance does.
    """
    # 1. Refuse what needs measured tie points
    has_gnss, wrong = bool((block.gnss_weights > 0.0).any()), ("", "")
    if (unknowns.free_network and not has_gnss) or unknowns.poses != "free":
        wrong = "needs_datum", "the poses must be free, with GNSS positions or control points"
    elif any(unknowns.water_sigma):
        wrong = "needs_water", "level, tilt and refractive index must be fixed"
    elif len(block.surfaces[1]):
        plane = "no point of --gcps can be on the water or on a plane (waterline, on:NAME)"
        wrong = "has_conditions", plane
    if wrong[0]:
        words = f"Without tie points {wrong[1]}. Change that, or give a model with tie points."
        raise GeometryError(f"adjust.cloud_{wrong[0]}", words)

    # 2. Find the largest weight of the cloud with which GNSS and control points fit
    def trial(lens: tuple[str, ...], sigma_px: float) -> Trial | None:
        """Return an adjustment; None if it fails."""
        try:
            of_lens = replace(unknowns, lens=lens)
            return _trial(block, original, apparent_xyz, of_lens, sigma_px)
        except GeometryError:
            return None

    lens, chosen, more = ("f",) if choose_lens else unknowns.lens, None, None
    for sigma_px in SIGMAS_PX:
        chosen = trial(lens, sigma_px) or chosen
        if chosen is not None and chosen.misfit <= FITS * chosen.redundancy:
            break
    if chosen is None:
        raise _unsolved("no weight of the cloud gives a solution")
    if lens != unknowns.lens:  # more of the lens
        more = trial(unknowns.lens, chosen.sigma_px)
    if more is not None:
        extra = (len(unknowns.lens) - len(lens)) * (len(chosen.problem.given.first_lens) - 1)
        gain = (chosen.misfit - more.misfit) / max(chosen.misfit / chosen.redundancy, 1.0)
        chosen = more if gain > chdtri(extra, SURE) else chosen
    # 3. Only GNSS and control points have noise; the precision is about that with tie points of the
    # standard deviation of the cloud
    sigma0 = float(np.sqrt(chosen.misfit / chosen.redundancy))
    known = precision_of(chosen.problem, chosen.found, max(sigma0, 1.0))
    count, free = int(chosen.problem.block.start[-1]), chosen.problem.unknowns.lens
    words = (
        f"No tie points: {count:,} images of points of the cloud were used with a standard"
        f" deviation of {chosen.sigma_px:g} px. Lens parameters free: {', '.join(free) or 'none'}."
    )
    if chosen.sigma_px >= POOR_PX:
        words += (
            " They fit GNSS and control points poorly, so bed and focal length may be less accurate"
            " than stated. Give tie points, control points or a calibrated lens."
        )
    fixed = [name for name in unknowns.lens if name not in free]
    values = {"free": list(free), "fixed": fixed, "sigma_px": chosen.sigma_px}
    note = PcfixWarning("adjust.by_cloud", words, **values)
    found = adjusted_of(chosen.problem, chosen.found, known, [note], "cloud")
    return replace(found, sigma0=sigma0, redundancy=chosen.redundancy)


def _trial(
    block: Block, original: Cameras, apparent_xyz: FloatArray, unknowns: Unknowns, sigma_px: float
) -> Trial:
    """Adjust a block with one weight of the cloud."""
    m, owner = block.tie_points, block.owner
    block = replace(block, sigma_px=np.where(owner < m, sigma_px, block.sigma_px))
    problem, start = prepare(block, unknowns)
    # the Jacobians of the straight collinearity at the original solution
    before, at_rest = prepare(replace(block, cameras=original), unknowns)
    o, nowhere = len(owner), np.zeros(len(block.xyz), np.bool_)
    dry = before.given._replace(wet=nowhere, weight=np.ones(o))
    apparent = np.ascontiguousarray(apparent_xyz - before.origin)
    rows = linearised(at_rest.state._replace(xyz=apparent), dry, UNDAMPED, 0, len(apparent))
    tests = np.zeros((o, 2, SHARED + dry.shared))
    tests[rows.observation[rows.is_image]] = rows.columns[rows.is_image]
    found = solve_unaware(problem, start, tests[: block.start[m]])
    marks, weight = problem.used & (owner >= m), problem.given.weight
    r = residuals(found.state, problem.given)[marks]
    in_images = float((r * r * weight[marks][:, None] ** 2).sum())
    # observations with noise, minus the coordinates of the surveyed points
    surveyed = problem.given.surveyed_weight > 0.0
    count = int((block.gnss_weights > 0.0).sum()) + 2 * int(marks.sum()) + int(surveyed.sum())
    count -= 3 * int(surveyed.any(axis=1).sum())
    return Trial(problem, found, sigma_px, found.cost + in_images, max(count - 7, 1))


# The equations


def solve_unaware(problem: Problem, start: Solution, tests: FloatArray) -> Solution:
    """Find poses, lens and points whose residuals are orthogonal to the original columns.

    Points of the cloud were observed where the original cameras image them. The tests, shape
    (t, 2, 9 + g), are the Jacobians of the straight collinearity at the original solution, by pose,
    point and shared unknowns, for these points. Control points are adjusted by least squares.
    """
    given = problem.given._replace(tests=tests)
    tested, now, size = replace(problem, given=given), start, np.inf
    for _ in range(MAX_STEPS):
        # the matrix is not symmetric
        matrix, right = reduced_at(tested, now)
        scale = 1.0 / np.sqrt(np.maximum(np.abs(matrix.diagonal()), 1e-300))
        try:
            step = scale * np.linalg.solve(matrix * scale * scale[:, None], scale * right)
        except np.linalg.LinAlgError:
            raise _unsolved("the equations are singular") from None
        points = point_steps(now.state, given, UNDAMPED, step)
        moved = moved_by(problem, now, step, points)
        size = float(np.abs(points).max(initial=0.0)) if np.isfinite(points).all() else np.inf
        if moved is None or not size < LARGE_STEP_M:
            break
        now = moved
        show(problem, now)
        if size < CLOSE_M:
            return replace(now, cost=survey_cost(problem, now))
    raise _unsolved(f"the steps do not converge (last step {size:.2g} m)")


def _unsolved(why: str) -> GeometryError:
    return GeometryError(
        "adjust.cloud_unsolved",
        f"The poses cannot be adjusted by the cloud: {why}. Give tie points, GNSS positions of more"
        " images, or control points.",
    )


# What absorbed refraction has done to a block


SIGMA_PX = 0.25  # of an image; small, so that the centres only hold the block in place
OWN_SIGMA_M = 1.0  # of a projection centre, which holds the block where it is
LEAST_IMAGES_OF_POINT, LEAST_POINTS, LEAST_IMAGES = 3, 10, 5


class Undone(NamedTuple):
    """What the poses would have absorbed, and the error of heights that this implies."""

    row: IntArray  # (k,), rows of the cameras with enough points
    pattern_m: FloatArray  # (k, 3), their centres minus those of an adjustment with water
    error_m: float  # RMS, heights of the land now, or if there is none of the corrected bed


def undo_absorption(
    xyz: FloatArray, cameras: Cameras, water: WaterSurface, refractive_index: float
) -> Undone:
    """Return the centres minus those of an adjustment with water; the block stays in place.

    The points, shape (m, 3), are a thousand or two of the apparent cloud or of its tie points.
    """
    least, in_frame = LEAST_IMAGES_OF_POINT, views_in_frame(xyz, cameras)
    shown = ties_of_cloud(xyz, in_frame, cameras, least).views.camera
    row = np.flatnonzero(np.bincount(shown, minlength=len(cameras)) >= LEAST_POINTS)
    if len(row) < LEAST_IMAGES:
        raise _unsolved(f"{len(row)} images have {LEAST_POINTS} points, {LEAST_IMAGES} are needed")
    cameras = some_cameras(cameras, row)
    ties = ties_of_cloud(xyz, views_in_frame(xyz, cameras), cameras, least)
    wet = is_submerged(ties.xyz[:, 2], surface_above(water, ties.xyz))
    if not wet.any():
        raise _unsolved("no point under water is in three images")
    true = true_start(ties.xyz, water, refractive_index, wet)
    block = plain_block(cameras, replace(ties, xyz=true), water, refractive_index, wet)
    sigma_m = np.full((len(cameras), 3), OWN_SIGMA_M)
    block = replace(block, gnss=GnssPositions(cameras.centres, sigma_m, None))
    trial = _trial(block, cameras, ties.xyz, Unknowns(lens=("f",)), SIGMA_PX)
    origin, state = trial.problem.origin, trial.found.state
    higher = state.xyz[:, 2] + origin[2] - intersect_fixed(block)[0][:, 2]
    is_land = ~wet if (~wet & np.isfinite(higher)).any() else wet
    error_m = float(np.sqrt(np.nanmean(higher[is_land] ** 2)))
    return Undone(row, cameras.centres - origin - state.centres, error_m)

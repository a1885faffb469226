"""How well an adjustment determines its unknowns: covariances, standard errors, correlations.

The inverse of the reduced normal matrix S is the covariance of poses and shared unknowns for
observations of unit weight, as the points were eliminated and not left out (Triggs et al. 2000,
section 6). All is scaled by the a-posteriori variance of unit weight, and by what groups of
observations disagree beyond it. The datum is that of the
priors; in a free network that of the start values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from pcfix.adjust.block import MOTIONS, WATER_NAMES, Unknowns
from pcfix.adjust.equations import Reduced, Undamped, point_covariances, solver, undamped
from pcfix.adjust.members import Members, drawn, members_of
from pcfix.adjust.problem import Problem, Solution, pose_gradients
from pcfix.adjust.solve import BED, LIMITS, weakest, words_of
from pcfix.errors import GeometryError
from pcfix.model import FloatArray

DENSE_UP_TO = 12_000
"""Unknowns up to which the whole inverse is computed (1.2 GB)."""

QUICK = 1000
"""Unknowns up to which memory does not matter and LAPACK's dpotri costs more than a plain inverse:
on busy cores its threads wait for one another for a third of a second."""

SINGULAR = 1e-13
"""Reciprocal condition of the scaled matrix below which nothing in the inverse can be trusted."""

BLOCK_MOTIONS = (
    "the mean height of the projection centres",
    "the mean tilt of the projection centres along x",
    "the mean tilt of the projection centres along y",
)


class SharedUnknown(NamedTuple):
    """One of the unknowns that all points share.

    name : see `Problem.names`; the level is that at the origin of the block, below the middle of
    the projection centres. added : to its start value.
    sigma : standard error, in its unit: pixels, metres, slopes without unit, radians.
    """

    name: str
    added: float
    sigma: float


@dataclass(frozen=True, eq=False)
class Precision:
    """What the observations say about how well everything is known.

    Attributes
    ----------
    sigma0 : float
        By whose square the covariances are scaled, apart from the factors of `precision_of`.
    pose_covariance : array, shape (k, 6, 6)
        Of the small turn of each camera about the axes of its own frame (radians), and of its
        centre in the world frame (metres). Zero where a pose is fixed.
    shared : tuple of SharedUnknown, length g
    correlation : array, shape (g, g)
        Of the shared unknowns.
    block_correlation : array, shape (g, 3)
        Of the shared unknowns with `BLOCK_MOTIONS`; zero where these are fixed.
    point_covariance_m2 : array, shape (m, 6), or None
        xx, xy, xz, yy, yz, zz, world frame; NaN of points that their observations do not fix.
        None where there are too many unknowns.
    notes : tuple of str
        What was left out.
    members : Members or None
        Drawn from the joint covariance of poses, lens and water; None as for the points.
    """

    sigma0: float
    pose_covariance: FloatArray
    shared: tuple[SharedUnknown, ...]
    correlation: FloatArray
    block_correlation: FloatArray
    point_covariance_m2: FloatArray | None
    notes: tuple[str, ...] = ()
    members: Members | None = None

    @property
    def centre_sigma_m(self) -> FloatArray:
        """Standard errors of the projection centres along x, y, z, shape (k, 3), metres."""
        return np.asarray(np.sqrt(np.einsum("kii->ki", self.pose_covariance)[:, 3:]))

    @property
    def angle_sigma_deg(self) -> FloatArray:
        """Standard errors of turns about the axes of each camera's frame, shape (k, 3)."""
        return np.asarray(np.degrees(np.sqrt(np.einsum("kii->ki", self.pose_covariance)[:, :3])))

    @property
    def point_sigma_m(self) -> FloatArray | None:
        """Standard errors of the points along x, y, z, shape (m, 3), metres."""
        covariance = self.point_covariance_m2
        return None if covariance is None else np.sqrt(covariance[:, [0, 3, 5]])

    def sigma_of(self, name: str) -> float | None:
        """Return the standard error of a shared unknown; None where it is fixed."""
        return next((row.sigma for row in self.shared if row.name == name), None)


def precision_of(
    problem: Problem, solution: Solution, sigma0: float = 1.0, factor: FloatArray | None = None
) -> Precision:
    """Return covariances and correlations at a solution.

    Parameters
    ----------
    problem : Problem
        Outliers without weight.
    solution : Solution
    sigma0 : float
        A-posteriori standard deviation of unit weight; 1 for what the given ones say.
    factor : array, shape (6 + g,), optional
        By which standard errors grow besides: of the angles and centres of all poses, and of the
        shared unknowns; see `pcfix.adjust.disagreement`.

    Raises
    ------
    GeometryError
        If the block does not determine its unknowns; says which.
    """
    equations = undamped(problem, solution)
    size, k = len(equations.reduced.active), len(solution.state.centres)
    g = problem.columns.total
    times = np.ones(6 + g) if factor is None else factor
    each = np.concatenate([np.tile(times[:6], k), times[6:]])[equations.reduced.active]
    asked = _asked(problem, solution)[equations.reduced.active] * each[:, None]
    variance = sigma0 * sigma0
    notes: list[str] = []
    points: FloatArray | None = None
    members: Members | None = None
    if loose := int((~equations.is_fixed).sum()):
        notes.append(f"{loose:,} points that their images do not fix have no covariance.")
    if size <= DENSE_UP_TO:
        inverse = _inverse(equations, solution)
        of_asked = asked.T @ inverse @ asked
        inverse *= each
        inverse *= each[:, None]
        poses = _pose_blocks(problem, solution, equations.reduced, inverse)
        points = variance * point_covariances(equations, solution, inverse)
        active = equations.reduced.active
        members = members_of(problem, solution, active, sigma0 * drawn(inverse))
    else:
        of_asked, poses = _by_parts(equations, solution, asked)
        poses *= times[:6] * times[:6, None]
        notes.append(
            f"The covariances of the points were left out, and the ensemble: {size:,} unknowns of"
            f" poses, lens and water are more than {DENSE_UP_TO:,}."
        )
    correlation = _correlations(of_asked)
    sigma = np.sqrt(np.diag(of_asked)[:g]) * sigma0
    rows = zip(problem.names, solution.shared.tolist(), sigma.tolist(), strict=True)
    return Precision(
        sigma0, variance * poses.reshape(k, 6, 6), tuple(SharedUnknown(*row) for row in rows),
        correlation[:g, :g], correlation[:g, g:], points, tuple(notes), members,
    )  # fmt: skip


def _asked(problem: Problem, solution: Solution) -> FloatArray:
    """Return what shared unknowns and block motions are of all unknowns, shape (u, g + 3)."""
    k, g = len(solution.state.centres), problem.columns.total
    rows = np.zeros((6 * k + g, g + 3))
    rows[6 * k :, :g] = np.eye(g)
    away = solution.state.centres - solution.state.centres.mean(axis=0)
    fit = np.linalg.pinv(np.column_stack([np.ones(k), away[:, :2]]), rcond=1e-6)
    if problem.columns.similarity < 0:
        rows[5 : 6 * k : 6, g:] = fit.T
        return rows
    at = 6 * k + problem.columns.similarity
    upward = pose_gradients(solution.state, problem.columns.pivot)[:, 5]
    rows[at : at + 7, g:] = np.einsum("ak,kb->ba", fit, upward)
    return rows


def _inverse(equations: Undamped, solution: Solution) -> FloatArray:
    """Return the whole inverse, by Cholesky's method with a unit diagonal."""
    from scipy.linalg import lapack

    matrix = equations.reduced.matrix
    if matrix.shape[0] == 0:
        return np.zeros((0, 0))
    a = np.array(matrix if isinstance(matrix, np.ndarray) else matrix.toarray(), order="F")
    diagonal = a.diagonal()
    if not (diagonal > 0.0).all():
        raise _singular(equations, solution)
    scale = 1.0 / np.sqrt(diagonal)
    a *= scale
    a *= scale[:, None]
    norm = lapack.dlange("1", a)  # type: ignore[call-arg]
    factor, failed = lapack.dpotrf(a, lower=1, overwrite_a=len(a) > QUICK)
    if failed:
        raise _singular(equations, solution)
    a = _inverted(a, factor)
    if not norm * lapack.dlange("1", a) * SINGULAR < 1.0:  # type: ignore[call-arg]
        raise _singular(equations, solution)
    a *= scale
    a *= scale[:, None]
    return np.asarray(a)


def _inverted(a: FloatArray, factor: FloatArray) -> FloatArray:
    """Return the inverse, of a large matrix in the place of its factor."""
    from scipy.linalg import lapack

    if len(a) <= QUICK:
        inverse = np.linalg.inv(a)
        return np.asarray(0.5 * (inverse + inverse.T))
    found, _ = lapack.dpotri(factor, lower=1, overwrite_c=1)
    for i in range(1, len(found)):
        found[:i, i] = found[i, :i]
    return np.asarray(found)


def _singular(equations: Undamped, solution: Solution) -> GeometryError:
    return GeometryError(
        "the normal equations are singular: " + weakest(equations.problem, solution)
    )


def _pose_blocks(
    problem: Problem, solution: Solution, reduced: Reduced, inverse: FloatArray
) -> FloatArray:
    """Return the covariance of each pose, shape (k, 6, 6)."""
    k = len(solution.state.centres)
    poses = np.zeros((k, 6, 6))
    if problem.columns.similarity >= 0:
        at = problem.columns.similarity
        by = pose_gradients(solution.state, problem.columns.pivot)
        return np.asarray(by @ inverse[at : at + 7, at : at + 7] @ by.transpose(0, 2, 1))
    place = np.full(len(problem.moves), -1)
    place[reduced.active] = np.arange(len(reduced.active))
    first = place[: 6 * k : 6]
    rows = first[first >= 0][:, None] + np.arange(6)
    poses[first >= 0] = inverse[rows[:, :, None], rows[:, None, :]]
    return poses


def _by_parts(
    equations: Undamped, solution: Solution, asked: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return covariances of what is asked for and of each pose, without the whole inverse."""
    reduced, k = equations.reduced, len(solution.state.centres)
    solve_for = solver(reduced)
    if solve_for is None:
        raise _singular(equations, solution)
    of_asked = asked.T @ solve_for(asked)
    poses = np.zeros((k, 6, 6))
    first = np.searchsorted(reduced.active, 6 * np.arange(k))
    moves = np.flatnonzero(reduced.active[np.minimum(first, len(asked) - 1)] == 6 * np.arange(k))
    for part in np.array_split(moves, max(1, len(moves) // 32)):
        rows = first[part][:, None] + np.arange(6)
        unit = np.zeros((len(asked), rows.size))
        unit[rows.ravel(), np.arange(rows.size)] = 1.0
        found = solve_for(unit).reshape(len(asked), len(part), 6)
        poses[part] = found[rows, np.arange(len(part))[:, None]]
    if not (np.diag(of_asked) >= 0.0).all() or not (np.einsum("kii->ki", poses) >= 0.0).all():
        raise _singular(equations, solution)
    return np.asarray(of_asked), poses


def _correlations(covariance: FloatArray) -> FloatArray:
    """Return correlations; zero with what is fixed, whose variance is zero."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    known = sigma > 0.0
    scale = np.where(known, 1.0 / np.where(known, sigma, 1.0), 0.0)
    return np.asarray(covariance * scale * scale[:, None])


STRONG = 0.95


NO_NEWS = 0.9
"""Share of a given standard deviation above which the images told nothing beyond it."""


def strong_correlations(precision: Precision) -> list[str]:
    """Return a sentence for each two unknowns that are hardly told apart, the strongest first.

    Pairs of k1, k2, ... are left out: they always are, and it harms nothing.
    """
    names = [row.name for row in precision.shared]
    found: list[tuple[float, str]] = []
    for i, name in enumerate(names):
        for j in range(i):
            r = float(precision.correlation[i, j])
            if abs(r) > STRONG and not (name[0] == names[j][0] == "k"):
                found.append((r, _pair(names[j], name, r)))
        for words, r in zip(BLOCK_MOTIONS, precision.block_correlation[i].tolist(), strict=True):
            # where poses move together, their shift is a shared unknown of its own
            if abs(r) > STRONG and name not in MOTIONS:
                found.append((r, _with_block(name, words, r)))
    return [words for _, words in sorted(found, key=lambda row: -abs(row[0]))]


def _pair(a: str, b: str, r: float) -> str:
    beds, words = (a in BED) + (b in BED), f"{words_of(a)} and {words_of(b)}"
    if beds == 2:
        return f"{words} move the bed alike: r = {r:.3f}; fix one of them."
    if beds == 1:
        return (
            f"{words} are hardly told apart: r = {r:.3f}; fix one of them, or give control points"
            " at several heights."
        )
    return f"{words} do the same to the images: r = {r:.3f}; fix one of them."


def _with_block(name: str, motion: str, r: float) -> str:
    remedy = "on land or better GNSS positions" if name in BED else "at several heights or obliques"
    return (
        f"{words_of(name)} and {motion} are hardly told apart: r = {r:.3f}; fix it, or give control"
        f" points {remedy}."
    )


LEAST_BEND_M = 0.02
"""Standard error of the bend of the water, from where it counts as undetermined, as the level."""

SURE = 0.01
"""Probability that flat water seems to be bent, by chance."""


def shape_doubts(precision: Precision, wet_xy: FloatArray) -> list[str]:
    """Return a sentence if the block cannot tell the shape of the water, where it was free.

    Parameters
    ----------
    wet_xy : array, shape (m, 2)
        Points under water, about the origin of the block, metres. What bends the water over them
        is what a plane does not take up.
    """
    rows = [i for i, row in enumerate(precision.shared) if row.name.startswith("shape_")]
    if not rows or len(wet_xy) < 6:
        return []
    x, y = wet_xy.T
    terms, plane = np.column_stack([x * x, x * y, y * y]), np.column_stack([np.ones(len(x)), x, y])
    terms = terms - plane @ np.linalg.lstsq(plane, terms, rcond=None)[0]
    by, sigma = np.array([[precision.shared[i].added, precision.shared[i].sigma] for i in rows]).T
    covariance = precision.correlation[np.ix_(rows, rows)] * sigma * sigma[:, None]
    chi2 = float(by @ np.linalg.solve(covariance, by))
    bend = float(np.sqrt(np.mean((terms @ by) ** 2)))
    error = float(np.sqrt(np.mean(np.einsum("mi,ij,mj->m", terms, covariance, terms))))
    if error <= LEAST_BEND_M and chi2 > chdtri(len(rows), SURE):
        return []
    figures = (
        f"its shape bends it by {1000.0 * bend:.2g} mm (rms over the bed), with a standard error of"
        f" {1000.0 * error:.2g} mm; leave shape out of --free"
    )
    if error > LEAST_BEND_M:
        more = "mark waterline points, or give more tie points under water"
        return [f"the block does not tell the shape of the water: {figures}, or {more}."]
    return [f"the water is a plane as far as the block tells: {figures}."]


def undetermined(precision: Precision, unknowns: Unknowns) -> list[str]:
    """Return a sentence for each unknown whose standard error is too large to be of use."""
    given = dict(zip(WATER_NAMES, unknowns.water_sigma, strict=True)) | unknowns.lens_sigma
    notes = []
    for row in precision.shared:
        limit, unit, _ = LIMITS.get(row.name, (math.inf, "", ""))
        prior = given.get(row.name.partition(" of sensor ")[0], math.inf)
        space = f" {unit}" if unit else ""
        if row.sigma > limit:
            notes.append(
                f"{words_of(row.name)} is undetermined: its standard error of"
                f" {row.sigma:.2g}{space} exceeds {limit:g}{space}; fix it to a measured value."
            )
        elif prior < math.inf and row.sigma > NO_NEWS * prior:
            notes.append(
                f"{words_of(row.name)} is what was given: the images tell no more than its standard"
                f" deviation of {prior:g}{space}."
            )
    return notes

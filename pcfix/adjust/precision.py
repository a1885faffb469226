"""The precision of an adjustment: covariances, standard errors, correlations, an ensemble.

The inverse of the reduced normal matrix S is the covariance of poses and shared unknowns for
observations of unit weight, because the points were eliminated and not ignored (Triggs et al. 2000,
section 6). It is scaled by the a-posteriori variance of unit weight, and by factors for errors that
observations share (`pcfix.adjust.shared_errors`). The datum is that of the prior knowledge; in a
free network that of the start values.

Standard errors do not tell that errors of a block are correlated: a focal length that is too long
is compensated by cameras that are too high. So members of an ensemble are drawn from the joint
covariance. Whatever is computed with each of them in turn scatters by all errors at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pcfix.adjust.normal import UNDAMPED, sparse_rows_of
from pcfix.adjust.parameters import CODES, INDEX, PORT, SHAPE, lens_parameter, moved_lens, words_of
from pcfix.adjust.problem import Problem, Solution, polynomial
from pcfix.adjust.solve import moved_by, reduced_at, singular, solver
from pcfix.errors import PcfixWarning
from pcfix.model import Cameras, FloatArray, WaterPlane, WaterRaster, WaterSurface

DENSE_UP_TO = 12_000
"""Unknowns up to which the whole inverse is computed (1.2 GB)."""

MOST_POINTS, POINTS_AT_ONCE = 50_000, 500
"""Points whose standard errors are computed, and how many at a time, which limits the memory."""

SINGULAR = 1e-12
"""Share of the variance of an unknown, if all others were known, below which none is meaningful."""


class SharedUnknown(NamedTuple):
    """A shared unknown; units are pixels, metres, slopes, radians.

    The level is that at the origin of the block, below the mean of the projection centres.
    """

    name: str
    added: float  # correction to its start value
    sigma: float  # its standard error


@dataclass(frozen=True, eq=False)
class Precision:
    """The precision of an adjustment with k cameras, m points and g shared unknowns."""

    sigma0: float  # a-posteriori standard deviation of unit weight, which scales the covariances
    # (k, 6, 6), rotation in the camera frame (rad), centre in the world (m); zero if fixed
    pose_covariance: FloatArray
    shared: tuple[SharedUnknown, ...]
    correlation: FloatArray  # (g, g), of the shared unknowns
    # (m, 3), standard errors of the points along x, y, z in metres; NaN if not determined, or not
    # among the `MOST_POINTS` of a large block, None for very large ones
    point_sigma_m: FloatArray | None
    members: Members | None = None  # drawn from the joint covariance; None for very large blocks

    @property
    def centre_sigma_m(self) -> FloatArray:
        """Standard errors of the projection centres along x, y, z, shape (k, 3), metres."""
        return np.asarray(np.sqrt(np.einsum("kii->ki", self.pose_covariance)[:, 3:]))

    @property
    def angle_sigma_deg(self) -> FloatArray:
        """Standard errors of rotations about the axes of the cameras, shape (k, 3)."""
        return np.asarray(np.degrees(np.sqrt(np.einsum("kii->ki", self.pose_covariance)[:, :3])))

    def sigma_of(self, name: str) -> float | None:
        """Return the standard error of a shared unknown; None if it is fixed."""
        return next((row.sigma for row in self.shared if row.name == name), None)


def precision_of(
    problem: Problem, solution: Solution, sigma0: float = 1.0, factor: FloatArray | None = None, *,
    only_poses: bool = False,
) -> Precision:  # fmt: skip
    """Return covariances and correlations at a solution.

    Parameters
    ----------
    problem : Problem
        Outliers have no weight.
    solution : Solution
    sigma0 : float
        A-posteriori standard deviation of unit weight; 1 for the given standard deviations.
    factor : array, shape (6 + g,), optional
        Further factors of standard errors: of angles and centres of all poses, and of the shared
        unknowns; see `pcfix.adjust.shared_errors`.
    only_poses : bool
        Whether standard errors of the points and an ensemble are not wanted.
    """
    matrix, k, g = reduced_at(problem, solution)[0], len(solution.lenses), len(problem.names)
    times, u = np.ones(6 + g) if factor is None else factor, matrix.shape[0]
    solve_for = solver(matrix)
    if solve_for is None:
        raise singular(problem, solution)
    # columns of the inverse, some at a time: those of 32 poses, then those of the shared unknowns
    is_wanted = u <= DENSE_UP_TO and not only_poses
    poses, inverse = np.zeros((k, 6, 6)), np.empty((u, u)) if is_wanted else None
    first, last = np.arange(0, u - g, 6), np.arange(u - g, u)
    for part in (*np.array_split(first, -(-len(first) // 32) or 1), None):
        rows = last if part is None else (part[:, None] + np.arange(6)).ravel()
        unit = np.zeros((u, len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        columns = solve_for(unit)
        if inverse is not None:
            inverse[:, rows] = columns
        if part is not None:
            of_part = columns[rows].reshape(len(part), 6, len(part), 6)
            poses[part // 6] = np.einsum("kikj->kij", of_part)
    of_shared = columns[last]
    diagonal = np.append(np.einsum("kii->ki", poses), of_shared.diagonal())[problem.fixed :]
    if not ((diagonal > 0.0) & (diagonal * matrix.diagonal() * SINGULAR < 1.0)).all():
        raise singular(problem, solution)
    of_shared = of_shared * times[6:] * times[6:, None]
    poses = poses * times[:6] * times[:6, None]
    points: FloatArray | None = None
    members: Members | None = None
    if inverse is not None:
        each = np.append(np.tile(times[:6], k), times[6:])[problem.fixed :]
        inverse *= each
        inverse *= each[:, None]
        points = sigma0 * _point_sigma(problem, solution, inverse)
        members = members_of(problem, solution, sigma0 * drawn(inverse))
    sigma = np.sqrt(np.diag(of_shared))
    correlation = of_shared / sigma / sigma[:, None]
    rows_of = zip(problem.names, solution.shared.tolist(), (sigma * sigma0).tolist(), strict=True)
    return Precision(
        sigma0, sigma0**2 * poses, tuple(SharedUnknown(*row) for row in rows_of), correlation,
        points, members,
    )  # fmt: skip


def _point_sigma(problem: Problem, found: Solution, inverse: FloatArray) -> FloatArray:
    """Return standard errors of the points for observations of unit weight, shape (m, 3).

    Their variances are those of V^-1 + V^-1 W' S^-1 W V^-1. The inverse S^-1 of the free unknowns
    has the shape (u, u).
    """
    sigma, first = np.full_like(found.state.xyz, np.nan), 0
    step = 1 + len(sigma) // MOST_POINTS
    for part in sparse_rows_of(found.state, problem.given, UNDAMPED):
        last = first + len(part.rows.rhs)
        own = part.inverse.diagonal().reshape(-1, 3)
        for some in range(0, last - first, step * POINTS_AT_ONCE):
            rows = np.arange(some, min(some + step * POINTS_AT_ONCE, last - first), step)
            coupling = part.coupling[(3 * rows[:, None] + np.arange(3)).ravel(), problem.fixed :]
            by_others = coupling.multiply(coupling @ inverse).sum(axis=1)
            # points that their rays do not fix have no variance
            square = np.where(own[rows] > 0.0, own[rows] + by_others.reshape(-1, 3), np.nan)
            sigma[first + rows] = np.sqrt(square)
        first = last
    return sigma


# What is known poorly


LIMITS = {
    "level": 0.02, "tilt_x": 0.0005, "tilt_y": 0.0005, "index": 0.005,
    "distance": 0.002, "centre_x": 0.002, "centre_y": 0.002, "centre_z": 0.002,
    "shape_xx": 1e-4, "shape_xy": 1e-4, "shape_yy": 1e-4,
}  # fmt: skip
"""Standard errors beyond which an unknown counts as undetermined; 1e-4 / m is 2 cm at 14 m."""

STRONG = 0.95
"""Correlation of two unknowns that are hardly separated."""


def undetermined(precision: Precision) -> list[PcfixWarning]:
    """Return a warning for each unknown whose standard error is too large to be useful.

    It names the unknown from which this one is hardly separated, if there is one.
    """
    notes, shared = [], precision.shared
    for i, row in enumerate(shared):
        (what, unit), limit = words_of(row.name), LIMITS.get(row.name, np.inf)
        if row.sigma <= limit:
            continue
        words = (
            f"the {what} is undetermined: standard error {row.sigma:.2g}{unit} (limit"
            f" {limit:.2g}{unit})."
        )
        values: dict[str, Any] = {"unknown": row.name, "sigma": row.sigma}
        r = np.where(np.arange(len(shared)) == i, 0.0, precision.correlation[i])
        other = int(np.abs(r).argmax())
        if abs(r[other]) > STRONG:
            pair, values["correlated_with"] = words_of(shared[other].name)[0], shared[other].name
            words += f" It is strongly correlated with the {pair} (r = {r[other]:.3f})."
        words += " Fix it to a measured value, or give control points at several heights."
        notes.append(PcfixWarning("adjust.undetermined", words, **values))
    return notes


# The ensemble


MEMBERS, AXES = 32, 16
"""So many members leave an eighth of a standard deviation to chance, but nothing along the axes."""

TINY = 1e-10
"""Added to the diagonal of correlations, which rounding may leave indefinite."""

SAME_M, SAME_FOCAL = 1e-3, 1e-6
"""Differences of distances between centres, and relative ones of focal lengths, in one block."""


@dataclass(frozen=True, eq=False)
class Members:
    """Corrections of m members of an ensemble to the k cameras of a block and to its water.

    Those of the water are added to its height below the mean of the centres, its slopes along x and
    y, the refractive index, and d, e, f of d x^2 + e x y + f y^2 about there; zero if fixed.
    """

    labels: tuple[str, ...]  # length k
    centres: FloatArray  # (k, 3), of the adjusted block, to recognise it
    focal: FloatArray  # (k,), the same
    turn: FloatArray  # (m, k, 3), rotation vectors in the frame of each camera, radians
    shift_m: FloatArray  # (m, k, 3), of the centres, along the same axes
    lens_names: tuple[str, ...]  # length p
    lens: FloatArray  # (m, k, p), added to these parameters
    water: FloatArray  # (m, 7)

    def __len__(self) -> int:
        return len(self.turn)

    def aligned(self, cameras: Cameras) -> Members | None:
        """Return the members in the order of their cameras, in any CRS; None for other cameras."""
        row = {label: i for i, label in enumerate(self.labels)}
        if len(row) < len(self.labels) or sorted(cameras.labels) != sorted(self.labels):
            return None
        rows = np.array([row[label] for label in cameras.labels])
        if cameras.rotations is None or cameras.lenses is None:
            return None
        focal = np.array([lens.focal for lens in cameras.lenses])
        here, there = (
            np.linalg.norm(c - c.mean(axis=0), axis=1)
            for c in (self.centres[rows], cameras.centres)
        )
        # maps differ in scale
        there = there * (here.mean() / max(float(there.mean()), SAME_M))
        is_same = np.abs(focal / self.focal[rows] - 1.0).max() < SAME_FOCAL
        if not is_same or np.abs(there - here).max() >= SAME_M:
            return None
        return Members(
            cameras.labels, self.centres[rows], self.focal[rows], self.turn[:, rows],
            self.shift_m[:, rows], self.lens_names, self.lens[:, rows], self.water,
        )  # fmt: skip

    def cameras(self, member: int, nominal: Cameras) -> Cameras:
        """Return the cameras of a member, given the adjusted ones in the same order."""
        rotations = np.asarray(nominal.rotations)
        codes = tuple(CODES[name] for name in self.lens_names)
        lenses = zip(nominal.lenses or (), self.lens[member], strict=True)
        return replace(
            nominal,
            centres=nominal.centres + np.einsum("kji,kj->ki", rotations, self.shift_m[member]),
            rotations=Rotation.from_rotvec(self.turn[member]).as_matrix() @ rotations,
            lenses=tuple(moved_lens(lens, codes, add) for lens, add in lenses),
        )

    def surface(self, member: int, water: WaterSurface, cameras: Cameras) -> WaterSurface:
        """Return the water of a member; a mesh or a dimension of the cloud stays the same."""
        level, b, c, _ = self.water[member, :4].tolist()
        if not np.delete(self.water[member], INDEX).any():
            return water
        x, y, _ = cameras.centres.mean(axis=0).tolist()
        if isinstance(water, WaterRaster):
            rows, columns = (np.arange(n) + 0.5 for n in water.height_m.shape)
            dx = (water.left_m + water.cell_m[0] * columns - x)[None, :]
            dy = (water.top_m - water.cell_m[1] * rows - y)[:, None]
            return replace(water, height_m=water.height_m + polynomial(self.water[member], dx, dy))
        if not isinstance(water, WaterPlane):
            return water
        return WaterPlane(water.a + level - b * x - c * y, water.b + b, water.c + c)


def drawn(covariance: FloatArray, count: int = MEMBERS) -> FloatArray:
    """Return random draws from a covariance, shape (a, a), as rows; always the same.

    Along the largest axes of its correlations, on which most unknowns move together, they scatter
    by exactly the variance; along all others by chance.
    """
    from scipy.linalg import cholesky
    from scipy.sparse.linalg import eigsh

    sigma, rng = np.sqrt(covariance.diagonal()), np.random.default_rng(0)
    correlation = np.array(covariance / sigma, order="F")
    correlation /= sigma[:, None]
    correlation[np.diag_indices(len(sigma))] += TINY
    few = min(AXES, count, len(sigma) - 1)
    found = eigsh(correlation, few, v0=np.ones(len(sigma))) if few > 0 else None
    factor = cholesky(correlation, lower=True, overwrite_a=True)
    draws = rng.standard_normal((count, len(sigma))) @ factor.T
    if found is not None:
        values, axes = found
        even = np.linalg.qr(draws @ axes)[0] * np.sqrt(count * values)
        draws += (even - draws @ axes) @ axes.T
    return np.asarray(draws * sigma)


def members_of(problem: Problem, found: Solution, steps: FloatArray) -> Members:
    """Return the members that differ from a solution by steps, shape (m, u), of free unknowns.

    Steps that take a lens or an index out of its range are skipped.
    """
    state, names = found.state, problem.unknowns.lens
    codes = [CODES[name] for name in names]
    before = [[lens_parameter(lens, code) for code in codes] for lens in found.lenses]
    turn, shift, lens, water = [], [], [], []
    for step in np.hstack([np.zeros((len(steps), problem.fixed)), steps]):
        moved = moved_by(problem, found, step, np.zeros_like(state.xyz))
        if moved is None:
            continue
        r, by = state.rotations, moved.state.water - state.water
        turn.append(Rotation.from_matrix(moved.state.rotations @ r.transpose(0, 2, 1)).as_rotvec())
        shift.append(np.einsum("kij,kj->ki", r, moved.state.centres - state.centres))
        after = [[lens_parameter(lens, code) for code in codes] for lens in moved.lenses]
        lens.append(np.array(after) - np.array(before))
        # level and slopes below the mean of the cameras, not at the origin of the block
        x, y, _ = state.centres.mean(axis=0)
        d, e, f = by[SHAPE:PORT]
        slopes = by[1] + 2.0 * d * x + e * y, by[2] + e * x + 2.0 * f * y
        water.append([float(polynomial(by, x, y)), *slopes, by[INDEX], d, e, f])
    k, m = len(state.centres), len(turn)
    return Members(
        problem.block.cameras.labels,
        state.centres + problem.origin,
        np.array([lens.focal for lens in found.lenses]),
        np.reshape(turn, (m, k, 3)),
        np.reshape(shift, (m, k, 3)),
        names,
        np.reshape(lens, (m, k, len(names))),
        np.reshape(water, (m, 7)),
    )

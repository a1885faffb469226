"""The precision of an adjustment: covariances, standard errors, correlations, an ensemble.

The inverse of the reduced normal matrix S is the covariance of poses and shared unknowns for
observations of unit weight, because the points were eliminated and not ignored (Triggs et al. 2000,
section 6). It is scaled by the a-posteriori variance of unit weight. The datum is that of the prior
knowledge; in a free network that of the start values.

These standard errors hold for independent errors. Errors of matching and of the lens model are
shared: by neighbouring points, by one image, by one place in the frame. A group of observations
contributes a part h of the right side; all parts together are zero. Without the other parts it
would move the unknowns by S^-1 h, and the sum of the squares over the groups is a variance that
allows for errors shared within a group (sandwich estimator: White 1980, Liang & Zeger 1986; to
first order a delete-a-group jackknife). Random groups of points give that variance without shared
errors, and random residuals that of observations of equal quality. The excess, if an F-test
confirms it, is added to the variances.

Places in the frame are too few for that, and lens, angles and centres absorb most of what they
share. There a smooth field of image shifts is estimated, as of terms that the lens model lacks: a
random field with standard deviation s in pixels, smooth over some part of the frame. With shifts e
of tiles of the frame as candidates besides the unknowns, R = C - B' A^-1 B and their right sides c
(see `pcfix.adjust.from_ties`), c has the covariance sigma0^2 R + s^2 R K R, where K is the
covariance of the tiles. That gives the likelihood of s. The mean over all s and ranges is used, so
that fields too small to be found count too. The unknowns move by A^-1 B e.

Standard errors do not show that errors of a block are correlated: a focal length that is too long
is compensated by cameras that are too high. So members of an ensemble are drawn from the joint
covariance. Whatever is computed with each of them in turn scatters by all errors at once.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import fdtri

from pcfix.adjust.normal import UNDAMPED, sparse_matrix, sparse_rows_of
from pcfix.adjust.parameters import CODES, CX, CY, FOCAL, INDEX, NAMES, PORT, SHAPE, moved_lens
from pcfix.adjust.problem import Problem, Solution, polynomial
from pcfix.adjust.solve import moved_by, reduced_at, singular, solver
from pcfix.model import Cameras, FloatArray, IntArray, WaterPlane, WaterRaster, WaterSurface

DENSE_UP_TO = 12_000  # unknowns up to which the whole inverse is computed (1.2 GB)

# Points whose standard errors are computed, and how many at a time, which limits the memory.
MOST_POINTS, POINTS_AT_ONCE = 50_000, 500

SINGULAR = 1e-12  # least share of a variance (all other unknowns known) that is meaningful


class SharedUnknown(NamedTuple):
    """A shared unknown before and after the adjustment: pixels, metres, slopes, radians.

    The level is that at the origin of the block, below the mean of the projection centres.
    """

    before: float
    after: float
    sigma: float  # standard error


@dataclass(frozen=True, eq=False)
class Precision:
    """The precision of an adjustment with k cameras, m points and g shared unknowns."""

    sigma0: float  # a-posteriori standard deviation of unit weight, which scales the covariances
    # (k, 6, 6), rotation in the camera frame (rad), centre in the world (m); zero if fixed
    pose_covariance: FloatArray
    shared: dict[str, SharedUnknown]  # by name, in the order of `Problem.names`
    correlation: FloatArray  # (g, g), of the shared unknowns
    # (m, 3), standard errors of the points along x, y, z in metres; NaN if not determined, or not
    # among the `MOST_POINTS` of a large block, None for very large ones
    point_sigma_m: FloatArray | None
    members: "Members | None" = None  # drawn from the joint covariance; None for very large blocks

    @property
    def centre_sigma_m(self) -> FloatArray:
        """Standard errors of the projection centres along x, y, z, shape (k, 3), metres."""
        return np.asarray(np.sqrt(np.einsum("kii->ki", self.pose_covariance)[:, 3:]))

    @property
    def angle_sigma_deg(self) -> FloatArray:
        """Standard errors of rotations about the axes of the cameras, shape (k, 3)."""
        return np.asarray(np.degrees(np.sqrt(np.einsum("kii->ki", self.pose_covariance)[:, :3])))

    @property
    def shared_sigma(self) -> FloatArray:
        """Standard errors of the shared unknowns, shape (g,)."""
        return np.array([row.sigma for row in self.shared.values()])


def precision_of(
    problem: Problem, solution: Solution, sigma0: float = 1.0, factor: FloatArray | None = None, *,
    only_poses: bool = False,
) -> Precision:  # fmt: skip
    """Return covariances and correlations at a solution.

    `sigma0` is the a-posteriori standard deviation of unit weight; 1 for the given standard
    deviations. `factor`, shape (6 + g,), has further factors of standard errors: of angles and
    centres of all poses, and of the shared unknowns (`disagreement_of`, `common_errors`).
    `only_poses` is without standard errors of the points and without an ensemble.
    """
    matrix, k, g = reduced_at(problem, solution)[0], len(solution.lenses), len(problem.names)
    times, u = np.ones(6 + g) if factor is None else factor, matrix.shape[0]
    solve_for = solver(matrix)
    if solve_for is None:
        raise singular(problem, solution)
    # columns of S^-1, some at a time: those of 32 poses, then those of the shared unknowns
    inverse = None if u > DENSE_UP_TO or only_poses else np.empty((u, u))
    poses, of_shared = np.zeros((k, 6, 6)), np.zeros((g, g))
    for rows in [*np.split(np.arange(u - g), range(192, u - g, 192)), np.arange(u - g, u)]:
        unit = np.zeros((u, len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        columns = solve_for(unit)
        if inverse is not None:
            inverse[:, rows] = columns
        if not len(rows) or rows[0] >= u - g:
            of_shared = columns[rows]
        else:
            six_by_six = columns[rows].reshape(-1, 6, len(rows) // 6, 6)
            poses[rows[::6] // 6] = np.einsum("kikj->kij", six_by_six)
    diagonal = np.append(np.einsum("kii->ki", poses), of_shared.diagonal())[problem.fixed :]
    if not ((diagonal > 0.0) & (diagonal * matrix.diagonal() * SINGULAR < 1.0)).all():
        raise singular(problem, solution)
    points = members = None
    if inverse is not None:
        each = np.append(np.tile(times[:6], k), times[6:])[problem.fixed :]
        inverse *= each
        inverse *= each[:, None]
        points = sigma0 * _point_sigma(problem, solution, inverse)
        members = members_of(problem, solution, sigma0 * drawn(inverse))
    sigma = np.sqrt(np.diag(of_shared))
    rows_of = zip(
        problem.start_values, problem.start_values + solution.shared, sigma0 * times[6:] * sigma,
        strict=True,
    )  # fmt: skip
    return Precision(
        sigma0,
        sigma0**2 * poses * times[:6] * times[:6, None],
        {name: SharedUnknown(*row) for name, row in zip(problem.names, rows_of, strict=True)},
        of_shared / sigma / sigma[:, None],
        points,
        members,
    )


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


# Errors that observations share


SURE = 0.99  # probability with which equal groups would not differ by as much
MOST_TILES, POINTS_PER_TILE, FRAME_TILES = 400, 25, 48
LEAST_GROUPS = 10  # fewer groups do not give a variance

# Error in common to all images at the corner of the frame, as a share of the image noise: matching
# shifts features with their slope, and outliers of the original adjustment are missing on one side.
# Focal length and principal point absorb it, so that poses and bed are right, and residuals do not
# show it. Rendered blocks, whose lens is known, had up to 1.5 times this.
COMMON_SHARE = 0.5


def disagreement_of(problem: Problem, found: Solution, formal: Precision) -> FloatArray:
    """Return by which factors standard errors must grow for shared errors, shape (6 + g,).

    They are those of the angles and centres of all poses, and of the shared unknowns; `formal` is
    the precision by the normal matrix.
    """
    given, block, added = problem.given, problem.block, np.zeros(6 + len(problem.names))
    (matrix, right), free = reduced_at(problem, found), slice(problem.fixed, None)
    solve_for, tiles = solver(matrix), min(MOST_TILES, len(block.xyz) // POINTS_PER_TILE)
    if tiles < LEAST_GROUPS or solve_for is None:
        return 1.0 + added
    # random groups of points, neighbouring points, points of an image, and places in the frame
    randomly = np.random.default_rng(0).integers(0, tiles, len(block.xyz))[block.owner]
    near = _tiles(found.state.xyz[:, :2], tiles)[block.owner]
    size = np.array([(lens.width, lens.height) for lens in block.cameras.lenses or ()])
    place = _tiles(given.image_xy / size[given.camera], FRAME_TILES)
    place += given.group[given.camera] * (place.max() + 1)  # each sensor has its own
    frame = np.unique(place, return_inverse=True)[1]
    # the first group has drawn residuals: the variances that random groups have by chance
    random = np.random.default_rng(1).normal(0.0, formal.sigma0, given.image_xy.shape)
    groups = [randomly, randomly, near, given.camera]
    *pulls, field, rest = _pulls_of(problem, found, groups, frame, random)
    by_chance, *shares = (_share_of(formal, solve_for(p[:, free].T)) for p in pulls)
    for group, share in zip(groups[1:], shares, strict=True):
        count = len(np.unique(group))
        is_more = share > fdtri(count - 1, tiles - 1, SURE) * by_chance
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
    common = COMMON_SHARE * noise_px / problem.lens_effects[rows]
    factor[6 + rows] = np.hypot(1.0, common / formal.shared_sigma[rows])
    return factor


def _tiles(xy: FloatArray, count: int) -> IntArray:
    """Return the tile of each place, of about `count` square ones that cover nearly all places."""
    low, high = np.nanpercentile(xy, [1.0, 99.0], axis=0)
    side = max(float(np.sqrt(np.prod(high - low) / count)), 1e-9)
    last = np.maximum(np.ceil((high - low) / side) - 1.0, 0.0)
    place = np.clip(np.floor((np.nan_to_num(xy) - low) / side), 0.0, last).astype(np.int64)
    return np.asarray(place[:, 0] * int(last[1] + 1.0) + place[:, 1])


def _share_of(formal: Precision, moved: FloatArray) -> FloatArray:
    """Return variances over the formal ones, (6 + g,), for poses their mean.

    `moved`, shape (u, n), are the movements of the free unknowns by each of n groups.
    """
    of_poses, of_shared = np.split((moved**2).sum(axis=1), [len(moved) - len(formal.shared)])
    share = np.append(np.zeros(6), of_shared / formal.shared_sigma**2)
    if len(of_poses):
        poses = np.einsum("kii->ki", formal.pose_covariance)
        share[:6] = (of_poses.reshape(-1, 6) / poses).mean(axis=0)
    return share


def _pulls_of(
    problem: Problem, found: Solution, groups: list[IntArray], frame: IntArray, drawn: FloatArray
) -> list[FloatArray]:
    """Return the right side of the reduced equations by groups, each of shape (groups, 6 k + g).

    The first is that with the weighted residuals `drawn`, shape (o, 2), instead of those found.
    Then, for shifts along u and v of the t tiles of the frame: B', shape (2 t, 6 k + g), and C
    with their right sides, shape (2 t, 2 t + 1).
    """
    size, count = 6 * len(found.lenses) + problem.given.shared, 2 * (int(frame.max()) + 1)
    pulls = [np.zeros((int(group.max()) + 1, size)) for group in groups]
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


RANGES = (0.2, 0.4, 0.8)  # ranges of smoothness, in half diagonals, from ripples to whole frames
LARGEST_PX, STEPS = 2.0, np.linspace(0.0, 1.0, 200)  # range of s; larger errors are of another lens
NO_FIELD = 1e-9  # share of the largest eigenvalue below which a field leaves no residuals


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
    distance2 = np.sum([(axis - axis[:, None]) ** 2 for axis in middle], axis=0)
    is_same_sensor = sensor == sensor[:, None]
    # in the eigenvectors of K R K' the pulls are independent, so that the likelihood is a product
    likely, halves = np.zeros((len(RANGES), len(STEPS))), []
    square = (LARGEST_PX * STEPS**3) ** 2  # dense where s is small
    for i, length in enumerate(RANGES):
        common = np.where(is_same_sensor, np.exp(-0.5 * distance2 / length**2), 0.0)
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


# The ensemble


MEMBERS, AXES = 32, 16  # leaves an eighth of a standard deviation to chance, nothing along the axes
TINY = 1e-10  # added to the diagonal of correlations, which rounding may leave indefinite
SAME_FOCAL = 1e-6  # relative difference of the focal lengths of one block


@dataclass(frozen=True, eq=False)
class Members:
    """Corrections of m members of an ensemble to the k cameras of a block and to its water.

    Those of the water are added to its height below the mean of the centres, its slopes along x and
    y, the refractive index, and d, e, f of d x^2 + e x y + f y^2 about there; zero if fixed.
    """

    labels: tuple[str, ...]  # length k
    focal: FloatArray  # (k,), of the adjusted block, to recognise it
    turn: FloatArray  # (m, k, 3), rotation vectors in the frame of each camera, radians
    shift_m: FloatArray  # (m, k, 3), of the centres, along the same axes
    lens_names: tuple[str, ...]  # length p
    lens: FloatArray  # (m, k, p), added to these parameters
    water: FloatArray  # (m, 7)

    def __len__(self) -> int:
        return len(self.turn)

    def aligned(self, cameras: Cameras) -> "Members | None":
        """Return the members in the order of their cameras, in any CRS; None for other cameras."""
        row = {label: i for i, label in enumerate(self.labels)}
        if sorted(cameras.labels) != sorted(row) or cameras.lenses is None:
            return None
        rows = np.array([row[label] for label in cameras.labels])
        focal = np.array([lens.focal for lens in cameras.lenses])
        if np.abs(focal / self.focal[rows] - 1.0).max() >= SAME_FOCAL:
            return None
        return Members(
            cameras.labels, self.focal[rows], self.turn[:, rows], self.shift_m[:, rows],
            self.lens_names, self.lens[:, rows], self.water,
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
    values, axes = np.zeros(0), np.zeros((len(sigma), 0))
    if few > 0:
        values, axes = eigsh(correlation, few, v0=np.ones(len(sigma)))
    factor = cholesky(correlation, lower=True, overwrite_a=True)
    draws = rng.standard_normal((count, len(sigma))) @ factor.T
    even = np.linalg.qr(draws @ axes)[0] * np.sqrt(count * values)
    return np.asarray((draws + (even - draws @ axes) @ axes.T) * sigma)


def members_of(problem: Problem, found: Solution, steps: FloatArray) -> Members:
    """Return the members that differ from a solution by steps, shape (m, u), of free unknowns.

    Steps that take a lens or an index out of its range are skipped.
    """
    state, given, names, k = found.state, problem.given, problem.unknowns.lens, len(found.lenses)
    steps = np.hstack([np.zeros((len(steps), problem.fixed)), steps])
    still = np.zeros_like(state.xyz)
    steps = steps[[moved_by(problem, found, one, still) is not None for one in steps]]
    poses, shared = steps[:, : 6 * k].reshape(-1, k, 6), steps[:, 6 * k :]
    lens = np.zeros((len(steps), k, len(names)))
    for column, (image, code) in enumerate(problem.lens_unknowns):
        of_sensor = given.group == given.group[image]
        lens[:, of_sensor, names.index(NAMES[code])] = shared[:, column, None]
    by, free = np.zeros((len(state.water), len(steps))), given.column >= 0
    by[free] = shared.T[given.column[free]]
    # level and slopes below the mean of the cameras, not at the origin of the block
    x, y, _ = state.centres.mean(axis=0)
    d, e, f = by[SHAPE:PORT]
    slopes = by[1] + 2.0 * d * x + e * y, by[2] + e * x + 2.0 * f * y
    return Members(
        problem.block.cameras.labels,
        np.array([one.focal for one in found.lenses]),
        poses[:, :, :3],
        np.einsum("kij,mkj->mki", state.rotations, poses[:, :, 3:]),
        names,
        lens,
        np.column_stack([polynomial(by, x, y), *slopes, by[INDEX], d, e, f]),
    )

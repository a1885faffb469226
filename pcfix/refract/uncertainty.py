r"""Compute the covariance of corrected points.

Errors that differ from ray to ray (of image coordinates, poses, waves) move the apparent point P
first: SfM software intersects straight rays by least squares in the images, so that

    Cov P = K^-1 R K^-1,   K = sum J'J,   R = sum J' Cov(image) J.

The correction moves P to Q; its derivative dQ/dP depends on the method, see
`pcfix.refract.sensitivity`. Errors common to all rays (level, index and tilt of the water) enter
only there, each with a column g of its own:

    Cov Q = dQ/dP Cov P dQ/dP' + sum over the common ones of sigma^2 g g'.

`consistent` inverts that adjustment: dQ/dP = (sum S T)^-1 K, and K cancels out, so that noise acts
as if the refracted rays had been adjusted in the images. The other methods have the derivative of
`snell`, which weights rays by their distance (m) from the point; the two differ more, the more the
lengths of the rays differ.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Nine, Symmetric, Vector, plus, scaled
from pcfix.model import FloatArray, IntArray, Outcome, SingleArray
from pcfix.options.correct import LEVEL_M
from pcfix.refract import sensitivity as s
from pcfix.refract import tiling
from pcfix.refract.batch import Batch, Intersection, Survey
from pcfix.refract.choice import Rig, Rule, rig_of, rule_of
from pcfix.refract.sensitivity import Budget
from pcfix.refract.tiling import TILE, Points, nine, points_of, three
from pcfix.water.surface import Field, height_at

Four: TypeAlias = tuple[float, float, float, float]

MIN_DETERMINANT = 1e-6
"""As of `pcfix.refract.rays.nearest_point`, of half the trace cubed: k^3 for k rays in space."""


def covariances(batch: Batch, shift_m: FloatArray) -> FloatArray:
    """Return the covariance of each corrected point, shape (m, 6), to first order.

    xx, xy, xz, yy, yz, zz in metres squared, world frame; zeros if fewer than two rays meet, or
    nearly parallel ones. `shift_m`, shape (m, 3), is true minus apparent, by any method. The
    standard deviations are those of the settings; that of the level is `level_sigma_m`, or else
    `LEVEL_M`, if the settings have none.

    A mesh or raster is taken as its plane above the point. All rays of a point are assumed to have
    made it, by an adjustment in image residuals, with noise of the size of a pixel in the middle of
    the image. A tilt turns the water about the middle of the projection centres.

    It is an approximation for methods that move points along the vertical only (they get that of
    `snell`), and where `consistent` inverts a dense matcher, which gets that of one adjustment of
    all its images.
    """
    survey, result = batch.survey, np.zeros((len(batch), 6))
    if not len(survey.cameras):
        return result
    # the rays are chosen: on a mesh some may be beyond the limit for the plane above the point
    every_ray = rule_of(survey)._replace(least_cosine2=0.0)
    in_tiles(
        _of_lists, tiling.tiles_of(batch), points_of(batch), np.ascontiguousarray(shift_m),
        rig_of(survey), batch.listed,
        every_ray, budget_of(survey), level_sigma_of(batch), result,
    )  # fmt: skip
    return result


def with_uncertainty(found: Intersection, batch: Batch) -> Intersection:
    """Return a result with its covariances and standard errors of Z, if asked for."""
    survey = batch.survey
    if survey.settings.dimensions != "all":
        return with_errors(found, None)
    covariance, line = covariances(batch, found.shift_m), survey.learned.regression
    if survey.settings.method == "regression" and line is not None:
        covariance[:, [_XZ, _YZ]] = 0.0
        covariance[:, _ZZ] = line.sigma_m(batch.surface.height_m - batch.xyz[:, 2]) ** 2
    return with_errors(found, covariance)


def with_errors(found: Intersection, covariance: FloatArray | None) -> Intersection:
    """Return a result with covariances (modified in place) and standard errors of Z."""
    if covariance is None:
        return found._replace(sigma_z_m=np.zeros(len(found.outcome)))
    moved = found.outcome == Outcome.CORRECTED
    if not moved.all():
        covariance[~moved] = 0.0
    return found._replace(sigma_z_m=np.sqrt(covariance[:, _ZZ]), covariance_m2=covariance)


def with_model_uncertainty(found: Intersection, batch: Batch) -> Intersection:
    """Add the uncertainties of the model and the poses to the covariances, if there are any."""
    model, poses = batch.survey.learned.model_uncertainty, batch.survey.learned.poses
    if (model is None and poses is None) or found.covariance_m2 is None:
        return found
    moved = found.outcome == Outcome.CORRECTED
    covariance = found.covariance_m2
    if model is not None:
        depth = batch.surface.height_m - (batch.xyz[:, 2] + found.shift_m[:, 2])
        more = model.scatter_m**2 + (model.per_depth * depth) ** 2
        covariance[:, _ZZ] += np.where(moved, more, 0.0)
    if poses is not None:
        covariance[moved, _ZZ] += poses.at(batch.xyz[moved, :2]) ** 2
    return with_errors(found, covariance)


_XZ, _YZ, _ZZ = 2, 4, 5


def level_sigma_of(batch: Batch) -> FloatArray:
    """Return the standard deviation of the water above each point, metres, shape (m,).

    The error of the level is common to all rays. Errors of the water of single images differ from
    ray to ray, and are added as the error of the mean over the rays.
    """
    stated, fitted = batch.survey.settings.sigma_level, batch.level_sigma_m
    known = stated if stated is not None else LEVEL_M if fitted is None else fitted
    full = np.array(np.broadcast_to(known, len(batch)), np.float64)
    full[np.isnan(full)] = LEVEL_M
    own, views = batch.survey.own_water, batch.views
    if own is None or views is None:
        return full
    of_own, points = np.zeros(len(batch)), points_of(batch)
    in_tiles(
        _own_sigma, len(batch), points, rig_of(batch.survey), own.sigma,
        batch.listed, of_own,
    )  # fmt: skip
    return np.hypot(full, of_own)


@kernel
def _own_sigma(
    span: Span, points: Points, rig: Rig, sigma: Field, views: tuple[IntArray, IntArray],
    found: FloatArray,
) -> None:  # fmt: skip
    """Set the standard error of the mean of the images' own water over the rays of a point.

    Errors are independent from image to image. The water is taken as level above the point.
    """
    start, camera = views
    for i in range(*span):
        total = 0.0
        for at in range(start[i], start[i + 1]):
            c, x, y = camera[at], points.xyz[i, 0], points.xyz[i, 1]
            up = rig.centres[c, 2] - points.xyz[i, 2]
            # where the straight ray pierces it
            f = (points.height[i] + rig.offset[c] - points.xyz[i, 2]) / up
            x, y = x + f * (rig.centres[c, 0] - x), y + f * (rig.centres[c, 1] - y)
            error = height_at(Field(sigma.heights, sigma.shape, sigma.frame, c), x, y)[0]
            total += error * error if error > 0.0 else 0.0
        found[i] = np.sqrt(total) / max(start[i + 1] - start[i], 1)


def budget_of(survey: Survey) -> Budget:
    """Return the error budget for kernels."""
    settings = survey.settings
    x, y = survey.cameras.centres[:, :2].mean(axis=0).tolist()
    return Budget(
        image_px=settings.sigma_image,
        refractive_index=settings.sigma_index,
        tilt=math.radians(settings.sigma_tilt),
        waves=math.radians(settings.sigma_waves),
        centre_m=settings.sigma_centre,
        attitude=math.radians(settings.sigma_attitude),
        pivot_x=x,
        pivot_y=y,
        in_images=survey.settings.method == "consistent",
    )


@kernel(allocates=True)
def _of_lists(
    span: Span, points: Points, shift: FloatArray, rig: Rig, views: tuple[IntArray, IntArray],
    rule: Rule, budget: Budget, level_sigma: FloatArray, result: FloatArray,
) -> None:  # fmt: skip
    """Compute the covariances of points with view lists, a tile at a time."""
    start, camera = views
    for t in range(*span):
        rows = points.order[t * TILE : (t + 1) * TILE]
        tile = np.empty(7 * TILE)
        # the runs of the tile, then those of its rays, then one camera after the other
        tiling.gather(tile, rows, points)
        room = s.room_of(tile, shift, rows)
        named, marks = tiling.marks_of_lists(start, camera, rows, len(rig.centres))
        for at in range(named.size):
            add_errors(room, tile, marks[at], rig, named[at], rule, budget)
        finish_tile(result, rows, room, tile, level_sigma, budget)


@device
def differ_by_ray(budget: Budget) -> bool:
    """Whether rays have errors other than the noise of image coordinates."""
    return max(budget.waves, max(budget.centre_m, budget.attitude)) > 0.0


@device
def add_errors(
    room: SingleArray, tile: FloatArray, marks: FloatArray, rig: Rig, c: int, rule: Rule,
    budget: Budget,
) -> None:  # fmt: skip
    """Add the rays of one camera to the points of a tile that have a mark."""
    count, sight = marks.size, s.lens_of(rig, c, rule)
    s.add_rays(room, tile, marks, rig, c, rule)
    # the derivative of consistent, or that of snell
    if budget.in_images:
        s.add_in_images(room, count, sight)
    else:
        s.add_in_space(room, count, sight)
    if budget.tilt > 0.0:
        s.add_tilt(room, count, sight, budget.in_images)
    if differ_by_ray(budget):
        s.add_noise(room, count, sight, budget)


@device(allocates=True)
def finish_tile(
    result: FloatArray, rows: IntArray, room: SingleArray, tile: FloatArray,
    level_sigma: FloatArray, budget: Budget,
) -> None:  # fmt: skip
    """Turn the sums of a tile into covariances.

    LLVM inlines what it calls; otherwise the loops over the points would not be vectorised.
    """
    out, sigma, sums = np.empty(6 * TILE), level_sigma[rows], room.astype(np.float64)
    # R = sigma^2 K if all rays have the same image noise
    if not differ_by_ray(budget):
        for at in range(6 * TILE):
            sums[s.NOISE * TILE + at] = budget.image_px**2 * sums[s.SIGHT * TILE + at]
    if budget.in_images:
        for j in range(rows.size):
            solved, by_delta = _solved_in_images(sums, j)
            _write(out, j, solved, by_delta, by_delta, sums, tile, sigma[j], budget)
    else:
        for j in range(rows.size):
            solved, by_delta, by_noise = _solved_in_space(sums, j)
            _write(out, j, solved, by_delta, by_noise, sums, tile, sigma[j], budget)
    for j in range(rows.size):
        for at in range(6):
            result[rows[j], at] = out[at * TILE + j]


@device
def _solved_in_images(sums: FloatArray, j: int) -> tuple[bool, Nine]:
    """Return whether the rays determine a point, and the inverse of sum S T.

    Q moves by that times the right side of the normal equations of P, and times sum S delta.
    """
    m = nine(sums, s.BY_Q * TILE + j)
    det, inverse = inverse_of(m)
    # in units of the trace, as M has the trace 2 k
    half = 0.5 * (m[0] + m[4] + m[8])
    return (sums[j] >= 2.0) & (det >= MIN_DETERMINANT * half * half * half), inverse


@device
def _solved_in_space(sums: FloatArray, j: int) -> tuple[bool, Nine, Nine]:
    """Return whether the rays determine a point, and two matrices.

    Q moves by the first, (sum M)^-1, times sum M delta, and by the second, (sum M)^-1 (sum M D)
    (sum W)^-1, times the right side of the normal equations of P.
    """
    k = sums[j]
    det, by_delta = inverse_of(_full(_six(sums, s.BY_Q * TILE + j)))
    full, by_sight = inverse_of(_full(_six(sums, s.SIGHT * TILE + j)))
    # (sum M)^-1 (sum M D) moves Q with P, (sum W)^-1 moves P with the images
    by_p = _product(by_delta, nine(sums, s.BY_P * TILE + j))
    solved = (k >= 2.0) & (det >= MIN_DETERMINANT * k * k * k) & (full > 0.0)
    return solved, by_delta, _product(by_p, by_sight)


@device
def _write(
    out: FloatArray, j: int, solved: bool, by_delta: Nine, by_noise: Nine, sums: FloatArray,
    tile: FloatArray, level_sigma: float, budget: Budget,
) -> None:  # fmt: skip
    """Write the covariance of a point: of noise, and of each common error."""
    b = by_noise
    # B R B'
    noise = _product(_product(b, _full(_six(sums, s.NOISE * TILE + j))), (
        b[0], b[3], b[6], b[1], b[4], b[7], b[2], b[5], b[8]
    ))  # fmt: skip
    # each common error is one standard deviation times a column
    level, index, u, v = _columns(by_delta, sums, tile, j, level_sigma, budget)
    x = level[0], index[0], u[0], v[0]
    y = level[1], index[1], u[1], v[1]
    z = level[2], index[2], u[2], v[2]
    out[j] = noise[0] + _dot(x, x) if solved else 0.0
    out[TILE + j] = noise[1] + _dot(x, y) if solved else 0.0
    out[2 * TILE + j] = noise[2] + _dot(x, z) if solved else 0.0
    out[3 * TILE + j] = noise[4] + _dot(y, y) if solved else 0.0
    out[4 * TILE + j] = noise[5] + _dot(y, z) if solved else 0.0
    out[5 * TILE + j] = noise[8] + _dot(z, z) if solved else 0.0


@device
def _dot(x: Four, y: Four) -> float:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3]


@device
def _columns(
    by_delta: Nine, sums: FloatArray, tile: FloatArray, j: int, level_sigma: float, budget: Budget
) -> tuple[Vector, Vector, Vector, Vector]:
    """Return how a point moves by one standard deviation of level, index and both tilts.

    A tilt also raises the water above the point, in proportion to its distance from the pivot.
    """
    nx, ny, nz = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
    # two horizontal directions of slope: u towards x, v across it
    scale = 1.0 / np.sqrt(nx * nx + nz * nz)
    ux, uz = nz * scale, -nx * scale
    by_tilt = nine(sums, s.BY_TILT * TILE + j)
    by_level, by_n = three(sums, s.BY_LEVEL * TILE + j), three(sums, s.BY_N * TILE + j)
    # the level rises along the vertical, h is along N
    level = scaled(nz, by_level)
    away_u, away_v = tile[j] - budget.pivot_x, tile[TILE + j] - budget.pivot_y
    # the normal leans away from where the slope rises
    u = plus(product_of(by_tilt, (-ux, 0.0, -uz)), scaled(away_u, level))
    v = plus(product_of(by_tilt, (-ny * uz, nx * uz - nz * ux, ny * ux)), scaled(away_v, level))
    return (
        scaled(level_sigma, product_of(by_delta, level)),
        scaled(budget.refractive_index, product_of(by_delta, by_n)),
        scaled(budget.tilt, product_of(by_delta, u)),
        scaled(budget.tilt, product_of(by_delta, v)),
    )


@device
def _six(sums: FloatArray, at: int) -> Symmetric:
    return (
        sums[at], sums[at + TILE], sums[at + 2 * TILE],
        sums[at + 3 * TILE], sums[at + 4 * TILE], sums[at + 5 * TILE],
    )  # fmt: skip


@device
def _full(m: Symmetric) -> Nine:
    return m[0], m[1], m[2], m[1], m[3], m[4], m[2], m[4], m[5]


@device
def product_of(m: Nine, x: Vector) -> Vector:
    """Return a matrix times a vector."""
    return (
        m[0] * x[0] + m[1] * x[1] + m[2] * x[2],
        m[3] * x[0] + m[4] * x[1] + m[5] * x[2],
        m[6] * x[0] + m[7] * x[1] + m[8] * x[2],
    )


@device
def _product(a: Nine, b: Nine) -> Nine:
    """Return a matrix times a matrix."""
    x = product_of(a, (b[0], b[3], b[6]))
    y = product_of(a, (b[1], b[4], b[7]))
    z = product_of(a, (b[2], b[5], b[8]))
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


@device
def inverse_of(m: Nine) -> tuple[float, Nine]:
    """Return the determinant of a matrix and its inverse, meaningless if that is 0."""
    a, b, c, d, e, f, g, h, i = m
    # cofactors of the first row
    x, y, z = e * i - f * h, f * g - d * i, d * h - e * g
    det = a * x + b * y + c * z
    inv = 1.0 / det
    return det, (
        inv * x, inv * (c * h - b * i), inv * (b * f - c * e),
        inv * y, inv * (a * i - c * g), inv * (c * d - a * f),
        inv * z, inv * (b * g - a * h), inv * (a * e - b * d),
    )  # fmt: skip

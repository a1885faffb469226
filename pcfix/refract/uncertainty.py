r"""Compute the covariance of corrected points, to first order.

Errors that differ from ray to ray (of image coordinates, poses, waves) move the apparent point P
first: SfM software intersects straight rays by least squares in the images, so that

    Cov P = K^-1 R K^-1,   K = sum J'J,   R = sum J' Cov(image) J.

The correction moves P to Q. Errors common to all rays (level and index of the water) enter
only there, each with a column g of its own:

    Cov Q = dQ/dP Cov P dQ/dP' + sum over the common ones of sigma^2 g g'.

**One ray** in the frame of the surface above P: N is up, the other two axes lie in the surface.
From P to the projection centre is e, of length L, with the height H above P and d = e - H N, of
length rho, across. The surface is h above P; the true point Q lies y below it. With r = 1 / n and
kappa = sqrt(L^2 - r^2 rho^2) the refracted ray is t = -(r d + kappa N) / L, and at depth y it is
m d away from P, with m = h / H - y r / kappa. All errors move this place, at a fixed y, by some
delta across:

=====================  ========================================================================
by                     delta
=====================  ========================================================================
P across, p            D p = (1 - m) p + beta (d.p) d,  beta = -y r (1 - r^2) / kappa^3
P up                   -D d / H
h                      (1 / H - r / kappa) d
n                      y r^2 L^2 / kappa^3 d
=====================  ========================================================================

Q has the least squared residuals in the images at P: sum J' (x(Q) - pi(P)) = 0. A Q that is off
its ray, by T Q = Q - (N.Q) (N + (r / kappa) d) at its own depth, is seen where P would be after a
move of D^-1 T Q. With W = J'J and S = W D^-1, D^-1 across as in the table,

    dQ = (sum S T)^-1 sum S delta,    S d = -H W N / (1 - m + beta rho^2)

as W e = 0. Q depends on P only through pi(P): dQ / dP = (sum S T)^-1 sum W, and K cancels out.

With g = S d it is S delta = c W delta + b (d.delta) g and S N = -v g, where

    c = 1 / (1 - m),    b = -beta / (1 - m),    v = (1 - b rho^2) / H,
    S T = c W + g (b d + (v - r / kappa) N)'

That is `consistent`. `snell` has the least distances from the rays instead (eq 11 of Skarlatos &
Agrafiotis 2018); up to 45 degrees its standard errors are the same to 2 %.

Neglected is the turn of M, and of J, times the residual, which is of second order.
"""

import math
from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import (
    NO_SQUARES,
    Symmetric,
    Vector,
    beyond,
    dot,
    minus,
    plus_square,
    product,
    row_of,
    scaled,
)
from pcfix.model import FloatArray, IntArray, Outcome
from pcfix.options.correct import LEVEL_M
from pcfix.refract import tiling
from pcfix.refract.batch import Batch, Chosen, Intersection, Survey
from pcfix.refract.rays import MIN_DETERMINANT
from pcfix.refract.tiling import TILE, add_three, inverse_of, nine, product_of, put, slots, three

# Standard error of the model of depth maps, common to a block: the bias of blocks with known truth
# was -0.6 to +1.4 ground pixels, largest with much image noise.
MODEL_GSD = 0.8

MODEL_SINGLE_GSD = 0.4  # of single depth maps: four semi-global matches had a bias of -0.2 to +0.1

_XZ, _YZ, _ZZ = 2, 4, 5


class Budget(NamedTuple):
    """Standard deviations, angles in radians.

    `by_ray` says whether rays have errors other than the noise of image coordinates.
    """

    image_px: float
    refractive_index: float
    waves: float
    centre_m: float
    attitude: float
    by_ray: bool


def covariances(batch: Batch, shift_m: FloatArray) -> FloatArray:
    """Return the covariance of each corrected point: xx, xy, xz, yy, yz, zz, shape (m, 6), m^2.

    Zeros if fewer than two rays meet, or nearly parallel ones. `shift_m`, shape (m, 3), is true
    minus apparent, by any method. A mesh or raster is taken as its plane above the point.

    It is that of `consistent` with tracks: an approximation for the other methods, and where
    `consistent` inverts a dense matcher, which gets that of one adjustment of all its images.
    """
    survey, result = batch.survey, np.zeros((len(batch), 6))
    if not len(survey.cameras):
        return result
    in_tiles(
        _of_lists, tiling.tiles_of(batch), tiling.spatial_order(batch.xyz), batch.chosen(),
        np.ascontiguousarray(shift_m), budget_of(survey), level_sigma_of(batch), result,
    )  # fmt: skip
    return result


def with_uncertainty(found: Intersection, batch: Batch) -> Intersection:
    """Return a result with its covariances and standard errors of Z, if the settings ask for them.

    The variance of Z is that of the budget or of a regression, and where they were estimated those
    of the model of depth maps, of mismatches and the reconstruction type, and of adjusted poses:

        Var Z = [Cov Q]_zz + ambiguity^2 + (k GSD)^2 + scatter^2 + (per_depth depth)^2 + poses^2
    """
    survey, covariance, ambiguity = batch.survey, found.covariance_m2, found.ambiguity_m
    found = found._replace(ambiguity_m=None)
    if survey.settings.dimensions != "all":
        return found
    learned, surface, moved = survey.learned, batch.surface, found.outcome == Outcome.CORRECTED
    if covariance is None:
        covariance, line = covariances(batch, found.shift_m), learned.regression
        if survey.settings.method == "regression" and line is not None:
            covariance[:, [_XZ, _YZ]] = 0.0
            covariance[:, _ZZ] = line.sigma_m(surface.height_m - batch.xyz[:, 2]) ** 2
    covariance[~moved] = 0.0
    variance, level = covariance[moved, _ZZ], surface.height_m[moved]
    if ambiguity is not None:  # of depth maps
        focal_px = float(np.median([lens.focal_px for lens in survey.cameras.lenses or ()]))
        gsd_m = (np.median(survey.cameras.centres[:, 2]) - level) / focal_px
        is_fused = survey.settings.matcher == "depth-maps"
        variance += ambiguity[moved] ** 2
        variance += ((MODEL_GSD if is_fused else MODEL_SINGLE_GSD) * gsd_m) ** 2
    if learned.model_uncertainty is not None:
        model, z = learned.model_uncertainty, (batch.xyz[:, 2] + found.shift_m[:, 2])[moved]
        variance += model.scatter_m**2 + (model.per_depth * (level - z)) ** 2
    if learned.poses is not None:
        variance += learned.poses.at(batch.xyz[moved, :2]) ** 2
    covariance[moved, _ZZ] = variance
    return found._replace(sigma_z_m=np.sqrt(covariance[:, _ZZ]), covariance_m2=covariance)


def level_sigma_of(batch: Batch) -> FloatArray:
    """Return the standard deviation of the water above each point, metres, shape (m,).

    That of the settings, else of the fit, else `LEVEL_M`.
    """
    stated, fitted = batch.survey.settings.sigma_level, batch.level_sigma_m
    known = stated if stated is not None else LEVEL_M if fitted is None else fitted
    full = np.array(np.broadcast_to(known, len(batch)), np.float64)
    full[np.isnan(full)] = LEVEL_M
    return full


def budget_of(survey: Survey) -> Budget:
    """Return the error budget for kernels."""
    settings = survey.settings
    return Budget(
        image_px=settings.sigma_image,
        refractive_index=settings.sigma_index,
        waves=math.radians(settings.sigma_waves),
        centre_m=settings.sigma_centre,
        attitude=math.radians(settings.sigma_attitude),
        by_ray=max(settings.sigma_waves, settings.sigma_centre, settings.sigma_attitude) > 0.0,
    )


# Runs of `TILE` numbers for the points of a tile: how far above the true point P is, along N; the
# number of rays; what level (3) and n (3) add to S delta; W (6); S T (9); noise (6).
_ABOVE, RAYS, BY_LEVEL, BY_N, IMAGES, BY_Q, NOISE, ROOM = slots(1, 1, 3, 3, 6, 9, 6)


@device(allocates=True)
def room_of(tile: FloatArray, shift: FloatArray, rows: IntArray) -> FloatArray:
    """Return room for the sums of a tile, which start at zero."""
    room = np.zeros(ROOM * TILE)
    for j in range(rows.size):
        room[_ABOVE * TILE + j] = -dot(three(tile, 4 * TILE + j), row_of(shift, rows[j]))
    return room


@device(forceinline=True)
def _weight(times: float, e: Vector, length2: float, axis: Vector, focal_px: float) -> Symmetric:
    """Return W = J'J of a camera at P, times how often the ray e counts.

    With the optical axis z and Z = -z.e it is (f / Z)^2 (I + x z' + z x'), x = e / Z +
    L^2 / (2 Z^2) z; without an axis (zeros), of angles, (f / L)^2 (I - e e' / L^2).
    """
    # cameras without an axis, such as fisheyes, have equal angles per pixel
    flat = axis[0] != 0.0 or axis[1] != 0.0 or axis[2] != 0.0
    # depth along the axis, or the squared distance
    deep = -dot(axis, e) if flat else length2
    inv = 1.0 / deep if times > 0.0 else 0.0
    # (f / Z)^2 or (f / L)^2; 0 for rays that do not count
    w = times * focal_px * focal_px * (inv * inv if flat else inv)
    a = inv if flat else -0.5 * inv
    b = 0.5 * length2 * inv * inv if flat else 0.0
    zx, zy, zz = axis[0] if flat else e[0], axis[1] if flat else e[1], axis[2] if flat else e[2]
    x, y, z = scaled(w, beyond(scaled(a, e), b, (zx, zy, zz)))
    return (
        w + 2.0 * x * zx, x * zy + zx * y, x * zz + zx * z,
        w + 2.0 * y * zy, y * zz + zy * z, w + 2.0 * z * zz,
    )  # fmt: skip


@device(forceinline=True)
def _add_six(sums: FloatArray, at: int, c: float, m: Symmetric) -> None:
    """Add c m."""
    add_three(sums, at, c, (m[0], m[1], m[2]))
    add_three(sums, at + 3 * TILE, c, (m[3], m[4], m[5]))


@device
def _add_rays(
    room: FloatArray, tile: FloatArray, marks: FloatArray, points: Chosen, k: int,
    budget: Budget | None,
) -> None:  # fmt: skip
    """Add one camera's rays to the sums of a tile's points, with a budget the noise of each ray.

    An error that moves the straight ray at P by z, of covariance C, moves its image by J z and
    adds W C W. A turned camera has C = attitude^2 L^2 times what is across the ray, a moved one
    centre_m^2. A wave of slope tau at the piercing point moves the refracted ray at depth y by
    -y (1 - r H / kappa) (tau + r^2 / kappa^2 d (d.tau)), which adds S delta delta' S in images.
    """
    rig, ratio = points.rig, 1.0 / points.n
    centre, axis, focal_px = row_of(rig.centres, k), row_of(rig.axes, k), rig.focal_px[k]
    offset = rig.offset[k]
    for j in range(marks.size):
        p, normal, times = three(tile, j), three(tile, 4 * TILE + j), marks[j]
        # e, H, L^2, rho^2 and h of the ray; one that does not count goes straight up
        e = minus(centre, p) if times > 0.0 else normal
        height, length2 = dot(normal, e), dot(e, e)
        rho2 = length2 - height * height
        h = normal[2] * (tile[3 * TILE + j] - (p[2] - offset))
        # light of a point above the water goes straight
        r, y = ratio if h > 0.0 else 1.0, h + room[_ABOVE * TILE + j]
        kappa = np.sqrt(length2 - r * r * rho2)
        # one division for two: 1 / kappa and 1 / H; then r / kappa, d, 1 - m and beta
        share = 1.0 / (height * kappa)
        inv_k, inv_h = share * height, share * kappa
        lean, d = r * inv_k, beyond(e, -height, normal)
        away, beta = 1.0 - h * inv_h + y * lean, y * lean * inv_k * inv_k * (r * r - 1.0)
        w = _weight(times, e, length2, axis, focal_px)
        # again for two: c, and g = S d = W d / (1 - m + beta rho^2), where W d = -H W N
        outer = away + beta * rho2
        share = 1.0 / (away * outer)
        c, b = share * outer, -beta * share * outer
        g, v = scaled(-height * share * away, product(w, normal)), (1.0 - b * rho2) * inv_h
        # S T = c W + g t', row by row
        t, at = beyond(scaled(b, d), v - lean, normal), BY_Q * TILE + j
        add_three(room, at, 1.0, beyond(scaled(c, (w[0], w[1], w[2])), g[0], t))
        add_three(room, at + 3 * TILE, 1.0, beyond(scaled(c, (w[1], w[3], w[4])), g[1], t))
        add_three(room, at + 6 * TILE, 1.0, beyond(scaled(c, (w[2], w[4], w[5])), g[2], t))
        # delta by h and by n, over d: 1 / H - r / kappa, and y r^2 L^2 / kappa^3
        inv_k2 = 1.0 / (kappa * kappa)
        by_n = y * lean * r * length2 * inv_k2 if r < 1.0 else 0.0
        room[RAYS * TILE + j] += times
        add_three(room, BY_LEVEL * TILE + j, inv_h - lean, g)
        add_three(room, BY_N * TILE + j, by_n, g)
        _add_six(room, IMAGES * TILE + j, 1.0, w)
        if budget is not None:
            # S delta = across (c W tau + along (d.tau) g), with tau across N, where c W N = -v g
            across = budget.waves * y * (1.0 - height * lean)
            along = b + lean * lean
            by_wave = along * (2.0 * v * height + along * rho2) - v * v
            # variance of the place of P from attitude, centre and waves, in all directions
            by_place = budget.attitude**2 * length2 + budget.centre_m**2 + (across * c) ** 2
            # W W, as W is symmetric: the sum of the squares of its rows
            square = plus_square(NO_SQUARES, (w[0], w[1], w[2]))
            square = plus_square(plus_square(square, (w[1], w[3], w[4])), (w[2], w[4], w[5]))
            at = NOISE * TILE + j
            _add_six(room, at, budget.image_px**2, w)
            _add_six(room, at, by_place, square)
            _add_six(room, at, across * across * by_wave, plus_square(NO_SQUARES, g))


@kernel(allocates=True)
def _of_lists(
    span: Span, order: IntArray, points: Chosen, shift: FloatArray, budget: Budget,
    level_sigma: FloatArray, result: FloatArray,
) -> None:  # fmt: skip
    """Compute the covariances of points with view lists, a tile at a time."""
    cameras = len(points.rig.centres)
    for t in range(*span):
        rows = order[t * TILE : (t + 1) * TILE]
        tile = np.empty(7 * TILE)
        tiling.gather(tile, rows, points)
        room = room_of(tile, shift, rows)
        named, marks = tiling.marks_of_lists(points.start, points.camera, rows, cameras)
        add_errors(room, tile, marks, named, points, budget)
        finish_tile(result, rows, room, tile, level_sigma, budget)


@device
def add_errors(
    room: FloatArray, tile: FloatArray, marks: FloatArray, near: IntArray, points: Chosen,
    budget: Budget,
) -> None:  # fmt: skip
    """Add the rays of cameras to the points of a tile.

    `marks`, a row for each of the cameras `near`, say how often each ray counts.
    """
    for k in range(len(marks)):
        # numba compiles a version of `_add_rays` for each kind of argument
        if budget.by_ray:
            _add_rays(room, tile, marks[k], points, near[k], budget)
        else:
            _add_rays(room, tile, marks[k], points, near[k], None)


@device(allocates=True)
def finish_tile(
    result: FloatArray, rows: IntArray, room: FloatArray, tile: FloatArray,
    level_sigma: FloatArray, budget: Budget,
) -> None:  # fmt: skip
    """Turn the sums of a tile into covariances: B R B' of the noise, and that of common errors.

    Each common error, of level and index, is one standard deviation times a column. LLVM inlines
    what the loop calls; otherwise it would not be vectorised.
    """
    out, sigma, sums = np.empty(6 * TILE), level_sigma[rows], room
    # R = sigma^2 K if all rays have the same image noise
    if not budget.by_ray:
        sums[NOISE * TILE :] = budget.image_px**2 * sums[IMAGES * TILE : BY_Q * TILE]
    for j in range(rows.size):
        m, k = nine(sums, BY_Q * TILE + j), sums[RAYS * TILE + j]
        det, b = inverse_of(m)
        # half the trace: k for k rays in space, as in `nearest_point`
        half = 0.5 * (m[0] + m[4] + m[8])
        solved = (k >= 2.0) & (det >= MIN_DETERMINANT * half * half * half)
        # B R B': R times each row of B, times each row
        noise = three(sums, NOISE * TILE + j) + three(sums, (NOISE + 3) * TILE + j)
        x, y, z = b[0:3], b[3:6], b[6:9]
        by_x, by_y, by_z = product(noise, x), product(noise, y), product(noise, z)
        cov = (
            dot(x, by_x), dot(x, by_y), dot(x, by_z), dot(y, by_y), dot(y, by_z), dot(z, by_z),
        )  # fmt: skip
        # the level rises along the vertical, h is along N
        level = scaled(tile[6 * TILE + j], three(sums, BY_LEVEL * TILE + j))
        index = three(sums, BY_N * TILE + j)
        cov = plus_square(cov, scaled(sigma[j], product_of(b, level)))
        cov = plus_square(cov, scaled(budget.refractive_index, product_of(b, index)))
        put(out, j, cov[0:3])
        put(out, 3 * TILE + j, cov[3:6])
        sums[RAYS * TILE + j] = 1.0 if solved else 0.0
    for j in range(rows.size):
        for at in range(6):
            result[rows[j], at] = out[at * TILE + j] if sums[RAYS * TILE + j] > 0.0 else 0.0

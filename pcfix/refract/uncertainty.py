r"""The covariance of corrected points, from that of what they were made from.

Errors that differ from ray to ray (of image coordinates, poses, waves) move the apparent point P
first: the SfM software intersects straight rays by least squares in the images, so that

    Cov P = K^-1 R K^-1,   K = sum J'J,   R = sum J' Cov(image) J.

The correction then carries P to Q; its derivative dQ/dP is that of the method, see
`pcfix.refract.sensitivity`. Errors common to all rays (level, index and tilt of the water) come in
only there, each with a column of its own:

    Cov Q = dQ/dP Cov P dQ/dP' + sum over the common ones of sigma^2 g g'.

`consistent` undoes that adjustment, so that dQ/dP = (sum S T)^-1 K, and K cancels out: noise comes
through as if the refracted rays had been adjusted in the images. The other methods have the
derivative of `snell`, which weighs rays by their distance (m) from the point; the more the lengths
of the rays differ, the more the two do.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numba import njit, prange

from pcfix.lens.frames import (
    ALL,
    NOT_DISTORTED,
    NOTHING,
    SOME,
    frames_of,
    in_frame,
    judge,
    mark,
    may_hold,
    pyramid,
)
from pcfix.model import NOMINAL_FOCAL_PX, Outcome, WaterPlane
from pcfix.options import LEVEL_M
from pcfix.refract import sensitivity as s
from pcfix.refract.choice import TILE, chosen_views, gather, least_cosine2, spatial_order
from pcfix.threads import one_caller

if TYPE_CHECKING:
    from pcfix.lens.frames import Frames, Pyramid
    from pcfix.model import Cameras, FloatArray, IntArray, Views
    from pcfix.options import Settings
    from pcfix.refract.learned import Learned
    from pcfix.refract.result import Intersection
    from pcfix.water.surface import SurfaceAbove

Three: TypeAlias = tuple[float, float, float]
Four: TypeAlias = tuple[float, float, float, float]
Nine: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]
"""A matrix, row by row."""

MIN_DETERMINANT = 1e-6
"""As of `pcfix.refract.rays.nearest_point`, of half the trace cubed: k^3 for k rays in space."""


class _Budget(NamedTuple):
    """Standard deviations, angles in radians; the place about which the water tilts.

    `in_images` says which residuals the correction makes least, see `pcfix.refract.sensitivity`.
    """

    image_px: float
    refractive_index: float
    tilt: float
    waves: float
    centre_m: float
    attitude: float
    pivot_x: float
    pivot_y: float
    in_images: bool


def covariances(
    xyz: FloatArray,
    shift_m: FloatArray,
    surface: SurfaceAbove,
    cameras: Cameras,
    settings: Settings,
    views: Views | None = None,
    level_offset_m: FloatArray | None = None,
    level_sigma_m: FloatArray | float | None = None,
) -> FloatArray:
    """Return the covariance of each corrected point.

    Parameters
    ----------
    xyz : array, shape (m, 3)
        Apparent points below the surface, metres, world frame.
    shift_m : array, shape (m, 3)
        True minus apparent, by whichever method.
    surface : SurfaceAbove
        The plane of the water surface above each of them.
    cameras, settings, views, level_offset_m
        As of `pcfix.refract.intersect.intersect`; the standard deviations are
        ``settings.errors``.
    level_sigma_m : array, shape (m,), or float, optional
        Standard deviation of the height of the surface above each point, as its fit has it; not
        used where ``settings.errors.level_m`` is given. NaN and None stand for `LEVEL_M`.

    Returns
    -------
    array, shape (m, 6)
        xx, xy, xz, yy, yz, zz in metres squared, world frame; zeros where fewer than two rays
        meet, or nearly parallel ones.

    Notes
    -----
    First order. A mesh or raster is taken as its plane above the point. Every ray of a point is
    taken to have made it, by an adjustment in image residuals; noise is of the size of a pixel in
    the middle of the image, lens distortion aside. A tilt turns the water about the middle of the
    projection centres.

    It is an approximation for methods that move points along the vertical only (they get that of
    `snell`), and where `consistent` inverts a dense matcher (depth maps, stereo pairs, their
    models), which gets that of one adjustment of all its images.
    """
    if not len(xyz):
        return np.zeros((0, 6))
    if settings.max_cameras is not None:
        plane = WaterPlane(0.0)  # only what is not a plane is looked at
        views = chosen_views(xyz, surface, plane, cameras, settings, views, level_offset_m)
    result = np.zeros((len(xyz), 6))
    points = (
        spatial_order(xyz),
        np.ascontiguousarray(xyz),
        np.ascontiguousarray(shift_m),
        np.ascontiguousarray(surface.height_m),
        np.ascontiguousarray(surface.slope),
        _level_sigma(level_sigma_m, settings, len(xyz)),
        np.ascontiguousarray(cameras.centres),
        *_focal_lengths(cameras),
        np.zeros(len(cameras)) if level_offset_m is None else level_offset_m,
    )
    rest = (
        least_cosine2(settings, cameras),
        1.0 / settings.refractive_index,
        _budget(settings, cameras),
        result,
    )
    with one_caller():
        if views is None:
            _all_in_frame(*points, frames_of(cameras), *rest)
        else:
            _of_lists(*points, views.start, views.camera, *rest)
    return result


def with_uncertainty(
    found: Intersection,
    xyz: FloatArray,
    surface: SurfaceAbove,
    cameras: Cameras,
    settings: Settings,
    views: Views | None,
    level_offset_m: FloatArray | None,
    learned: Learned,
    level_sigma_m: FloatArray | float | None,
) -> Intersection:
    """Return a result with its covariances and standard errors of Z, where they are asked for.

    The standard error of a regression is that with which it predicts check depths left out of it
    (of its residuals, where none can be): it holds whatever the poses and the water were.
    """
    moved = found.outcome == Outcome.CORRECTED
    if settings.dimensions != "all":
        return found._replace(sigma_z_m=np.zeros(len(xyz)))
    covariance = covariances(
        xyz, found.shift_m, surface, cameras, settings, views, level_offset_m, level_sigma_m
    )
    covariance[~moved] = 0.0
    line = learned.regression
    if settings.method == "regression" and line is not None:
        sigma = line.rmse_m if line.cv_rmse_m is None else line.cv_rmse_m
        covariance[:, [_XZ, _YZ]] = 0.0
        covariance[moved, _ZZ] = sigma**2
    return found._replace(sigma_z_m=np.sqrt(covariance[:, _ZZ]), covariance_m2=covariance)


_XZ, _YZ, _ZZ = 2, 4, 5


def _level_sigma(given: FloatArray | float | None, settings: Settings, m: int) -> FloatArray:
    stated = settings.errors.level_m
    sigma = LEVEL_M if given is None else given
    full = np.array(np.broadcast_to(sigma if stated is None else stated, m), np.float64)
    full[np.isnan(full)] = LEVEL_M
    return full


def _budget(settings: Settings, cameras: Cameras) -> _Budget:
    errors = settings.errors
    x, y = cameras.centres[:, :2].mean(axis=0).tolist()
    return _Budget(
        image_px=errors.image_px,
        refractive_index=errors.index,
        tilt=math.radians(errors.tilt_deg),
        waves=math.radians(errors.waves_deg),
        centre_m=errors.centre_m,
        attitude=math.radians(errors.attitude_deg),
        pivot_x=x,
        pivot_y=y,
        in_images=settings.method == "consistent",
    )


def _focal_lengths(cameras: Cameras) -> tuple[FloatArray, FloatArray]:
    """Return optical axes, shape (k, 3), and focal lengths (px), shape (k,).

    An axis of zeros stands for an image in which equal angles are equally long, as in a
    fisheye's, nearly.
    """
    axes = np.zeros((len(cameras), 3))
    if cameras.lenses is None or cameras.rotations is None:
        return axes, np.full(len(cameras), NOMINAL_FOCAL_PX)
    flat = np.array([lens.projection == "perspective" for lens in cameras.lenses])
    axes[flat] = cameras.rotations[flat, 2]
    return axes, np.array([lens.focal_px for lens in cameras.lenses])


@njit(cache=True, error_model="numpy", nogil=True)
def _mark_pyramid(
    marks: FloatArray, tile: FloatArray, centre: FloatArray, g: Pyramid
) -> None:  # fmt: skip
    """Mark the points of a tile that lie in a frame without distortion."""
    cx, cy, cz = centre[0], centre[1], centre[2]
    for j in range(marks.size):
        held = in_frame(g, cx - tile[j], cy - tile[TILE + j], cz - tile[2 * TILE + j])
        marks[j] = 1.0 if held else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _mark_camera(
    marks: FloatArray, tile: FloatArray, frames: Frames, c: int, centre: FloatArray,
    low: FloatArray, high: FloatArray,
) -> bool:  # fmt: skip
    """Mark the points of a tile that lie in the frame of camera c; return whether any may."""
    if not may_hold(frames.planes[c], centre, low, high):
        return False
    if frames.row[c] == NOT_DISTORTED:
        _mark_pyramid(marks, tile, centre, pyramid(frames.planes[c]))
        return True
    held = judge(frames, c, centre, low, high)
    if held == ALL:
        marks[:] = 1.0
    if held != SOME:
        return bool(held != NOTHING)
    x, y, z = (
        tile[: marks.size],
        tile[TILE : TILE + marks.size],
        tile[2 * TILE : 2 * TILE + marks.size],
    )
    return bool(mark(marks, x, y, z, centre, frames, c) > 0)


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _all_in_frame(
    order: IntArray, xyz: FloatArray, shift: FloatArray, surface: FloatArray, slope: FloatArray,
    level_sigma: FloatArray, centres: FloatArray, axes: FloatArray, focal: FloatArray,
    offset: FloatArray, frames: Frames, least_cosine2: float, r: float, budget: _Budget,
    result: FloatArray,
) -> None:  # fmt: skip
    """Every camera whose frame holds the point; see `pcfix.refract.intersect`."""
    for t in prange((len(order) + TILE - 1) // TILE):
        rows = order[t * TILE : (t + 1) * TILE]
        tile, sums = np.empty(s.TILE_RUNS * TILE), np.zeros(s.SUMS * TILE)
        marks = np.empty(rows.size)
        low, high = gather(tile, rows, xyz, surface, slope)
        s.add_below(tile, shift, rows)
        for c in range(len(centres)):
            if _mark_camera(marks, tile, frames, c, centres[c], low, high):
                _add(
                    sums, tile, marks, centres[c], axes[c], focal[c], offset[c],
                    least_cosine2, r, budget,
                )  # fmt: skip
        _finish_tile(result, rows, sums, tile, level_sigma, budget)


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _of_lists(
    order: IntArray, xyz: FloatArray, shift: FloatArray, surface: FloatArray, slope: FloatArray,
    level_sigma: FloatArray, centres: FloatArray, axes: FloatArray, focal: FloatArray,
    offset: FloatArray, start: IntArray, camera: IntArray, least_cosine2: float, r: float,
    budget: _Budget, result: FloatArray,
) -> None:  # fmt: skip
    """Take the cameras of lists; those of a tile come one after the other, as by their frames."""
    for t in prange((len(order) + TILE - 1) // TILE):
        rows = order[t * TILE : (t + 1) * TILE]
        tile, sums = np.empty(s.TILE_RUNS * TILE), np.zeros(s.SUMS * TILE)
        gather(tile, rows, xyz, surface, slope)
        s.add_below(tile, shift, rows)
        named = _named(start, camera, rows, len(centres))
        place = np.zeros(len(centres), np.int64)
        place[named] = np.arange(named.size)
        marks = np.zeros((named.size, rows.size))
        for j in range(rows.size):
            for at in range(start[rows[j]], start[rows[j] + 1]):
                marks[place[camera[at]], j] += 1.0
        for at in range(named.size):
            c = named[at]
            _add(
                sums, tile, marks[at], centres[c], axes[c], focal[c], offset[c],
                least_cosine2, r, budget,
            )  # fmt: skip
        _finish_tile(result, rows, sums, tile, level_sigma, budget)


@njit(cache=True, error_model="numpy", nogil=True)
def _named(start: IntArray, camera: IntArray, rows: IntArray, k: int) -> IntArray:
    """Return the cameras that the lists of some points name, in their order."""
    named = np.zeros(k, np.bool_)
    for i in rows:
        for at in range(start[i], start[i + 1]):
            named[camera[at]] = True
    return np.flatnonzero(named)


@njit(cache=True, error_model="numpy", nogil=True)
def _add(
    sums: FloatArray, tile: FloatArray, marks: FloatArray,
    centre: FloatArray, axis: FloatArray, focal: float, offset: float,
    least_cosine2: float, r: float, budget: _Budget,
) -> None:  # fmt: skip
    """Add one camera's rays to the points of a tile that have a mark."""
    if budget.in_images:
        s.add_in_images(sums, tile, marks, centre, axis, focal, offset, least_cosine2, r)
    else:
        s.add_in_space(sums, tile, marks, centre, axis, focal, offset, least_cosine2, r)
    if budget.tilt > 0.0:
        s.add_tilt(
            sums, tile, marks, centre, axis, focal, offset, least_cosine2, r, budget.in_images
        )  # fmt: skip
    if _per_image(budget):
        s.add_noise(
            sums, tile, marks, centre, axis, focal, offset, least_cosine2, r,
            budget.image_px, budget.centre_m, budget.attitude, budget.waves,
        )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _per_image(budget: _Budget) -> bool:
    """Whether rays differ by more than the noise of image coordinates."""
    return max(budget.waves, max(budget.centre_m, budget.attitude)) > 0.0


# What follows `_finish_tile` is inlined: with calls left in it the loop over the points of a tile
# is not vectorised, and takes five times as long.


@njit(cache=True, error_model="numpy", nogil=True)
def _finish_tile(
    result: FloatArray, rows: IntArray, sums: FloatArray, tile: FloatArray,
    level_sigma: FloatArray, budget: _Budget,
) -> None:  # fmt: skip
    """Turn the sums of a tile into covariances."""
    out, sigma = np.empty(6 * TILE), level_sigma[rows]
    if not _per_image(budget):
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


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _solved_in_images(sums: FloatArray, j: int) -> tuple[bool, Nine]:
    """Return whether the rays fix a point, and the inverse of sum S T.

    Q moves by that times the right side of the normal equations of P, and times sum S delta.
    """
    m = _nine(sums, s.BY_Q * TILE + j)
    det, inverse = _inverted(m)
    half = 0.5 * (m[0] + m[4] + m[8])
    return (sums[j] >= 2.0) & (det >= MIN_DETERMINANT * half * half * half), inverse


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _solved_in_space(sums: FloatArray, j: int) -> tuple[bool, Nine, Nine]:
    """Return whether the rays fix a point, and by what it moves.

    That is (sum M)^-1 times sum M delta, and (sum M)^-1 (sum M D) (sum W)^-1 times the right side
    of the normal equations of P.
    """
    k, at = sums[j], s.BY_Q * TILE + j
    xx, xy, xz = sums[at], sums[at + TILE], sums[at + 2 * TILE]
    yy, yz = sums[at + 3 * TILE], sums[at + 4 * TILE]
    det, by_delta = _inverted((k - xx, -xy, -xz, -xy, k - yy, -yz, -xz, -yz, xx + yy))
    full, by_sight = _inverted(_full(_six(sums, s.SIGHT * TILE + j)))
    by_p = _product(by_delta, _nine(sums, s.BY_P * TILE + j))
    solved = (k >= 2.0) & (det >= MIN_DETERMINANT * k * k * k) & (full > 0.0)
    return solved, by_delta, _product(by_p, by_sight)


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _write(
    out: FloatArray, j: int, solved: bool, by_delta: Nine, by_noise: Nine, sums: FloatArray,
    tile: FloatArray, level_sigma: float, budget: _Budget,
) -> None:  # fmt: skip
    """Write the covariance of a point: of its noise, and of each common error a column squared."""
    b = by_noise
    noise = _product(_product(b, _full(_six(sums, s.NOISE * TILE + j))), (
        b[0], b[3], b[6], b[1], b[4], b[7], b[2], b[5], b[8]
    ))  # fmt: skip
    level, index, u, v = _columns(by_delta, sums, tile, j, level_sigma, budget)
    x, y, z = (
        (level[0], index[0], u[0], v[0]),
        (level[1], index[1], u[1], v[1]),
        (level[2], index[2], u[2], v[2]),
    )
    out[j] = noise[0] + _dot(x, x) if solved else 0.0
    out[TILE + j] = noise[1] + _dot(x, y) if solved else 0.0
    out[2 * TILE + j] = noise[2] + _dot(x, z) if solved else 0.0
    out[3 * TILE + j] = noise[4] + _dot(y, y) if solved else 0.0
    out[4 * TILE + j] = noise[5] + _dot(y, z) if solved else 0.0
    out[5 * TILE + j] = noise[8] + _dot(z, z) if solved else 0.0


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _dot(x: Four, y: Four) -> float:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3]


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _columns(
    by_delta: Nine, sums: FloatArray, tile: FloatArray, j: int, level_sigma: float, budget: _Budget
) -> tuple[Three, Three, Three, Three]:
    """Return how a point moves by one standard deviation of level, index and both tilts.

    A tilt also raises the water above the point, by its distance from the pivot.
    """
    nx, ny, nz = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
    scale = 1.0 / np.sqrt(nx * nx + nz * nz)
    ux, uz = nz * scale, -nx * scale
    by_tilt = _nine(sums, s.BY_TILT * TILE + j)
    by_level, by_n = _three(sums, s.BY_LEVEL * TILE + j), _three(sums, s.BY_N * TILE + j)
    level = _scaled(nz, by_level)
    away_u, away_v = tile[j] - budget.pivot_x, tile[TILE + j] - budget.pivot_y
    # the normal leans away from where the slope rises
    u = _plus(_times(by_tilt, (-ux, 0.0, -uz)), _scaled(away_u, level))
    v = _plus(_times(by_tilt, (-ny * uz, nx * uz - nz * ux, ny * ux)), _scaled(away_v, level))
    return (
        _scaled(level_sigma, _times(by_delta, level)),
        _scaled(budget.refractive_index, _times(by_delta, by_n)),
        _scaled(budget.tilt, _times(by_delta, u)),
        _scaled(budget.tilt, _times(by_delta, v)),
    )


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _three(sums: FloatArray, at: int) -> Three:
    return sums[at], sums[at + TILE], sums[at + 2 * TILE]


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _six(sums: FloatArray, at: int) -> s.Six:
    return (
        sums[at], sums[at + TILE], sums[at + 2 * TILE],
        sums[at + 3 * TILE], sums[at + 4 * TILE], sums[at + 5 * TILE],
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _nine(sums: FloatArray, at: int) -> Nine:
    return (
        sums[at], sums[at + TILE], sums[at + 2 * TILE],
        sums[at + 3 * TILE], sums[at + 4 * TILE], sums[at + 5 * TILE],
        sums[at + 6 * TILE], sums[at + 7 * TILE], sums[at + 8 * TILE],
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _full(m: s.Six) -> Nine:
    return m[0], m[1], m[2], m[1], m[3], m[4], m[2], m[4], m[5]


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _scaled(c: float, x: Three) -> Three:
    return c * x[0], c * x[1], c * x[2]


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _plus(x: Three, y: Three) -> Three:
    return x[0] + y[0], x[1] + y[1], x[2] + y[2]


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _times(m: Nine, x: Three) -> Three:
    """Return a matrix times a vector."""
    return (
        m[0] * x[0] + m[1] * x[1] + m[2] * x[2],
        m[3] * x[0] + m[4] * x[1] + m[5] * x[2],
        m[6] * x[0] + m[7] * x[1] + m[8] * x[2],
    )


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _product(a: Nine, b: Nine) -> Nine:
    """Return a matrix times a matrix."""
    x, y, z = (
        _times(a, (b[0], b[3], b[6])), _times(a, (b[1], b[4], b[7])), _times(a, (b[2], b[5], b[8]))
    )  # fmt: skip
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _inverted(m: Nine) -> tuple[float, Nine]:
    """Return the determinant of a matrix and its inverse, which without one is meaningless."""
    a, b, c, d, e, f, g, h, i = m
    x, y, z = e * i - f * h, f * g - d * i, d * h - e * g
    det = a * x + b * y + c * z
    inv = 1.0 / det
    return det, (
        inv * x, inv * (c * h - b * i), inv * (b * f - c * e),
        inv * y, inv * (a * i - c * g), inv * (c * d - a * f),
        inv * z, inv * (b * g - a * h), inv * (a * e - b * d),
    )  # fmt: skip

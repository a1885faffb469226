r"""The covariance of corrected points, from that of what they were made from.

Errors that differ from ray to ray (of image coordinates, poses, waves) move the apparent point P
first: the SfM software intersects straight rays by least squares in the images, so that

    Cov P = K^-1 R K^-1,   K = sum J'J,   R = sum J' Cov(image) J.

The correction then carries P to Q; its derivative dQ/dP is that of the intersection of the
refracted rays, see `pcfix.refract.sensitivity`. Errors common to all rays (level, index and tilt of
the water) come in only there, each with a column of its own:

    Cov Q = dQ/dP Cov P dQ/dP' + sum over the common ones of sigma^2 g g'.

It is the same to first order as intersecting refracted rays of which each is displaced, but for
the weights: there every ray would count by its distance (m) from the point, here as it does in
the images (px), which is how the noise really went in.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit, prange

from pcfix.model import Outcome
from pcfix.refract import sensitivity as s
from pcfix.refract.choice import TILE, choose, gather, least_cosine2, near_cameras, spatial_order
from pcfix.refract.frames import (
    ALL,
    NOT_DISTORTED,
    NOTHING,
    SOME,
    frames_of,
    in_frame,
    judge,
    mark,
    may_hold,
    no_frames,
    pyramid,
)
from pcfix.refract.threads import one_caller
from pcfix.settings import LEVEL_M

if TYPE_CHECKING:
    from pcfix.label.surface import SurfaceAbove
    from pcfix.model import Cameras, FloatArray, IntArray, Lens, Views
    from pcfix.refract.frames import Frames, Pyramid
    from pcfix.refract.learned import Learned
    from pcfix.refract.result import Intersection
    from pcfix.settings import Settings

NOMINAL_FOCAL_PX = 3700.0
"""Of cameras without a lens: a survey drone's of 20 megapixels, 0.27 mrad a pixel."""
NOMINAL_WIDTH_PX = 5472.0
"""Of lenses in millimetres whose pixel size is not known: the same camera's longer side."""


class _Budget(NamedTuple):
    """Standard deviations, angles in radians; the place about which the water tilts."""

    image_px: float
    refractive_index: float
    tilt: float
    waves: float
    centre_m: float
    attitude: float
    pivot_x: float
    pivot_y: float


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
    the middle of the image, lens distortion aside. For methods that move points along the
    vertical only it is an approximation: that of the intersection. A tilt turns the water about
    the middle of the projection centres.
    """
    if not len(xyz):
        return np.zeros((0, 6))
    order = spatial_order(xyz)
    result = np.zeros((len(xyz), 6))
    least = least_cosine2(settings, cameras)
    common = (
        order,
        np.ascontiguousarray(xyz),
        np.ascontiguousarray(shift_m),
        np.ascontiguousarray(surface.height_m),
        np.ascontiguousarray(surface.slope),
        _level_sigma(level_sigma_m, settings, len(xyz)),
        np.ascontiguousarray(cameras.centres),
        *_focal_lengths(cameras),
        np.zeros(len(cameras)) if level_offset_m is None else level_offset_m,
        frames_of(cameras) if views is None else no_frames(len(cameras)),
        least,
        1.0 / settings.refractive_index,
        _budget(settings, cameras),
        result,
    )
    with one_caller():
        if views is None and settings.max_cameras is None:
            _all_in_frame(*common)
        else:
            rows = None if views is None else (views.start, views.camera)
            _chosen(*common, rows, settings.max_cameras or len(cameras))
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
    return axes, np.array([focal_px(lens) for lens in cameras.lenses])


def focal_px(lens: Lens) -> float:
    """Return the focal length in pixels; of a lens in millimetres without a pixel size, nearly."""
    if lens.unit == "px":
        return lens.focal
    if lens.pixel_size_mm is not None:
        return lens.focal / lens.pixel_size_mm
    return lens.focal / max(lens.width, lens.height) * NOMINAL_WIDTH_PX


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
        tile, sums = np.empty(s.RUNS * TILE), np.zeros(s.SUMS * TILE)
        marks = np.empty(rows.size)
        low, high = gather(tile, rows, xyz, surface, slope)
        s.add_frames(tile, shift, rows)
        for c in range(len(centres)):
            if _mark_camera(marks, tile, frames, c, centres[c], low, high):
                _add(
                    sums, tile, marks, centres[c], axes[c], focal[c], offset[c],
                    least_cosine2, r, budget,
                )  # fmt: skip
        _finish_tile(result, rows, sums, tile, level_sigma, budget)


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _chosen(
    order: IntArray, xyz: FloatArray, shift: FloatArray, surface: FloatArray, slope: FloatArray,
    level_sigma: FloatArray, centres: FloatArray, axes: FloatArray, focal: FloatArray,
    offset: FloatArray, frames: Frames, least_cosine2: float, r: float, budget: _Budget,
    result: FloatArray, views: tuple[IntArray, IntArray] | None, most: int,
) -> None:  # fmt: skip
    """Chosen cameras per point."""
    for t in prange((len(order) + TILE - 1) // TILE):
        rows = order[t * TILE : (t + 1) * TILE]
        tile, sums = np.empty(s.RUNS * TILE), np.zeros(s.SUMS * TILE)
        marks = np.ones(rows.size)
        low, high = gather(tile, rows, xyz, surface, slope)
        s.add_frames(tile, shift, rows)
        near = near_cameras(frames, centres, low, high)
        for j in range(rows.size):
            candidates = near
            if views is not None:
                candidates = views[1][views[0][rows[j]] : views[0][rows[j] + 1]].astype(np.int64)
            kept = choose(
                candidates, tile, j, centres, offset, frames, least_cosine2, most, None, None, -1
            )
            for c in candidates[kept]:
                _add(
                    sums[j:], tile[j:], marks[:1], centres[c], axes[c], focal[c], offset[c],
                    least_cosine2, r, budget,
                )  # fmt: skip
        _finish_tile(result, rows, sums, tile, level_sigma, budget)


@njit(cache=True, error_model="numpy", nogil=True)
def _rare(budget: _Budget) -> bool:
    """Whether more than image noise, level and index counts."""
    return max(max(budget.tilt, budget.waves), max(budget.centre_m, budget.attitude)) > 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _add(
    sums: FloatArray, tile: FloatArray, marks: FloatArray,
    centre: FloatArray, axis: FloatArray, focal: float, offset: float,
    least_cosine2: float, r: float, budget: _Budget,
) -> None:  # fmt: skip
    """Add one camera's rays to the points of a tile that have a mark."""
    s.add_rays(
        sums, tile, marks, centre, axis, focal, offset, least_cosine2, r
    )  # fmt: skip
    if _rare(budget):
        s.add_rare(
            sums, tile, marks, centre, axis, focal, offset, least_cosine2, r,
            budget.centre_m, budget.attitude, budget.waves, budget.image_px,
        )  # fmt: skip


MIN_DETERMINANT = 1e-6
"""As of `pcfix.refract.rays.nearest_point`."""


@njit(cache=True, error_model="numpy", nogil=True)
def _finish_tile(
    result: FloatArray, rows: IntArray, sums: FloatArray, tile: FloatArray,
    level_sigma: FloatArray, budget: _Budget,
) -> None:  # fmt: skip
    """Turn the sums of a tile into covariances."""
    frame, by_p = np.zeros((3, 3)), np.empty((3, 3))
    normal, sight, noise = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    work, total = np.empty((3, 3)), np.empty((3, 3))
    columns = np.zeros((4, 3))
    for j in range(rows.size):
        k = sums[s.RAYS * TILE + j]
        if k < 2.0:
            continue
        at = s.TT * TILE + j
        xx, xy, xz = sums[at], sums[at + TILE], sums[at + 2 * TILE]
        yy, yz = sums[at + 3 * TILE], sums[at + 4 * TILE]
        det = _invert(normal, k - xx, -xy, -xz, k - yy, -yz, xx + yy)
        if not det >= MIN_DETERMINANT * k * k * k:
            continue
        at = s.SIGHT * TILE + j
        if not _invert_run(sight, sums, at) > 0.0:
            continue
        _frame(frame, tile, j)
        for i in range(3):
            for p in range(3):
                work[i, p] = sums[(s.BY_P + 3 * p + i) * TILE + j]
        # dQ/dP, its left side in the frame of the surface, its right side turned to the world's
        _multiply(by_p, normal, work, False)
        _multiply(work, by_p, frame, False)
        if _rare(budget):
            _square_run(noise, sums, s.NOISE * TILE + j)
            _multiply(by_p, sight, noise, False)
            _multiply(noise, by_p, sight, False)
        else:
            noise[:] = budget.image_px * budget.image_px * sight
        _multiply(by_p, work, noise, False)
        _multiply(total, by_p, work, True)
        _common(columns, sums, tile, j, normal, level_sigma[rows[j]], budget)
        for column in range(4 if budget.tilt > 0.0 else 2):
            for i in range(3):
                for p in range(3):
                    total[i, p] += columns[column, i] * columns[column, p]
        # from the frame of the surface to the world's
        for i in range(3):
            for p in range(3):
                by_p[i, p] = (
                    total[i, 0] * frame[0, p]
                    + total[i, 1] * frame[1, p]
                    + total[i, 2] * frame[2, p]
                )
        row = result[rows[j]]
        at = 0
        for i in range(3):
            for p in range(i, 3):
                row[at] = (
                    frame[0, i] * by_p[0, p] + frame[1, i] * by_p[1, p] + frame[2, i] * by_p[2, p]
                )
                at += 1


@njit(cache=True, error_model="numpy", nogil=True)
def _common(
    columns: FloatArray, sums: FloatArray, tile: FloatArray, j: int, normal: FloatArray,
    level_sigma: float, budget: _Budget,
) -> None:  # fmt: skip
    """Write how a point moves by one standard deviation of level, index and both tilts, in rows.

    A tilt also raises the water above the point, by its distance from the pivot.
    """
    up = tile[6 * TILE + j]
    away = tile[j] - budget.pivot_x, tile[TILE + j] - budget.pivot_y
    for i in range(3):
        by_level, by_n, by_u, by_v = 0.0, 0.0, 0.0, 0.0
        for p in range(3):
            g = normal[i, p]
            by_level += g * up * sums[(s.BY_LEVEL + p) * TILE + j]
            by_n += g * sums[(s.BY_N + p) * TILE + j]
        columns[0, i] = level_sigma * by_level
        columns[1, i] = budget.refractive_index * by_n
        if budget.tilt == 0.0:
            continue
        for p in range(3):
            # the normal leans away from where the slope rises
            g = normal[i, p]
            by_u -= g * sums[(s.BY_TILT + p) * TILE + j]
            by_v -= g * sums[(s.BY_TILT + 3 + p) * TILE + j]
        columns[2, i] = budget.tilt * (by_u + away[0] * by_level)
        columns[3, i] = budget.tilt * (by_v + away[1] * by_level)


@njit(cache=True, error_model="numpy", nogil=True)
def _frame(frame: FloatArray, tile: FloatArray, j: int) -> None:
    """Write the axes of the surface above a point, in rows."""
    frame[0, 0], frame[0, 2] = tile[s.UX * TILE + j], tile[s.UZ * TILE + j]
    frame[1, 0], frame[1, 1] = tile[s.VX * TILE + j], tile[s.VY * TILE + j]
    frame[1, 2] = tile[s.VZ * TILE + j]
    for axis in range(3):
        frame[2, axis] = tile[(4 + axis) * TILE + j]


@njit(cache=True, error_model="numpy", nogil=True)
def _multiply(out: FloatArray, a: FloatArray, b: FloatArray, turned: bool) -> None:
    """Write the product of a and b, or of a and b transposed, shape (3, 3)."""
    for i in range(3):
        for p in range(3):
            if turned:
                out[i, p] = a[i, 0] * b[p, 0] + a[i, 1] * b[p, 1] + a[i, 2] * b[p, 2]
            else:
                out[i, p] = a[i, 0] * b[0, p] + a[i, 1] * b[1, p] + a[i, 2] * b[2, p]


@njit(cache=True, error_model="numpy", nogil=True)
def _square_run(out: FloatArray, sums: FloatArray, at: int) -> None:
    """Write the symmetric matrix whose six elements lie in runs from `at`."""
    out[0, 0], out[0, 1], out[0, 2] = sums[at], sums[at + TILE], sums[at + 2 * TILE]
    out[1, 0], out[1, 1], out[1, 2] = out[0, 1], sums[at + 3 * TILE], sums[at + 4 * TILE]
    out[2, 0], out[2, 1], out[2, 2] = out[0, 2], out[1, 2], sums[at + 5 * TILE]


@njit(cache=True, error_model="numpy", nogil=True)
def _invert_run(out: FloatArray, sums: FloatArray, at: int) -> float:
    """Invert the symmetric matrix whose six elements lie in runs from `at`; return its det."""
    return _invert(
        out, sums[at], sums[at + TILE], sums[at + 2 * TILE], sums[at + 3 * TILE],
        sums[at + 4 * TILE], sums[at + 5 * TILE],
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _invert(
    out: FloatArray, xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> float:
    """Write the inverse of a symmetric matrix, shape (3, 3); return its determinant."""
    c00, c01, c02 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    c11, c12, c22 = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    det = xx * c00 + xy * c01 + xz * c02
    inv = 1.0 / det
    out[0, 0], out[0, 1], out[0, 2] = inv * c00, inv * c01, inv * c02
    out[1, 0], out[1, 1], out[1, 2] = inv * c01, inv * c11, inv * c12
    out[2, 0], out[2, 1], out[2, 2] = inv * c02, inv * c12, inv * c22
    return float(det)

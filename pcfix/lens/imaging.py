"""Project a direction in the camera frame to the image, and back.

Projection, distortion and interior orientation are joined by the chain rule. NaN stands where a
direction has no image, or a place in the image no direction.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from pcfix.kernels import device, kernel
from pcfix.lens.algebra import Vector, row_of, times, transposed_times, vector
from pcfix.lens.formulas import (
    B2,
    B3,
    CENTRE_X,
    CENTRE_Y,
    DISC,
    FOCAL_X,
    FOCAL_Y,
    INVERSE,
    PRINCIPAL_X,
    PRINCIPAL_Y,
    TAIL,
    TANGENTIAL,
    Gradients,
    angle,
    coefficients,
    distorted,
    plane_and_gradients,
    undistorted,
)
from pcfix.model import Cameras, FloatArray, IntArray, Lens


def project(lens: Lens, directions: FloatArray) -> FloatArray:
    """Return the image coordinates of directions, shape (n, 3), camera frame, any length.

    Shape (n, 2), in the unit of the lens, also outside the frame; NaN where the lens has no image,
    as behind a perspective camera or beyond the fold of the distortion.
    """
    rows = np.ascontiguousarray(directions, np.float64).reshape(-1, 3)
    return _project(coefficients(lens), rows)


def unproject(lens: Lens, image_xy: FloatArray) -> FloatArray:
    """Return the directions of image coordinates, shape (n, 2), in the unit of the lens.

    Unit vectors in the camera frame, shape (n, 3); NaN outside the image of the lens.
    """
    rows = np.ascontiguousarray(image_xy, np.float64).reshape(-1, 2)
    return _unproject(coefficients(lens), rows)


def straight_images(xyz: FloatArray, camera: IntArray, cameras: Cameras) -> FloatArray:
    """Return the image coordinates of points by straight rays, shape (o, 2); see `project`.

    Each point, shape (o, 3), world frame, has one camera: a row of `cameras`, which have rotations
    and lenses.
    """
    lenses, rotations = cameras.lenses or (), np.asarray(cameras.rotations)
    image_xy = np.full((len(xyz), 2), np.nan)
    order = np.argsort(camera, kind="stable")
    ends = np.searchsorted(camera[order], np.arange(len(lenses) + 1))
    for k in np.flatnonzero(np.diff(ends)):
        rows = order[ends[k] : ends[k + 1]]
        image_xy[rows] = project(lenses[k], (xyz[rows] - cameras.centres[k]) @ rotations[k].T)
    return image_xy


@device
def image_of(c: FloatArray, x: float, y: float, z: float) -> tuple[float, float]:
    """Return u, v of one direction: projection, distortion, interior orientation."""
    return image_and_gradients(c, x, y, z)[:2]


@device
def direction_of(c: FloatArray, u: float, v: float) -> tuple[float, float, float]:
    """Return the unit direction of one place in the image: `image_of` backwards."""
    cx, cy = c[CENTRE_X], c[CENTRE_Y]
    u, v = u - c[PRINCIPAL_X], v - c[PRINCIPAL_Y]
    det = c[FOCAL_X] * c[FOCAL_Y] - c[B2] * c[B3]
    dx = (c[FOCAL_Y] * u - c[B2] * v) / det - cx
    dy = (c[FOCAL_X] * v - c[B3] * u) / det - cy
    if c[INVERSE] != 0.0:
        px, py, _ = distorted(c, dx, dy)
    else:
        px, py = undistorted(c, dx, dy)
    px, py = px + cx, py + cy
    rho = np.sqrt(px * px + py * py)
    theta = angle(c, rho)
    scale = np.sin(theta) / rho if rho > 0.0 else 1.0
    return scale * px, scale * py, np.cos(theta)


@kernel(allocates=True)
def _project(c: FloatArray, directions: FloatArray) -> FloatArray:
    image = np.empty((len(directions), 2))
    for i in range(len(directions)):
        image[i, 0], image[i, 1] = image_of(c, *row_of(directions, i))
    return image


@kernel(allocates=True)
def _unproject(c: FloatArray, image: FloatArray) -> FloatArray:
    directions = np.empty((len(image), 3))
    for i in range(len(image)):
        ray = direction_of(c, image[i, 0], image[i, 1])
        directions[i, 0], directions[i, 1], directions[i, 2] = ray
    return directions


@device
def image_and_gradients(
    c: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, Gradients]:
    """Return u, v of a direction (x, y, z), camera frame, and their derivatives by it."""
    px, py, (ax, ay, az, bx, by, bz) = plane_and_gradients(c, x, y, z)
    px, py = px - c[CENTRE_X], py - c[CENTRE_Y]
    if c[INVERSE] != 0.0:
        dx, dy = undistorted(c, px, py)
        _, _, (xx, xy, yx, yy) = distorted(c, dx, dy)
        det = xx * yy - xy * yx
        xx, xy, yx, yy = yy / det, -xy / det, -yx / det, xx / det
    else:
        dx, dy, (xx, xy, yx, yy) = distorted(c, px, py)
    dx, dy = dx + c[CENTRE_X], dy + c[CENTRE_Y]
    fx, fy, b2, b3 = c[FOCAL_X], c[FOCAL_Y], c[B2], c[B3]
    ua, ub = fx * xx + b2 * yx, fx * xy + b2 * yy
    va, vb = fy * yx + b3 * xx, fy * yy + b3 * xy
    return (
        c[PRINCIPAL_X] + fx * dx + b2 * dy,
        c[PRINCIPAL_Y] + fy * dy + b3 * dx,
        (
            ua * ax + ub * bx, ua * ay + ub * by, ua * az + ub * bz,
            va * ax + vb * bx, va * ay + vb * by, va * az + vb * bz,
        ),
    )  # fmt: skip


Plain: TypeAlias = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float,
    float, float,
]  # fmt: skip
"""k1 to k4, p1, p2, the centre of distortion, the squared disc, and the interior orientation."""


@device
def plain_lens(c: FloatArray) -> Plain:
    """Return the common lens (`PLAIN`) as numbers, which stay in registers."""
    return (
        *vector(c, TAIL), c[TAIL + 3],
        c[TANGENTIAL], c[TANGENTIAL + 1], c[CENTRE_X], c[CENTRE_Y],
        c[DISC] * c[DISC],
        c[FOCAL_X], c[B2], c[B3], c[FOCAL_Y],
        c[PRINCIPAL_X], c[PRINCIPAL_Y],
    )  # fmt: skip


@device(inline="always")
def plain_image(c: Plain, w: Vector) -> tuple[float, float, Gradients]:
    """Do as `image_and_gradients` for the common lens, without branches: loops vectorise."""
    k1, k2, k3, k4, p1, p2, centre_x, centre_y, disc2, fx, b2, b3, fy, u0, v0 = c
    inv = 1.0 / w[2]
    flat_x, flat_y = w[0] * inv, w[1] * inv
    x, y = flat_x - centre_x, flat_y - centre_y
    r2 = x * x + y * y
    # Brown: radial factor g and its derivative by r^2, then tangential terms
    g = 1.0 + (((k4 * r2 + k3) * r2 + k2) * r2 + k1) * r2
    twice = 2.0 * (((4.0 * k4 * r2 + 3.0 * k3) * r2 + 2.0 * k2) * r2 + k1)
    dx = g * x + (p1 * (r2 + 2.0 * x * x) + 2.0 * p2 * x * y) + centre_x
    dy = g * y + (p2 * (r2 + 2.0 * y * y) + 2.0 * p1 * x * y) + centre_y
    xx = g + twice * x * x + 6.0 * p1 * x + 2.0 * p2 * y
    xy = twice * x * y + 2.0 * (p1 * y + p2 * x)
    yy = g + twice * y * y + 6.0 * p2 * y + 2.0 * p1 * x
    # behind the camera and beyond the fold of the distortion there is no image
    seen = (w[2] > 0.0) & (r2 <= disc2)
    u = u0 + fx * dx + b2 * dy if seen else np.nan
    v = v0 + fy * dy + b3 * dx if seen else np.nan
    ua, ub, va, vb = fx * xx + b2 * xy, fx * xy + b2 * yy, fy * xy + b3 * xx, fy * yy + b3 * xy
    return u, v, (
        inv * ua, inv * ub, -inv * (ua * flat_x + ub * flat_y),
        inv * va, inv * vb, -inv * (va * flat_x + vb * flat_y),
    )  # fmt: skip


@device(inline="always")
def image_and_slopes(
    lens: FloatArray, plain: Plain | None, r: FloatArray, direction: Vector
) -> tuple[float, float, Vector, Vector]:
    """Return u, v of a direction in the world frame, and the gradients of u and v there.

    The camera has the rotation r. The numbers of the common lens are used if there are any.
    """
    if plain is None:
        u, v, g = image_and_gradients(lens, *times(r, direction))
    else:
        u, v, g = plain_image(plain, times(r, direction))
    return u, v, transposed_times(r, g[:3]), transposed_times(r, g[3:])

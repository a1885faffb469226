"""Project a direction in the camera frame to the image, and back.

The formulas are those of `pcfix.model.Lens`, used only where they are one to one: a direction
beyond the fold of the distortion has no place in the image, and a place beyond the image of the
fold no direction. Both are NaN.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias

import numpy as np

from pcfix.kernels import device, kernel
from pcfix.lens import formulas as places
from pcfix.lens.algebra import Vector, times, transposed_times, vector
from pcfix.lens.formulas import (
    CODES,
    angle,
    distorted,
    largest_angle,
    largest_disc,
    largest_radius,
    radius,
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


@lru_cache(maxsize=8192)
def coefficients(lens: Lens) -> FloatArray:
    """Return a lens as the flat array that the kernels take, see `pcfix.lens.formulas`."""
    c = np.zeros(places.TAIL)
    c[places.KIND] = CODES[lens.projection]
    c[places.TANGENTIAL : places.TANGENTIAL + 4] = _filled(lens.tangential, 4)[:4]
    c[places.THIN_PRISM : places.THIN_PRISM + 4] = _filled(lens.thin_prism, 4)[:4]
    c[places.IN_TURN], c[places.INVERSE] = lens.in_turn, lens.inverse
    c[places.CENTRE_X : places.CENTRE_Y + 1] = lens.distortion_centre
    c[places.FOCAL_X : places.FOCAL_Y + 1] = lens.focal + lens.b1, lens.b2, lens.b3, lens.focal
    c[places.PRINCIPAL_X : places.PRINCIPAL_Y + 1] = lens.principal_x, lens.principal_y
    c[places.WIDTH : places.HEIGHT + 1] = lens.width, lens.height
    more = (*lens.radial[4:], *lens.denominator, *lens.tangential[2:], *lens.thin_prism)
    is_plain = not (lens.inverse or lens.in_turn or any(more))
    c[places.PLAIN] = is_plain and lens.projection == "perspective"
    # what has no fixed length stands at the end
    radial = _filled(lens.radial, places.LEAST_RADIALS)
    shape = _filled(lens.shape, places.LEAST_SHAPES)
    counts = len(radial), len(lens.denominator), len(shape)
    c[places.RADIALS : places.SHAPES + 1] = counts
    c[places.SHAPE] = places.TAIL + counts[0] + counts[1]
    c = np.concatenate([c, radial, lens.denominator, shape])
    c[places.LARGEST_ANGLE] = largest_angle(lens)
    c[places.LARGEST_RADIUS] = largest_radius(c)
    c[places.DISC] = largest_disc(lens, c)
    return c


def lens_table(lenses: tuple[Lens, ...]) -> tuple[IntArray, FloatArray]:
    """Return the row of each of k lenses in a table, and the table for kernels, shape (l, ...).

    It has equal lenses once, as of `pcfix.lens.formulas`, padded with zeros.
    """
    rows: dict[Lens, int] = {}
    row = np.array([rows.setdefault(lens, len(rows)) for lens in lenses])
    each = [coefficients(lens) for lens in rows]
    table = np.zeros((len(each), max(map(len, each))))
    for i, numbers in enumerate(each):
        table[i, : len(numbers)] = numbers
    return row, table


def _filled(numbers: tuple[float, ...], least: int) -> tuple[float, ...]:
    """Return the numbers, filled up with zeros to the least length."""
    return (*numbers, *(0.0,) * (least - len(numbers)))


@device
def in_plane(c: FloatArray, x: float, y: float, z: float) -> tuple[float, float]:
    """Return the plane coordinates of a direction, before distortion; NaN where it has none."""
    return _plane_and_gradients(c, x, y, z)[:2]


@device
def image_of(c: FloatArray, x: float, y: float, z: float) -> tuple[float, float]:
    """Return u, v of one direction: projection, distortion, interior orientation."""
    return image_and_gradients(c, x, y, z)[:2]


@device
def direction_of(c: FloatArray, u: float, v: float) -> tuple[float, float, float]:
    """Return the unit direction of one place in the image: `image_of` backwards."""
    cx, cy = c[places.CENTRE_X], c[places.CENTRE_Y]
    u, v = u - c[places.PRINCIPAL_X], v - c[places.PRINCIPAL_Y]
    det = c[places.FOCAL_X] * c[places.FOCAL_Y] - c[places.B2] * c[places.B3]
    dx = (c[places.FOCAL_Y] * u - c[places.B2] * v) / det - cx
    dy = (c[places.FOCAL_X] * v - c[places.B3] * u) / det - cy
    if c[places.INVERSE] != 0.0:
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
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        image[i, 0], image[i, 1] = image_of(c, x, y, z)
    return image


@kernel(allocates=True)
def _unproject(c: FloatArray, image: FloatArray) -> FloatArray:
    directions = np.empty((len(image), 3))
    for i in range(len(image)):
        x, y, z = direction_of(c, image[i, 0], image[i, 1])
        directions[i, 0], directions[i, 1], directions[i, 2] = x, y, z
    return directions


Gradients: TypeAlias = tuple[float, float, float, float, float, float]
"""Derivatives of two numbers by three others: a_x, a_y, a_z, b_x, b_y, b_z."""

_NOWHERE = (np.nan,) * 6


@device
def image_and_gradients(
    c: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, Gradients]:
    """Return u, v of a direction (x, y, z), camera frame, and their derivatives by it.

    Projection, distortion and interior orientation are joined by the chain rule. NaN where there is
    no image.
    """
    px, py, (ax, ay, az, bx, by, bz) = _plane_and_gradients(c, x, y, z)
    px, py = px - c[places.CENTRE_X], py - c[places.CENTRE_Y]
    if c[places.INVERSE] != 0.0:
        dx, dy = undistorted(c, px, py)
        _, _, (xx, xy, yx, yy) = distorted(c, dx, dy)
        det = xx * yy - xy * yx
        xx, xy, yx, yy = yy / det, -xy / det, -yx / det, xx / det
    else:
        dx, dy, (xx, xy, yx, yy) = distorted(c, px, py)
    dx, dy = dx + c[places.CENTRE_X], dy + c[places.CENTRE_Y]
    fx, fy, b2, b3 = c[places.FOCAL_X], c[places.FOCAL_Y], c[places.B2], c[places.B3]
    ua, ub = fx * xx + b2 * yx, fx * xy + b2 * yy
    va, vb = fy * yx + b3 * xx, fy * yy + b3 * xy
    return (
        c[places.PRINCIPAL_X] + fx * dx + b2 * dy,
        c[places.PRINCIPAL_Y] + fy * dy + b3 * dx,
        (
            ua * ax + ub * bx, ua * ay + ub * by, ua * az + ub * bz,
            va * ax + vb * bx, va * ay + vb * by, va * az + vb * bz,
        ),
    )  # fmt: skip


@device
def image_in_world(
    c: FloatArray, r: FloatArray, direction: Vector
) -> tuple[float, float, Vector, Vector]:
    """Return u, v of a direction in the world frame, and the gradients of u and v there.

    The camera has the rotation r.
    """
    u, v, g = image_and_gradients(c, *times(r, direction))
    return u, v, transposed_times(r, g[:3]), transposed_times(r, g[3:])


@device
def _plane_and_gradients(
    c: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, Gradients]:
    """Return the plane coordinates of a direction before distortion, and their gradients.

    With the radius rho(theta), q^2 = x^2 + y^2 and r^2 = q^2 + z^2 they are (rho / q) (x, y),
    and theta = atan2(q, z) has the gradient (z / r^2) by q and (-q / r^2) by z.
    """
    if c[places.KIND] == places.PERSPECTIVE:
        if not z > 0.0:
            return np.nan, np.nan, _NOWHERE
        px, py = x / z, y / z
        return px, py, (1.0 / z, 0.0, -px / z, 0.0, 1.0 / z, -py / z)
    q2 = x * x + y * y
    r2 = q2 + z * z
    theta = np.arctan2(np.sqrt(q2), z)
    if not (theta <= c[places.LARGEST_ANGLE] and (q2 > 0.0 or z > 0.0)):
        return np.nan, np.nan, _NOWHERE
    rho, slope = radius(c, theta)
    scale = rho / np.sqrt(q2) if q2 > 0.0 else slope / z
    turn = (slope * z / r2 - scale) / q2 if q2 > 0.0 else 0.0
    away = -slope / r2
    cross = turn * x * y
    return (
        scale * x,
        scale * y,
        (scale + turn * x * x, cross, away * x, cross, scale + turn * y * y, away * y),
    )


Plain: TypeAlias = tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float,
    float, float,
]  # fmt: skip
"""k1 to k4, p1, p2, the centre of distortion, the squared disc, and the interior orientation."""


@device
def plain_lens(c: FloatArray) -> Plain:
    """Return the common lens (`places.PLAIN`) as numbers, which stay in registers."""
    return (
        *vector(c, places.TAIL), c[places.TAIL + 3],
        c[places.TANGENTIAL], c[places.TANGENTIAL + 1], c[places.CENTRE_X], c[places.CENTRE_Y],
        c[places.DISC] * c[places.DISC],
        c[places.FOCAL_X], c[places.B2], c[places.B3], c[places.FOCAL_Y],
        c[places.PRINCIPAL_X], c[places.PRINCIPAL_Y],
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
    """Do as `image_in_world`, by the numbers of the common lens if there are any."""
    if plain is None:
        return image_in_world(lens, r, direction)
    u, v, g = plain_image(plain, times(r, direction))
    return u, v, transposed_times(r, g[:3]), transposed_times(r, g[3:])

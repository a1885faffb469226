"""Project a direction in the camera frame to the image, and back.

The formulas are those of `pcfix.model.Lens`, projection and Brown's distortion, used only where
they are one to one: a direction beyond the fold of the distortion has no place in the image, and a
place beyond the image of the fold no direction. Both are NaN.

For the kernels a lens is a flat array of numbers, see `coefficients`; several lenses, padded with
zeros, are the rows of a table.

In Brown's formula, places are relative to the centre of distortion. It is used inside a disc in
which the symmetric part of its Jacobian is positive definite: on a disc that is enough for no two
places to have the same image. Without tangential terms it is the disc up to the fold, where
d r' / d r = 0.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias, get_args

import numpy as np
from numpy.polynomial import Polynomial

from pcfix.kernels import device, kernel
from pcfix.lens.algebra import Vector, times, transposed_times, vector
from pcfix.model import Cameras, FloatArray, IntArray, Lens, Projection

KIND, LARGEST_ANGLE, LARGEST_RADIUS = range(3)
"""The projection as a number, and its limits: radians, and the radius in its plane."""

TANGENTIAL, THIN_PRISM = 3, 7
IN_TURN, INVERSE, CENTRE_X, CENTRE_Y, DISC = range(11, 16)
"""`DISC` is the radius about the centre of distortion up to which Brown's formula is used."""

FOCAL_X, B2, B3, FOCAL_Y, PRINCIPAL_X, PRINCIPAL_Y, WIDTH, HEIGHT = range(16, 24)

PLAIN = 24  # whether the lens is the common one: perspective with Brown's k1 to k4, p1 and p2 only

RADIALS, DENOMINATORS, SHAPES, SHAPE, TAIL = range(25, 30)
"""Number of each; k1 is at `TAIL`, the others follow, the first shape number at `SHAPE`."""

LEAST_RADIALS, LEAST_SHAPES = 4, 2
"""Zeros are added up to these numbers, so that the first few can be read unconditionally."""


CODES: dict[str, int] = {name: i for i, name in enumerate(get_args(Projection))}
PERSPECTIVE, EQUIDISTANT, EQUISOLID, POLYNOMIAL, FOV, DUAL, DIVISION, EUCM = CODES.values()

RIGHT_ANGLE = 0.5 * np.pi


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
    """Return a lens as the flat array that the kernels take, see `KIND`."""
    c = np.zeros(TAIL)
    c[KIND] = CODES[lens.projection]
    c[TANGENTIAL : TANGENTIAL + len(lens.tangential)] = lens.tangential
    c[THIN_PRISM : THIN_PRISM + len(lens.thin_prism)] = lens.thin_prism
    c[IN_TURN], c[INVERSE] = lens.in_turn, lens.inverse
    c[CENTRE_X : CENTRE_Y + 1] = lens.distortion_centre
    c[FOCAL_X : FOCAL_Y + 1] = lens.focal + lens.b1, lens.b2, lens.b3, lens.focal
    c[PRINCIPAL_X : PRINCIPAL_Y + 1] = lens.principal_x, lens.principal_y
    c[WIDTH : HEIGHT + 1] = lens.width, lens.height
    more = (*lens.radial[4:], *lens.denominator, *lens.tangential[2:], *lens.thin_prism)
    is_plain = not (lens.inverse or lens.in_turn or any(more))
    c[PLAIN] = is_plain and lens.projection == "perspective"
    # what has no fixed length stands at the end
    radial = (*lens.radial, *(0.0,) * (LEAST_RADIALS - len(lens.radial)))
    shape = (*lens.shape, *(0.0,) * (LEAST_SHAPES - len(lens.shape)))
    counts = len(radial), len(lens.denominator), len(shape)
    c[RADIALS : SHAPES + 1] = counts
    c[SHAPE] = TAIL + counts[0] + counts[1]
    c = np.concatenate([c, radial, lens.denominator, shape])
    c[LARGEST_ANGLE] = largest_angle(lens)
    c[LARGEST_RADIUS] = largest_radius(c)
    c[DISC] = largest_disc(lens)
    return c


def lens_table(lenses: tuple[Lens, ...]) -> tuple[IntArray, FloatArray]:
    """Return the row of each of k lenses in a table, and the table for kernels, shape (l, ...).

    It has equal lenses once, padded with zeros.
    """
    rows: dict[Lens, int] = {}
    row = np.array([rows.setdefault(lens, len(rows)) for lens in lenses])
    each = [coefficients(lens) for lens in rows]
    table = np.zeros((len(each), max(map(len, each))))
    for i, numbers in enumerate(each):
        table[i, : len(numbers)] = numbers
    return row, table


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
def plane_and_gradients(
    c: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, Gradients]:
    """Return the plane coordinates of a direction before distortion, and their gradients.

    With the radius rho(theta), q^2 = x^2 + y^2 and r^2 = q^2 + z^2 they are (rho / q) (x, y),
    and theta = atan2(q, z) has the gradient (z / r^2) by q and (-q / r^2) by z.
    """
    if c[KIND] == PERSPECTIVE:
        if not z > 0.0:
            return np.nan, np.nan, _NOWHERE
        px, py = x / z, y / z
        return px, py, (1.0 / z, 0.0, -px / z, 0.0, 1.0 / z, -py / z)
    q2 = x * x + y * y
    r2 = q2 + z * z
    theta = np.arctan2(np.sqrt(q2), z)
    if not (theta <= c[LARGEST_ANGLE] and (q2 > 0.0 or z > 0.0)):
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
    """Do as `image_in_world`, by the numbers of the common lens if there are any."""
    if plain is None:
        return image_in_world(lens, r, direction)
    u, v, g = plain_image(plain, times(r, direction))
    return u, v, transposed_times(r, g[:3]), transposed_times(r, g[3:])


def largest_angle(lens: Lens) -> float:
    """Return the angle up to which the radius of the projection grows, radians."""
    s0, s1 = (*lens.shape, 0.0, 0.0)[:2]
    match lens.projection:
        case "equidistant" | "equisolid":
            return np.pi
        case "polynomial":
            slope = Polynomial(lens.shape or (0.0,)).deriv()
            if slope(0.0) <= 0.0:
                return 0.0
            return RIGHT_ANGLE * min(2.0, first_root(slope))
        case "dual" if s0 == 0.0:
            return np.pi
        case "dual" if s0 < 0.0:
            return float(np.arctan(np.sqrt(-1.0 / s0)))
        case "division" if s0 < 0.0:
            return np.pi
        case "division" if s0 > 0.0:
            return float(np.arctan(0.5 / np.sqrt(s0)))
        case "fov" if abs(s0) >= np.pi:
            return 0.0
        case "eucm" if s0 > 0.0:
            w = s0 / (1.0 - s0) if s0 <= 0.5 else (1.0 - s0) / s0
            return float(np.pi - np.arctan2(np.sqrt((1.0 - w * w) / s1), w))
        case _:
            return RIGHT_ANGLE


@kernel
def largest_radius(c: FloatArray) -> float:
    """Return the radius of the largest angle; may be infinite."""
    rho = radius(c, c[LARGEST_ANGLE])[0]
    # a tangent or a quotient beyond its pole by rounding
    return rho if rho >= 0.0 else np.inf


def first_root(polynomial: Polynomial) -> float:
    """Return the smallest positive real root, or infinity.

    It is the largest root of the polynomial in 1 / x, whose leading coefficient is never small.
    """
    roots = np.asarray(Polynomial(polynomial.coef[::-1]).roots(), complex)
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 1e-300)]
    return 1.0 / float(real.max()) if real.size else np.inf


@device
def _shape(c: FloatArray, i: int) -> float:
    return c[int(c[SHAPE]) + i]


@device
def radius(c: FloatArray, theta: float) -> tuple[float, float]:
    """Return the radius in the plane of a direction at an angle from the axis, and its slope."""
    kind, s0, s1 = int(c[KIND]), _shape(c, 0), _shape(c, 1)
    if kind == EQUIDISTANT or (kind == DUAL and s0 == 0.0):
        return theta, 1.0
    if kind == EQUISOLID:
        return 2.0 * np.sin(0.5 * theta), np.cos(0.5 * theta)
    if kind == POLYNOMIAL:  # Pix4D's, in which a right angle counts as 1
        q, rho, slope = theta / RIGHT_ANGLE, 0.0, 0.0
        for i in range(int(c[SHAPES]) - 1, -1, -1):
            slope = slope * q + rho
            rho = rho * q + _shape(c, i)
        return rho, slope / RIGHT_ANGLE
    sine, cosine, tangent = np.sin(theta), np.cos(theta), np.tan(theta)
    if kind == FOV and s0 != 0.0:
        twice = 2.0 * np.tan(0.5 * s0)
        slope = twice / (s0 * (cosine * cosine + twice * twice * sine * sine))
        return np.arctan(twice * tangent) / s0, slope
    if kind == DUAL:  # the weighted mean of perspective and equidistant
        return s0 * tangent + (1.0 - s0) * theta, 1.0 + s0 * tangent * tangent
    if kind == DIVISION:
        root = np.sqrt(max(cosine * cosine - 4.0 * s0 * sine * sine, 0.0))
        rho = (cosine - root) / (2.0 * s0 * sine) if cosine < 0.0 else 2.0 * sine / (cosine + root)
        # rho cos = (1 + s0 rho^2) sin, differentiated; safe beyond a right angle
        above = (1.0 + s0 * rho * rho) * cosine + rho * sine
        return rho, above / (cosine - 2.0 * s0 * rho * sine)
    if kind == EUCM:
        d = np.sqrt(s1 * sine * sine + cosine * cosine)
        below = s0 * d + (1.0 - s0) * cosine
        below_slope = s0 * (s1 - 1.0) * sine * cosine / d - (1.0 - s0) * sine
        rho = sine / below
        return rho, (cosine - rho * below_slope) / below
    return tangent, 1.0 / (cosine * cosine)


@kernel
def angle(c: FloatArray, rho: float) -> float:
    """Return the angle from the axis of a radius in the plane: the inverse of `radius`."""
    if not rho <= c[LARGEST_RADIUS]:
        return np.nan
    if int(c[KIND]) == PERSPECTIVE:
        return np.arctan(rho)
    # Newton's method, with bisection if a step leaves the bracket
    low, high = 0.0, c[LARGEST_ANGLE]
    if rho < radius(c, low)[0]:
        return np.nan
    theta = 0.5 * high
    for _ in range(100):
        value, slope = radius(c, theta)
        if value < rho:
            low = theta
        else:
            high = theta
        then = theta - (value - rho) / slope
        if not low <= then <= high:
            then = 0.5 * (low + high)
        if abs(then - theta) <= 4e-16:
            return then
        theta = then
    return theta


Jacobian: TypeAlias = tuple[float, float, float, float]


@device
def _series(c: FloatArray, at: int, count: int, r2: float) -> tuple[float, float]:
    """Return 1 + c1 r^2 + c2 r^4 + ... and its derivative by r^2 (Horner's scheme for both)."""
    value, slope = 0.0, 0.0
    for i in range(at + count - 1, at - 1, -1):
        slope = slope * r2 + value
        value = value * r2 + c[i]
    return 1.0 + value * r2, slope * r2 + value


@device
def _radial(c: FloatArray, r2: float) -> tuple[float, float]:
    """Return r' / r and its derivative by r^2."""
    k, d = int(c[RADIALS]), int(c[DENOMINATORS])
    above, slope = _series(c, TAIL, k, r2)
    if d == 0:
        return above, slope
    below, below_slope = _series(c, TAIL + k, d, r2)
    g = above / below
    return g, (slope - g * below_slope) / below


@device
def _sideways(c: FloatArray, x: float, y: float) -> tuple[float, float, Jacobian]:
    """Return the tangential and thin prism terms, and their Jacobian."""
    p1, p2, p3, p4 = c[TANGENTIAL], c[TANGENTIAL + 1], c[TANGENTIAL + 2], c[TANGENTIAL + 3]
    s1, s2, s3, s4 = c[THIN_PRISM], c[THIN_PRISM + 1], c[THIN_PRISM + 2], c[THIN_PRISM + 3]
    r2 = x * x + y * y
    tx = p1 * (r2 + 2.0 * x * x) + 2.0 * p2 * x * y
    ty = p2 * (r2 + 2.0 * y * y) + 2.0 * p1 * x * y
    more, slope = 1.0 + (p3 + p4 * r2) * r2, 2.0 * (p3 + 2.0 * p4 * r2)
    across = 2.0 * (p1 * y + p2 * x) * more
    # derivatives by r^2, which has the gradient 2 (x, y)
    sx, sy = tx * slope + 2.0 * (s1 + 2.0 * s2 * r2), ty * slope + 2.0 * (s3 + 2.0 * s4 * r2)
    return tx * more + (s1 + s2 * r2) * r2, ty * more + (s3 + s4 * r2) * r2, (
        (6.0 * p1 * x + 2.0 * p2 * y) * more + sx * x, across + sx * y,
        across + sy * x, (6.0 * p2 * y + 2.0 * p1 * x) * more + sy * y,
    )  # fmt: skip


@device
def distorted(c: FloatArray, x: float, y: float) -> tuple[float, float, Jacobian]:
    """Return Brown's formula at a place, and d x'/d x, d x'/d y, d y'/d x, d y'/d y.

    The place is NaN outside the disc where the formula is one to one.
    """
    r2 = x * x + y * y
    g, slope = _radial(c, r2)
    twice = 2.0 * slope
    xx, xy, yy = g + twice * x * x, twice * x * y, g + twice * y * y
    fx, fy = (g * x, g * y) if r2 <= c[DISC] * c[DISC] else (np.nan, np.nan)
    if c[IN_TURN] == 0.0:
        tx, ty, (a, b, d, e) = _sideways(c, x, y)
        return fx + tx, fy + ty, (xx + a, xy + b, xy + d, yy + e)
    tx, ty, (a, b, d, e) = _sideways(c, g * x, g * y)
    a, e = a + 1.0, e + 1.0
    return fx + tx, fy + ty, (
        a * xx + b * xy, a * xy + b * yy, d * xx + e * xy, d * xy + e * yy
    )  # fmt: skip


@device
def undistorted(c: FloatArray, u: float, v: float) -> tuple[float, float]:
    """Return the place in the disc that `distorted` maps to (u, v), or NaN.

    Newton's method from (u, v) or, if that is outside, from a place in the disc in that direction;
    each step is halved until it stays in the disc and reduces the residual.
    """
    rho = np.sqrt(u * u + v * v)
    if rho == 0.0 or not rho < np.inf:
        return u * 1.0, v * 1.0
    scale = min(1.0, 0.9 * c[DISC] / rho)
    x, y = scale * u, scale * v
    fx, fy, (a, b, d, e) = distorted(c, x, y)
    fx, fy = fx - u, fy - v
    for _ in range(100):
        if fx * fx + fy * fy <= (2e-16 * (1.0 + rho)) ** 2:
            break
        det = a * e - b * d
        dx, dy = (e * fx - b * fy) / det, (a * fy - d * fx) / det
        nearer = False
        for _ in range(40):
            gx, gy, there = distorted(c, x - dx, y - dy)
            gx, gy = gx - u, gy - v
            nearer = gx * gx + gy * gy < fx * fx + fy * fy
            if nearer:
                break
            dx, dy = 0.5 * dx, 0.5 * dy
        if not nearer:
            break
        x, y, fx, fy, (a, b, d, e) = x - dx, y - dy, gx, gy, there
    if fx * fx + fy * fy <= (1e-12 * (1.0 + rho)) ** 2:
        return x, y
    return np.nan, np.nan


def largest_disc(lens: Lens) -> float:
    """Return the radius of a disc where Brown's formula is one to one; may be infinite.

    The symmetric part of its Jacobian has the eigenvalues g and g + 2 q g' of the radial terms,
    q = r^2, less at most the `bound` of the tangential and thin prism terms.
    """
    r, q = Polynomial((0.0, 1.0)), Polynomial((0.0, 0.0, 1.0))
    above, below = Polynomial((1.0, *lens.radial)), Polynomial((1.0, *lens.denominator))
    # g = above / below; the slope of r' is this over below^2, all by q
    slope = (above + 2.0 * r * above.deriv()) * below - 2.0 * r * above * below.deriv()
    above, below, slope = above(q), below(q), slope(q)
    p1, p2, p3, p4 = np.abs((*lens.tangential, 0.0, 0.0, 0.0, 0.0)[:4])
    s1, s2, s3, s4 = (*lens.thin_prism, 0.0, 0.0, 0.0, 0.0)[:4]
    p = np.hypot(p1, p2)
    bound = r * (6.0 * p + 2.0 * np.hypot(s1, s3) + q * (12.0 * p * p3 + 4.0 * np.hypot(s2, s4)))
    bound += 18.0 * p * p4 * r**5
    if lens.in_turn:  # these terms are those of the place after the radial terms, r' = r g
        most = first_root(1.0 - bound)
        return min(first_root(slope), first_root(below), first_root(below - r * above / most))
    left = (slope - bound * below**2, above - bound * below, below)
    return min(first_root(one) for one in left)

"""A lens as numbers for kernels: projection and Brown's distortion, both ways, and their limits.

The formulas are those of `pcfix.model.Lens`, used only where they are one to one: a direction
beyond the fold of the distortion has no place in the image, and a place beyond the image of the
fold no direction. Both are NaN.

For the kernels a lens is a flat array of numbers, see `coefficients`; several lenses, padded with
zeros, are the rows of a table.

In Brown's formula, places are relative to the centre of distortion. It is used inside a disc in
which the symmetric part of its Jacobian is positive definite: on a disc that is enough for no two
places to have the same image. Without tangential terms it is the disc up to the fold, where
d r' / d r = 0.
"""

from functools import lru_cache
from typing import TypeAlias, get_args

import numpy as np
from numpy.polynomial import Polynomial

from pcfix.kernels import device, kernel
from pcfix.model import FloatArray, IntArray, Lens, Projection

# The projection as a number, and its limits: radians, and the radius in its plane.
KIND, LARGEST_ANGLE, LARGEST_RADIUS = range(3)

TANGENTIAL, THIN_PRISM = 3, 7
# `DISC` is the radius about the centre of distortion up to which Brown's formula is used.
IN_TURN, INVERSE, CENTRE_X, CENTRE_Y, DISC = range(11, 16)

FOCAL_X, B2, B3, FOCAL_Y, PRINCIPAL_X, PRINCIPAL_Y, WIDTH, HEIGHT = range(16, 24)

PLAIN = 24  # whether the lens is the common one: perspective with Brown's k1 to k4, p1 and p2 only

# Number of each; k1 is at `TAIL`, the others follow, the first shape number at `SHAPE`.
RADIALS, DENOMINATORS, SHAPES, SHAPE, TAIL = range(25, 30)

# Zeros are added up to these numbers, so that the first few can be read unconditionally.
LEAST_RADIALS, LEAST_SHAPES = 4, 2

CODES: dict[str, int] = {name: i for i, name in enumerate(get_args(Projection))}
PERSPECTIVE, EQUIDISTANT, EQUISOLID, POLYNOMIAL, FOV, DUAL, DIVISION, EUCM = CODES.values()

RIGHT_ANGLE = 0.5 * np.pi


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
    # parts of variable length come last
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


# Derivatives of two numbers by three others: a_x, a_y, a_z, b_x, b_y, b_z.
Gradients: TypeAlias = tuple[float, float, float, float, float, float]

_NOWHERE = (np.nan,) * 6


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
    # rho / q and its derivative by q over q; on the axis rho = slope q / z, and it does not turn
    scale = rho / np.sqrt(q2) if q2 > 0.0 else slope / z
    turn = (slope * z / r2 - scale) / q2 if q2 > 0.0 else 0.0
    away = -slope / r2
    cross = turn * x * y
    return (
        scale * x,
        scale * y,
        (scale + turn * x * x, cross, away * x, cross, scale + turn * y * y, away * y),
    )


def largest_angle(lens: Lens) -> float:
    """Return the angle up to which the radius of the projection grows, radians."""
    s0, s1 = (*lens.shape, 0.0, 0.0)[:2]
    match lens.projection:
        case "equidistant" | "equisolid":
            return np.pi
        case "polynomial":  # up to where it turns back
            slope = Polynomial(lens.shape or (0.0,)).deriv()
            if slope(0.0) <= 0.0:
                return 0.0
            return RIGHT_ANGLE * min(2.0, first_root(slope))
        case "dual" if s0 == 0.0:
            return np.pi
        case "dual" if s0 < 0.0:  # slope 1 + s0 tan^2 = 0
            return float(np.arctan(np.sqrt(-1.0 / s0)))
        case "division" if s0 < 0.0:
            return np.pi
        case "division" if s0 > 0.0:  # rho / (1 + s0 rho^2) is largest at s0 rho^2 = 1
            return float(np.arctan(0.5 / np.sqrt(s0)))
        case "fov" if abs(s0) >= np.pi:
            return 0.0
        case "eucm" if s0 > 0.0:  # z > -w sqrt(s1 (x^2 + y^2) + z^2) (Usenko et al. 2018)
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
def radius(c: FloatArray, theta: float) -> tuple[float, float]:
    """Return the radius in the plane of a direction at an angle from the axis, and its slope."""
    kind, first = int(c[KIND]), int(c[SHAPE])
    s0, s1 = c[first], c[first + 1]
    if kind == EQUIDISTANT or (kind == DUAL and s0 == 0.0):
        return theta, 1.0
    if kind == EQUISOLID:
        return 2.0 * np.sin(0.5 * theta), np.cos(0.5 * theta)
    if kind == POLYNOMIAL:  # Pix4D's, in which a right angle counts as 1
        q, rho, slope = theta / RIGHT_ANGLE, 0.0, 0.0
        for i in range(first + int(c[SHAPES]) - 1, first - 1, -1):
            slope = slope * q + rho
            rho = rho * q + c[i]
        return rho, slope / RIGHT_ANGLE
    sine, cosine, tangent = np.sin(theta), np.cos(theta), np.tan(theta)
    if kind == FOV and s0 != 0.0:  # tan(s0 rho) = 2 tan(s0 / 2) tan theta
        twice = 2.0 * np.tan(0.5 * s0)
        slope = twice / (s0 * (cosine * cosine + twice * twice * sine * sine))
        return np.arctan(twice * tangent) / s0, slope
    if kind == DUAL:  # the weighted mean of perspective and equidistant
        return s0 * tangent + (1.0 - s0) * theta, 1.0 + s0 * tangent * tangent
    if kind == DIVISION:  # tan theta = rho / (1 + s0 rho^2), a quadratic equation in rho
        root = np.sqrt(max(cosine * cosine - 4.0 * s0 * sine * sine, 0.0))
        rho = (cosine - root) / (2.0 * s0 * sine) if cosine < 0.0 else 2.0 * sine / (cosine + root)
        # the same as rho cos = (1 + s0 rho^2) sin, differentiated; safe beyond a right angle
        above = (1.0 + s0 * rho * rho) * cosine + rho * sine
        return rho, above / (cosine - 2.0 * s0 * rho * sine)
    if kind == EUCM:  # rho = sin / (s0 sqrt(s1 sin^2 + cos^2) + (1 - s0) cos)
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
    if rho < radius(c, low)[0]:  # a polynomial may begin above zero
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
    # the radial terms: g = r' / r, and twice its derivative by r^2 (quotient rule)
    r2, k = x * x + y * y, int(c[RADIALS])
    above, slope = _series(c, TAIL, k, r2)
    below, below_slope = _series(c, TAIL + k, int(c[DENOMINATORS]), r2)
    g = above / below
    twice = 2.0 * ((slope - g * below_slope) / below)
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
        return u, v
    scale = min(1.0, 0.9 * c[DISC] / rho)  # the start
    x, y = scale * u, scale * v
    fx, fy, (a, b, d, e) = distorted(c, x, y)
    fx, fy = fx - u, fy - v
    for _ in range(100):
        if fx * fx + fy * fy <= (2e-16 * (1.0 + rho)) ** 2:
            break
        det = a * e - b * d  # positive in the disc
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

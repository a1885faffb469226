"""How the place in the image moves with the direction that is imaged: derivatives of a lens.

The formulas are those of `pcfix.model.Lens`, in the same three steps: projection, Brown's
distortion, image. The chain rule joins them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numba import njit

from pcfix.lens import places
from pcfix.lens.brown import distorted, jacobian, undistorted
from pcfix.lens.projections import CODES, RIGHT_ANGLE, radius

if TYPE_CHECKING:
    from pcfix.model import FloatArray

Gradients: TypeAlias = tuple[float, float, float, float, float, float]
"""Of two numbers by three others: a_x, a_y, a_z, b_x, b_y, b_z."""

_KIND, _SHAPE, _SHAPES, _INVERSE = places.KIND, places.SHAPE, places.SHAPES, places.INVERSE
_CENTRE_X, _CENTRE_Y, _B2, _B3 = places.CENTRE_X, places.CENTRE_Y, places.B2, places.B3
_FOCAL_X, _FOCAL_Y = places.FOCAL_X, places.FOCAL_Y
_PRINCIPAL_X, _PRINCIPAL_Y = places.PRINCIPAL_X, places.PRINCIPAL_Y
_PERSPECTIVE, _EQUIDISTANT, _EQUISOLID = (
    CODES[name] for name in ("perspective", "equidistant", "equisolid")
)
_POLYNOMIAL, _FOV, _DUAL = (CODES[name] for name in ("polynomial", "fov", "dual"))
_DIVISION, _EUCM = CODES["division"], CODES["eucm"]
_NOWHERE = (np.nan,) * 6


@njit(cache=True, error_model="numpy", nogil=True)
def image_and_gradients(
    c: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, Gradients]:
    """Return where a lens images a direction, and how that moves.

    Parameters
    ----------
    c : array
        Of `pcfix.lens.imaging.coefficients`.
    x, y, z : float
        Camera frame, any length.

    Returns
    -------
    u, v : float
        In the unit of the lens; NaN where it has no image.
    gradients : Gradients
        Of u and v by x, y, z, per unit of the direction.
    """
    px, py, (ax, ay, az, bx, by, bz) = _plane_and_gradients(c, x, y, z)
    px, py = px - c[_CENTRE_X], py - c[_CENTRE_Y]
    if c[_INVERSE] != 0.0:
        dx, dy = undistorted(c, px, py)
        xx, xy, yx, yy = jacobian(c, dx, dy)
        det = xx * yy - xy * yx
        xx, xy, yx, yy = yy / det, -xy / det, -yx / det, xx / det
    else:
        dx, dy = distorted(c, px, py)
        xx, xy, yx, yy = jacobian(c, px, py)
    dx, dy = dx + c[_CENTRE_X], dy + c[_CENTRE_Y]
    fx, fy, b2, b3 = c[_FOCAL_X], c[_FOCAL_Y], c[_B2], c[_B3]
    ua, ub = fx * xx + b2 * yx, fx * xy + b2 * yy
    va, vb = fy * yx + b3 * xx, fy * yy + b3 * xy
    return (
        c[_PRINCIPAL_X] + fx * dx + b2 * dy,
        c[_PRINCIPAL_Y] + fy * dy + b3 * dx,
        (
            ua * ax + ub * bx, ua * ay + ub * by, ua * az + ub * bz,
            va * ax + vb * bx, va * ay + vb * by, va * az + vb * bz,
        ),
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _plane_and_gradients(
    c: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, Gradients]:
    """Return the plane coordinates of a direction before distortion, and their gradients.

    With the radius rho(theta), q^2 = x^2 + y^2 and r^2 = q^2 + z^2 they are (rho / q) (x, y),
    and theta = atan2(q, z) has the gradient (z / r^2) by q and (-q / r^2) by z.
    """
    if c[_KIND] == _PERSPECTIVE:
        if not z > 0.0:
            return np.nan, np.nan, _NOWHERE
        px, py = x / z, y / z
        return px, py, (1.0 / z, 0.0, -px / z, 0.0, 1.0 / z, -py / z)
    q2 = x * x + y * y
    r2 = q2 + z * z
    theta = np.arctan2(np.sqrt(q2), z)
    if not (theta <= c[places.LARGEST_ANGLE] and (q2 > 0.0 or z > 0.0)):
        return np.nan, np.nan, _NOWHERE
    rho = radius(c, theta)
    slope = _radius_slope(c, theta, rho)
    scale = rho / np.sqrt(q2) if q2 > 0.0 else slope / z
    turn = (slope * z / r2 - scale) / q2 if q2 > 0.0 else 0.0
    away = -slope / r2
    cross = turn * x * y
    return (
        scale * x,
        scale * y,
        (scale + turn * x * x, cross, away * x, cross, scale + turn * y * y, away * y),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _radius_slope(c: FloatArray, theta: float, rho: float) -> float:
    """Return d rho / d theta of `pcfix.lens.projections.radius`."""
    kind = int(c[_KIND])
    s0, s1 = c[int(c[_SHAPE])], c[int(c[_SHAPE]) + 1]
    sine, cosine = np.sin(theta), np.cos(theta)
    if kind == _EQUIDISTANT:
        return 1.0
    if kind == _EQUISOLID:
        return np.cos(0.5 * theta)
    if kind == _POLYNOMIAL:
        return _polynomial_slope(c, theta)
    if kind == _FOV and s0 != 0.0:
        twice = 2.0 * np.tan(0.5 * s0)
        return twice / (s0 * (cosine * cosine + twice * twice * sine * sine))
    if kind == _DUAL:
        return 1.0 if s0 == 0.0 else s0 / (cosine * cosine) + 1.0 - s0
    if kind == _DIVISION:
        # rho cos = (1 + s0 rho^2) sin, differentiated; safe beyond a right angle
        above = (1.0 + s0 * rho * rho) * cosine + rho * sine
        return above / (cosine - 2.0 * s0 * rho * sine)
    if kind == _EUCM:
        d = np.sqrt(s1 * sine * sine + cosine * cosine)
        below = s0 * d + (1.0 - s0) * cosine
        below_slope = s0 * (s1 - 1.0) * sine * cosine / d - (1.0 - s0) * sine
        return (cosine - rho * below_slope) / below
    return 1.0 / (cosine * cosine)


@njit(cache=True, error_model="numpy", nogil=True)
def _polynomial_slope(c: FloatArray, theta: float) -> float:
    """Return the slope of Pix4D's polynomial, in which a right angle counts as 1."""
    q, slope = theta / RIGHT_ANGLE, 0.0
    for i in range(int(c[_SHAPES]) - 1, 0, -1):
        slope = slope * q + i * c[int(c[_SHAPE]) + i]
    return slope / RIGHT_ANGLE

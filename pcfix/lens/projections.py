"""The angle from a lens's axis and the distance from the centre of its plane, both ways.

The table of `pcfix.model.Lens` says which is which. The kernels take the flat coefficients of
`pcfix.lens.imaging.coefficients`; `angle` answers NaN beyond the image of the largest angle.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, get_args

import numpy as np
from numba import njit
from numpy.polynomial import Polynomial

from pcfix.lens.places import KIND, LARGEST_ANGLE, LARGEST_RADIUS, SHAPE, SHAPES
from pcfix.model import Projection

if TYPE_CHECKING:
    from pcfix.model import FloatArray, Lens

CODES: dict[str, int] = {name: i for i, name in enumerate(get_args(Projection))}
_PERSPECTIVE, _EQUIDISTANT, _EQUISOLID = (
    CODES[name] for name in ("perspective", "equidistant", "equisolid")
)
_POLYNOMIAL, _FOV, _DUAL = (CODES[name] for name in ("polynomial", "fov", "dual"))
_DIVISION, _EUCM = CODES["division"], CODES["eucm"]

RIGHT_ANGLE = 0.5 * np.pi


def largest_angle(lens: Lens) -> float:
    """Return the angle up to which the projection goes outwards, radians."""
    s0, s1 = (*lens.shape, 0.0, 0.0)[:2]
    match lens.projection:
        case "equidistant" | "equisolid":
            return np.pi
        case "polynomial":
            return _end_of_polynomial(lens.shape)
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


def largest_radius(c: FloatArray) -> float:
    """Return the distance from the centre of the largest angle; may be infinite."""
    rho = float(radius(c, c[LARGEST_ANGLE]))
    return rho if rho >= 0.0 else np.inf  # a tangent or a quotient beyond its pole by rounding


def _end_of_polynomial(shape: tuple[float, ...]) -> float:
    slope = Polynomial(shape or (0.0,)).deriv()
    if slope(0.0) <= 0.0:
        return 0.0
    return RIGHT_ANGLE * min(2.0, first_root(slope))


def first_root(polynomial: Polynomial) -> float:
    """Return the smallest positive real root; infinite where there is none.

    Found as the largest root of the polynomial in 1 / x, as the lowest coefficient is never
    small while the highest may be next to nothing.
    """
    roots = np.asarray(Polynomial(polynomial.coef[::-1]).roots(), complex)
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 1e-300)]
    return 1.0 / float(real.max()) if real.size else np.inf


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _shape(c: FloatArray, i: int) -> float:
    return c[int(c[SHAPE]) + i]


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def radius(c: FloatArray, theta: float) -> float:
    """Return the distance from the centre of the plane of a direction at an angle."""
    kind, s0, s1 = int(c[KIND]), _shape(c, 0), _shape(c, 1)
    if kind == _EQUIDISTANT:
        return theta
    if kind == _EQUISOLID:
        return 2.0 * np.sin(0.5 * theta)
    if kind == _POLYNOMIAL:
        return _polynomial(c, theta)[0]
    if kind == _FOV and s0 != 0.0:
        return np.arctan(2.0 * np.tan(0.5 * s0) * np.tan(theta)) / s0
    if kind == _DUAL:
        return _dual(s0, theta)[0]
    sine, cosine = np.sin(theta), np.cos(theta)
    if kind == _DIVISION:
        root = np.sqrt(max(cosine * cosine - 4.0 * s0 * sine * sine, 0.0))
        if cosine < 0.0:
            return (cosine - root) / (2.0 * s0 * sine)
        return 2.0 * sine / (cosine + root)
    if kind == _EUCM:
        d = np.sqrt(s1 * sine * sine + cosine * cosine)
        return sine / (s0 * d + (1.0 - s0) * cosine)
    return np.tan(theta)


@njit(cache=True, error_model="numpy", nogil=True)
def angle(c: FloatArray, rho: float) -> float:
    """Return the angle from the axis of a place in the plane; undoes `radius`."""
    if not rho <= c[LARGEST_RADIUS]:
        return np.nan
    kind, s0, s1 = int(c[KIND]), _shape(c, 0), _shape(c, 1)
    if kind == _EQUIDISTANT:
        return rho
    if kind == _EQUISOLID:
        return 2.0 * np.arcsin(0.5 * rho)
    if kind in (_POLYNOMIAL, _DUAL):
        return _search(c, rho)
    if kind == _FOV and s0 != 0.0:
        return np.arctan(np.tan(rho * s0) / (2.0 * np.tan(0.5 * s0)))
    if kind == _DIVISION:
        return np.arctan2(rho, 1.0 + s0 * rho * rho)
    if kind == _EUCM:
        q = s1 * rho * rho
        root = np.sqrt(max(1.0 - (2.0 * s0 - 1.0) * q, 0.0))
        up = (1.0 - s0 * s0 * q) / (s0 * root + 1.0 - s0)
        return np.arctan2(rho, up)
    return np.arctan(rho)


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _polynomial(c: FloatArray, theta: float) -> tuple[float, float]:
    """Return Pix4D's polynomial and its slope."""
    q = theta / RIGHT_ANGLE
    value, slope = 0.0, 0.0
    for i in range(int(c[SHAPES]) - 1, -1, -1):
        slope = slope * q + value
        value = value * q + _shape(c, i)
    return value, slope / RIGHT_ANGLE


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _dual(share: float, theta: float) -> tuple[float, float]:
    """Return the mean of perspective and equidistant, and its slope."""
    if share == 0.0:
        return theta, 1.0
    tangent = np.tan(theta)
    return share * tangent + (1.0 - share) * theta, 1.0 + share * tangent * tangent


@njit(cache=True, error_model="numpy", nogil=True)
def _search(c: FloatArray, rho: float) -> float:
    """Solve radius(theta) = rho by Newton's steps, halving the bracket where they leave it."""
    low, high = 0.0, c[LARGEST_ANGLE]
    if rho < radius(c, low):
        return np.nan
    theta = 0.5 * high
    for _ in range(100):
        if c[KIND] == _DUAL:
            value, slope = _dual(_shape(c, 0), theta)
        else:
            value, slope = _polynomial(c, theta)
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

"""The distortion formulas of MicMac, from ideal to observed image position, in pixels.

Each takes and gives positions of shape (n, 2). `params` and `states` are those of the XML.
References: M. Pierrot-Deseilligny, MicMac documentation, "Distortion models"; for the parameters'
order the class templates in src/photogram of https://github.com/micmacIGN/micmac.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pcfix.model import FloatArray


def radial(xy: FloatArray, centre: Sequence[float], coefficients: Sequence[float]) -> FloatArray:
    """Return positions moved along their radius d from the centre by d (k1 d^2 + k2 d^4 + ...)."""
    away = xy - np.asarray(centre)
    r2 = np.einsum("ij,ij->i", away, away)
    return np.asarray(xy + away * _series(r2, coefficients)[:, None])


def fraser(
    xy: FloatArray,
    centre: Sequence[float],
    coefficients: Sequence[float],
    p1: float,
    p2: float,
    b1: float,
    b2: float,
) -> FloatArray:
    """Return the radial model with decentring p1, p2 and, in x alone, affinity b1, b2."""
    x, y = (xy - np.asarray(centre)).T
    r2 = x * x + y * y
    more_x = p1 * (2 * x * x + r2) + 2 * p2 * x * y + b1 * x + b2 * y
    more_y = p2 * (2 * y * y + r2) + 2 * p1 * x * y
    return np.asarray(radial(xy, centre, coefficients) + np.column_stack([more_x, more_y]))


def polynomial(xy: FloatArray, params: Sequence[float], states: Sequence[float]) -> FloatArray:
    """Return eModelePolyDegN: states are scale and origin; the degree follows from `params`."""
    scale, origin = states[0], np.asarray(states[1:3])
    x, y = ((xy - origin) / scale).T
    more_x, more_y = _second_degree(x, y, params)
    at, degree = 6, 3
    while at < len(params):
        terms = np.array([x ** (degree - i) * y**i for i in range(degree + 1)])
        more_x = more_x + np.asarray(params[at : at + degree + 1]) @ terms
        at += degree + 1
        more_y = more_y + np.asarray(params[at : at + degree + 1]) @ terms
        at, degree = at + degree + 1, degree + 1
    return np.asarray(xy + scale * np.column_stack([more_x, more_y]))


def radial_and_second_degree(
    xy: FloatArray, params: Sequence[float], states: Sequence[float], terms: int
) -> FloatArray:
    """Return eModeleRadFour: degree two, and `terms` radial ones about a centre of their own."""
    scale, origin = states[0], np.asarray(states[1:3])
    x, y = ((xy - origin) / scale).T
    more_x, more_y = _second_degree(x, y, params)
    dx, dy = x - params[6], y - params[7]
    along = _series(dx * dx + dy * dy, params[8 : 8 + terms])
    return xy + scale * np.column_stack([more_x + dx * along, more_y + dy * along])


def ebner(xy: FloatArray, params: Sequence[float], states: Sequence[float]) -> FloatArray:
    """Return eModeleEbner: twelve orthogonal terms; the state is the base b."""
    x, y = xy.T
    mean = states[0] ** 2 * 2.0 / 3.0
    x2, y2, p = x * x - mean, y * y - mean, params
    more_x = p[0] * x + p[1] * y - 2 * p[2] * x2 + p[3] * x * y + p[4] * y2
    more_x += p[6] * x * y2 + p[8] * y * x2 + p[10] * x2 * y2
    more_y = -p[0] * y + p[1] * x + p[2] * x * y - 2 * p[3] * y2 + p[5] * x2
    more_y += p[7] * y * x2 + p[9] * x * y2 + p[11] * x2 * y2
    return np.asarray(xy + np.column_stack([more_x, more_y]))


def brown(xy: FloatArray, params: Sequence[float], states: Sequence[float]) -> FloatArray:
    """Return eModeleDCBrown: fourteen terms; the state is the focal length."""
    x, y = xy.T
    x2, y2, p = x * x, y * y, params
    both = p[12] * x2 * y2 / states[0] + p[13] * (x2 + y2)
    more_x = p[0] * x + p[1] * y + p[2] * x * y + p[3] * y2
    more_x += p[4] * x2 * y + p[5] * x * y2 + p[6] * x2 * y2 + x * both
    more_y = p[7] * x * y + p[8] * x2 + p[9] * x2 * y + p[10] * x * y2 + p[11] * x2 * y2 + y * both
    return np.asarray(xy + np.column_stack([more_x, more_y]))


def fisheye(
    xy: FloatArray, params: Sequence[float], states: Sequence[float], kind: str
) -> FloatArray:
    """Return the fisheyes of 10 radial, 5 decentring and 5 polynomial degrees.

    The perspective position about params[0:2], over the state, is the tangent of an angle t; the
    radius becomes t (linear), 2 sin(t / 2) (equisolid) or 2 tan(t / 2) (stereographic).
    """
    scale, centre = states[0], np.asarray(params[:2])
    away = (xy - centre) / scale
    tangent = np.hypot(*away.T)
    t = np.arctan(tangent)
    radius = {"linear": t, "equisolid": 2 * np.sin(t / 2), "stereographic": 2 * np.tan(t / 2)}[kind]
    near = tangent < 1e-12
    factor = np.where(near, 1.0, radius / np.where(near, 1.0, tangent))
    x, y = (away * factor[:, None]).T
    r2 = x * x + y * y
    along = 1.0 + _series(r2, params[2:12])
    out_x = x * along + params[22] * x + params[23] * y
    out_y = y * along + params[23] * x
    for k in range(5):
        p, q, n = params[12 + 2 * k], params[13 + 2 * k], 2 * (k + 1)
        out_x = out_x + r2**k * (p * (r2 + n * x * x) + q * n * x * y)
        out_y = out_y + r2**k * (q * (r2 + n * y * y) + p * n * x * y)
    more_x, more_y = _fisheye_polynomial(x, y, params[24:])
    return centre + scale * np.column_stack([out_x + more_x, out_y + more_y])


def _fisheye_polynomial(
    x: FloatArray, y: FloatArray, params: Sequence[float]
) -> tuple[FloatArray, FloatArray]:
    """Return degrees 3 to 5, without the terms that the radial and decentring ones span."""
    left = iter(params)
    more_x, more_y = np.zeros_like(x), np.zeros_like(y)
    for degree in (3, 4, 5):
        for i in range(degree + 1):
            term = x ** (degree - i) * y**i
            if i > 0:
                more_x = more_x + next(left) * term
            if degree % 2 or i < degree:
                more_y = more_y + next(left) * term
    return more_x, more_y


def _second_degree(
    x: FloatArray, y: FloatArray, p: Sequence[float]
) -> tuple[FloatArray, FloatArray]:
    """Return the six terms of degree one and two that no focal length or rotation can make."""
    more_x = p[0] * x + p[1] * y - 2 * p[2] * x * x + p[3] * x * y + p[4] * y * y
    more_y = -p[0] * y + p[1] * x + p[2] * x * y - 2 * p[3] * y * y + p[5] * x * x
    return more_x, more_y


def _series(r2: FloatArray, coefficients: Sequence[float]) -> FloatArray:
    """Return k1 r2 + k2 r2^2 + ..."""
    return sum((k * r2 ** (i + 1) for i, k in enumerate(coefficients)), np.zeros_like(r2))

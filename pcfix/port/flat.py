r"""A flat port: two parallel planes before the camera.

Picture the projection centre, and the unit normal N of the port, towards the water. The light
crosses the layers air, glass, water, thick d, T and D along N; D belongs to the point X. The part
of X across N is s. As at the surface of a lake (`pcfix.refract.backward`) the direction at the
projection centre is

    w = N + k s

so that t = k \|s\| is the tangent of the angle of incidence in air, and with Snell's law the
sideways distances add up to \|s\|. With S(m) = sqrt(m^2 + (m^2 - 1) k^2 s.s):

    G(k) = k (d + T / S(g) + D / S(n)) - 1 = 0

G rises and bends down, so that Newton's method started at k = 1 / (d + T / g + D / n), where
G <= 0, comes to the only root from the left and needs no bracket. Nothing is divided by \|s\|.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.port.faces import bent, dot, unit

if TYPE_CHECKING:
    from pcfix.model import FloatArray
    from pcfix.port.faces import Ray, Vector

NEWTON_STEPS = 60
CLOSE = 1e-8
"""Of a step, relative; as each step squares the error, the next would be below rounding."""


@njit(cache=True, error_model="numpy", nogil=True)
def through_flat(
    normal: Vector, distance: float, thickness: float, glass: float, n: float,
    point: Vector, out: FloatArray,
) -> None:  # fmt: skip
    """Find the direction of a point behind a flat port, as `pcfix.port.light.through_port`.

    Of G(k, D, s.s, n) = 0, implicitly, with grad D = N and grad s.s = 2 s.
    """
    along = normal[0] * point[0] + normal[1] * point[1] + normal[2] * point[2]
    aside = (
        point[0] - along * normal[0],
        point[1] - along * normal[1],
        point[2] - along * normal[2],
    )
    aside2 = aside[0] * aside[0] + aside[1] * aside[1] + aside[2] * aside[2]
    depth = along - distance - thickness
    k = _slope(distance, thickness, depth, aside2, glass, n)
    g2, n2, t2 = glass * glass, n * n, k * k * aside2
    cube_g, root_n = np.sqrt(g2 + (g2 - 1.0) * t2) ** 3, np.sqrt(n2 + (n2 - 1.0) * t2)
    cube_n = root_n * root_n * root_n
    below = 1.0 / (distance + thickness * g2 / cube_g + depth * n2 / cube_n)
    by_depth = -below * k / root_n
    by_aside = below * k * k * k * (thickness * (g2 - 1.0) / cube_g + depth * (n2 - 1.0) / cube_n)
    by_n = below * k * depth * n * (1.0 + t2) / cube_n
    for i in range(3):
        out[i, 0], out[i, 4] = normal[i] + k * aside[i], by_n * aside[i]
        for j in range(3):
            gradient = by_depth * normal[j] + by_aside * aside[j]
            across = (1.0 if i == j else 0.0) - normal[i] * normal[j]
            out[i, 1 + j] = k * across + aside[i] * gradient


@njit(cache=True, error_model="numpy", nogil=True)
def _slope(
    distance: float, thickness: float, depth: float, aside2: float, glass: float, n: float
) -> float:
    """Solve G for k; NaN for a point that is not in the water, or out of reach of all light."""
    if not depth > 0.0:
        return np.nan
    g2, n2 = glass * glass, n * n
    a_g, a_n = (g2 - 1.0) * aside2, (n2 - 1.0) * aside2
    k = 1.0 / (distance + thickness / glass + depth / n)
    for _ in range(NEWTON_STEPS):
        k2 = k * k
        root_g, root_n = np.sqrt(g2 + a_g * k2), np.sqrt(n2 + a_n * k2)
        miss = 1.0 - k * (distance + thickness / root_g + depth / root_n)
        step = miss / (distance + thickness * g2 / root_g**3 + depth * n2 / root_n**3)
        k += step
        if abs(step) <= CLOSE * k:
            return k
    return np.nan


@njit(cache=True, error_model="numpy", nogil=True)
def ray_through_flat(
    normal: Vector, distance: float, thickness: float, glass: float, n: float, direction: Vector
) -> Ray:
    """Return the ray behind a flat port, as `pcfix.port.light.ray_through`."""
    s = unit(direction)
    steep = dot(normal, s)
    inside = bent(s, normal, 1.0 / glass)
    if not steep > 0.0:
        inside = (np.nan, np.nan, np.nan)
    f, h = distance / steep, thickness / dot(normal, inside)
    t = bent(inside, normal, glass / n)
    return (
        f * s[0] + h * inside[0], f * s[1] + h * inside[1], f * s[2] + h * inside[2],
        t[0], t[1], t[2],
    )  # fmt: skip

"""The slow twin of the backward tracers: brentq on planes, Fermat's principle on any surface."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq, minimize

from pcfix.model import FloatArray


def through_plane(
    point: FloatArray, centre: FloatArray, plane: tuple[float, float, float], n: float
) -> FloatArray:
    """Return where light from a point leaves the water plane z = a + b x + c y (metres).

    In the upright plane of the two feet the light leaves x from the camera's foot, where the
    sines of the two angles are as n to 1. Straight above the water.
    """
    a, b, c = plane
    normal = np.array([-b, -c, 1.0]) / np.sqrt(1.0 + b * b + c * c)
    at_origin = np.array([0.0, 0.0, a])
    height, depth = normal @ (centre - at_origin), normal @ (at_origin - point)
    foot = centre - height * normal
    aside = point + depth * normal - foot
    r = np.linalg.norm(aside)
    if depth <= 0.0:
        return foot + aside * height / (height + depth)
    if r < 1e-12:
        return foot

    def snell(x: float) -> float:
        return float(x / np.hypot(x, height) - n * (r - x) / np.hypot(r - x, depth))

    return foot + aside / r * brentq(snell, 0.0, r, xtol=1e-15, rtol=1e-15, maxiter=500)


def through_surface(
    point: FloatArray,
    centre: FloatArray,
    height_at: Callable[[float, float], float],
    n: float,
    starts: FloatArray,
) -> FloatArray:
    """Return the piercing point of least travel time from a point under a height field.

    Parameters
    ----------
    point, centre : array, shape (3,)
        Metres.
    height_at : function of x, y
        The surface, metres.
    n : float
    starts : array, shape (m, 2)
        Plan positions from which the search goes downhill; the best end counts.
    """

    def time(xy: FloatArray) -> float:
        a = np.array([xy[0], xy[1], height_at(xy[0], xy[1])])
        return float(np.linalg.norm(a - centre) + n * np.linalg.norm(a - point))

    options = {"xatol": 1e-9, "fatol": 1e-15, "maxiter": 4000, "maxfev": 4000}
    ends = [minimize(time, s, method="Nelder-Mead", options=options) for s in starts]
    x, y = min(ends, key=lambda end: end.fun).x
    return np.array([x, y, height_at(x, y)])


def direction(piercing: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the unit direction from a projection centre to a piercing point."""
    way = piercing - centre
    return way / np.linalg.norm(way)

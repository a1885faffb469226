"""Scattershot: a shot of rays through the water, then narrower ones about the best of it.

The name is in Mulsow 2024, whose text could not be had; this is how it was read. Rays to the knots
of a grid on the surface are followed to the object point; the grid is drawn together about the
best one again and again. No start value, no derivative, no law of refraction even: the best one
is that of the least optical length (Fermat). So where a broken surface sends light along several
paths the quickest is taken, and a path may leave through a crease, which no refracted ray does.
Near the end a length is too blunt (it changes with the square of the distance), so the refracted
rays are looked at, and how near to the point they come.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.refract.tracing.forward import CLOSE_M, height_of, miss_through, travel

if TYPE_CHECKING:
    from pcfix.refract.tracing.forward import Found, Water

KNOTS = 21
"""Of the first shot, each way."""
SHOTS = 200
BLUNT_M = 1e-7
"""Half the grid at which lengths no longer tell the rays apart."""
NEIGHBOUR_M = 1e-4


@njit(cache=True, error_model="numpy", nogil=True)
def scattershot(water: Water, level: float, ex: float, ey: float, ez: float, n: float) -> Found:
    """Return where light from the origin leaves the water towards e, (x, y, shots, found).

    On calm water that is between the plan place of the point and the straight line; the first
    shot covers these and as much as the point is deep all around.
    """
    f = level / ez
    middle_x, middle_y = 0.5 * f * ex, 0.5 * f * ey
    half = level + max(abs(middle_x), abs(middle_y))
    best, x, y = np.inf, middle_x, middle_y
    apart = 2.0 * half / (KNOTS - 1)
    for i in range(KNOTS):
        for j in range(KNOTS):
            knot_x, knot_y = middle_x - half + i * apart, middle_y - half + j * apart
            length = travel(water, ex, ey, ez, knot_x, knot_y, n)
            if length < best:
                best, x, y = length, knot_x, knot_y
    x, y, shots, found = narrowed(water, ex, ey, ez, x, y, 2.0 * apart, n)
    return x, y, shots + 1, found


@njit(cache=True, error_model="numpy", nogil=True)
def narrowed(
    water: Water, ex: float, ey: float, ez: float, x: float, y: float, half: float, n: float
) -> Found:
    """Return the nearest place of least optical length, from a place and half a grid's size on.

    Found is a path that hits the point, or one through a crease, known to about 1e-6 m along it:
    the shortest one although the rays beside it miss.
    """
    x, y, first, _ = _draw_together(water, ex, ey, ez, x, y, half, BLUNT_M, n, False)
    px, py, second, miss = _draw_together(
        water, ex, ey, ez, x, y, NEIGHBOUR_M, 0.1 * CLOSE_M, n, True
    )
    if miss <= CLOSE_M:
        return px, py, first + second, True
    return x, y, first + second, _inside(water, x, y)


@njit(cache=True, error_model="numpy", nogil=True)
def _draw_together(
    water: Water, ex: float, ey: float, ez: float, x: float, y: float, half: float, end: float,
    n: float, by_miss: bool,
) -> tuple[float, float, int, float]:  # fmt: skip
    """Halve a grid of 5 x 5 about its best knot until it is small enough.

    While the best knot is on the rim the grid moves and keeps its size.
    """
    best, shots = _badness(water, ex, ey, ez, x, y, n, by_miss), 0
    while shots < SHOTS and half > end and not (by_miss and best <= CLOSE_M):
        shots += 1
        best_i, best_j = 0, 0
        for i in range(-2, 3):
            for j in range(-2, 3):
                bad = _badness(
                    water, ex, ey, ez, x + 0.5 * half * i, y + 0.5 * half * j, n, by_miss
                )
                if bad < best:
                    best, best_i, best_j = bad, i, j
        x, y = x + 0.5 * half * best_i, y + 0.5 * half * best_j
        if max(abs(best_i), abs(best_j)) < 2:
            half *= 0.5
    return x, y, shots, best


@njit(cache=True, error_model="numpy", nogil=True)
def _badness(
    water: Water, ex: float, ey: float, ez: float, x: float, y: float, n: float, by_miss: bool
) -> float:
    """Return the miss of a ray or the optical length of a path, metres; infinite without any."""
    if by_miss:
        mx, my = miss_through(water, ex, ey, ez, x, y, n)
        return np.inf if np.isnan(mx) else float(np.sqrt(mx * mx + my * my))
    return travel(water, ex, ey, ez, x, y, n)


@njit(cache=True, error_model="numpy", nogil=True)
def _inside(water: Water, x: float, y: float) -> bool:
    """Whether there is water on all sides: at an edge the shortest path means nothing."""
    for i in (-1.0, 1.0):
        for j in (-1.0, 1.0):
            if np.isnan(height_of(water, x + i * NEIGHBOUR_M, y + j * NEIGHBOUR_M)[0]):
                return False
    return True

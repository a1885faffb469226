"""MDFRT, multi-directional forward ray tracing: rays in neighbouring directions, interpolated.

The name is in Mulsow 2024, whose text could not be had; this is how it was read. A ray and two
beside it are traced forward through the water. Where the three come down to the height of the
object point gives the mapping from direction to place, linearised; it is solved for the direction
that hits the point, the rays are traced about that one and nearer to each other, and so on. It
starts with the straight line. That is Newton's method with differences instead of derivatives:
three rays a step, few steps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.refract.tracing.forward import CLOSE_M, SHORT, shoot

if TYPE_CHECKING:
    from pcfix.refract.tracing.forward import Found, Water

MAX_STEPS = 30
HALVINGS = 24
NARROW_M = 1e-6
"""The least distance of the aims: below, rounding would outdo what is left out."""


@njit(cache=True, error_model="numpy", nogil=True)
def mdfrt(water: Water, level: float, ex: float, ey: float, ez: float, n: float) -> Found:
    """Return where light from the origin leaves the water towards e, (x, y, steps, found).

    A step that makes the miss grow is halved until it is short; so is one beyond the edge of the
    water.
    """
    f = level / ez
    x, y = f * ex, f * ey
    ax, ay, mx, my = shoot(water, level, ex, ey, ez, x, y, n)
    if np.isnan(mx):
        x, y = 0.0, 0.0
        ax, ay, mx, my = shoot(water, level, ex, ey, ez, x, y, n)
    for step in range(1, MAX_STEPS + 1):
        before = mx * mx + my * my
        if not before > CLOSE_M * CLOSE_M:
            return ax, ay, step, not np.isnan(mx)
        apart = min(max(0.01 * np.sqrt(before), NARROW_M), 0.05 * level)
        _, _, xx, yx = shoot(water, level, ex, ey, ez, x + apart, y, n)
        _, _, xy, yy = shoot(water, level, ex, ey, ez, x, y + apart, n)
        xx, yx, xy, yy = xx - mx, yx - my, xy - mx, yy - my
        det = (xx * yy - xy * yx) / apart
        dx, dy = (xy * my - yy * mx) / det, (yx * mx - xx * my) / det
        size, share = np.sqrt(dx * dx + dy * dy), 1.0
        if not size < np.inf:
            return ax, ay, step, False
        for _ in range(HALVINGS):
            there = shoot(water, level, ex, ey, ez, x + share * dx, y + share * dy, n)
            less = there[2] * there[2] + there[3] * there[3] < before
            if less or (share * size < SHORT * level and not np.isnan(there[2])):
                break
            share *= 0.5
        if np.isnan(there[2]):
            return ax, ay, step, False
        x, y = x + share * dx, y + share * dy
        ax, ay, mx, my = there
    return ax, ay, MAX_STEPS, mx * mx + my * my <= CLOSE_M * CLOSE_M

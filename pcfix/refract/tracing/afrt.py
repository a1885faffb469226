"""AFRT, alternating forward ray tracing: shoot, see by how much the point is missed, aim anew.

The name is in Mulsow 2024, whose text could not be had; this is how it was read. The straight ray
to an apparent point P, at the height of the object point, is traced forward through the water and
comes out beside the object point; P is moved by as much the other way, the ray is traced again,
and so on. It starts with P in the object point. On calm water, from a height H over a depth D, this
alone would gain a factor of about (1 + H / D) / (1 - 1 / n) a step; from the second step on
Broyden's secant makes use of what the last steps did. No derivative of the surface is needed, and
one ray a step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.refract.tracing.forward import CLOSE_M, shoot

if TYPE_CHECKING:
    from pcfix.refract.tracing.forward import Found, Water

MAX_STEPS = 60


@njit(cache=True, error_model="numpy", nogil=True)
def afrt(water: Water, level: float, ex: float, ey: float, ez: float, n: float) -> Found:
    """Return where light from the origin leaves the water towards e, (x, y, steps, found).

    After a step s = -B m the good Broyden update of the inverse B is
    B + t (s'B) / (s'(s - t)), with t = -B m of the new miss. A step is at most the depth or,
    where that is more, what the straight line goes sideways in the water.
    """
    f = level / ez
    px, py, sx, sy = 0.0, 0.0, 0.0, 0.0
    bxx, bxy, byx, byy = 1.0, 0.0, 0.0, 1.0
    x, y = f * ex, f * ey
    longest = max(level, np.sqrt(x * x + y * y))
    for step in range(1, MAX_STEPS + 1):
        ax, ay, mx, my = shoot(water, level, ex, ey, ez, px + f * (ex - px), py + f * (ey - py), n)
        if np.isnan(mx):
            return x, y, step, False
        x, y = ax, ay
        if mx * mx + my * my <= CLOSE_M * CLOSE_M:
            return x, y, step, True
        tx, ty = -bxx * mx - bxy * my, -byx * mx - byy * my
        if step > 1:
            share = 1.0 / (sx * (sx - tx) + sy * (sy - ty))
            along_x, along_y = sx * bxx + sy * byx, sx * bxy + sy * byy
            bxx, bxy = bxx + share * tx * along_x, bxy + share * tx * along_y
            byx, byy = byx + share * ty * along_x, byy + share * ty * along_y
            tx, ty = -bxx * mx - bxy * my, -byx * mx - byy * my
        size = np.sqrt(tx * tx + ty * ty)
        if not size < np.inf:
            return x, y, step, False
        if size > longest:
            tx, ty = tx * longest / size, ty * longest / size
        px, py, sx, sy = px + tx, py + ty, tx, ty
    return x, y, MAX_STEPS, False

r"""Kotowski's ray tracing: Newton's method on the piercing point, by derivatives of the surface.

The idea is that of Kotowski 1988, Phototriangulation in multi-media photogrammetry: ray tracing
through refracting surfaces of any form inside the bundle, which Mulsow 2010, A flexible
multi-media bundle approach, takes up. Only the openings of both could be had; that the piercing
point is iterated from the straight line by Newton's method is how they were read, and the
equations are our own.

With the unit vectors u from the camera to A and v from A to the point, Snell's law says that
u - n v stands upright on the surface, hence on its tangents (1, 0, b) and (0, 1, c):

    g = (u_x - n v_x + b (u_z - n v_z), u_y - n v_y + c (u_z - n v_z)) = 0

g is also the gradient of the optical length by the place of A (Fermat). The third condition, A on
the surface, is kept by taking z from it. A bilinear raster has the second derivative z_xy only;
planes and facets have none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.refract.tracing.forward import CLOSE_M, SHORT, height_of

if TYPE_CHECKING:
    from pcfix.refract.tracing.forward import Found, Water
    from pcfix.water.surface import Field

MAX_STEPS = 40
HALVINGS = 24


@njit(cache=True, error_model="numpy", nogil=True)
def kotowski(water: Water, level: float, ex: float, ey: float, ez: float, n: float) -> Found:
    """Return where light from the origin leaves the water towards e, (x, y, steps, found).

    A step that makes g grow is halved until it is short; from one patch of a broken surface to the
    next g may grow on the right way. So is one beyond the edge of the water.
    """
    f = level / ez
    x, y = f * ex, f * ey
    gx, gy, hxx, hxy, hyy = _snell(water, ex, ey, ez, x, y, n)
    if np.isnan(gx):
        x, y = 0.0, 0.0
        gx, gy, hxx, hxy, hyy = _snell(water, ex, ey, ez, x, y, n)
    for step in range(1, MAX_STEPS + 1):
        det = hxx * hyy - hxy * hxy
        dx, dy = (hxy * gy - hyy * gx) / det, (hxy * gx - hxx * gy) / det
        before, size, share = gx * gx + gy * gy, np.sqrt(dx * dx + dy * dy), 1.0
        for _ in range(HALVINGS):
            gx, gy, hxx, hxy, hyy = _snell(water, ex, ey, ez, x + share * dx, y + share * dy, n)
            if gx * gx + gy * gy < before or (share * size < SHORT * level and not np.isnan(gx)):
                break
            share *= 0.5
        if np.isnan(gx):
            return x, y, step, False
        x, y = x + share * dx, y + share * dy
        if size <= CLOSE_M:
            return x, y, step, True
    return x, y, MAX_STEPS, False


@njit(cache=True, error_model="numpy", nogil=True)
def _snell(
    water: Water, ex: float, ey: float, ez: float, x: float, y: float, n: float
) -> tuple[float, float, float, float, float]:
    r"""Return g at a plan place, and its derivatives by x and y: xx, xy and yy.

    The unit vectors turn with A by (I - u u') / \|A - C\| and -(I - v v') / \|A\|.
    """
    z, b, c = height_of(water, x, y)
    twist = _twist_at(water.field, water.origin[0] + x, water.origin[1] + y)
    ux, uy, uz = x - ex, y - ey, z - ez
    air, wet = 1.0 / np.sqrt(ux * ux + uy * uy + uz * uz), 1.0 / np.sqrt(x * x + y * y + z * z)
    ux, uy, uz, vx, vy, vz = air * ux, air * uy, air * uz, -wet * x, -wet * y, -wet * z
    along_ux, along_uy = ux + b * uz, uy + c * uz
    along_vx, along_vy = vx + b * vz, vy + c * vz
    up = uz - n * vz
    both = air + n * wet
    return (
        along_ux - n * along_vx,
        along_uy - n * along_vy,
        both * (1.0 + b * b) - air * along_ux * along_ux - n * wet * along_vx * along_vx,
        both * b * c - air * along_ux * along_uy - n * wet * along_vx * along_vy + up * twist,
        both * (1.0 + c * c) - air * along_uy * along_uy - n * wet * along_vy * along_vy,
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _twist_at(field: Field | None, x: float, y: float) -> float:
    """Return the second derivative z_xy of a raster's patch at a place (world frame), 1 / m."""
    if field is not None:
        rows, columns = field.heights.shape
        u, v = (x - field.west_x) / field.cell_x, (field.north_y - y) / field.cell_y
        if not (-0.5 <= u <= columns - 0.5 and -0.5 <= v <= rows - 0.5):
            return 0.0
        column = min(max(int(np.floor(u)), 0), columns - 2)
        row = min(max(int(np.floor(v)), 0), rows - 2)
        z = field.heights
        twist = z[row + 1, column + 1] - z[row, column + 1] - z[row + 1, column] + z[row, column]
        return -float(twist) / (field.cell_x * field.cell_y)
    return 0.0

"""Where the line from the projection centre to the apparent point meets a water mesh or raster.

Starting from the plane above the point, meet it; take the plane of the surface there, meet that
one, and so on. Water is nearly flat, so this is over in one to three steps.

On a mesh the planes are the facets'; on a crease between two, where it would go to and fro, the
last of `MAX_STEPS` stands. On a raster they are the tangent planes of the bilinear surface; each
step keeps to the bracket in which the line passes the surface, and halves it where a tangent plane
leads out of it, until the line is within `CLOSE_M` of the surface. Beyond the edge of either, and
over its gaps, the last plane goes on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.water.surface import height_at, locate

if TYPE_CHECKING:
    from pcfix.water.surface import Field, Tin

MAX_STEPS = 16
MAX_HALVINGS = 64
CLOSE_M = 1e-9
"""Along the vertical: a thousand times finer than any use, and no finer than a height in doubles
allows (1e-12 m at 5000 m)."""


@njit(cache=True, error_model="numpy", nogil=True)
def pierce_mesh(
    tin: Tin, px: float, py: float, pz: float, ex: float, ey: float, ez: float, facet: int
) -> tuple[float, float, float, float]:
    """Return the fraction of e from P to the surface, and the unit normal there.

    Parameters
    ----------
    tin : Tin
    px, py, pz : float
        Apparent point, world frame.
    ex, ey, ez : float
        From it to the projection centre.
    facet : int
        The facet above the point.

    Returns
    -------
    f, nx, ny, nz : float
        The piercing point is P + f e.
    """
    f, nx, ny, nz = 0.0, 0.0, 0.0, 1.0
    for _ in range(MAX_STEPS):
        a, b, c = tin.planes[facet, 0], tin.planes[facet, 1], tin.planes[facet, 2]
        above = a + b * (px - tin.origin_x) + c * (py - tin.origin_y) - pz
        f = above / (ez - b * ex - c * ey)
        nz = 1.0 / np.sqrt(1.0 + b * b + c * c)
        nx, ny = -b * nz, -c * nz
        following = locate(tin, px + f * ex, py + f * ey)
        if following == facet or following < 0:
            break
        facet = following
    return f, nx, ny, nz


@njit(cache=True, error_model="numpy", nogil=True)
def pierce_raster(
    field: Field, px: float, py: float, pz: float, ex: float, ey: float, ez: float,
    h: float, nx: float, ny: float, nz: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Return the fraction of e from P to the surface, and the unit normal there.

    Parameters
    ----------
    field : Field
    px, py, pz : float
        Apparent point, world frame.
    ex, ey, ez : float
        From it to the projection centre.
    h, nx, ny, nz : float
        Distance of the point from the tangent plane above it, and that plane's normal.

    Returns
    -------
    f, nx, ny, nz : float
        The piercing point is P + f e.
    """
    low, high = 0.0, 1.0
    f = h / (nx * ex + ny * ey + nz * ez)
    for _ in range(MAX_HALVINGS):
        z, b, c = height_at(field, px + f * ex, py + f * ey)
        gap = z - (pz + f * ez)
        if np.isnan(gap):
            break
        nz = 1.0 / np.sqrt(1.0 + b * b + c * c)
        nx, ny = -b * nz, -c * nz
        if abs(gap) <= CLOSE_M:
            break
        if gap > 0.0:
            low = f
        else:
            high = f
        f += gap / (ez - b * ex - c * ey)
        if not low < f < high:
            f = 0.5 * (low + high)
    return f, nx, ny, nz

"""Where the line from the projection centre to the apparent point meets a water mesh.

Starting from the facet above the point, meet its plane; if that lands on another facet, meet
that one's plane, and so on. Water is nearly flat, so this is over in one to three steps; on a
crease between two facets, where it would go to and fro, the last of `MAX_STEPS` stands.
Beyond the edge of the mesh the last facet's plane goes on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.label.tin import locate

if TYPE_CHECKING:
    from pcfix.label.tin import Tin

MAX_STEPS = 16


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

"""Butler et al. 2002: where the bent rays of two cameras pass each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.model import Outcome
from pcfix.refract.literature.level import rays_of
from pcfix.refract.literature.pairs import in_pairs
from pcfix.refract.rays import line_terms, nearest_point, refracted

if TYPE_CHECKING:
    from pcfix.model import BoolArray, FloatArray, IntArray
    from pcfix.refract.bundles import Bundle
    from pcfix.refract.result import Intersection


def butler(bundle: Bundle) -> Intersection:
    """Intersect the bent rays of two cameras under level water; X, Y and Z move.

    Parameters
    ----------
    bundle : Bundle

    Returns
    -------
    Intersection
        Of the pair that `pcfix.refract.literature.pairs` chooses for each point.

    Notes
    -----
    Butler, Lane, Chandler & Porfiri (2002), "Through-water close range digital photogrammetry in
    flume and field environments", Photogrammetric Record 17(99), 419-439. The paper's text was
    not at hand, only what is said of it: the place where the line of sight of each of two cameras
    enters the water, Snell's law there, and the true point from the two bent rays. Two rays in
    space do not meet in general, and what the paper does then was not to be found out. Here the
    true point is the middle of the shortest line between them, which needs no choice between the
    rays (it is eq 11 of Skarlatos & Agrafiotis 2018 for two). Bent rays nearer to parallel than
    a tenth of a degree leave it open, and the point is not corrected.

    So it is the method snell with two cameras and level water: exact where both see the point at
    the same incidence, or both stand in one vertical plane with it. Elsewhere the straight rays
    of a pair pass each other, so that the apparent point lies on neither, and an error remains.
    """
    paired = in_pairs(bundle)
    found = np.zeros((len(bundle.xyz), 4))
    parallel = np.zeros(len(bundle.xyz), np.bool_)
    _meet(*rays_of(paired), 1.0 / bundle.settings.refractive_index, found, parallel)
    outcome = np.where(parallel, np.uint8(Outcome.PARALLEL_RAYS), paired.outcome())
    return paired.result(found[:, :3], outcome=outcome, ray_miss_m=found[:, 3])


@njit(cache=True, error_model="numpy", nogil=True)
def _meet(
    xyz: FloatArray, depth: FloatArray, centres: FloatArray, offset: FloatArray,
    start: IntArray, camera: IntArray, r: float, found: FloatArray, parallel: BoolArray,
) -> None:  # fmt: skip
    """Fill in the shift of each point with two rays, its distance from them, and if they fail."""
    for i in range(len(xyz)):
        if start[i + 1] - start[i] < 2:
            continue
        xx = xy = xz = yy = yz = bx = by = bz = s = 0.0
        for c in camera[start[i] : start[i + 1]]:
            ex, ey = centres[c, 0] - xyz[i, 0], centres[c, 1] - xyz[i, 1]
            ez = centres[c, 2] - xyz[i, 2]
            length2 = ex * ex + ey * ey + ez * ez
            share = max(depth[i] + offset[c], 0.0) / ez  # of the way up where the water is
            dx, dy, dz = -ex, -ey, -ez
            if share > 0.0:
                dx, dy, dz = refracted(ex, ey, ez, length2, 0.0, 0.0, 1.0, ez, r)
            terms = line_terms(share * ex, share * ey, share * ez, dx, dy, dz, 1.0 / length2)
            xx, xy, xz, yy, yz = (
                xx + terms[0], xy + terms[1], xz + terms[2], yy + terms[3], yz + terms[4]
            )  # fmt: skip
            bx, by, bz, s = bx + terms[5], by + terms[6], bz + terms[7], s + terms[8]
        solved, qx, qy, qz, miss, _ = nearest_point(2.0, xx, xy, xz, yy, yz, bx, by, bz, s)
        parallel[i] = not solved
        if solved:
            found[i, 0], found[i, 1], found[i, 2], found[i, 3] = qx, qy, qz, miss

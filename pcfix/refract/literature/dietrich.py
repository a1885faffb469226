"""Dietrich 2017: the depth along each camera's line of sight, and the mean over the cameras."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.model import Outcome
from pcfix.refract.literature.level import down, plumb_line_crossings, rays_of

if TYPE_CHECKING:
    from pcfix.refract.bundles import Bundle
    from pcfix.refract.result import Intersection


def dietrich(bundle: Bundle) -> Intersection:
    """Multiply the apparent depth by the mean of tan r / tan i over the cameras; only Z moves.

    Parameters
    ----------
    bundle : Bundle

    Returns
    -------
    Intersection
        Points with one ray are corrected too: a mean needs no second one, and the author's
        program does the same. The rays of a point cross its plumb line at different depths;
        `ray_miss_m` is how far they pass from the mean.

    Notes
    -----
    Dietrich (2017), "Bathymetric Structure-from-Motion", Earth Surface Processes and Landforms
    42, 355-364, as his program pyBathySfM computes it: r is the angle from the vertical of the
    line from the apparent point to the camera, sin i = sin r / n, and with the apparent depth h_a

        h = h_a tan r / tan i, averaged over all cameras with equal weight.

    The program leaves a camera exactly above the point out, as tan i is 0 there; here it counts
    with the limit, n h_a.

    Exact where all rays have the same incidence. The slanting rays fix the apparent depth more
    than the steep ones do, which a mean does not know: where incidences differ, the result is too
    shallow, by up to 1.5 % of the depth under nine nadir images (32 m apart, 80 m up) and by
    4 % for one camera overhead and one at 32 degrees.
    """
    lowered, miss = np.zeros(len(bundle.xyz)), np.zeros(len(bundle.xyz))
    n = bundle.settings.refractive_index
    plumb_line_crossings(*rays_of(bundle), n, False, lowered, miss)
    outcome = np.where(bundle.counts > 0, Outcome.CORRECTED, Outcome.NO_CAMERA).astype(np.uint8)
    return bundle.result(down(lowered), outcome=outcome, ray_miss_m=miss)

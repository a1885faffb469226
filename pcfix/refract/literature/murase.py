"""Murase et al. 2008: two cameras, two depths, and their mean weighted by cosines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.refract.literature.level import down, plumb_line_crossings, rays_of
from pcfix.refract.literature.pairs import in_pairs

if TYPE_CHECKING:
    from pcfix.refract.bundles import Bundle
    from pcfix.refract.result import Intersection


def murase(bundle: Bundle) -> Intersection:
    """Take the mean of the depths from two cameras, weighted by cosines; only Z moves.

    Parameters
    ----------
    bundle : Bundle

    Returns
    -------
    Intersection
        Of the pair that `pcfix.refract.literature.pairs` chooses for each point.

    Notes
    -----
    Murase et al. (2008), "A photogrammetric correction procedure for light refraction effects at
    a two-medium boundary", Photogrammetric Engineering & Remote Sensing 74(9), 1129-1136. The
    paper's text was not at hand, only what is said of it: a correction by Snell's law from the
    positions of the two cameras, in which cosines weigh the two. This is read as follows. Both
    bent rays cross the plumb line of the apparent point, as each lies in the vertical plane
    through that point and its camera, but in general at different depths h_1 and h_2:

        h = (h_1 cos a_1 + h_2 cos a_2) / (cos a_1 + cos a_2)

    with a_1 and a_2 the angles from the vertical in air. Whether the paper's cosines are those in
    air or in water was not to be found out; the difference is of the second order in the
    difference of the two. Nothing is singular: see `pcfix.refract.literature.level`.

    Exact where both rays have the same incidence. The weights are against geometry: a steep ray
    runs along the plumb line and says least of the depth, yet it counts most.
    """
    paired = in_pairs(bundle)
    lowered, miss = np.zeros(len(bundle.xyz)), np.zeros(len(bundle.xyz))
    n = bundle.settings.refractive_index
    plumb_line_crossings(*rays_of(paired), n, True, lowered, miss)
    return paired.result(down(lowered), ray_miss_m=miss)

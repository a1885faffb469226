"""The plain factor: true depth by apparent depth is one number everywhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.model import Outcome
from pcfix.refract.literature.level import apparent_depth, down

if TYPE_CHECKING:
    from pcfix.model import FloatArray
    from pcfix.refract.bundles import Bundle
    from pcfix.refract.result import Intersection


def factor(bundle: Bundle) -> Intersection:
    """Multiply the apparent depth by `depth_factor`, else by the refractive index; only Z moves.

    Parameters
    ----------
    bundle : Bundle

    Returns
    -------
    Intersection
        Every point is corrected, as no ray is needed; see `without_rays`.

    Notes
    -----
    With n it is the limit for cameras straight above, long in use for rivers (Westaway et al.
    2001, Woodget et al. 2015). Away from there the true depth is larger, at the angle a in air by
    (n^2 - 1) tan^2 a / (2 n^2) of it: 1.6 % at 15 degrees, 3.3 % at 21 degrees. A factor of one's
    own can take that in.
    """
    ratio = bundle.settings.depth_factor
    ratio = bundle.settings.refractive_index if ratio is None else ratio
    return without_rays(bundle, (ratio - 1.0) * apparent_depth(bundle))


def without_rays(bundle: Bundle, lowered_m: FloatArray) -> Intersection:
    """Return the result of a method that lowers points and looks at no camera.

    Parameters
    ----------
    bundle : Bundle
    lowered_m : array, shape (m,)
        How far each point goes down.

    Returns
    -------
    Intersection
        All points are corrected. `ray_count` is that of the cameras that were chosen for the
        point, but at least 1: in files a count of 0 marks a point that was not corrected.
    """
    outcome = np.full(len(bundle.xyz), Outcome.CORRECTED, np.uint8)
    found = bundle.result(down(lowered_m), outcome=outcome)
    return found._replace(ray_count=np.maximum(found.ray_count, 1))

"""What is learned of the whole cloud and block before the points are corrected."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pcfix.refract.bed import Bed
    from pcfix.refract.matcher import Matcher
    from pcfix.refract.occlusion import Occluder
    from pcfix.refract.regression import DepthRegression


class Learned(NamedTuple):
    """What methods may need beyond the points themselves; None where it was not learned.

    Attributes
    ----------
    regression : DepthRegression or None
        From check depths, for the method of that name.
    occluder : Occluder or None
        The cloud's own surface, which hides points from cameras.
    matcher : Matcher or None
        Which images were matched with which.
    bed : Bed or None
        What fused points of one place have in common.
    """

    regression: DepthRegression | None = None
    occluder: Occluder | None = None
    matcher: Matcher | None = None
    bed: Bed | None = None

"""What was found, and why it was believed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pcfix.model import FloatArray, WaterPlane


@dataclass(frozen=True, eq=False)
class EvidenceCurves:
    """What each cue gains (logarithm of a ratio of likelihoods) from water at each height.

    Attributes
    ----------
    height_m : array, shape (h,)
        World heights; of a tilted surface, those above `WaterProposal.centre_xy`.
    gain : dict of array, shape (h,)
        By the name of the cue.
    """

    height_m: FloatArray
    gain: dict[str, FloatArray]


@dataclass(frozen=True, eq=False)
class WaterProposal:
    """A water surface that a cloud suggests.

    Attributes
    ----------
    surface : WaterPlane
    sigma_level_m : float
        Standard error of its height at `centre_xy`, from drawing tiles of the cloud anew. It knows
        nothing of what deceives all of the shore alike, such as a bank that stops at the water.
    centre_xy : array, shape (2,)
        The middle of the shoreline, metres, world frame.
    level_m : float
        The height of the surface there.
    tilt : array, shape (2,)
        dz/dx and dz/dy.
    sigma_tilt : float
        Standard error of the tilt along the shore, dz per metre; NaN where it was not looked for.
    confidence : float
        0 to 1: how far the evidence is above what is refused.
    evidence : dict of str to float
        The figures, by name.
    reasons : tuple of str
        The same in sentences.
    shoreline : array, shape (m, 3)
        Places where the ground passes the surface, metres, world frame.
    curves : EvidenceCurves
    ground : array, shape (c, 3)
        The cloud thinned to cells, metres, world frame.
    """

    surface: WaterPlane
    sigma_level_m: float
    centre_xy: FloatArray
    level_m: float
    tilt: FloatArray
    sigma_tilt: float
    confidence: float
    evidence: dict[str, float]
    reasons: tuple[str, ...]
    shoreline: FloatArray
    curves: EvidenceCurves
    ground: FloatArray

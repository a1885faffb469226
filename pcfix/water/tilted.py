"""Whether a cloud shows its waterline tilted against water that was given."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.water import search
from pcfix.water.search import NO_TILT, Looked, Peak

TILTS = (-0.02, -0.015, -0.01, -0.0075, -0.005, -0.0025, 0.0025, 0.005, 0.0075, 0.01, 0.015, 0.02)
DIRECTIONS = 4
REACH_M, LEAST_APART_M = 2.0, 0.3
"""From the water that was given, in the middle of the cloud; and from end to end."""
LEAST_GAIN, MOST_LEFT, ABOUT_AS_GOOD = 100.0, 0.4, 0.9
"""Evidence of the tilted waterline, the share of it that the level one may have, and from which
another tilt is as likely: across a straight shore nothing tells it."""
_WINDS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")


class Tilted(NamedTuple):
    """A waterline that rises towards `to` by so much a metre, against the given water.

    low_m, high_m : where it is lowest and highest in the cloud, above the given water.
    """

    to: str
    slope: float
    low_m: float
    high_m: float


def find_tilt(whole: Looked) -> Tilted | None:
    """Return how the waterline of a cloud is tilted, if it is; `whole` is above the given water."""
    samples = whole.samples
    middle = np.median(samples.xyz[:, :2], axis=0)
    angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    ways = np.column_stack([np.cos(angles), np.sin(angles)])

    def best(tilt: np.ndarray) -> Peak:
        at_middle = whole.heights_m + samples.origin[2] + middle @ tilt
        gain = np.where(np.abs(at_middle) <= REACH_M, search.gains(whole, tilt), 0.0)
        row = int(np.argmax(gain))
        return Peak(float(whole.heights_m[row]), tilt, float(gain[row]))

    level = best(NO_TILT)
    peaks = [best(slope * way) for slope in sorted(TILTS, key=abs) for way in ways]
    least = ABOUT_AS_GOOD * max(one.score for one in peaks)
    peak = next(one for one in peaks if one.score >= least)  # the one that is tilted least
    if peak.score < LEAST_GAIN or level.score > MOST_LEFT * peak.score:
        return None
    shore = samples.xyz[search.near_surface(samples, peak), :2] @ peak.tilt
    heights = shore + peak.level_m + samples.origin[2]
    if len(heights) < 2 or np.ptp(heights) < LEAST_APART_M:
        return None
    slope = float(np.hypot(*peak.tilt))
    wind = round(float(np.arctan2(peak.tilt[1], peak.tilt[0])) / (np.pi / 4.0)) % len(_WINDS)
    return Tilted(_WINDS[wind], slope, float(heights.min()), float(heights.max()))

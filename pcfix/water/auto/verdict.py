"""Whether the evidence for a water surface is good enough, in figures and in words."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import GeometryError
from pcfix.water.auto.cues import BRIGHT, SLOPE
from pcfix.water.auto.layer import layer_gain
from pcfix.water.auto.moments import gain_of
from pcfix.water.auto.search import SAME_PLACE_M, gains, placing

if TYPE_CHECKING:
    from pcfix.water.auto.samples import Samples
    from pcfix.water.auto.search import Looked, Peak

LEAST_AGREED, LEAST_EACH = 12.0, 3.0
LIFTS = 0.15, 0.75
"""Change of slope that can be refraction, about 0.36, seen through bumps."""
LEAST_ALONE, LEAST_COLOUR_ALONE = 25.0, 40.0
"""Slope and layer have a size that physics gives; colours can change with height by nature too."""
LEAST_LAYER = 15.0
"""Noise piles up by chance more often than slopes and colours break at one height."""
MOST_RIVAL_AGREED, MOST_RIVAL_ALONE = 0.75, 0.5
MOST_SIGMA_M = 0.2
LEAST_SHARE = 0.005
WITNESS_SIGMAS, WITNESS_REACH_M = 3.0, 0.35
INSTEAD = "give the water surface instead: a level, shoreline points, a plane:a,b,c or a mesh"
LAYER = "floating points"


class Verdict(NamedTuple):
    """Figures and sentences about a surface that was believed."""

    confidence: float
    evidence: dict[str, float]
    reasons: tuple[str, ...]


def judge(samples: Samples, peak: Peak, near: Looked, whole: Looked, sigma_m: float) -> Verdict:
    """Weigh the evidence.

    Parameters
    ----------
    samples : Samples
    peak : Peak
        The surface.
    near, whole : Looked
        About it, with its tilt, and over all heights without one.
    sigma_m : float
        Standard error of the level.

    Raises
    ------
    GeometryError
        If the evidence is poor, contradictory, or all of the cloud is on one side of the surface.
    """
    found = _gains_at_surface(near)
    rival_m, rival = _rival(whole, peak)
    evidence = {f"{name} gain": value for name, value in found.items()}
    evidence |= {"rival gain": rival, "rival height": rival_m + float(samples.origin[2])}
    witnesses = _witnesses(near, evidence)
    evidence["total gain"] = sum(max(value, 0.0) for value in found.values())
    _refuse_one_sided(samples, peak, evidence)
    speaking = _speaking(found)
    if speaking == [SLOPE.name]:
        _refuse_other_breaks(samples, peak, near)
    needed = _needed(speaking)
    confidence = _refuse_poor(samples, peak, evidence, sigma_m, *needed)
    return Verdict(confidence, evidence, _reasons(near, found, witnesses, evidence))


def _gains_at_surface(near: Looked) -> dict[str, float]:
    """Return what each cue that fixes the level gains at the surface."""
    middle = len(near.heights_m) // 2
    found = {cue.name: float(gain_of(sums).gain[middle]) for cue, sums in placing(near)}
    found[LAYER] = float(layer_gain(near.floating, near.heights_m, near.tilt)[middle])
    return found


def _speaking(found: dict[str, float]) -> list[str]:
    """Return the cues that gain enough to count."""
    least = {LAYER: LEAST_LAYER}
    return [name for name, gain in found.items() if gain >= least.get(name, LEAST_EACH)]


def _refuse_other_breaks(samples: Samples, peak: Peak, near: Looked) -> None:
    """Refuse a break of slope that nothing confirms and that refraction does not make."""
    middle = len(near.heights_m) // 2
    sums = next(sums for cue, sums in near.cues if cue.name == SLOPE.name)
    size = float(gain_of(sums).amplitude[middle])
    if not LIFTS[0] <= size <= LIFTS[1]:
        raise GeometryError(
            "No water surface was found: the only evidence is a break of slope at"
            f" {_height(samples, peak)}, where slopes change by {1.0 + size:.2f} times and"
            f" refraction makes about 1.36: a bank or a terrace, it seems; {INSTEAD}."
        )


def _needed(speaking: list[str]) -> tuple[float, float]:
    """Return the least evidence, and the largest part of it that another height may have."""
    if len(speaking) >= 2:
        return LEAST_AGREED, MOST_RIVAL_AGREED
    coloured = any("/" in name or name == BRIGHT.name for name in speaking)
    return (LEAST_COLOUR_ALONE if coloured else LEAST_ALONE), MOST_RIVAL_ALONE


def _rival(whole: Looked, peak: Peak) -> tuple[float, float]:
    """Return the best height that is another one, and its gain."""
    total = gains(whole, peak.tilt)
    total = np.where(np.abs(whole.heights_m - peak.level_m) > SAME_PLACE_M, total, 0.0)
    row = int(np.argmax(total))
    return float(whole.heights_m[row]), float(total[row])


def _witnesses(near: Looked, evidence: dict[str, float]) -> list[str]:
    """Return the sentences of cues that only say that there is water below about here."""
    said = []
    close = np.abs(near.heights_m - near.heights_m[len(near.heights_m) // 2]) <= WITNESS_REACH_M
    for cue, sums in near.cues:
        if cue.places:
            continue
        gain = gain_of(sums)
        sigmas = float((cue.what.sign * gain.amplitude / (gain.sigma + 1e-12))[close].max())
        evidence[f"{cue.name} sigmas"] = sigmas
        if sigmas >= WITNESS_SIGMAS:
            said.append(f"{cue.words} ({sigmas:.0f} standard errors)")
    return said


def _refuse_one_sided(samples: Samples, peak: Peak, evidence: dict[str, float]) -> None:
    above_m = samples.smooth_m - samples.xyz[:, :2] @ peak.tilt - peak.level_m
    wet = float(np.mean(above_m < 0.0))
    evidence["share below"] = wet
    if not LEAST_SHARE <= wet <= 1.0 - LEAST_SHARE:
        side = "below" if wet > 0.5 else "above"
        raise GeometryError(
            f"No water surface was found: nearly all of the cloud lies {side} the best candidate,"
            f" {_height(samples, peak)}, so that there is no shoreline to see; {INSTEAD}."
        )


def _refuse_poor(
    samples: Samples,
    peak: Peak,
    evidence: dict[str, float],
    sigma_m: float,
    least: float,
    most_rival: float,
) -> float:
    """Return the confidence, or refuse."""
    total, rival = evidence["total gain"], evidence["rival gain"]
    if total < least:
        raise GeometryError(
            "No water surface was found: slopes, colours, noise and floating points were searched"
            f" for a change at one height, and the best, {_height(samples, peak)}, is too weak"
            f" (evidence {total:.0f}, {least:.0f} needed); {INSTEAD}."
        )
    if rival > most_rival * total:
        raise GeometryError(
            f"No water surface was found: the evidence is contradictory, {_height(samples, peak)}"
            f" and {evidence['rival height']:.2f} m are nearly as likely (evidence {total:.0f} and"
            f" {rival:.0f}); {INSTEAD}."
        )
    if sigma_m > MOST_SIGMA_M:
        raise GeometryError(
            f"No water surface was found: parts of the cloud disagree by {sigma_m:.2f} m about the"
            f" best candidate, {_height(samples, peak)}; {INSTEAD}."
        )
    return float(min(1.0 - rival / total, 1.0 - math.exp(-total / (2.0 * least))))


def _height(samples: Samples, peak: Peak) -> str:
    middle = samples.xyz[:, :2].mean(axis=0) @ peak.tilt
    return f"{peak.level_m + float(middle) + float(samples.origin[2]):.2f} m"


def _reasons(
    near: Looked, found: dict[str, float], witnesses: list[str], evidence: dict[str, float]
) -> tuple[str, ...]:
    said = []
    middle = len(near.heights_m) // 2
    for cue, sums in placing(near):
        gain = gain_of(sums)
        if found[cue.name] >= LEAST_EACH:
            size, sigma = float(gain.amplitude[middle]), float(gain.sigma[middle])
            evidence[f"{cue.name} amplitude"], evidence[f"{cue.name} sigma"] = size, sigma
            said.append(f"{cue.words}: {_size(cue.name, size, sigma)}")
    if found[LAYER] >= LEAST_EACH:
        said.append(f"points float in a thin layer (evidence {found[LAYER]:.0f})")
    return (*said, *witnesses)


def _size(name: str, size: float, sigma: float) -> str:
    if name == SLOPE.name:
        return f"true slopes are {1.0 + size:.2f} ± {sigma:.2f} times the apparent ones"
    return f"the logarithm of the ratio falls by {-size:.2f} ± {sigma:.2f} per metre"

"""The level, or plane, that the cues agree on best, and whether that is good enough."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcfix.errors import GeometryError
from pcfix.model import BoolArray, FloatArray
from pcfix.water.cues import BRIGHT, SLOPE, Cue, Moments, cue_moments, cues_of, gain_of
from pcfix.water.samples import Floating, Samples, layer_gain

LARGEST_TILT, USUAL_TILT = 0.006, 0.002
TILT_STEP_M, MOST_TILT_STEPS = 0.15, 9
COARSE_M, FINE_M, MOST_HEIGHTS = 0.04, 0.01, 800
FINE_REACH_M, SAME_PLACE_M = 0.6, 0.3
WATERLINE_M = 0.05
DRAWS, TILT_DRAWS, TILT_REACH = 120, 40, 6
NO_TILT = np.zeros(2)


class Looked(NamedTuple):
    """Everything that was summed up about a cloud, at heights above a tilted plane.

    cues : (cue, its sums) of those that say anything.
    floating : Floating
    heights_m : shape (h,)
    tilt : shape (2,), of the plane through the origin of the samples.
    """

    cues: list[tuple[Cue, Moments]]
    floating: Floating
    heights_m: FloatArray
    tilt: FloatArray


class Peak(NamedTuple):
    """The best surface: level_m + tilt . xy from the origin of the samples.

    score : what its cues gain, less for tilts that are not usual.
    """

    level_m: float
    tilt: FloatArray
    score: float


def look(samples: Samples, floating: Floating, heights_m: FloatArray, tilt: FloatArray) -> Looked:
    """Sum up all cues at the given heights above a tilted plane."""
    cues = [(cue, cue_moments(samples, cue, heights_m, tilt)) for cue in cues_of(samples)]
    known = [(cue, sums) for cue, sums in cues if sums is not None]
    return Looked(known, floating, heights_m, tilt)


def all_heights(samples: Samples) -> FloatArray:
    """Return heights over the range of the ground."""
    low, high = np.percentile(samples.smooth_m, [0.5, 99.5])
    count = int(np.clip((high - low) / COARSE_M, 8, MOST_HEIGHTS))
    return np.linspace(low, high, count)


def gains(looked: Looked, tilt: FloatArray, rng: np.random.Generator | None = None) -> FloatArray:
    """Return what the cues that fix the level gain in all, at each height.

    Parameters
    ----------
    looked : Looked
    tilt : array, shape (2,)
        On top of that of `looked`.
    rng : Generator, optional
        Draw the tiles and floating points anew, with replacement.
    """
    total = np.zeros(len(looked.heights_m))
    for _, sums in placing(looked):
        times = None if rng is None else _drawn(len(sums.sums), rng)
        total += np.maximum(gain_of(sums.shifted(tilt) if tilt.any() else sums, times).gain, 0.0)
    times = None if rng is None else _drawn(len(looked.floating.xyz), rng)
    return total + layer_gain(looked.floating, looked.heights_m, looked.tilt + tilt, times)


def placing(looked: Looked) -> list[tuple[Cue, Moments]]:
    """Return the cues that fix the level; of the colours the one that says more."""
    fixing = [(cue, sums) for cue, sums in looked.cues if cue.places]
    light = [pair for pair in fixing if "/" in pair[0].name]
    if len(light) < 2:
        return fixing
    weaker = min(light, key=lambda pair: float(gain_of(pair[1]).gain.max()))
    return [pair for pair in fixing if pair is not weaker]


def _drawn(count: int, rng: np.random.Generator) -> FloatArray:
    return np.bincount(rng.integers(0, max(count, 1), count), minlength=count).astype(float)


def best(looked: Looked, tilts: FloatArray) -> Peak:
    """Return the best height and tilt among those given, shape (k, 2)."""
    found = [_best_height(looked, tilt) for tilt in tilts]
    return max(found, key=lambda peak: peak.score)


def _best_height(looked: Looked, tilt: FloatArray) -> Peak:
    total = gains(looked, tilt)
    row = int(np.argmax(total))
    whole = looked.tilt + tilt
    usual = 0.5 * float(whole @ whole) / USUAL_TILT**2
    return Peak(float(looked.heights_m[row]), whole, float(total[row]) - usual)


def axis_of(samples: Samples, peak: Peak) -> FloatArray:
    """Return the direction in which the waterline runs, shape (2,).

    Water that stands is level, and water that flows is level across: only along it may it fall.
    """
    xy = samples.xyz[near_surface(samples, peak), :2]
    if len(xy) < 3:
        xy = samples.xyz[:, :2]
    return np.asarray(np.linalg.svd(xy - xy.mean(axis=0), full_matrices=False)[2][0])


def near_surface(samples: Samples, peak: Peak) -> BoolArray:
    """Return which cells are as high as the water, shape (m,)."""
    above_m = samples.smooth_m - samples.xyz[:, :2] @ peak.tilt - peak.level_m
    return np.asarray(np.abs(above_m) <= WATERLINE_M)


def tilts_along(axis: FloatArray, step: float, steps: int) -> FloatArray:
    """Return tilts along an axis, the level one first, shape (2 steps + 1, 2)."""
    up_and_down = np.arange(-steps, steps + 1)
    return (up_and_down[np.argsort(np.abs(up_and_down), kind="stable")] * step)[:, None] * axis


def tilt_step(samples: Samples) -> float:
    """Return the step of tilt that is searched: so much over the extent of the cloud."""
    extent = float(np.ptp(samples.xyz[:, :2], axis=0).max())
    return max(TILT_STEP_M / extent, LARGEST_TILT / MOST_TILT_STEPS)


def refine(
    samples: Samples, floating: Floating, start: Peak, axis: FloatArray | None
) -> tuple[Peak, Looked]:
    """Look again near a surface, in fine steps of height and, along an axis, of tilt."""
    peak, step = start, tilt_step(samples)
    reach = np.arange(-FINE_REACH_M, FINE_REACH_M + FINE_M / 2.0, FINE_M)
    for _ in range(3 if axis is not None else 1):
        looked = look(samples, floating, peak.level_m + reach, peak.tilt)
        step /= 2.0
        tilts = NO_TILT[None] if axis is None else tilts_along(axis, step, 2)
        peak = best(looked, tilts)
    return peak, look(samples, floating, peak.level_m + reach, peak.tilt)


def drawn(looked: Looked, axis: FloatArray | None, step: float) -> tuple[FloatArray, FloatArray]:
    """Return what draws of the tiles with replacement give beside the surface found.

    Returns
    -------
    level_m : array, shape (`DRAWS`,)
        With the tilt that was found.
    tilt : array, shape (`TILT_DRAWS`,)
        Along the axis, beside the one found; empty without an axis.
    """
    rng = np.random.default_rng(0)
    heights = looked.heights_m - looked.heights_m[len(looked.heights_m) // 2]
    near = np.abs(heights) <= SAME_PLACE_M
    draws = [gains(looked, NO_TILT, rng)[near] for _ in range(DRAWS)]
    level = np.array([heights[near][int(np.argmax(draw))] for draw in draws])
    if axis is None:
        return level, np.empty(0)
    tilts = tilts_along(axis, step / 2.0, TILT_REACH)
    tilt = [_drawn_tilt(looked, tilts, near, seed) for seed in range(TILT_DRAWS)]
    return level, np.array(tilt) @ axis


def _drawn_tilt(looked: Looked, tilts: FloatArray, near: BoolArray, seed: int) -> FloatArray:
    """Return the best of the tilts for one draw of the tiles, the same for all tilts."""
    tops = [gains(looked, tilt, np.random.default_rng(seed))[near].max() for tilt in tilts]
    return np.asarray(tilts[int(np.argmax(tops))])


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
    sentences = []
    close = np.abs(near.heights_m - near.heights_m[len(near.heights_m) // 2]) <= WITNESS_REACH_M
    for cue, sums in near.cues:
        if cue.places:
            continue
        gain = gain_of(sums)
        sigmas = float((cue.what.sign * gain.amplitude / (gain.sigma + 1e-12))[close].max())
        evidence[f"{cue.name} sigmas"] = sigmas
        if sigmas >= WITNESS_SIGMAS:
            sentences.append(f"{cue.meaning} ({sigmas:.0f} standard errors)")
    return sentences


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
    sentences = []
    middle = len(near.heights_m) // 2
    for cue, sums in placing(near):
        gain = gain_of(sums)
        if found[cue.name] >= LEAST_EACH:
            size, sigma = float(gain.amplitude[middle]), float(gain.sigma[middle])
            evidence[f"{cue.name} amplitude"], evidence[f"{cue.name} sigma"] = size, sigma
            sentences.append(f"{cue.meaning}: {_size(cue.name, size, sigma)}")
    if found[LAYER] >= LEAST_EACH:
        sentences.append(f"points float in a thin layer (evidence {found[LAYER]:.0f})")
    return (*sentences, *witnesses)


def _size(name: str, size: float, sigma: float) -> str:
    if name == SLOPE.name:
        return f"true slopes are {1.0 + size:.2f} ± {sigma:.2f} times the apparent ones"
    return f"the logarithm of the ratio falls by {-size:.2f} ± {sigma:.2f} per metre"

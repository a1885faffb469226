"""The level, or plane, that the cues agree on best, and whether that is good enough."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcfix.errors import GeometryError
from pcfix.model import BoolArray, FloatArray
from pcfix.water.cues import BRIGHT, SLOPE, Cue, Gain, Moments, cue_moments, cues_of, gain_of
from pcfix.water.samples import Samples, layer_gain

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
    samples : Samples
    heights_m : shape (h,)
    tilt : shape (2,), of the plane through the origin of the samples.
    """

    cues: list[tuple[Cue, Moments]]
    samples: Samples
    heights_m: FloatArray
    tilt: FloatArray


class Peak(NamedTuple):
    """The best surface: level_m + tilt . xy from the origin of the samples.

    score : what its cues gain, less for tilts that are not usual.
    """

    level_m: float
    tilt: FloatArray
    score: float


def look(samples: Samples, heights_m: FloatArray, tilt: FloatArray) -> Looked:
    """Sum up all cues at the given heights above a tilted plane."""
    cues = [(cue, cue_moments(samples, cue, heights_m, tilt)) for cue in cues_of(samples)]
    known = [(cue, sums) for cue, sums in cues if sums is not None]
    return Looked(known, samples, heights_m, tilt)


def all_heights(samples: Samples) -> FloatArray:
    """Return heights over the range of the ground."""
    low, high = np.percentile(samples.smooth_m, [0.5, 99.5])
    count = int(np.clip((high - low) / COARSE_M, 8, MOST_HEIGHTS))
    return np.linspace(low, high, count)


def gains(looked: Looked, tilt: FloatArray, rng: np.random.Generator | None = None) -> FloatArray:
    """Return what the cues that fix the level gain in all, at each height, shape (h,).

    `tilt`, shape (2,), comes on top of that of `looked`. With `rng` tiles and floating points are
    drawn anew, with replacement.
    """
    total = np.zeros(len(looked.heights_m))
    for _, sums in placing(looked):
        times = None if rng is None else _drawn(len(sums.sums), rng)
        total += np.maximum(gain_of(sums.shifted(tilt) if tilt.any() else sums, times).gain, 0.0)
    times = None if rng is None else _drawn(len(looked.samples.tile), rng)
    return total + layer_gain(looked.samples, looked.heights_m, looked.tilt + tilt, times)


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
    found = []
    for tilt in tilts:
        total, whole = gains(looked, tilt), looked.tilt + tilt
        row = int(np.argmax(total))
        unusual = 0.5 * float(whole @ whole) / USUAL_TILT**2
        found.append(Peak(float(looked.heights_m[row]), whole, float(total[row]) - unusual))
    return max(found, key=lambda peak: peak.score)


def axis_of(samples: Samples, peak: Peak) -> FloatArray:
    """Return the direction in which the waterline runs, shape (2,).

    Water that stands is level, and water that flows is level across: only along it may it fall.
    """
    xy = samples.xyz[near_surface(samples, peak), :2]
    if len(xy) < 3:
        xy = samples.xyz[:, :2]
    return np.asarray(np.linalg.svd(xy - xy.mean(axis=0), full_matrices=False)[2][0])


def heights_above(samples: Samples, peak: Peak) -> FloatArray:
    """Return how high the smooth ground of the cells lies above the water, shape (m,)."""
    return np.asarray(samples.smooth_m - samples.xyz[:, :2] @ peak.tilt - peak.level_m)


def near_surface(samples: Samples, peak: Peak) -> BoolArray:
    """Return which cells are as high as the water, shape (m,)."""
    return np.asarray(np.abs(heights_above(samples, peak)) <= WATERLINE_M)


def tilts_along(axis: FloatArray, step: float, steps: int) -> FloatArray:
    """Return tilts along an axis, the level one first, shape (2 steps + 1, 2)."""
    up_and_down = np.arange(-steps, steps + 1)
    return (up_and_down[np.argsort(np.abs(up_and_down), kind="stable")] * step)[:, None] * axis


def tilt_step(samples: Samples) -> float:
    """Return the step of tilt that is searched: so much over the extent of the cloud."""
    extent = float(np.ptp(samples.xyz[:, :2], axis=0).max())
    return max(TILT_STEP_M / extent, LARGEST_TILT / MOST_TILT_STEPS)


def refine(samples: Samples, start: Peak, axis: FloatArray | None) -> tuple[Peak, Looked]:
    """Look again near a surface, in fine steps of height and, along an axis, of tilt."""
    peak, step = start, tilt_step(samples)
    reach = np.arange(-FINE_REACH_M, FINE_REACH_M + FINE_M / 2.0, FINE_M)
    for _ in range(3 if axis is not None else 1):
        looked = look(samples, peak.level_m + reach, peak.tilt)
        step /= 2.0
        tilts = NO_TILT[None] if axis is None else tilts_along(axis, step, 2)
        peak = best(looked, tilts)
    return peak, look(samples, peak.level_m + reach, peak.tilt)


def drawn(looked: Looked, axis: FloatArray | None, step: float) -> tuple[FloatArray, FloatArray]:
    """Return what draws of the tiles with replacement give beside the surface found.

    Levels with the tilt that was found, shape (`DRAWS`,), metres, and tilts along the axis, shape
    (`TILT_DRAWS`,), none without an axis.
    """
    rng = np.random.default_rng(0)
    heights = looked.heights_m - looked.heights_m[len(looked.heights_m) // 2]
    near = np.abs(heights) <= SAME_PLACE_M
    draws = [gains(looked, NO_TILT, rng)[near] for _ in range(DRAWS)]
    level = np.array([heights[near][int(np.argmax(draw))] for draw in draws])
    if axis is None:
        return level, np.empty(0)
    tilts = tilts_along(axis, step / 2.0, TILT_REACH)
    tops = [  # a draw of the tiles is the same for all tilts
        [gains(looked, tilt, np.random.default_rng(seed))[near].max() for tilt in tilts]
        for seed in range(TILT_DRAWS)
    ]
    return level, tilts[np.argmax(tops, axis=1)] @ axis


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


def judge(
    samples: Samples, peak: Peak, near: Looked, whole: Looked, sigma_m: float
) -> tuple[float, dict[str, float], tuple[str, ...]]:
    """Return the confidence in a surface, the figures of its evidence, and sentences about it.

    `near` is what was seen about it, with its tilt, and `whole` over all heights without one;
    `sigma_m` is the standard error of its level.

    Raises
    ------
    GeometryError
        If the evidence is poor, contradictory, or all of the cloud is on one side of the surface.
    """
    middle = len(near.heights_m) // 2
    gain = {cue: gain_of(sums) for cue, sums in near.cues}
    fixing = [cue for cue, _ in placing(near)]
    found = {cue.name: float(gain[cue].gain[middle]) for cue in fixing}
    found[LAYER] = float(layer_gain(samples, near.heights_m, near.tilt)[middle])
    evidence = {f"{name} gain": value for name, value in found.items()}
    rival_m, evidence["rival gain"] = _rival(whole, peak)
    evidence["rival height"] = rival_m + float(samples.origin[2])
    witnesses = _witnesses(near, gain, evidence)
    evidence["total gain"] = sum(max(value, 0.0) for value in found.values())
    evidence["share below"] = float(np.mean(heights_above(samples, peak) < 0.0))
    speaking = [
        name for name, g in found.items() if g >= (LEAST_LAYER if name == LAYER else LEAST_EACH)
    ]
    lift = float(gain[SLOPE].amplitude[middle]) if speaking == [SLOPE.name] else None
    least = _refuse_poor(_height(samples, peak), evidence, sigma_m, speaking, lift)
    sentences = []
    for cue in fixing:
        if found[cue.name] >= LEAST_EACH:
            size, sigma = float(gain[cue].amplitude[middle]), float(gain[cue].sigma[middle])
            evidence[f"{cue.name} amplitude"], evidence[f"{cue.name} sigma"] = size, sigma
            sentences.append(f"{cue.meaning}: {_size(cue, size, sigma)}")
    if found[LAYER] >= LEAST_EACH:
        sentences.append(f"points float in a thin layer (evidence {found[LAYER]:.0f})")
    total, rival = evidence["total gain"], evidence["rival gain"]
    confidence = float(min(1.0 - rival / total, 1.0 - math.exp(-total / (2.0 * least))))
    return confidence, evidence, (*sentences, *witnesses)


def _rival(whole: Looked, peak: Peak) -> tuple[float, float]:
    """Return the best height that is another one, and its gain."""
    total = gains(whole, peak.tilt)
    total = np.where(np.abs(whole.heights_m - peak.level_m) > SAME_PLACE_M, total, 0.0)
    row = int(np.argmax(total))
    return float(whole.heights_m[row]), float(total[row])


def _witnesses(near: Looked, gain: dict[Cue, Gain], evidence: dict[str, float]) -> list[str]:
    """Return the sentences of cues that only say that there is water below about here."""
    sentences = []
    close = np.abs(near.heights_m - near.heights_m[len(near.heights_m) // 2]) <= WITNESS_REACH_M
    for cue, seen in gain.items():
        if not cue.places:
            sigmas = float((cue.what.sign * seen.amplitude / (seen.sigma + 1e-12))[close].max())
            evidence[f"{cue.name} sigmas"] = sigmas
            if sigmas >= WITNESS_SIGMAS:
                sentences.append(f"{cue.meaning} ({sigmas:.0f} standard errors)")
    return sentences


def _refuse_poor(
    height: str, evidence: dict[str, float], sigma_m: float, speaking: list[str], lift: float | None
) -> float:
    """Return the evidence that is needed, or refuse.

    `speaking` are the cues that gain enough to count; `lift` is the change of slope where that
    alone speaks: a break that refraction does not make is a bank.
    """
    total, rival, wet = (evidence[name] for name in ("total gain", "rival gain", "share below"))
    least, most_rival = LEAST_AGREED, MOST_RIVAL_AGREED
    if len(speaking) < 2:
        coloured = any("/" in name or name == BRIGHT.name for name in speaking)
        least, most_rival = (LEAST_COLOUR_ALONE if coloured else LEAST_ALONE), MOST_RIVAL_ALONE
    why = ""
    if not LEAST_SHARE <= wet <= 1.0 - LEAST_SHARE:
        side = "below" if wet > 0.5 else "above"
        why = (
            f"nearly all of the cloud lies {side} the best candidate, {height}, so that there is no"
            " shoreline to see"
        )
    elif lift is not None and not LIFTS[0] <= lift <= LIFTS[1]:
        why = (
            f"the only evidence is a break of slope at {height}, where slopes change by"
            f" {1.0 + lift:.2f} times and refraction makes about 1.36: a bank or a terrace, it"
            " seems"
        )
    elif total < least:
        why = (
            "slopes, colours, noise and floating points were searched for a change at one height,"
            f" and the best, {height}, is too weak (evidence {total:.0f}, {least:.0f} needed)"
        )
    elif rival > most_rival * total:
        why = (
            f"the evidence is contradictory, {height} and {evidence['rival height']:.2f} m are"
            f" nearly as likely (evidence {total:.0f} and {rival:.0f})"
        )
    elif sigma_m > MOST_SIGMA_M:
        why = f"parts of the cloud disagree by {sigma_m:.2f} m about the best candidate, {height}"
    if why:
        raise GeometryError(f"No water surface was found: {why}; {INSTEAD}.")
    return least


def _height(samples: Samples, peak: Peak) -> str:
    middle = samples.xyz[:, :2].mean(axis=0) @ peak.tilt
    return f"{peak.level_m + float(middle) + float(samples.origin[2]):.2f} m"


def _size(cue: Cue, size: float, sigma: float) -> str:
    if cue == SLOPE:
        return f"true slopes are {1.0 + size:.2f} ± {sigma:.2f} times the apparent ones"
    return f"the logarithm of the ratio falls by {-size:.2f} ± {sigma:.2f} per metre"

"""Search the level, or plane, that the cues agree on best, and judge it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcfix.errors import GeometryError
from pcfix.model import BoolArray, FloatArray
from pcfix.water.cues import BLUE, RED, SLOPE, Moments, Samples, cue_moments, gain_of, layer_gain

LARGEST_TILT, USUAL_TILT = 0.006, 0.002
TILT_STEP_M, MOST_TILT_STEPS = 0.15, 9
COARSE_M, FINE_M, MOST_HEIGHTS = 0.04, 0.01, 800
FINE_REACH_M, SAME_PLACE_M = 0.6, 0.3
WATERLINE_M = 0.05
DRAWS, TILT_DRAWS, TILT_REACH = 120, 40, 6
NO_TILT = np.zeros(2)


class Scan(NamedTuple):
    """The sums of all cues of a cloud, at heights above a tilted plane."""

    cues: list[Moments]  # of the slope and of the stronger colour, if they show anything
    samples: Samples
    heights_m: FloatArray  # (h,)
    tilt: FloatArray  # (2,), of the plane through the origin of the samples


class Peak(NamedTuple):
    """The best surface: level_m + tilt . xy from the origin of the samples."""

    level_m: float
    tilt: FloatArray
    score: float  # total gain of its cues, reduced for unusual tilts


def scan_at(samples: Samples, heights_m: FloatArray, tilt: FloatArray) -> Scan:
    """Sum all cues at the given heights above a tilted plane."""
    slope, *light = (
        cue_moments(samples, cue, heights_m, tilt)
        for cue in ((SLOPE, RED, BLUE) if len(samples.colour) else (SLOPE,))
    )
    known = [sums for sums in light if sums is not None]
    stronger = sorted(known, key=lambda sums: -float(gain_of(sums).gain.max()))[:1]
    return Scan([*([slope] if slope else []), *stronger], samples, heights_m, tilt)


def gains(scan: Scan, tilt: FloatArray, rng: np.random.Generator | None = None) -> FloatArray:
    """Return the total gain of the cues at each height, shape (h,).

    `tilt`, shape (2,), is added to that of `scan`. With `rng`, tiles and floating points are
    resampled with replacement (bootstrap).
    """
    total = np.zeros(len(scan.heights_m))
    for sums in scan.cues:
        times = None if rng is None else _drawn(len(sums.sums), rng)
        total += np.maximum(gain_of(sums.shifted(tilt) if tilt.any() else sums, times).gain, 0.0)
    times = None if rng is None else _drawn(len(scan.samples.tile), rng)
    return total + layer_gain(scan.samples, scan.heights_m, scan.tilt + tilt, times)


def _drawn(count: int, rng: np.random.Generator) -> FloatArray:
    return np.bincount(rng.integers(0, max(count, 1), count), minlength=count).astype(float)


def best(scan: Scan, tilts: FloatArray) -> Peak:
    """Return the best height and tilt among tilts of shape (k, 2)."""
    found = []
    for tilt in tilts:
        total, total_tilt = gains(scan, tilt), scan.tilt + tilt
        row = int(np.argmax(total))
        unusual = 0.5 * float(total_tilt @ total_tilt) / USUAL_TILT**2
        found.append(Peak(float(scan.heights_m[row]), total_tilt, float(total[row]) - unusual))
    return max(found, key=lambda peak: peak.score)


def axis_of(samples: Samples, peak: Peak) -> FloatArray:
    """Return the direction in which the waterline runs, shape (2,).

    Standing water is level, and flowing water is level across: it may only fall along the line.
    """
    xy = samples.xyz[near_surface(samples, peak), :2]
    if len(xy) < 3:
        xy = samples.xyz[:, :2]
    return np.asarray(np.linalg.svd(xy - xy.mean(axis=0), full_matrices=False)[2][0])


def heights_above(samples: Samples, peak: Peak) -> FloatArray:
    """Return the heights of the smooth ground of the cells above the water, shape (m,)."""
    return np.asarray(samples.smooth_m - samples.xyz[:, :2] @ peak.tilt - peak.level_m)


def near_surface(samples: Samples, peak: Peak) -> BoolArray:
    """Return the cells at the height of the water, shape (m,)."""
    return np.asarray(np.abs(heights_above(samples, peak)) <= WATERLINE_M)


def tilts_along(axis: FloatArray, step: float, steps: int) -> FloatArray:
    """Return tilts along an axis, the level one first, shape (2 steps + 1, 2)."""
    up_and_down = np.arange(-steps, steps + 1)
    return (up_and_down[np.argsort(np.abs(up_and_down), kind="stable")] * step)[:, None] * axis


def tilt_step(samples: Samples) -> float:
    """Return the step of the searched tilts: `TILT_STEP_M` over the extent of the cloud."""
    extent = float(np.ptp(samples.xyz[:, :2], axis=0).max())
    return max(TILT_STEP_M / extent, LARGEST_TILT / MOST_TILT_STEPS)


def refine(samples: Samples, start: Peak, axis: FloatArray | None) -> tuple[Peak, Scan]:
    """Search near a surface in fine steps of height and, along an axis, of tilt."""
    peak, step = start, tilt_step(samples)
    reach = np.arange(-FINE_REACH_M, FINE_REACH_M + FINE_M / 2.0, FINE_M)
    for _ in range(3 if axis is not None else 1):
        scan = scan_at(samples, peak.level_m + reach, peak.tilt)
        step /= 2.0
        tilts = NO_TILT[None] if axis is None else tilts_along(axis, step, 2)
        peak = best(scan, tilts)
    return peak, scan_at(samples, peak.level_m + reach, peak.tilt)


def drawn(scan: Scan, axis: FloatArray | None, step: float) -> tuple[FloatArray, FloatArray]:
    """Return bootstrap samples of the level and of the tilt, relative to the surface found.

    Levels have the shape (`DRAWS`,), metres, with the tilt found; tilts along the axis the shape
    (`TILT_DRAWS`,), none without an axis.
    """
    rng = np.random.default_rng(0)
    heights = scan.heights_m - scan.heights_m[len(scan.heights_m) // 2]
    near = np.abs(heights) <= SAME_PLACE_M
    draws = [gains(scan, NO_TILT, rng)[near] for _ in range(DRAWS)]
    level = np.array([heights[near][int(np.argmax(draw))] for draw in draws])
    if axis is None:
        return level, np.empty(0)
    tilts = tilts_along(axis, step / 2.0, TILT_REACH)
    tops = [  # with the same sample for all tilts
        [gains(scan, tilt, np.random.default_rng(seed))[near].max() for tilt in tilts]
        for seed in range(TILT_DRAWS)
    ]
    return level, tilts[np.argmax(tops, axis=1)] @ axis


LEAST_AGREED, LEAST_EACH = 12.0, 3.0
LIFTS = 0.15, 0.75
"""Range of the change of slope by refraction, about 0.36, on rough ground."""
LEAST_SINGLE, LEAST_COLOUR_SINGLE = 25.0, 40.0
"""Physics gives the size of slope and layer; colours may change with height on land too."""
LEAST_LAYER = 15.0
"""Noise forms a layer by chance more often than slopes and colours break at one height."""
MOST_RIVAL_AGREED, MOST_RIVAL_SINGLE = 0.75, 0.5
MOST_SIGMA_M = 0.2
LEAST_SHARE = 0.005
INSTEAD = "Give the water surface: a level, shoreline points, plane:a,b,c or a mesh."
LAYER = "floating points"


def judge(
    peak: Peak, near: Scan, coarse: Scan, sigma_m: float
) -> tuple[float, dict[str, float], tuple[str, ...]]:
    """Return the confidence in a surface, the figures of its evidence, and sentences about it.

    `near` are the sums about it, with its tilt, and `coarse` those over all heights without tilt;
    `sigma_m` is the standard error of its level. Raises GeometryError ``water.not_found``.
    """
    samples, middle = near.samples, len(near.heights_m) // 2
    gain = {sums.cue: gain_of(sums) for sums in near.cues}
    found = {cue.name: float(gain[cue].gain[middle]) for cue in gain}
    found[LAYER] = float(layer_gain(samples, near.heights_m, near.tilt)[middle])
    # the rival: the best height elsewhere
    elsewhere = np.abs(coarse.heights_m - peak.level_m) > SAME_PLACE_M
    rivals = np.where(elsewhere, gains(coarse, peak.tilt), 0.0)
    row = int(np.argmax(rivals))
    total, rival = sum(max(value, 0.0) for value in found.values()), float(rivals[row])
    rival_m = float(coarse.heights_m[row]) + float(samples.origin[2])
    wet = float(np.mean(heights_above(samples, peak) < 0.0))
    evidence = {f"{name} gain": value for name, value in found.items()} | {
        "rival gain": rival, "rival height": rival_m, "total gain": total, "share below": wet,
    }  # fmt: skip
    sentences = []
    for cue, seen in gain.items():
        if found[cue.name] >= LEAST_EACH:
            size, sigma = float(seen.amplitude[middle]), float(seen.sigma[middle])
            evidence[f"{cue.name} amplitude"], evidence[f"{cue.name} sigma"] = size, sigma
            text = f"the logarithm of the ratio falls by {-size:.2f} ± {sigma:.2f} per metre"
            if cue == SLOPE:
                text = f"true slopes are {1.0 + size:.2f} ± {sigma:.2f} times the apparent ones"
            sentences.append(f"{cue.meaning}: {text}")
    if found[LAYER] >= LEAST_EACH:
        sentences.append(f"points float in a thin layer (evidence {found[LAYER]:.0f})")
    # what is needed depends on the cues that gain enough to count
    strong = [
        name for name, g in found.items() if g >= (LEAST_LAYER if name == LAYER else LEAST_EACH)
    ]
    least, most_rival, lift = LEAST_AGREED, MOST_RIVAL_AGREED, LIFTS[0]
    if len(strong) < 2:
        coloured = any("/" in name for name in strong)
        least, most_rival = (LEAST_COLOUR_SINGLE if coloured else LEAST_SINGLE), MOST_RIVAL_SINGLE
    if strong == [SLOPE.name]:
        lift = evidence["slope amplitude"]
    reason = ""
    if not LEAST_SHARE <= wet <= 1.0 - LEAST_SHARE:
        reason, why = "no_shoreline", "nearly all of the cloud is on one side of it"
    elif not LIFTS[0] <= lift <= LIFTS[1]:  # a break that refraction does not make
        reason = "bank"
        why = f"slopes change by {1.0 + lift:.2f} times there, and refraction makes about 1.36"
    elif total < least:
        reason, why = "weak", f"its evidence is {total:.0f}, and {least:.0f} is needed"
    elif rival > most_rival * total:
        reason = "contradictory"
        why = f"its evidence is {total:.0f}, and {rival_m:.2f} m has {rival:.0f}, nearly as much"
    elif sigma_m > MOST_SIGMA_M:
        reason, why = "inconsistent", f"parts of the cloud differ by {sigma_m:.2f} m"
    if reason:
        height = peak.level_m + float(samples.xyz[:, :2].mean(axis=0) @ peak.tilt)
        raise GeometryError(
            "water.not_found",
            f"No water surface was found. The best candidate is"
            f" {height + float(samples.origin[2]):.2f} m, but {why}. {INSTEAD}",
            reason=reason, evidence=evidence,
        )  # fmt: skip
    confidence = float(min(1.0 - rival / total, 1.0 - math.exp(-total / (2.0 * least))))
    return confidence, evidence, tuple(sentences)


TILTS = (-0.02, -0.015, -0.01, -0.0075, -0.005, -0.0025, 0.0025, 0.005, 0.0075, 0.01, 0.015, 0.02)
DIRECTIONS = 4
REACH_M, LEAST_APART_M = 2.0, 0.3
"""Largest distance from the given water in the middle of the cloud; least one from end to end."""
LEAST_GAIN, MOST_LEFT, ABOUT_AS_GOOD = 100.0, 0.4, 0.9
"""Least evidence of a tilted waterline; the largest share of it for the level one; and the share
from which another tilt is as likely, as the tilt across a straight shore is unknown."""
_WINDS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")


class Tilted(NamedTuple):
    """A waterline that is tilted against the given water."""

    to: str  # the direction in which it rises
    slope: float  # rise per metre
    low_m: float  # lowest and highest place in the cloud, above the given water
    high_m: float


def find_tilt(coarse: Scan) -> Tilted | None:
    """Return the tilt of a waterline, if any; heights of `coarse` are above the given water."""
    samples = coarse.samples
    middle = np.median(samples.xyz[:, :2], axis=0)
    angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    ways = np.column_stack([np.cos(angles), np.sin(angles)])

    def best(tilt: FloatArray) -> Peak:
        at_middle = coarse.heights_m + samples.origin[2] + middle @ tilt
        gain = np.where(np.abs(at_middle) <= REACH_M, gains(coarse, tilt), 0.0)
        row = int(np.argmax(gain))
        return Peak(float(coarse.heights_m[row]), tilt, float(gain[row]))

    level = best(NO_TILT)
    peaks = [best(slope * way) for slope in sorted(TILTS, key=abs) for way in ways]
    least = ABOUT_AS_GOOD * max(one.score for one in peaks)
    peak = next(one for one in peaks if one.score >= least)  # the least tilt
    if peak.score < LEAST_GAIN or level.score > MOST_LEFT * peak.score:
        return None
    shore = samples.xyz[near_surface(samples, peak), :2] @ peak.tilt
    heights = shore + peak.level_m + samples.origin[2]
    if len(heights) < 2 or np.ptp(heights) < LEAST_APART_M:
        return None
    slope = float(np.hypot(*peak.tilt))
    wind = round(float(np.arctan2(peak.tilt[1], peak.tilt[0])) / (np.pi / 4.0)) % len(_WINDS)
    return Tilted(_WINDS[wind], slope, float(heights.min()), float(heights.max()))

"""The level, or plane, that the cues agree on best."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.water.auto.cues import Cue, cue_moments, cues_of
from pcfix.water.auto.layer import Floating, layer_gain
from pcfix.water.auto.moments import Moments, gain_of

if TYPE_CHECKING:
    from pcfix.model import BoolArray, FloatArray
    from pcfix.water.auto.samples import Samples

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
    said = [(cue, sums) for cue, sums in cues if sums is not None]
    return Looked(said, floating, heights_m, tilt)


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

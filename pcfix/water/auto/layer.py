"""What floats: points well above the ground around them that lie at one height, thinly.

Waves, foam and glints that images agree on by chance give points on the surface itself. Leaves and
wires are above the ground too, but at all heights.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from pcfix.model import BoolArray, FloatArray, IntArray
    from pcfix.water.auto.samples import Samples

LEAST_ABOVE_M, TIMES_NOISE = 0.25, 10.0
"""Less, and the tail of the noise follows the ground and piles up where that is flat."""
HALF_LAYER_M, HALF_AROUND_M = 0.05, 0.6
MOST_GAIN = 100.0
"""Many points are not independent: what they gain tends to this."""
TILE_CELLS = 12.0


class Floating(NamedTuple):
    """Points above the ground; p of them.

    xyz : shape (p, 3), metres from the origin of the samples.
    tile : shape (p,), number of the square that each is in.
    """

    xyz: FloatArray
    tile: IntArray


def points_above(samples: Samples, xyz: FloatArray, among: BoolArray | None = None) -> Floating:
    """Return the points of the cloud, shape (n, 3), that are well above the ground.

    `among`, shape (n,): which points to look at.
    """
    above_m = (xyz[:, 2] - samples.origin[2]) - samples.smooth_m[samples.of_point]
    least = np.maximum(LEAST_ABOVE_M, TIMES_NOISE * samples.rough_m)
    chosen = above_m > least[samples.of_point]
    local = xyz[chosen if among is None else chosen & among] - samples.origin
    column, row = (local[:, :2] / (TILE_CELLS * samples.cell_m)).astype(np.int64).T
    return Floating(local, row * (column.max(initial=0) + 1) + column)


def layer_gain(
    floating: Floating, heights_m: FloatArray, tilt: FloatArray, times: FloatArray | None = None
) -> FloatArray:
    """Return how much likelier the counts are with a layer at each height than without.

    Logarithm of the ratio of Poisson likelihoods; what is expected comes from above and below.
    Points of one tile at one height count once. `times`: how often to count each point.

    Parameters
    ----------
    floating : Floating
    heights_m : array, shape (h,)
        Evenly spaced, above the tilted plane through the origin of the samples.
    tilt : array, shape (2,)

    Returns
    -------
    array, shape (h,)
    """
    step = heights_m[1] - heights_m[0]
    height = floating.xyz[:, 2] - floating.xyz[:, :2] @ tilt
    column = np.rint((height - heights_m[0]) / step).astype(np.int64)
    inside = (column >= 0) & (column < len(heights_m))
    once = _first_of_each(floating.tile, column) & inside
    counts = np.bincount(
        column[once], None if times is None else times[once], minlength=len(heights_m)
    )
    sums = np.concatenate([[0.0], np.cumsum(counts)])
    layer, in_layer = _within(sums, round(HALF_LAYER_M / step))
    wide, in_wide = _within(sums, round(HALF_AROUND_M / step))
    around = np.maximum(in_wide - in_layer, 1)
    expected = np.maximum(wide - layer, 1.0) * in_layer / around
    ratio = np.maximum(layer / expected, 1.0)
    gain = layer * np.log(ratio) - expected * (ratio - 1.0)
    return np.asarray(-MOST_GAIN * np.expm1(-gain / MOST_GAIN))


def _within(sums: FloatArray, reach: int) -> tuple[FloatArray, IntArray]:
    """Return the counts within so many bins of each, and how many bins that is."""
    middle = np.arange(len(sums) - 1)
    low, high = np.maximum(middle - reach, 0), np.minimum(middle + reach + 1, len(sums) - 1)
    return sums[high] - sums[low], high - low


def _first_of_each(tile: IntArray, column: IntArray) -> BoolArray:
    key = tile * (np.ptp(column) + 1 if len(column) else 1) + column - column.min(initial=0)
    first = np.zeros(len(tile), bool)
    first[np.unique(key, return_index=True)[1]] = True
    return first

r"""Fuse the depth maps of a point: which maps agree, and the bed that they would have seen.

The depth map q of an image shows a trial bed at the depth d_q beyond the apparent point P, relative
to the distance of P, and a bed that is higher by r at d_q + s_q r.

1. *Averaging.* Before the fusion each depth is replaced by the mean D_q + S_q r of itself and those
   of partners that differ by less than `AVERAGED_WITHIN`.
2. *Fusion.* The software takes one image's pixel, the seed, and fuses with it the depths of its
   neighbours that agree, within `AGREE`: the group of the seed. With the weights W_q the mean of
   the group is P, so that the bed is higher than the trial bed by

       r = -sum_q W_q D_q / sum_q W_q S_q

   As the bed decides which depths agree, the group is formed again with this r.
3. *Choice.* What the maps of a group showed is used up, and later seeds fuse what is left. So the
   points of a place come from a few groups, and each group has the bed at another apparent height:
   a metre apart under deep water, where there are obliques. Neighbouring points come from different
   groups, and only the true bed is among the likely ones of all. The bed of the surroundings
   (`pcfix.refract.bed`) identifies the group of each point.

A view list names the maps that were fused: the list is the only group, and all its depths count.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from pcfix.kernels import device
from pcfix.model import FloatArray, IntArray
from pcfix.refract.matcher import Matcher

AVERAGED_WITHIN = 0.012
"""Depths of neighbouring maps that differ by less, relative, are averaged before the fusion."""

AGREE = 0.01  # depths that differ by less, relative, are fused

_ROUNDS, _ROUNDS_OF_LIST = 1, 2  # how often the maps are chosen again for the bed of a group

ABSENT = -1


class PointMaps(NamedTuple):
    """The k depth maps of one point and their groups, for kernels; see the docstring above.

    The arrays have room for the maps of all images of the block.
    """

    place: IntArray  # of each image of the block among the k maps, or `ABSENT`
    averaged: IntArray  # (k, 9), each map and its partners by their places; `ABSENT` after the last
    fused: IntArray  # (k, 13), each seed and its neighbours likewise; (1, k) with a view list
    share: FloatArray  # (k,), W: the weight of each map by itself
    trial: FloatArray  # (k,), d: the depth of the trial bed
    slope: FloatArray  # (k,), s: its change with the height, 1/m; NaN without a depth
    own: FloatArray  # (k,), d + s r, for the bed of one group
    mean: FloatArray  # (k,), D + S r, for the same bed
    mean_slope: FloatArray  # (k,), S
    number: FloatArray  # (k,), how many depths the mean is of
    rise: FloatArray  # (k,), r of the group of each seed, metres
    size: FloatArray  # (k,), how many maps that group has
    weight: FloatArray  # (k,), of each map in the group that made the point


class Bed(NamedTuple):
    """The bed of the surroundings as heights on a grid; see `pcfix.refract.bed`."""

    height_m: FloatArray  # (rows, columns), world frame, southern row first; NaN if unknown
    left_m: float
    bottom_m: float
    cell_m: float
    between: bool = True  # whether heights are interpolated between cells

    def height_at(self, xy: FloatArray) -> FloatArray:
        """Return the height at each place, NaN where the cell has none."""
        from scipy.ndimage import map_coordinates

        place = (xy.T[::-1] - [[self.bottom_m], [self.left_m]]) / self.cell_m
        cell: dict[str, Any] = {"mode": "grid-constant", "output": np.float64}
        own = map_coordinates(self.height_m, np.floor(place), order=0, cval=np.nan, **cell)
        if not self.between:
            return np.asarray(own)
        # the mean of the four nearest middles of cells that have a height
        known = np.isfinite(self.height_m)
        total, weight = (
            map_coordinates(values, place - 0.5, order=1, **cell)
            for values in (np.where(known, self.height_m, 0.0), known.astype(np.float64))
        )
        inside = np.isfinite(own) & (weight > 0.0)
        return np.where(inside, total / np.where(inside, weight, 1.0), np.nan)


@device(allocates=True)
def room_for_maps(matcher: Matcher, listed: bool) -> PointMaps:
    """Return room for the maps of a point."""
    k, members = len(matcher.averaged), matcher.averaged.shape[1] + 1
    # a view list is one group, of up to all maps
    seeds, most = (1, k) if listed else (k, matcher.fused.shape[1] + 1)
    return PointMaps(
        np.full(k, ABSENT), np.full((k, members), ABSENT), np.full((seeds, most), ABSENT),
        np.empty(k), np.empty(k), np.empty(k), np.empty(k), np.empty(k),
        np.empty(k), np.empty(k), np.empty(k), np.empty(k), np.empty(k),
    )  # fmt: skip


@device
def find_members(maps: PointMaps, images: IntArray, matcher: Matcher, listed: bool) -> None:
    """Find the maps that may be averaged and fused with each map of a point with these images."""
    maps.place[:] = ABSENT
    for q in range(images.size):
        maps.place[images[q]] = q
    for q in range(images.size):
        _set_members(maps.averaged[q], q, matcher.averaged[images[q]], maps.place)
    for seed in range(min(images.size, len(maps.fused))):
        others = images[1:] if listed else matcher.fused[images[seed]]
        _set_members(maps.fused[seed], seed, others, maps.place)


@device
def _set_members(members: IntArray, q: int, others: IntArray, place: IntArray) -> None:
    """Write the place of a map, and after it those of other images that have one."""
    members[0], count = q, 1
    for c in others:
        if c >= 0 and place[c] >= 0:
            members[count], count = place[c], count + 1
    members[count:] = ABSENT


@device(forceinline=True)
def find_rises(maps: PointMaps, k: int, listed: bool) -> None:
    """Find the bed and the size of the group of each seed, of k maps.

    Which depths agree is decided for the trial bed, and again for the bed of each group.
    """
    seeds, spread = min(k, len(maps.fused)), _set_bed(maps, k, 0.0)
    for q in range(k):
        _average(maps, q)
    for seed in range(seeds):
        maps.rise[seed], maps.size[seed] = _fuse(maps, seed, listed)
    for seed in range(seeds):
        for _ in range(_ROUNDS_OF_LIST if listed else _ROUNDS):
            # where all depths agree, for both beds, so do the groups
            if max(spread, _set_bed(maps, k, maps.rise[seed])) < AGREE:
                break
            _average_group(maps, seed)
            step, maps.size[seed] = _fuse(maps, seed, listed)
            maps.rise[seed] += step


@device
def _set_bed(maps: PointMaps, k: int, rise: float) -> float:
    """Set the depths d + s r of k maps for a bed; return their range."""
    low, high = np.inf, -np.inf
    for q in range(k):
        own = maps.trial[q] + maps.slope[q] * rise
        # NaN is neither lower nor higher
        low, high = own if own < low else low, own if own > high else high
        maps.own[q] = own
    return high - low


@device(forceinline=True)
def _average_group(maps: PointMaps, seed: int) -> None:
    """Average the depths that may be fused with that of a seed."""
    for q in maps.fused[seed]:
        if q < 0:
            break
        _average(maps, q)


@device(forceinline=True)
def _average(maps: PointMaps, q: int) -> None:
    """Average a depth with those of its partners that agree."""
    own, total, change, count = maps.own[q], 0.0, 0.0, 0.0
    for a in maps.averaged[q]:
        if a < 0:
            break
        # no branch, which the processor would predict wrongly half the time
        agrees = abs(maps.own[a] - own) < AVERAGED_WITHIN
        total += maps.own[a] if agrees else 0.0
        change += maps.slope[a] if agrees else 0.0
        count += 1.0 if agrees else 0.0
    each = 1.0 / count
    maps.mean[q], maps.mean_slope[q], maps.number[q] = total * each, change * each, count


@device(forceinline=True)
def _range_of(maps: PointMaps, seed: int, listed: bool) -> tuple[float, float]:
    """Return the middle of the depths that are fused with a seed, and how far they may be from it.

    All depths of a list are fused, but none that is NaN.
    """
    return (0.0, np.inf) if listed else (maps.mean[seed], AGREE)


@device(forceinline=True)
def _fuse(maps: PointMaps, seed: int, listed: bool) -> tuple[float, float]:
    """Return by how much the bed of the group of a seed is higher, and the size of the group."""
    total, change, members = 0.0, 0.0, 0.0
    middle, within = _range_of(maps, seed, listed)
    for q in maps.fused[seed]:
        if q < 0:
            break
        agrees = abs(maps.mean[q] - middle) < within
        total += maps.share[q] * maps.mean[q] if agrees else 0.0
        change += maps.share[q] * maps.mean_slope[q] if agrees else 0.0
        members += 1.0 if agrees else 0.0
    return -total / change, members


@device(forceinline=True)
def set_weights(maps: PointMaps, seed: int, k: int, listed: bool) -> None:
    """Set the weights of k maps if the group of a seed made the point; all zero without a seed.

    The weight of each map of the group is shared evenly by the maps that were averaged into it.
    """
    maps.weight[:k] = 0.0
    if seed < 0:
        return
    _set_bed(maps, k, maps.rise[seed])
    _average_group(maps, seed)
    middle, within = _range_of(maps, seed, listed)
    for q in maps.fused[seed]:
        if q < 0 or not abs(maps.mean[q] - middle) < within:
            continue
        for a in maps.averaged[q]:
            if a >= 0 and abs(maps.own[a] - maps.own[q]) < AVERAGED_WITHIN:
                maps.weight[a] += maps.share[q] / maps.number[q]


@device(forceinline=True)
def likely_seed(maps: PointMaps, k: int, wanted: float, width_m: float) -> tuple[int, float]:
    """Return the seed of the group that made the point, -1 if no map has a depth; the ambiguity.

    That is the group whose bed is nearest to the wanted rise r or, where this is NaN, the largest.
    The ambiguity is the standard deviation (m) of the beds of all groups, which are likely by their
    distance from the wanted bed, with the standard deviation `width_m`.
    """
    best, least, known = -1, np.inf, wanted == wanted
    total, first, second = 0.0, 0.0, 0.0  # sum and moments of the likelihood
    for seed in range(k):
        if maps.slope[seed] != maps.slope[seed]:  # the seed does not see this bed
            continue
        rise = maps.rise[seed]
        misfit = abs(rise - wanted) if known else -maps.size[seed]
        if misfit < least:
            best, least = seed, misfit
        likely = np.exp(-0.5 * (misfit / width_m) ** 2) if known else 1.0
        total += likely
        first, second = first + likely * rise, second + likely * rise * rise
    # all groups are far from the wanted bed
    if not total > 0.0:
        return best, abs(least) if best >= 0 else 0.0
    mean = first / total
    return best, np.sqrt(max(second / total - mean * mean, 0.0))

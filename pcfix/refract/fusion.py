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
   identifies the group of each point.

A view list names the maps that were fused: the list is the only group, and all its depths count.

The bed of the surroundings is the height that most points of a place can have come from. A point
has a likely bed b for each group that may have made it, all equally probable. In a cell of a grid
the bed is the height z with the largest

    sum over its points of  log(OUTLIER + sum_b exp(-((b - z) / width)^2 / 2))

It serves only to choose among the likely beds of a point; no point is put onto it.
"""

from typing import Any, NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.model import FloatArray, IntArray
from pcfix.refract.matcher import Matcher

AVERAGED_WITHIN = 0.012  # relative difference of neighbouring maps that are averaged before fusion
AGREE = 0.01  # depths that differ by less, relative, are fused
_ROUNDS, _ROUNDS_OF_LIST = 1, 2  # how often the maps are chosen again for the bed of a group

ABSENT = -1

POINTS_A_CELL, MOST_CELLS = 12.0, 4_000_000
WIDTH_GSD = 2.0  # standard deviation of the likely beds of a place: relief in a cell, and noise
OUTLIER = 0.01  # likelihood of a point without a likely bed near it, relative to one with a bed
BINS, DEVIATIONS = 2.0, 3  # bins per standard deviation of likely beds; deviations to both sides
# Largest distance of a cell from the median of its neighbours, and how many of these to each side.
FAR_OFF_M, REACH = 0.4, 2


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
    """The bed of the surroundings as heights on a grid; see the docstring above."""

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


def bed_of(xy: FloatArray, likely_m: FloatArray, gsd_m: float) -> Bed:
    """Return the bed of m places with the heights of h likely beds, shape (m, h)."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    cell = _cell_m(xy, low, high)
    columns, rows = (int(n) + 1 for n in (high - low) / cell)
    at = np.floor((xy - low) / cell).astype(np.int64)
    key = at[:, 1] * columns + at[:, 0]
    order = np.argsort(key, kind="stable")
    filled, counts = np.unique(key, return_counts=True)
    start = np.concatenate([[0], np.cumsum(counts)])
    found, height = np.empty(len(filled)), np.full(rows * columns, np.nan)
    in_tiles(_most_likely, len(found), order, start, likely_m, WIDTH_GSD * gsd_m, found)
    height[filled] = found
    grid = height.reshape(rows, columns)
    # Where only one group of images sees the bed, several heights are equally likely: a cell far
    # from the median of its surroundings gets that.
    row, column = np.nonzero(np.isfinite(grid))
    padded = np.pad(grid, REACH, constant_values=np.nan)
    down, right = np.mgrid[: 2 * REACH + 1, : 2 * REACH + 1].reshape(2, -1)
    middle = np.nanmedian(padded[row[:, None] + down, column[:, None] + right], axis=1)
    far = np.abs(grid[row, column] - middle) > FAR_OFF_M
    grid[row[far], column[far]] = middle[far]
    return Bed(grid, float(low[0]), float(low[1]), cell)


def _cell_m(xy: FloatArray, low: FloatArray, high: FloatArray) -> float:
    """Return the side of cells that hold `POINTS_A_CELL` points on average where there are any."""
    area = np.prod(np.maximum(high - low, 1.0))
    least = float(np.sqrt(area / MOST_CELLS))
    side = max(float(np.sqrt(area * POINTS_A_CELL / len(xy))), least)
    for _ in range(3):
        at = np.floor((xy - low) / side).astype(np.int64)
        filled = len(np.unique(at[:, 1] * (at[:, 0].max() + 1) + at[:, 0]))
        side = max(side * float(np.sqrt(POINTS_A_CELL * filled / len(xy))), least)
    return side


@kernel(allocates=True)
def _most_likely(
    span: Span, order: IntArray, start: IntArray, likely: FloatArray, width_m: float,
    found: FloatArray,
) -> None:  # fmt: skip
    """Find the most likely height of the bed in each cell, on a histogram; NaN without any."""
    reach = int(DEVIATIONS * BINS)
    for c in range(*span):
        rows = order[start[c] : start[c + 1]]
        # the range of likely beds in the cell; comparisons with NaN are false
        low, high = np.inf, -np.inf
        for i in rows:
            for b in likely[i]:
                low, high = b if b < low else low, b if b > high else high
        found[c] = np.nan
        if not high >= low:
            continue
        step = max(width_m / BINS, (high - low) / 2000.0)
        total = np.zeros(int((high - low) / step) + 2)
        own = np.empty(total.size)
        for i in rows:
            own[:] = OUTLIER
            for b in likely[i]:
                at = (b - low) / step
                if at == at:
                    for k in range(max(0, int(at) - reach), min(own.size, int(at) + reach + 2)):
                        off = (k - at) / BINS
                        own[k] += np.exp(-0.5 * off * off)
            total += np.log(own)
        found[c] = low + np.argmax(total) * step


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

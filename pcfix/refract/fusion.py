"""Which depth maps were fused into a point, where no list says it.

The software takes one image's pixel, the seed, and fuses with it the depth maps of its neighbours
that agree; what they showed is used up, and later seeds fuse what is left. So the points of a place
come from a few groups of images, and each group has the bed at another apparent height: where
there are obliques, a metre apart under deep water.

For each image that sees the point the model fuses what would agree with it as the seed, and says
at which height the bed would lie if that group had made the point: the likely beds. Neighbouring
points are of different groups, and only the true bed is among the likely ones of all; so the
height that most points around can have come from, the bed of the surroundings
(`pcfix.refract.matcher`), tells which group made each of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import dot
from pcfix.model import FloatArray, IntArray
from pcfix.refract.batch import Batch, Intersection
from pcfix.refract.cells import are_same, cameras_of, cells_of, counts_of, is_quick
from pcfix.refract.depth_maps import (
    ABSENT,
    AMBIGUITY,
    AVERAGED_WITHIN,
    COLUMNS,
    Lines,
    Room,
    Sight,
    find_lines,
    intersection_of,
    likely_bed,
    made_up,
    room_for,
    settle_bed,
    sight_of,
)
from pcfix.refract.map_table import LEAST_POINTS, Block, Table, block_of, no_table, reads, table_of
from pcfix.refract.matcher import WIDTH_M, Matcher

AGREE = 0.01
"""Depths that differ by less, relative, are fused."""

SHALLOW, DEEP = 0.3, 3.5
"""Where the bed of the surroundings is looked for at first, in likely heights: outliers have it
elsewhere."""


def invert_fusion(batch: Batch) -> Intersection:
    """Return the true points from which fused depth maps would have made the apparent ones.

    Parameters
    ----------
    batch : Batch
        Its views are all images that see each point. `batch.survey.learned` has the matcher and, if
        it was learned, the bed of the surroundings; without it the largest group made the point.
    """
    bed = batch.survey.learned.bed
    around = np.full(len(batch.xyz), np.nan) if bed is None else bed.height_at(batch.xyz[:, :2])
    result = np.zeros((len(batch.xyz), COLUMNS))
    _in_cells(batch, _invert, around, result)
    return intersection_of(batch, result)


def likely_beds(batch: Batch) -> FloatArray:
    """Return the heights of the bed that different groups of images would have made points of.

    Returns
    -------
    array of float32, shape (m, most views)
        Relative to each apparent point, metres; NaN where there is none.
    """
    likely = np.full((len(batch.xyz), max(1, batch.counts.max(initial=0))), np.nan, np.float32)
    _in_cells(batch, _likely, likely)
    return likely


def _in_cells(batch: Batch, run: Callable[..., None], *given: FloatArray) -> None:
    order, first = cells_of(batch)
    in_tiles(
        run, len(first) - 1, (order, first), block_of(batch), is_quick(batch), *given,
        points=len(batch),
    )  # fmt: skip


class Groups(NamedTuple):
    """Which of a point's depth maps were averaged and fused with which, for kernels.

    Attributes
    ----------
    averaged, fused : array, shape (k, 9) and (k, 13)
        For each map itself and the others, by their places among those of the point; -1 after the
        last.
    place : array, shape (k,)
        Of each image among those of the point, or -1.
    share : array, shape (k,)
        What each map counts for.
    depth, change : array, shape (k,)
        Of each map as it is averaged, relative, and how that changes with the height of the bed.
    rise, size : array, shape (k,)
        How far up the bed is if the group of each seed made the point, metres, and how many maps
        are in it.
    own : array, shape (k,)
        Depth of each map by itself.
    """

    averaged: IntArray
    fused: IntArray
    place: IntArray
    share: FloatArray
    depth: FloatArray
    change: FloatArray
    rise: FloatArray
    size: FloatArray
    own: FloatArray


@device(allocates=True)
def _no_groups(block: Block) -> Groups:
    k, matcher = len(block.points.centres), block.matcher
    return Groups(
        np.full((k, matcher.averaged.shape[1] + 1), ABSENT),
        np.full((k, matcher.fused.shape[1] + 1), ABSENT),
        np.full(k, ABSENT), np.empty(k), np.empty(k), np.empty(k), np.empty(k), np.empty(k),
        np.empty(k),
    )  # fmt: skip


@device
def _group(groups: Groups, maps: IntArray, matcher: Matcher) -> None:
    """Find the places of the depth maps of a point."""
    groups.place[:] = ABSENT
    for q in range(maps.size):
        groups.place[maps[q]] = q
    for q in range(maps.size):
        _place(groups.averaged[q], q, matcher.averaged[maps[q]], groups.place)
        _place(groups.fused[q], q, matcher.fused[maps[q]], groups.place)


@device
def _place(members: IntArray, q: int, others: IntArray, place: IntArray) -> None:
    """Write a place and those of other images that have one."""
    members[0], count = q, 1
    for c in others:
        if c >= 0 and place[c] >= 0:
            members[count], count = place[c], count + 1
    members[count:] = ABSENT


@kernel(allocates=True)
def _likely(
    span: Span, cells: tuple[IntArray, IntArray], block: Block, quick: bool, likely: FloatArray
) -> None:
    points, (order, first) = block.points, cells
    room, none, groups = room_for(len(points.centres)), no_table(), _no_groups(block)
    for cell in range(*span):
        rows = order[first[cell] : first[cell + 1]]
        fitted = none
        if quick and rows.size >= LEAST_POINTS:
            fitted = table_of(rows, counts_of(rows, points) > 0, block)
        for at in range(rows.size):
            i, maps = rows[at], cameras_of(points, rows[at])
            if at == 0 or not are_same(maps, cameras_of(points, rows[at - 1])):
                _group(groups, maps, block.matcher)
            table = fitted if reads(fitted, points, i) else none
            _likely_of(likely[i], i, maps, groups, block, table, room)


@device
def _likely_of(
    likely: FloatArray, i: int, maps: IntArray, groups: Groups, block: Block, table: Table,
    room: Room,
) -> None:  # fmt: skip
    sight = sight_of(block.points, i)
    t, slope = room.t[: maps.size], room.slope[: maps.size]
    depths = Lines(likely_bed(sight, block), t, slope)
    find_lines(depths, maps, sight, block, table, room)
    _set_shares(groups.share, maps, sight, block)
    _set_rises(groups, depths)
    for seed in range(maps.size):
        if depths.slope[seed] == depths.slope[seed]:
            likely[seed] = depths.bed + groups.rise[seed]


@kernel(allocates=True)
def _invert(
    span: Span, cells: tuple[IntArray, IntArray], block: Block, quick: bool, around: FloatArray,
    result: FloatArray,
) -> None:  # fmt: skip
    points, (order, first) = block.points, cells
    room, none, groups = room_for(len(points.centres)), no_table(), _no_groups(block)
    for cell in range(*span):
        rows = order[first[cell] : first[cell + 1]]
        fitted = none
        if quick and rows.size >= LEAST_POINTS:
            fitted = table_of(rows, counts_of(rows, points) > 0, block)
        for at in range(rows.size):
            i, maps = rows[at], cameras_of(points, rows[at])
            if at == 0 or not are_same(maps, cameras_of(points, rows[at - 1])):
                _group(groups, maps, block.matcher)
            table = fitted if reads(fitted, points, i) else none
            _invert_one(result[i], i, maps, around[i], groups, block, table, room)


@device
def _invert_one(
    row: FloatArray, i: int, maps: IntArray, around: float, groups: Groups, block: Block,
    table: Table, room: Room,
) -> None:  # fmt: skip
    sight = sight_of(block.points, i)
    wanted, bed = around - sight.now[2], likely_bed(sight, block)
    if wanted == wanted:
        bed = max(min(wanted, SHALLOW * bed), DEEP * bed)
    depths = Lines(bed, room.t[: maps.size], room.slope[: maps.size])
    find_lines(depths, maps, sight, block, table, room)
    _set_shares(groups.share, maps, sight, block)
    seed, rise, row[AMBIGUITY] = _best_seed(groups, depths, wanted - bed)
    weight = room.weight[: maps.size]
    weight[:] = 0.0
    if seed >= 0:
        _weigh(weight, seed, rise, groups, depths)
    settle_bed(row, maps, weight, depths, sight, block, table, room)


@device
def _set_shares(share: FloatArray, maps: IntArray, sight: Sight, block: Block) -> None:
    for q in range(maps.size):
        made = made_up(sight, block, maps[q])
        share[q] = 1.0 / dot(made, made)


@device
def _best_seed(groups: Groups, depths: Lines, wanted: float) -> tuple[int, float, float]:
    """Return the seed whose group has the bed nearest to the wanted height, or the largest one.

    And that bed, and how far apart (m, standard deviation) the beds are of the groups that it can
    have been.
    """
    best, at_best, least, known = -1, 0.0, np.inf, wanted == wanted
    total, first, second = 0.0, 0.0, 0.0
    _set_rises(groups, depths)
    for seed in range(depths.t.size):
        if depths.slope[seed] != depths.slope[seed]:
            continue
        rise = groups.rise[seed]
        misfit = abs(rise - wanted) if known else -groups.size[seed]
        if misfit < least:
            best, at_best, least = seed, rise, misfit
        likely = np.exp(-0.5 * (misfit / WIDTH_M) ** 2) if known else 1.0
        total += likely
        first, second = first + likely * rise, second + likely * rise * rise
    if not total > 0.0:
        return best, at_best, abs(least) if best >= 0 else 0.0
    mean = first / total
    return best, at_best, np.sqrt(max(second / total - mean * mean, 0.0))


@device
def _set_rises(groups: Groups, depths: Lines) -> None:
    """Find how far up the bed is if the group of each seed made the point, and its size.

    Which maps agree is asked for the bed that the lines are of, and again for that of each group.
    """
    k = depths.t.size
    _set_depths(groups, depths, 0.0)
    for q in range(k):
        _average(q, groups, depths)
    for seed in range(k):
        groups.rise[seed], groups.size[seed] = _fuse(seed, groups)
    for seed in range(k):
        _average_around(seed, groups, depths, groups.rise[seed])
        step, groups.size[seed] = _fuse(seed, groups)
        groups.rise[seed] += step


@device
def _average_around(seed: int, groups: Groups, depths: Lines, rise: float) -> None:
    """Average the depths that may be fused with that of a seed, for a bed so much higher."""
    _set_depths(groups, depths, rise)
    for q in groups.fused[seed]:
        if q < 0:
            break
        _average(q, groups, depths)


@device
def _set_depths(groups: Groups, depths: Lines, rise: float) -> None:
    """Set the depth of each map for a bed so much higher."""
    for q in range(depths.t.size):
        groups.own[q] = depths.t[q] + depths.slope[q] * rise


@device
def _average(q: int, groups: Groups, depths: Lines) -> None:
    """Average a depth with those of the maps around that agree.

    Without a branch, as no processor guesses which do.
    """
    own, total, change, count = groups.own[q], 0.0, 0.0, 0.0
    for a in groups.averaged[q]:
        if a < 0:
            break
        agrees = abs(groups.own[a] - own) < AVERAGED_WITHIN
        total += groups.own[a] if agrees else 0.0
        change += depths.slope[a] if agrees else 0.0
        count += 1.0 if agrees else 0.0
    each = 1.0 / count
    groups.depth[q], groups.change[q] = total * each, change * each


@device
def _fuse(seed: int, groups: Groups) -> tuple[float, float]:
    """Return how far up the bed must go for the group of a seed, and how many maps it has."""
    total, change, members = 0.0, 0.0, 0.0
    for q in groups.fused[seed]:
        if q < 0:
            break
        agrees = abs(groups.depth[q] - groups.depth[seed]) < AGREE
        total += groups.share[q] * groups.depth[q] if agrees else 0.0
        change += groups.share[q] * groups.change[q] if agrees else 0.0
        members += 1.0 if agrees else 0.0
    return -total / change, members


@device
def _weigh(weight: FloatArray, seed: int, rise: float, groups: Groups, depths: Lines) -> None:
    """Write what each depth map counts for in the group of a seed.

    The weight of one that agrees goes evenly to the maps it was averaged with.
    """
    t, slope = depths.t, depths.slope
    _average_around(seed, groups, depths, rise)
    for q in groups.fused[seed]:
        if q < 0:
            break
        if not abs(groups.depth[q] - groups.depth[seed]) < AGREE:
            continue
        own, count = t[q] + slope[q] * rise, 0.0
        for a in groups.averaged[q]:
            count += a >= 0 and abs(t[a] + slope[a] * rise - own) < AVERAGED_WITHIN
        for a in groups.averaged[q]:
            if a >= 0 and abs(t[a] + slope[a] * rise - own) < AVERAGED_WITHIN:
                weight[a] += groups.share[q] / count

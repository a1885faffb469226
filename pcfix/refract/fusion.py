"""Undo the fusion of depth maps into points.

The software takes one image's pixel, the seed, and fuses with it the depth maps of its neighbours
that agree. What they showed is used up, and later seeds fuse what is left. So the points of a place
come from a few groups of images, and each group has the bed at another apparent height: a metre
apart under deep water, where there are obliques.

*With a view list* the fused maps are known. Each counts by its weight, that of the list or one by
its squared distance. The maps that were averaged into it before (`pcfix.refract.depth_maps`) share
that weight.

*Without a list* the model fuses, for each image that sees the point, the maps that would agree with
it as the seed, and computes the height of the bed if that group had made the point: the likely
beds. Neighbouring points come from different groups, and only the true bed is among the likely ones
of all. So the height that most points around can have come from, the bed of the surroundings
(`pcfix.refract.matcher`), identifies the group of each point.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import dot
from pcfix.lens.frames import holds
from pcfix.model import FloatArray, IntArray
from pcfix.refract import depth_maps
from pcfix.refract.batch import Batch, Intersection
from pcfix.refract.depth_maps import ABSENT, AVERAGED_WITHIN, Lines, Room, Sight
from pcfix.refract.map_table import (
    CUBIC,
    LEAST_POINTS,
    Block,
    Table,
    block_of,
    layers_of,
    no_table,
    reads,
    table_of,
)
from pcfix.refract.matcher import MATCHED, WIDTH_M, Matcher
from pcfix.refract.tiling import are_same, cells_of, counts_of

AGREE = 0.01
"""Depths that differ by less, relative, are fused."""

SHALLOW, DEEP = 0.3, 3.5
"""Range of the bed of the surroundings, in likely heights; outliers have it elsewhere."""

_ROUNDS, _BEDS = 4, 3
FAR = 0.1
"""Of the way to the bed: farther off, it is decided anew which depths were averaged."""

_OUTSIDE = -2


def invert_fusion(batch: Batch) -> Intersection:
    """Return the true points from which fused depth maps would have made the apparent ones.

    The views of the batch are all images that see each point. `batch.survey.learned` has the
    matcher and perhaps the bed of the surroundings; without it the largest group made the point.
    """
    bed = batch.survey.learned.bed
    around = np.full(len(batch.xyz), np.nan) if bed is None else bed.height_at(batch.xyz[:, :2])
    result = np.zeros((len(batch.xyz), depth_maps.COLUMNS))
    _in_cells(batch, False, around, result, np.zeros((0, 0), np.float32))
    return depth_maps.intersection_of(batch, result)


def likely_beds(batch: Batch) -> FloatArray:
    """Return the heights of the bed from which different groups of images would have made points.

    Relative to each apparent point, metres, float32, shape (m, most views); NaN if there is none.
    """
    likely = np.full((len(batch.xyz), max(1, batch.counts.max(initial=0))), np.nan, np.float32)
    _in_cells(batch, False, np.zeros(0), np.zeros((0, 0)), likely)
    return likely


def invert_depth_maps(batch: Batch) -> Intersection:
    """Return the true points from which dense matching would have made the apparent ones.

    The views of the batch are the images whose depth maps were fused, with their weights;
    `batch.survey.learned.matcher` has how they were matched. The surface above each point is taken
    as a plane.
    """
    weights, result = batch.rays.weight, np.zeros((len(batch.xyz), depth_maps.COLUMNS))
    given = np.zeros(0) if weights is None else weights.astype(np.float64)
    _in_cells(batch, True, given, result, np.zeros((0, 0), np.float32))
    return depth_maps.intersection_of(batch, result)


def _in_cells(
    batch: Batch, listed: bool, given: FloatArray, result: FloatArray, likely: FloatArray
) -> None:
    layer, dense = layers_of(batch), batch.survey.learned.dense
    order, first = cells_of(batch, layer)
    # which cells have polynomials is one decision for the whole cloud
    least = LEAST_POINTS if dense is None else 1 if dense else len(batch) + 1
    in_tiles(
        _invert_cells, len(first) - 1, (order, first, layer), block_of(batch), least, listed,
        given, result, likely, points=len(batch),
    )  # fmt: skip


class Groups(NamedTuple):
    """Which of the k depth maps of a point were averaged and fused with which, for kernels."""

    averaged: IntArray  # (k, 9), each map and its partners by their places; -1 after the last
    fused: IntArray  # (k, 13), likewise
    place: IntArray  # (k,), of each image among those of the point, or `ABSENT`
    found: IntArray  # (k,), the images of a point with a list
    share: FloatArray  # (k,), the weight of each map
    depth: FloatArray  # (k,), the averaged depth of each map, relative
    change: FloatArray  # (k,), its change with the height of the bed, 1/m
    rise: FloatArray  # (k,), how far up the bed is if the group of a seed made the point, metres
    size: FloatArray  # (k,), the number of maps in the group
    own: FloatArray  # (k,), the depth of each map before it is averaged


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
    # the map itself comes first
    members[0], count = q, 1
    for c in others:
        if c >= 0 and place[c] >= 0:
            members[count], count = place[c], count + 1
    members[count:] = ABSENT


@kernel(allocates=True)
def _invert_cells(
    span: Span, cells: tuple[IntArray, IntArray, IntArray], block: Block, least: int, listed: bool,
    given: FloatArray, result: FloatArray, likely: FloatArray,
) -> None:  # fmt: skip
    """Invert the fusion of the points of each cell or, where `likely` has rows, fill these in.

    With lists `given` are the weights of their entries, if there are any; without, the heights of
    the bed of the surroundings.
    """
    points, (order, first, layer), matcher = block.points, cells, block.matcher
    k, none = len(points.centres), no_table()
    room = Room(
        np.empty(k), np.empty(k), np.empty(k), np.empty(k), np.empty((k, 6)),
        np.empty((MATCHED, 3)), np.empty((MATCHED * MATCHED, 2)), np.empty(CUBIC),
    )  # fmt: skip
    groups = Groups(
        np.full((k, matcher.averaged.shape[1] + 1), ABSENT),
        np.full((k, matcher.fused.shape[1] + 1), ABSENT),
        np.full(k, ABSENT), np.empty(k, np.int64), np.empty(k), np.empty(k), np.empty(k),
        np.empty(k), np.empty(k), np.empty(k),
    )  # fmt: skip
    for cell in range(*span):
        rows = order[first[cell] : first[cell + 1]]
        fitted = none
        if rows.size >= least and reads(block, rows[0]):
            seeing = counts_of(rows, points) > 0
            for c in np.flatnonzero(seeing) if listed else rows[:0]:
                for a in matcher.averaged[c]:  # maps that were averaged into those of the lists
                    seeing[a] = seeing[a] or a >= 0
            fitted = table_of(rows[0], layer[rows[0]], seeing, block)
            depth_maps.set_steep(fitted, layer[rows[0]], block, room)
        _invert_points(rows, listed, given, result, likely, groups, block, fitted, none, room)


@device
def _invert_points(
    rows: IntArray, listed: bool, given: FloatArray, result: FloatArray, likely: FloatArray,
    groups: Groups, block: Block, fitted: Table, none: Table, room: Room,
) -> None:  # fmt: skip
    """Do as `_invert_cells` for the points of one cell, with its polynomials.

    It makes no arrays, so that references to the many that it reads are not counted.
    """
    points, before = block.points, rows[:0]
    for i in rows:
        first, last = points.start[i], points.start[i + 1]
        cameras, table = points.camera[first:last], fitted if reads(block, i) else none
        sight = depth_maps.sight_of(points, i)
        if listed:
            weight = given[first:last] if given.size else given
            _invert_listed(result[i], cameras, weight, groups, sight, block, table, room)
            continue
        # points with the same cameras share their groups
        if not are_same(cameras, before):
            _group(groups, cameras, block.matcher)
        before = cameras
        if len(likely):
            bed = depth_maps.likely_bed(sight, block)
            depths = _rises_of(bed, cameras, groups, sight, block, table, room)
            for seed in range(cameras.size):
                if depths.slope[seed] == depths.slope[seed]:
                    likely[i, seed] = bed + groups.rise[seed]
        else:
            _invert_one(result[i], cameras, given[i], groups, sight, block, table, room)


@device
def _invert_one(
    row: FloatArray, maps: IntArray, around: float, groups: Groups, sight: Sight, block: Block,
    table: Table, room: Room,
) -> None:  # fmt: skip
    """Find the group that made a point, and invert the fusion of its maps."""
    wanted, bed = around - sight.now[2], depth_maps.likely_bed(sight, block)
    if wanted == wanted:  # the bed of the surroundings is known
        bed = max(min(wanted, SHALLOW * bed), DEEP * bed)
    depths = _rises_of(bed, maps, groups, sight, block, table, room)
    seed, rise, row[depth_maps.AMBIGUITY] = _best_seed(groups, depths, wanted - bed)
    weight = room.weight[: maps.size]
    weight[:] = 0.0
    if seed >= 0:
        # a map that agrees shares its weight with the maps it was averaged with
        _average_around(seed, groups, depths, rise)
        for q in groups.fused[seed]:
            if q < 0:
                break
            if abs(groups.depth[q] - groups.depth[seed]) < AGREE:
                _share(weight, q, groups.share[q], groups)
    depth_maps.settle_bed(row, maps, weight, depths, sight, block, table, room)


@device
def _share(weight: FloatArray, q: int, share: float, groups: Groups) -> None:
    """Add the weight of a depth map evenly to the maps that were averaged into it."""
    count = 0.0
    for a in groups.averaged[q]:
        count += a >= 0 and abs(groups.own[a] - groups.own[q]) < AVERAGED_WITHIN
    for a in groups.averaged[q]:
        if a >= 0 and abs(groups.own[a] - groups.own[q]) < AVERAGED_WITHIN:
            weight[a] += share / count


@device
def _rises_of(
    bed: float, maps: IntArray, groups: Groups, sight: Sight, block: Block, table: Table,
    room: Room,
) -> Lines:  # fmt: skip
    """Set the weights of the depth maps and the rises of their groups; return their lines."""
    depths = Lines(bed, room.t[: maps.size], room.slope[: maps.size])
    depth_maps.find_lines(depths, maps, sight, block, table, room)
    for q in range(maps.size):
        # the pixel on the ground grows with the distance
        up = depth_maps.original_up(sight, block, maps[q])
        groups.share[q] = 1.0 / dot(up, up)
    _set_rises(groups, depths)
    return depths


@device
def _best_seed(groups: Groups, depths: Lines, wanted: float) -> tuple[int, float, float]:
    """Return the seed of the group that made the point, its rise, and the ambiguity.

    That is the group whose bed is nearest to the wanted height or, where this is NaN, the largest.
    The ambiguity is the standard deviation (m) of the beds of all groups that are likely.
    """
    best, at_best, least, known = -1, 0.0, np.inf, wanted == wanted
    total, first, second = 0.0, 0.0, 0.0  # sum, and moments, of what is likely
    for seed in range(depths.t.size):
        # the seed has no depth of this bed
        if depths.slope[seed] != depths.slope[seed]:
            continue
        rise = groups.rise[seed]
        # distance from the wanted bed, or else the larger group first
        misfit = abs(rise - wanted) if known else -groups.size[seed]
        if misfit < least:
            best, at_best, least = seed, rise, misfit
        likely = np.exp(-0.5 * (misfit / WIDTH_M) ** 2) if known else 1.0
        total += likely
        first, second = first + likely * rise, second + likely * rise * rise
    # all groups are far from the wanted bed
    if not total > 0.0:
        return best, at_best, abs(least) if best >= 0 else 0.0
    mean = first / total
    return best, at_best, np.sqrt(max(second / total - mean * mean, 0.0))


@device
def _set_rises(groups: Groups, depths: Lines) -> None:
    """Find the rise and the size of the group of each seed.

    Which maps agree is decided for the bed of the lines, and again for that of each group.
    """
    k = depths.t.size
    for q in range(k):
        groups.own[q] = depths.t[q]
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
    """Average the depths that may be fused with that of a seed, for a bed higher by `rise`."""
    for q in range(depths.t.size):
        groups.own[q] = depths.t[q] + depths.slope[q] * rise
    for q in groups.fused[seed]:
        if q < 0:
            break
        _average(q, groups, depths)


@device(forceinline=True)
def _average(q: int, groups: Groups, depths: Lines) -> None:
    """Average a depth with those of its partners that agree."""
    own, total, change, count = groups.own[q], 0.0, 0.0, 0.0
    for a in groups.averaged[q]:
        if a < 0:
            break
        # no branch, which the processor would predict wrongly half the time
        agrees = abs(groups.own[a] - own) < AVERAGED_WITHIN
        total += groups.own[a] if agrees else 0.0
        change += depths.slope[a] if agrees else 0.0
        count += 1.0 if agrees else 0.0
    each = 1.0 / count
    groups.depth[q], groups.change[q] = total * each, change * each


@device(forceinline=True)
def _fuse(seed: int, groups: Groups) -> tuple[float, float]:
    """Return how far up the bed is for the group of a seed, and how many maps the group has."""
    total, change, members = 0.0, 0.0, 0.0
    for q in groups.fused[seed]:
        if q < 0:
            break
        agrees = abs(groups.depth[q] - groups.depth[seed]) < AGREE
        total += groups.share[q] * groups.depth[q] if agrees else 0.0
        change += groups.share[q] * groups.change[q] if agrees else 0.0
        members += 1.0 if agrees else 0.0
    # the weighted mean of depth + change * rise is zero
    return -total / change, members


@device
def _invert_listed(
    row: FloatArray, listed: IntArray, given: FloatArray, groups: Groups, sight: Sight,
    block: Block, table: Table, room: Room,
) -> None:  # fmt: skip
    """Invert the fusion of the maps in the list of a point, with their weights."""
    maps = groups.found[: _with_neighbours(groups, listed, sight, block)]
    _group(groups, maps, block.matcher)
    t, slope, weight = room.t[: maps.size], room.slope[: maps.size], room.weight[: maps.size]
    bed, step = depth_maps.likely_bed(sight, block), 0.0
    for _ in range(_BEDS):
        bed += step
        # which depths agree depends on the bed, and the bed on which agree
        depth_maps.find_lines(Lines(bed, t, slope), maps, sight, block, table, room)
        step = 0.0
        for _ in range(_ROUNDS):
            for q in range(maps.size):
                groups.own[q], weight[q] = t[q] + slope[q] * step, 0.0
            for k in range(listed.size):
                up = depth_maps.original_up(sight, block, listed[k])
                share = given[k] if given.size else 1.0 / dot(up, up)
                _share(weight, groups.place[listed[k]], share, groups)
            step = depth_maps.balance(t, slope, weight)
        if not abs(step) > FAR * abs(bed):
            break
    depth_maps.settle_bed(row, maps, weight, Lines(bed, t, slope), sight, block, table, room)


@device
def _with_neighbours(groups: Groups, listed: IntArray, sight: Sight, block: Block) -> int:
    """Gather the listed images, and their partners whose frames hold the point; return how many."""
    count, matcher, place = 0, block.matcher, groups.place
    place[:] = ABSENT
    for c in listed:
        if place[c] < 0:
            place[c], groups.found[count] = count, c
            count += 1
        for a in matcher.averaged[c]:
            if a < 0:
                break
            # a partner that was not looked at yet
            if place[a] == ABSENT:
                place[a] = _OUTSIDE
                if holds(matcher.inner, a, depth_maps.original_up(sight, block, a)):
                    place[a], groups.found[count] = count, a
                    count += 1
    return count

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

import numpy as np

from pcfix.kernels import Span, in_tiles, kernel, lean
from pcfix.lens.algebra import row_of
from pcfix.model import FloatArray, IntArray
from pcfix.refract.batch import Batch, Chosen, Images, Intersection
from pcfix.refract.depth_maps import (
    ABSENT,
    AMBIGUITY,
    COLUMNS,
    Lines,
    Room,
    Sight,
    arrays_of,
    averages,
    balance,
    find_lines,
    intersection_of,
    look_at,
    room_for,
    settle_bed,
)
from pcfix.refract.matcher import WIDTH_M, Matcher

AGREE = 0.01
"""Depths that differ by less, relative, are fused."""

MAX_ROUNDS = 6
CLOSE_M = 2e-3


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
    in_tiles(_invert, len(batch), *arrays_of(batch), around, result)
    return intersection_of(batch, result)


def likely_beds(batch: Batch) -> FloatArray:
    """Return the heights of the bed that different groups of images would have made points of.

    Returns
    -------
    array of float32, shape (m, most views)
        Relative to each apparent point, metres; NaN where there is none.
    """
    likely = np.full((len(batch.xyz), max(1, batch.counts.max(initial=0))), np.nan, np.float32)
    in_tiles(_likely, len(batch), *arrays_of(batch), likely)
    return likely


@kernel
def _likely(
    span: Span, points: Chosen, images: Images, matcher: Matcher, likely: FloatArray
) -> None:
    room = room_for(len(points.centres), matcher.matched.shape[1])
    for i in range(*span):
        maps = points.camera[points.start[i] : points.start[i + 1]]
        _likely_of(likely[i], points, i, maps, images, matcher, room)


@lean
def _likely_of(
    likely: FloatArray, points: Chosen, i: int, maps: IntArray, images: Images, matcher: Matcher,
    room: Room,
) -> None:  # fmt: skip
    look_at(room, points, i, images)
    sight = Sight(room.up, room.made, room.above, row_of(points.normals, i), points.n)
    t, slope = room.t[: maps.size], room.slope[: maps.size]
    depths = Lines(find_lines(t, slope, maps, sight, images, matcher, room), t, slope)
    _set(room.place, maps)
    for seed in range(maps.size):
        if depths.slope[seed] == depths.slope[seed]:
            rise, _ = _group(seed, maps, depths, sight.made, matcher, room)
            likely[seed] = depths.bed + rise
    _unset(room.place, maps)


@kernel
def _invert(
    span: Span, points: Chosen, images: Images, matcher: Matcher, around: FloatArray,
    result: FloatArray,
) -> None:  # fmt: skip
    room = room_for(len(points.centres), matcher.matched.shape[1])
    for i in range(*span):
        maps = points.camera[points.start[i] : points.start[i + 1]]
        _invert_one(result[i], points, i, maps, around[i], images, matcher, room)


@lean
def _invert_one(
    row: FloatArray, points: Chosen, i: int, maps: IntArray, around: float, images: Images,
    matcher: Matcher, room: Room,
) -> None:  # fmt: skip
    look_at(room, points, i, images)
    sight = Sight(room.up, room.made, room.above, row_of(points.normals, i), points.n)
    t, slope = room.t[: maps.size], room.slope[: maps.size]
    depths = Lines(find_lines(t, slope, maps, sight, images, matcher, room), t, slope)
    _set(room.place, maps)
    wanted = around - points.xyz[i, 2] - depths.bed
    weight = room.weight[: maps.size]
    weight[:] = 0.0
    seed, row[AMBIGUITY] = _best_seed(maps, depths, sight.made, matcher, wanted, room)
    if seed >= 0:
        _group(seed, maps, depths, sight.made, matcher, room)
    _unset(room.place, maps)
    settle_bed(row, maps, weight, depths, sight, images, matcher, room)


@lean
def _set(place: IntArray, maps: IntArray) -> None:
    for q in range(maps.size):
        place[maps[q]] = q


@lean
def _unset(place: IntArray, maps: IntArray) -> None:
    for c in maps:
        place[c] = ABSENT


@lean
def _best_seed(
    maps: IntArray, depths: Lines, made: FloatArray, matcher: Matcher, wanted: float, room: Room
) -> tuple[int, float]:
    """Return the seed whose group has the bed nearest to the wanted height, or the largest one.

    And how far apart (m, standard deviation) the beds are of the groups that it can have been.
    """
    best, least = -1, np.inf
    total, first, second = 0.0, 0.0, 0.0
    for seed in range(maps.size):
        if depths.slope[seed] != depths.slope[seed]:
            continue
        rise, members = _group(seed, maps, depths, made, matcher, room)
        known = wanted == wanted
        misfit = abs(rise - wanted) if known else -float(members)
        if misfit < least:
            best, least = seed, misfit
        likely = np.exp(-0.5 * (misfit / WIDTH_M) ** 2) if known else 1.0
        total += likely
        first, second = first + likely * rise, second + likely * rise * rise
    if not total > 0.0:
        return best, abs(least) if best >= 0 else 0.0
    mean = first / total
    return best, np.sqrt(max(second / total - mean * mean, 0.0))


@lean
def _group(
    seed: int, maps: IntArray, depths: Lines, made: FloatArray, matcher: Matcher, room: Room
) -> tuple[float, int]:
    """Return the height of the bed if the group of a seed made the point, and the group's size.

    Also sets, in the room, what each depth map counts for in it.
    """
    t, slope = depths.t, depths.slope
    rise, members = -t[seed] / slope[seed], 0
    weight, now, place = room.weight[: maps.size], room.now[: maps.size], room.place
    for _ in range(MAX_ROUNDS):
        for q in range(maps.size):
            now[q] = t[q] + slope[q] * rise
        weight[:] = 0.0
        middle, _ = _averaged(maps[seed], seed, now, place, matcher)
        members = _fuse(weight, seed, maps, now, middle, place, made, matcher)
        for c in matcher.fused[maps[seed]]:
            if c >= 0 and place[c] >= 0:
                members += _fuse(weight, place[c], maps, now, middle, place, made, matcher)
        step = balance(now, slope, weight)
        rise += step
        if not abs(step) > CLOSE_M:
            break
    return rise, members


@lean
def _averaged(
    camera: int, q: int, now: FloatArray, place: IntArray, matcher: Matcher
) -> tuple[float, float]:
    """Return a depth after averaging with the maps around that agree, and their number."""
    total, count = now[q], 1.0
    for a in matcher.averaged[camera]:
        if averages(q, a, now, place):
            total, count = total + now[place[a]], count + 1.0
    return total / count, count


@lean
def _fuse(
    weight: FloatArray, q: int, maps: IntArray, now: FloatArray, middle: float, place: IntArray,
    made: FloatArray, matcher: Matcher,
) -> int:  # fmt: skip
    """Fuse one depth map if it agrees: its weight goes evenly to the maps it was averaged with."""
    camera = maps[q]
    depth, count = _averaged(camera, q, now, place, matcher)
    if not abs(depth - middle) < AGREE:
        return 0
    each = 1.0 / ((made[camera, 0] ** 2 + made[camera, 1] ** 2 + made[camera, 2] ** 2) * count)
    weight[q] += each
    for a in matcher.averaged[camera]:
        if averages(q, a, now, place):
            weight[place[a]] += each
    return 1

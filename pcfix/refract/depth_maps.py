r"""Compute where dense matching puts a point under water, and invert that.

A dense cloud is not triangulated from tracks. For each image the matcher finds the depth of every
pixel along its own ray at which the compared images agree best: a depth map. Then each depth is
averaged with those of neighbouring maps that see the same place, and the maps are fused: a point
is the weighted mean of the depths of several images, each along its own ray. Under water these
depths differ, as each depends on the positions of the compared images.

The model, for an apparent point P, a level bed at the height z, and one image i:

1. The ray from the projection centre i through P is refracted and meets the bed in Q_i.
2. From Q_i the light goes back to the images j that i was matched with; each sees Q_i in the
   direction a_ij.
3. The depth map has P + t u_i on the ray u_i, where the two images that agree best agree: for
   each pair of j the t with the least squared distances in the images, and of these the mean with
   the weights exp(-squares / `Matcher.tolerance_px2`). PatchMatch scores a depth by its two best
   images; which these are changes from pixel to pixel.

The fused point is P where sum_i W_i t_i u_i = 0 along the vertical: one equation for z. The true
point is the mean of the Q_i with the same weights. The bed may be taken as level, because a slope
moves the Q_i and the directions a_ij nearly alike.

**Fusion.** The software takes one image's pixel, the seed, and fuses with it the depth maps of its
neighbours that agree. What they showed is used up, and later seeds fuse what is left. So the points
of a place come from a few groups of images, and each group has the bed at another apparent height:
a metre apart under deep water, where there are obliques.

*With a view list* the fused maps are known. Each counts by its weight, that of the list or one by
its squared distance. The maps that were averaged into it before share that weight.

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
from pcfix.lens.algebra import Vector, beyond, cross, dot, minus, row_of, scaled
from pcfix.lens.frames import holds
from pcfix.model import FloatArray, IntArray
from pcfix.refract.batch import (
    CORRECTED,
    NO_CAMERA,
    ONE_CAMERA,
    Batch,
    Chosen,
    Images,
    Intersection,
    images_of,
    normal_above,
    to_adjusted,
    to_original,
)
from pcfix.refract.matcher import MATCHED, Matcher
from pcfix.refract.rays import light_near, refracted
from pcfix.refract.tiling import are_same

MAX_LOOKS = 5
CLOSE_M = 0.002
"""Step of the bed below which the rest is linear."""

LIKELY, LEAST_DEPTH_M = 1.1, 0.005
"""Likely height of the bed, in terms of (n - 1) times the depth; the least depth."""

LEAST_CHANGE, MOST_CHANGE = 0.35, 1.5
"""Range of the change of the apparent depth with that of the bed along a ray."""

WIDTH_M = 0.2
"""Standard deviation of the beds of groups that may have made a point."""

NOTHING = 14.0
"""exp(-NOTHING), a millionth, is neglected."""

AVERAGED_WITHIN = 0.012
"""Depths of neighbouring maps that differ by less, relative, are averaged before the fusion."""

_DISTANCE, AMBIGUITY, OUTCOME, _COUNT = 3, 4, 5, 6
COLUMNS = 7
"""Columns that the kernels write: the shift, and these."""

DEPTH, BY_HEIGHT, _X, _Y, _X_BY_HEIGHT, _Y_BY_HEIGHT = range(6)
"""Rows of `Room.looks`: the depth of a bed in a map beyond P, by the distance of P from the
camera, and its change with the height of the bed (1/m); the place on the bed, and its change."""

ABSENT = -1


class Block(NamedTuple):
    """All points and cameras, the images of the original model, and the matcher, for kernels."""

    points: Chosen
    images: Images
    matcher: Matcher
    offset_m: float  # how much higher the water stood, mean over all images


class Sight(NamedTuple):
    """One apparent point, for kernels."""

    now: Vector  # its place, world frame
    original: Vector  # the same in the original model
    above: float  # height of the water over it, along the normal, metres
    normal: Vector  # of the water, upward


class Room(NamedTuple):
    """Temporary arrays for one point and the k images."""

    weight: FloatArray  # (k,), of each map, with what is averaged into it
    looks: FloatArray  # (6, k), of `_look`
    partners: FloatArray  # (partners, 3), of `_compare`
    pairs: FloatArray  # (pairs of partners, 2), of `best_pairs`


@device
def sight_of(points: Chosen, i: int) -> Sight:
    """Return point i."""
    normal = normal_above(points, i)
    above = normal[2] * (points.height[i] - points.xyz[i, 2])
    return Sight(row_of(points.xyz, i), row_of(points.original_xyz, i), above, normal)


@device(forceinline=True)
def original_up(sight: Sight, block: Block, c: int) -> Vector:
    """Return the vector from the point to the projection centre, both of the original model."""
    return minus(row_of(block.images.centres, c), sight.original)


class Lines(NamedTuple):
    """The depth of each map as a linear function of the height of the bed; NaN without one."""

    bed: float  # a height of the bed, relative to the apparent point, metres
    t: FloatArray  # (maps,), the depth of that bed; see `DEPTH`
    slope: FloatArray  # its change with the height, 1/m


@device
def look(
    maps: IntArray, weight: FloatArray, bed: float, sight: Sight, block: Block, room: Room
) -> None:
    """Compute the depths of a bed in the maps of those images that have a weight; see `_look`."""
    for q in range(maps.size):
        if weight[q] > 0.0:
            _look(room.looks[:, q], maps[q], bed, sight, block, room)


@device
def lines_at(bed: float, maps: IntArray, sight: Sight, block: Block, room: Room) -> Lines:
    """Return the lines of the depth maps of some images about a bed."""
    room.weight[: maps.size] = 1.0
    look(maps, room.weight, bed, sight, block, room)
    return Lines(bed, room.looks[DEPTH, : maps.size], room.looks[BY_HEIGHT, : maps.size])


@device
def likely_bed(sight: Sight, block: Block) -> float:
    """Return a likely height of the bed, relative to the apparent point."""
    above = sight.above + sight.normal[2] * block.offset_m
    return -LIKELY * max(above, LEAST_DEPTH_M) / sight.normal[2] * (block.points.n - 1.0)


@device
def balance(t: FloatArray, slope: FloatArray, weight: FloatArray) -> float:
    """Return how far up the bed is at which the weighted mean of the depths is zero."""
    total, change = 0.0, 0.0
    for q in range(t.size):
        if weight[q] > 0.0 and slope[q] == slope[q]:
            total, change = total + weight[q] * t[q], change + weight[q] * slope[q]
    return -total / change


@device
def settle_bed(
    row: FloatArray, maps: IntArray, weight: FloatArray, depths: Lines, sight: Sight,
    block: Block, room: Room,
) -> None:  # fmt: skip
    """Find the height of the bed at which the fused depths give the apparent point; write the row.

    Starts from the lines that were computed last and repeats until the steps are small.
    """
    row[OUTCOME] = NO_CAMERA if maps.size == 0 else ONE_CAMERA
    bed, looks = depths.bed, room.looks
    step = balance(depths.t, depths.slope, weight)
    for _ in range(MAX_LOOKS):
        # no image with a weight sees the bed
        if not np.isfinite(step):
            return
        if abs(step) <= CLOSE_M:
            break
        bed += step
        look(maps, weight, bed, sight, block, room)
        step = balance(depths.t, depths.slope, weight)
    # the true point is the weighted mean of the Q_i, moved by the rest of the step
    total, x, y, squares, count = 0.0, 0.0, 0.0, 0.0, 0.0
    for q in range(maps.size):
        if weight[q] > 0.0 and looks[BY_HEIGHT, q] == looks[BY_HEIGHT, q]:
            w, px = weight[q], looks[_X, q] + step * looks[_X_BY_HEIGHT, q]
            py = looks[_Y, q] + step * looks[_Y_BY_HEIGHT, q]
            total, x, y = total + w, x + w * px, y + w * py
            squares, count = squares + w * (px * px + py * py), count + 1.0
    if not (np.isfinite(step) and np.isfinite(squares)):
        return
    row[0], row[1], row[2] = x / total, y / total, bed + step
    row[_DISTANCE] = np.sqrt(max(squares / total - row[0] ** 2 - row[1] ** 2, 0.0))
    row[OUTCOME], row[_COUNT] = CORRECTED, count


@device(forceinline=True)
def _look(out: FloatArray, c: int, bed: float, sight: Sight, block: Block, room: Room) -> None:
    """Compute the depth of a bed, at a height relative to the apparent point P, in one depth map.

    Its change with the height is approximate. NaN where no partner of image c sees the bed there.
    """
    n, normal = block.points.n, sight.normal
    a, e, above = _ray(c, sight, block)
    # H and L^2; f leads to the piercing point, as in `rays`
    across, length2 = dot(normal, e), dot(e, e)
    per_across = 1.0 / across
    f, bend = (above * per_across, 1.0 / n) if above > 0.0 else (0.0, 1.0)
    d = refracted(e, length2, normal, across, bend)
    a, down = beyond(a, f, e), 1.0 / d[2]
    s = (bed - a[2]) * down  # along the refracted ray from the water to the bed
    q = a[0] + s * d[0], a[1] + s * d[1], bed
    out[_X], out[_Y] = q[0], q[1]
    out[_X_BY_HEIGHT], out[_Y_BY_HEIGHT] = d[0] * down, d[1] * down
    up = original_up(sight, block, c)
    length = np.sqrt(dot(up, up))
    count = _compare(room.partners, c, q, length, sight, block)
    t = best_pairs(room.partners[:count], room.pairs, block.matcher.tolerance_px2)
    out[DEPTH] = t / length
    # the change of the depth with the bed is nearly that of the whole water column
    away, depth = np.sqrt(length2), dot(normal, minus(a, q))
    per_depth = away * per_across
    change = (t + f * away) / depth if depth > LEAST_DEPTH_M else per_depth / n
    change = min(max(change, LEAST_CHANGE * per_depth), MOST_CHANGE * per_depth)
    out[BY_HEIGHT] = -change / length if t == t else np.nan


@device(forceinline=True)
def _ray(c: int, sight: Sight, block: Block) -> tuple[Vector, Vector, float]:
    """Return the ray on which image c shows the point.

    Its nearest place to the point, relative to the point; the vector from there to the projection
    centre; and the height of the water over that place, metres.
    """
    up = minus(row_of(block.points.centres, c), sight.now)
    above = sight.above + sight.normal[2] * block.points.offset[c]
    if block.images.same:
        return (0.0, 0.0, 0.0), up, above
    # the ray of the original image, in the adjusted camera
    d = to_adjusted(block.images, c, scaled(-1.0, original_up(sight, block, c)))
    e = scaled(dot(up, d) / dot(d, d), d)
    a = minus(up, e)
    return a, e, above - dot(sight.normal, a)


@device
def _compare(
    partners: FloatArray, c: int, q: Vector, length: float, sight: Sight, block: Block
) -> int:
    """Write what the partners of image c see of a bed at Q; return how many see it.

    The depth beyond P along the ray of c (m), its squared residual (px^2) and half the curvature of
    that (px^2/m^2). The light path is the true one; its direction in the image, P and the ray are
    those of the original model.
    """
    points, matcher, original = block.points, block.matcher, original_up(sight, block, c)
    u, count = scaled(-1.0 / length, original), 0
    for j in matcher.matched[c]:
        if j < 0:
            break
        up = minus(row_of(points.centres, j), sight.now)
        above = sight.above + sight.normal[2] * points.offset[j]
        k, _, _, _, s = light_near(q, up, sight.normal, above, points.n)
        w = to_original(block.images, j, minus(scaled(k, s), sight.normal))
        sees = dot(sight.normal, up) > above and holds(matcher.inner, j, scaled(-1.0, w))
        if not sees:
            continue
        # where the ray w of j is nearest to u; it has any length
        base, across = minus(original, original_up(sight, block, j)), cross(u, w)
        sine2, along, w2 = dot(across, across), dot(u, w), dot(w, w)
        away = (dot(base, w) * along - dot(base, u) * w2) / sine2
        # pixels per metre at that place, by the length of w, as the image of j sees it
        scale = matcher.focal_px[j] / (dot(base, w) + away * along)
        off = scale * dot(base, across)
        partners[count, 0], partners[count, 1] = away - length, off * off * w2 / sine2
        partners[count, 2] = scale * scale * sine2
        count += 1
    return count


@device
def best_pairs(partners: FloatArray, pairs: FloatArray, tolerance: float) -> float:
    """Return the depth at which two images agree best, as a weighted mean over the pairs.

    See `_compare`. NaN without a partner; of a single partner its own depth. `pairs` gets the
    squared residuals of two images at their common depth, and that depth.
    """
    count, least = 0, np.inf
    if len(partners) < 2:
        return partners[0, 0] if len(partners) else np.nan
    for p in range(len(partners)):
        for q in range(p + 1, len(partners)):
            a, b = partners[p, 2], partners[q, 2]
            # the minimum of the sum of two parabolas
            off, share = partners[q, 0] - partners[p, 0], b / (a + b)
            cost = partners[p, 1] + partners[q, 1] + a * share * off * off
            pairs[count, 0], pairs[count, 1] = cost, partners[p, 0] + share * off
            least, count = min(least, cost), count + 1
    total, sum_t = 0.0, 0.0
    for p in range(count):
        # the weights fall off by e for each `tolerance` of squared residuals
        worse = (pairs[p, 0] - least) / tolerance
        if worse < NOTHING:
            w = np.exp(-worse)
            total, sum_t = total + w, sum_t + w * pairs[p, 1]
    return sum_t / total


AGREE = 0.01
"""Depths that differ by less, relative, are fused."""

SHALLOW, DEEP = 0.3, 3.5
"""Range of the bed of the surroundings, in likely heights; outliers have it elsewhere."""

_ROUNDS, _BEDS = 4, 3
FAR = 0.1
"""Of the way to the bed: farther off, it is decided anew which depths were averaged."""

_OUTSIDE = -2


def invert_depth_maps(batch: Batch) -> Intersection:
    """Return the true points from which fused depth maps would have made the apparent ones.

    The views of the batch are, if their kind is depth-maps, the images whose maps were fused, with
    their weights; else all images that see each point. `batch.survey.learned` has the matcher and
    perhaps the bed of the surroundings; without it the largest group made a point. The surface
    above each point is taken as a plane. The rays of the result are the maps with a weight.
    """
    rays, bed = batch.rays, batch.survey.learned.bed
    listed = rays.kind == "depth-maps"
    if listed:
        given = np.zeros(0) if rays.weight is None else rays.weight.astype(np.float64)
    else:
        given = np.full(len(batch), np.nan) if bed is None else bed.height_at(batch.xyz[:, :2])
    result = np.zeros((len(batch), COLUMNS))
    _invert_all(batch, listed, given, result, np.zeros((0, 0), np.float32))
    outcome = result[:, OUTCOME].astype(np.uint8)
    found = batch.result(result[:, :3], outcome=outcome, ray_miss_m=result[:, _DISTANCE])
    moved = outcome == CORRECTED
    return found._replace(
        ambiguity_m=np.where(moved, result[:, AMBIGUITY], 0.0),
        ray_count=np.where(moved, result[:, _COUNT], 0).astype(np.int32),
    )


def likely_beds(batch: Batch) -> FloatArray:
    """Return the heights of the bed from which different groups of images would have made points.

    Relative to each apparent point, metres, float32, shape (m, most views); NaN if there is none.
    """
    likely = np.full((len(batch.xyz), max(1, batch.counts.max(initial=0))), np.nan, np.float32)
    _invert_all(batch, False, np.zeros(0), np.zeros((0, 0)), likely)
    return likely


def _invert_all(
    batch: Batch, listed: bool, given: FloatArray, result: FloatArray, likely: FloatArray
) -> None:
    matcher = batch.survey.learned.matcher
    if matcher is None:
        raise ValueError("a model of the matcher is needed")
    images = images_of(batch.original_model, batch.survey.cameras)
    points = batch.chosen()
    block = Block(points, images, matcher, float(points.offset.mean()))
    in_tiles(
        _invert_tile, len(batch), block, listed, given, result, likely, points=len(batch)
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
def _invert_tile(
    span: Span, block: Block, listed: bool, given: FloatArray, result: FloatArray,
    likely: FloatArray,
) -> None:  # fmt: skip
    """Invert the fusion of some points or, where `likely` has rows, fill these in.

    With lists `given` are the weights of their entries, if there are any; without, the heights of
    the bed of the surroundings.
    """
    matcher, k = block.matcher, len(block.points.centres)
    room = Room(
        np.empty(k), np.empty((6, k)), np.empty((MATCHED, 3)), np.empty((MATCHED * MATCHED, 2))
    )
    groups = Groups(
        np.full((k, matcher.averaged.shape[1] + 1), ABSENT),
        np.full((k, matcher.fused.shape[1] + 1), ABSENT),
        np.full(k, ABSENT), np.empty(k, np.int64), np.empty(k), np.empty(k), np.empty(k),
        np.empty(k), np.empty(k), np.empty(k),
    )  # fmt: skip
    _invert_points(span, listed, given, result, likely, groups, block, room)


@device
def _invert_points(
    span: Span, listed: bool, given: FloatArray, result: FloatArray, likely: FloatArray,
    groups: Groups, block: Block, room: Room,
) -> None:  # fmt: skip
    """Do as `_invert_tile` with room for one point.

    It makes no arrays, so that references to the many that it reads are not counted.
    """
    points, before = block.points, block.points.camera[:0]
    for i in range(*span):
        first, last = points.start[i], points.start[i + 1]
        cameras, sight = points.camera[first:last], sight_of(points, i)
        if listed:
            weight = given[first:last] if given.size else given
            _invert_listed(result[i], cameras, weight, groups, sight, block, room)
            continue
        # points with the same cameras share their groups
        if not are_same(cameras, before):
            _group(groups, cameras, block.matcher)
        before = cameras
        if len(likely):
            bed = likely_bed(sight, block)
            depths = _rises_of(bed, cameras, groups, sight, block, room)
            for seed in range(cameras.size):
                if depths.slope[seed] == depths.slope[seed]:
                    likely[i, seed] = bed + groups.rise[seed]
        else:
            _invert_one(result[i], cameras, given[i], groups, sight, block, room)


@device
def _invert_one(
    row: FloatArray, maps: IntArray, around: float, groups: Groups, sight: Sight, block: Block,
    room: Room,
) -> None:  # fmt: skip
    """Find the group that made a point, and invert the fusion of its maps."""
    wanted, bed = around - sight.now[2], likely_bed(sight, block)
    if wanted == wanted:  # the bed of the surroundings is known
        bed = max(min(wanted, SHALLOW * bed), DEEP * bed)
    depths = _rises_of(bed, maps, groups, sight, block, room)
    seed, rise, row[AMBIGUITY] = _best_seed(groups, depths, wanted - bed)
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
    settle_bed(row, maps, weight, depths, sight, block, room)


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
    bed: float, maps: IntArray, groups: Groups, sight: Sight, block: Block, room: Room
) -> Lines:
    """Set the weights of the depth maps and the rises of their groups; return their lines."""
    depths = lines_at(bed, maps, sight, block, room)
    for q in range(maps.size):
        # the pixel on the ground grows with the distance
        up = original_up(sight, block, maps[q])
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
    block: Block, room: Room,
) -> None:  # fmt: skip
    """Invert the fusion of the maps in the list of a point, with their weights."""
    maps = groups.found[: _with_neighbours(groups, listed, sight, block)]
    _group(groups, maps, block.matcher)
    bed, step, weight = likely_bed(sight, block), 0.0, room.weight[: maps.size]
    for _ in range(_BEDS):
        bed += step
        # which depths agree depends on the bed, and the bed on which agree
        depths = lines_at(bed, maps, sight, block, room)
        step = 0.0
        for _ in range(_ROUNDS):
            for q in range(maps.size):
                groups.own[q], weight[q] = depths.t[q] + depths.slope[q] * step, 0.0
            for k in range(listed.size):
                up = original_up(sight, block, listed[k])
                share = given[k] if given.size else 1.0 / dot(up, up)
                _share(weight, groups.place[listed[k]], share, groups)
            step = balance(depths.t, depths.slope, weight)
        if not abs(step) > FAR * abs(bed):
            break
    settle_bed(row, maps, weight, depths, sight, block, room)


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
                if holds(matcher.inner, a, original_up(sight, block, a)):
                    place[a], groups.found[count] = count, a
                    count += 1
    return count

r"""Where dense matching puts a point under water, and how to undo exactly that.

A dense cloud is not triangulated from tracks. For one image after the other the matcher finds how
deep each pixel lies along its own ray, so that the images it is compared with agree best: a depth
map. Then each depth is averaged with those of neighbouring maps that see the same place, and the
maps are fused: a point is the weighted mean of the depths of several images, each along its own
ray. Under water these depths differ, as each depends on where the compared images stand.

The model, for an apparent point P, a bed at the height z, level around P, and one image i:

1. The ray from the projection centre i through P bends into the water and meets the bed in Q_i.
2. From Q_i the light goes back to the images j that i was matched with; each sees Q_i in the
   direction a_ij.
3. The depth map has P + t u_i on the ray u_i, where the two images that agree best agree: for
   each pair of j the t with the least squared distances in the images, and of these the mean with
   the weights exp(-squares / `Matcher.tolerance_px2`). PatchMatch scores a depth by its two best
   images; which these are changes from pixel to pixel.

The fused point is P where sum_i W_i t_i u_i = 0 along the vertical: one equation for z. The true
point is the mean of the Q_i with the same weights.

A level bed will do: a slope of it moves the Q_i and the directions a_ij nearly alike.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, in_tiles, inlined, kernel, lean
from pcfix.lens.algebra import Vector, beyond, dot, minus, row_of, scaled
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
    as_made,
    as_now,
    images_of,
)
from pcfix.refract.matcher import Matcher
from pcfix.refract.rays import direction, light_path, refracted

MAX_LOOKS = 5
CLOSE_M = 0.002
"""Between two looks; what is left is mended in a straight line."""

LEAST_RISE_M = 0.005
AVERAGED_WITHIN = 0.012
"""Depths of neighbouring maps that differ by less, relative, are averaged before the fusion."""

_ROUNDS = 4
_MISS, AMBIGUITY, OUTCOME, _COUNT = 3, 4, 5, 6
COLUMNS = 7
"""Of what the kernels write: the shift, and these."""


def invert_depth_maps(batch: Batch) -> Intersection:
    """Return the true points from which dense matching would have made the apparent ones.

    Parameters
    ----------
    batch : Batch
        Its views are the images whose depth maps were fused, with their weights;
        `batch.survey.learned.matcher` says how they were matched.

    Notes
    -----
    The surface above each point is taken as a plane.
    """
    weights = batch.rays.weight
    result = np.zeros((len(batch.xyz), COLUMNS))
    given = np.zeros(0) if weights is None else weights.astype(np.float64)
    in_tiles(_invert, len(batch), *arrays_of(batch), given, result)
    return intersection_of(batch, result)


class Sight(NamedTuple):
    """What the k images have of one apparent point, for kernels.

    Attributes
    ----------
    up : array, shape (k, 3)
        From the point to the projection centres, metres, world frame.
    made : array, shape (k, 3)
        The same as the matcher had them, and the point; `up` itself where it is not corrected with
        other cameras.
    above : array, shape (k,)
        Height of the water of each image over the point, along the normal, metres.
    normal : Vector
        Of the water, upward.
    n : float
        Refractive index.
    """

    up: FloatArray
    made: FloatArray
    above: FloatArray
    normal: Vector
    n: float


class Room(NamedTuple):
    """Room for one point and the k images, so that no kernel makes arrays.

    up, made : shape (k, 3); above : shape (k,), of `Sight`.
    t, slope : shape (k,), of `Lines`.
    weight, now : shape (k,), what each map counts for, and its depth as it is now.
    looks : shape (k, 5), of `_look`.
    pairs : shape (partners, 3), of `_depth`.
    place, found : shape (k,), where each image is among those found, and these.
    """

    up: FloatArray
    made: FloatArray
    above: FloatArray
    t: FloatArray
    slope: FloatArray
    weight: FloatArray
    now: FloatArray
    looks: FloatArray
    pairs: FloatArray
    place: IntArray
    found: IntArray


@kernel
def room_for(k: int, partners: int) -> Room:
    """Return new room, in which no image has a place."""
    return Room(
        np.empty((k, 3)), np.empty((k, 3)), np.empty(k), np.empty(k), np.empty(k), np.empty(k),
        np.empty(k), np.empty((k, 5)), np.empty((partners, 3)), np.full(k, ABSENT),
        np.empty(k, np.int64),
    )  # fmt: skip


@lean
def look_at(room: Room, points: Chosen, i: int, images: Images) -> None:
    """Fill in what the images have of point i: `up`, `made` and `above`."""
    apart = len(images.centres) > 0
    for c in range(len(points.centres)):
        for axis in range(3):
            up = points.centres[c, axis] - points.xyz[i, axis]
            room.up[c, axis] = room.made[c, axis] = up
            if apart:
                room.made[c, axis] = images.centres[c, axis] - points.made_xyz[i, axis]
        above = points.height[i] - points.xyz[i, 2] + points.offset[c]
        room.above[c] = points.normals[i, 2] * above


def arrays_of(batch: Batch) -> tuple[Chosen, Images, Matcher]:
    """Return what the kernels take of a batch: points, images and the matcher."""
    matcher = batch.survey.learned.matcher
    if matcher is None:
        raise ValueError("a model of the matcher is needed")
    images = images_of(batch.made_with, batch.survey.cameras)
    return batch.chosen(), images, matcher


def intersection_of(batch: Batch, result: FloatArray) -> Intersection:
    """Return the rows that the kernels wrote as a result; its `sigma_z_m` is the ambiguity.

    The rays are those of the depth maps that count, averaged ones included.
    """
    found = batch.result(
        result[:, :3], outcome=result[:, OUTCOME].astype(np.uint8), ray_miss_m=result[:, _MISS]
    )
    moved = found.outcome == CORRECTED
    return found._replace(
        sigma_z_m=np.where(moved, result[:, AMBIGUITY], 0.0),
        ray_count=np.where(moved, result[:, _COUNT], 0).astype(np.int32),
    )


@kernel
def _invert(
    span: Span, points: Chosen, images: Images, matcher: Matcher, weight: FloatArray,
    result: FloatArray,
) -> None:  # fmt: skip
    room = room_for(len(points.centres), matcher.matched.shape[1])
    for i in range(*span):
        first, last = points.start[i], points.start[i + 1]
        given = weight[first:last] if weight.size else weight
        _invert_one(result[i], points, i, points.camera[first:last], given, images, matcher, room)


@lean
def _invert_one(
    row: FloatArray, points: Chosen, i: int, listed: IntArray, given: FloatArray, images: Images,
    matcher: Matcher, room: Room,
) -> None:  # fmt: skip
    look_at(room, points, i, images)
    made, normal = room.made, row_of(points.normals, i)
    sight = Sight(room.up, made, room.above, normal, points.n)
    maps = room.found[: _with_neighbours(room.found, room.place, listed, made, matcher)]
    t, slope = room.t[: maps.size], room.slope[: maps.size]
    depths = Lines(find_lines(t, slope, maps, sight, images, matcher, room), t, slope)
    counts, now, step = room.weight[: maps.size], room.now, 0.0
    for _ in range(_ROUNDS):
        for q in range(maps.size):
            now[q] = t[q] + slope[q] * step
        _share(counts, room.place, listed, given, made, now, matcher)
        step = balance(t, slope, counts)
    settle_bed(row, maps, counts, depths, sight, images, matcher, room)
    for q in maps:
        room.place[q] = ABSENT
    for c in listed:
        for a in matcher.averaged[c]:
            if a >= 0:
                room.place[a] = ABSENT


ABSENT, _OUTSIDE = -1, -2


@lean
def _with_neighbours(
    found: IntArray, place: IntArray, listed: IntArray, made: FloatArray, matcher: Matcher
) -> int:
    """Gather the listed images and those in frame that their depths were averaged with.

    Returns how many they are. `place` says where each image is among them.
    """
    count = 0
    for c in listed:
        if place[c] < 0:
            place[c], found[count] = count, c
            count += 1
        for a in matcher.averaged[c]:
            if a < 0:
                break
            if place[a] == ABSENT:
                place[a] = _OUTSIDE
                if holds(matcher.inner, a, row_of(made, a)):
                    place[a], found[count] = count, a
                    count += 1
    return count


@lean
def _share(
    counts: FloatArray, place: IntArray, listed: IntArray, given: FloatArray, made: FloatArray,
    now: FloatArray, matcher: Matcher,
) -> None:  # fmt: skip
    """Set what each depth map counts for in the point, with their depths as they are now.

    A fused map counts by its weight, that of the matcher or one by its squared distance, and
    shares it evenly with the maps it was averaged with before.
    """
    counts[:] = 0.0
    for k in range(listed.size):
        c = listed[k]
        w = given[k] if given.size else 1.0 / dot(row_of(made, c), row_of(made, c))
        own, members = place[c], 1.0
        for a in matcher.averaged[c]:
            members += averages(own, a, now, place)
        counts[own] += w / members
        for a in matcher.averaged[c]:
            if averages(own, a, now, place):
                counts[place[a]] += w / members


@lean
def averages(own: int, a: int, now: FloatArray, place: IntArray) -> bool:
    """Whether a depth is averaged with that of image a: both show the place, nearly alike."""
    if a < 0 or place[a] < 0:
        return False
    return bool(abs(now[place[a]] - now[own]) < AVERAGED_WITHIN)


class Lines(NamedTuple):
    """How the depth of each map changes with the height of the bed, nearly in a line.

    Attributes
    ----------
    bed : float
        A likely height of the bed, relative to the apparent point, metres.
    t, slope : array, shape (maps,)
        How far beyond the apparent point the map has that bed, relative to the distance from the
        camera, and the change of it with the height, 1/m. NaN where it has none.
    """

    bed: float
    t: FloatArray
    slope: FloatArray


@lean
def find_lines(
    t: FloatArray, slope: FloatArray, maps: IntArray, sight: Sight, images: Images,
    matcher: Matcher, room: Room,
) -> float:  # fmt: skip
    """Fill in the lines of the depth maps of some images, and return their likely bed."""
    deep = 0.0
    for c in range(sight.above.size):
        deep += sight.above[c]
    deep = -(deep / sight.above.size) / sight.normal[2] * (sight.n - 1.0)
    bed, rise = 1.1 * deep, min(0.1 * deep, -LEAST_RISE_M)
    out = room.looks[0]
    for q in range(maps.size):
        _look(out, maps[q], bed, sight, images, matcher, room.pairs)
        t[q] = out[0]
        _look(out, maps[q], bed + rise, sight, images, matcher, room.pairs)
        slope[q] = (out[0] - t[q]) / rise
        usual = 1.0 / (sight.n * sight.made[maps[q], 2])
        if slope[q] == slope[q] and not 0.5 < -slope[q] / usual < 2.0:
            slope[q] = -usual  # another pair of images was the best one there
    return bed


@lean
def balance(t: FloatArray, slope: FloatArray, weight: FloatArray) -> float:
    """Return how far up the bed must go so that the weighted mean of the depths is zero."""
    total, change = 0.0, 0.0
    for q in range(t.size):
        if weight[q] > 0.0 and slope[q] == slope[q]:
            total, change = total + weight[q] * t[q], change + weight[q] * slope[q]
    return -total / change


@lean
def settle_bed(
    row: FloatArray, maps: IntArray, weight: FloatArray, depths: Lines, sight: Sight,
    images: Images, matcher: Matcher, room: Room,
) -> None:  # fmt: skip
    """Find the height of the bed at which the fused depths give the apparent point, and write it.

    From where the lines say, and looked at again until they need not be mended.
    """
    row[OUTCOME] = NO_CAMERA if maps.size == 0 else ONE_CAMERA
    bed, slope = depths.bed, depths.slope
    step = balance(depths.t, slope, weight)
    looks = room.looks[: maps.size]
    for _ in range(MAX_LOOKS):
        if not np.isfinite(step):
            return
        bed += step
        for q in range(maps.size):
            if weight[q] > 0.0:
                _look(looks[q], maps[q], bed, sight, images, matcher, room.pairs)
            else:
                looks[q, 0] = 0.0
        step = balance(looks[:, 0], slope, weight)
        if abs(step) < CLOSE_M:
            break
    total, x, y, squares, count = 0.0, 0.0, 0.0, 0.0, 0.0
    for q in range(maps.size):
        if weight[q] > 0.0 and slope[q] == slope[q]:
            w, px = weight[q], looks[q, 1] + step * looks[q, 3]
            py = looks[q, 2] + step * looks[q, 4]
            total, x, y = total + w, x + w * px, y + w * py
            squares, count = squares + w * (px * px + py * py), count + 1.0
    if not (np.isfinite(step) and np.isfinite(squares)):
        return
    row[0], row[1], row[2] = x / total, y / total, bed + step
    row[_MISS] = np.sqrt(max(squares / total - row[0] ** 2 - row[1] ** 2, 0.0))
    row[OUTCOME], row[_COUNT] = CORRECTED, count


@lean
def _look(
    out: FloatArray, c: int, bed: float, sight: Sight, images: Images, matcher: Matcher,
    work: FloatArray,
) -> None:  # fmt: skip
    """Say where the depth map of image c has a bed at a height relative to the apparent point.

    Writes how far beyond P, relative to the distance from the camera, the place on the bed, and how
    that moves with the height.
    """
    a, e, above = _ray(c, sight, images)
    across, wet = dot(sight.normal, e), sight.above[c] > 0.0
    f, bend = (above / across, 1.0 / sight.n) if wet else (0.0, 1.0)
    d = refracted(e, dot(e, e), sight.normal, across, bend)
    a = beyond(a, f, e)
    s = (bed - a[2]) / d[2]
    out[1], out[2] = a[0] + s * d[0], a[1] + s * d[1]
    out[3], out[4] = d[0] / d[2], d[1] / d[2]
    made = row_of(sight.made, c)
    length = np.sqrt(dot(made, made))
    u = -made[0] / length, -made[1] / length, -made[2] / length
    out[0] = _depth(c, (out[1], out[2], bed), u, sight, images, matcher, work) / length


@inlined
def _ray(c: int, sight: Sight, images: Images) -> tuple[Vector, Vector, float]:
    """Return the ray on which image c shows the point.

    Where it passes the point, relative to it, the way from there to the projection centre, and how
    high the water is over there.
    """
    up = row_of(sight.up, c)
    if len(images.centres) == 0:
        return (0.0, 0.0, 0.0), up, sight.above[c]
    d = as_now(images, c, scaled(-1.0, row_of(sight.made, c)))
    e = scaled(dot(up, d) / dot(d, d), d)
    a = minus(up, e)
    return a, e, sight.above[c] - dot(sight.normal, a)


@inlined
def _depth(
    c: int, q: Vector, u: Vector, sight: Sight, images: Images, matcher: Matcher, work: FloatArray
) -> float:
    """Return how far beyond P, m along its ray u, the depth map of image c has the bed at Q.

    NaN where none of the images that it was matched with sees Q. The light goes as it does; where
    it seems to come from, and P and u, are as the matcher had them.
    """
    count = 0
    for j in matcher.matched[c]:
        if j < 0:
            break
        path = light_path(q, row_of(sight.up, j), sight.normal, sight.above[j], sight.n)
        a = as_made(images, j, direction(path, sight.normal))
        if not (path[0] == path[0] and holds(matcher.inner, j, scaled(-1.0, a))):
            continue
        a, e = scaled(1.0 / np.sqrt(dot(a, a)), a), row_of(sight.made, j)
        p = minus(scaled(-1.0, e), scaled(-dot(e, a), a))
        g = minus(u, scaled(dot(u, a), a))
        scale = matcher.focal_px[j] ** 2 / dot(e, e)
        work[count, 0], work[count, 1] = scale * dot(p, p), scale * dot(p, g)
        work[count, 2] = scale * dot(g, g)
        count += 1
    if count == 0:
        return np.nan
    if count == 1:
        return -work[0, 1] / work[0, 2]
    return _best_pairs(work[:count], matcher.tolerance_px2)


@lean
def _best_pairs(work: FloatArray, tolerance: float) -> float:
    """Return the depth at which two images agree best: a mean over the pairs, the best most.

    Rows of `work`: the squared residual at t = 0, half its derivative, its curvature.
    """
    least, total, sum_t = np.inf, 0.0, 0.0
    for p in range(len(work)):
        for q in range(p + 1, len(work)):
            half, curved = work[p, 1] + work[q, 1], work[p, 2] + work[q, 2]
            cost = work[p, 0] + work[q, 0] - half * half / curved
            if cost < least:
                shrink = np.exp((cost - least) / tolerance) if total > 0.0 else 0.0
                total, sum_t, least = total * shrink, sum_t * shrink, cost
            w = np.exp((least - cost) / tolerance)
            total += w
            sum_t -= w * half / curved
    return sum_t / total

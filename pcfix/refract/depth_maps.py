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

*With a view list* the fused maps are known: the list is the only group. Each map counts by its
weight, that of the list or one by its squared distance. The maps that were averaged into it before
share that weight.

*Without a list* the model fuses, for each image that sees the point, the maps that would agree with
it as the seed, and computes the height of the bed if that group had made the point: the likely
beds. Neighbouring points come from different groups, and only the true bed is among the likely ones
of all. So the height that most points around can have come from, the bed of the surroundings
(`pcfix.refract.matcher`), identifies the group of each point.

A point needs some 80 light paths for each bed that is tried.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import beyond, dot, minus, row_of, scaled
from pcfix.lens.frames import holds, mark
from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.refract import tiling
from pcfix.refract.batch import (
    CORRECTED,
    NO_CAMERA,
    ONE_CAMERA,
    Batch,
    Chosen,
    Images,
    Intersection,
    images_of,
    in_other,
)
from pcfix.refract.likelihood import Candidates
from pcfix.refract.matcher import LEAST_NEAR, NEAR, Matcher
from pcfix.refract.rays import light_near, refracted
from pcfix.refract.tiling import TILE, are_same, put, slots, three

MAX_LOOKS = 5
CLOSE_M = 0.002  # step of the bed below which the rest is linear

LIKELY, LEAST_DEPTH_M = 1.1, 0.005
"""Likely height of the bed, in terms of (n - 1) times the depth; the least depth."""

LEAST_CHANGE, MOST_CHANGE = 0.35, 1.5
"""Range of the change of the apparent depth with that of the bed along a ray."""

NOTHING = 14.0  # exp(-NOTHING), a millionth, is neglected

AVERAGED_WITHIN = 0.012
"""Depths of neighbouring maps that differ by less, relative, are averaged before the fusion."""

BASE_RAY_DEG, LEAST_PRIOR = 27.0, 1e-4
"""Angle of the ray of a base image from the vertical at which it is e times less frequent."""

AGREE = 0.01  # depths that differ by less, relative, are fused

SHALLOW, DEEP = 0.3, 3.5
"""Range of the bed of the surroundings, in likely heights; outliers have it elsewhere."""

_ROUNDS, _ROUNDS_OF_LIST, _BEDS_OF_LIST = 1, 2, 3
"""How often the averaged maps are chosen again for the bed of a group; beds that are tried."""
FAR = 0.1  # of the way to the bed: farther off, the averaged depths are chosen again

SINGLE = ("single-map", "nearest-map")
"""Names of `pcfix.options` for software that keeps one map at each place."""

ABSENT, _OUTSIDE = -1, -2

_DISTANCE, AMBIGUITY, OUTCOME, _COUNT = 3, 4, 5, 6
COLUMNS = 7  # columns that the kernels write: the shift, and these

# Runs of `TILE` numbers. Of the look of a bed in one depth map: the depth of that bed beyond P, by
# the distance of P from the camera, and its change with the height of the bed (1/m); the place on
# the bed (2), and its change (2).
DEPTH, BY_HEIGHT, _PLACE, _PLACE_BY_HEIGHT, LOOK = slots(1, 1, 2, 2)
# Of the points: the height of the bed. Of one map: the ray u and the distance of its projection
# centre, Q, what the change of the depth with the bed depends on (3). Of one partner: the direction
# w, whether it sees Q; the only depth, how many partners see Q, the least cost, and the sums of the
# mean.
(
    BED, _RAY, _LENGTH, _Q, _AWAY, _WATER, _STEEP, _W, _SEES, _SOLE, _SEEN, _LEAST, _TOTAL, _SUM,
    ROOM,
) = slots(1, 3, 1, 3, 1, 1, 1, 3, 1, 1, 1, 1, 1, 1)  # fmt: skip
# Of a partner: the depth beyond P along the ray (m), its squared residual (px^2), and half the
# curvature of that (px^2/m^2). Of a pair: its squared residual, and its depth.
_AT, _SQUARES, _CURVATURE, PARTNER = slots(1, 1, 1)
_COST, _PAIR_AT, PAIR = slots(1, 1)
# Of the points, after the runs of `tiling.gather`: P in the original model.
_ORIGINAL, _POINT = 7, 10


class Block(NamedTuple):
    """All points and cameras, the images of the original model, and the matcher, for kernels."""

    points: Chosen
    images: Images
    matcher: Matcher
    offset_m: float  # how much higher the water stood, mean over all images
    listed: bool  # whether view lists name the maps that were fused
    weight: FloatArray  # of the entries of the lists; empty for one by the squared distance
    around: FloatArray  # (m,), height of the bed of the surroundings, NaN where it is unknown


class Tile(NamedTuple):
    """Arrays of a tile of points, for kernels; runs of `TILE` numbers, see above."""

    points: FloatArray  # (`_POINT`,)
    room: FloatArray  # (`ROOM`,)
    partners: FloatArray  # (p, `PARTNER`)
    pairs: FloatArray  # (p (p - 1) / 2, `PAIR`)
    looks: FloatArray  # (k, `LOOK`), of the images near the tile
    step: FloatArray  # (`TILE`,), of the bed, metres
    going: BoolArray  # (`TILE`,), whether the bed is searched
    row: IntArray  # (k,), of each image in `looks`


class Maps(NamedTuple):
    """The depth maps of the m points of a tile, for kernels."""

    rows: IntArray  # (m,), the rows of the points
    start: IntArray  # the maps of point j are camera[start[j] : start[j + 1]]
    camera: IntArray
    near: IntArray  # (k,), the images of all these maps
    marks: FloatArray  # (k, m), whether the points have these maps
    weights: FloatArray  # (k, m), what each map counts for each point


class Groups(NamedTuple):
    """Which of the k depth maps of a point were averaged and fused with which, for kernels."""

    averaged: IntArray  # (k, 9), each map and its partners by their places; -1 after the last
    fused: IntArray  # (k, 13), the group of each seed likewise; (1, k) with view lists
    place: IntArray  # (k,), of each image among those of the point, or `ABSENT`
    t: FloatArray  # (k,), the depth of a bed in each map; see `DEPTH`
    slope: FloatArray  # (k,), its change with the height of the bed, 1/m; NaN without a depth
    weight: FloatArray  # (k,), of each map, with what is averaged into it
    share: FloatArray  # (k,), the weight of each map by itself
    depth: FloatArray  # (k,), the averaged depth of each map, relative
    change: FloatArray  # (k,), its change with the height of the bed, 1/m
    rise: FloatArray  # (k,), how far up the bed is if the group of a seed made the point, metres
    size: FloatArray  # (k,), the number of maps in the group
    own: FloatArray  # (k,), the depth of each map before it is averaged
    number: FloatArray  # (k,), how many maps are averaged into each


def invert_depth_maps(batch: Batch) -> Intersection:
    """Return the true points from which fused depth maps would have made the apparent ones.

    The views of the batch are, if their kind is depth-maps, the images whose maps were fused, with
    their weights; else all images that see each point. `batch.survey.learned` has the matcher and
    perhaps the bed of the surroundings; without it the largest group made a point. The surface
    above each point is taken as a plane. The rays of the result are the maps with a weight or, of
    a single map, its image and the visible ones that it can have been matched with: at most `NEAR`.
    """
    result = _invert_all(batch)
    few = np.flatnonzero(result[:, OUTCOME] == ONE_CAMERA)
    is_single = batch.survey.settings.matcher in SINGLE and batch.rays.kind != "depth-maps"
    if is_single and len(few):
        # no image shows the point with `LEAST_NEAR` others: at the edge of the block
        result[few] = _invert_all(batch.take(few), least=1)
    outcome = result[:, OUTCOME].astype(np.uint8)
    found = batch.result(result[:, :3], outcome=outcome, ray_miss_m=result[:, _DISTANCE])
    moved = outcome == CORRECTED
    count = np.minimum(batch.counts, 1 + NEAR) if is_single else result[:, _COUNT]
    return found._replace(
        ambiguity_m=np.where(moved, result[:, AMBIGUITY], 0.0),
        ray_count=np.where(moved, count, 0).astype(np.int32),
    )


def likely_beds(batch: Batch) -> FloatArray:
    """Return the heights of the bed from which different groups of images would have made points.

    Relative to each apparent point, metres, float32, shape (m, most views); NaN if there is none.
    """
    likely = np.full((len(batch.xyz), max(1, batch.counts.max(initial=0))), np.nan, np.float32)
    _invert_all(batch, likely)
    return likely


def candidates_of(batch: Batch) -> Candidates:
    """Return the `likely_beds` in the world frame, with their probabilities.

    Of single maps, oblique rays are less likely: on two blocks of semi-global matching an image was
    the base image of a point about exp(-(angle / `BASE_RAY_DEG`)^4) times as often as straight
    above.
    """
    likely = batch.xyz[:, 2:] + likely_beds(batch)
    prior = np.ones(likely.shape)
    if batch.survey.settings.matcher == "single-map":
        views = batch.rays
        owner = np.repeat(np.arange(len(batch)), batch.counts)
        up = batch.survey.cameras.centres[views.camera] - batch.xyz[owner]
        angle = np.degrees(np.arccos(up[:, 2] / np.linalg.norm(up, axis=1)))
        place = np.arange(len(owner)) - np.asarray(views.start)[owner]
        prior[owner, place] = np.exp(-((angle / BASE_RAY_DEG) ** 4)) + LEAST_PRIOR
    return Candidates(likely, prior)


def _invert_all(
    batch: Batch, likely: FloatArray | None = None, least: int = LEAST_NEAR
) -> FloatArray:
    """Return the columns of the result, or fill in the likely beds."""
    survey, rays, bed = batch.survey, batch.rays, batch.survey.learned.bed
    matcher, given_matcher = survey.learned.matcher, survey.settings.matcher
    if matcher is None:
        raise ValueError("a model of the matcher is needed")
    listed = rays.kind == "depth-maps" and likely is None
    if given_matcher in SINGLE:
        nearest = given_matcher == "nearest-map"
        matcher = matcher.of_single_maps(1 if listed else least, nearest=nearest)
    points, weight, around = batch.chosen(), np.zeros(0), np.full(len(batch), np.nan)
    if listed and rays.weight is not None:
        weight = rays.weight.astype(np.float64)
    if bed is not None and not listed and likely is None:
        around = bed.height_at(batch.xyz[:, :2])
    images, offset_m = images_of(batch.original_model, survey.cameras), float(points.offset.mean())
    block = Block(points, images, matcher, offset_m, listed, weight, around)
    result = np.zeros((len(batch), COLUMNS))
    in_tiles(
        _invert_tiles, tiling.tiles_of(batch), tiling.spatial_order(batch.xyz), block, result,
        np.zeros((0, 0), np.float32) if likely is None else likely, points=len(batch),
    )  # fmt: skip
    return result


@kernel(allocates=True)
def _invert_tiles(
    span: Span, order: IntArray, block: Block, result: FloatArray, likely: FloatArray
) -> None:
    """Invert the fusion of the points of some tiles or, where `likely` has rows, fill these in."""
    k, partners = block.matcher.matched.shape
    tile = Tile(
        np.empty(_POINT * TILE),
        np.empty(ROOM * TILE),
        np.empty((partners, PARTNER * TILE)),
        np.empty((partners * (partners - 1) // 2, PAIR * TILE)),
        np.empty((k, LOOK * TILE)),
        np.empty(TILE),
        np.empty(TILE, np.bool_),
        np.full(k, ABSENT),
    )
    # a view list is one group, of up to all maps
    seeds, most = (1, k) if block.listed else (k, block.matcher.fused.shape[1] + 1)
    groups = Groups(
        np.full((k, block.matcher.averaged.shape[1] + 1), ABSENT), np.full((seeds, most), ABSENT),
        np.full(k, ABSENT), np.empty(k), np.empty(k), np.empty(k), np.empty(k), np.empty(k),
        np.empty(k), np.empty(k), np.empty(k), np.empty(k), np.empty(k),
    )  # fmt: skip
    for t in range(*span):
        rows = order[t * TILE : (t + 1) * TILE]
        tiling.gather(tile.points, rows, block.points)
        _start(tile, rows, block)
        # the maps of each point, and the images near the tile
        start, camera = _maps_of(rows, groups.place, tile, block)
        near, marks = tiling.marks_of_lists(start, camera, np.arange(rows.size), k)
        maps = Maps(rows, start, camera, near, marks, np.zeros(marks.shape))
        for q in range(near.size):
            tile.row[near[q]] = q
        _look(tile, near, marks, block)
        _weigh(maps, result, likely, groups, tile, block)
        if len(likely):
            continue
        for _ in range(_BEDS_OF_LIST - 1 if block.listed else 0):
            # which depths agree depends on the bed, and the bed on which agree
            if not _move_on(tile, maps.weights, 0.0, FAR):
                break
            _look(tile, near, marks, block)
            _weigh(maps, result, likely, groups, tile, block)
        for _ in range(MAX_LOOKS):
            if not _move_on(tile, maps.weights, CLOSE_M, 0.0):
                break
            _look(tile, near, maps.weights, block)
        _finish(result, maps, tile)


@device
def _start(tile: Tile, rows: IntArray, block: Block) -> None:
    """Set a likely bed below each point of a tile or, where it is known, that of the surroundings.

    A point of apparent depth h has its bed about (n - 1) h below itself.
    """
    points, around = block.points, block.around
    for j in range(rows.size):
        normal, z = three(tile.points, 4 * TILE + j), tile.points[2 * TILE + j]
        above = normal[2] * (tile.points[3 * TILE + j] - z)
        put(tile.points, _ORIGINAL * TILE + j, row_of(points.original_xyz, rows[j]))
        depth = max(above + normal[2] * block.offset_m, LEAST_DEPTH_M) / normal[2]
        bed = -LIKELY * depth * (points.n - 1.0)
        if around[rows[j]] == around[rows[j]]:
            bed = max(min(around[rows[j]] - z, SHALLOW * bed), DEEP * bed)
        tile.room[BED * TILE + j], tile.going[j] = bed, True


@device(allocates=True)
def _maps_of(
    rows: IntArray, place: IntArray, tile: Tile, block: Block
) -> tuple[IntArray, IntArray]:
    """Return the images of each point: where those of the next one start, and the images.

    To the images of a view list are added their partners whose frames hold the point, as their
    maps were averaged into those of the list.
    """
    points, matcher = block.points, block.matcher
    most = 0
    for i in rows:
        most += points.start[i + 1] - points.start[i]
    start = np.zeros(rows.size + 1, np.int64)
    found, count = np.empty(most * (matcher.averaged.shape[1] + 1), np.int64), 0
    for j in range(rows.size):
        place[:] = ABSENT
        p = three(tile.points, _ORIGINAL * TILE + j)
        for c in points.camera[points.start[rows[j]] : points.start[rows[j] + 1]]:
            if place[c] < 0:
                place[c], found[count], count = 0, c, count + 1
            for a in matcher.averaged[c]:
                # a partner that was not looked at yet
                if block.listed and a >= 0 and place[a] == ABSENT:
                    place[a] = _OUTSIDE
                    if holds(matcher.inner, a, minus(row_of(block.images.centres, a), p)):
                        place[a], found[count], count = 0, a, count + 1
        start[j + 1] = count
    return start, found[:count]


@device
def _look(tile: Tile, near: IntArray, weights: FloatArray, block: Block) -> None:
    """Compute the depths of the beds of a tile in the maps of images; see `LOOK`.

    Of those maps, one row of the weights each, that count for a point whose bed is searched.
    """
    for k in range(near.size):
        counts = False
        for j in range(weights.shape[1]):
            counts |= (weights[k, j] > 0.0) & tile.going[j]
        if counts:
            _look_in(tile.looks[k], near[k], weights.shape[1], tile, block)


@device
def _look_in(out: FloatArray, c: int, count: int, tile: Tile, block: Block) -> None:
    """Compute the depths of the beds of all points of a tile in the depth map of image c.

    The weighted mean over the pairs of partners; of a single partner its own depth; NaN where none
    sees the bed. The change with the height is approximate.
    """
    room, partners, pairs = tile.room, 0, 0
    _aim(out, c, count, tile, block)
    room[_SOLE * TILE : ROOM * TILE] = 0.0
    room[_LEAST * TILE : _TOTAL * TILE] = np.inf
    for partner in block.matcher.matched[c]:
        if partner >= 0:
            _compare(tile.partners[partners], c, partner, count, tile, block)
            partners += 1
    for p in range(partners):
        for q in range(p + 1, partners):
            _agree_best(tile.pairs[pairs], tile.partners[p], tile.partners[q], room, count)
            pairs += 1
    # the costs count relative to the least of all pairs
    for p in range(pairs):
        _add_pair(room, tile.pairs[p], count, block.matcher.tolerance_px2)
    for j in range(count):
        seen, sole = room[_SEEN * TILE + j], room[_SOLE * TILE + j]
        mean = room[_SUM * TILE + j] / room[_TOTAL * TILE + j]
        t = mean if seen > 1.0 else sole
        # the change of the depth with the bed is nearly that of the whole water column
        depth, per_depth = room[_WATER * TILE + j], room[_STEEP * TILE + j]
        change = (t + room[_AWAY * TILE + j]) / depth
        change = change if depth > LEAST_DEPTH_M else per_depth / block.points.n
        change = min(max(change, LEAST_CHANGE * per_depth), MOST_CHANGE * per_depth)
        per_length = 1.0 / room[_LENGTH * TILE + j]
        out[DEPTH * TILE + j] = t * per_length
        found = t == t and seen >= block.matcher.least
        out[BY_HEIGHT * TILE + j] = -change * per_length if found else np.nan


@device
def _aim(out: FloatArray, c: int, count: int, tile: Tile, block: Block) -> None:
    """Follow the ray on which one image shows each point to the bed."""
    points, images, room = block.points, block.images, tile.room
    centre, original, n = row_of(points.centres, c), row_of(images.centres, c), points.n
    for j in range(count):
        normal, bed = three(tile.points, 4 * TILE + j), room[BED * TILE + j]
        p = three(tile.points, j)
        up, ray = minus(centre, p), minus(original, three(tile.points, _ORIGINAL * TILE + j))
        above = normal[2] * (tile.points[3 * TILE + j] - (p[2] - points.offset[c]))
        # the ray of the original image in the adjusted camera, from where it passes the point
        d = in_other(images.original, images.adjusted, c, scaled(-1.0, ray))
        e = scaled(dot(up, d) / dot(d, d), d)
        a = minus(up, e)
        above -= dot(normal, a)
        # H and L^2; f leads to the piercing point, as in `rays`
        across, length2 = dot(normal, e), dot(e, e)
        per_across, length = 1.0 / across, np.sqrt(dot(ray, ray))
        f = above * per_across if above > 0.0 else 0.0
        d = refracted(e, length2, normal, across, 1.0 / n if above > 0.0 else 1.0)
        a, down = beyond(a, f, e), 1.0 / d[2]
        s = (bed - a[2]) * down  # along the refracted ray from the water to the bed
        q = a[0] + s * d[0], a[1] + s * d[1], bed
        out[_PLACE * TILE + j], out[(_PLACE + 1) * TILE + j] = q[0], q[1]
        out[_PLACE_BY_HEIGHT * TILE + j] = d[0] * down
        out[(_PLACE_BY_HEIGHT + 1) * TILE + j] = d[1] * down
        put(room, _RAY * TILE + j, scaled(-1.0 / length, ray))
        put(room, _Q * TILE + j, q)
        away = np.sqrt(length2)
        room[_LENGTH * TILE + j], room[_AWAY * TILE + j] = length, f * away
        room[_WATER * TILE + j] = dot(normal, minus(a, q))
        room[_STEEP * TILE + j] = away * per_across


@device
def _compare(partner: FloatArray, c: int, other: int, count: int, tile: Tile, block: Block) -> None:
    """Set what another image than c sees of the bed at Q; see `PARTNER`.

    The light path is the true one; its direction in the image, P and the ray of image c are those
    of the original model.
    """
    points, images, matcher, room = block.points, block.images, block.matcher, tile.room
    centre, offset, n = row_of(points.centres, other), points.offset[other], points.n
    for j in range(count):
        p, normal = three(tile.points, j), three(tile.points, 4 * TILE + j)
        up = minus(centre, p)
        above = normal[2] * (tile.points[3 * TILE + j] - (p[2] - offset))
        k, _, _, _, s = light_near(three(room, _Q * TILE + j), up, normal, above, n)
        # a camera under the water sees nothing
        k = k if dot(normal, up) > above else np.nan
        w = in_other(images.adjusted, images.original, other, minus(scaled(k, s), normal))
        put(room, _W * TILE + j, w)
    # frames hold places relative to the camera, here w
    sees = room[_SEES * TILE : _SEES * TILE + count]
    mark(sees, room[_W * TILE :], TILE, matcher.inner, other, (0.0, 0.0, 0.0))
    centre, focal_px = row_of(images.centres, other), matcher.focal_px[other]
    for j in range(count):
        u, w = three(room, _RAY * TILE + j), three(room, _W * TILE + j)
        # from P to the other centre, both of the original model
        up = minus(centre, three(tile.points, _ORIGINAL * TILE + j))
        per_w2, along, back = 1.0 / dot(w, w), dot(u, w), dot(up, w)
        # from P to the nearest place on the ray w, and u across that
        r, across = beyond(up, -back * per_w2, w), beyond(u, -along * per_w2, w)
        sine2 = dot(across, across)
        # the depth t at which u is nearest to the ray, how far they pass each other, and the
        # pixels for a metre there
        t = dot(r, across) / sine2
        miss, away = beyond(r, -t, across), t * along - back
        scale2 = focal_px * focal_px / (away * away * per_w2)
        partner[_AT * TILE + j] = t if sees[j] > 0.0 else 0.0
        partner[_SQUARES * TILE + j] = scale2 * dot(miss, miss) if sees[j] > 0.0 else np.inf
        partner[_CURVATURE * TILE + j] = scale2 * sine2 if sees[j] > 0.0 else 1.0
        # how many partners see the bed, and its depth if only one does
        room[_SEEN * TILE + j] += sees[j]
        room[_SOLE * TILE + j] += partner[_AT * TILE + j]


@device
def _agree_best(
    pair: FloatArray, a: FloatArray, b: FloatArray, room: FloatArray, count: int
) -> None:
    """Find the depth at which two partners agree best: the minimum of the sum of two parabolas."""
    for j in range(count):
        bow_a, bow_b = a[_CURVATURE * TILE + j], b[_CURVATURE * TILE + j]
        off, share = b[_AT * TILE + j] - a[_AT * TILE + j], bow_b / (bow_a + bow_b)
        cost = a[_SQUARES * TILE + j] + b[_SQUARES * TILE + j] + bow_a * share * off * off
        pair[_COST * TILE + j], pair[_PAIR_AT * TILE + j] = cost, a[_AT * TILE + j] + share * off
        room[_LEAST * TILE + j] = min(room[_LEAST * TILE + j], cost)


@device
def _add_pair(room: FloatArray, pair: FloatArray, count: int, tolerance: float) -> None:
    """Add the depth of a pair with its weight, which falls by e for each `tolerance`."""
    for j in range(count):
        worse = (pair[_COST * TILE + j] - room[_LEAST * TILE + j]) / tolerance
        # exp(-worse) as the sixteenth power of the Taylor series of exp(-worse / 16): a loop that
        # calls exp would not be vectorised
        x = worse / 16.0
        w = 1.0 - x / 4.0 * (1.0 - x / 5.0 * (1.0 - x / 6.0))
        w = 1.0 - x * (1.0 - x / 2.0 * (1.0 - x / 3.0 * w))
        w *= w
        w *= w
        w *= w
        w *= w
        w = w if worse < NOTHING else 0.0
        room[_TOTAL * TILE + j] += w
        room[_SUM * TILE + j] += w * pair[_PAIR_AT * TILE + j]


@device
def _weigh(
    maps: Maps, result: FloatArray, likely: FloatArray, groups: Groups, tile: Tile, block: Block
) -> None:
    """Set the weights of the maps of the group that made each point, or its likely beds."""
    before = maps.camera[:0]
    for j in range(maps.rows.size):
        if not tile.going[j]:
            continue
        i, bed = maps.rows[j], tile.room[BED * TILE + j]
        cameras = maps.camera[maps.start[j] : maps.start[j + 1]]
        # points with the same cameras share their groups
        if not are_same(cameras, before):
            _group(groups, cameras, block)
        before, k = cameras, cameras.size
        _set_lines(groups, cameras, i, j, tile, block)
        _set_rises(groups, k, block.listed)
        if len(likely):
            for seed in range(k):
                if groups.slope[seed] == groups.slope[seed]:
                    likely[i, seed] = bed + groups.rise[seed]
            continue
        # the only group of a list, else that whose bed is nearest to the surroundings
        seed = 0
        if not block.listed:
            wanted = block.around[i] - tile.points[2 * TILE + j] - bed
            seed, result[i, AMBIGUITY] = _best_seed(groups, cameras, wanted, j, tile, block)
        groups.weight[:k] = 0.0
        if seed >= 0:
            # which maps agree for the bed of this group
            _move(groups, k, groups.rise[seed])
            _share_out(seed, groups, block.listed)
        for q in range(k):
            maps.weights[tile.row[cameras[q]], j] = groups.weight[q]


@device
def _group(groups: Groups, maps: IntArray, block: Block) -> None:
    """Find the places of the depth maps of a point, and of those averaged and fused with each."""
    groups.place[:] = ABSENT
    for q in range(maps.size):
        groups.place[maps[q]] = q
    for q in range(maps.size):
        _place(groups.averaged[q], q, block.matcher.averaged[maps[q]], groups.place)
        if block.listed:
            groups.fused[0, q] = q
        else:
            _place(groups.fused[q], q, block.matcher.fused[maps[q]], groups.place)
    if block.listed:
        groups.fused[0, maps.size :] = ABSENT


@device
def _place(members: IntArray, q: int, others: IntArray, place: IntArray) -> None:
    """Write a place and those of other images that have one."""
    # the map itself comes first
    members[0], count = q, 1
    for c in others:
        if c >= 0 and place[c] >= 0:
            members[count], count = place[c], count + 1
    members[count:] = ABSENT


@device
def _set_lines(groups: Groups, maps: IntArray, i: int, j: int, tile: Tile, block: Block) -> None:
    """Set the depths in the maps of a point and their changes, about the bed of the last look.

    Also what each map counts: nothing for those that are only averaged into maps of a list.
    """
    points, p = block.points, three(tile.points, _ORIGINAL * TILE + j)
    for q in range(maps.size):
        k = tile.row[maps[q]]
        groups.t[q] = tile.looks[k, DEPTH * TILE + j]
        groups.slope[q] = tile.looks[k, BY_HEIGHT * TILE + j]
        groups.share[q] = 0.0
    for at in range(points.start[i], points.start[i + 1]):
        # the pixel on the ground grows with the distance
        up = minus(row_of(block.images.centres, points.camera[at]), p)
        share = block.weight[at] if block.weight.size else 1.0 / dot(up, up)
        groups.share[groups.place[points.camera[at]]] += share


@device
def _set_rises(groups: Groups, k: int, listed: bool) -> None:
    """Find the rise and the size of the group of each seed, of k maps.

    Which maps agree is decided for the bed of the lines, and again for that of each group.
    """
    seeds, spread = min(k, len(groups.fused)), _move(groups, k, 0.0)
    for q in range(k):
        _average(q, groups)
    for seed in range(seeds):
        groups.rise[seed], groups.size[seed] = _fuse(seed, groups, listed)
    for seed in range(seeds):
        for _ in range(_ROUNDS_OF_LIST if listed else _ROUNDS):
            # where all depths agree, for both beds, so do the groups
            if max(spread, _move(groups, k, groups.rise[seed])) < AGREE:
                break
            _average_around(seed, groups)
            step, groups.size[seed] = _fuse(seed, groups, listed)
            groups.rise[seed] += step


@device
def _move(groups: Groups, k: int, rise: float) -> float:
    """Set the depths of k maps for a bed higher by `rise`; return their range."""
    low, high = np.inf, -np.inf
    for q in range(k):
        own = groups.t[q] + groups.slope[q] * rise
        # NaN is neither lower nor higher
        low, high = own if own < low else low, own if own > high else high
        groups.own[q] = own
    return high - low


@device
def _average_around(seed: int, groups: Groups) -> None:
    """Average the depths that may be fused with that of a seed."""
    for q in groups.fused[seed]:
        if q < 0:
            break
        _average(q, groups)


@device(forceinline=True)
def _average(q: int, groups: Groups) -> None:
    """Average a depth with those of its partners that agree."""
    own, total, change, count = groups.own[q], 0.0, 0.0, 0.0
    for a in groups.averaged[q]:
        if a < 0:
            break
        # no branch, which the processor would predict wrongly half the time
        agrees = abs(groups.own[a] - own) < AVERAGED_WITHIN
        total += groups.own[a] if agrees else 0.0
        change += groups.slope[a] if agrees else 0.0
        count += 1.0 if agrees else 0.0
    each = 1.0 / count
    groups.depth[q], groups.change[q], groups.number[q] = total * each, change * each, count


@device(forceinline=True)
def _limits(seed: int, groups: Groups, listed: bool) -> tuple[float, float]:
    """Return the depth of a seed, and by how much the depths fused with it may differ from it.

    All depths of a list are fused, but none that is NaN.
    """
    return (0.0, np.inf) if listed else (groups.depth[seed], AGREE)


@device(forceinline=True)
def _fuse(seed: int, groups: Groups, listed: bool) -> tuple[float, float]:
    """Return how far up the bed is for the group of a seed, and how many maps the group has."""
    total, change, members = 0.0, 0.0, 0.0
    depth, within = _limits(seed, groups, listed)
    for q in groups.fused[seed]:
        if q < 0:
            break
        agrees = abs(groups.depth[q] - depth) < within
        total += groups.share[q] * groups.depth[q] if agrees else 0.0
        change += groups.share[q] * groups.change[q] if agrees else 0.0
        members += 1.0 if agrees else 0.0
    # the weighted mean of depth + change * rise is zero
    return -total / change, members


@device
def _share_out(seed: int, groups: Groups, listed: bool) -> None:
    """Add the weights of the maps of a group evenly to those that were averaged into each."""
    _average_around(seed, groups)
    depth, within = _limits(seed, groups, listed)
    for q in groups.fused[seed]:
        if q < 0 or not abs(groups.depth[q] - depth) < within:
            continue
        for a in groups.averaged[q]:
            if a >= 0 and abs(groups.own[a] - groups.own[q]) < AVERAGED_WITHIN:
                groups.weight[a] += groups.share[q] / groups.number[q]


@device
def _best_seed(
    groups: Groups, cameras: IntArray, wanted: float, j: int, tile: Tile, block: Block
) -> tuple[int, float]:
    """Return the seed of the group that made the point, and the ambiguity.

    That is the group whose bed is nearest to the wanted height or, where this is NaN, the largest;
    of software that takes the nearest map, that map. The ambiguity is the standard deviation (m) of
    the beds of all groups that are likely.
    """
    matcher, p = block.matcher, three(tile.points, _ORIGINAL * TILE + j)
    best, least, known = -1, np.inf, wanted == wanted
    total, first, second = 0.0, 0.0, 0.0  # sum, and moments, of what is likely
    for seed in range(cameras.size):
        # the seed has no depth of this bed
        if groups.slope[seed] != groups.slope[seed]:
            continue
        rise = groups.rise[seed]
        # distance from the wanted bed, or else the larger group first
        misfit = abs(rise - wanted) if known else -groups.size[seed]
        likely = np.exp(-0.5 * (misfit / matcher.width_m) ** 2) if known else 1.0
        if matcher.is_nearest:
            x, y, _ = minus(row_of(block.images.centres, cameras[seed]), p)
            misfit = x * x + y * y
        if misfit < least:
            best, least = seed, misfit
        total += likely
        first, second = first + likely * rise, second + likely * rise * rise
    if matcher.is_nearest:
        return best, 0.0
    # all groups are far from the wanted bed
    if not total > 0.0:
        return best, abs(least) if best >= 0 else 0.0
    mean = first / total
    return best, np.sqrt(max(second / total - mean * mean, 0.0))


@device
def _set_steps(tile: Tile, weights: FloatArray) -> None:
    """Set how far up the bed of each point is at which the weighted mean of the depths is zero."""
    for j in range(weights.shape[1]):
        total, change = 0.0, 0.0
        for k in range(len(weights)):
            slope = tile.looks[k, BY_HEIGHT * TILE + j]
            if weights[k, j] > 0.0 and slope == slope:
                total += weights[k, j] * tile.looks[k, DEPTH * TILE + j]
                change += weights[k, j] * slope
        tile.step[j] = -total / change


@device
def _move_on(tile: Tile, weights: FloatArray, least_m: float, share: float) -> bool:
    """Move the beds to where the fused depths give the apparent points; return whether any moved.

    A bed moves by more than `least_m` and a share of its distance from the apparent point.
    """
    _set_steps(tile, weights)
    searched = False
    for j in range(weights.shape[1]):
        step, bed = tile.step[j], tile.room[BED * TILE + j]
        # NaN where no image with a weight sees the bed
        tile.going[j] = np.isfinite(step) and abs(step) > least_m + share * abs(bed)
        if tile.going[j]:
            tile.room[BED * TILE + j] = bed + step
            searched = True
    return searched


@device
def _finish(result: FloatArray, maps: Maps, tile: Tile) -> None:
    """Write the rows: the weighted mean of the Q, moved by the rest of the step."""
    weights = maps.weights
    _set_steps(tile, weights)
    for j in range(weights.shape[1]):
        row, step = result[maps.rows[j]], tile.step[j]
        total, x, y, square, count = 0.0, 0.0, 0.0, 0.0, 0
        for k in range(len(weights)):
            look, w = tile.looks[k], weights[k, j]
            if w > 0.0 and look[BY_HEIGHT * TILE + j] == look[BY_HEIGHT * TILE + j]:
                # Q on the ray of this image, at the height of the bed after the step
                u = look[_PLACE * TILE + j] + step * look[_PLACE_BY_HEIGHT * TILE + j]
                v = look[(_PLACE + 1) * TILE + j] + step * look[(_PLACE_BY_HEIGHT + 1) * TILE + j]
                total, count, square = total + w, count + 1, square + w * (u * u + v * v)
                x, y = x + w * u, y + w * v
        # without a map that sees the bed the point stays where it is
        row[OUTCOME] = ONE_CAMERA if maps.start[j + 1] > maps.start[j] else NO_CAMERA
        per_weight = 1.0 / total
        x, y, square = x * per_weight, y * per_weight, square * per_weight
        if np.isfinite(step) and np.isfinite(square):
            row[0], row[1], row[2] = x, y, tile.room[BED * TILE + j] + step
            row[_DISTANCE] = np.sqrt(max(square - x * x - y * y, 0.0))
            row[OUTCOME], row[_COUNT] = CORRECTED, count

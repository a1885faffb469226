r"""Compute where dense matching puts a point under water, and invert that.

A dense cloud is not triangulated from tracks. For each image the matcher finds the depth of every
pixel along its own ray at which the compared images agree best: a depth map. The maps that agree
are averaged and fused (`pcfix.refract.fusion`): a point is the weighted mean of the depths of
several images, each along its own ray. Under water these depths differ, as each depends on the
positions of the compared images.

The model, for an apparent point P, a level bed at the height z, and one image i:

1. The ray from the projection centre i through P is refracted and meets the bed in Q_i.
2. From Q_i the light goes back to the images j that i was matched with; each sees Q_i in the
   direction w_ij.
3. The depth map has P + t_i u_i on the ray u_i, where the two images that agree best agree: for
   each pair of j the t with the least squared distances in the images, and of these the mean with
   the weights exp(-squares / `Matcher.tolerance_px2`). PatchMatch scores a depth by its two best
   images; which these are changes from pixel to pixel.

The fused point is P where sum_i W_i t_i = 0, with t_i relative to the distance of P from image i:
one equation for z, solved by Newton's method. The true point is the mean of the Q_i with the same
weights. The bed may be taken as level, because a slope moves the Q_i and the directions w_ij nearly
alike.

With a view list the fused maps are known. Without one they are chosen as the group whose bed is
nearest to that of the surroundings. A point needs some 80 light paths for each bed that is tried.
"""

from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Vector, beyond, dot, minus, row_of, scaled
from pcfix.lens.imaging import holds, mark
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
from pcfix.refract.fusion import (
    ABSENT,
    PointMaps,
    find_members,
    find_rises,
    likely_seed,
    room_for_maps,
    set_weights,
)
from pcfix.refract.matcher import LEAST_NEAR, NEAR, NEAR_WIDTH_M, Matcher
from pcfix.refract.patches import Candidates
from pcfix.refract.rays import light_near, refracted
from pcfix.refract.tiling import TILE, are_same, put, slots, three

MAX_STEPS = 5
CLOSE_M = 0.002  # step of the bed below which the rest is linear

# Beds for which the maps of a list are averaged again; the least change from one bed to the next,
# relative to its depth below P.
_BEDS_OF_LIST, FAR = 3, 0.1

# Height of the first bed, in terms of (n - 1) times the apparent depth; the least depth.
LIKELY, LEAST_DEPTH_M = 1.1, 0.005

SHALLOW, DEEP = 0.3, 3.5  # range of the surrounding bed, in heights of the first; outliers leave it

# Distance to the other bed with which the change is computed, relative to the height of the bed;
# the largest relative difference from the estimated change.
RISE, STEEP = 0.1, 0.3

LEAST_CHANGE, MOST_CHANGE = 0.35, 1.5  # of the apparent depth with that of the bed along a ray
NOTHING = 14.0  # exp(-NOTHING), a millionth, is neglected

# Angle of the ray of a base image from the vertical at which it is e times less frequent.
BASE_RAY_DEG, LEAST_PRIOR = 27.0, 1e-4

SINGLE = ("single-map", "nearest-map")  # software that keeps one map at each place

_OUTSIDE = -2

# Columns of the result, after the shift.
_DISTANCE, _AMBIGUITY, _OUTCOME, _COUNT, _WIDTH = 3, 4, 5, 6, 7

# Runs of `TILE` numbers. What a depth map shows of the bed: its depth beyond P, relative to the
# distance of P, and Q; and how both change with the height of the bed (1/m).
_DEPTH, _BY_HEIGHT, _Q, _Q_BY_HEIGHT, _SHOWN = slots(1, 1, 3, 3)
# Of the points: the height z of the bed, relative to P. Of one map: the ray u, the distance of P
# from the projection centre, and what the change of the depth with the bed depends on: the way from
# P up to the water, the depth of Q, and L / H of the ray in air. Of one partner: the direction w,
# and whether it sees Q. Of all partners: the only depth, how many see Q, the least cost of a pair,
# and the sums of the mean.
(
    _BED, _RAY, _LENGTH, _TO_WATER, _UNDER_WATER, _SLANT, _W, _SEES, _SOLE, _SEEN, _LEAST,
    _TOTAL, _SUM, _ROOM,
) = slots(1, 3, 1, 1, 1, 1, 3, 1, 1, 1, 1, 1, 1)  # fmt: skip
# Of a partner: the depth t at which it agrees best (m), its squared residual there (px^2), and half
# the curvature of that (px^2/m^2). Of a pair of partners: its cost (px^2), and its depth.
_AT, _SQUARES, _CURVATURE, _PARTNER = slots(1, 1, 1)
_COST, _PAIR_AT, _PAIR = slots(1, 1)
# Of the points, after the runs of `tiling.gather`: P in the original model.
_ORIGINAL, _POINT = 7, 10


class MapInputs(NamedTuple):
    """All points and cameras, the images of the original model, and the matcher, for kernels."""

    points: Chosen
    images: Images
    matcher: Matcher
    listed: bool  # whether view lists name the maps that were fused
    weight: FloatArray  # of the entries of the lists; empty for one by the squared distance
    first: FloatArray  # (m,), height of the first bed, relative to P
    around: FloatArray  # (m,), the same of the surroundings, NaN where it is unknown


class MapTile(NamedTuple):
    """A tile of m points and their depth maps, for kernels.

    The map that image c has of point j is in row ``row[c]`` and column j.
    """

    rows: IntArray  # (m,), the rows of the points
    start: IntArray  # the images of point j are camera[start[j] : start[j + 1]]
    camera: IntArray
    near: IntArray  # (k,), all these images
    row: IntArray  # of each image of the block among those near
    marks: FloatArray  # (k, m), whether the points have these maps
    weights: FloatArray  # (k, m), what each map counts for each point
    step: FloatArray  # (m,), of the bed, metres
    going: BoolArray  # (m,), whether the bed is searched
    points: FloatArray  # runs of `TILE` numbers, see above: (`_POINT`,)
    room: FloatArray  # (`_ROOM`,)
    partners: FloatArray  # (p, `_PARTNER`)
    pairs: FloatArray  # (p (p - 1) / 2, `_PAIR`)
    shown: FloatArray  # (k, `_SHOWN`)


def invert_depth_maps(batch: Batch) -> Intersection:
    """Return the true points from which fused depth maps would have made the apparent ones.

    The views of the batch are, if their kind is depth-maps, the images whose maps were fused, with
    their weights; else all images that see each point. `batch.survey.learned` has the matcher and
    perhaps the bed of the surroundings; without it the largest group made a point. The surface
    above each point is taken as a plane. The rays of the result are the maps with a weight or, of
    a single map, its image and the visible ones that it can have been matched with: at most `NEAR`.
    """
    result = _invert_all(batch)
    few = np.flatnonzero(result[:, _OUTCOME] == ONE_CAMERA)
    is_single = batch.survey.settings.matcher in SINGLE and batch.rays.kind != "depth-maps"
    if is_single and len(few):
        # no image shows the point with `LEAST_NEAR` others: at the edge of the block
        result[few] = _invert_all(batch.take(few), least=1)
    outcome = result[:, _OUTCOME].astype(np.uint8)
    found = batch.result(result[:, :3], outcome=outcome, ray_miss_m=result[:, _DISTANCE])
    moved = outcome == CORRECTED
    count = np.minimum(batch.counts, 1 + NEAR) if is_single else result[:, _COUNT]
    return found._replace(
        ambiguity_m=np.where(moved, result[:, _AMBIGUITY], 0.0),
        ray_count=np.where(moved, count, 0).astype(np.int32),
    )


def likely_beds(batch: Batch) -> Candidates:
    """Return the heights of the bed from which different groups of images would have made points.

    World frame, with their probabilities. Of single maps, oblique rays are less likely: on two
    blocks of semi-global matching an image was the base image of a point about
    exp(-(angle / `BASE_RAY_DEG`)^4) times as often as straight above.
    """
    likely = np.full((len(batch.xyz), max(1, batch.counts.max(initial=0))), np.nan, np.float32)
    _invert_all(batch, likely)
    prior = np.ones(likely.shape)
    if batch.survey.settings.matcher == "single-map":
        views = batch.rays
        owner = np.repeat(np.arange(len(batch)), batch.counts)
        up = batch.survey.cameras.centres[views.camera] - batch.xyz[owner]
        angle = np.degrees(np.arccos(up[:, 2] / np.linalg.norm(up, axis=1)))
        place = np.arange(len(owner)) - np.asarray(views.start)[owner]
        prior[owner, place] = np.exp(-((angle / BASE_RAY_DEG) ** 4)) + LEAST_PRIOR
    return Candidates(batch.xyz[:, 2:] + likely, prior)


def _invert_all(
    batch: Batch, likely: FloatArray | None = None, least: int = LEAST_NEAR
) -> FloatArray:
    """Return the columns of the result, or fill in the likely beds, relative to each point."""
    survey, rays, bed = batch.survey, batch.rays, batch.survey.learned.bed
    matcher, software = survey.learned.matcher, survey.settings.matcher
    if matcher is None:
        raise ValueError("a model of the matcher is needed")
    listed = rays.kind == "depth-maps" and likely is None
    if software in SINGLE:
        none = np.zeros((len(matcher.near), 0), np.int64)
        matcher = matcher._replace(
            matched=matcher.near, averaged=none, fused=none, tolerance_px2=np.inf,
            width_m=NEAR_WIDTH_M, least=1 if listed else least,
            is_nearest=software == "nearest-map",
        )  # fmt: skip
    images, z = images_of(batch.original_model, survey.cameras), batch.xyz[:, 2]
    points, weight = batch.chosen(), np.zeros(0)
    if listed and rays.weight is not None:
        weight = rays.weight.astype(np.float64)
    # a point of apparent depth h has its bed about (n - 1) h below itself
    depth = np.maximum(batch.surface.height_m - z + points.rig.offset.mean(), LEAST_DEPTH_M)
    first, around = -LIKELY * (points.n - 1.0) * depth, np.full(len(batch), np.nan)
    if bed is not None and not listed and likely is None:
        around = bed.height_at(batch.xyz[:, :2]) - z
        known = np.clip(around, DEEP * first, SHALLOW * first)
        first = np.where(np.isnan(around), first, known)
    given = MapInputs(points, images, matcher, listed, weight, first, around)
    result = np.zeros((len(batch), _WIDTH))
    in_tiles(
        _invert_tiles, tiling.tiles_of(batch), tiling.spatial_order(batch.xyz), given, result,
        np.zeros((0, 0), np.float32) if likely is None else likely, points=len(batch),
    )  # fmt: skip
    return result


@kernel(allocates=True)
def _invert_tiles(
    span: Span, order: IntArray, given: MapInputs, result: FloatArray, likely: FloatArray
) -> None:
    """Invert the fusion of the points of some tiles or, where `likely` has rows, fill these in."""
    (k, partners), maps = given.matcher.matched.shape, room_for_maps(given.matcher, given.listed)
    row, points, room = np.empty(k, np.int64), np.empty(_POINT * TILE), np.empty(_ROOM * TILE)
    compared = np.empty((partners, _PARTNER * TILE))
    pairs = np.empty((partners * (partners - 1) // 2, _PAIR * TILE))
    shown = np.empty((k, _SHOWN * TILE))  # of all images; the system provides what is used
    for t in range(*span):
        rows = order[t * TILE : (t + 1) * TILE]
        tiling.gather(points, rows, given.points)
        tiling.gather_three(points[_ORIGINAL * TILE :], rows, given.points.original_xyz)
        start, camera = _maps_of(rows, maps.place, points, given)
        near, marks = tiling.marks_of_lists(start, camera, np.arange(rows.size), k)
        for q in range(near.size):
            row[near[q]] = q
        tile = MapTile(
            rows, start, camera, near, row, marks, np.zeros(marks.shape), np.empty(rows.size),
            np.ones(rows.size, np.bool_), points, room, compared, pairs, shown,
        )  # fmt: skip
        for j in range(rows.size):
            tile.room[_BED * TILE + j] = given.first[rows[j]]
        _look_with_slopes(tile, marks, given)
        _choose_maps(tile, result, likely, maps, given)
        if len(likely):
            continue
        for _ in range(_BEDS_OF_LIST - 1 if given.listed else 0):
            # which depths agree depends on the bed, and the bed on which agree
            if not _move(tile, 0.0, FAR):
                break
            _look_with_slopes(tile, marks, given)
            _choose_maps(tile, result, likely, maps, given)
        for _ in range(MAX_STEPS):
            if not _move(tile, CLOSE_M, 0.0):
                break
            _look(tile, tile.weights, given)
        _finish(result, tile)


@device(allocates=True)
def _maps_of(
    rows: IntArray, place: IntArray, runs: FloatArray, given: MapInputs
) -> tuple[IntArray, IntArray]:
    """Return the images of each point: where those of the next one start, and the images.

    To the images of a view list are added their partners whose frames hold the point, as their
    maps were averaged into those of the list.
    """
    points, matcher = given.points, given.matcher
    most = 0
    for i in rows:
        most += points.start[i + 1] - points.start[i]
    start = np.zeros(rows.size + 1, np.int64)
    found, count = np.empty(most * (matcher.averaged.shape[1] + 1), np.int64), 0
    for j in range(rows.size):
        place[:] = ABSENT
        p = three(runs, _ORIGINAL * TILE + j)
        for c in points.camera[points.start[rows[j]] : points.start[rows[j] + 1]]:
            if place[c] < 0:
                place[c], found[count], count = 0, c, count + 1
            for a in matcher.averaged[c]:
                # a partner that was not looked at yet
                if given.listed and a >= 0 and place[a] == ABSENT:
                    place[a] = _OUTSIDE
                    if holds(matcher.inner, a, minus(row_of(given.images.centres, a), p)):
                        place[a], found[count], count = 0, a, count + 1
        start[j + 1] = count
    return start, found[:count]


# 1. The depth of a bed in one depth map
#
# Functions that are called for each map are inlined: a call would put their forty arrays on the
# stack, which took a sixth of the time.


@device
def _look(tile: MapTile, weights: FloatArray, given: MapInputs) -> None:
    """Compute the depths of the beds of a tile in the depth maps near it; see `_SHOWN`.

    Of those maps, one row of the weights each, that count for a point whose bed is searched. A
    depth is the weighted mean over the pairs of partners; of a single partner its own depth; NaN
    where none sees the bed. The change with the height is approximate.
    """
    room, count, matcher = tile.room, weights.shape[1], given.matcher
    for k in range(tile.near.size):
        counts = False
        for j in range(count):
            counts |= (weights[k, j] > 0.0) & tile.going[j]
        if not counts:
            continue
        shown, c, partners, pairs = tile.shown[k], tile.near[k], 0, 0
        _trace_to_bed(shown, c, count, tile, given)
        room[_SOLE * TILE : _ROOM * TILE] = 0.0
        room[_LEAST * TILE : _TOTAL * TILE] = np.inf
        for partner in matcher.matched[c]:
            if partner >= 0:
                _see_from(tile.partners[partners], shown, partner, count, tile, given)
                partners += 1
        for p in range(partners):
            for q in range(p + 1, partners):
                _match_pair(tile.pairs[pairs], tile.partners[p], tile.partners[q], room, count)
                pairs += 1
        # the costs count relative to the least of all pairs
        for p in range(pairs):
            _add_pair(room, tile.pairs[p], count, matcher.tolerance_px2)
        for j in range(count):
            seen, sole = room[_SEEN * TILE + j], room[_SOLE * TILE + j]
            mean = room[_SUM * TILE + j] / room[_TOTAL * TILE + j]
            t = mean if seen > 1.0 else sole
            # apparent by true way under water; in shallow water its limit, and never far from that
            depth, slant = room[_UNDER_WATER * TILE + j], room[_SLANT * TILE + j]
            change = (t + room[_TO_WATER * TILE + j]) / depth
            change = change if depth > LEAST_DEPTH_M else slant / given.points.n
            change = min(max(change, LEAST_CHANGE * slant), MOST_CHANGE * slant)
            per_length = 1.0 / room[_LENGTH * TILE + j]
            shown[_DEPTH * TILE + j] = t * per_length
            found = t == t and seen >= matcher.least
            shown[_BY_HEIGHT * TILE + j] = -change * per_length if found else np.nan


@device
def _look_with_slopes(tile: MapTile, marks: FloatArray, given: MapInputs) -> None:
    """Do as `_look`, and for transferred points compute the change with the height by differences.

    Their depth maps are those of the original model, whose lens and poses absorbed refraction. The
    change that `_look` estimates holds for true poses only.
    """
    bed, count = tile.room[_BED * TILE : _RAY * TILE], marks.shape[1]
    if given.images.adjusted is None:
        _look(tile, marks, given)
        return
    # First look at another bed. The weights of the points that are searched are set later, so that
    # they can hold the depths of that bed until then.
    for j in range(count):
        tile.step[j] = min(RISE * bed[j], -LEAST_DEPTH_M)
        bed[j] += tile.step[j]
    _look(tile, marks, given)
    for j in range(count):
        bed[j] -= tile.step[j]
        for k in range(len(marks) if tile.going[j] else 0):
            tile.weights[k, j] = tile.shown[k, _DEPTH * TILE + j]
    _look(tile, marks, given)
    for j in range(count):
        for k in range(len(marks) if tile.going[j] else 0):
            change = (tile.weights[k, j] - tile.shown[k, _DEPTH * TILE + j]) / tile.step[j]
            usual, tile.weights[k, j] = tile.shown[k, _BY_HEIGHT * TILE + j], 0.0
            # where it differs by more, other partners agree best at the other bed
            if abs(change / usual - 1.0) < STEEP:
                tile.shown[k, _BY_HEIGHT * TILE + j] = change


@device(forceinline=True)
def _trace_to_bed(shown: FloatArray, c: int, count: int, tile: MapTile, given: MapInputs) -> None:
    """Trace the ray on which image c shows each point through the water to Q on the bed."""
    points, images, room = given.points, given.images, tile.room
    centre, original, n = row_of(points.rig.centres, c), row_of(images.centres, c), points.n
    for j in range(count):
        normal, bed = three(tile.points, 4 * TILE + j), room[_BED * TILE + j]
        p = three(tile.points, j)
        up, ray = minus(centre, p), minus(original, three(tile.points, _ORIGINAL * TILE + j))
        above = normal[2] * (tile.points[3 * TILE + j] - (p[2] - points.rig.offset[c]))
        # the ray of the original image in the adjusted camera; it passes P at a
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
        put(shown, _Q * TILE + j, q)
        put(shown, _Q_BY_HEIGHT * TILE + j, scaled(down, d))
        put(room, _RAY * TILE + j, scaled(-1.0 / length, ray))
        away = np.sqrt(length2)
        room[_LENGTH * TILE + j], room[_TO_WATER * TILE + j] = length, f * away
        room[_UNDER_WATER * TILE + j] = dot(normal, minus(a, q))
        room[_SLANT * TILE + j] = away * per_across


@device(forceinline=True)
def _see_from(
    partner: FloatArray, shown: FloatArray, c: int, count: int, tile: MapTile, given: MapInputs
) -> None:
    """Set at which depth t on the ray u the partner c agrees best, and how well; see `_PARTNER`.

    The light path from Q is the true one; its direction in the image, P and the ray u are those of
    the original model.
    """
    points, images, matcher, room = given.points, given.images, given.matcher, tile.room
    centre, offset, n = row_of(points.rig.centres, c), points.rig.offset[c], points.n
    for j in range(count):
        p, normal = three(tile.points, j), three(tile.points, 4 * TILE + j)
        up = minus(centre, p)
        above = normal[2] * (tile.points[3 * TILE + j] - (p[2] - offset))
        k, _, _, _, s = light_near(three(shown, _Q * TILE + j), up, normal, above, n)
        # a camera under the water sees nothing
        k = k if dot(normal, up) > above else np.nan
        w = in_other(images.adjusted, images.original, c, minus(scaled(k, s), normal))
        put(room, _W * TILE + j, w)
    # frames hold places relative to the camera, here w
    sees = room[_SEES * TILE : _SEES * TILE + count]
    mark(sees, room[_W * TILE :], TILE, matcher.inner, c, (0.0, 0.0, 0.0))
    centre, focal_px = row_of(images.centres, c), matcher.focal_px[c]
    for j in range(count):
        u, w = three(room, _RAY * TILE + j), three(room, _W * TILE + j)
        # from P to the other centre, both of the original model
        up = minus(centre, three(tile.points, _ORIGINAL * TILE + j))
        per_w2, along, back = 1.0 / dot(w, w), dot(u, w), dot(up, w)
        # from P to the nearest place on the ray w, and u across that
        r, across = beyond(up, -back * per_w2, w), beyond(u, -along * per_w2, w)
        sine2 = dot(across, across)
        # the t at which u is nearest to the ray w, how far they pass each other, and the pixels
        # for a metre there: focal length by distance from the centre, squared
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
def _match_pair(
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


# 2. The maps that were fused into each point


@device
def _choose_maps(
    tile: MapTile, result: FloatArray, likely: FloatArray, maps: PointMaps, given: MapInputs
) -> None:
    """Set the weights of the maps of the group that made each point, or its likely beds."""
    points, matcher, before = given.points, given.matcher, tile.camera[:0]
    for j in range(tile.rows.size):
        if not tile.going[j]:
            continue
        i, bed = tile.rows[j], tile.room[_BED * TILE + j]
        images = tile.camera[tile.start[j] : tile.start[j + 1]]
        # points with the same images share their groups
        if not are_same(images, before):
            find_members(maps, images, matcher, given.listed)
        before, k, p = images, images.size, three(tile.points, _ORIGINAL * TILE + j)
        # what the maps of the point show of its bed, and the weight of each by itself; those that
        # are only averaged into the maps of a list have none
        for q in range(k):
            shown = tile.shown[tile.row[images[q]]]
            maps.trial[q], maps.slope[q] = shown[_DEPTH * TILE + j], shown[_BY_HEIGHT * TILE + j]
            maps.share[q] = 0.0
        for at in range(points.start[i], points.start[i + 1]):
            # the pixel on the ground grows with the distance
            up = minus(row_of(given.images.centres, points.camera[at]), p)
            share = given.weight[at] if given.weight.size else 1.0 / dot(up, up)
            maps.share[maps.place[points.camera[at]]] += share
        find_rises(maps, k, given.listed)
        if len(likely):
            for seed in range(k):
                if maps.slope[seed] == maps.slope[seed]:
                    likely[i, seed] = bed + maps.rise[seed]
            continue
        seed = 0  # the only group of a list
        if matcher.is_nearest and not given.listed:
            seed = _nearest_map(maps, images, p, given)
        elif not given.listed:
            wanted = given.around[i] - bed
            seed, result[i, _AMBIGUITY] = likely_seed(maps, k, wanted, matcher.width_m)
        set_weights(maps, seed, k, given.listed)
        for q in range(k):
            tile.weights[tile.row[images[q]], j] = maps.weight[q]


@device
def _nearest_map(maps: PointMaps, images: IntArray, p: Vector, given: MapInputs) -> int:
    """Return the map with a depth whose image is nearest to a point in plan; -1 without any."""
    best, least = -1, np.inf
    for q in range(images.size):
        x, y, _ = minus(row_of(given.images.centres, images[q]), p)
        if maps.slope[q] == maps.slope[q] and x * x + y * y < least:
            best, least = q, x * x + y * y
    return best


# 3. The bed at which the fused depth is that of the apparent point


@device
def _set_steps(tile: MapTile) -> None:
    """Set how far up the bed of each point is at which the weighted mean of the depths is zero."""
    weights = tile.weights
    for j in range(weights.shape[1]):
        total, change = 0.0, 0.0
        for k in range(len(weights)):
            slope = tile.shown[k, _BY_HEIGHT * TILE + j]
            if weights[k, j] > 0.0 and slope == slope:
                total += weights[k, j] * tile.shown[k, _DEPTH * TILE + j]
                change += weights[k, j] * slope
        tile.step[j] = -total / change


@device
def _move(tile: MapTile, least_m: float, share: float) -> bool:
    """Move the beds to where the fused depths give the apparent points; return whether any moved.

    A bed moves by more than `least_m` and a share of its distance from the apparent point.
    """
    _set_steps(tile)
    searched = False
    for j in range(tile.rows.size):
        step, bed = tile.step[j], tile.room[_BED * TILE + j]
        # NaN where no image with a weight sees the bed
        tile.going[j] = np.isfinite(step) and abs(step) > least_m + share * abs(bed)
        if tile.going[j]:
            tile.room[_BED * TILE + j] = bed + step
            searched = True
    return searched


@device
def _finish(result: FloatArray, tile: MapTile) -> None:
    """Write the rows: the weighted mean of the Q, moved by the rest of the step."""
    weights = tile.weights
    _set_steps(tile)
    for j in range(weights.shape[1]):
        row, step = result[tile.rows[j]], tile.step[j]
        total, x, y, square, count = 0.0, 0.0, 0.0, 0.0, 0
        for k in range(len(weights)):
            shown, w = tile.shown[k], weights[k, j]
            if w > 0.0 and shown[_BY_HEIGHT * TILE + j] == shown[_BY_HEIGHT * TILE + j]:
                # Q on the ray of this image, at the height of the bed after the step
                q, by_height = three(shown, _Q * TILE + j), three(shown, _Q_BY_HEIGHT * TILE + j)
                u, v, _ = beyond(q, step, by_height)
                total, count, square = total + w, count + 1, square + w * (u * u + v * v)
                x, y = x + w * u, y + w * v
        # without a map that sees the bed the point stays where it is
        row[_OUTCOME] = ONE_CAMERA if tile.start[j + 1] > tile.start[j] else NO_CAMERA
        per_weight = 1.0 / total
        x, y, square = x * per_weight, y * per_weight, square * per_weight
        if np.isfinite(step) and np.isfinite(square):
            row[0], row[1], row[2] = x, y, tile.room[_BED * TILE + j] + step
            row[_DISTANCE] = np.sqrt(max(square - x * x - y * y, 0.0))
            row[_OUTCOME], row[_COUNT] = CORRECTED, count

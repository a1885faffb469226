r"""Find the true point that stereo pairs would have placed, by the median, at the apparent one.

Semi-global matchers (such as MicMac and SURE) match two images at a time. Each pair that shows a
point intersects its two straight rays, and the point of the cloud is the median of these places.
Under water every pair has an error of its own, larger the more obliquely it looks.

The model, for an apparent point P and its pairs (a, b), all of which show one true point Q:

1. The light from Q leaves the water towards the camera c, which sees it in the direction w_c
   (`pcfix.refract.rays`).
2. The two straight rays of a pair give the place with the least squared residuals in the two
   images,

       X_ab(Q) = argmin_X  sum_{c = a, b} \|G_c (X - C_c)\|^2

   with G_c the derivative of the image of camera c by position, 2 x 3, px/m, on the ray w_c at the
   distance of X. G_c w_c = 0, so that a residual off the ray is one in the image.
3. The matcher's point is the median of the X_ab in x, y and z separately. With three pairs or
   more it depends on the axes, so that the cloud must be in the frame that it was matched in.

Q is found where that median is P: three equations for three unknowns. The median of smooth
functions is continuous, with kinks where it changes from one pair to another. Broyden's method
starts at `snell`'s solution with the derivative diag(1, 1, apparent by true depth), and goes back
to half such a step wherever it does not come nearer.

Points that need more than a few steps form new tiles.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import (
    Vector,
    beyond,
    cross,
    dot,
    minus,
    row_of,
    scaled,
    solved,
    times,
    transposed_times,
    vector,
)
from pcfix.lens.formulas import KIND, PERSPECTIVE, PLAIN
from pcfix.lens.imaging import Plain, image_and_slopes, plain_lens
from pcfix.model import BoolArray, FloatArray, IntArray, Outcome, Views
from pcfix.refract import tiling
from pcfix.refract.batch import (
    CORRECTED,
    NO_CAMERA,
    ONE_CAMERA,
    PARALLEL,
    Batch,
    Chosen,
    Images,
    Intersection,
    images_of,
    in_other,
    warn_of_unsolved,
)
from pcfix.refract.intersect import add_camera
from pcfix.refract.rays import MIN_DETERMINANT, light_near, nearest_point, ray_distance
from pcfix.refract.tiling import TILE, nine, put, slots, three

STEPS, MAX_STEPS = 3, 40  # of a tile, after which its remaining points form new ones; most steps
CLOSE_M = 2e-4  # of the median from P before the last step, which leaves some millionths
ABSENT = -1

# Columns of a search: Q, the nearest Q so far, F there and its size, the share of a step, whether
# it goes on, and the ratio of true to apparent depth at the start. Of the result: the shift, the
# distance from the rays, and the outcome.
(
    _, _NEAREST, _AT_NEAREST, _BEST, _SHARE, _IS_ACTIVE, _RATIO,
    _SHIFT, _DISTANCE, _OUTCOME, _WIDTH,
) = slots(3, 3, 3, 1, 1, 1, 1, 3, 1, 1)  # fmt: skip

# Runs of `TILE` numbers of a ray: the gradient of the scale of its image by place, and of the image
# of Q G'G, G'G e and |G e|^2.
_BY_PLACE, _SQUARE, _RIGHT, _REST, RAY = slots(3, 6, 3, 1)


class PairInputs(NamedTuple):
    """All points and cameras, the pairs, and the searches, for kernels."""

    points: Chosen
    images: Images
    search: FloatArray  # (m, `_WIDTH`)
    derivative: FloatArray  # (m, 3, 3), B: of Q by the median
    partners: IntArray  # (k, ...), the partners of each image, each pair once


class PairTile(NamedTuple):
    """A tile of m points, the k rays of its cameras and the p pairs of these, for kernels."""

    rows: IntArray  # (m,), the rows of the points
    near: IntArray  # (k,), the cameras
    ray: IntArray  # of each camera of the block, its row among those near, or `ABSENT`
    marks: FloatArray  # (k, m), whether the camera is in a pair of the point
    pairs: IntArray  # (p, 2), the two rays of each pair
    own: IntArray  # (3, m, most), the pairs of each point in the order of their x, y and z
    wide: IntArray  # (m,), how many these are
    narrow: IntArray  # (m,), and how many more without a base
    points: FloatArray  # runs of `TILE` numbers: those of `tiling.gather`, and the original P
    sums: FloatArray  # those of `add_camera`
    now: FloatArray  # Q
    rays: FloatArray  # (k, `RAY`)
    places: FloatArray  # (p, 3), X_ab
    values: FloatArray  # (most,), for the median


def invert_pairs(batch: Batch) -> Intersection:
    """Return the true points from which the median of stereo pairs would be the apparent ones.

    The views of the batch are the cameras that may be in a pair; the pairs are those of images that
    the matcher matched, each once. The surface above each point is taken as a plane.

    `ray_count` and `incidence_deg` are of the cameras that are in a pair; `ray_miss_m` is the
    distance from their refracted rays through the apparent point, as for `snell`. A point with
    cameras but without a pair is `ONE_CAMERA`, one with narrow pairs only `PARALLEL_RAYS`. Points
    without a solution get that of `snell`, with a warning.
    """
    survey, matcher = batch.survey, batch.survey.learned.matcher
    if matcher is None:
        raise ValueError("a model of the matcher is needed")
    # a pair that both images have counts for the first one
    image, at = np.nonzero(matcher.matched >= 0)
    partner, partners = matcher.matched[image, at], matcher.matched.copy()
    again = (matcher.matched[partner] == image[:, None]).any(axis=1) & (partner < image)
    partners[image[again], at[again]] = -1
    images = images_of(batch.original_model, survey.cameras)
    search, derivative = np.zeros((len(batch), _WIDTH)), np.zeros((len(batch), 3, 3))
    given = PairInputs(batch.chosen(), images, search, derivative, partners)
    used, rows = np.zeros(len(batch.rays.camera), np.bool_), tiling.spatial_order(batch.xyz)
    for steps in range(0, MAX_STEPS, STEPS):
        in_tiles(
            _search, -(-len(rows) // TILE), rows, given, steps == 0, used,
            points=0 if steps else len(batch),
        )  # fmt: skip
        rows = rows[search[rows, _IS_ACTIVE] > 0.0]
    outcome = search[:, _OUTCOME].astype(np.uint8)
    moved = outcome == Outcome.CORRECTED
    warn_of_unsolved("stereo pairs: no solution", search[moved, _BEST] <= CLOSE_M)
    count = np.concatenate([[0], np.cumsum(used)])
    in_pairs = Views(count[batch.rays.start], np.asarray(batch.rays.camera)[used])
    return replace(batch, views=in_pairs).result(
        search[:, _SHIFT:_DISTANCE], outcome=outcome, ray_miss_m=search[:, _DISTANCE]
    )


@kernel(allocates=True)
def _search(span: Span, order: IntArray, given: PairInputs, first: bool, used: BoolArray) -> None:
    """Search the points of some tiles, the first time from `snell`'s solution, by a few steps."""
    points, k = given.points, len(given.points.rig.centres)
    ray = np.empty(k, np.int64)
    for t in range(*span):
        rows, runs = order[t * TILE : (t + 1) * TILE], np.empty(10 * TILE)
        tiling.gather(runs, rows, points)
        tiling.gather_three(runs[7 * TILE :], rows, points.original_xyz)
        near, marks = tiling.marks_of_lists(points.start, points.camera, rows, k)
        ray[:] = ABSENT
        for q in range(near.size):
            ray[near[q]] = q
        # the marks become those of cameras in a pair
        pairs, own, wide, narrow = _pairs_of(rows, marks, ray, runs, given)
        tile = PairTile(
            rows, near, ray, marks, pairs, own, wide, narrow, runs, np.zeros(11 * TILE),
            np.empty(3 * TILE), np.empty((near.size, RAY * TILE)),
            np.empty((len(pairs), 3 * TILE)), np.empty(own.shape[2]),
        )  # fmt: skip
        for q in range(near.size):
            add_camera(tile.sums, runs, marks[q], points, near[q], 0.0, None, None)
        if first:
            _start(tile, given, used)
        for _ in range(STEPS):
            if not _step(tile, given):
                break
        # a search that is done, or came near enough, replaces the intersection
        for j in range(rows.size):
            one = given.search[rows[j]]
            if one[_OUTCOME] == CORRECTED and one[_BEST] <= CLOSE_M:
                k_rays, sums = tile.sums[9 * TILE + j], nine(tile.sums, j)
                one[_SHIFT], one[_SHIFT + 1], one[_SHIFT + 2] = vector(one)
                one[_DISTANCE] = ray_distance(k_rays, sums, vector(one))


@device(allocates=True)
def _pairs_of(
    rows: IntArray, marks: FloatArray, ray: IntArray, runs: FloatArray, given: PairInputs
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return the pairs of a tile, as in `PairTile`: pairs, own, wide and narrow.

    The marks say which cameras each point has, and afterwards which of them are in a pair.
    """
    points, k, step = given.points, len(marks), given.partners.shape[1]
    most = 0
    for i in rows:
        most = max(most, (points.start[i + 1] - points.start[i]) * step)
    # the number of each pair of rays, in the order in which the points have them
    number, total = np.full((k, k), ABSENT), 0
    pairs = np.empty((min(k * k, rows.size * most), 2), np.int64)
    own = np.empty((3, rows.size, most), np.int64)
    wide, narrow = np.zeros(rows.size, np.int64), np.zeros(rows.size, np.int64)
    in_pair = np.zeros(marks.shape)
    for j in range(rows.size):
        for a in points.camera[points.start[rows[j]] : points.start[rows[j] + 1]]:
            for b in given.partners[a]:
                # both cameras must be among those of the point
                if b < 0 or ray[b] < 0 or not marks[ray[b], j] > 0.0:
                    continue
                if not _is_wide(a, b, j, runs, points):
                    narrow[j] += 1
                    continue
                one, other = ray[a], ray[b]
                if number[one, other] < 0:
                    number[one, other], pairs[total, 0], pairs[total, 1] = total, one, other
                    total += 1
                for axis in range(3):
                    own[axis, j, wide[j]] = number[one, other]
                wide[j] += 1
                in_pair[one, j], in_pair[other, j] = 1.0, 1.0
    marks[:] = in_pair
    return pairs[:total], own, wide, narrow


@device
def _is_wide(a: int, b: int, j: int, tile: FloatArray, points: Chosen) -> bool:
    """Whether a pair has a base, as seen from P, and both cameras are above P and the water.

    The limit is that of `pcfix.refract.rays.nearest_point` for two rays.
    """
    p, normal = three(tile, j), three(tile, 4 * TILE + j)
    e_a, e_b = minus(row_of(points.rig.centres, a), p), minus(row_of(points.rig.centres, b), p)
    # sin^2 of the angle between the rays against that of parallel ones
    across, depth = cross(e_a, e_b), tile[3 * TILE + j] - p[2]
    above = dot(normal, e_a) > max(normal[2] * (depth + points.rig.offset[a]), 0.0)
    above = above and dot(normal, e_b) > max(normal[2] * (depth + points.rig.offset[b]), 0.0)
    return above and dot(across, across) >= 4.0 * MIN_DETERMINANT * dot(e_a, e_a) * dot(e_b, e_b)


@device
def _start(tile: PairTile, given: PairInputs, used: BoolArray) -> None:
    """Set the start of each search, the outcome, and which cameras are used."""
    points, runs = given.points, tile.points
    for j in range(tile.rows.size):
        i, one = tile.rows[j], given.search[tile.rows[j]]
        first, last = points.start[i], points.start[i + 1]
        if tile.wide[j] == 0:
            # no pair has a base, or there is none
            few = ONE_CAMERA if last > first else NO_CAMERA
            one[_OUTCOME] = PARALLEL if tile.narrow[j] else few
            continue
        for at in range(first, last):
            used[at] = tile.marks[tile.ray[points.camera[at]], j] > 0.0
        fixed, q, distance = nearest_point(tile.sums[9 * TILE + j], nine(tile.sums, j))
        one[_OUTCOME] = CORRECTED if fixed else PARALLEL
        if fixed:
            one[0], one[1], one[2] = q
            one[_SHIFT], one[_SHIFT + 1], one[_SHIFT + 2] = q
            one[_BEST], one[_SHARE], one[_IS_ACTIVE], one[_DISTANCE] = np.inf, 1.0, 1.0, distance
            # a place sinks as the true point does, times the ratio of their depths
            depth = runs[3 * TILE + j] - runs[2 * TILE + j]
            one[_RATIO] = 1.0 - q[2] / depth if depth > 0.0 else 1.0
            _start_derivative(given.derivative[i], one)


@device
def _step(tile: PairTile, given: PairInputs) -> bool:
    """Do one step of all searches of a tile; return whether any goes on."""
    optics, places, is_active = given.images.original, tile.places, False
    for j in range(tile.rows.size):
        put(tile.now, j, vector(given.search[tile.rows[j]]))
    for q in range(tile.near.size):
        lens = optics.lenses[optics.row[tile.near[q]]]
        # numba compiles a version of `_see` for each kind of argument
        if lens[PLAIN] != 0.0:
            _see(tile.rays[q], tile.near[q], tile, given, plain_lens(lens))
        else:
            _see(tile.rays[q], tile.near[q], tile, given, None)
    for p in range(len(tile.pairs)):
        one, other = tile.rays[tile.pairs[p, 0]], tile.rays[tile.pairs[p, 1]]
        _meet(places[p], one, other, tile.rows.size)
    for j in range(tile.rows.size):
        search, count = given.search[tile.rows[j]], tile.wide[j]
        if search[_IS_ACTIVE] > 0.0:
            # the median is relative to P, so that it is F itself
            x = _median(places, tile.values, tile.own[0, j, :count], j)
            y = _median(places, tile.values, tile.own[1, j, :count], TILE + j)
            z = _median(places, tile.values, tile.own[2, j, :count], 2 * TILE + j)
            _advance(search, given.derivative[tile.rows[j]], (x, y, z))
            is_active = is_active or search[_IS_ACTIVE] > 0.0
    return is_active


@device
def _see(ray: FloatArray, c: int, tile: PairTile, given: PairInputs, plain: Plain | None) -> None:
    """Write the normal equations of the images of Q: G'G, G'G e and |G e|^2; see `RAY`.

    The direction w, in the original model, is scaled to the distance of P, so that G is that there.
    The scale of an image depends on the distance, relative to that of P: along the axis in a
    perspective image, from the centre in other projections.
    """
    points, images, runs = given.points, given.images, tile.points
    centre, original, optics = (
        row_of(points.rig.centres, c),
        row_of(images.centres, c),
        images.original,
    )
    r, lens, offset = optics.rotations[c], optics.lenses[optics.row[c]], points.rig.offset[c]
    axis = row_of(r, 2)
    is_flat = lens[KIND] == PERSPECTIVE
    for j in range(tile.rows.size):
        p, normal = three(runs, j), three(runs, 4 * TILE + j)
        above = normal[2] * (runs[3 * TILE + j] - p[2] + offset)
        k, _, _, _, s = light_near(three(tile.now, j), minus(centre, p), normal, above, points.n)
        w = in_other(images.adjusted, optics, c, minus(scaled(k, s), normal))
        e = minus(original, three(runs, 7 * TILE + j))
        size2, ahead = dot(e, e), -dot(axis, e)
        # behind a perspective camera the depth along the axis has no meaning
        flat = is_flat and ahead > 0.0
        scale = 1.0 / ahead if flat else -1.0 / size2
        by_place = scaled(scale, axis if flat else e)
        # g.w is the distance of w in terms of P
        w = scaled(1.0 / dot(w, by_place), w)
        u, _, by_u, by_v = image_and_slopes(lens, plain, r, w)
        # NaN where there is no image
        off_u, off_v = dot(by_u, e) + 0.0 * u, dot(by_v, e)
        put(ray, _BY_PLACE * TILE + j, by_place)
        (a, b, c_), (x, y, z) = by_u, by_v
        put(ray, _SQUARE * TILE + j, (a * a + x * x, a * b + x * y, a * c_ + x * z))
        put(ray, (_SQUARE + 3) * TILE + j, (b * b + y * y, b * c_ + y * z, c_ * c_ + z * z))
        put(ray, _RIGHT * TILE + j, beyond(scaled(off_u, by_u), off_v, by_v))
        ray[_REST * TILE + j] = off_u * off_u + off_v * off_v


@device
def _meet(place: FloatArray, a: FloatArray, b: FloatArray, count: int) -> None:
    """Write where the straight rays of a pair have the least squared residuals in their images.

    At X the residual of a camera is G (X - e) / t, with t = 1 + g.X the distance of X relative to
    that of P. The first round takes t = 1. The second has t, and its change with X: at the minimum

        sum_c G'G (X - e) / t^2 - r^2 / t^3 g = 0,    r^2 = |G (X - e)|^2

    That matters for narrow pairs whose rays pass each other.
    """
    # first t = 1, then with the t and r^2 of that place
    for j in range(count):
        put(place, j, _solve_two(a, b, j, 1.0, 1.0, 0.0, 0.0))
    for j in range(count):
        x = three(place, j)
        t, r2 = _residual(x, a, j)
        t_b, r2_b = _residual(x, b, j)
        of_a, of_b = 1.0 / (t * t), 1.0 / (t_b * t_b)
        put(place, j, _solve_two(a, b, j, of_a, of_b, r2 * of_a / t, r2_b * of_b / t_b))


@device(forceinline=True)
def _residual(place: Vector, ray: FloatArray, j: int) -> tuple[float, float]:
    """Return t and r^2 of a place."""
    x, y, z = place
    xx, xy, xz = three(ray, _SQUARE * TILE + j)
    yy, yz, zz = three(ray, (_SQUARE + 3) * TILE + j)
    # |G (X - e)|^2 from the sums
    twice = x * (xy * y + xz * z) + yz * y * z - dot(place, three(ray, _RIGHT * TILE + j))
    r2 = xx * x * x + yy * y * y + zz * z * z + 2.0 * twice + ray[_REST * TILE + j]
    return 1.0 + dot(place, three(ray, _BY_PLACE * TILE + j)), r2


@device(forceinline=True)
def _solve_two(
    a: FloatArray, b: FloatArray, j: int, of_a: float, of_b: float, g_a: float, g_b: float
) -> Vector:
    """Solve the normal equations of two rays, with the weights and gradients of each."""
    right = _sum(a, b, _RIGHT * TILE + j, of_a, of_b)
    right = beyond(right, g_a, three(a, _BY_PLACE * TILE + j))
    right = beyond(right, g_b, three(b, _BY_PLACE * TILE + j))
    first = _sum(a, b, _SQUARE * TILE + j, of_a, of_b)
    last = _sum(a, b, (_SQUARE + 3) * TILE + j, of_a, of_b)
    return solved(first + last, right)[1]


@device(forceinline=True)
def _sum(a: FloatArray, b: FloatArray, at: int, of_a: float, of_b: float) -> Vector:
    """Return a weighted sum of three numbers of two rays."""
    return beyond(scaled(of_a, three(a, at)), of_b, three(b, at))


@device
def _median(places: FloatArray, values: FloatArray, own: IntArray, at: int) -> float:
    """Return the median of one coordinate of the places of some pairs, NaN if one is.

    The pairs are sorted in place by insertion: from step to step their order changes little.
    """
    for i in range(own.size):
        pair, to = own[i], i
        value = places[pair, at]
        if value != value:
            return np.nan
        while to > 0 and values[to - 1] > value:
            values[to], own[to] = values[to - 1], own[to - 1]
            to -= 1
        values[to], own[to] = value, pair
    half = own.size // 2
    return values[half] if own.size % 2 else 0.5 * (values[half - 1] + values[half])


@device
def _advance(one: FloatArray, b: FloatArray, f: Vector) -> None:
    """Move the Q of a search to where the median F of the pairs' places is P.

    From the nearest Q so far goes a step s = -B F. Where F comes nearer, by y, the good Broyden
    update is B + (s - B y) s'B / (s'B y); where it does not, B starts again with half the step.
    """
    size = np.sqrt(dot(f, f))
    if size < one[_BEST]:
        if one[_BEST] < np.inf and size > CLOSE_M:
            s, y = minus(vector(one), vector(one, _NEAREST)), minus(f, vector(one, _AT_NEAREST))
            missing, left = minus(s, times(b, y)), transposed_times(b, s)
            along = dot(left, y)
            for i in range(3 if along != 0.0 else 0):
                for j in range(3):
                    b[i, j] += missing[i] * left[j] / along
        for i in range(3):
            one[_NEAREST + i], one[_AT_NEAREST + i] = one[i], f[i]
        one[_BEST] = size
    elif one[_BEST] < np.inf:
        one[_SHARE] *= 0.5
        _start_derivative(b, one)
    else:  # no image of the start
        one[_IS_ACTIVE] = 0.0
        return
    step = times(b, vector(one, _AT_NEAREST))
    one[0], one[1], one[2] = minus(vector(one, _NEAREST), step)
    # the last step is small enough for the B so far
    one[_IS_ACTIVE] = 1.0 if one[_BEST] > CLOSE_M else 0.0


@device
def _start_derivative(b: FloatArray, one: FloatArray) -> None:
    """Set B to a share of diag(1, 1, true by apparent depth)."""
    b[:] = 0.0
    b[0, 0], b[1, 1], b[2, 2] = one[_SHARE], one[_SHARE], one[_SHARE] * one[_RATIO]

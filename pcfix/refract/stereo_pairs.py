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
starts at `snell`'s solution with the derivative diag(1, 1, 1/n), as if all light came from straight
above, and goes back to half such a step wherever it does not come nearer.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel, most_between
from pcfix.lens import algebra
from pcfix.lens.algebra import (
    Vector,
    beyond,
    cross,
    dot,
    minus,
    plus,
    row_of,
    scaled,
    solved,
    vector,
)
from pcfix.lens.formulas import KIND, PERSPECTIVE
from pcfix.lens.imaging import image_in_world
from pcfix.model import BoolArray, FloatArray, IntArray, Outcome, Views
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
    normal_above,
    to_original,
    warn_of_unsolved,
)
from pcfix.refract.choice import cameras_of_pairs
from pcfix.refract.intersect import check_consistent
from pcfix.refract.rays import (
    MIN_DETERMINANT,
    NO_LINE,
    light_near,
    nearest_point,
    plus_line,
    ray_distance,
    refracted,
)

MAX_STEPS = 40
CLOSE_M = 5e-5
"""Largest distance of the median from P before the last step, which leaves about a millionth."""


# Columns of the result.
_DISTANCE, _OUTCOME, _FOUND, _WIDTH = 3, 4, 5, 6

# Columns of a ray: e, the height of its water over P, e of the original model, the gradient of its
# scale (g of `_meet`), and of the image of Q G'G (xx, xy, xz, yy, yz, zz), G'G e, |G e|^2.
_ABOVE, _ORIGINAL, _BY_PLACE, _SQUARE, _RIGHT, _RAY_WIDTH = 3, 4, 7, 10, 16, 20


class _Point(NamedTuple):
    """One apparent point with its rays and pairs; coordinates are relative to the point."""

    normal: Vector  # of the water above the point
    n: float  # refractive index
    rays: FloatArray  # (j, ...), a row for each of its cameras
    cameras: IntArray  # (j,)
    used: BoolArray  # (j,), whether the camera is in a pair
    pairs: IntArray  # (p, 2), the rays of each pair
    places: FloatArray  # (3, p), temporary: where the pairs place a true point


def invert_pairs(batch: Batch, pairs: Views | None = None) -> Intersection:
    """Return the true points from which the median of stereo pairs would be the apparent ones.

    The views of the batch are pairs, or the cameras that may be in one; then `pairs`, of the kind
    pairs, count if both cameras are among the views. By default the pairs are those of images that
    the matcher matched, each once. The surface above each point is taken as a plane.

    `ray_count` and `incidence_deg` are of the cameras that are in a pair; `ray_miss_m` is the
    distance from their refracted rays through the apparent point, as for `snell`. A point with
    cameras but without a pair is `ONE_CAMERA`, one with narrow pairs only `PARALLEL_RAYS`. Points
    without a solution get that of `snell`, with a warning.
    """
    check_consistent(batch.survey.cameras)
    if batch.rays.kind == "pairs":
        pairs, batch = batch.rays, replace(batch, views=cameras_of_pairs(batch.rays))
    cameras, matcher = batch.survey.cameras, batch.survey.learned.matcher
    if pairs is None and matcher is None:
        raise ValueError("pairs or a model of the matcher are needed")
    start, camera, partners = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 0), int)
    if pairs is not None:
        start, camera = np.asarray(pairs.start, np.int64), np.asarray(pairs.camera, np.int64)
    elif matcher is not None:
        partners = _each_once(matcher.matched)
    used, result = np.zeros(len(batch.rays.camera), np.bool_), np.zeros((len(batch), _WIDTH))
    images = images_of(batch.original_model, cameras)
    in_tiles(
        _invert, len(batch), batch.chosen(), images, (start, camera, partners), used, result,
        points=len(batch),
    )  # fmt: skip
    outcome = result[:, _OUTCOME].astype(np.uint8)
    moved = outcome == Outcome.CORRECTED
    warn_of_unsolved("stereo pairs: no solution", result[moved, _FOUND] > 0.0)
    count = np.concatenate([[0], np.cumsum(used)])
    in_pairs = Views(count[batch.rays.start], np.asarray(batch.rays.camera)[used])
    found = replace(batch, views=in_pairs)
    return found.result(result[:, :3], outcome=outcome, ray_miss_m=result[:, _DISTANCE])


def _each_once(matched: IntArray) -> IntArray:
    """Return the images that each was matched with, -1 for a pair that the other one has too."""
    image, at = np.nonzero(matched >= 0)
    partner = matched[image, at]
    again = (matched[partner] == image[:, None]).any(axis=1) & (partner < image)
    once = matched.copy()
    once[image[again], at[again]] = -1
    return once


@kernel(allocates=True)
def _invert(
    span: Span, points: Chosen, images: Images, listed: tuple[IntArray, IntArray, IntArray],
    used: BoolArray, result: FloatArray,
) -> None:  # fmt: skip
    """Correct some points; without listed pairs they are those of the matcher."""
    (listed_start, listed_camera, partners), start = listed, points.start
    most = most_between(span, start)
    most_pairs = most * partners.shape[1]
    if listed_start.size:
        most_pairs = most_between(span, listed_start) // 2
    rays, place = np.empty((most, _RAY_WIDTH)), np.full(len(points.centres), -1)
    pairs, places = np.empty((most_pairs, 2), np.int64), np.empty((3, most_pairs))
    inverse = np.empty((3, 3))
    for i in range(*span):
        cameras, normal = points.camera[start[i] : start[i + 1]], normal_above(points, i)
        flags = used[start[i] : start[i + 1]]
        # `place` maps a camera to its ray of this point
        for j in range(cameras.size):
            place[cameras[j]] = j
            _begin(rays[j], points, i, cameras[j], images)
        count = 0
        if listed_start.size:
            for at in range(listed_start[i], listed_start[i + 1], 2):
                a, b = place[listed_camera[at]], place[listed_camera[at + 1]]
                if a >= 0 and b >= 0 and a != b:
                    pairs[count, 0], pairs[count, 1], count = a, b, count + 1
        else:
            for a in range(cameras.size):
                for partner in partners[cameras[a]]:
                    if partner >= 0 and place[partner] >= 0:
                        pairs[count, 0], pairs[count, 1], count = a, place[partner], count + 1
        for c in cameras:
            place[c] = -1
        wide = _wide_pairs(pairs[:count], rays, normal)
        if wide == 0:
            few = ONE_CAMERA if cameras.size else NO_CAMERA
            result[i, _OUTCOME] = PARALLEL if count else few
            continue
        for p in range(wide):
            flags[pairs[p, 0]], flags[pairs[p, 1]] = True, True
        point = _Point(normal, points.n, rays, cameras, flags, pairs[:wide], places[:, :wide])
        _solve(result[i], point, images, inverse)


@device
def _begin(ray: FloatArray, points: Chosen, i: int, c: int, images: Images) -> None:
    """Fill in where a ray comes from, and how the scale of its image changes with the place.

    The scale depends on the distance, relative to that of P: along the axis in a perspective
    image, from the centre in other projections.
    """
    e = minus(row_of(points.centres, c), row_of(points.xyz, i))
    up = normal_above(points, i)[2]
    ray[_ABOVE] = up * (points.height[i] - points.xyz[i, 2] + points.offset[c])
    original = minus(row_of(images.centres, c), row_of(points.original_xyz, i))
    optics = images.original
    axis, size2 = row_of(optics.rotations[c], 2), dot(original, original)
    ahead = -dot(axis, original)
    # behind a perspective camera the depth along the axis has no meaning
    flat = optics.lenses[optics.row[c], KIND] == PERSPECTIVE and ahead > 0.0
    for j in range(3):
        ray[j], ray[_ORIGINAL + j] = e[j], original[j]
        ray[_BY_PLACE + j] = axis[j] / ahead if flat else -original[j] / size2


@device
def _see(ray: FloatArray, q: Vector, c: int, point: _Point, images: Images) -> None:
    """Write the normal equations of the image of Q: G'G, G'G e and |G e|^2.

    The direction w, in the original model, is scaled to the distance of P, so that G is that there.
    """
    k, _, _, _, s = light_near(q, vector(ray), point.normal, ray[_ABOVE], point.n)
    w = to_original(images, c, minus(scaled(k, s), point.normal))
    # g.w is the distance of w in terms of P
    w = scaled(1.0 / dot(w, vector(ray, _BY_PLACE)), w)
    optics, e = images.original, vector(ray, _ORIGINAL)
    _, _, by_u, by_v = image_in_world(optics.lenses[optics.row[c]], optics.rotations[c], w)
    ray[_SQUARE:] = 0.0
    for g in (by_u, by_v):
        (x, y, z), off = g, dot(g, e)
        # one row g of G: g g', (g.e) g and (g.e)^2
        terms = (x * x, x * y, x * z, y * y, y * z, z * z, off * x, off * y, off * z, off * off)
        for i in range(10):
            ray[_SQUARE + i] += terms[i]


@device
def _meet(a: FloatArray, b: FloatArray) -> Vector:
    """Return where two straight rays have the least squared residuals in their images.

    At X the residual of a camera is G (X - e) / t, with t = 1 + g.X the distance of X relative to
    that of P. The first round takes t = 1. The second has t, and its change with X: at the minimum

        sum_c G'G (X - e) / t^2 - r^2 / t^3 g = 0,    r^2 = |G (X - e)|^2

    That matters for narrow pairs whose rays pass each other.
    """
    # first t = 1, then with the t and r^2 of that place
    place = _solve_two(a, b, 1.0, 1.0, 0.0, 0.0)
    t, r2 = _residual(place, a)
    t_b, r2_b = _residual(place, b)
    return _solve_two(a, b, 1.0 / (t * t), 1.0 / (t_b * t_b), r2 / t**3, r2_b / t_b**3)


@device
def _residual(place: Vector, ray: FloatArray) -> tuple[float, float]:
    """Return t and r^2 of a place."""
    (x, y, z), s = place, ray[_SQUARE:]
    t = 1.0 + x * ray[_BY_PLACE] + y * ray[_BY_PLACE + 1] + z * ray[_BY_PLACE + 2]
    # |G (X - e)|^2 from the sums
    twice = x * (s[1] * y + s[2] * z) + s[4] * y * z - (s[6] * x + s[7] * y + s[8] * z)
    return t, s[0] * x * x + s[3] * y * y + s[5] * z * z + 2.0 * twice + s[9]


@device
def _solve_two(
    a: FloatArray, b: FloatArray, of_a: float, of_b: float, g_a: float, g_b: float
) -> Vector:
    """Solve the normal equations of two rays, with the weights and gradients of each."""
    right = beyond(_sum(a, b, of_a, of_b, _RIGHT), g_a, vector(a, _BY_PLACE))
    right = beyond(right, g_b, vector(b, _BY_PLACE))
    xx, xy, xz = _sum(a, b, of_a, of_b, _SQUARE)
    yy, yz, zz = _sum(a, b, of_a, of_b, _SQUARE + 3)
    return solved((xx, xy, xz, yy, yz, zz), right)[1]


@device
def _sum(a: FloatArray, b: FloatArray, of_a: float, of_b: float, at: int) -> Vector:
    """Return a weighted sum of three columns of two rays."""
    return plus(scaled(of_a, vector(a, at)), scaled(of_b, vector(b, at)))


@device
def _wide_pairs(pairs: IntArray, rays: FloatArray, normal: Vector) -> int:
    """Bring the pairs that have a base, as seen from P, to the front; return how many there are.

    The limit is that of `pcfix.refract.rays.nearest_point` for two rays. Cameras below the water
    or the point have no ray.
    """
    count = 0
    for p in range(len(pairs)):
        first, second = rays[pairs[p, 0]], rays[pairs[p, 1]]
        a, b = vector(first), vector(second)
        # sin^2 of the angle between the rays against that of parallel ones
        across = cross(a, b)
        above = dot(normal, a) > max(first[_ABOVE], 0.0)
        above = above and dot(normal, b) > max(second[_ABOVE], 0.0)
        wide = dot(across, across) >= 4.0 * MIN_DETERMINANT * (dot(a, a) * dot(b, b))
        if above and wide:
            pairs[count, 0], pairs[count, 1] = pairs[p, 0], pairs[p, 1]
            count += 1
    return count


@device
def _solve(out: FloatArray, point: _Point, images: Images, inverse: FloatArray) -> None:
    """Solve one point and write its row."""
    k, sums, n = 0.0, NO_LINE, point.n
    for j in range(point.used.size):
        if point.used[j]:
            e, above = vector(point.rays[j]), point.rays[j, _ABOVE]
            # where the ray through P enters the water, and its direction there
            length2, across = dot(e, e), dot(point.normal, e)
            f, bend = (above / across, 1.0 / n) if above > 0.0 else (0.0, 1.0)
            d = refracted(e, length2, point.normal, across, bend)
            k, sums = k + 1.0, plus_line(sums, scaled(f, e), d, 1.0 / length2)
    fixed, start, _ = nearest_point(k, sums)
    if not fixed:
        out[_OUTCOME] = PARALLEL
        return
    found, q = _search(start, inverse, point, images)
    out[0], out[1], out[2] = q
    out[_DISTANCE] = ray_distance(k, sums, q)
    out[_OUTCOME], out[_FOUND] = CORRECTED, 1.0 if found else 0.0


@device
def _search(
    start: Vector, inverse: FloatArray, point: _Point, images: Images
) -> tuple[bool, Vector]:
    """Return whether a Q was found where the median F of the pairs' places is P, and that Q.

    From the nearest Q so far goes a step s = -B F, at first as from above. Where F comes nearer,
    by y, the good Broyden update is B + (s - B y) s'B / (s'B y); where it does not, B starts again
    with half the step.
    """
    rays, pairs, places = point.rays, point.pairs, point.places
    _as_from_above(inverse, 1.0, point.n)
    q, nearest, at_nearest, best, share = start, start, (0.0, 0.0, 0.0), np.inf, 1.0
    for _ in range(MAX_STEPS):
        # where the pairs would place Q; NaN where a camera has no image of it
        for j in range(point.used.size):
            if point.used[j]:
                _see(rays[j], q, point.cameras[j], point, images)
        for p in range(len(pairs)):
            places[0, p], places[1, p], places[2, p] = _meet(rays[pairs[p, 0]], rays[pairs[p, 1]])
        # the median is relative to P, so that it is F itself
        f = _median(places[0]), _median(places[1]), _median(places[2])
        size = np.sqrt(dot(f, f))
        if size <= CLOSE_M:
            return True, _onward(q, inverse, f)
        if size < best:
            if best < np.inf:
                step, change = minus(q, nearest), minus(f, at_nearest)
                missing = minus(step, algebra.times(inverse, change))
                left = algebra.transposed_times(inverse, step)
                along = dot(left, change)
                for i in range(3 if along != 0.0 else 0):
                    for j in range(3):
                        inverse[i, j] += missing[i] * left[j] / along
            best, nearest, at_nearest = size, q, f
        elif best < np.inf:
            share *= 0.5
            _as_from_above(inverse, share, point.n)
        else:  # no image of the start
            return False, start
        q = _onward(nearest, inverse, at_nearest)
    return False, start


@device
def _onward(q: Vector, inverse: FloatArray, f: Vector) -> Vector:
    """Return Q after a step -B F."""
    return minus(q, algebra.times(inverse, f))


@device
def _as_from_above(inverse: FloatArray, share: float, n: float) -> None:
    """Set B to a share of the inverse derivative for light from straight above."""
    inverse[:] = 0.0
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = share, share, share * n


@device
def _median(values: FloatArray) -> float:
    """Return the median, NaN if a value is; sorts the values in place by insertion."""
    for i in range(values.size):
        value, place = values[i], i
        if value != value:
            return np.nan
        while place > 0 and values[place - 1] > value:
            values[place] = values[place - 1]
            place -= 1
        values[place] = value
    half = values.size // 2
    return values[half] if values.size % 2 else 0.5 * (values[half - 1] + values[half])

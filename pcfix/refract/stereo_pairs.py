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
above, and goes back to half such a step wherever it does not come nearer. In a cell with many
points X_ab(Q) is a polynomial (`pcfix.refract.pair_table`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel, most_between
from pcfix.lens import algebra
from pcfix.lens.algebra import Vector, cross, dot, minus, row_of, scaled, vector
from pcfix.model import BoolArray, FloatArray, IntArray, Outcome, Views
from pcfix.refract import pair_table
from pcfix.refract.batch import (
    CORRECTED,
    NO_CAMERA,
    ONE_CAMERA,
    PARALLEL,
    Batch,
    Chosen,
    Intersection,
    images_of,
    optics_of,
    warn_of_unsolved,
)
from pcfix.refract.cells import are_same, cameras_of, cells_of, is_quick
from pcfix.refract.choice import cameras_of_pairs
from pcfix.refract.consistent import check_consistent
from pcfix.refract.pair_table import ABOVE, PairImages, PairTable
from pcfix.refract.rays import MIN_DETERMINANT, add_line, nearest_point, refracted

MAX_STEPS = 40
ALIKE = 0.5
"""Least ratio of two depths at which a point starts from the one before."""

CLOSE_M = 1e-6
"""Largest distance of the median from P; the error of Q is two or three times as much."""


# Columns of the result.
_DISTANCE, _OUTCOME, _FOUND, _WIDTH = 3, 4, 5, 6


class _Point(NamedTuple):
    """One apparent point with its rays and pairs.

    Attributes
    ----------
    xyz, normal : Vector
        World frame; the normal is that of the water above the point.
    rays : array, shape (j, ...)
        The ray of each of its cameras, see `pcfix.refract.pair_table`.
    cameras : array, shape (j,)
    used : array of bool, shape (j,)
        Whether the camera is in a pair.
    pairs : array, shape (p, 3)
        The rays of each pair, and its row in a table.
    places : array, shape (3, p)
        Temporary: where the pairs place a true point.
    """

    xyz: Vector
    normal: Vector
    rays: FloatArray
    cameras: IntArray
    used: BoolArray
    pairs: IntArray
    places: FloatArray


def invert_pairs(batch: Batch, pairs: Views | None = None) -> Intersection:
    """Return the true points from which the median of stereo pairs would be the apparent ones.

    Parameters
    ----------
    batch : Batch
        Its cameras need angles and lenses. Its views are pairs, or the cameras that may be in one.
        The surface above each point is taken as a plane.
    pairs : Views, optional
        Of the kind pairs; a pair counts if both cameras are among the batch's views. Default: the
        pairs of images that the matcher matched, each once.

    Returns
    -------
    Intersection
        `ray_count` and `incidence_deg` are of the cameras that are in a pair; `ray_miss_m` is the
        distance from their refracted rays through the apparent point, as for `snell`. A point with
        cameras but without a pair is `ONE_CAMERA`, one with narrow pairs only `PARALLEL_RAYS`.
        Points without a solution get that of `snell`, with a warning.
    """
    check_consistent(batch.survey.cameras)
    if batch.rays.kind == "pairs":
        pairs, batch = batch.rays, replace(batch, views=cameras_of_pairs(batch.rays))
    cameras, matcher = batch.survey.cameras, batch.survey.learned.matcher
    if pairs is None and matcher is None:
        raise ValueError("pairs or a model of the matcher are needed")
    original = cameras if batch.original_model is None else batch.original_model.cameras
    none = np.zeros(0, np.int64)
    listed = (none, none)
    if pairs is not None:
        listed = np.asarray(pairs.start, np.int64), np.asarray(pairs.camera, np.int64)
    matched = np.zeros((0, 0), np.int64) if matcher is None else matcher.matched
    used, result = np.zeros(len(batch.rays.camera), np.bool_), np.zeros((len(batch), _WIDTH))
    both = images_of(batch.original_model, cameras)
    images = PairImages(optics_of(original), both, batch.survey.settings.refractive_index)
    order, first = cells_of(batch)
    focal_px = None
    if is_quick(batch) and matcher is not None and batch.original_model is None:
        # without a large cell the kernel is compiled without polynomials
        large = np.diff(first).max(initial=0) >= pair_table.LEAST_POINTS
        focal_px = matcher.focal_px if large else None
    in_tiles(
        _invert, len(first) - 1, (order, first), batch.chosen(), images, (*listed, matched),
        focal_px, used, result, points=len(batch),
    )  # fmt: skip
    outcome = result[:, _OUTCOME].astype(np.uint8)
    moved = outcome == Outcome.CORRECTED
    warn_of_unsolved("stereo pairs: no solution", result[moved, _FOUND] > 0.0)
    count = np.concatenate([[0], np.cumsum(used)])
    in_pairs = Views(count[batch.rays.start], np.asarray(batch.rays.camera)[used])
    found = replace(batch, views=in_pairs)
    return found.result(result[:, :3], outcome=outcome, ray_miss_m=result[:, _DISTANCE])


@kernel(allocates=True)
def _invert(
    span: Span, cells: tuple[IntArray, IntArray], points: Chosen, images: PairImages,
    listed: tuple[IntArray, IntArray, IntArray], focal_px: FloatArray | None, used: BoolArray,
    result: FloatArray,
) -> None:  # fmt: skip
    """Correct the points of each cell.

    Without listed pairs, which are empty then, they are those of the images that were matched. With
    focal lengths large cells have polynomials. A point starts from the one before it, if that has
    the same cameras.
    """
    (order, first), (listed_start, listed_camera, matched) = cells, listed
    start = points.start
    most = most_between((0, len(start) - 1), start)
    most_pairs = most * matched.shape[1]
    if listed_start.size:
        most_pairs = most_between((0, len(start) - 1), listed_start) // 2
    rays, place = np.empty((most, pair_table.RAY_WIDTH)), np.full(len(points.centres), -1)
    pairs, places = np.empty((most_pairs, 3), np.int64), np.empty((3, most_pairs))
    room = np.empty(9), np.empty((3, 3))
    for t in range(*span):
        before, inside = -1, order[first[t] : first[t + 1]]
        if focal_px is None:
            table = None
        else:
            table = pair_table.no_pair_table()
            if inside.size >= pair_table.LEAST_POINTS:
                table = pair_table.pair_table_of(inside, points, images, matched, focal_px)
        for i in inside:
            cameras = points.camera[start[i] : start[i + 1]]
            flags, normal = used[start[i] : start[i + 1]], row_of(points.normals, i)
            # `place` maps a camera to its ray of this point
            for j in range(cameras.size):
                place[cameras[j]] = j
                pair_table.begin(rays[j], points, i, cameras[j], images)
            if listed_start.size:
                entries = listed_camera[listed_start[i] : listed_start[i + 1]]
                count = _listed_pairs(pairs, entries, place)
            else:
                count = _matched_pairs(pairs, cameras, matched, place)
            for c in cameras:
                place[c] = -1
            wide = _wide_pairs(pairs[:count], rays, normal)
            if wide == 0:
                few = ONE_CAMERA if cameras.size else NO_CAMERA
                result[i, _OUTCOME] = PARALLEL if count else few
                continue
            for p in range(wide):
                flags[pairs[p, 0]], flags[pairs[p, 1]] = True, True
            # the result row first holds the start of the search, NaN without one
            near = result[i, :3]
            near[:] = np.nan
            if before >= 0 and are_same(cameras, cameras_of(points, before)):
                depth = points.height[i] - points.xyz[i, 2]
                there = points.height[before] - points.xyz[before, 2]
                # the shift grows with the depth, unless the depths differ much
                if there > 0.0 and ALIKE * there < depth < there / ALIKE:
                    for axis in range(3):
                        near[axis] = result[before, axis] * (depth / there)
            xyz = row_of(points.xyz, i)
            point = _Point(xyz, normal, rays, cameras, flags, pairs[:wide], places[:, :wide])
            quick = False
            if table is not None:
                quick = pair_table.has_pairs(table, points, i, point.pairs)
            _solve(result[i], point, images, room, quick, table)
            before = i if result[i, _FOUND] > 0.0 else -1


@device
def _listed_pairs(pairs: IntArray, entries: IntArray, place: IntArray) -> int:
    """Write the pairs of a list whose cameras both have a place; return how many."""
    count = 0
    for p in range(entries.size // 2):
        a, b = place[entries[2 * p]], place[entries[2 * p + 1]]
        if a >= 0 and b >= 0 and a != b:
            pairs[count, 0], pairs[count, 1], pairs[count, 2] = a, b, -1
            count += 1
    return count


@device
def _matched_pairs(pairs: IntArray, cameras: IntArray, matched: IntArray, place: IntArray) -> int:
    """Write the pairs of cameras of which either was matched with the other; return how many.

    The third column is the entry of `matched` that makes the pair.
    """
    count, partners = 0, matched.shape[1]
    for a in range(cameras.size):
        for p in range(partners):
            partner = matched[cameras[a], p]
            if partner < 0:
                break
            b = place[partner]
            # a pair that each image has in its list counts once
            both = False
            for one in matched[partner]:
                both = both or one == cameras[a]
            if b < 0 or (b < a and both):
                continue
            pairs[count, 0], pairs[count, 1], pairs[count, 2] = a, b, cameras[a] * partners + p
            count += 1
    return count


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
        above = dot(normal, a) > max(first[ABOVE], 0.0)
        above = above and dot(normal, b) > max(second[ABOVE], 0.0)
        wide = dot(across, across) >= 4.0 * MIN_DETERMINANT * (dot(a, a) * dot(b, b))
        if above and wide:
            pairs[count, 0], pairs[count, 1] = pairs[p, 0], pairs[p, 1]
            pairs[count, 2] = pairs[p, 2]
            count += 1
    return count


@device
def _solve(
    out: FloatArray, point: _Point, images: PairImages, room: tuple[FloatArray, FloatArray],
    quick: bool, table: PairTable | None,
) -> None:  # fmt: skip
    """Solve one point and write its row, which has a start already or NaN.

    With `quick` the table of the cell has all pairs of the point.
    """
    (sums, inverse), n = room, images.n
    fixed, q = _snell(sums, point, n)
    if not fixed:
        out[:3], out[_OUTCOME] = 0.0, PARALLEL
        return
    found, near = False, vector(out)
    if near[0] == near[0]:  # B is still that of the point before
        found, near = _search(near, inverse, point, images, quick, table)
    if found:
        q = near
    else:
        start = q
        _as_from_above(inverse, 1.0, n)
        found, q = _search(start, inverse, point, images, quick, table)
        if quick and not found:  # the search left the box of the table
            _as_from_above(inverse, 1.0, n)
            found, q = _search(start, inverse, point, images, False, table)
    out[0], out[1], out[2] = q
    out[_DISTANCE] = _ray_distance(q, point, n)
    out[_OUTCOME], out[_FOUND] = CORRECTED, 1.0 if found else 0.0


@device
def _line(ray: FloatArray, normal: Vector, n: float) -> tuple[Vector, Vector, float]:
    """Return where the ray through P enters the water, its direction, and its length squared."""
    e = vector(ray)
    length2, across = dot(e, e), dot(normal, e)
    f, bend = (ray[ABOVE] / across, 1.0 / n) if ray[ABOVE] > 0.0 else (0.0, 1.0)
    return scaled(f, e), refracted(e, length2, normal, across, bend), length2


@device
def _snell(sums: FloatArray, point: _Point, n: float) -> tuple[bool, Vector]:
    """Return whether there is a point nearest to the refracted rays, and that point."""
    k = 0.0
    sums[:] = 0.0
    for j in range(point.used.size):
        if point.used[j]:
            a, d, length2 = _line(point.rays[j], point.normal, n)
            add_line(sums, a, d, 1.0 / length2)
            k += 1.0
    fixed, q, _, _ = nearest_point(k, sums)
    return fixed, q


@device
def _ray_distance(q: Vector, point: _Point, n: float) -> float:
    """Return the rms distance of Q from the refracted rays through P."""
    k, total = 0.0, 0.0
    for j in range(point.used.size):
        if point.used[j]:
            a, d, length2 = _line(point.rays[j], point.normal, n)
            a = minus(q, a)
            along = dot(a, d)
            total += max(dot(a, a) - along * along / length2, 0.0)
            k += 1.0
    return np.sqrt(total / k)


@device
def _search(
    start: Vector, inverse: FloatArray, point: _Point, images: PairImages, quick: bool,
    table: PairTable | None,
) -> tuple[bool, Vector]:  # fmt: skip
    """Return whether a Q was found where the median F of the pairs' places is P, and that Q.

    From the nearest Q so far goes a step s = -B F, at first with the given B. Where F comes nearer,
    by y, the good Broyden update is B + (s - B y) s'B / (s'B y); where it does not, B starts again
    with half the step.
    """
    q, nearest, at_nearest, best, share = start, start, (0.0, 0.0, 0.0), np.inf, 1.0
    for _ in range(MAX_STEPS):
        if table is None:  # a condition of its own, so that numba drops what follows
            _place_pairs(q, point, images)
        elif quick:
            pair_table.read_pairs(point.places, q, point.xyz, point.pairs, table)
        else:
            _place_pairs(q, point, images)
        # the median is relative to P, so that it is F itself
        f = _median(point.places[0]), _median(point.places[1]), _median(point.places[2])
        size = np.sqrt(dot(f, f))
        if size <= CLOSE_M:
            return True, q
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
            _as_from_above(inverse, share, images.n)
        else:  # no image of the start
            return False, start
        q = nearest
        for j in range(3):
            q = minus(q, scaled(at_nearest[j], algebra.column_of(inverse, j)))
    return False, start


@device
def _as_from_above(inverse: FloatArray, share: float, n: float) -> None:
    """Set B to a share of the inverse derivative for light from straight above."""
    inverse[:] = 0.0
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = share, share, share * n


@device
def _place_pairs(q: Vector, point: _Point, images: PairImages) -> None:
    """Set where the pairs would have placed Q; NaN where a camera has no image of it."""
    rays, pairs, places = point.rays, point.pairs, point.places
    for j in range(point.used.size):
        if point.used[j]:
            pair_table.see(rays[j], q, point.cameras[j], point.normal, images)
    for p in range(len(pairs)):
        place = pair_table.meet(rays[pairs[p, 0]], rays[pairs[p, 1]])
        places[0, p], places[1, p], places[2, p] = place


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

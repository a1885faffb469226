r"""Find the true point that stereo pairs would have placed, by the median, at the apparent one.

Matchers of the semi-global kind (MicMac, SURE and their like) match two images at a time. Each pair
that shows a point intersects its two straight rays, and the point of the cloud is the median of
these places. Under water every pair is off in its own way, more so the more obliquely it looks.

The model, for an apparent point P and its pairs (a, b), all of which show one true point Q:

1. The light from Q leaves the water towards the camera c, which sees it in the direction w_c
   (`pcfix.refract.rays`).
2. The two straight rays of a pair give the place with the least squared residuals in the two
   images,

       X_ab(Q) = argmin_X  sum_{c = a, b} \|G_c (X - C_c)\|^2

   with G_c the derivative of the image of camera c by position, 2 x 3, px/m, on the ray w_c at the
   distance of X. G_c w_c = 0, so that a residual off the ray is one in the image.
3. The matcher's point is the median of the X_ab in x, y and z one by one: of three pairs or more
   it hangs on the axes, so that the cloud has to come in the frame that it was matched in.

Q is looked for, where that median is P: three equations for three unknowns. The median of smooth
functions is continuous, with kinks where it goes over from one pair to another. Broyden's method
starts at `snell`'s solution with the derivative diag(1, 1, 1/n), as if all light came from straight
above, and is taken back to half of such a step wherever it does not come nearer. Where a cell has
many points, X_ab(Q) is a polynomial (`pcfix.refract.pair_table`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel, most_between
from pcfix.lens.algebra import (
    Vector,
    column_of,
    cross,
    dot,
    minus,
    row_of,
    scaled,
    times,
    transposed_times,
    vector,
)
from pcfix.model import BoolArray, FloatArray, IntArray, Outcome, Views
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
from pcfix.refract.pair_places import ABOVE, RAY_WIDTH, PairImages, begin, meet, see
from pcfix.refract.pair_table import (
    LEAST_POINTS,
    PairTable,
    has_pairs,
    no_pair_table,
    pair_table_of,
    read_pairs,
)
from pcfix.refract.rays import MIN_DETERMINANT, add_line, nearest_point, refracted

MAX_STEPS = 40
ALIKE = 0.5
"""Depths between which the start from the point before is not far off."""

CLOSE_M = 1e-6
"""How far from P the median may be; Q is then off by two or three times as much."""


# Columns of the result.
_MISS, _OUTCOME, _FOUND, _WIDTH = 3, 4, 5, 6


class _Point(NamedTuple):
    """The apparent point, and whether the table of its cell has all its pairs; the table."""

    xyz: Vector
    quick: bool
    table: PairTable


def invert_pairs(batch: Batch, pairs: Views | None = None) -> Intersection:
    """Return the true points from which the median of stereo pairs would be the apparent ones.

    Parameters
    ----------
    batch : Batch
        Its cameras need angles and lenses. Its views are pairs, or the cameras that may be in one.
    pairs : Views, optional
        Of the kind pairs; one is left out where either camera is not among the batch's views.
        Without them the pairs are those of the images that the matcher learned matched, each
        pair once.

    Returns
    -------
    Intersection
        `ray_count` and `incidence_deg` are of the cameras that are in a pair; `ray_miss_m` is the
        distance from their refracted rays through the apparent point, as of `snell`. A point with
        cameras but without a pair is `ONE_CAMERA`, one with narrow pairs only `PARALLEL_RAYS`.

    Raises
    ------
    SettingError
        If the cameras have no angles or no lenses.

    Warns
    -----
    PcfixWarning
        Of points for which no true point was found; they get the solution of `snell`.

    Notes
    -----
    The surface above each point is taken as a plane.
    """
    check_consistent(batch.survey.cameras)
    if batch.rays.kind == "pairs":
        pairs, batch = batch.rays, replace(batch, views=cameras_of_pairs(batch.rays))
    cameras, matcher = batch.survey.cameras, batch.survey.learned.matcher
    if pairs is None and matcher is None:
        raise ValueError("pairs or a model of the matcher are needed")
    made = cameras if batch.original_model is None else batch.original_model.cameras
    none = np.zeros(0, np.int64)
    listed = (none, none)
    if pairs is not None:
        listed = np.asarray(pairs.start, np.int64), np.asarray(pairs.camera, np.int64)
    matched = np.zeros((0, 0), np.int64) if matcher is None else matcher.matched
    used, result = np.zeros(len(batch.rays.camera), np.bool_), np.zeros((len(batch), _WIDTH))
    both = images_of(batch.original_model, cameras)
    images = PairImages(optics_of(made), both, batch.survey.settings.refractive_index)
    quick = is_quick(batch) and matcher is not None and batch.original_model is None
    focal_px = np.zeros(0) if matcher is None or not quick else matcher.focal_px
    order, first = cells_of(batch)
    in_tiles(
        _invert, len(first) - 1, (order, first), batch.chosen(), images, (*listed, matched),
        focal_px, used, result, points=len(batch),
    )  # fmt: skip
    outcome = result[:, _OUTCOME].astype(np.uint8)
    moved = outcome == Outcome.CORRECTED
    warn_of_unsolved("stereo pairs: no solution", result[moved, _FOUND] > 0.0)
    count = np.concatenate([[0], np.cumsum(used)])
    in_pairs = Views(count[batch.rays.start], np.asarray(batch.rays.camera)[used])
    shift, miss = result[:, :3], result[:, _MISS]
    return replace(batch, views=in_pairs).result(shift, outcome=outcome, ray_miss_m=miss)


@kernel(allocates=True)
def _invert(
    span: Span, cells: tuple[IntArray, IntArray], points: Chosen, images: PairImages,
    listed: tuple[IntArray, IntArray, IntArray], focal_px: FloatArray, used: BoolArray,
    result: FloatArray,
) -> None:  # fmt: skip
    """Correct the points of each cell.

    Without listed pairs, which are empty then, they are those of the images that were matched; with
    focal lengths the cell has polynomials. A point starts from the one before it, if that has the
    same cameras.
    """
    (order, first), none = cells, no_pair_table()
    start, matched = points.start, listed[2]
    most = most_between((0, len(start) - 1), start)
    most_pairs = most * matched.shape[1]
    if listed[0].size:
        most_pairs = most_between((0, len(start) - 1), listed[0]) // 2
    rays, place = np.empty((most, RAY_WIDTH)), np.full(len(points.centres), -1)
    pairs, places = np.empty((most_pairs, 3), np.int64), np.empty((3, most_pairs))
    room, before = (np.empty(9), np.empty((3, 3))), -1
    for t in range(*span):
        before, inside, table = -1, order[first[t] : first[t + 1]], none
        if focal_px.size and inside.size >= LEAST_POINTS:
            table = pair_table_of(inside, points, images, matched, focal_px)
        for i in inside:
            cameras = points.camera[start[i] : start[i + 1]]
            flags, normal = used[start[i] : start[i + 1]], row_of(points.normals, i)
            for j in range(cameras.size):
                place[cameras[j]] = j
                begin(rays[j], points, i, cameras[j], images)
            if listed[0].size:
                entries = listed[1][listed[0][i] : listed[0][i + 1]]
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
            near = result[i, :3]
            near[:] = np.nan
            if before >= 0 and are_same(cameras, cameras_of(points, before)):
                _start(near, points, i, before, result[before])
            point = _Point(row_of(points.xyz, i), has_pairs(table, points, i, pairs[:wide]), table)
            of_pairs = pairs[:wide], places[:, :wide]
            _solve(result[i], rays, cameras, flags, of_pairs, normal, images, room, point)
            before = i if result[i, _FOUND] > 0.0 else -1


@device
def _start(near: FloatArray, points: Chosen, i: int, before: int, found: FloatArray) -> None:
    """Write where the true point lies if it is as far off by its depth as that of another one."""
    depth = points.height[i] - points.xyz[i, 2]
    there = points.height[before] - points.xyz[before, 2]
    if there > 0.0 and ALIKE * there < depth < there / ALIKE:
        for axis in range(3):
            near[axis] = found[axis] * (depth / there)


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

    And by which entry of what was matched.
    """
    count, partners = 0, matched.shape[1]
    for a in range(cameras.size):
        for p in range(partners):
            partner = matched[cameras[a], p]
            if partner < 0:
                break
            b = place[partner]
            if b < 0 or (b < a and _contains(matched[partner], cameras[a])):
                continue
            pairs[count, 0], pairs[count, 1], pairs[count, 2] = a, b, cameras[a] * partners + p
            count += 1
    return count


@device
def _contains(row: IntArray, value: int) -> bool:
    found = False
    for one in row:
        found = found or one == value
    return found


@device
def _wide_pairs(pairs: IntArray, rays: FloatArray, normal: Vector) -> int:
    """Bring the pairs with a base to the front, as seen from P; return how many there are.

    The limit is that of `pcfix.refract.rays.nearest_point` for two rays. Cameras below the water
    or the point have no ray.
    """
    count = 0
    for p in range(len(pairs)):
        first, second = rays[pairs[p, 0]], rays[pairs[p, 1]]
        a, b = vector(first), vector(second)
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
    out: FloatArray, rays: FloatArray, cameras: IntArray, used: BoolArray,
    pairs: tuple[IntArray, FloatArray], normal: Vector, images: PairImages,
    room: tuple[FloatArray, FloatArray], point: _Point,
) -> None:  # fmt: skip
    """Solve one point and write its row; the pairs come with room for their places.

    The row has a start already, or NaN.
    """
    sums, inverse = room
    fixed, q = _snell(sums, rays, used, normal, images.n)
    if not fixed:
        out[:3], out[_OUTCOME] = 0.0, PARALLEL
        return
    found, near = False, vector(out)
    if near[0] == near[0]:  # B is still that of the point before
        found, near = _search(near, inverse, rays, cameras, used, pairs, normal, images, point)
    if found:
        q = near
    else:
        _as_from_above(inverse, 1.0, images.n)
        start = q
        found, q = _search(start, inverse, rays, cameras, used, pairs, normal, images, point)
        if point.quick and not found:  # beyond the table
            _as_from_above(inverse, 1.0, images.n)
            point = _Point(point.xyz, False, point.table)
            found, q = _search(start, inverse, rays, cameras, used, pairs, normal, images, point)
    out[0], out[1], out[2] = q
    out[_MISS] = _miss(q, rays, used, normal, images.n)
    out[_OUTCOME], out[_FOUND] = CORRECTED, 1.0 if found else 0.0


@device
def _line(ray: FloatArray, normal: Vector, n: float) -> tuple[Vector, Vector, float]:
    """Return where the ray through P enters the water, its direction, and its length squared."""
    e = vector(ray)
    length2, across = dot(e, e), dot(normal, e)
    f, bend = (ray[ABOVE] / across, 1.0 / n) if ray[ABOVE] > 0.0 else (0.0, 1.0)
    return scaled(f, e), refracted(e, length2, normal, across, bend), length2


@device
def _snell(
    sums: FloatArray, rays: FloatArray, used: BoolArray, normal: Vector, n: float
) -> tuple[bool, Vector]:
    """Return whether there is a point nearest to the refracted rays, and it."""
    k = 0.0
    sums[:] = 0.0
    for j in range(used.size):
        if used[j]:
            a, d, length2 = _line(rays[j], normal, n)
            add_line(sums, a, d, 1.0 / length2)
            k += 1.0
    fixed, q, _, _ = nearest_point(k, sums)
    return fixed, q


@device
def _miss(q: Vector, rays: FloatArray, used: BoolArray, normal: Vector, n: float) -> float:
    """Return the rms distance of Q from the refracted rays through P."""
    k, total = 0.0, 0.0
    for j in range(used.size):
        if used[j]:
            a, d, length2 = _line(rays[j], normal, n)
            a = minus(q, a)
            along = dot(a, d)
            total += max(dot(a, a) - along * along / length2, 0.0)
            k += 1.0
    return np.sqrt(total / k)


@device
def _search(
    start: Vector, inverse: FloatArray, rays: FloatArray, cameras: IntArray, used: BoolArray,
    pairs: tuple[IntArray, FloatArray], normal: Vector, images: PairImages, point: _Point,
) -> tuple[bool, Vector]:  # fmt: skip
    """Return whether a Q was found where the median F of the pairs' places is P, and it.

    From the nearest Q so far goes a step s = -B F, at first with the B that is there. Where F
    comes nearer, by y, the good Broyden update is B + (s - B y) s'B / (s'B y); where it does not,
    B starts anew, with half the step.
    """
    q, nearest, at_nearest, best, share = start, start, (0.0, 0.0, 0.0), np.inf, 1.0
    for _ in range(MAX_STEPS):
        if point.quick:
            read_pairs(pairs[1], q, point.xyz, pairs[0], point.table)
        else:
            _place_pairs(q, rays, cameras, used, pairs, normal, images)
        f = _median(pairs[1][0]), _median(pairs[1][1]), _median(pairs[1][2])
        size = np.sqrt(dot(f, f))
        if size <= CLOSE_M:
            return True, q
        if size < best:
            if best < np.inf:
                _update(inverse, minus(q, nearest), minus(f, at_nearest))
            best, nearest, at_nearest = size, q, f
        elif best < np.inf:
            share *= 0.5
            _as_from_above(inverse, share, images.n)
        else:
            return False, start
        q = nearest
        for j in range(3):
            q = minus(q, scaled(at_nearest[j], column_of(inverse, j)))
    return False, start


@device
def _as_from_above(inverse: FloatArray, share: float, n: float) -> None:
    """Set B to a share of what it is where all light comes from straight above."""
    inverse[:] = 0.0
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = share, share, share * n


@device
def _update(inverse: FloatArray, step: Vector, change: Vector) -> None:
    """Bring B to where it takes the last change of F for the last step (Broyden)."""
    missing, left = minus(step, times(inverse, change)), transposed_times(inverse, step)
    scale = dot(left, change)
    if scale == 0.0:
        return
    for i in range(3):
        for j in range(3):
            inverse[i, j] += missing[i] * left[j] / scale


@device
def _place_pairs(
    q: Vector, rays: FloatArray, cameras: IntArray, used: BoolArray,
    of_pairs: tuple[IntArray, FloatArray], normal: Vector, images: PairImages,
) -> None:  # fmt: skip
    """Set where the pairs would have placed Q; NaN where some camera has no image of it."""
    pairs, places = of_pairs
    for j in range(used.size):
        if used[j]:
            see(rays[j], q, cameras[j], normal, images)
    for p in range(len(pairs)):
        places[0, p], places[1, p], places[2, p] = meet(rays[pairs[p, 0]], rays[pairs[p, 1]])


@device
def _median(values: FloatArray) -> float:
    """Return the median, NaN where one is; the values are sorted."""
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

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
above, and is taken back to half of such a step wherever it does not come nearer.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pcfix.kernels import Span, in_tiles, kernel, lean, most_between
from pcfix.lens.algebra import (
    Vector,
    beyond,
    column_of,
    cross,
    dot,
    minus,
    plus,
    row_of,
    scaled,
    solved,
    times,
    transposed_times,
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
    Optics,
    as_made,
    images_of,
    optics_of,
    warn_of_unsolved,
)
from pcfix.refract.cells import are_same, cameras_of, cells_of
from pcfix.refract.choice import cameras_of_pairs
from pcfix.refract.consistent import check_consistent
from pcfix.refract.rays import (
    MIN_DETERMINANT,
    add_line,
    direction,
    light_path,
    nearest_point,
    refracted,
)

MAX_STEPS = 40
ALIKE = 0.5
"""Depths between which the start from the point before is not far off."""

CLOSE_M = 1e-6
"""How far from P the median may be; Q is then off by two or three times as much."""


# Columns of the result.
_MISS, _OUTCOME, _FOUND, _WIDTH = 3, 4, 5, 6

# Columns of a ray: e, the height of its water over P, e as the matcher had it, how its scale
# changes (g of `_meet`), and of the image of Q G'G (xx, xy, xz, yy, yz, zz), G'G e, |G e|^2.
_ABOVE, _MADE, _BY_PLACE, _SQUARE, _RIGHT, _RAY_WIDTH = 3, 4, 7, 10, 16, 20


class _Images(NamedTuple):
    """Those of the matcher; `both` has them as they were and as they are now; n."""

    optics: Optics
    both: Images
    n: float


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
    made = cameras if batch.made_with is None else batch.made_with.cameras
    none = np.zeros(0, np.int64)
    listed = (none, none)
    if pairs is not None:
        listed = np.asarray(pairs.start, np.int64), np.asarray(pairs.camera, np.int64)
    matched = np.zeros((0, 0), np.int64) if matcher is None else matcher.matched
    used, result = np.zeros(len(batch.rays.camera), np.bool_), np.zeros((len(batch), _WIDTH))
    both = images_of(batch.made_with, cameras)
    optics = optics_of(made)
    order, first = cells_of(batch)
    in_tiles(
        _invert, len(first) - 1, (order, first), batch.chosen(), optics, both, (*listed, matched),
        used, result, points=len(batch),
    )  # fmt: skip
    outcome = result[:, _OUTCOME].astype(np.uint8)
    moved = outcome == Outcome.CORRECTED
    warn_of_unsolved("stereo pairs: no solution", result[moved, _FOUND] > 0.0)
    count = np.concatenate([[0], np.cumsum(used)])
    in_pairs = Views(count[batch.rays.start], np.asarray(batch.rays.camera)[used])
    shift, miss = result[:, :3], result[:, _MISS]
    return replace(batch, views=in_pairs).result(shift, outcome=outcome, ray_miss_m=miss)


@kernel
def _invert(
    span: Span, cells: tuple[IntArray, IntArray], points: Chosen, optics: Optics, both: Images,
    listed: tuple[IntArray, IntArray, IntArray], used: BoolArray, result: FloatArray,
) -> None:  # fmt: skip
    """Correct the points of each cell.

    Without listed pairs, which are empty then, they are those of the images that were matched. A
    point starts from the one before it, if that has the same cameras.
    """
    order, first = cells
    start, images, matched = points.start, _Images(optics, both, points.n), listed[2]
    most = most_between((0, len(start) - 1), start)
    most_pairs = most * matched.shape[1]
    if listed[0].size:
        most_pairs = most_between((0, len(start) - 1), listed[0]) // 2
    rays, place = np.empty((most, _RAY_WIDTH)), np.full(len(points.centres), -1)
    pairs, places = np.empty((most_pairs, 2), np.int64), np.empty((3, most_pairs))
    room, before = (np.empty(9), np.empty((3, 3))), -1
    for t in range(*span):
        before = -1
        for i in order[first[t] : first[t + 1]]:
            cameras = points.camera[start[i] : start[i + 1]]
            flags, normal = used[start[i] : start[i + 1]], row_of(points.normals, i)
            for j in range(cameras.size):
                place[cameras[j]] = j
                _begin(rays[j], points, i, cameras[j], images)
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
            of_pairs = pairs[:wide], places[:, :wide]
            _solve(result[i], rays, cameras, flags, of_pairs, normal, images, room)
            before = i if result[i, _FOUND] > 0.0 else -1


@lean
def _start(near: FloatArray, points: Chosen, i: int, before: int, found: FloatArray) -> None:
    """Write where the true point lies if it is as far off by its depth as that of another one."""
    depth = points.height[i] - points.xyz[i, 2]
    there = points.height[before] - points.xyz[before, 2]
    if there > 0.0 and ALIKE * there < depth < there / ALIKE:
        for axis in range(3):
            near[axis] = found[axis] * (depth / there)


@lean
def _begin(ray: FloatArray, points: Chosen, i: int, c: int, images: _Images) -> None:
    """Fill in where a ray comes from, and how its scale changes with the place.

    The distance that the scale of an image goes by, in terms of P's, is in perspective that along
    the axis, in other projections that from the centre.
    """
    e = minus(row_of(points.centres, c), row_of(points.xyz, i))
    ray[_ABOVE] = points.normals[i, 2] * (points.height[i] - points.xyz[i, 2] + points.offset[c])
    made, optics = e, images.optics
    if len(images.both.centres):
        made = minus(row_of(images.both.centres, c), row_of(points.made_xyz, i))
    axis, size2 = row_of(optics.rotations[c], 2), dot(made, made)
    ahead = -dot(axis, made)
    flat = optics.lenses[optics.row[c], KIND] == PERSPECTIVE and ahead > 0.0
    for j in range(3):
        ray[j], ray[_MADE + j] = e[j], made[j]
        ray[_BY_PLACE + j] = axis[j] / ahead if flat else -made[j] / size2


@lean
def _listed_pairs(pairs: IntArray, entries: IntArray, place: IntArray) -> int:
    """Write the pairs of a list whose cameras both have a place; return how many."""
    count = 0
    for p in range(entries.size // 2):
        a, b = place[entries[2 * p]], place[entries[2 * p + 1]]
        if a >= 0 and b >= 0 and a != b:
            pairs[count, 0], pairs[count, 1] = a, b
            count += 1
    return count


@lean
def _matched_pairs(pairs: IntArray, cameras: IntArray, matched: IntArray, place: IntArray) -> int:
    """Write the pairs of cameras of which either was matched with the other; return how many."""
    count = 0
    for a in range(cameras.size):
        for partner in matched[cameras[a]]:
            if partner < 0:
                break
            b = place[partner]
            if b < 0 or (b < a and _contains(matched[partner], cameras[a])):
                continue
            pairs[count, 0], pairs[count, 1] = a, b
            count += 1
    return count


@lean
def _contains(row: IntArray, value: int) -> bool:
    found = False
    for one in row:
        found = found or one == value
    return found


@lean
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
        above = dot(normal, a) > max(first[_ABOVE], 0.0)
        above = above and dot(normal, b) > max(second[_ABOVE], 0.0)
        wide = dot(across, across) >= 4.0 * MIN_DETERMINANT * (dot(a, a) * dot(b, b))
        if above and wide:
            pairs[count, 0], pairs[count, 1] = pairs[p, 0], pairs[p, 1]
            count += 1
    return count


@lean
def _solve(
    out: FloatArray, rays: FloatArray, cameras: IntArray, used: BoolArray,
    pairs: tuple[IntArray, FloatArray], normal: Vector, images: _Images,
    room: tuple[FloatArray, FloatArray],
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
        found, near = _search(near, inverse, rays, cameras, used, pairs, normal, images)
    if found:
        q = near
    else:
        _as_from_above(inverse, 1.0, images.n)
        found, q = _search(q, inverse, rays, cameras, used, pairs, normal, images)
    out[0], out[1], out[2] = q
    out[_MISS] = _miss(q, rays, used, normal, images.n)
    out[_OUTCOME], out[_FOUND] = CORRECTED, 1.0 if found else 0.0


@lean
def _line(ray: FloatArray, normal: Vector, n: float) -> tuple[Vector, Vector, float]:
    """Return where the ray through P enters the water, its direction, and its length squared."""
    e = vector(ray)
    length2, across = dot(e, e), dot(normal, e)
    f, bend = (ray[_ABOVE] / across, 1.0 / n) if ray[_ABOVE] > 0.0 else (0.0, 1.0)
    return scaled(f, e), refracted(e, length2, normal, across, bend), length2


@lean
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


@lean
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


@lean
def _search(
    start: Vector, inverse: FloatArray, rays: FloatArray, cameras: IntArray, used: BoolArray,
    pairs: tuple[IntArray, FloatArray], normal: Vector, images: _Images,
) -> tuple[bool, Vector]:  # fmt: skip
    """Return whether a Q was found where the median F of the pairs' places is P, and it.

    From the nearest Q so far goes a step s = -B F, at first with the B that is there. Where F
    comes nearer, by y, the good Broyden update is B + (s - B y) s'B / (s'B y); where it does not,
    B starts anew, with half the step.
    """
    q, nearest, at_nearest, best, share = start, start, (0.0, 0.0, 0.0), np.inf, 1.0
    for _ in range(MAX_STEPS):
        f = _median_of_pairs(q, rays, cameras, used, pairs, normal, images)
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


@lean
def _as_from_above(inverse: FloatArray, share: float, n: float) -> None:
    """Set B to a share of what it is where all light comes from straight above."""
    inverse[:] = 0.0
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = share, share, share * n


@lean
def _update(inverse: FloatArray, step: Vector, change: Vector) -> None:
    """Bring B to where it takes the last change of F for the last step (Broyden)."""
    missing, left = minus(step, times(inverse, change)), transposed_times(inverse, step)
    scale = dot(left, change)
    if scale == 0.0:
        return
    for i in range(3):
        for j in range(3):
            inverse[i, j] += missing[i] * left[j] / scale


@lean
def _median_of_pairs(
    q: Vector, rays: FloatArray, cameras: IntArray, used: BoolArray,
    of_pairs: tuple[IntArray, FloatArray], normal: Vector, images: _Images,
) -> Vector:  # fmt: skip
    """Return where the pairs would have placed Q; NaN where some camera has no image of it."""
    pairs, places = of_pairs
    for j in range(used.size):
        if used[j]:
            _see(rays[j], q, cameras[j], normal, images)
    for p in range(len(pairs)):
        places[0, p], places[1, p], places[2, p] = _meet(rays[pairs[p, 0]], rays[pairs[p, 1]])
    return _median(places[0]), _median(places[1]), _median(places[2])


@lean
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


@lean
def _see(ray: FloatArray, q: Vector, c: int, normal: Vector, images: _Images) -> None:
    """Write what the image of Q says about places: G'G, G'G e and |G e|^2.

    w, as the matcher had it, is scaled to be as far away as P, so that G is that of there.
    """
    path = light_path(q, vector(ray), normal, ray[_ABOVE], images.n)
    w = as_made(images.both, c, direction(path, normal))
    w = scaled(1.0 / dot(w, vector(ray, _BY_PLACE)), w)
    optics, e = images.optics, vector(ray, _MADE)
    _, _, by_u, by_v = image_in_world(optics.lenses[optics.row[c]], optics.rotations[c], w)
    ray[_SQUARE:] = 0.0
    for g in (by_u, by_v):
        (x, y, z), off = g, dot(g, e)
        terms = (x * x, x * y, x * z, y * y, y * z, z * z, off * x, off * y, off * z, off * off)
        for i in range(10):
            ray[_SQUARE + i] += terms[i]


@lean
def _meet(a: FloatArray, b: FloatArray) -> Vector:
    """Return where two straight rays have the least squared residuals in their images.

    At X the residual of a camera is G (X - e) / t, t = 1 + g.X how far away X is in terms of P. The
    first round takes t as one. The second has it, and that it changes with X: at the least

        sum_c G'G (X - e) / t^2 - r^2 / t^3 g = 0,    r^2 = |G (X - e)|^2

    which tells in narrow pairs of rays that miss each other.
    """
    place = _solve_two(a, b, 1.0, 1.0, 0.0, 0.0)
    t, r2 = _residual(place, a)
    t_b, r2_b = _residual(place, b)
    return _solve_two(a, b, 1.0 / (t * t), 1.0 / (t_b * t_b), r2 / t**3, r2_b / t_b**3)


@lean
def _residual(place: Vector, ray: FloatArray) -> tuple[float, float]:
    """Return t and r^2 of a place."""
    (x, y, z), s = place, ray[_SQUARE:]
    t = 1.0 + x * ray[_BY_PLACE] + y * ray[_BY_PLACE + 1] + z * ray[_BY_PLACE + 2]
    twice = x * (s[1] * y + s[2] * z) + s[4] * y * z - (s[6] * x + s[7] * y + s[8] * z)
    return t, s[0] * x * x + s[3] * y * y + s[5] * z * z + 2.0 * twice + s[9]


@lean
def _solve_two(
    a: FloatArray, b: FloatArray, of_a: float, of_b: float, g_a: float, g_b: float
) -> Vector:
    """Solve the normal equations of two rays."""
    x, y, z = beyond(
        beyond(_sum(a, b, of_a, of_b, _RIGHT), g_a, vector(a, _BY_PLACE)), g_b, vector(b, _BY_PLACE)
    )
    xx, xy, xz = _sum(a, b, of_a, of_b, _SQUARE)
    yy, yz, zz = _sum(a, b, of_a, of_b, _SQUARE + 3)
    return solved((xx, xy, xz, yy, yz, zz), (x, y, z))[1]


@lean
def _sum(a: FloatArray, b: FloatArray, of_a: float, of_b: float, at: int) -> Vector:
    """Return so many times three columns of one ray and of the other."""
    return plus(scaled(of_a, vector(a, at)), scaled(of_b, vector(b, at)))

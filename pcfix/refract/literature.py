"""Methods of the literature, for comparison; all share one camera's ray through level water.

Picture the vertical plane through a camera C and the apparent point P. The line of sight meets
the surface at A, at the angle a from the vertical, and goes on under water at the angle b, with
sin a = n sin b. The vertical through P is its *plumb line*. P lies on it at the apparent depth d,
where the straight line of sight crosses it; the bent ray crosses it further down, at the depth

    d tan a / tan b = d sqrt(n^2 + (n^2 - 1) tan^2 a)

as tan b = sin a / sqrt(n^2 - sin^2 a). The left side is 0/0 for a camera straight above the
point; the right side is its limit there, n d, and the same everywhere else.

These methods know level water only. Over a tilted surface or a mesh the depth is counted from the
height of the water above the apparent point, along the vertical, and the surface is taken as level
there. Each camera has its own water level where that moved; a camera whose water stood below the
apparent point saw it through air, and its ray goes straight on.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcfix.errors import SettingError
from pcfix.kernels import Span, in_tiles, kernel, lean, part
from pcfix.lens.algebra import dot, minus, row_of, scaled
from pcfix.model import BoolArray, FloatArray, IntArray, Outcome, Views
from pcfix.refract.batch import Batch, Chosen, Intersection
from pcfix.refract.rays import add_line, nearest_point, refracted


def apparent_depth(batch: Batch) -> FloatArray:
    """Return how far the apparent points lie below the water above them, metres, shape (m,)."""
    return np.asarray(batch.surface.height_m - batch.xyz[:, 2])


def down(shift_m: FloatArray) -> FloatArray:
    """Return shifts, shape (m, 3), that go down by so many metres, shape (m,)."""
    none = np.zeros(len(shift_m))
    return np.column_stack([none, none, -shift_m])


@lean
def depth_ratio(tan2: float, n: float) -> float:
    """Return tan a / tan b of a ray with tan^2 a = `tan2`: what a depth grows by along it."""
    return np.sqrt(n * n + (n * n - 1.0) * tan2)


@kernel
def _plumb_line_crossings(points: Chosen, by_cosine: bool) -> tuple[FloatArray, FloatArray]:
    """Find where the bent rays of each point cross its plumb line, in the mean.

    Parameters
    ----------
    points : Chosen
    by_cosine : bool
        Weigh each ray with the cosine of its angle a in air, not with 1.

    Returns
    -------
    lowered, miss : array, shape (m,)
        How far below the apparent point the mean lies, and its root mean square distance from the
        bent rays, metres; 0 where a point has no ray.

    Notes
    -----
    A point h above the place where a ray crosses the plumb line is h sin b away from the ray.
    """
    lowered, miss = np.zeros(len(points.xyz)), np.zeros(len(points.xyz))
    for i in range(len(points.xyz)):
        rays = points.camera[points.start[i] : points.start[i + 1]]
        total, weights, squares = 0.0, 0.0, 0.0
        for c in rays:
            below, cosine2 = _crossing(points, i, c)
            weight = np.sqrt(cosine2) if by_cosine else 1.0
            total += weight * below
            weights += weight
        if rays.size == 0:
            continue
        lowered[i] = total / weights
        for c in rays:
            below, cosine2 = _crossing(points, i, c)
            squares += (lowered[i] - below) ** 2 * (1.0 - cosine2) / (points.n * points.n)
        miss[i] = np.sqrt(squares / rays.size)
    return lowered, miss


@lean
def _crossing(points: Chosen, i: int, c: int) -> tuple[float, float]:
    """Return how far below the apparent point a bent ray crosses its plumb line; cos^2 a."""
    ex, ey, ez = minus(row_of(points.centres, c), row_of(points.xyz, i))
    plan2 = ex * ex + ey * ey
    cosine2 = ez * ez / (plan2 + ez * ez)
    depth = points.height[i] - points.xyz[i, 2] + points.offset[c]
    return max(depth, 0.0) * (depth_ratio(plan2 / (ez * ez), points.n) - 1.0), cosine2


BASE_TO_HEIGHT = (0.3, 0.6)
"""From an overlap of about 80 % to one of 60 % with the usual lenses, both common in surveys."""


def in_pairs(batch: Batch) -> Batch:
    """Return the batch with the best pair of each point instead of all its rays.

    Their papers had two images; a cloud of today has many, and does not say which two. Here each
    point gets, of the cameras that were chosen for it, the pair

    - whose ratio of base to height is nearest to the range `BASE_TO_HEIGHT`: below it the depth is
      weak, above it images no longer match well; and
    - among those within the range (or equally far from it) the pair whose more slanting ray is the
      steepest, which lies on both sides of the point where there is such a pair. There the two rays
      have nearly the same incidence, for which the methods are exact.

    The point was made by more images than these, or by others, so that the pair has another
    incidence than the rays that set the apparent depth. With nine nadir images over a point (32 m
    apart, 80 m up) that costs some 5 % of the depth at worst.

    With the cameras at the plan distances e_1 and e_2 (vectors) and heights z_1 and z_2 from the
    point, the ratio is |e_1 / z_1 - e_2 / z_2|: base by height where both are equally high.

    Points with one ray keep it and those with none have none, so that the batch still says what
    becomes of them.
    """
    start = np.concatenate([[0], np.cumsum(np.minimum(batch.counts, 2))]).astype(np.int64)
    camera = np.empty(start[-1], np.int64)
    in_tiles(_choose_pairs, len(batch), batch.chosen(), start, camera)
    return replace(batch, views=Views(start, camera))


@kernel
def _choose_pairs(span: Span, points: Chosen, pair_start: IntArray, pair: IntArray) -> None:
    """Fill in ``pair[pair_start[i] : pair_start[i + 1]]`` for every point."""
    for i in range(*span):
        rays = points.camera[points.start[i] : points.start[i + 1]]
        place = pair_start[i]
        if rays.size == 1:
            pair[place] = rays[0]
        if rays.size > 1:
            first, second = _best_pair(points.xyz[i], points.centres, rays)
            pair[place], pair[place + 1] = rays[first], rays[second]


@part
def _best_pair(point: FloatArray, centres: FloatArray, rays: IntArray) -> tuple[int, int]:
    """Return the places of the best pair in the list of at least two rays; of equals the first."""
    k, (least, most) = rays.size, BASE_TO_HEIGHT
    u, v = np.empty(k), np.empty(k)
    for j in range(k):
        ez = centres[rays[j], 2] - point[2]
        u[j] = (centres[rays[j], 0] - point[0]) / ez
        v[j] = (centres[rays[j], 1] - point[1]) / ez
    best_gap, best_slant, first, second = np.inf, np.inf, 0, 1
    for a in range(k):
        slant_a = u[a] * u[a] + v[a] * v[a]
        for b in range(a + 1, k):
            ratio = np.hypot(u[a] - u[b], v[a] - v[b])
            gap = max(least - ratio, ratio - most, 0.0)
            if gap > best_gap:
                continue
            slant = max(slant_a, u[b] * u[b] + v[b] * v[b])
            if gap < best_gap or slant < best_slant:
                best_gap, best_slant, first, second = gap, slant, a, b
    return first, second


def factor(batch: Batch) -> Intersection:
    """Multiply the apparent depth by `depth_factor`, else by the refractive index; only Z moves.

    Returns
    -------
    Intersection
        Every point is corrected, as no ray is needed; see `without_rays`.

    Notes
    -----
    With n it is the limit for cameras straight above, long in use for rivers (Westaway et al.
    2001, Woodget et al. 2015). Away from there the true depth is larger, at the angle a in air by
    (n^2 - 1) tan^2 a / (2 n^2) of it: 1.6 % at 15 degrees, 3.3 % at 21 degrees. A factor of one's
    own can take that in.
    """
    ratio = batch.survey.settings.depth_factor
    ratio = batch.survey.settings.refractive_index if ratio is None else ratio
    return without_rays(batch, (ratio - 1.0) * apparent_depth(batch))


def regression(batch: Batch) -> Intersection:
    """Apply the regression that was learned to the apparent depths; only Z moves.

    Returns
    -------
    Intersection
        Every point is corrected, as no ray is needed; see
        `without_rays`.

    Raises
    ------
    SettingError
        If no regression was learned.

    Notes
    -----
    Method III of Hsu & Wang, whose text was not at hand: a line fitted to check depths. With a
    negative intercept the line takes very shallow points above the water; they go to its surface.
    """
    learned = batch.survey.learned.regression
    if learned is None:
        raise SettingError("method regression needs a regression; fit one of check depths first.")
    apparent = apparent_depth(batch)
    return without_rays(batch, learned.depth_m(apparent) - apparent)


def without_rays(batch: Batch, lowered_m: FloatArray) -> Intersection:
    """Return the result of a method that lowers points and looks at no camera.

    Parameters
    ----------
    batch : Batch
    lowered_m : array, shape (m,)
        How far each point goes down.

    Returns
    -------
    Intersection
        All points are corrected. `ray_count` is that of the cameras that were chosen for the
        point, but at least 1: in files a count of 0 marks a point that was not corrected.
    """
    outcome = np.full(len(batch.xyz), Outcome.CORRECTED, np.uint8)
    found = batch.result(down(lowered_m), outcome=outcome)
    return found._replace(ray_count=np.maximum(found.ray_count, 1))


def dietrich(batch: Batch) -> Intersection:
    """Multiply the apparent depth by the mean of tan r / tan i over the cameras; only Z moves.

    Returns
    -------
    Intersection
        Points with one ray are corrected too: a mean needs no second one, and the author's
        program does the same. The rays of a point cross its plumb line at different depths;
        `ray_miss_m` is how far they pass from the mean.

    Notes
    -----
    Dietrich (2017), "Bathymetric Structure-from-Motion", Earth Surface Processes and Landforms
    42, 355-364, as his program pyBathySfM computes it: r is the angle from the vertical of the
    line from the apparent point to the camera, sin i = sin r / n, and with the apparent depth h_a

        h = h_a tan r / tan i, averaged over all cameras with equal weight.

    The program leaves a camera exactly above the point out, as tan i is 0 there; here it counts
    with the limit, n h_a.

    Exact where all rays have the same incidence. The slanting rays fix the apparent depth more
    than the steep ones do, which a mean does not know: where incidences differ, the result is too
    shallow, by up to 1.5 % of the depth under nine nadir images (32 m apart, 80 m up) and by
    4 % for one camera overhead and one at 32 degrees.
    """
    lowered, miss = _plumb_line_crossings(batch.chosen(), False)
    outcome = np.where(batch.counts > 0, Outcome.CORRECTED, Outcome.NO_CAMERA).astype(np.uint8)
    return batch.result(down(lowered), outcome=outcome, ray_miss_m=miss)


def murase(batch: Batch) -> Intersection:
    """Take the mean of the depths from two cameras, weighted by cosines; only Z moves.

    Returns
    -------
    Intersection
        Of the pair that `pcfix.refract.literature` chooses for each point.

    Notes
    -----
    Murase et al. (2008), "A photogrammetric correction procedure for light refraction effects at
    a two-medium boundary", Photogrammetric Engineering & Remote Sensing 74(9), 1129-1136. The
    paper's text was not at hand, only what is said of it: a correction by Snell's law from the
    positions of the two cameras, in which cosines weigh the two. This is read as follows. Both
    bent rays cross the plumb line of the apparent point, as each lies in the vertical plane
    through that point and its camera, but in general at different depths h_1 and h_2:

        h = (h_1 cos a_1 + h_2 cos a_2) / (cos a_1 + cos a_2)

    with a_1 and a_2 the angles from the vertical in air. Whether the paper's cosines are those in
    air or in water was not to be found out; the difference is of the second order in the
    difference of the two. Nothing is singular: see `pcfix.refract.literature`.

    Exact where both rays have the same incidence. The weights are against geometry: a steep ray
    runs along the plumb line and says least of the depth, yet it counts most.
    """
    paired = in_pairs(batch)
    lowered, miss = _plumb_line_crossings(paired.chosen(), True)
    return paired.result(down(lowered), ray_miss_m=miss)


def butler(batch: Batch) -> Intersection:
    """Intersect the bent rays of two cameras under level water; X, Y and Z move.

    Returns
    -------
    Intersection
        Of the pair that `pcfix.refract.literature` chooses for each point.

    Notes
    -----
    Butler, Lane, Chandler & Porfiri (2002), "Through-water close range digital photogrammetry in
    flume and field environments", Photogrammetric Record 17(99), 419-439. The paper's text was
    not at hand, only what is said of it: the place where the line of sight of each of two cameras
    enters the water, Snell's law there, and the true point from the two bent rays. Two rays in
    space do not meet in general, and what the paper does then was not to be found out. Here the
    true point is the middle of the shortest line between them, which needs no choice between the
    rays (it is eq 11 of Skarlatos & Agrafiotis 2018 for two). Bent rays nearer to parallel than
    a tenth of a degree leave it open, and the point is not corrected.

    So it is the method snell with two cameras and level water: exact where both see the point at
    the same incidence, or both stand in one vertical plane with it. Elsewhere the straight rays
    of a pair pass each other, so that the apparent point lies on neither, and an error remains.
    """
    paired = in_pairs(batch)
    found, parallel = _meet(paired.chosen())
    outcome = np.where(parallel, np.uint8(Outcome.PARALLEL_RAYS), paired.outcome())
    return paired.result(found[:, :3], outcome=outcome, ray_miss_m=found[:, 3])


@kernel
def _meet(points: Chosen) -> tuple[FloatArray, BoolArray]:
    """Return the shift of each point with two rays and its distance from them; where they fail."""
    found, sums = np.zeros((len(points.xyz), 4)), np.empty(9)
    parallel = np.zeros(len(points.xyz), np.bool_)
    for i in range(len(points.xyz)):
        if points.start[i + 1] - points.start[i] < 2:
            continue
        sums[:] = 0.0
        for c in points.camera[points.start[i] : points.start[i + 1]]:
            e = minus(row_of(points.centres, c), row_of(points.xyz, i))
            length2, depth = dot(e, e), points.height[i] - points.xyz[i, 2] + points.offset[c]
            share = max(depth, 0.0) / e[2]  # of the way up where the water is
            d = scaled(-1.0, e)
            if share > 0.0:
                d = refracted(e, length2, (0.0, 0.0, 1.0), e[2], 1.0 / points.n)
            add_line(sums, scaled(share, e), d, 1.0 / length2)
        solved, q, miss, _ = nearest_point(2.0, sums)
        parallel[i] = not solved
        if solved:
            found[i, 0], found[i, 1], found[i, 2] = q
            found[i, 3] = miss
    return found, parallel

"""Methods of the literature, for comparison: all are for level water.

In the vertical plane through a camera C and the apparent point P, the line of sight meets the
surface at A, at the angle a from the vertical, and goes on under water at the angle b, with
sin a = n sin b. The vertical through P is its *plumb line*. P lies on it at the apparent depth d,
where the straight line of sight crosses it; the refracted ray crosses it deeper, at the depth

    d tan a / tan b = d sqrt(n^2 + (n^2 - 1) tan^2 a)

as tan b = sin a / sqrt(n^2 - sin^2 a). Straight below the camera the left side is 0/0; the right
side is its limit n d.

Over a tilted surface or a mesh the water is taken as level at its height above the apparent point.
Each camera may have its own water level; where that is below the apparent point, its ray goes
straight.
"""

from __future__ import annotations

import numpy as np

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import minus, row_of
from pcfix.model import BoolArray, FloatArray, IntArray, Outcome
from pcfix.refract.batch import Batch, Chosen, Intersection
from pcfix.refract.rays import MIN_DETERMINANT
from pcfix.refract.regression import raise_no_regression

TOLERANCE = 1e-9
"""Of tan a between two iterations of `shan`; the depth then changes by less than 1e-9 of itself."""
MOST_ITERATIONS = 50


def apparent_depth(batch: Batch) -> FloatArray:
    """Return the depth of the apparent points below the water above them, metres, shape (m,)."""
    return np.asarray(batch.surface.height_m - batch.xyz[:, 2])


def down(shift_m: FloatArray) -> FloatArray:
    """Return downward shifts, shape (m, 3), of some metres, shape (m,)."""
    none = np.zeros(len(shift_m))
    return np.column_stack([none, none, -shift_m])


@device
def depth_ratio(tan2: float, n: float) -> float:
    """Return tan a / tan b of a ray with tan^2 a = `tan2`: true by apparent depth along it."""
    return np.sqrt(n * n + (n * n - 1.0) * tan2)


@kernel(allocates=True)
def _mean_crossings(points: Chosen) -> tuple[FloatArray, FloatArray]:
    """Return the mean depth below P at which the refracted rays of a point cross its plumb line.

    And the root mean square distance of that place from the rays; metres, 0 without rays.
    """
    lowered, distance = np.zeros(len(points.xyz)), np.zeros(len(points.xyz))
    for i in range(len(points.xyz)):
        rays = points.camera[points.start[i] : points.start[i + 1]]
        for c in rays:
            lowered[i] += _crossing(points, i, c)[0] / rays.size
        distance[i] = _distance(points, i, rays, lowered[i])
    return lowered, distance


@device(allocates=True)
def _distance(points: Chosen, i: int, rays: IntArray, lowered: float) -> float:
    """Return the root mean square distance of a place on the plumb line from the rays."""
    squares = 0.0
    for c in rays:
        below, cosine2 = _crossing(points, i, c)
        # h above the crossing the ray is h sin b away
        squares += (lowered - below) ** 2 * (1.0 - cosine2) / (points.n * points.n)
    return np.sqrt(squares / max(rays.size, 1))


@device
def _crossing(points: Chosen, i: int, c: int) -> tuple[float, float]:
    """Return how far below P a refracted ray crosses its plumb line, and cos^2 a."""
    ex, ey, ez = minus(row_of(points.centres, c), row_of(points.xyz, i))
    plan2 = ex * ex + ey * ey
    cosine2 = ez * ez / (plan2 + ez * ez)
    # below the water of this camera; 0 above it
    depth = points.height[i] - points.xyz[i, 2] + points.offset[c]
    return max(depth, 0.0) * (depth_ratio(plan2 / (ez * ez), points.n) - 1.0), cosine2


def factor(batch: Batch) -> Intersection:
    """Multiply the apparent depth by `depth_factor`, else by the refractive index; only Z moves.

    Every point is corrected, as no ray is needed; see `without_rays`.

    Notes
    -----
    n is the limit for cameras straight above, long in use for rivers (Westaway et al. 2001, Woodget
    et al. 2015). At the angle a in air the true depth is larger by (n^2 - 1) tan^2 a / (2 n^2) of
    it: 1.6 % at 15 degrees, 3.3 % at 21 degrees. A factor of one's own can include that, or that of
    stereo pairs (`pcfix.refract.stereo_factor`), for which `depth_factor` auto stands.
    """
    settings = batch.survey.settings
    given = settings.depth_factor
    ratio = settings.refractive_index if given is None else float(given)
    return without_rays(batch, (ratio - 1.0) * apparent_depth(batch))


def regression(batch: Batch) -> Intersection:
    """Apply the fitted regression to the apparent depths; only Z moves.

    Every point is corrected, as no ray is needed; see `without_rays`.

    Raises
    ------
    SettingError
        If there is no regression.

    Notes
    -----
    Method III of Hsu & Wang ("the empirical relation between the true depth and apparent depth
    from a limited depth measurement"), option 1 of Mulsow (2024): a line fitted to check depths.
    With a negative intercept very shallow points would lie above the water; they go to its surface.
    The slope that they print, 0.9895, is for negative values from an origin at 190 mm; here depths
    count from the water.
    """
    learned = batch.survey.learned.regression
    if learned is None:
        raise_no_regression()
    apparent = apparent_depth(batch)
    return without_rays(batch, learned.depth_m(apparent) - apparent)


def without_rays(batch: Batch, lowered_m: FloatArray) -> Intersection:
    """Return the result of a method that lowers points, shape (m,), and needs no cameras.

    All points are corrected. `ray_count` is that of the chosen cameras, but at least 1: in files a
    count of 0 marks a point that was not corrected.
    """
    outcome = np.full(len(batch.xyz), Outcome.CORRECTED, np.uint8)
    found = batch.result(down(lowered_m), outcome=outcome)
    return found._replace(ray_count=np.maximum(found.ray_count, 1))


def butler(batch: Batch) -> Intersection:
    """Multiply the apparent depth by tan r / tan i, in the mean over the images; only Z moves.

    Points with one ray are corrected too. The rays of a point cross its plumb line at different
    depths; `ray_miss_m` is their distance from the mean.

    Notes
    -----
    Method I of Hsu & Wang, eq 1: with r the angle from the vertical of the line from the apparent
    point to the projection centre,

        h = h_A tan r / tan(asin(sin r / n))

    for one image (``max_cameras=1``); for more images the mean with equal weights. Straight below a
    camera, where that is 0 / 0, it has its limit n h_A.

    The paper that they name it after (Butler, Lane, Chandler & Porfiri 2002, Photogrammetric Record
    17(99), 419-439) refracts both image rays of a stereo pair and intersects them again, which is
    `snell` with ``max_cameras=2``.

    Exact where all rays have the same incidence. Slanting rays determine the apparent depth more
    than steep ones, which a mean ignores: where incidences differ, the result is too shallow, by up
    to 1.5 % of the depth under nine nadir images (32 m apart, 80 m up) and by 4 % for one camera
    overhead and one at 32 degrees.

    It is also the method of Dietrich (2017), "Bathymetric Structure-from-Motion", Earth Surface
    Processes and Landforms 42, 355-364, over all cameras, as his program pyBathySfM computes it.
    The program excludes a camera exactly above the point, as tan i is 0 there.
    """
    lowered, distance = _mean_crossings(batch.chosen())
    outcome = np.where(batch.counts > 0, Outcome.CORRECTED, Outcome.NO_CAMERA).astype(np.uint8)
    return batch.result(down(lowered), outcome=outcome, ray_miss_m=distance)


def murase(batch: Batch) -> Intersection:
    """Take the depth from the X-parallax of each stereo pair of a point's images; only Z moves.

    Points whose pairs have almost no parallax are not corrected.

    Notes
    -----
    Method II of Hsu & Wang, eqs 2 to 4: with X along the base of a pair, r and i the angles of a
    ray from the vertical in air and water, and D the distance of a camera in plan,

        h = h_A (tan r_1 cos t_1 + tan r_2 cos t_2) / (tan i_1 cos t_1 + tan i_2 cos t_2)
        cos t_1 = (X_A - X_S1) / D_1,  cos t_2 = (X_S2 - X_A) / D_2

    which is the depth at which the refracted rays have the same X. Of k images all k (k - 1) / 2
    pairs are used; the mean of their depths is weighted by the squares of their parallaxes under
    water (the denominators), as in least squares. A pair without a base in plan has no X and does
    not count.

    The paper that they name it after (Murase et al. 2008, Photogrammetric Engineering & Remote
    Sensing 74(9), 1129-1136) corrects from the positions of the two cameras of a pair; implemented
    is the formula that Hsu & Wang print.

    Exact where both rays have the same incidence, and where cameras and point are in one vertical
    plane. Elsewhere the rays of a pair differ in Y too, which the formula ignores.
    """
    lowered, distance, failed = _equal_x(batch.chosen())
    outcome = np.where(failed, np.uint8(Outcome.PARALLEL_RAYS), batch.outcome())
    return batch.result(down(lowered), outcome=outcome, ray_miss_m=distance)


@kernel(allocates=True)
def _equal_x(points: Chosen) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return how far each point sinks by its pairs, its distance from the rays, and failures.

    With p the slope tan r cos t of a ray along the base and q = p / s that of the refracted one,
    the ray is q z - (p - q) d from the plumb line, z below the apparent point. The two of a pair
    are equal at z = ((p_1 - q_1) d_1 - (p_2 - q_2) d_2) / (q_1 - q_2), with the depth d of each
    image under its own water level; for one level that is the formula of the paper.
    """
    lowered, distance = np.zeros(len(points.xyz)), np.zeros(len(points.xyz))
    failed = np.zeros(len(points.xyz), np.bool_)
    for i in range(len(points.xyz)):
        rays = points.camera[points.start[i] : points.start[i + 1]]
        if rays.size < 2:
            continue
        # weighted mean over all pairs
        products = squares = 0.0
        for a in range(rays.size):
            for b in range(a + 1, rays.size):
                parallax, shift = _pair(points, i, rays[a], rays[b])
                products += parallax * shift
                squares += parallax * parallax
        pairs = rays.size * (rays.size - 1) // 2
        # next to no parallax leaves the depth open
        sunk = products / squares if squares > 4.0 * pairs * MIN_DETERMINANT else -np.inf
        failed[i] = sunk < 0.0
        if not failed[i]:
            lowered[i], distance[i] = sunk, _distance(points, i, rays, sunk)
    return lowered, distance, failed


@device
def _pair(points: Chosen, i: int, first: int, second: int) -> tuple[float, float]:
    """Return the X-parallax of two refracted rays per metre of depth, and at the apparent point."""
    x, y, _ = minus(row_of(points.centres, second), row_of(points.centres, first))
    # X is along the base of the pair
    base = np.hypot(x, y)
    if base == 0.0:
        return 0.0, 0.0
    parallax = shift = 0.0
    for c, sign in ((first, 1.0), (second, -1.0)):
        ex, ey, ez = minus(row_of(points.centres, c), row_of(points.xyz, i))
        depth = points.height[i] - points.xyz[i, 2] + points.offset[c]
        s = depth_ratio((ex * ex + ey * ey) / (ez * ez), points.n) if depth > 0.0 else 1.0
        # slope of the straight ray along X, and that under water
        straight = -(ex * x + ey * y) / (base * ez)
        parallax += sign * straight / s
        shift += sign * (straight - straight / s) * max(depth, 0.0)
    return parallax, shift


def shan(batch: Batch) -> Intersection:
    """Intersect with the collinearity equations of the s-model; X, Y and Z move.

    Points whose refracted rays are nearer to parallel than a tenth of a degree, or for which the
    iteration finds no depth under the water, are not corrected.

    Notes
    -----
    Shan (1994), "Relief reconstruction using two-media photogrammetry", as Skarlatos & Agrafiotis
    (2018, JMSE 6(3), 77, section 2.1.1, eqs 1-7) give it; their eq 2 lacks the root that eqs 1 and
    7 have. The image of the true point (X, Y) at the depth D is that of a point seen through air on
    the same vertical at the depth D / s, with

        s = tan a / tan b = sqrt(n^2 + (n^2 - 1) tan^2 a)        (eq 7)

    so that the collinearity equations hold with D / s for the depth (eq 3). Every image has its
    own s; two images give four equations for X, Y, D and two s. With s known they are linear.
    The iteration starts with s = 1, takes tan a from the point found, and with the s of eq 7
    solves again, until no tan a changes by more than `TOLERANCE`.

    Differences from the paper:

    - The paper's first tan a is eq 6 with Z = 0; s = 1 is nearer, and saves an iteration.
    - The image ray is the line from the projection centre to the apparent point, as a cloud has
      no image coordinates. So the start, s = 1, is the apparent point itself.
    - Any number of rays: the equations of all are solved together in least squares, each one
      divided so that it is X or Y in metres. Two rays alone are overdetermined too (4 by 3).
    - The equations are horizontal distances at the true depth, not distances from the rays as in
      eq 11 (method snell); the two agree where the rays intersect.
    - tan a is that of eq 6, from the point at the depth D / s, with the previous s.
    - Vertical rays leave the depth open: the equations are singular.

    Exact where the straight rays meet in the apparent point: two cameras at the same incidence,
    or in one vertical plane with the point. The image ray determines s, so that the iteration only
    accounts for rays that pass each other; a few iterations are enough.
    """
    found = np.zeros((len(batch.xyz), 4))
    failed = np.zeros(len(batch.xyz), np.bool_)
    in_tiles(_solve_all, len(batch), batch.chosen(), found, failed, points=len(batch))
    outcome = np.where(failed, np.uint8(Outcome.PARALLEL_RAYS), batch.outcome())
    return batch.result(found[:, :3], outcome=outcome, ray_miss_m=found[:, 3])


@kernel(allocates=True)
def _solve_all(span: Span, points: Chosen, found: FloatArray, failed: BoolArray) -> None:
    """Fill in shift and distance from the rays of each point with two rays or more."""
    for i in range(*span):
        rays = points.camera[points.start[i] : points.start[i + 1]]
        if rays.size < 2:
            continue
        e = np.empty((rays.size, 3))
        d = np.empty(rays.size)
        for j in range(rays.size):
            for axis in range(3):
                e[j, axis] = points.centres[rays[j], axis] - points.xyz[i, axis]
            depth = points.height[i] - points.xyz[i, 2]
            # the depth under the water of this camera; 0 above it
            d[j] = max(depth + points.offset[rays[j]], 0.0)
        solved, x, y, sunk = _iterate(e, d, points.n)
        failed[i] = not solved
        if solved:
            found[i, 0], found[i, 1], found[i, 2] = x, y, -sunk
            found[i, 3] = _shan_distance(e, d, points.n, x, y, sunk)


@device(allocates=True)
def _iterate(e: FloatArray, d: FloatArray, n: float) -> tuple[bool, float, float, float]:
    """Solve for one point; e (k, 3) leads from it to the cameras, d (k,) is its depth for each.

    Returns whether it was solved, and how far the true point is aside (x, y) and below, metres.
    """
    s, tangent = np.ones(d.size), np.hypot(e[:, 0], e[:, 1]) / e[:, 2]
    x = y = sunk = 0.0
    for _ in range(MOST_ITERATIONS):
        for j in range(d.size):
            s[j] = depth_ratio(tangent[j] ** 2, n) if d[j] > 0.0 else 1.0
        solved, x, y, sunk = _intersected(e, d, s)
        if not (solved and sunk + d.min() >= 0.0):
            return False, 0.0, 0.0, 0.0
        change = 0.0
        for j in range(d.size):
            # height of the camera over the point at the depth D / s
            rise = e[j, 2] - d[j] + (d[j] + sunk) / s[j]
            following = np.hypot(x - e[j, 0], y - e[j, 1]) / rise
            change = max(change, abs(following - tangent[j]))
            tangent[j] = following
        if change <= TOLERANCE:
            break
    return True, x, y, sunk


@device(allocates=True)
def _intersected(e: FloatArray, d: FloatArray, s: FloatArray) -> tuple[bool, float, float, float]:
    """Solve the collinearity equations with s known.

    In plan, a camera's image ray is u = -e / e_z metres aside per metre down, and in the water
    v = u / s. It meets the vertical of the true point, x aside and `sunk` below the apparent one,
    where

        x = v sunk + r,    r = -(u - v) d

    for each of the two axes: a straight line through the places (v, r), of which `sunk` is the
    slope with its sign changed.
    """
    k = d.size
    v, r = np.empty((k, 2)), np.empty((k, 2))
    for j in range(k):
        for axis in range(2):
            u = -e[j, axis] / e[j, 2]
            v[j, axis] = u / s[j]
            r[j, axis] = -(u - v[j, axis]) * d[j]
    mean_v = np.array([v[:, 0].mean(), v[:, 1].mean()])
    mean_r = np.array([r[:, 0].mean(), r[:, 1].mean()])
    # least squares of a line through the places (v, r)
    spread = product = 0.0
    for j in range(k):
        for axis in range(2):
            away = v[j, axis] - mean_v[axis]
            spread += away * away
            product += away * (r[j, axis] - mean_r[axis])
    # of two rays at a small angle alpha the spread is alpha^2 / 2
    if not spread >= 2.0 * k * MIN_DETERMINANT:
        return False, 0.0, 0.0, 0.0
    sunk = -product / spread
    return True, mean_r[0] + sunk * mean_v[0], mean_r[1] + sunk * mean_v[1], sunk


@device
def _shan_distance(
    e: FloatArray, d: FloatArray, n: float, x: float, y: float, sunk: float
) -> float:
    """Return the root mean square distance of a point from the refracted rays."""
    squares = 0.0
    for j in range(d.size):
        u, w = -e[j, 0] / e[j, 2], -e[j, 1] / e[j, 2]
        s = depth_ratio(u * u + w * w, n) if d[j] > 0.0 else 1.0
        v0, v1 = u / s, w / s
        aside0 = x - v0 * sunk + (u - v0) * d[j]
        aside1 = y - v1 * sunk + (w - v1) * d[j]
        # the part of the offset along the ray does not count
        along = aside0 * v0 + aside1 * v1
        square = aside0 * aside0 + aside1 * aside1 - along * along / (1.0 + v0 * v0 + v1 * v1)
        squares += max(square, 0.0)
    return np.sqrt(squares / d.size)

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

from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Vector, minus, row_of
from pcfix.model import BoolArray, FloatArray, Outcome
from pcfix.refract.batch import Batch, Chosen, Intersection
from pcfix.refract.rays import MIN_DETERMINANT

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
def _mean_crossings(points: Chosen) -> FloatArray:
    """Return the mean depth below P at which the refracted rays of a point cross its plumb line."""
    lowered = np.zeros(len(points.xyz))
    for i in range(len(points.xyz)):
        rays = points.camera[points.start[i] : points.start[i + 1]]
        for c in rays:
            lowered[i] += _crossing(points, i, c)[0] / rays.size
    return lowered


@kernel(allocates=True)
def _distances(points: Chosen, shift: FloatArray) -> FloatArray:
    """Return the root mean square distance of the true points from their refracted rays, metres."""
    distance = np.zeros(len(points.xyz))
    for i in range(len(points.xyz)):
        rays, squares = points.camera[points.start[i] : points.start[i + 1]], 0.0
        for c in rays:
            below, u, v = _crossing(points, i, c)
            # how far aside of the ray the point is at its own depth
            x = shift[i, 0] - u * (-shift[i, 2] - below)
            y = shift[i, 1] - v * (-shift[i, 2] - below)
            # the part of the offset along the ray does not count
            along = x * u + y * v
            square = x * x + y * y - along * along / (1.0 + u * u + v * v)
            squares += max(square, 0.0)
        distance[i] = np.sqrt(squares / max(rays.size, 1))
    return distance


@device
def _crossing(points: Chosen, i: int, c: int) -> Vector:
    """Return how far below P a refracted ray crosses its plumb line, and how it leans.

    The latter is how far it goes aside per metre down, in x and y.
    """
    ex, ey, ez = minus(row_of(points.centres, c), row_of(points.xyz, i))
    tan2 = (ex * ex + ey * ey) / (ez * ez)
    depth = max(points.height[i] - points.xyz[i, 2] + points.offset[c], 0.0)
    s = depth_ratio(tan2, points.n) if depth > 0.0 else 1.0
    return depth * (s - 1.0), -ex / (ez * s), -ey / (ez * s)


def factor(batch: Batch) -> Intersection:
    """Multiply the apparent depth by `depth_factor`, else by the refractive index; only Z moves.

    Every point is corrected, as no ray is needed; see `without_rays`.

    Notes
    -----
    n is the limit for cameras straight above, long in use for rivers (Westaway et al. 2001, Woodget
    et al. 2015). At the angle a in air the true depth is larger by (n^2 - 1) tan^2 a / (2 n^2) of
    it: 1.6 % at 15 degrees, 3.3 % at 21 degrees. The factor auto is that of stereo pairs
    (`pcfix.refract.stereo_factor`).
    """
    settings = batch.survey.settings
    given = settings.depth_factor
    ratio = settings.refractive_index if given is None else float(given)
    return without_rays(batch, (ratio - 1.0) * apparent_depth(batch))


def regression(batch: Batch) -> Intersection:
    """Apply the fitted regression to the apparent depths; only Z moves.

    Every point is corrected, as no ray is needed; see `without_rays`. Raises SettingError if there
    is no regression.

    Notes
    -----
    Method III of Hsu & Wang ("the empirical relation between the true depth and apparent depth
    from a limited depth measurement"), option 1 of Mulsow (2024): a line fitted to check depths.
    With a negative intercept very shallow points would lie above the water; they go to its surface.
    The slope that they print, 0.9895, is for negative values from an origin at 190 mm; here depths
    count from the water.
    """
    line = batch.survey.learned.regression
    if line is None:
        raise SettingError(
            "regression.missing",
            "Method regression needs a fitted line. Give check depths or the line of another"
            " cloud.",
        )
    apparent = apparent_depth(batch)
    return without_rays(batch, line.depth_m(apparent) - apparent)


def without_rays(batch: Batch, lowered_m: FloatArray) -> Intersection:
    """Return the result of a method that lowers points, shape (m,), and needs no cameras.

    All points are corrected. `ray_count` is that of the chosen cameras, but at least 1: in files a
    count of 0 marks a point that was not corrected.
    """
    outcome = np.full(len(batch.xyz), Outcome.CORRECTED, np.uint8)
    found = batch.result(down(lowered_m), outcome=outcome)
    return found._replace(ray_count=np.maximum(found.ray_count, 1))


def _with_distances(batch: Batch, shift: FloatArray, outcome: npt.NDArray[Any]) -> Intersection:
    distance = _distances(batch.chosen(), shift)
    return batch.result(shift, outcome=outcome.astype(np.uint8), ray_miss_m=distance)


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
    lowered = _mean_crossings(batch.chosen())
    outcome = np.where(batch.counts > 0, Outcome.CORRECTED, Outcome.NO_CAMERA)
    return _with_distances(batch, down(lowered), outcome)


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
    lowered = _equal_x(batch.chosen())
    outcome = np.where(lowered < 0.0, Outcome.PARALLEL_RAYS, batch.outcome())
    return _with_distances(batch, down(np.maximum(lowered, 0.0)), outcome)


@kernel(allocates=True)
def _equal_x(points: Chosen) -> FloatArray:
    """Return how far each point sinks by its pairs; negative where these leave the depth open."""
    lowered = np.zeros(len(points.xyz))
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
        lowered[i] = -products / squares if squares > 4.0 * pairs * MIN_DETERMINANT else -np.inf
    return lowered


@device
def _pair(points: Chosen, i: int, first: int, second: int) -> tuple[float, float]:
    """Return the X-parallax of two refracted rays per metre of depth, and at the apparent point.

    With the slope q of a ray along the base and its crossing `below` the apparent point, the ray is
    q (z - below) from the plumb line at the depth z; both are equal at -shift / parallax.
    """
    x, y, _ = minus(row_of(points.centres, second), row_of(points.centres, first))
    # X is along the base of the pair
    base = np.hypot(x, y)
    if base == 0.0:
        return 0.0, 0.0
    parallax = shift = 0.0
    for c, sign in ((first, 1.0), (second, -1.0)):
        below, u, v = _crossing(points, i, c)
        q = sign * (u * x + v * y) / base
        parallax, shift = parallax + q, shift - q * below
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
    shift = np.zeros((len(batch.xyz), 3))
    failed = np.zeros(len(batch.xyz), np.bool_)
    in_tiles(_iterate, len(batch), batch.chosen(), shift, failed, points=len(batch))
    outcome = np.where(failed, Outcome.PARALLEL_RAYS, batch.outcome())
    return _with_distances(batch, shift, outcome)


@kernel(allocates=True)
def _iterate(span: Span, points: Chosen, shift: FloatArray, failed: BoolArray) -> None:
    """Fill in the shift of each point with two rays or more, or that it has no solution."""
    for i in range(*span):
        rays = points.camera[points.start[i] : points.start[i + 1]]
        if rays.size < 2:
            continue
        e, d, s = np.empty((rays.size, 3)), np.empty(rays.size), np.ones(rays.size)
        for j in range(rays.size):
            e[j] = points.centres[rays[j]] - points.xyz[i]
            # the depth under the water of this camera; 0 above it
            d[j] = max(points.height[i] - points.xyz[i, 2] + points.offset[rays[j]], 0.0)
        tangent = np.hypot(e[:, 0], e[:, 1]) / e[:, 2]
        for _ in range(MOST_ITERATIONS):
            for j in range(rays.size):
                s[j] = depth_ratio(tangent[j] ** 2, points.n) if d[j] > 0.0 else 1.0
            solved, x, y, sunk = _intersected(e, d, s)
            failed[i] = not (solved and sunk + d.min() >= 0.0)
            if failed[i]:
                break
            # tan a from the height of the camera over the point at the depth D / s
            following = np.hypot(x - e[:, 0], y - e[:, 1]) / (e[:, 2] - d + (d + sunk) / s)
            change, tangent = np.abs(following - tangent).max(), following
            if change <= TOLERANCE:
                break
        if not failed[i]:
            shift[i, 0], shift[i, 1], shift[i, 2] = x, y, -sunk


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
    k, means = float(d.size), np.zeros((2, 2))
    spread = product = 0.0
    for axis in range(2):
        u = -e[:, axis] / e[:, 2]
        v = u / s
        r = -(u - v) * d
        means[axis, 0], means[axis, 1] = v.mean(), r.mean()
        # least squares of a line through the places (v, r)
        away = v - means[axis, 0]
        spread += (away * away).sum()
        product += (away * (r - means[axis, 1])).sum()
    # of two rays at a small angle alpha the spread is alpha^2 / 2
    if not spread >= 2.0 * k * MIN_DETERMINANT:
        return False, 0.0, 0.0, 0.0
    sunk = -product / spread
    return True, means[0, 1] + sunk * means[0, 0], means[1, 1] + sunk * means[1, 0], sunk

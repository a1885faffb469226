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

import numpy as np

from pcfix.kernels import device, kernel
from pcfix.lens.algebra import minus, row_of
from pcfix.model import BoolArray, FloatArray, IntArray, Outcome
from pcfix.refract.batch import Batch, Chosen, Intersection
from pcfix.refract.rays import MIN_DETERMINANT
from pcfix.refract.regression import raise_no_regression


def apparent_depth(batch: Batch) -> FloatArray:
    """Return how far the apparent points lie below the water above them, metres, shape (m,)."""
    return np.asarray(batch.surface.height_m - batch.xyz[:, 2])


def down(shift_m: FloatArray) -> FloatArray:
    """Return shifts, shape (m, 3), that go down by so many metres, shape (m,)."""
    none = np.zeros(len(shift_m))
    return np.column_stack([none, none, -shift_m])


@device
def depth_ratio(tan2: float, n: float) -> float:
    """Return tan a / tan b of a ray with tan^2 a = `tan2`: what a depth grows by along it."""
    return np.sqrt(n * n + (n * n - 1.0) * tan2)


@kernel(allocates=True)
def _mean_crossings(points: Chosen) -> tuple[FloatArray, FloatArray]:
    """Return how far below its apparent point the bent rays of each cross its plumb line.

    Returns
    -------
    lowered, miss : array, shape (m,)
        The mean over the rays, and its root mean square distance from them, metres; 0 where a
        point has no ray.
    """
    lowered, miss = np.zeros(len(points.xyz)), np.zeros(len(points.xyz))
    for i in range(len(points.xyz)):
        rays = points.camera[points.start[i] : points.start[i + 1]]
        for c in rays:
            lowered[i] += _crossing(points, i, c)[0] / rays.size
        miss[i] = _miss(points, i, rays, lowered[i])
    return lowered, miss


@device(allocates=True)
def _miss(points: Chosen, i: int, rays: IntArray, lowered: float) -> float:
    """Return the root mean square distance of a place on the plumb line from the bent rays.

    A place h above where a ray crosses the plumb line is h sin b away from the ray.
    """
    squares = 0.0
    for c in rays:
        below, cosine2 = _crossing(points, i, c)
        squares += (lowered - below) ** 2 * (1.0 - cosine2) / (points.n * points.n)
    return np.sqrt(squares / max(rays.size, 1))


@device
def _crossing(points: Chosen, i: int, c: int) -> tuple[float, float]:
    """Return how far below the apparent point a bent ray crosses its plumb line; cos^2 a."""
    ex, ey, ez = minus(row_of(points.centres, c), row_of(points.xyz, i))
    plan2 = ex * ex + ey * ey
    cosine2 = ez * ez / (plan2 + ez * ez)
    depth = points.height[i] - points.xyz[i, 2] + points.offset[c]
    return max(depth, 0.0) * (depth_ratio(plan2 / (ez * ez), points.n) - 1.0), cosine2


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
    own can take that in, or that of stereo pairs, `pcfix.refract.stereo_factor`, for which
    `depth_factor` auto stands until the cloud is looked at.
    """
    settings = batch.survey.settings
    given = settings.depth_factor
    ratio = settings.refractive_index if given is None else float(given)
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
    Method III of Hsu & Wang ("the empirical relation between the true depth and apparent depth
    from a limited depth measurement"), option 1 of Mulsow (2024): a line fitted to check depths.
    With a negative intercept it takes very shallow points above the water; they go to its surface.
    Their own line, of values that are negative as the origin is at 190 mm, has the slope 0.9895;
    here depths count from the water.
    """
    learned = batch.survey.learned.regression
    if learned is None:
        raise_no_regression()
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


def butler(batch: Batch) -> Intersection:
    """Multiply the apparent depth by tan r / tan i, in the mean over the images; only Z moves.

    Returns
    -------
    Intersection
        Points with one ray are corrected too: the formula has one image. The rays of a point cross
        its plumb line at different depths; `ray_miss_m` is how far they pass from the mean.

    Notes
    -----
    Method I of Hsu & Wang, eq 1: with r the angle from the vertical of the line from the apparent
    point to the projection centre,

        h = h_A tan r / tan(asin(sin r / n))

    one image at a time; ``max_cameras=1`` is the single image of the paper, and of more images the
    mean is taken with equal weights. Straight below a camera, where that is 0 / 0, it has its
    limit n h_A.

    What they name it after (Butler, Lane, Chandler & Porfiri 2002, Photogrammetric Record 17(99),
    419-439) is known for more: both image rays of a stereo pair are bent at the surface and
    intersected again, which is `snell` with ``max_cameras=2``.

    Exact where all rays have the same incidence. The slanting rays fix the apparent depth more
    than the steep ones do, which a mean does not know: where incidences differ, the result is too
    shallow, by up to 1.5 % of the depth under nine nadir images (32 m apart, 80 m up) and by
    4 % for one camera overhead and one at 32 degrees.
    """
    lowered, miss = _mean_crossings(batch.chosen())
    outcome = np.where(batch.counts > 0, Outcome.CORRECTED, Outcome.NO_CAMERA).astype(np.uint8)
    return batch.result(down(lowered), outcome=outcome, ray_miss_m=miss)


def dietrich(batch: Batch) -> Intersection:
    """Take the mean of tan r / tan i over all cameras: the formula of `butler`, as SfM uses it.

    Returns
    -------
    Intersection

    Notes
    -----
    Dietrich (2017), "Bathymetric Structure-from-Motion", Earth Surface Processes and Landforms
    42, 355-364, as his program pyBathySfM computes it. The program leaves a camera exactly above
    the point out, as tan i is 0 there; here it counts with the limit.
    """
    return butler(batch)


def murase(batch: Batch) -> Intersection:
    """Take the depth from the X-parallax of each stereo pair of a point's images; only Z moves.

    Returns
    -------
    Intersection
        Points whose pairs have next to no parallax are not corrected.

    Notes
    -----
    Method II of Hsu & Wang, eqs 2 to 4: with X along the base of a pair, r and i the angles of a
    ray from the vertical in air and water, and D the distance of a camera in plan,

        h = h_A (tan r_1 cos t_1 + tan r_2 cos t_2) / (tan i_1 cos t_1 + tan i_2 cos t_2)
        cos t_1 = (X_A - X_S1) / D_1,  cos t_2 = (X_S2 - X_A) / D_2

    which is the depth at which the bent rays have the same X. Two images make one pair; of k images
    all k (k - 1) / 2 pairs are used, and the mean of their depths has the squares of their
    parallaxes under water (the denominators) for weights, as least squares would give them. A pair
    without a base in plan has no X and counts for nothing.

    What they name it after (Murase et al. 2008, Photogrammetric Engineering & Remote Sensing 74(9),
    1129-1136) is known for a correction from the positions of the two cameras of a pair; the
    formula that Hsu & Wang print is what is built.

    Exact where both rays have the same incidence, and where cameras and point are in one vertical
    plane. Elsewhere the rays of a pair differ in Y too, which the formula leaves out.
    """
    lowered, miss, failed = _equal_x(batch.chosen())
    outcome = np.where(failed, np.uint8(Outcome.PARALLEL_RAYS), batch.outcome())
    return batch.result(down(lowered), outcome=outcome, ray_miss_m=miss)


@kernel(allocates=True)
def _equal_x(points: Chosen) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return how far each point sinks by its pairs, its distance from the rays, where they fail.

    With p the slope tan r cos t of a ray along the base and q = p / s that of the bent one, z
    below the apparent point the ray is q z - (p - q) d from the plumb line. The two of a pair are
    equal at z = ((p_1 - q_1) d_1 - (p_2 - q_2) d_2) / (q_1 - q_2), where each image has its own
    depth d under its own water level; for one level that is the formula of the text.
    """
    lowered, miss = np.zeros(len(points.xyz)), np.zeros(len(points.xyz))
    failed = np.zeros(len(points.xyz), np.bool_)
    for i in range(len(points.xyz)):
        rays = points.camera[points.start[i] : points.start[i + 1]]
        if rays.size < 2:
            continue
        products = squares = 0.0
        for a in range(rays.size):
            for b in range(a + 1, rays.size):
                parallax, shift = _pair(points, i, rays[a], rays[b])
                products += parallax * shift
                squares += parallax * parallax
        pairs = rays.size * (rays.size - 1) // 2
        sunk = products / squares if squares > 4.0 * pairs * MIN_DETERMINANT else -np.inf
        failed[i] = sunk < 0.0
        if not failed[i]:
            lowered[i], miss[i] = sunk, _miss(points, i, rays, sunk)
    return lowered, miss, failed


@device
def _pair(points: Chosen, i: int, first: int, second: int) -> tuple[float, float]:
    """Return the X-parallax of two bent rays by metre of depth, and at the apparent point."""
    x, y, _ = minus(row_of(points.centres, second), row_of(points.centres, first))
    base = np.hypot(x, y)
    if base == 0.0:
        return 0.0, 0.0
    parallax = shift = 0.0
    for c, sign in ((first, 1.0), (second, -1.0)):
        ex, ey, ez = minus(row_of(points.centres, c), row_of(points.xyz, i))
        depth = points.height[i] - points.xyz[i, 2] + points.offset[c]
        s = depth_ratio((ex * ex + ey * ey) / (ez * ez), points.n) if depth > 0.0 else 1.0
        straight = -(ex * x + ey * y) / (base * ez)
        parallax += sign * straight / s
        shift += sign * (straight - straight / s) * max(depth, 0.0)
    return parallax, shift

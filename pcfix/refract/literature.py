"""Methods of the literature, for comparison: all are for level water.

In the vertical plane through a camera C and the apparent point P, the line of sight meets the
surface at A, at the angle a from the vertical, and goes on under water at the angle b, with
sin a = n sin b. The vertical through P is its *plumb line*. P lies on it at the apparent depth d,
where the straight line of sight crosses it; the refracted ray crosses it deeper, at the depth

    d tan a / tan b = d sqrt(n^2 + (n^2 - 1) tan^2 a)

as tan b = sin a / sqrt(n^2 - sin^2 a). Straight below the camera the left side is 0/0; the right
side is its limit n d. The methods differ in what they make of the crossings of several rays.

Over a tilted surface or a mesh the water is taken as level at its height above the apparent point.
Each camera may have its own water level; where that is below the apparent point, its ray goes
straight.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from pcfix.errors import GeometryError, SettingError
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.model import BoolArray, Cameras, FloatArray, Outcome
from pcfix.refract.batch import Batch, Chosen, Intersection
from pcfix.refract.rays import MIN_DETERMINANT

TOLERANCE = 1e-9  # of tan a between iterations of `shan`; depths change by less than 1e-9
MOST_ITERATIONS = 50

# Of the refracted rays of a point: how far below P each crosses the plumb line, metres; how it
# leans, metres aside in x and y per metre down; and s = tan a / tan b, true by apparent depth.
Crossings: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]

_MEAN, _PAIRS, _S_MODEL = range(3)


def factor(batch: Batch) -> Intersection:
    """Multiply the apparent depth by `depth_factor`, else by the refractive index; only Z moves.

    n is the limit for cameras straight above, long in use for rivers (Westaway et al. 2001, Woodget
    et al. 2015). At the angle a in air the true depth is larger by (n^2 - 1) tan^2 a / (2 n^2) of
    it: 1.6 % at 15 degrees, 3.3 % at 21 degrees. The factor auto is that of `stereo_factor`.
    """
    settings = batch.survey.settings
    given = settings.depth_factor
    ratio = settings.refractive_index if given is None else float(given)
    apparent = batch.surface.height_m - batch.xyz[:, 2]
    return _without_rays(batch, (ratio - 1.0) * apparent)


def regression(batch: Batch) -> Intersection:
    """Apply the line fitted to check depths to the apparent depths; only Z moves.

    Method III of Hsu & Wang, option 1 of Mulsow (2024). With a negative intercept very shallow
    points would lie above the water; they go to its surface. The slope that Hsu & Wang print,
    0.9895, is for negative values from an origin at 190 mm; here depths count from the water.
    Raises SettingError without a line.
    """
    line = batch.survey.learned.regression
    if line is None:
        raise SettingError(
            "regression.missing",
            "Method regression needs a fitted line. Give check depths or the line of another"
            " cloud.",
        )
    apparent = batch.surface.height_m - batch.xyz[:, 2]
    return _without_rays(batch, line.depth_m(apparent) - apparent)


def _without_rays(batch: Batch, lowered_m: FloatArray) -> Intersection:
    """Return the result of a method that lowers points, shape (m,), and needs no cameras.

    All points are corrected. `ray_count` is that of the chosen cameras, but at least 1: in files a
    count of 0 marks a point that was not corrected.
    """
    shift = np.zeros((len(batch), 3))
    shift[:, 2] = -lowered_m
    found = batch.result(shift, outcome=np.full(len(batch), Outcome.CORRECTED, np.uint8))
    return found._replace(ray_count=np.maximum(found.ray_count, 1))


def _by_rays(batch: Batch, method: int) -> Intersection:
    """Return the result of a method by the refracted rays of the chosen cameras."""
    m = len(batch)
    shift, distance, failed = np.zeros((m, 3)), np.zeros(m), np.zeros(m, np.bool_)
    in_tiles(_solve, m, batch.chosen(), method, shift, distance, failed, points=m)
    outcome = np.where(failed, Outcome.PARALLEL_RAYS, Outcome.CORRECTED)
    if method != _MEAN:
        outcome[batch.counts == 1] = Outcome.ONE_CAMERA
    outcome[batch.counts == 0] = Outcome.NO_CAMERA
    return batch.result(shift, outcome=outcome.astype(np.uint8), ray_miss_m=distance)


@kernel(allocates=True)
def _solve(
    span: Span, points: Chosen, method: int, shift: FloatArray, distance: FloatArray,
    failed: BoolArray,
) -> None:  # fmt: skip
    """Fill in the shift of each point, or that it has none, and its distance from the rays."""
    centres, offset = points.rig.centres, points.rig.offset
    for i in range(*span):
        cameras = points.camera[points.start[i] : points.start[i + 1]]
        k = cameras.size
        e = centres[cameras] - points.xyz[i]
        # the depth under the water of each camera; 0 above it
        d = np.maximum(points.height[i] - points.xyz[i, 2] + offset[cameras], 0.0)
        rays = _crossings(e, d, np.hypot(e[:, 0], e[:, 1]) / e[:, 2], points.n)
        # how far the true point is aside of the apparent one, and below it
        x, y, down_m, solved = 0.0, 0.0, 0.0, True
        if method == _MEAN:
            down_m = rays[0].sum() / max(k, 1)
        elif k >= 2 and method == _PAIRS:
            down_m, solved = _equal_x(e, rays)
        elif k >= 2:
            x, y, down_m, solved = _s_model(e, d, rays, points.n)
        failed[i] = not solved
        if solved:
            shift[i] = x, y, -down_m
        # root mean square distance of the true point from the refracted rays: how far aside of each
        # it is at its own depth, without the part of that along the ray
        below, u, v, _ = rays
        aside_x = shift[i, 0] + u * (shift[i, 2] + below)
        aside_y = shift[i, 1] + v * (shift[i, 2] + below)
        along = aside_x * u + aside_y * v
        squares = aside_x * aside_x + aside_y * aside_y - along * along / (1.0 + u * u + v * v)
        distance[i] = np.sqrt(np.maximum(squares, 0.0).sum() / max(k, 1))


@device(allocates=True)
def _crossings(e: FloatArray, depth: FloatArray, tangent: FloatArray, n: float) -> Crossings:
    """Return the crossings of rays with tan a in air through depths of water; s is 1 above it."""
    s = np.where(depth > 0.0, np.sqrt(n * n + (n * n - 1.0) * tangent * tangent), 1.0)
    return depth * (s - 1.0), -e[:, 0] / (e[:, 2] * s), -e[:, 1] / (e[:, 2] * s), s


def butler(batch: Batch) -> Intersection:
    """Multiply the apparent depth by tan r / tan i, in the mean over the images; only Z moves.

    Points with one ray are corrected too. The rays of a point cross its plumb line at different
    depths; `ray_miss_m` is their distance from the mean.

    Method I of Hsu & Wang, eq 1: with r the angle from the vertical of the line from the apparent
    point to the projection centre,

        h = h_A tan r / tan(asin(sin r / n))

    for one image; for more images the mean with equal weights. Straight below a
    camera, where that is 0 / 0, it has its limit n h_A. Over all cameras it is also the method of
    Dietrich (2017), "Bathymetric Structure-from-Motion", Earth Surface Processes and Landforms 42,
    355-364, as his program pyBathySfM computes it.

    The paper that they name it after (Butler, Lane, Chandler & Porfiri 2002, Photogrammetric Record
    17(99), 419-439) refracts both image rays of a stereo pair and intersects them again, which is
    `snell` with two cameras.

    Exact where all rays have the same incidence. Slanting rays determine the apparent depth more
    than steep ones, which a mean ignores: where incidences differ, the result is too shallow, by up
    to 1.5 % of the depth under nine nadir images (32 m apart, 80 m up) and by 4 % for one camera
    overhead and one at 32 degrees.
    """
    return _by_rays(batch, _MEAN)


def murase(batch: Batch) -> Intersection:
    """Take the depth from the X-parallax of each stereo pair of a point's images; only Z moves.

    Points whose pairs have almost no parallax are not corrected.

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
    return _by_rays(batch, _PAIRS)


@device
def _equal_x(e: FloatArray, rays: Crossings) -> tuple[float, bool]:
    """Return how far a point sinks by its pairs, and whether these determine it.

    With its slope q along the base and its crossing `below` the apparent point, a ray is
    q (z - below) from the plumb line at the depth z.
    """
    below, u, v, _ = rays
    products = squares = 0.0
    for a in range(below.size):
        for b in range(a + 1, below.size):
            # X is along the base of the pair
            x, y = e[b, 0] - e[a, 0], e[b, 1] - e[a, 1]
            base = np.hypot(x, y)
            if base == 0.0:
                continue
            q, q_other = (u[a] * x + v[a] * y) / base, (u[b] * x + v[b] * y) / base
            # least squares over the pairs: q (z - below) is the same for both rays
            parallax = q - q_other
            products += parallax * (q * below[a] - q_other * below[b])
            squares += parallax * parallax
    pairs = below.size * (below.size - 1) // 2
    sunk = products / squares
    return sunk, squares > 4.0 * pairs * MIN_DETERMINANT and sunk >= 0.0


def shan(batch: Batch) -> Intersection:
    """Intersect with the collinearity equations of the s-model; X, Y and Z move.

    Points whose refracted rays are nearer to parallel than a tenth of a degree, or for which the
    iteration finds no depth under the water, are not corrected.

    Shan (1994), "Relief reconstruction using two-media photogrammetry", as Skarlatos & Agrafiotis
    (2018, JMSE 6(3), 77, section 2.1.1, eqs 1-7) give it; their eq 2 lacks the root that eqs 1 and
    7 have. The image of the true point (X, Y) at the depth D is that of a point seen through air on
    the same vertical at the depth D / s, with

        s = tan a / tan b = sqrt(n^2 + (n^2 - 1) tan^2 a)        (eq 7)

    so that the collinearity equations hold with D / s for the depth (eq 3). Every image has its
    own s; two images give four equations for X, Y, D and two s. With s known they are linear.
    The iteration starts with s = 1, takes tan a from the point found, and with the s of eq 7
    solves again, until no tan a changes by more than `TOLERANCE`.

    Here the image ray is the line from the projection centre to the apparent point, as a cloud has
    no image coordinates; so the start is the apparent point itself, where the paper has eq 6 with
    Z = 0. The equations of any number of rays are solved together in least squares, as horizontal
    distances at the true depth; those of `snell` (eq 11) are distances from the rays, and the two
    agree where the rays intersect. Vertical rays leave the depth open.

    Exact where the straight rays meet in the apparent point: two cameras at the same incidence, or
    in one vertical plane with the point. Elsewhere a few iterations are enough.
    """
    return _by_rays(batch, _S_MODEL)


@device(allocates=True)
def _s_model(
    e: FloatArray, d: FloatArray, rays: Crossings, n: float
) -> tuple[float, float, float, bool]:
    """Return how far a point moves and sinks, and whether the iteration ends under the water.

    A refracted ray goes u and v metres aside per metre down. With s known, it meets the vertical of
    the true point, x aside and `sunk` below the apparent one, where

        x = u (sunk - below)

    and likewise for y and v: a straight line through the places (u, -u below) and (v, -v below), of
    which `sunk` is the slope with its sign changed.
    """
    x = y = sunk = 0.0
    tangent = np.hypot(e[:, 0], e[:, 1]) / e[:, 2]
    for _ in range(MOST_ITERATIONS):
        below, u, v, s = rays
        from_u, from_v = u - u.mean(), v - v.mean()
        spread = (from_u * from_u + from_v * from_v).sum()
        sunk = (below * (u * from_u + v * from_v)).sum() / spread
        # of two rays at a small angle alpha the spread is alpha^2 / 2
        if not (spread >= 2.0 * d.size * MIN_DETERMINANT and sunk + d.min() >= 0.0):
            return x, y, sunk, False
        x, y = (u * (sunk - below)).mean(), (v * (sunk - below)).mean()
        # tan a from the height of the camera over the point at the depth D / s
        following = np.hypot(x - e[:, 0], y - e[:, 1]) / (e[:, 2] - d + (d + sunk) / s)
        change, tangent = np.abs(following - tangent).max(), following
        rays = _crossings(e, d, tangent, n)
        if change <= TOLERANCE:
            break
    return x, y, sunk, True


NADIR_DEG = 15.0  # images that look further to the side do not count: the formula is for nadir
NODES = 100  # of the overlap, along each side; twice as many change no digit of five


@dataclass(frozen=True)
class StereoFactor:
    """A depth factor and the figures it was computed from."""

    factor: float  # ratio of true to apparent depth
    height_m: float  # flying height above the water, median
    base_m: float  # distance between neighbouring images in plan, median
    images: int  # nadir images
    aside: int  # images that look aside, which do not count

    def __str__(self) -> str:
        aside = (
            f" {self.aside} images are tilted by more than {NADIR_DEG:g} degrees; points from these"
            " need a larger factor."
        )
        return (
            f"Depth factor {self.factor:.4f}, from a flying height of {self.height_m:.2f} m above"
            f" the water and a base of {self.base_m:.2f} m (medians of {self.images} images)."
            f"{aside if self.aside else ''}"
        )


def stereo_factor(cameras: Cameras, level_m: float, n: float) -> StereoFactor:
    """Return the depth factor of the stereo pairs of a block, with angles and lenses, over water.

    Raises GeometryError if fewer than two images look down, or neighbours do not overlap.

    Mulsow (2024), "Methods for geometric modelling of refraction in photo-bathymetry", names a
    "correction factor calculated from camera setup (flying height, focal length, base length)" as
    the second practical approach, without a formula. This is how it is worked out here.

    Two images look straight down from the height H above the water; their base B runs along x. Seen
    from where the light of a bed point enters the air, the cameras lie by t_1 and t_2 to the side,
    vectors in plan in units of H, so that |t| is the tangent of the angle in air, and t_1x - t_2x
    is B / H. Under water the ray of camera i runs t_i / s_i to the side for each metre of depth,
    with

        s_i = tan(in air) / tan(in water) = sqrt(n^2 + (n^2 - 1) |t_i|^2),

    but software lets it go on by t_i. It puts the point where the two rays have one x, as parallax
    across the base tells nothing of depth: a true depth h becomes the apparent depth d with

        h (t_1x / s_1 - t_2x / s_2) = d (t_1x - t_2x)
        h / d = (B / H) / (t_1x / s_1 - t_2x / s_2)

    Midway between two cameras near each other that is n, as for cameras straight above. The factor
    is the mean of h / d over the overlap of both frames on the water, in which the focal length and
    the size of the frame say how far t reaches. Depths count as small against H. Where the images
    are more than a pair, or look aside, the cloud has another ratio.
    """
    from scipy.spatial import cKDTree

    rotations, lenses = np.asarray(cameras.rotations), cameras.lenses or ()
    flat = np.array([lens.projection == "perspective" for lens in lenses])
    rows = np.flatnonzero(flat & (-rotations[:, 2, 2] >= np.cos(np.radians(NADIR_DEG))))
    if len(rows) < 2:
        raise GeometryError(
            "cameras.no_stereo",
            f"Only {len(rows)} of {len(cameras)} images are nadir images (within {NADIR_DEG:g}"
            " degrees, no fisheye), and depth-factor auto needs two. Give a number.",
            nadir=len(rows),
        )
    centres = cameras.centres[rows]
    # the base in plan from each image to the nearest other place, and in the frame of its camera
    plan, place = np.unique(centres[:, :2].round(3), axis=0, return_inverse=True)
    near = np.asarray(cKDTree(plan).query(plan, k=[2])[1])[:, 0]
    to_next = (plan[np.minimum(near, len(plan) - 1)] - plan)[place.reshape(-1)]
    right, down, _ = np.abs(np.einsum("kij,kj->ik", rotations[rows, :, :2], to_next))
    height_m = float(np.median(centres[:, 2] - level_m))
    base_m = float(np.median(np.hypot(*to_next.T)))
    frames = np.array([(lenses[i].focal, lenses[i].width, lenses[i].height) for i in rows])
    tangents = np.median(frames[:, 1:] / frames[:, :1], axis=0) / 2.0
    along, across = tangents[::-1] if np.median(right) < np.median(down) else tangents
    relative = base_m / height_m
    if not 0.0 < relative < 2.0 * along:
        raise GeometryError(
            "cameras.no_overlap",
            f"Neighbouring images, {base_m:.2f} m apart and {height_m:.2f} m above the water, do"
            " not overlap, as depth-factor auto needs. Check cameras and water, or give a number.",
            base_m=base_m,
            height_m=height_m,
        )
    factor = float(ratios(relative, along, across, n).mean())
    return StereoFactor(factor, height_m, base_m, len(rows), len(cameras) - len(rows))


def ratios(relative_base: float, along: float, across: float, n: float) -> FloatArray:
    """Return the ratio of true to apparent depth over the overlap of a pair.

    `relative_base` is the base by the flying height; `along` and `across` are half the sides of the
    frame by the focal length. The result, shape (NODES, NODES), is for the middles of cells.
    """
    middles = (np.arange(NODES) + 0.5) / NODES * 2.0 - 1.0
    x, y = np.meshgrid(middles * (along - relative_base / 2.0), middles * across)
    left, right = x + relative_base / 2.0, x - relative_base / 2.0
    s_1, s_2 = (np.sqrt(n * n + (n * n - 1.0) * (t * t + y * y)) for t in (left, right))
    return np.asarray(relative_base / (left / s_1 - right / s_2))

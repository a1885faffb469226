"""Compute the depth factor of a stereo pair from flying height, focal length and base.

Mulsow (2024), "Methods for geometric modelling of refraction in photo-bathymetry", names a
"correction factor calculated from camera setup (flying height, focal length, base length)" as the
second practical approach, without a formula. This is how it is worked out here.

Two images look straight down from the height H above the water; their base B runs along x. Seen
from where the light of a bed point enters the air, the cameras lie by t_1 and t_2 to the side,
vectors in plan in units of H, so that |t| is the tangent of the angle in air, and t_1x - t_2x is
B / H. Under water the ray of camera i runs t_i / s_i to the side for each metre of depth, with

    s_i = tan(in air) / tan(in water) = sqrt(n^2 + (n^2 - 1) |t_i|^2),

but software lets it go on by t_i. It puts the point where the two rays have one x, as parallax
across the base tells nothing of depth: a true depth h becomes the apparent depth d with

    h (t_1x / s_1 - t_2x / s_2) = d (t_1x - t_2x),     h / d = (B / H) / (t_1x / s_1 - t_2x / s_2).

Midway between two cameras near each other that is n, as for cameras straight above. The factor is
the mean of h / d over the overlap of both frames on the water, in which the focal length and the
size of the frame say how far t reaches. Depths count as small against H. Where the images are more
than a pair, or look aside, the cloud has another ratio.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.errors import GeometryError
from pcfix.model import Cameras, FloatArray
from pcfix.refract.batch import require_orientation

NADIR_DEG = 15.0
"""An image that looks further to the side does not count: the formula is of vertical ones."""
NODES = 100
"""Of the overlap, along each side; the mean is the same to five digits with twice as many."""


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
            f" {self.aside} images look aside by more than {NADIR_DEG:g} degrees; points from these"
            " need a larger factor."
        )
        return (
            f"Depth factor {self.factor:.4f}, from a flying height of {self.height_m:.2f} m above"
            f" the water and a base of {self.base_m:.2f} m (medians of {self.images} images)."
            f"{aside if self.aside else ''}"
        )


def stereo_factor(cameras: Cameras, level_m: float, n: float) -> StereoFactor:
    """Return the depth factor of the stereo pairs of a block over water of a level.

    Raises GeometryError if fewer than two images look down, or neighbours do not overlap.
    """
    from scipy.spatial import cKDTree

    require_orientation(cameras, "depth-factor auto")
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
    way = (plan[np.minimum(near, len(plan) - 1)] - plan)[place.reshape(-1)]
    right, down, _ = np.abs(np.einsum("kij,kj->ik", rotations[rows, :, :2], way))
    height_m, base_m = float(np.median(centres[:, 2] - level_m)), float(np.median(np.hypot(*way.T)))
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

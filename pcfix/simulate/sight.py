"""Which images show which points, and where straight rays through their pixels intersect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.model import Cameras, FloatArray, IntArray
from pcfix.simulate.settings import Optics
from pcfix.simulate.terrain import Terrain
from pcfix.simulate.tracing import Water, project, rotations_of, triangulate

LEAST_VIEWS = 3


def starts(counts: IntArray) -> IntArray:
    """Return where the rows of each point begin, and the end, from their numbers."""
    return np.concatenate([[0], np.cumsum(counts)])


@dataclass(frozen=True, eq=False)
class Site:
    """Ground, water and images of a scene in local coordinates, and its random numbers.

    `true` are the poses of the images, `given` those for the intersection, and the angles are yaw,
    pitch and roll, degrees, shape (k, 3). Nothing is below `lowest_m`. What is detected has random
    numbers of its own, `luck`.
    """

    terrain: Terrain
    true: Cameras
    true_angles: FloatArray
    given: Cameras
    given_angles: FloatArray
    optics: Optics
    water: Water
    lowest_m: float
    image_noise_px: float
    detection: float
    rng: np.random.Generator
    luck: np.random.Generator

    def observed(self, ideal: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return ideal pixels as measured: noise is on the image, which is then undistorted.

        Dense matchers and the rays of tie points use undistorted images too.
        """
        image = self.optics.to_image(ideal)
        return self.optics.to_ideal(image + rng.normal(0.0, self.image_noise_px, image.shape))


@dataclass(frozen=True, eq=False)
class Sight:
    """The m pairs of one of n points and an image that shows it, sorted by point, then camera.

    Point i of `truth`, shape (n, 3), has the pairs from ``start[i]`` to ``start[i + 1]``; `ideal`,
    shape (m, 2), are ideal pixels without noise.
    """

    site: Site
    truth: FloatArray
    start: IntArray
    point: IntArray
    camera: IntArray
    ideal: FloatArray

    @property
    def paired(self) -> np.ndarray:
        """Which points have pairs, shape (n,)."""
        return np.asarray(np.diff(self.start) > 0)

    def intersected(self, pixels: FloatArray) -> FloatArray:
        """Return where straight rays through ideal pixels, (m, 2), meet with least residuals.

        Shape (n, 3); a point without pairs stays where it is.
        """
        paired, apparent = self.paired, self.truth.copy()
        if paired.any():
            starts = np.concatenate([self.start[:-1][paired], self.start[-1:]])
            apparent[paired] = triangulate(
                pixels,
                self.site.given,
                self.camera,
                starts,
                self.site.optics.lens,
                apparent[paired],
            )
        return apparent


def see(truth: FloatArray, site: Site, rng: np.random.Generator) -> Sight:
    """Trace every point, shape (n, 3), into every image; those in fewer than three have no pairs.

    `rng` says what is detected; the luckiest three images of a point always are.
    """
    cameras = site.true
    # how far from below each camera it can see anything: the most oblique ray of the frame's
    # corner, prolonged as if there were no refraction
    off_nadir = np.arccos(np.clip(-rotations_of(cameras)[:, 2, 2], -1.0, 1.0))
    widest = np.minimum(np.arctan(site.optics.reach) + off_nadir, np.radians(80.0))
    reach = (cameras.centres[:, 2] - site.lowest_m) * np.tan(widest)
    across = truth[:, None, 0] - cameras.centres[:, 0], truth[:, None, 1] - cameras.centres[:, 1]
    point, camera = np.nonzero(np.hypot(*across) < reach)
    surface = site.water.piercing_points(truth[point], cameras.centres[camera], camera)
    ideal, z = project(surface, cameras, camera, site.optics.lens)
    inside = (z > 0) & site.optics.frames(site.optics.to_image(ideal))
    point, camera, ideal = point[inside], camera[inside], ideal[inside]
    taken = np.bincount(point, minlength=len(truth))[point] >= LEAST_VIEWS
    if site.detection < 1.0:
        luck = rng.uniform(0.0, 1.0, len(point))
        rank = np.empty(len(point), np.int64)
        rank[np.lexsort((luck, point))] = np.arange(len(point)) - np.searchsorted(point, point)
        taken &= (luck < site.detection) | (rank < LEAST_VIEWS)
    point, camera, ideal = point[taken], camera[taken], ideal[taken]
    return Sight(
        site, truth, starts(np.bincount(point, minlength=len(truth))), point, camera, ideal
    )

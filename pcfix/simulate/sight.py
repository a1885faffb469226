"""Which images show which points, and where: what every kind of cloud is made from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pcfix.simulate.block import reach_m
from pcfix.simulate.tracing import project

if TYPE_CHECKING:
    from pcfix.model import Cameras, FloatArray, IntArray
    from pcfix.simulate.optics import Optics
    from pcfix.simulate.water import Water

LEAST_VIEWS = 3


@dataclass(frozen=True, eq=False)
class Rig:
    """All that the images are made with and the software is given.

    Attributes
    ----------
    true, given : Cameras
        The poses of the images, and those that the cloud is intersected with.
    optics : Optics
    water : Water
    lowest_m : float
        Nothing is below this height.
    image_noise_px, detection : float
    """

    true: Cameras
    given: Cameras
    optics: Optics
    water: Water
    lowest_m: float
    image_noise_px: float
    detection: float

    def observed(self, ideal: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return ideal pixels as measured: noise is on the image, which is then undistorted.

        Dense matchers and the rays of tie points use undistorted images too.
        """
        image = self.optics.to_image(ideal)
        return self.optics.to_ideal(image + rng.normal(0.0, self.image_noise_px, image.shape))


@dataclass(frozen=True, eq=False)
class Sight:
    """Pairs of a point and an image that shows it, sorted by point, then camera.

    Attributes
    ----------
    start : array, shape (n + 1,)
        Point i has the pairs from ``start[i]`` to ``start[i + 1]``.
    point, camera : array, shape (m,)
    ideal : array, shape (m, 2)
        Where the image shows it, ideal pixels without noise.
    """

    start: IntArray
    point: IntArray
    camera: IntArray
    ideal: FloatArray

    @property
    def made(self) -> np.ndarray:
        """Which points have pairs, shape (n,)."""
        return np.asarray(np.diff(self.start) > 0)

    def rows(self, cameras: int) -> IntArray:
        """Return the row of each point and camera, shape (n, cameras), -1 where there is none."""
        rows = np.full((len(self.start) - 1, cameras), -1)
        rows[self.point, self.camera] = np.arange(len(self.point))
        return rows


def see(truth: FloatArray, rig: Rig, rng: np.random.Generator) -> Sight:
    """Trace every point into every image; points in fewer than three have no pairs.

    Parameters
    ----------
    truth : array, shape (n, 3)
    rig : Rig
    rng : Generator
        Of detection.
    """
    cameras = rig.true
    across = truth[:, None, 0] - cameras.centres[:, 0], truth[:, None, 1] - cameras.centres[:, 1]
    reach = reach_m(cameras, rig.lowest_m, 0.0, rig.optics)
    point, camera = np.nonzero(np.hypot(*across) < reach)
    surface = rig.water.piercing_points(truth[point], cameras.centres[camera], camera)
    ideal, z = project(surface, cameras, camera, rig.optics.lens)
    inside = (z > 0) & rig.optics.frames(ideal, rig.optics.to_image(ideal))
    point, camera, ideal = point[inside], camera[inside], ideal[inside]
    taken = _detected(point, rig.detection, rng)
    taken &= np.bincount(point, minlength=len(truth))[point] >= LEAST_VIEWS
    point, camera, ideal = point[taken], camera[taken], ideal[taken]
    start = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(truth)))])
    return Sight(start, point, camera, ideal)


def _detected(point: IntArray, probability: float, rng: np.random.Generator) -> np.ndarray:
    """Return which pairs take part: by chance, but the luckiest three of a point always."""
    if probability >= 1.0:
        return np.ones(len(point), bool)
    luck = rng.uniform(0.0, 1.0, len(point))
    order = np.lexsort((luck, point))
    first = np.searchsorted(point, point)  # the row at which each pair's point begins
    rank = np.empty(len(point), np.int64)
    rank[order] = np.arange(len(point)) - first
    return np.asarray((luck < probability) | (rank < LEAST_VIEWS))

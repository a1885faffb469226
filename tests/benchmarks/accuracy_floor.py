"""The noise floor of `accuracy.py`: triangulation through the water by the images themselves.

Nothing of `pcfix.refract` is used: light takes Fermat's path (`pcfix.simulate.tracing`), and the
derivatives are differences.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pcfix.simulate.tracing import piercing_points_of_planes, project

STEP_M = 1e-4
CONVERGED_M = 1e-6
MOST_STEPS = 10


def triangulated_again(
    truth: np.ndarray, views: Any, cameras: Any, water: Any, n: float, noise_px: float, rng: Any
) -> np.ndarray:
    """Return the points whose images through a plane surface are nearest to noisy ones.

    Gauss-Newton for all points at once, from the truth. The images have one lens, without
    distortion.

    Parameters
    ----------
    truth : array, shape (m, 3)
        Submerged, metres, world frame.
    views : Views
        The images of each, two at least.
    cameras : Cameras
        Those that the images were made with.
    water : WaterPlane
    n, noise_px : float
    rng : Generator

    Returns
    -------
    array, shape (m, 3)
    """
    owner = np.repeat(np.arange(len(truth)), np.diff(views.start))
    plane = _near_plane(water, truth)

    def images(points: np.ndarray) -> np.ndarray:
        return _images(points[owner], cameras, views.camera, plane, n)

    seen = images(truth)
    seen = seen + rng.normal(0.0, noise_px, seen.shape)
    points, aside = truth.copy(), STEP_M * np.eye(3)
    for _ in range(MOST_STEPS):
        slopes = [(images(points + d) - images(points - d)) / (2.0 * STEP_M) for d in aside]
        slope, residual = np.stack(slopes, axis=2), seen - images(points)
        left = np.add.reduceat(np.einsum("rki,rkj->rij", slope, slope), views.start[:-1])
        right = np.add.reduceat(np.einsum("rki,rk->ri", slope, residual), views.start[:-1])
        step = np.linalg.solve(left, right[:, :, None])[:, :, 0]
        points = points + step
        if np.abs(step).max() < CONVERGED_M:
            return points
    raise ArithmeticError("the triangulation through the water does not converge")


def _near_plane(water: Any, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a point of the plane, near the points as digits are lost far away, and its normal."""
    x, y = points[:, :2].mean(axis=0)
    anchor = np.array([x, y, water.a + water.b * x + water.c * y])
    return anchor, np.array([-water.b, -water.c, 1.0]) / np.sqrt(1.0 + water.b**2 + water.c**2)


def _images(
    points: np.ndarray, cameras: Any, camera: np.ndarray, plane: tuple[Any, Any], n: float
) -> np.ndarray:
    """Return where images show points, one each, through the water; pixels, shape (r, 2)."""
    anchor, normal = (np.broadcast_to(part, points.shape) for part in plane)
    way = piercing_points_of_planes(points, cameras.centres[camera], anchor, normal, n)
    return project(way, cameras, camera, cameras.lenses[0])[0]

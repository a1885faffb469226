"""From a true point through a level water surface into images, and what SfM makes of it.

The piercing point of the ray from object to camera is where Fermat's principle puts it: the
root of Snell's law along the line between their feet, found by a safeguarded Newton iteration.
Nothing here is shared with the correction; it goes the other way and uses other mathematics.

All arrays are flat over (point, camera) pairs, sorted by point.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pcfix.model import Cameras, FloatArray, IntArray, Lens

_NEWTON_STEPS = 60
_CONVERGED_M = 1e-11


def piercing_points(
    points: FloatArray, centres: FloatArray, water_level_m: float, refractive_index: float
) -> FloatArray:
    """Return where the light from each point to its camera passes the level surface.

    Parameters
    ----------
    points, centres : array, shape (m, 3)
        Object point and projection centre of each pair. A point above the water is its own
        "piercing point": its light goes straight.

    Returns
    -------
    array, shape (m, 3)

    Raises
    ------
    ArithmeticError
        If the iteration does not converge.
    """
    depth = water_level_m - points[:, 2]
    wet = depth > 0.0
    foot = points[wet, :2] - centres[wet, :2]
    reach = np.hypot(*foot.T)
    height, depth = centres[wet, 2] - water_level_m, depth[wet]
    along = _root_of_snell(reach, height, depth, refractive_index)
    surface = points.copy()
    share = np.divide(along, reach, out=np.zeros_like(along), where=reach > 0.0)
    surface[wet, :2] = centres[wet, :2] + foot * share[:, None]
    surface[wet, 2] = water_level_m
    return surface


def _root_of_snell(
    reach: FloatArray, height: FloatArray, depth: FloatArray, n: float
) -> FloatArray:
    """Return x in [0, reach] with x/|(x, H)| = n (D - x)/|(D - x, h)|; the difference rises."""
    low, high = np.zeros_like(reach), reach.copy()
    x = reach * height / (height + depth / n)
    for _ in range(_NEWTON_STEPS):
        rest = reach - x
        air, water = np.hypot(x, height), np.hypot(rest, depth)
        value = x / air - n * rest / water
        low, high = np.where(value < 0.0, x, low), np.where(value < 0.0, high, x)
        step = value / (height**2 / air**3 + n * depth**2 / water**3)
        following = x - step
        following = np.where((following < low) | (following > high), (low + high) / 2.0, following)
        moved = np.abs(following - x).max(initial=0.0)
        x = following
        if moved < _CONVERGED_M:
            return x
    raise ArithmeticError("the piercing point was not found")


def project(
    targets: FloatArray, cameras: Cameras, camera: IntArray, lens: Lens
) -> tuple[FloatArray, FloatArray]:
    """Return pixels, shape (m, 2), and the depth along the optical axis, shape (m,)."""
    if cameras.rotations is None:
        raise ValueError("projection needs cameras with angles")
    ray = targets - cameras.centres[camera]
    x, y, z = np.einsum("mij,mj->im", cameras.rotations[camera], ray)
    u = lens.focal * x / z + lens.principal_x
    v = lens.focal * y / z + lens.principal_y
    return np.column_stack([u, v]), z


def triangulate(
    pixels: FloatArray,
    cameras: Cameras,
    camera: IntArray,
    start: IntArray,
    lens: Lens,
    guess: FloatArray,
) -> FloatArray:
    """Return what software that knows nothing of water makes of image points.

    The point with the least squared reprojection errors over straight rays, by Gauss-Newton.

    Parameters
    ----------
    pixels : array, shape (m, 2)
    camera : array, shape (m,)
    start : array, shape (n + 1,)
        Point i has the pairs from ``start[i]`` to ``start[i + 1]``, two at least.
    guess : array, shape (n, 3)

    Returns
    -------
    array, shape (n, 3)
    """
    if cameras.rotations is None:
        raise ValueError("triangulation needs cameras with angles")
    rows = cameras.rotations[camera]
    owner = np.repeat(np.arange(len(start) - 1), np.diff(start))
    points = guess.copy()
    for _ in range(20):
        seen, z = project(points[owner], cameras, camera, lens)
        offset = (seen - [lens.principal_x, lens.principal_y]) / lens.focal
        scale = (lens.focal / z)[:, None]
        jacobian = [scale * (rows[:, i] - offset[:, i : i + 1] * rows[:, 2]) for i in (0, 1)]
        residual = pixels - seen
        normal, right = np.empty((len(points), 3, 3)), np.empty((len(points), 3))
        for i in range(3):
            for j in range(i, 3):
                total = (
                    jacobian[0][:, i] * jacobian[0][:, j] + jacobian[1][:, i] * jacobian[1][:, j]
                )
                normal[:, i, j] = normal[:, j, i] = np.add.reduceat(total, start[:-1])
            right[:, i] = np.add.reduceat(
                jacobian[0][:, i] * residual[:, 0] + jacobian[1][:, i] * residual[:, 1], start[:-1]
            )
        step = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        points += step
        if np.abs(step).max() < 1e-7:
            break
    return points

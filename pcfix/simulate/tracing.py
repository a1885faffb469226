"""Rays from true points through the water surface into images, and their straight intersection.

The piercing point follows from Fermat's principle: it is the root of Snell's law along the line
between the feet of object and camera, found by a safeguarded Newton iteration. Nothing here is
shared with the correction, which traces in the other direction by other mathematics. The surface is
a plane, level or tilted.

Arrays are flat over the m (point, camera) pairs, sorted by point: metres, shape (m, 3), unless
stated otherwise.
"""

import numpy as np

from pcfix.model import Cameras, FloatArray, IntArray, Lens, WaterPlane


def anchors_and_normals(plane: WaterPlane, count: int) -> tuple[FloatArray, FloatArray]:
    """Return a point of a plane and its unit normal, each of shape (count, 3)."""
    up = np.array([-plane.b, -plane.c, 1.0])
    up /= np.linalg.norm(up)
    anchor = np.array([0.0, 0.0, plane.a])
    return np.broadcast_to(anchor, (count, 3)), np.broadcast_to(up, (count, 3))


def piercing_points_of_planes(
    points: FloatArray, centres: FloatArray, anchors: FloatArray, normals: FloatArray,
    refractive_index: float,
) -> FloatArray:  # fmt: skip
    """Return where the light from each point to its camera passes a plane, (m, 3).

    `anchors` and `normals` are a point of each pair's plane and its unit normal, away from the
    water. A point above the water is its own piercing point.
    """
    depth = np.einsum("mi,mi->m", anchors - points, normals)
    wet = depth > 0.0
    n, depth = normals[wet], depth[wet]
    height = np.einsum("mi,mi->m", centres[wet] - anchors[wet], n)
    below_camera = centres[wet] - height[:, None] * n
    foot = points[wet] + depth[:, None] * n - below_camera
    reach = np.sqrt(np.einsum("mi,mi->m", foot, foot))
    along = _root_of_snell(reach, height, depth, refractive_index)
    share = np.divide(along, reach, out=np.zeros_like(along), where=reach > 0.0)
    surface = points.copy()
    surface[wet] = below_camera + foot * share[:, None]
    return surface


def _root_of_snell(
    reach: FloatArray, height: FloatArray, depth: FloatArray, n: float
) -> FloatArray:
    """Return x in [0, reach] with x/|(x, H)| = n (D - x)/|(D - x, h)|; the difference rises."""
    low, high = np.zeros_like(reach), reach.copy()
    x = reach * height / (height + depth / n)
    for _ in range(60):
        rest = reach - x
        air, water = np.hypot(x, height), np.hypot(rest, depth)
        value = x / air - n * rest / water
        low, high = np.where(value < 0.0, x, low), np.where(value < 0.0, high, x)
        # Newton by the derivative of the difference, or a bisection where that leaves the bracket
        step = value / (height**2 / air**3 + n * depth**2 / water**3)
        following = x - step
        following = np.where((following < low) | (following > high), (low + high) / 2.0, following)
        moved = np.abs(following - x).max(initial=0.0)
        x = following
        if moved < 1e-11:  # metres
            return x
    raise ArithmeticError("the piercing point was not found")


def project(
    targets: FloatArray, cameras: Cameras, camera: IntArray, lens: Lens
) -> tuple[FloatArray, FloatArray]:
    """Return pixels, shape (m, 2), and the depth along the optical axis, shape (m,)."""
    ray = targets - cameras.centres[camera]
    x, y, z = np.einsum("mij,mj->im", np.asarray(cameras.rotations)[camera], ray)
    u = lens.focal * x / z + lens.principal_x
    v = lens.focal * y / z + lens.principal_y
    return np.column_stack([u, v]), z


def triangulate(
    pixels: FloatArray, cameras: Cameras, camera: IntArray, start: IntArray, lens: Lens,
    guess: FloatArray,
) -> FloatArray:  # fmt: skip
    """Intersect straight rays through image points: least squared reprojection errors.

    Gauss-Newton from a guess, shape (n, 3). Point i has the pairs from ``start[i]`` to
    ``start[i + 1]``, at least two.
    """
    rows = np.asarray(cameras.rotations)[camera]
    owner = np.repeat(np.arange(len(start) - 1), np.diff(start))
    points = guess.copy()
    for _ in range(20):
        seen, z = project(points[owner], cameras, camera, lens)
        offset = (seen - [lens.principal_x, lens.principal_y]) / lens.focal
        scale = (lens.focal / z)[:, None]
        # the gradients of both image coordinates by the place of the point
        u, v = (scale * (rows[:, i] - offset[:, i : i + 1] * rows[:, 2]) for i in (0, 1))
        residual = pixels - seen
        products = u[:, :, None] * u[:, None] + v[:, :, None] * v[:, None]
        normal = np.add.reduceat(products, start[:-1])
        right = np.add.reduceat(u * residual[:, :1] + v * residual[:, 1:], start[:-1])
        step = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        points += step
        if np.abs(step).max(initial=0.0) < 1e-7:
            break
    return points

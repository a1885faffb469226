"""From a true point through a plane water surface into images, and what SfM makes of it.

The piercing point of the ray from object to camera is where Fermat's principle puts it: the
root of Snell's law along the line between their feet, found by a safeguarded Newton iteration.
Nothing here is shared with the correction; it goes the other way and uses other mathematics.

The surface is a plane, level or tilted, with waves that each image sees anew. Waves are normals, no
heights. At the moment of an image the surface near the place where its light would pass the mean
plane is the plane through that place whose normal is tilted by the slope of a random field; the
light takes the least optical path through this tangent plane. So Snell's law holds exactly with the
tilted normal. Left out are the height of the waves and their curvature within the few centimetres
by which they move the crossing, so that no caustics arise.

All arrays are flat over the m (point, camera) pairs, sorted by point: metres, shape (m, 3), where
nothing else is said.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.model import Cameras, FloatArray, IntArray, Lens, WaterPlane

_NEWTON_STEPS = 60
_CONVERGED_M = 1e-11


def piercing_points(
    points: FloatArray, centres: FloatArray, water_level_m: float, refractive_index: float
) -> FloatArray:
    """Return where the light from each point to its camera passes the level surface, (m, 3).

    A point above the water is its own "piercing point": its light goes straight.

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


def piercing_points_of_planes(
    points: FloatArray,
    centres: FloatArray,
    anchors: FloatArray,
    normals: FloatArray,
    refractive_index: float,
) -> FloatArray:
    """Return where the light from each point to its camera passes a plane of any attitude, (m, 3).

    The picture is that of `piercing_points` with the plane's normal for the plumb line: the feet
    of both on the plane, and the root of Snell's law between them. `anchors` and `normals` are a
    point of each pair's plane and its unit normal, away from the water.
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


def bed_points(
    centres: FloatArray,
    directions: FloatArray,
    water: tuple[FloatArray, FloatArray],
    bed: tuple[FloatArray, FloatArray],
    refractive_index: float,
) -> FloatArray:
    """Return what each camera sees along a ray: where it meets the bed, bent at the water, (m, 3).

    Directions are of any length; `water` and `bed` are a point of each ray's water plane and of its
    bed plane, and their unit normals. A ray that meets the bed above the water is straight.
    """
    (anchors, normals), (places, bed_normals) = water, bed
    straight = _on_plane(centres, directions, places, bed_normals)
    wet = np.einsum("mi,mi->m", straight - anchors, normals) < 0.0
    surface = _on_plane(centres[wet], directions[wet], anchors[wet], normals[wet])
    unit = directions[wet] / np.linalg.norm(directions[wet], axis=1)[:, None]
    down = np.einsum("mi,mi->m", unit, normals[wet])[:, None]
    # Snell: the part along the surface shrinks by n, the rest is what a unit vector has left
    sideways = (unit - down * normals[wet]) / refractive_index
    rest = np.sqrt(1.0 - np.einsum("mi,mi->m", sideways, sideways))[:, None]
    bent = sideways - rest * normals[wet]
    straight[wet] = _on_plane(surface, bent, places[wet], bed_normals[wet])
    return straight


def _on_plane(
    origins: FloatArray, directions: FloatArray, anchors: FloatArray, normals: FloatArray
) -> FloatArray:
    gap = np.einsum("mi,mi->m", anchors - origins, normals)
    speed = np.einsum("mi,mi->m", directions, normals)
    return np.asarray(origins + (gap / speed)[:, None] * directions)


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


def rotations_of(cameras: Cameras) -> FloatArray:
    """Return the rotations of simulated cameras, which all have them."""
    if cameras.rotations is None:
        raise ValueError("simulated images need cameras with angles")
    return cameras.rotations


def project(
    targets: FloatArray, cameras: Cameras, camera: IntArray, lens: Lens
) -> tuple[FloatArray, FloatArray]:
    """Return pixels, shape (m, 2), and the depth along the optical axis, shape (m,)."""
    ray = targets - cameras.centres[camera]
    x, y, z = np.einsum("mij,mj->im", rotations_of(cameras)[camera], ray)
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

    The points, shape (n, 3), with the least squared reprojection errors over straight rays, by
    Gauss-Newton from a guess. Point i has the pairs from ``start[i]`` to ``start[i + 1]``, two at
    least.
    """
    rows = rotations_of(cameras)[camera]
    owner = np.repeat(np.arange(len(start) - 1), np.diff(start))
    points = guess.copy()
    for _ in range(20):
        seen, z = project(points[owner], cameras, camera, lens)
        offset = (seen - [lens.principal_x, lens.principal_y]) / lens.focal
        scale = (lens.focal / z)[:, None]
        u, v = (scale * (rows[:, i] - offset[:, i : i + 1] * rows[:, 2]) for i in (0, 1))
        residual_u, residual_v = (pixels - seen).T
        normal, right = np.empty((len(points), 3, 3)), np.empty((len(points), 3))
        for i in range(3):
            for j in range(i, 3):
                product = u[:, i] * u[:, j] + v[:, i] * v[:, j]
                normal[:, i, j] = normal[:, j, i] = np.add.reduceat(product, start[:-1])
            product = u[:, i] * residual_u + v[:, i] * residual_v
            right[:, i] = np.add.reduceat(product, start[:-1])
        step = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        points += step
        if np.abs(step).max(initial=0.0) < 1e-7:
            break
    return points


_COMPONENTS = 8
"""Sinusoids of a field; with so many, slopes are nearly normally distributed."""


@dataclass(frozen=True, eq=False)
class Waves:
    """A field of slopes for each of k images, as a sum of c sinusoids of one wavelength.

    wave_numbers : shape (k, c, 2), radians per metre along the two axes of the mean plane.
    phases : shape (k, c).
    steepness : amplitude of the slope of each sinusoid.
    """

    wave_numbers: FloatArray
    phases: FloatArray
    steepness: float

    @classmethod
    def random(
        cls, cameras: int, slope_deg: float, wavelength_m: float, rng: np.random.Generator
    ) -> Waves:
        """Draw fields whose slope along any axis has the standard deviation asked for.

        Directions are spread evenly over the half circle, beginning anywhere: then the variance
        along either axis is ``components * steepness^2 / 4``.
        """
        first = rng.uniform(0.0, 1.0, (cameras, 1))
        angle = np.pi * (first + np.arange(_COMPONENTS)) / _COMPONENTS
        phases = rng.uniform(0.0, 2.0 * np.pi, (cameras, _COMPONENTS))
        number = 2.0 * np.pi / wavelength_m
        towards = np.stack([np.cos(angle), np.sin(angle)], axis=2)
        steepness = 2.0 * np.tan(np.radians(slope_deg)) / np.sqrt(_COMPONENTS)
        return cls(number * towards, phases, float(steepness))

    def slopes(self, camera: IntArray, at: FloatArray) -> FloatArray:
        """Return the slopes along both axes, shape (m, 2), at places of the plane, (m, 2)."""
        slopes = np.zeros(at.shape)
        for i in range(_COMPONENTS):
            number = self.wave_numbers[camera, i]
            phase = (number * at).sum(axis=1) + self.phases[camera, i]
            size = self.steepness / np.hypot(*number.T)
            slopes -= (size * np.sin(phase))[:, None] * number
        return slopes


@dataclass(frozen=True, eq=False)
class Water:
    """The surface that light is traced through: its mean, in the frame of the points, and waves."""

    plane: WaterPlane
    refractive_index: float
    waves: Waves | None = None

    @property
    def normal(self) -> FloatArray:
        """Unit normal of the mean surface, up."""
        up = np.array([-self.plane.b, -self.plane.c, 1.0])
        return np.asarray(up / np.linalg.norm(up))

    def piercing_points(
        self, points: FloatArray, centres: FloatArray, camera: IntArray
    ) -> FloatArray:
        """Return where the light from each point to its camera passes the surface, (m, 3).

        A point above the mean plane is its own "piercing point".
        """
        if self.waves is None and self.plane.b == self.plane.c == 0.0:
            return piercing_points(points, centres, self.plane.a, self.refractive_index)
        anchors, normals = self.tangent_planes(points, centres, camera)
        return piercing_points_of_planes(points, centres, anchors, normals, self.refractive_index)

    def tangent_planes(
        self, points: FloatArray, centres: FloatArray, camera: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the plane that the light of each pair passes: a point of it and the unit normal.

        All are of shape (m, 3); `camera`, shape (m,), says whose waves there are.
        """
        shape = points.shape
        anchor = np.array([0.0, 0.0, self.plane.a])
        anchors, normals = np.broadcast_to(anchor, shape), np.broadcast_to(self.normal, shape)
        if self.waves is None:
            return anchors, normals
        at = piercing_points_of_planes(points, centres, anchors, normals, self.refractive_index)
        wet = (points - anchor) @ self.normal < 0.0
        east = np.array([1.0, 0.0, self.plane.b])
        east /= np.linalg.norm(east)
        north = np.cross(self.normal, east)
        places = (at - anchor) @ np.column_stack([east, north])
        slopes = self.waves.slopes(camera, places)
        rough = self.normal - slopes[:, :1] * east - slopes[:, 1:] * north
        rough /= np.linalg.norm(rough, axis=1)[:, None]
        return np.where(wet[:, None], at, anchors), np.where(wet[:, None], rough, normals)

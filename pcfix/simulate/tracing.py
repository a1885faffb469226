"""Rays from true points through the water surface into images, and their straight intersection.

The piercing point follows from Fermat's principle: it is the root of Snell's law along the line
between the feet of object and camera, found by a safeguarded Newton iteration. Nothing here is
shared with the correction, which traces in the other direction by other mathematics.

The surface is a plane, level or tilted, with waves that differ from image to image. A wave is a
tilt of the tangent plane where the light would pass the mean plane; the light takes the least
optical path through the tangent plane, so Snell's law holds exactly there. The height of the waves
and their curvature within the few centimetres of this shift are neglected, so there are no
caustics.

Arrays are flat over the m (point, camera) pairs, sorted by point: metres, shape (m, 3), unless
stated otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.model import Cameras, FloatArray, IntArray, Lens, WaterPlane

_NEWTON_STEPS = 60
_CONVERGED_M = 1e-11


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
    pixels: FloatArray, cameras: Cameras, camera: IntArray, start: IntArray, lens: Lens,
    guess: FloatArray,
) -> FloatArray:  # fmt: skip
    """Intersect straight rays through image points: least squared reprojection errors.

    Gauss-Newton from a guess, shape (n, 3). Point i has the pairs from ``start[i]`` to
    ``start[i + 1]``, at least two.
    """
    rows = rotations_of(cameras)[camera]
    owner = np.repeat(np.arange(len(start) - 1), np.diff(start))
    points = guess.copy()
    for _ in range(20):
        seen, z = project(points[owner], cameras, camera, lens)
        offset = (seen - [lens.principal_x, lens.principal_y]) / lens.focal
        scale = (lens.focal / z)[:, None]
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


_COMPONENTS = 8
"""Sinusoids of a field: enough that slopes are nearly normally distributed."""


@dataclass(frozen=True, eq=False)
class Waves:
    """A field of slopes for each of k images, the sum of c sinusoids of one wavelength.

    `wave_numbers`, shape (k, c, 2), are in radians per metre along the axes of the mean plane;
    `steepness` is the amplitude of the slope of each sinusoid.
    """

    wave_numbers: FloatArray
    phases: FloatArray
    steepness: float

    @classmethod
    def random(
        cls, cameras: int, slope_deg: float, wavelength_m: float, rng: np.random.Generator
    ) -> Waves:
        """Draw fields whose slope along any axis has the given standard deviation.

        Directions are evenly spread over the half circle, so the variance along either axis is
        ``components * steepness^2 / 4``.
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

    def piercing_points(
        self, points: FloatArray, centres: FloatArray, camera: IntArray
    ) -> FloatArray:
        """Return where the light from each point to its camera passes the surface, (m, 3)."""
        anchors, normals = self.tangent_planes(points, centres, camera)
        return piercing_points_of_planes(points, centres, anchors, normals, self.refractive_index)

    def tangent_planes(
        self, points: FloatArray, centres: FloatArray, camera: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return a point and the unit normal of the plane that the light of each pair passes.

        Both have the shape (m, 3); `camera`, shape (m,), selects the waves.
        """
        shape = points.shape
        anchor = np.array([0.0, 0.0, self.plane.a])
        up = np.array([-self.plane.b, -self.plane.c, 1.0])  # normal of the mean surface
        up /= np.linalg.norm(up)
        anchors, normals = np.broadcast_to(anchor, shape), np.broadcast_to(up, shape)
        if self.waves is None:
            return anchors, normals
        at = piercing_points_of_planes(points, centres, anchors, normals, self.refractive_index)
        wet = (points - anchor) @ up < 0.0
        east = np.array([1.0, 0.0, self.plane.b])
        east /= np.linalg.norm(east)
        north = np.cross(up, east)
        places = (at - anchor) @ np.column_stack([east, north])
        slopes = self.waves.slopes(camera, places)
        rough = up - slopes[:, :1] * east - slopes[:, 1:] * north
        rough /= np.linalg.norm(rough, axis=1)[:, None]
        return np.where(wet[:, None], at, anchors), np.where(wet[:, None], rough, normals)

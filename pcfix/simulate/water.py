"""The simulated water surface: a plane, level or tilted, with waves that each image sees anew.

Waves are normals, no heights. At the moment of an image the surface near the place where its
light would pass the mean plane is the plane through that place whose normal is tilted by the
slope of a random field; the light takes the least optical path through this tangent plane. So
Snell's law holds exactly with the tilted normal. Left out are the height of the waves and their
curvature within the few centimetres by which they move the crossing, so that no caustics arise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pcfix.simulate.tracing import piercing_points, piercing_points_of_planes

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray, WaterPlane

_COMPONENTS = 8
"""Sinusoids of a field; with so many, slopes are nearly normally distributed."""


@dataclass(frozen=True, eq=False)
class Waves:
    """A field of slopes for each of k images, as a sum of sinusoids of one wavelength.

    Attributes
    ----------
    wave_numbers : array, shape (k, c, 2)
        Radians per metre along the two axes of the mean plane.
    phases : array, shape (k, c)
    steepness : float
        Amplitude of the slope of each sinusoid.
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
    """The surface that light is traced through; same frame as the points.

    Attributes
    ----------
    plane : WaterPlane
        The mean surface.
    refractive_index : float
    waves : Waves or None
    """

    plane: WaterPlane
    refractive_index: float
    waves: Waves | None = None

    @property
    def is_level(self) -> bool:
        """Whether the mean surface is."""
        return self.plane.b == self.plane.c == 0.0

    @property
    def normal(self) -> FloatArray:
        """Unit normal of the mean surface, up."""
        up = np.array([-self.plane.b, -self.plane.c, 1.0])
        return np.asarray(up / np.linalg.norm(up))

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return z of the mean surface."""
        return np.asarray(self.plane.a + self.plane.b * x + self.plane.c * y)

    def piercing_points(
        self, points: FloatArray, centres: FloatArray, camera: IntArray
    ) -> FloatArray:
        """Return where the light from each point to its camera passes the surface, (m, 3).

        A point above the mean plane is its own "piercing point".
        """
        if self.waves is None and self.is_level:
            return piercing_points(points, centres, self.plane.a, self.refractive_index)
        anchors, normals = self.tangent_planes(points, centres, camera)
        return piercing_points_of_planes(points, centres, anchors, normals, self.refractive_index)

    def tangent_planes(
        self, points: FloatArray, centres: FloatArray, camera: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the plane that the light of each pair passes: a point of it and the unit normal.

        Parameters
        ----------
        points, centres : array, shape (m, 3)
        camera : array, shape (m,)
            Rows of the cameras, for their waves.

        Returns
        -------
        tuple of array, shape (m, 3)
        """
        shape = points.shape
        anchor = np.array([0.0, 0.0, self.plane.a])
        anchors, normals = np.broadcast_to(anchor, shape), np.broadcast_to(self.normal, shape)
        if self.waves is None:
            return anchors, normals
        at = piercing_points_of_planes(points, centres, anchors, normals, self.refractive_index)
        wet = (points - anchor) @ self.normal < 0.0
        east, north = self._axes()
        places = (at - anchor) @ np.column_stack([east, north])
        slopes = self.waves.slopes(camera, places)
        rough = self.normal - slopes[:, :1] * east - slopes[:, 1:] * north
        rough /= np.linalg.norm(rough, axis=1)[:, None]
        return np.where(wet[:, None], at, anchors), np.where(wet[:, None], rough, normals)

    def _axes(self) -> tuple[FloatArray, FloatArray]:
        """Return two unit vectors in the mean plane at right angles, the first towards east."""
        east = np.array([1.0, 0.0, self.plane.b])
        east /= np.linalg.norm(east)
        return east, np.cross(self.normal, east)

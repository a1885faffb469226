"""A made-up shore: land, beach, and a sea bed with swells, rocks and a ledge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit

if TYPE_CHECKING:
    from pcfix.model import FloatArray

LAND_HEIGHT_M = 3.0
GREATEST_DEPTH_M = 12.0
_ROCKS_PER_M2 = 1.0 / 150.0


@dataclass(frozen=True)
class Shore:
    """A surface z(x, y): the land is at x = 0, the deep water at x = length.

    Attributes
    ----------
    length_m, width_m : float
        Extent in x and y, from the origin.
    water_level_m : float
    rocks : array, shape (r, 4)
        Plan position, height and radius of each rock, metres.
    """

    length_m: float
    width_m: float
    water_level_m: float
    rocks: FloatArray

    @classmethod
    def random(
        cls, length_m: float, width_m: float, water_level_m: float, rng: np.random.Generator
    ) -> Shore:
        """Strew rocks over a shore."""
        count = int(length_m * width_m * _ROCKS_PER_M2)
        place = rng.uniform(0.0, 1.0, (count, 2)) * [length_m, width_m]
        size = np.column_stack([rng.uniform(0.2, 0.8, count), rng.uniform(0.5, 2.0, count)])
        return cls(length_m, width_m, water_level_m, np.column_stack([place, size]))

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return z at plan positions, metres; never deeper than `GREATEST_DEPTH_M`."""
        slope = LAND_HEIGHT_M - (LAND_HEIGHT_M + GREATEST_DEPTH_M) * (x / self.length_m) ** 1.2
        swell = 0.4 * np.sin(x / 7.0) * np.cos(y / 9.0) + 0.15 * np.sin(x / 2.3 + y / 3.1)
        ledge = -0.6 * expit((x - 0.6 * self.length_m - 0.1 * y) / 0.3)
        z = slope + swell + ledge
        for start in range(0, len(x), 50_000):
            part = slice(start, start + 50_000)
            z[part] += self._rocks(x[part], y[part])
        return self.water_level_m + np.maximum(z, -GREATEST_DEPTH_M)

    def _rocks(self, x: FloatArray, y: FloatArray) -> FloatArray:
        near = cKDTree(self.rocks[:, :2]).query(np.column_stack([x, y]), k=1)
        distance, (height, radius) = near[0], self.rocks[near[1], 2:].T
        return np.asarray(height * np.exp(-((distance / radius) ** 2)))

"""Made-up ground, as depth below the mean water plane: it tilts with the water."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit

if TYPE_CHECKING:
    from pcfix.model import FloatArray, WaterPlane

BedKind = Literal["shore", "flat", "slope", "steps", "river"]
BEDS: tuple[BedKind, ...] = get_args(BedKind)

LAND_HEIGHT_M = 3.0
GREATEST_DEPTH_M = 12.0
DEFAULT_DEPTH_M = {"shore": GREATEST_DEPTH_M, "flat": 3.0, "slope": 6.0, "steps": 6.0, "river": 2.5}
STEPS = 6
_ROCKS_PER_M2 = 1.0 / 150.0
_BANK = 0.3  # of a river's depth
_GRADIENT_STEP_M = 1e-4
_WALL = 10.0  # a slope steeper than this is the wall of a step, beside which the bed is level


@dataclass(frozen=True)
class Terrain:
    """A surface z(x, y) over a rectangle from the origin.

    =======  ===================================================================================
    shore    land at x = 0, then beach and bed with swells, rocks and a ledge to the deep water
             at x = length
    flat     one depth everywhere
    slope    an even slope from the waterline at x = 0 to the greatest depth at x = length
    steps    `STEPS` level steps of equal length and height from x = 0 to x = length, a flume
    river    a winding channel along x with pools, and banks above the water
    =======  ===================================================================================

    Attributes
    ----------
    kind : {"shore", "flat", "slope", "steps", "river"}
    length_m, width_m : float
        Extent in x and y.
    water : WaterPlane
        Mean surface, in the same frame.
    greatest_depth_m : float
        Vertically below the water.
    rocks : array, shape (r, 4)
        Plan position, height and radius of each rock, metres; of a shore.
    """

    kind: BedKind
    length_m: float
    width_m: float
    water: WaterPlane
    greatest_depth_m: float
    rocks: FloatArray

    @classmethod
    def random(
        cls,
        kind: BedKind,
        extent_m: tuple[float, float],
        water: WaterPlane,
        greatest_depth_m: float,
        rng: np.random.Generator,
    ) -> Terrain:
        """Make a terrain; a shore gets random rocks."""
        rocks = np.zeros((0, 4))
        if kind == "shore":
            count = int(extent_m[0] * extent_m[1] * _ROCKS_PER_M2)
            place = rng.uniform(0.0, 1.0, (count, 2)) * extent_m
            size = np.column_stack([rng.uniform(0.2, 0.8, count), rng.uniform(0.5, 2.0, count)])
            rocks = np.column_stack([place, size])
        return cls(kind, *extent_m, water, greatest_depth_m, rocks)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return z at plan positions, metres; never deeper than `greatest_depth_m`."""
        above = np.maximum(self._above_water(x, y), -self.greatest_depth_m)
        return np.asarray(self.water.a + self.water.b * x + self.water.c * y + above)

    def normals(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return unit normals, up, shape (m, 3), from differences over 0.2 mm."""
        d = _GRADIENT_STEP_M
        along_x = (self.height(x + d, y) - self.height(x - d, y)) / (2.0 * d)
        along_y = (self.height(x, y + d) - self.height(x, y - d)) / (2.0 * d)
        wall = np.hypot(along_x, along_y) > _WALL
        slopes = np.where(wall, self.water.b, along_x), np.where(wall, self.water.c, along_y)
        up = np.column_stack([-slopes[0], -slopes[1], np.ones(len(x))])
        return np.asarray(up / np.linalg.norm(up, axis=1)[:, None])

    def _above_water(self, x: FloatArray, y: FloatArray) -> FloatArray:
        share, deepest = x / self.length_m, self.greatest_depth_m
        if self.kind == "shore":
            return self._shore(x, y)
        if self.kind == "river":
            return self._river(x, y)
        if self.kind == "slope":
            return np.asarray(-deepest * share)
        if self.kind == "steps":
            step = np.clip(np.floor(STEPS * share) + 1.0, 1.0, STEPS)
            return np.asarray(-deepest * step / STEPS)
        return np.full(len(x), -deepest)

    def _shore(self, x: FloatArray, y: FloatArray) -> FloatArray:
        size = min(1.0, self.greatest_depth_m / GREATEST_DEPTH_M)  # shallow shores are smoother
        land, share = LAND_HEIGHT_M * size, np.maximum(x / self.length_m, 0.0)
        slope = land - (land + self.greatest_depth_m) * share**1.2
        swell = 0.4 * np.sin(x / 7.0) * np.cos(y / 9.0) + 0.15 * np.sin(x / 2.3 + y / 3.1)
        ledge = -0.6 * expit((x - 0.6 * self.length_m - 0.1 * y) / 0.3)
        z = slope + size * swell + size * ledge
        if len(self.rocks):
            for start in range(0, len(x), 50_000):
                part = slice(start, start + 50_000)
                z[part] += size * self._rocks(x[part], y[part])
        return np.asarray(z)

    def _rocks(self, x: FloatArray, y: FloatArray) -> FloatArray:
        near = cKDTree(self.rocks[:, :2]).query(np.column_stack([x, y]), k=1)
        distance, (height, radius) = near[0], self.rocks[near[1], 2:].T
        return np.asarray(height * np.exp(-((distance / radius) ** 2)))

    def _river(self, x: FloatArray, y: FloatArray) -> FloatArray:
        turn = 2.0 * np.pi * x / self.length_m
        middle = self.width_m * (0.5 + 0.1 * np.sin(turn))
        across = (y - middle) / (0.35 * self.width_m)
        pools = 0.8 + 0.2 * np.sin(3.0 * turn)
        deepest = self.greatest_depth_m
        return np.asarray(np.minimum(-deepest * pools * (1.0 - across**2), _BANK * deepest))

"""Made-up ground, as depth below the mean water plane: it tilts with the water."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit

from pcfix.model import FloatArray, WaterPlane
from pcfix.options.scenes import BedKind

GREATEST_DEPTH_M = 12.0
STEPS = 6


@dataclass(frozen=True)
class Terrain:
    """A surface z(x, y) over a rectangle from the origin, below a mean water plane.

    `rocks`, shape (r, 4), are plan position, height and radius, metres, of a shore.
    """

    kind: BedKind
    length_m: float
    width_m: float
    water: WaterPlane
    greatest_depth_m: float
    rocks: FloatArray

    @classmethod
    def random(
        cls, kind: BedKind, extent_m: tuple[float, float], water: WaterPlane,
        greatest_depth_m: float, rng: np.random.Generator,
    ) -> Terrain:  # fmt: skip
        """Make a terrain; a shore gets random rocks."""
        rocks = np.zeros((0, 4))
        if kind == "shore":
            count = int(extent_m[0] * extent_m[1] * (1.0 / 150.0))  # one in 150 m2
            place = rng.uniform(0.0, 1.0, (count, 2)) * extent_m
            size = np.column_stack([rng.uniform(0.2, 0.8, count), rng.uniform(0.5, 2.0, count)])
            rocks = np.column_stack([place, size])
        return cls(kind, *extent_m, water, greatest_depth_m, rocks)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return z at plan positions, metres; never deeper than `greatest_depth_m`."""
        above = np.maximum(BEDS[self.kind].above_water(self, x, y), -self.greatest_depth_m)
        return np.asarray(self.water.a + self.water.b * x + self.water.c * y + above)


def _shore(ground: Terrain, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return land at x = 0, then beach and bed with swells, rocks and a ledge to deep water."""
    size = min(1.0, ground.greatest_depth_m / GREATEST_DEPTH_M)  # shallow shores are smoother
    land, share = 3.0 * size, np.maximum(x / ground.length_m, 0.0)
    slope = land - (land + ground.greatest_depth_m) * share**1.2
    swell = 0.4 * np.sin(x / 7.0) * np.cos(y / 9.0) + 0.15 * np.sin(x / 2.3 + y / 3.1)
    ledge = -0.6 * expit((x - 0.6 * ground.length_m - 0.1 * y) / 0.3)
    z = slope + size * swell + size * ledge
    if len(ground.rocks):
        distance, rock = cKDTree(ground.rocks[:, :2]).query(np.column_stack([x, y]))
        height, radius = ground.rocks[rock, 2:].T
        z = z + size * (height * np.exp(-((distance / radius) ** 2)))
    return np.asarray(z)


def _steps(ground: Terrain, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return `STEPS` level steps of equal length and height along x, as in a flume."""
    step = np.clip(np.floor(STEPS * (x / ground.length_m)) + 1.0, 1.0, STEPS)
    return np.asarray(-ground.greatest_depth_m * step / STEPS)


def _river(ground: Terrain, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return a winding channel along x with pools, and banks above the water."""
    turn = 2.0 * np.pi * x / ground.length_m
    middle = ground.width_m * (0.5 + 0.1 * np.sin(turn))
    across = (y - middle) / (0.35 * ground.width_m)
    pools = 0.8 + 0.2 * np.sin(3.0 * turn)
    deepest = ground.greatest_depth_m
    return np.asarray(np.minimum(-deepest * pools * (1.0 - across**2), 0.3 * deepest))


class Bed(NamedTuple):
    """A kind of bed: its usual greatest depth, and its height above the water at n places."""

    default_depth_m: float
    above_water: Callable[[Terrain, FloatArray, FloatArray], FloatArray]


BEDS: dict[BedKind, Bed] = {
    "shore": Bed(GREATEST_DEPTH_M, _shore),
    "flat": Bed(3.0, lambda ground, x, y: np.full(len(x), -ground.greatest_depth_m)),
    "slope": Bed(6.0, lambda ground, x, y: -ground.greatest_depth_m * (x / ground.length_m)),
    "steps": Bed(6.0, _steps),
    "river": Bed(2.5, _river),
}
"""Flat: one depth everywhere; slope: from the waterline at x = 0 to the greatest depth at the end.
A new kind is an entry here and in `BedKind`."""

"""A corrected scene with outliers put into it."""

from functools import cache
from typing import NamedTuple

import numpy as np

import pcfix
from pcfix.model import BoolArray, FloatArray, WaterPlane
from pcfix.options.steps import CleanRules
from pcfix.points.noise import Cloud, ReasonArray, flag_neighbours
from pcfix.water.surface import surface_above

POINTS, OUTLIERS = 60_000, 300


class Spoilt(NamedTuple):
    """A scene of good points, then of outliers below the bed, in the water and in the air."""

    xyz: np.ndarray
    ray_count: np.ndarray
    ray_miss_m: np.ndarray
    incidence_deg: np.ndarray
    water_level_m: float
    good: slice
    below: slice
    floating: slice
    air: slice


@cache
def spoilt_scene(points: int = POINTS, outliers: int = OUTLIERS) -> Spoilt:
    """Return the scene; 6 points a square metre, noise of the bed a few centimetres."""
    scene = pcfix.simulate_scene(points)
    level = scene.water_level_m
    result = pcfix.correct_points(scene.apparent_xyz, scene.cameras, level)
    xyz, rng = result.xyz, np.random.default_rng(5)
    deep = np.flatnonzero(level - xyz[:, 2] > 2.0)
    below, floating = (xyz[rng.choice(deep, outliers, replace=False)] for _ in range(2))
    air = xyz[rng.choice(points, outliers, replace=False)]
    below[:, 2] -= rng.uniform(0.8, 5.0, outliers)
    floating[:, 2] += rng.uniform(1.0, level - floating[:, 2] - 0.1)
    air[:, 2] = np.maximum(air[:, 2], level) + rng.uniform(4.0, 30.0, outliers)
    for part in (below, floating, air):
        part[:, :2] += rng.normal(0.0, 0.2, (outliers, 2))
    wet = np.zeros(3 * outliers, bool)
    wet[: 2 * outliers] = True
    ends = points + outliers * np.arange(4)
    return Spoilt(
        np.vstack([xyz, below, floating, air]),
        np.append(result.ray_count, np.where(wet, 10, 0)),
        np.append(result.ray_miss_m, np.where(wet, 0.05, 0.0)),
        np.append(result.incidence_deg, np.where(wet, 30.0, 0.0)),
        level,
        slice(points),
        *(slice(a, b) for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)),
    )


def reasons_of(
    xyz: FloatArray, *, water: float | None = None, used: BoolArray | None = None,
    rules: CleanRules | None = None, **rays: FloatArray,
) -> ReasonArray:  # fmt: skip
    """Return the reasons of the tests for each point; `rays` are dimensions of a correction."""
    n, rules = len(xyz), rules or CleanRules()
    above = None if water is None else surface_above(WaterPlane(water), xyz)
    cloud = Cloud(np.empty((n, 3)), *(np.zeros(n, kind) for kind in (bool, bool, np.uint8)))
    cloud.add(slice(n), xyz, np.ones(n, bool) if used is None else used, above, rays, rules)
    flag_neighbours("xyz", cloud, rules)
    return cloud.reasons

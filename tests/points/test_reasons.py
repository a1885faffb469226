"""Noise that is found, terrain that is spared, and input that is refused."""

import numpy as np

from pcfix.options.steps import CleanRules
from pcfix.points.noise import Reason
from tests.points.scenes import reasons_of, spoilt_scene
from tests.utils.codes import refused


def test_outliers_found() -> None:
    """The band of the bed is a slope's drop in a neighbourhood of 1.3 m, at least 0.3 m.

    Outliers stand at least 0.8 m below and 1 m above a bed point. On the steepest slopes, and at
    the rim of the water, the band is wider than that: a twentieth may stay. In the air, 4 m up,
    some have another outlier near: a twentieth again. The fences leave one in some 10,000 points
    of a normal distribution outside, the floors nearly all of these inside.
    """
    s = spoilt_scene()
    rays = {"RayCount": s.ray_count, "RayMiss": s.ray_miss_m, "Incidence": s.incidence_deg}
    reasons = reasons_of(s.xyz, water=s.water_level_m, **rays)
    assert (reasons[s.below] & Reason.BELOW_BED > 0).mean() > 0.95
    assert (reasons[s.floating] & Reason.FLOATING > 0).mean() > 0.95
    assert (reasons[s.air] & Reason.STATISTICAL > 0).mean() > 0.95
    assert (reasons[s.good] > 0).mean() < 1e-3


def test_wall_and_rock_spared() -> None:
    """A step of 3 m, with points on its face, and a rock of 1.5 m: breaks of the bed, not noise."""
    rng = np.random.default_rng(8)
    xyz = rng.uniform((0.0, 0.0, -8.0), (40.0, 40.0, -8.0), (16_000, 3))
    xyz[xyz[:, 0] > 20.0, 2] = -5.0
    xyz[np.hypot(xyz[:, 0] - 10.0, xyz[:, 1] - 10.0) < 1.5, 2] = -6.5
    face = rng.uniform((20.0, 0.0, -8.0), (20.01, 40.0, -5.0), (1200, 3))
    xyz = np.vstack([xyz, face])
    xyz[:, 2] += rng.normal(0.0, 0.03, len(xyz))
    reasons = reasons_of(xyz, water=0.0, rules=CleanRules(deviations=None))
    # the rock's crown of 1.5 m holds 70 points, more than twice a neighbourhood
    assert (reasons > 0).mean() < 1e-3


def test_land_spared() -> None:
    """Ground under a canopy lies far below its neighbours in plan."""
    rng = np.random.default_rng(4)
    canopy = rng.uniform((0, 0, 8.0), (30, 30, 9.0), (9000, 3))
    ground = rng.uniform((0, 0, 1.0), (30, 30, 1.0), (300, 3))
    bed = rng.uniform((40, 0, -2.1), (70, 30, -2.0), (9000, 3))
    xyz = np.vstack([canopy, ground, bed])
    assert not reasons_of(xyz, water=0.0, rules=CleanRules(deviations=None)).any()


def test_weak_intersections() -> None:
    xyz = spoilt_scene().xyz[:50]
    rays, miss, angle = np.zeros(50), np.zeros(50), np.zeros(50)
    miss[:10], angle[:10] = 9.0, 89.0  # on land these say nothing
    rays[10:] = 3
    rays[20], miss[21], angle[22] = 2, 0.51, 75.1
    rays[23], miss[23] = 2, 0.6
    only = CleanRules(deviations=None, below=None, floating=None)
    found = reasons_of(xyz, RayCount=rays, RayMiss=miss, Incidence=angle, rules=only)
    weak = {20: 4, 21: 8, 22: 16, 23: 12}
    assert found.tolist() == [weak.get(i, 0) for i in range(50)]
    assert reasons_of(xyz, RayCount=rays, rules=only).tolist() == [
        4 if i in (20, 23) else 0 for i in range(50)
    ]


def test_all_tests_off() -> None:
    names = {"deviations", "min_rays", "max_ray_miss", "max_incidence", "below", "floating"}
    with refused("option.no_test"):
        CleanRules(**dict.fromkeys(names))

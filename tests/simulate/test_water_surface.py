"""Light through level and tilted water: Snell and Fermat."""

import numpy as np
import pytest

from pcfix.model import WaterPlane
from pcfix.simulate.tracing import anchors_and_normals, piercing_points_of_planes
from tests.utils.bed_rays import bed_points
from tests.utils.twins import light_path

N = 1.34
COUNT = 40


def pairs(seed=3):
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-30, 30, (COUNT, 2)), -rng.uniform(3, 12, COUNT)])
    centres = np.column_stack([rng.uniform(-60, 60, (COUNT, 2)), rng.uniform(40, 90, COUNT)])
    return points, centres


WATERS = {
    "level": anchors_and_normals(WaterPlane(0.3), COUNT),
    "tilted": anchors_and_normals(WaterPlane(0.3, 0.05, -0.03), COUNT),
}


def angle(one, other):
    """Return the angle between vectors, precise where it is small."""
    return np.arctan2(np.linalg.norm(np.cross(one, other)), np.dot(one, other))


@pytest.mark.parametrize("water", WATERS.values(), ids=WATERS)
def test_snell_and_fermat(water):
    points, centres = pairs()
    anchors, normals = water
    found = piercing_points_of_planes(points, centres, *water, N)
    for i in range(COUNT):
        up = normals[i]
        air, deep = centres[i] - found[i], found[i] - points[i]
        assert up @ (found[i] - anchors[i]) == pytest.approx(0.0, abs=1e-10)  # on the plane, m
        sine = np.sin(angle(air, up)) / N
        assert np.arcsin(sine) == pytest.approx(angle(deep, up), abs=1e-9)  # rad
        # air, normal and water lie in one plane
        assert np.dot(np.cross(air, up), deep) == pytest.approx(0.0, abs=1e-7)
        slope = -up[:2] / up[2]
        plane = (anchors[i, 2] - slope @ anchors[i, :2], *slope)
        assert found[i] == pytest.approx(light_path(points[i], centres[i], plane, N), abs=1e-8)
        best = np.linalg.norm(air) + N * np.linalg.norm(deep)
        for aside in np.cross(up, np.eye(3)):
            there = found[i] + 1e-3 * aside
            longer = np.linalg.norm(centres[i] - there) + N * np.linalg.norm(there - points[i])
            assert longer > best - 1e-13


def test_land():
    points, centres = pairs()
    points[:, 2] = 8.0
    for water in WATERS.values():
        assert np.array_equal(piercing_points_of_planes(points, centres, *water, N), points)


def test_there_and_back():
    water = WATERS["tilted"]
    points, centres = pairs()
    surface = piercing_points_of_planes(points, centres, *water, N)
    bed_normals = np.random.default_rng(1).normal(0, 0.2, (COUNT, 3)) + np.array([0, 0, 1])
    bed_normals /= np.linalg.norm(bed_normals, axis=1)[:, None]
    seen = bed_points(centres, surface - centres, water, (points, bed_normals), N)
    assert seen == pytest.approx(points, abs=1e-9)

"""Light through tilted and wavy water: Snell, Fermat, and the statistics of the waves."""

import numpy as np
import pytest

from pcfix.model import WaterPlane
from pcfix.simulate.tracing import Water, Waves
from tests.utils.bed_rays import bed_points
from tests.utils.twins import bend, light_path

N = 1.34
TILTED = WaterPlane(0.3, 0.05, -0.03)
COUNT = 40


def pairs(seed=3):
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-30, 30, (COUNT, 2)), -rng.uniform(3, 12, COUNT)])
    centres = np.column_stack([rng.uniform(-60, 60, (COUNT, 2)), rng.uniform(40, 90, COUNT)])
    return points, centres, rng.integers(0, 9, COUNT)


def waters():
    waves = Waves.random(9, 3.0, 2.0, np.random.default_rng(8))
    return {
        "level": Water(WaterPlane(0.3), N),
        "tilted": Water(TILTED, N),
        "waves": Water(WaterPlane(0.3), N, waves),
        "tilted waves": Water(TILTED, N, waves),
    }


def angle(one, other):
    """Return the angle between vectors, precise where it is small."""
    return np.arctan2(np.linalg.norm(np.cross(one, other)), np.dot(one, other))


@pytest.mark.parametrize("kind", waters())
def test_snell_and_fermat(kind):
    water = waters()[kind]
    points, centres, camera = pairs()
    found = water.piercing_points(points, centres, camera)
    anchors, normals = water.tangent_planes(points, centres, camera)
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
    points, centres, camera = pairs()
    points[:, 2] = 8.0
    for water in waters().values():
        assert np.array_equal(water.piercing_points(points, centres, camera), points)


def test_there_and_back():
    water = waters()["tilted waves"]
    points, centres, camera = pairs()
    surface = water.piercing_points(points, centres, camera)
    planes = water.tangent_planes(points, centres, camera)
    bed_normals = np.random.default_rng(1).normal(0, 0.2, (COUNT, 3)) + np.array([0, 0, 1])
    bed_normals /= np.linalg.norm(bed_normals, axis=1)[:, None]
    seen = bed_points(centres, surface - centres, planes, (points, bed_normals), N)
    assert seen == pytest.approx(points, abs=1e-9)
    for i in range(COUNT):  # the slow twin's refraction
        air, under = surface[i] - centres[i], points[i] - surface[i]
        slow = bend(air / np.linalg.norm(air), planes[1][i], N)
        assert slow == pytest.approx(under / np.linalg.norm(under), abs=1e-9)


def test_wave_statistics():
    rng = np.random.default_rng(4)
    waves = Waves.random(400, 2.0, 1.5, rng)
    camera = rng.integers(0, 400, 40_000)
    at = rng.uniform(-50, 50, (40_000, 2))
    slopes = waves.slopes(camera, at)
    # 40,000 independent draws: 0.4 % of a standard deviation, and 1 % of the amplitudes' spread
    assert np.degrees(np.arctan(slopes.std(axis=0))) == pytest.approx([2.0, 2.0], rel=0.02)
    assert np.abs(slopes.mean(axis=0)).max() < 0.001
    near, far = np.array([0.05, 0.0]), rng.normal(0.0, 15.0, at.shape)
    others = [(camera, at + near), (camera, at + far), ((camera + 1) % 400, at)]
    alike = [np.corrcoef(slopes[:, 0], waves.slopes(*one)[:, 0])[0, 1] for one in others]
    assert alike[0] > 0.95
    assert np.abs(alike[1:]).max() < 0.03
    angles = 2.0 * np.pi / np.linalg.norm(waves.wave_numbers, axis=2)
    assert angles == pytest.approx(1.5)

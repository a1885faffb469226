"""The factor of stereo pairs: by light traced through the water, and on simulated clouds."""

from dataclasses import replace

import numpy as np
import pytest

import pcfix
from pcfix.errors import GeometryError, SettingError
from pcfix.refract.literature import NODES, ratios, stereo_factor
from tests.utils.codes import refused
from tests.utils.twins import light_path

N = 1.34
SCENE = {"bed": "shore", "lidar_per_m2": 0.0}


@pytest.fixture(scope="module")
def scene():
    return pcfix.simulate_scene(8000, seed=1, **SCENE)


def test_limits():
    assert ratios(0.2, 0.5, 0.4, 1.0) == pytest.approx(1.0, abs=1e-12)
    assert ratios(0.001, 0.002, 0.002, N) == pytest.approx(N, abs=1e-5)


def test_traced_light():
    height, base, along, across = 100.0, 20.0, 0.55, 0.75
    found = ratios(base / height, along, across, N)
    middles = (np.arange(NODES) + 0.5) / NODES * 2.0 - 1.0
    for i, j in ((50, 50), (3, 90), (97, 10), (60, 99)):
        x, y = height * middles[j] * (along - 0.1), height * middles[i] * across
        bed = np.array([x, y, -0.05])  # shallow, as the formula takes depths
        t = []
        for centre in ([-base / 2, 0.0, height], [base / 2, 0.0, height]):
            crossing = light_path(bed, np.array(centre), (0.0, 0.0, 0.0), N)
            t.append((crossing[0], (crossing[0] - centre[0]) / height))
        # x of both straight rays at the apparent depth d: crossing + d t
        apparent = -(t[1][0] - t[0][0]) / (t[1][1] - t[0][1])
        assert 0.05 / apparent == pytest.approx(found[i, j], rel=2e-4)


def test_simulated_block(scene):
    found = stereo_factor(scene.cameras, scene.water.a, N)
    apparent, true = (scene.depth_m(xyz) for xyz in (scene.apparent_xyz, scene.true_xyz))
    wet = (np.diff(scene.views.start) > 1) & (apparent > 0.5)
    # 1.4427 and 1.433: the points of the cloud have more images than a pair
    assert found.factor == pytest.approx(np.mean(true[wet] / apparent[wet]), rel=0.01)
    assert found.height_m == pytest.approx(80.0, abs=0.5)
    assert (found.images, found.aside) == (40, 0)
    assert found.base_m == pytest.approx(15.77, abs=0.005)


def test_auto(scene):
    found = stereo_factor(scene.cameras, scene.water.a, N)
    given = scene.xyz, scene.cameras, scene.water
    auto, told = (
        pcfix.correct_points(*given, method="factor", depth_factor=factor)
        for factor in ("auto", found.factor)
    )
    assert np.array_equal(auto.xyz, told.xyz)


def test_obliques_ignored():
    scene = pcfix.simulate_scene(500, seed=1, obliques_deg=35.0, **SCENE)
    found = stereo_factor(scene.cameras, scene.water.a, N)
    assert (found.images, found.aside) == (40, 72)


def test_refused(scene):
    cameras, level = scene.cameras, scene.water.a
    bare = pcfix.Cameras(cameras.labels, cameras.centres)
    with refused("cameras.no_orientation", SettingError):
        pcfix.correct_points(scene.xyz, bare, scene.water, method="factor", depth_factor="auto")
    far = replace(cameras, centres=cameras.centres * [20.0, 20.0, 1.0])
    aside = replace(cameras, rotations=np.broadcast_to(np.eye(3), (40, 3, 3)))
    one = replace(cameras, centres=np.broadcast_to(cameras.centres[0], (40, 3)))
    for wrong, code, values in (
        (far, "cameras.no_overlap", {}),
        (aside, "cameras.no_stereo", {"nadir": 0}),
        (one, "cameras.no_overlap", {"base_m": 0.0}),
    ):
        with refused(code, GeometryError, **values):
            stereo_factor(wrong, level, N)

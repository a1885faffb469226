"""What a scene can be asked for: blocks, grounds, water, and what is refused."""

import numpy as np
import pytest

import pcfix
from pcfix.simulate.settings import STEPS, SceneSettings
from tests.utils.codes import refused
from tests.utils.twins import image_slowly

FEW = {"points": 200, "lidar_per_m2": 0.2}


@pytest.mark.parametrize(
    ("code", "arguments"),
    [
        ("scene.too_low", {"flying_height_m": 5.0}),
        ("scene.pixels", {"sensor_mm": (13.2, 4.4)}),
        ("scene.too_low", {"tilt_percent": 19.0, "area_m": (900, 80)}),
        ("option.no_use", {"oblique_share": 0.5}),
    ],
)
def test_contradictory(code, arguments):
    with refused(code):
        pcfix.simulate_scene(**arguments)


def looks_down_deg(scene):
    return np.degrees(np.arccos(-scene.true_cameras.rotations[:, 2, 2]))


def test_obliques():
    scene = pcfix.simulate_scene(obliques_deg=35.0, oblique_share=0.5, area_m=(400, 300), **FEW)
    off = looks_down_deg(scene)
    slanted = off > 15.0
    assert off[slanted].mean() == pytest.approx(35.0, abs=1.0)  # attitudes vary by 1.5 deg
    # rings reach as far beyond the area as nadir images, with steps of their own
    assert slanted.mean() == pytest.approx(0.5, abs=0.1)
    every = pcfix.simulate_scene(obliques_deg=35.0, oblique_share=1.0, oblique_directions=2, **FEW)
    assert (looks_down_deg(every) > 25.0).all()


def test_tilted_water():
    scene = pcfix.simulate_scene(tilt_percent=2.0, tilt_heading_deg=180.0, bed="flat", **FEW)
    water = scene.water
    assert (water.b, water.c) == pytest.approx((0.0, 0.02), abs=1e-15)  # falls to the south
    for xyz, noise in ((scene.true_xyz, 1e-8), (scene.lidar_xyz, 0.3)):
        assert scene.depth_m(xyz) == pytest.approx(3.0, abs=noise)
    middle = scene.true_xyz.mean(axis=0)
    middle[:2] = [410_260.0, 4_650_340.0]
    level = water.a + water.b * middle[0] + water.c * middle[1]
    assert level == pytest.approx(0.37, abs=1e-8)


def test_beds():
    def depths(bed, **more):
        scene = pcfix.simulate_scene(3000, bed=bed, lidar_per_m2=0, **more)
        return scene, scene.depth_m(scene.true_xyz), scene.true_xyz[:, 0] - 410_200.0

    assert np.ptp(depths("flat", greatest_depth_m=4.0)[1]) < 1e-8
    _, depth, x = depths("slope")
    assert depth == pytest.approx(6.0 * x / 120.0, abs=1e-8)
    _, depth, _ = depths("steps", greatest_depth_m=0.3, flying_height_m=2.0, area_m=(4, 2))
    assert np.unique(np.round(depth, 6)) == pytest.approx(0.3 * np.arange(1, STEPS + 1) / STEPS)
    river, depth, _ = depths("river")
    assert 0.02 < (depth < 0).mean() < 0.6
    assert 2.0 < depth.max() <= 2.5 + 1e-9
    assert np.hypot(river.water.b, river.water.c) == pytest.approx(0.003)
    _, depth, _ = depths("shore", greatest_depth_m=5.0)
    assert depth.min() < -0.5
    assert 4.5 < depth.max() <= 5.0 + 1e-9


def test_brown():
    """The simulated lens against Brown's formula, term by term."""
    optics = SceneSettings(distortion=(-0.08, 0.03, -0.006, 0.0007, -0.0005)).optics
    rng = np.random.default_rng(0)
    ideal = rng.uniform(0, 1, (200, 2)) * [5472, 3648]
    image = optics.to_image(ideal)
    for i in range(200):
        plane = (ideal[i] - [2736, 1824]) / optics.lens.focal
        slow = image_slowly(optics.lens, np.array([*plane, 1.0]))
        assert image[i] == pytest.approx(slow, abs=1e-8)  # pixels
    assert np.abs(image - ideal).max() > 20.0
    assert optics.to_ideal(image) == pytest.approx(ideal, abs=1e-8)

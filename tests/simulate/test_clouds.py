"""Simulated tracks: without refraction the truth comes back, and a slow twin agrees."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares

import pcfix
from pcfix.simulate.scene import ORIGIN_M
from tests.utils.twins import light_path

LENS = (-0.06, 0.02, -0.004, 0.0006, -0.0004)
MICROMETRE = 1e-6


@pytest.mark.parametrize(
    "more",
    [
        {"distortion": LENS, "tilt_percent": 1.0, "obliques_deg": 35.0},
        {"bed": "river", "detection": 0.6},
        {"bed": "steps", "area_m": (4, 2), "flying_height_m": 2.0, "greatest_depth_m": 0.3},
    ],
)
def test_truth_without_refraction(more):
    scene = pcfix.simulate_scene(150, index=1.0, image_noise=0.0, lidar_per_m2=0.1, **more)
    assert np.diff(scene.views.start).mean() > 3
    assert scene.xyz == pytest.approx(scene.true_xyz, abs=MICROMETRE)


class Twin:
    """A scene in local coordinates, and what it takes to make its points again."""

    def __init__(self, scene):
        self.n, self.lens = scene.refractive_index, scene.cameras.lenses[0]
        self.given, self.true = scene.cameras, scene.true_cameras
        b, c = scene.water.b, scene.water.c
        self.plane = (scene.water.a + b * ORIGIN_M[0] + c * ORIGIN_M[1], b, c)
        self.truth, self.xyz = scene.true_xyz - ORIGIN_M, scene.xyz - ORIGIN_M

    def centre(self, cameras, i):
        return cameras.centres[i] - ORIGIN_M

    def pixels(self, cameras, i, target):
        x, y, z = cameras.rotations[i] @ (target - self.centre(cameras, i))
        half = np.array([self.lens.width, self.lens.height]) / 2
        return half + self.lens.focal * np.array([x, y]) / z

    def image(self, i, point):
        """Return where the true image i shows a point."""
        target = point
        if point[2] < self.plane[0] + self.plane[1] * point[0] + self.plane[2] * point[1]:
            target = light_path(point, self.centre(self.true, i), self.plane, self.n)
        return self.pixels(self.true, i, target)

    def straight(self, cameras, point, guess):
        """Return the point with the least residuals over straight rays of the given cameras."""
        seen = {i: self.image(i, point) for i in cameras}

        def residuals(at):
            return np.concatenate([self.pixels(self.given, i, at) - seen[i] for i in cameras])

        tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
        return least_squares(residuals, guess, x_scale=0.01, **tight).x


POSES = {"position_noise_m": 0.03, "attitude_noise_deg": 0.02}


def test_tracks_twin():
    scene = pcfix.simulate_scene(60, image_noise=0.0, tilt_percent=1.0, detection=0.7, **POSES)
    twin, start = Twin(scene), scene.views.start
    for i in range(0, 60, 10):
        of_point = scene.views.camera[start[i] : start[i + 1]]
        slow = twin.straight(of_point, twin.truth[i], twin.xyz[i] + 0.1)
        assert twin.xyz[i] == pytest.approx(slow, abs=1e-5)  # scipy stops at 1e-8 of a focal length


def test_pose_noise():
    scene = pcfix.simulate_scene(
        20, block="oblique", position_noise_m=0.2, attitude_noise_deg=0.3, lidar_per_m2=0
    )
    k = len(scene.cameras)
    off = scene.cameras.centres - scene.true_cameras.centres
    turned = scene.yaw_pitch_roll_deg - scene.true_yaw_pitch_roll_deg
    # a standard deviation of 3 k values is known to 1 / sqrt(6 k) of it; four times that
    assert off.std() == pytest.approx(0.2, rel=4 / math.sqrt(6 * k))
    assert turned.std() == pytest.approx(0.3, rel=4 / math.sqrt(6 * k))
    calm = pcfix.simulate_scene(20, block="oblique", lidar_per_m2=0)
    assert np.array_equal(calm.true_cameras.centres, scene.true_cameras.centres)
    assert np.array_equal(calm.true_xyz, scene.true_xyz)
    assert np.array_equal(calm.views.camera, scene.views.camera)


def test_detection():
    every = pcfix.simulate_scene(800, lidar_per_m2=0)
    some = pcfix.simulate_scene(800, lidar_per_m2=0, detection=0.6)
    share = len(some.views.camera) / len(every.views.camera)
    assert share == pytest.approx(0.6, abs=0.02)  # 10,000 draws: 0.005
    few = pcfix.simulate_scene(800, lidar_per_m2=0, detection=0.05)
    assert np.diff(few.views.start).min() == 3

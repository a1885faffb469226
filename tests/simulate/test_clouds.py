"""Every kind of cloud: without refraction the truth comes back, and slow twins agree.

`tests.refract.test_depth_maps` checks fused depth maps: their slow twin undoes simulated ones.
"""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares

import pcfix
from pcfix.simulate.scene import ORIGIN_M
from tests.utils.matchers import matched_scene
from tests.utils.twins import light_path

KINDS = ("tracks", "pairs", "depth-maps", "single-map", "nearest-map")
LENS = (-0.06, 0.02, -0.004, 0.0006, -0.0004)
MICROMETRE = 1e-6


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "more",
    [
        {"distortion": LENS, "tilt_percent": 1.0, "wave_slope_deg": 2.0, "obliques_deg": 35.0},
        {"bed": "river", "detection": 0.6},
        {"bed": "steps", "area_m": (4, 2), "flying_height_m": 2.0, "greatest_depth_m": 0.3},
    ],
)
def test_truth_without_refraction(kind, more):
    scene = matched_scene(150, cloud=kind, index=1.0, image_noise=0.0, lidar_per_m2=0.1, **more)
    assert np.diff(scene.views.start).mean() > (0.8 if kind.endswith("-map") else 3)
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

    def in_frame(self, i, point):
        u, v = self.image(i, point)
        return 0 <= u < self.lens.width and 0 <= v < self.lens.height

    def straight(self, cameras, point, guess):
        """Return the point with the least residuals over straight rays of the given cameras."""
        seen = {i: self.image(i, point) for i in cameras}

        def residuals(at):
            return np.concatenate([self.pixels(self.given, i, at) - seen[i] for i in cameras])

        tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
        return least_squares(residuals, guess, x_scale=0.01, **tight).x


POSES = {"position_noise_m": 0.03, "attitude_noise_deg": 0.02}


def views_of(scene, i):
    return scene.views.camera[scene.views.start[i] : scene.views.start[i + 1]]


def test_tracks_twin():
    scene = pcfix.simulate_scene(60, image_noise=0.0, tilt_percent=1.0, detection=0.7, **POSES)
    twin = Twin(scene)
    for i in range(0, 60, 10):
        slow = twin.straight(views_of(scene, i), twin.truth[i], twin.xyz[i] + 0.1)
        assert twin.xyz[i] == pytest.approx(slow, abs=1e-5)  # scipy stops at 1e-8 of a focal length


def test_pairs_twin():
    scene = matched_scene(60, cloud="pairs", image_noise=0.0, tilt_percent=1.0, **POSES)
    twin = Twin(scene)
    for i in (5, 33, 59):
        pairs = scene.pairs[scene.pairs_start[i] : scene.pairs_start[i + 1]]
        assert np.array_equal(np.unique(pairs), views_of(scene, i))
        shown = [k for k in range(len(scene.cameras)) if twin.in_frame(k, twin.truth[i])]
        near = {
            (min(k, j), max(k, j)) for k in shown for j in scene.neighbours[k] if int(j) in shown
        }
        assert {tuple(pair) for pair in pairs.tolist()} == near
        slow = [twin.straight(pair, twin.truth[i], twin.xyz[i] + 0.1) for pair in pairs]
        # a pair's angle is small, so scipy's last step is larger in z
        assert twin.xyz[i] == pytest.approx(np.median(slow, axis=0), abs=1e-4)


@pytest.mark.parametrize("kind", ["single-map", "nearest-map"])
def test_single_map_twin(kind):
    """Least squares over the partners, of a point that is held on the ray of its base image."""
    scene = matched_scene(60, cloud=kind, image_noise=0.0, **POSES)
    twin = Twin(scene)
    for i in (5, 33, 59):
        (base,) = views_of(scene, i)
        centre, point = twin.centre(twin.given, base), twin.xyz[i]
        shown = [k for k in scene.neighbours[base] if k >= 0 and twin.in_frame(k, twin.truth[i])]
        assert len(shown) >= 3
        seen = {k: twin.image(k, twin.truth[i]) for k in shown}
        if kind == "nearest-map":
            plan = np.linalg.norm((scene.cameras.centres - scene.xyz[i])[:, :2], axis=1)
            assert plan[base] < 2.0 * plan.min()

        def residuals(far, centre=centre, point=point, seen=seen):
            at = centre + far * (point - centre)
            return np.concatenate([twin.pixels(twin.given, k, at) - seen[k] for k in seen])

        slow = least_squares(residuals, 1.0, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        # 1e-6 of a flying height of 80 m
        assert slow == pytest.approx(1.0, abs=1e-6)


def test_depth_maps():
    scene = matched_scene(400, cloud="depth-maps", image_noise=0.3, obliques_deg=25.0)
    made = np.diff(scene.views.start) > 0
    assert made.mean() > 0.95
    assert scene.views.weight.min() > 0.0
    counts = np.diff(scene.views.start)[made]
    assert counts.min() >= 3
    land = made & (scene.depth_m(scene.true_xyz) < -0.05)
    assert np.abs((scene.xyz - scene.true_xyz)[land]).max() < 5 * scene.gsd_m
    deep = made & (scene.depth_m(scene.true_xyz) > 5.0)
    ratio = (scene.depth_m(scene.xyz) / scene.depth_m(scene.true_xyz))[deep]
    # looked at 60 degrees from the plumb line, water seems 0.4 times as deep
    assert 0.3 < ratio.min() < np.median(ratio) < 1 / 1.34


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

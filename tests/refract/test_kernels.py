"""Both kernels, any number of threads, tiles and orders: the same bits."""

import os
import subprocess
import sys
from functools import partial

import numpy as np
import pytest

import pcfix
from pcfix.kernels import threads
from pcfix.refract.tiling import TILE, spatial_order
from tests.utils.beyond_frames import BEYOND_FRAMES

pytestmark = BEYOND_FRAMES

snell = partial(pcfix.correct_points, method="snell", max_angle=None)

RNG = np.random.default_rng(7)
N = 2 * TILE + 17  # fewer than tell how a list was made, which SigmaZ would have


def lens():
    return pcfix.Lens(3000.0, 4000.0, 3000.0, 2010.0, 1490.0)


def framed_cameras(k=25):
    """Return nadir cameras with some tilt; each sees part of the points."""
    from scipy.spatial.transform import Rotation

    centres = np.column_stack([RNG.uniform(0, 100, (k, 2)), RNG.uniform(55, 65, k)])
    tilt = Rotation.from_euler("zyx", RNG.normal(0, [90, 5, 5], (k, 3)), degrees=True)
    rotations = np.diag([1.0, -1.0, -1.0]) @ tilt.as_matrix().transpose(0, 2, 1)
    return pcfix.Cameras(tuple(map(str, range(k))), centres, rotations, (lens(),) * k)


@pytest.fixture(scope="module")
def cameras():
    return framed_cameras()


@pytest.fixture(scope="module")
def points():
    return np.column_stack([RNG.uniform(0, 100, (N, 2)), -RNG.uniform(0.1, 8, N)])


def same(one, other):
    for name in ("xyz", "outcome", "ray_count", "ray_miss_m", "incidence_deg", "sigma_z_m"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name


def views_in_frame(points, cameras):
    """Return the cameras whose frame holds each point, by plain projection."""
    rows = []
    for point in points:
        local = np.einsum("kij,kj->ki", cameras.rotations, point - cameras.centres)
        u = lens().focal * local[:, 0] / local[:, 2] + lens().principal_x
        v = lens().focal * local[:, 1] / local[:, 2] + lens().principal_y
        inside = (u >= 0) & (u <= 4000) & (v >= 0) & (v <= 3000) & (local[:, 2] > 0)
        rows.append(np.flatnonzero(inside))
    start = np.concatenate([[0], np.cumsum([len(r) for r in rows])])
    return pcfix.Views(start, np.concatenate(rows))


def test_frame_test_is_projection(points, cameras):
    views = views_in_frame(points, cameras)
    result = snell(points, cameras, 0.0)
    seen = np.diff(views.start)
    assert 0 < seen.min() + 1 < seen.max() < len(cameras)  # the scene tests something
    assert np.array_equal(result.ray_count, np.where(seen >= 2, seen, 0))
    same(result, snell(points, cameras, 0.0, views=views))


def test_order_of_points_does_not_matter(points, cameras):
    shuffled = RNG.permutation(N)
    one = snell(points, cameras, 0.0)
    other = snell(points[shuffled], cameras, 0.0)
    assert np.array_equal(one.xyz[shuffled], other.xyz)


def test_points_alone_give_the_same_bits(points, cameras):
    whole = snell(points, cameras, 0.0)
    for i in range(0, N, 61):
        alone = snell(points[i : i + 1], cameras, 0.0)
        assert np.array_equal(alone.xyz[0], whole.xyz[i])


def test_number_of_threads_does_not_matter(points, cameras):
    results = []
    for count in (1, 3):
        with threads(count):
            results.append(snell(points, cameras, 0.0))
    same(*results)


def test_point_by_point_kernel_agrees_to_the_bit(points, cameras):
    every = snell(points, cameras, 0.0)
    chosen = snell(points, cameras, 0.0, max_cameras=len(cameras))
    same(every, chosen)


def test_level_plane_and_dimension_agree(points, cameras):
    level = snell(points, cameras, 0.25)
    same(level, snell(points, cameras, np.full(N, 0.25)))
    same(level, snell(points, cameras, pcfix.WaterPlane(0.25)))


def test_max_cameras_takes_the_steepest(points, cameras):
    result = snell(points, cameras, 0.0, max_cameras=3)
    assert result.ray_count.max() == 3
    views = views_in_frame(points, cameras)
    for i in range(0, N, 50):
        mine = views.camera[views.start[i] : views.start[i + 1]]
        if len(mine) < 3:
            continue
        down = points[i] - cameras.centres[mine]
        angle = np.degrees(np.arctan2(np.hypot(*down[:, :2].T), -down[:, 2]))
        assert result.incidence_deg[i] == pytest.approx(np.sort(angle)[2], abs=1e-6)


def test_max_angle_limits_the_rays(points, cameras):
    result = snell(points, cameras, 0.0, max_angle=15.0)
    assert 0 < result.incidence_deg.max() <= 15.0 + 1e-6
    assert set(result.outcome.tolist()) >= {pcfix.Outcome.CORRECTED, pcfix.Outcome.FLAT_RAYS}


def test_unusable_rays_say_why():
    two_at_one_place = pcfix.Cameras(("a", "b"), np.array([[0.0, 0, 50], [0, 0, 50]]))
    below = snell([[0, 0, -1.0]], two_at_one_place, 0.0)
    assert below.outcome.tolist() == [pcfix.Outcome.PARALLEL_RAYS]
    one = pcfix.Cameras(("a",), np.array([[0.0, 0, 50]]))
    result = snell([[3, 0, -1.0]], one, 0.0)
    assert result.outcome.tolist() == [pcfix.Outcome.ONE_CAMERA]
    assert result.xyz.tolist() == [[3, 0, -1.0]]
    assert result.depth_m.tolist() == [1.0]


def test_cameras_used_are_those_with_rays(points, cameras):
    result = snell(points, cameras, 0.0)
    views = views_in_frame(points, cameras)
    assert np.array_equal(np.flatnonzero(result.camera_used), np.unique(views.camera))


def test_spatial_order_is_a_permutation(points):
    assert np.array_equal(np.sort(spatial_order(points)), np.arange(N))
    line = np.column_stack([np.zeros(N), np.linspace(0, 1e6, N), np.zeros(N)])
    assert np.array_equal(np.sort(spatial_order(line)), np.arange(N))


def test_compiled_and_interpreted_agree(tmp_path, points, cameras):
    some = points[:40]
    np.savez(tmp_path / "scene.npz", xyz=some, centres=cameras.centres, r=cameras.rotations)
    script = f"""
import numpy as np, pcfix
scene = np.load({str(tmp_path / "scene.npz")!r})
k = len(scene["centres"])
cameras = pcfix.Cameras(tuple(map(str, range(k))), scene["centres"], scene["r"],
                        (pcfix.Lens(3000.0, 4000.0, 3000.0, 2010.0, 1490.0),) * k)
one = pcfix.correct_points(scene["xyz"], cameras, 0.0, method="snell")
other = pcfix.correct_points(scene["xyz"], cameras, 0.0, method="snell", max_cameras=4)
np.savez({str(tmp_path / "out.npz")!r}, one=one.xyz, other=other.xyz)
"""
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script], check=True, env=interpreted_environment()
    )
    slow = np.load(tmp_path / "out.npz")
    fast = snell(some, cameras, 0.0)
    # the compiler may round a product and a sum at once: allow the last bits
    assert slow["one"] == pytest.approx(fast.xyz, abs=1e-11)
    assert slow["other"] == pytest.approx(snell(some, cameras, 0.0, max_cameras=4).xyz, abs=1e-11)


def interpreted_environment():

    return {**os.environ, "NUMBA_DISABLE_JIT": "1"}


def test_threads_of_python_may_call_at_once():
    """Under numba's own pool of threads, two callers at once would end the process."""
    program = """
import threading, numpy as np, pcfix
cameras = pcfix.Cameras(("a", "b"), np.array([[-20.0, 0, 100], [20.0, 0, 100]]))
xyz = np.random.default_rng(1).uniform((-50, -50, -9), (50, 50, 0), (200_000, 3))
results = [None] * 4
def work(i): results[i] = pcfix.correct_points(xyz, cameras, 0.0, method="snell").xyz
threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
for t in threads: t.start()
for t in threads: t.join()
assert all(np.array_equal(r, results[0]) for r in results)
"""
    subprocess.run([sys.executable, "-c", program], check=True)

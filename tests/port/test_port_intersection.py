"""Correction of clouds taken under water, on scenes traced by Fermat's principle."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix import Cameras
from pcfix.model import Outcome
from pcfix.options.correct import ScienceOptions
from pcfix.port.housing import DomePort, FlatPort, ray_through, window_of
from pcfix.port.methods import correct_through_port
from tests.utils.codes import refused
from tests.utils.compiled import compiled
from tests.utils.port_scenes import images_of, simulate_port
from tests.utils.twins import stacked_intersection

ray_through = compiled(ray_through)

FLAT = FlatPort(0.02, 0.008, 1.49, (0.02, -0.01, 1.0))
DOME = DomePort(0.05, 0.004, 1.49, (0.001, -0.002, -0.01))
NOISE_PX = 0.5


@pytest.fixture(scope="module", params=[FLAT, DOME], ids=["flat", "dome"])
def scene(request):
    return simulate_port(request.param, points=1500)


@pytest.fixture(scope="module", params=[FLAT, DOME], ids=["flat", "dome"])
def noisy(request):
    return simulate_port(request.param, points=1500, noise_px=NOISE_PX, seed=1)


def errors_of(scene, found):
    assert (found.outcome == Outcome.CORRECTED).all()
    return scene.apparent + found.shift_m - scene.truth


def run(scene, views=None, **settings):
    settings = ScienceOptions(method="consistent", **settings)
    return correct_through_port(scene.apparent, scene.cameras, scene.port, settings, views)


def test_consistent(scene):
    # the images are right to 1e-8 px (see test_port), 1e-11 m at 3 m; at UTM coordinates 1e-9 m.
    # Newton's method stops at 1e-7 m, beyond which a further step would go
    before = scene.apparent[:, 2] - scene.truth[:, 2]
    assert np.sqrt((before**2).mean()) > 0.1
    found = run(scene, scene.views)
    assert np.abs(errors_of(scene, found)).max() < 5e-9
    assert found.ray_count.tolist() == np.diff(scene.views.start).tolist()
    assert found.camera_used.all()


def test_without_list(scene):
    found = run(scene)
    right = np.abs(errors_of(scene, found)).max(axis=1) < 5e-9
    assert right.mean() > 0.6
    # several sets of cameras may image the point that they lead to; at the border of an image a
    # point may alternate
    true = scene.apparent + found.shift_m
    _, inside = images_of(true, scene.cameras, scene.port, scene.refractive_index)
    agrees = inside.sum(axis=1) == found.ray_count
    assert agrees[right].all()
    assert agrees.mean() > 0.95


def test_ray_distance(scene):
    """The rays through the apparent point one by one, about the point that is nearest to them."""
    found = run(scene, scene.views)
    window, start = window_of(scene.port), scene.views.start
    for i in range(0, len(scene.apparent), 50):
        places, rays, point = [], [], scene.apparent[i]
        for c in scene.views.camera[start[i] : start[i + 1]]:
            centre, turn = scene.cameras.centres[c], scene.cameras.rotations[c]
            place, ray = ray_through(window, 1.34, tuple(turn @ (point - centre)))
            places.append(turn.T @ place + (centre - point))
            rays.append(turn.T @ ray)
        truth = stacked_intersection(np.array(places), rays)
        misses = np.linalg.norm(np.cross(truth - places, rays), axis=1)
        assert found.ray_miss_m[i] == pytest.approx(np.sqrt((misses**2).mean()), abs=1e-7)


def test_covariance_of_noise(noisy):
    # three thousand normalised squares have a mean of 1 within 4 sigma = 0.15 (correlations aside)
    found = run(noisy, noisy.views, sigma_image=NOISE_PX, sigma_index=0.0)
    errors = errors_of(noisy, found)
    c = found.covariance_m2
    full = np.stack([c[:, [0, 1, 2]], c[:, [1, 3, 4]], c[:, [2, 4, 5]]], axis=1)
    squares = np.einsum("mi,mij,mj->m", errors, np.linalg.inv(full), errors)
    assert squares.mean() / 3.0 == pytest.approx(1.0, abs=0.1)
    assert found.sigma_z_m == pytest.approx(np.sqrt(c[:, 5]))


def test_covariance_of_poses():
    # one camera errs at a time: its centre by 0.1 mm, its attitude by 0.1 mrad, in turn
    scene = simulate_port(FLAT, points=25, seed=3)
    for budget in ({"sigma_centre": 1e-4}, {"sigma_attitude": np.degrees(1e-4)}):
        total = np.zeros(len(scene.truth))
        for camera in range(len(scene.cameras)):
            for axis in range(3):
                other = adjusted_again(scene, moved(scene.cameras, camera, axis, *budget))
                total += (other - scene.truth)[:, 2] ** 2
        found = run(scene, scene.views, sigma_image=0.0, sigma_index=0.0, **budget)
        # first order: the steps are 1e-4, second order a few thousandths of the result
        assert found.sigma_z_m == pytest.approx(np.sqrt(total), rel=0.01)


def moved(cameras, camera, axis, what):
    """Return cameras of which one is shifted or turned along an axis."""
    centres, rotations, step = cameras.centres.copy(), cameras.rotations.copy(), np.zeros(3)
    step[axis] = 1e-4
    if what == "sigma_centre":
        centres[camera] += step
    else:
        rotations[camera] = Rotation.from_rotvec(step).as_matrix() @ rotations[camera]
    return dataclasses.replace(cameras, centres=centres, rotations=rotations)


def adjusted_again(scene, cameras):
    """Adjust the fixed image places through the port with other cameras, by numeric derivatives."""
    from tests.utils.port_scenes import fermat_directions

    owner = np.repeat(np.arange(len(scene.truth)), np.diff(scene.views.start))
    c, lens = scene.views.camera, scene.cameras.lenses[0]

    def images(xyz):
        local = np.einsum("oij,oj->oi", cameras.rotations[c], xyz[owner] - cameras.centres[c])
        w = fermat_directions(local, scene.port, scene.refractive_index)
        uv = lens.focal * w[:, :2] / w[:, 2:]
        return uv + np.array([lens.principal_x, lens.principal_y])

    xyz = scene.truth.copy()
    for _ in range(2):
        residual = scene.image_xy - images(xyz)
        jacobian = np.stack(
            [(images(xyz + 1e-4 * e) - images(xyz - 1e-4 * e)) / 2e-4 for e in np.eye(3)], axis=2
        )
        for i, (first, last) in enumerate(
            zip(scene.views.start, scene.views.start[1:], strict=False)
        ):
            a = jacobian[first:last].reshape(-1, 3)
            xyz[i] += np.linalg.lstsq(a, residual[first:last].ravel(), rcond=None)[0]
    return xyz


def test_limits(scene):
    widest = run(scene, scene.views).incidence_deg.max()
    limit = 0.3 * widest
    narrow = run(scene, scene.views, max_angle=limit)
    assert narrow.incidence_deg.max() <= limit < widest
    few = narrow.outcome != Outcome.CORRECTED
    assert few.any()
    assert not narrow.shift_m[few].any()


def test_cameras_refused():
    bare = Cameras(("a", "b"), np.array([[0.0, 0, 0], [1.0, 0, 0]]))
    turned = dataclasses.replace(bare, rotations=np.array([np.diag([1.0, -1.0, -1.0])] * 2))
    xyz = np.array([[0.0, 0, -2]])
    for cameras, missing in ((bare, ["angles", "lenses"]), (turned, ["lenses"])):
        with refused("cameras.no_orientation", missing=missing):
            correct_through_port(xyz, cameras, FLAT, ScienceOptions())

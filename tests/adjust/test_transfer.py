"""Points transferred from original to adjusted cameras, by straight rays."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.adjust.transfer import transfer
from pcfix.model import Cameras, Lens, Views
from tests.utils.consistent_twin import image_in, triangulated_straight

DOWN = np.diag([1.0, -1.0, -1.0])
STEP_M = 1e-6  # of the last step of the iteration, whose error is far below it


def lens_of(focal=1500.0, k1=-0.05):
    return Lens(focal, 2000.0, 1500.0, 1003.0, 746.0, radial=(k1, 0.01))


@pytest.fixture
def cameras():
    """Return twelve images from 60 m, tilted by some degrees each."""
    rng = np.random.default_rng(5)
    x, y = (grid.ravel() for grid in np.meshgrid([0.0, 20.0, 40.0, 60.0], [0.0, 20.0, 40.0]))
    centres = np.column_stack([x, y, 60.0 + rng.normal(0.0, 1.0, 12)])
    tilt = Rotation.from_rotvec(rng.normal(0.0, 0.05, (12, 3))).as_matrix()
    labels = tuple(f"i{i}" for i in range(12))
    return Cameras(labels, centres, tilt @ DOWN, (lens_of(),) * 12)


@pytest.fixture
def points():
    return np.random.default_rng(6).uniform((5.0, 5.0, -8.0), (55.0, 35.0, 6.0), (300, 3))


def everybody(n, k):
    return Views(np.arange(0, n * k + 1, k), np.tile(np.arange(k), n))


def disturbed(cameras, rng):
    """Return what an adjustment may have made of them: other centres, angles and lens."""
    turn = Rotation.from_rotvec(rng.normal(0.0, 5e-4, (len(cameras), 3))).as_matrix()
    return replace(
        cameras,
        centres=cameras.centres + rng.normal(0.0, 0.1, (len(cameras), 3)) + [0.1, -0.2, 0.3],
        rotations=turn @ cameras.rotations,
        lenses=(lens_of(1494.0, -0.052),) * len(cameras),
    )


def test_similarity(cameras, points):
    turn = Rotation.from_rotvec([0.01, -0.02, 0.5]).as_matrix()

    def taken(xyz):
        return 1.003 * xyz @ turn.T + [12.0, -3.0, 0.7]

    new = replace(cameras, centres=taken(cameras.centres), rotations=cameras.rotations @ turn.T)
    shift, moved = transfer(points, everybody(len(points), 12), cameras, new)
    assert moved.all()
    assert np.abs(points + shift - taken(points)).max() < STEP_M


def test_come_home(cameras, points):
    """The disturbed cameras' points are where their own straight rays nearly meet."""
    old = disturbed(cameras, np.random.default_rng(2))
    some = points[:40]
    data = np.array([
        triangulated_straight([image_in(cameras, c, xyz) for c in range(12)], old, range(12), xyz)
        for xyz in some
    ])  # fmt: skip
    shift, moved = transfer(data, everybody(40, 12), old, cameras)
    assert moved.all()
    away = np.sqrt(((data - some) ** 2).sum(axis=1).mean())
    left = np.sqrt(((data + shift - some) ** 2).sum(axis=1).mean())
    assert away > 0.2
    # what is lost is the residual of the old rays (1 px) times the change of the gradients
    assert left < 0.01 * away


def test_no_intersection(cameras, points):
    twice = Views(np.array([0, 0, 1, 3]), np.array([4, 7, 7]))
    shift, moved = transfer(
        points[:3], twice, cameras, disturbed(cameras, np.random.default_rng(3))
    )
    assert not moved.any()
    assert not shift.any()

"""The adjustment on simulated blocks: it comes home, and it is what scipy makes of them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.problem import solved_cameras, water_of
from pcfix.model import WaterPlane
from tests.utils.tie_blocks import adjusted, block_of
from tests.utils.tie_points import simulate_tie_points

FREE = np.inf


HOME_M = 1e-6  # without noise: Newton's steps end where the cost is rounding, 1e-9 m or better

SMALL = {"area_m": (50, 40), "greatest_depth_m": 5, "position_noise_m": 0.5,
         "attitude_noise_deg": 0.3}  # fmt: skip


OBLIQUE = {"block": "oblique", "obliques_deg": 30, "oblique_directions": 2, "oblique_share": 0.4}


@cache
def scene(points=80, **settings):
    return simulate_tie_points(points, **(SMALL | settings))


def misses(data, problem, found):
    """Return the largest errors of projection centres (m), angles (rad) and points (m)."""
    cameras = solved_cameras(problem, found)
    turn = cameras.rotations @ data.true_cameras.rotations.transpose(0, 2, 1)
    ties = found.state.xyz[: len(data.truth)] + problem.origin
    return (
        np.abs(cameras.centres - data.true_cameras.centres).max(),
        np.linalg.norm(Rotation.from_matrix(turn).as_rotvec(), axis=1).max(),
        np.abs(ties - data.truth).max(),
    )


def disturbed(data, seed=3, by_m=0.3):
    """Return wrong start values of the points."""
    return data.truth + np.random.default_rng(seed).normal(0.0, by_m, data.truth.shape)


@pytest.mark.parametrize(
    ("settings", "given"),
    [({}, {}), ({"tilt_percent": 2.0}, {}), (OBLIQUE, {}), ({}, {"gnss": False, "control": True})],
    ids=["nadir", "tilted water", "obliques", "control points only"],
)
def test_comes_home(settings, given):
    data = scene(**settings)
    block = block_of(data, exact=True, start_xyz=disturbed(data), **given)
    problem, found = adjusted(block, Unknowns(lens=()))
    assert max(misses(data, problem, found)) < HOME_M


def test_lens_and_water_come_home():
    lens = (-0.05, 0.02, -0.004, 1e-3, -5e-4)
    data = scene(distortion=lens, **OBLIQUE)
    right = data.true_cameras.lenses[0]
    wrong = replace(right, focal=right.focal + 20.0, principal_x=right.principal_x - 5.0)
    cameras = replace(data.cameras, lenses=(wrong,) * len(data.cameras))
    block = block_of(
        data, exact=True, control=True, cameras=cameras, start_xyz=disturbed(data),
        water=WaterPlane(data.water.a + 0.3), index=1.33,
    )  # fmt: skip
    unknowns = Unknowns(
        lens=("f", "cx", "cy"), surface={"level": FREE, "tilt": FREE, "index": FREE}
    )
    problem, found = adjusted(block, unknowns)
    assert max(misses(data, problem, found)) < HOME_M
    assert abs(found.lenses[0].focal - right.focal) < 1e-5  # px
    assert abs(found.state.water[3] - data.refractive_index) < 1e-7
    x, y = problem.origin[:2]
    plane = water_of(problem, found.state)
    assert abs(plane.a + plane.b * x + plane.c * y - data.water.a) < HOME_M


def test_free_network():
    """With the water level fixed, the images tell height and tilt; the rest is the start's."""
    data = scene()
    block = block_of(data, exact=True, gnss=False)
    problem, found = adjusted(block, Unknowns(lens=(), free_network=True))
    moved = found.state.centres + problem.origin - data.cameras.centres
    assert np.abs(moved[:, :2].mean(axis=0)).max() < 1e-6  # m: what the network holds
    # the network is the true one but for a turn about the vertical, a shift in plan and a scale
    # about the water
    a = data.true_cameras.centres - [*data.true_cameras.centres.mean(axis=0)[:2], data.water.a]
    b = found.state.centres + problem.origin
    b = b - [*b.mean(axis=0)[:2], data.water.a]
    s = np.sqrt((b * b).sum() / (a * a).sum())
    over, across = (a[:, :2] * b[:, :2]).sum(), a[:, 0] @ b[:, 1] - a[:, 1] @ b[:, 0]
    turn = Rotation.from_euler("z", np.arctan2(across, over)).as_matrix()
    np.testing.assert_allclose(b, s * a @ turn.T, atol=HOME_M)

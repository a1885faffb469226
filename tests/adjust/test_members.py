"""Members of an adjustment: what they scatter by, and which cameras they are known by."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.adjust.block import Unknowns
from pcfix.adjust.members import drawn, members_of
from pcfix.adjust.precision import precision_of
from pcfix.adjust.problem import solved_cameras, water_of
from pcfix.adjust.solve import moved_by
from tests.adjust.test_precision import adjusted, tiny
from tests.utils.tie_blocks import block_of


def test_draws_have_their_covariance():
    rng = np.random.default_rng(1)
    sigma = 10.0 ** np.arange(-6, 2)
    mix = rng.normal(size=(8, 8))
    covariance = mix @ mix.T * sigma * sigma[:, None]
    draws = drawn(covariance, 40_000)
    found = draws.T @ draws / len(draws)
    scale = np.sqrt(covariance.diagonal())
    assert np.abs((found - covariance) / scale / scale[:, None]).max() < 0.03


@pytest.mark.parametrize("poses", ["free", "similarity"])
def test_a_member_is_the_block_with_its_step(poses):
    unknowns = Unknowns(poses=poses, lens=("f", "k1"), level_sigma_m=0.1, tilt_sigma=0.01)
    problem, found = adjusted(block_of(tiny(), control=True), unknowns)
    size = len(problem.moves)
    active = np.flatnonzero(problem.moves)
    steps = np.random.default_rng(2).normal(0.0, 1e-3, (3, len(active)))
    members = members_of(problem, found, active, steps)
    nominal = solved_cameras(problem, found)
    order = np.arange(len(nominal))[::-1]
    shuffled = replace(
        nominal, labels=nominal.labels[::-1], centres=nominal.centres[order],
        rotations=nominal.rotations[order], lenses=nominal.lenses[::-1],
    )  # fmt: skip
    rows = members.rows_of(shuffled)
    assert rows.tolist() == order.tolist()
    for i, one in enumerate(steps):
        step = np.zeros(size)
        step[active] = one
        moved = moved_by(problem, found, step, np.zeros_like(found.state.xyz))
        wanted, got = solved_cameras(problem, moved), members.cameras(i, shuffled, rows)
        np.testing.assert_allclose(got.centres[order], wanted.centres, atol=1e-8)
        np.testing.assert_allclose(got.rotations[order], wanted.rotations, atol=1e-12)
        assert got.lenses[0].focal == pytest.approx(wanted.lenses[-1].focal, rel=1e-12)
        assert got.lenses[0].radial == pytest.approx(wanted.lenses[-1].radial, rel=1e-12)
        water, level = water_of(problem, found.state), water_of(problem, moved.state)
        shown = members.surface(i, water, nominal)
        x, y = nominal.centres[0, :2]
        assert shown.a + shown.b * x + shown.c * y == pytest.approx(
            level.a + level.b * x + level.c * y, abs=1e-7
        )


def test_they_scatter_as_the_adjustment_says():
    problem, found = adjusted(block_of(tiny()), Unknowns(lens=("f",)))
    precision = precision_of(problem, found, sigma0=2.0)
    members = precision.members
    squares = np.einsum("mki,kij->mkj", members.shift_m, found.state.rotations) ** 2
    wanted = precision.centre_sigma_m
    # 32 draws tell a standard deviation to an eighth
    np.testing.assert_allclose(np.sqrt(squares.mean(axis=0)), wanted, rtol=0.4)
    assert np.sqrt(squares.mean() / (wanted**2).mean()) == pytest.approx(1.0, abs=0.1)
    f = np.sqrt((members.lens[:, 0, 0] ** 2).mean())
    assert f == pytest.approx(precision.sigma_of("f"), rel=0.3)
    height = members.shift_m @ found.state.rotations[0][:, 2:]
    r = np.corrcoef(height[:, :, 0].mean(axis=1), members.lens[:, 0, 0])[0, 1]
    assert r == pytest.approx(precision.block_correlation[0, 0], abs=0.4)


def test_cameras_of_another_block_are_told():
    problem, found = adjusted(block_of(tiny()), Unknowns(lens=("f",)))
    members, cameras = precision_of(problem, found).members, solved_cameras(problem, found)
    turn = Rotation.from_rotvec([0.3, 0.2, 1.0]).as_matrix()
    elsewhere = replace(cameras, centres=0.9996 * cameras.centres @ turn.T + 5e5)
    assert members.rows_of(elsewhere) is not None
    far = cameras.centres.copy()
    far[0, 0] += 0.01
    longer = tuple(replace(lens, focal=lens.focal + 0.1) for lens in cameras.lenses)
    for other in (
        replace(cameras, centres=far),
        replace(cameras, lenses=longer),
        replace(cameras, labels=("other", *cameras.labels[1:])),
        replace(cameras, rotations=None, lenses=None),
    ):
        assert members.rows_of(other) is None

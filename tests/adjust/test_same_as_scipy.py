"""Solutions and covariances are those of scipy's least squares, with a Jacobian by differences."""

from dataclasses import replace

import numpy as np
import pytest

from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.precision import precision_of
from tests.adjust.test_conditions import at_level, block_with, put
from tests.utils.adjust_twin import Twin
from tests.utils.curved_water import under_curved_water
from tests.utils.tie_blocks import adjusted, block_of, tiny_scene

FREE = np.inf
INDEX_SIGMA = 0.01
WATER = {"level": FREE, "tilt": FREE}


def free_poses():
    return block_of(tiny_scene(11, tilt_percent=2.0), control=True), WATER | {"index": INDEX_SIGMA}


def fixed_poses():
    return block_of(tiny_scene(14), control=True, gnss=False), WATER | {"index": INDEX_SIGMA}


def curved_water():
    data = tiny_scene(14)
    curved = under_curved_water(data, np.array([4.8e-4, -2.4e-4, -3.6e-4]))
    block = block_of(curved, control=True, cameras=data.true_cameras, gnss=False)
    return block, WATER | {"shape": FREE}


def on_surfaces(parallel=()):
    data = tiny_scene(20, tilt_percent=1.0)
    data, on = put(data, {
        "water": (np.arange(4), at_level(data, data.water.b, data.water.c)),
        "floor": (np.arange(4, 10), at_level(data, 0.01, 0.0, 1.0)),
    })  # fmt: skip
    block = block_with(data, on, cameras=data.true_cameras, gnss=False)
    # the twin does not know of points that are never wet: a waterline that it meets from above
    return replace(block, wet=np.ones(len(block.wet), bool), parallel=parallel), WATER


def parallel_surfaces():
    return on_surfaces(("water", "floor"))


@pytest.mark.parametrize(
    "case", [free_poses, fixed_poses, curved_water, on_surfaces, parallel_surfaces]
)
def test_same_as_scipy(case):
    block, surface = case()
    is_free, lens = case is free_poses, ("f",) if "index" in surface else ()
    unknowns = Unknowns("free" if is_free else "fixed", lens, surface)
    problem, found = adjusted(block, unknowns)
    precision = precision_of(problem, found, sigma0=2.0)
    index_sigma = INDEX_SIGMA if "index" in surface else FREE
    twin = Twin(block, tuple(problem.names), is_free, index_sigma)
    x = twin.solve()
    centres, rotations, added, xyz = twin.parts(x)
    assert abs((twin.residuals(x) ** 2).sum() - found.cost) < 1e-6  # of about 250
    # m: a thousandth of the standard errors and less; both stop where the cost no longer changes
    np.testing.assert_allclose(found.state.centres, centres, atol=1e-5)
    np.testing.assert_allclose(found.state.xyz, xyz, atol=1e-5)
    np.testing.assert_allclose(found.state.rotations, rotations, atol=1e-6)
    for name, value in added.items():
        row = precision.shared[name]
        # the twin's planes are absolute, ours are corrections of a fitted start
        assert " of " in name or abs(row.after - row.before - value) < 1e-3 * row.sigma
    # 0.2 percent: what differences of an ill-conditioned Jacobian are good to
    sigma, g = 2.0 * np.sqrt(np.diag(covariance := twin.covariance(x))), twin.poses + len(added)
    shared = slice(twin.poses, g)
    np.testing.assert_allclose(precision.shared_sigma, sigma[shared], rtol=2e-3)
    np.testing.assert_allclose(precision.point_sigma_m, sigma[g:].reshape(-1, 3), rtol=2e-3)
    correlation = 4.0 * covariance[shared, shared] / np.outer(sigma[shared], sigma[shared])
    np.testing.assert_allclose(precision.correlation, correlation, atol=2e-3)
    for i, of_pose in enumerate(precision.pose_covariance):
        rows = slice(6 * i, 6 * i + 6)
        if is_free:
            unit = np.outer(sigma[rows], sigma[rows])
            np.testing.assert_allclose(
                of_pose / unit, 4.0 * covariance[rows, rows] / unit, atol=2e-3
            )
        assert is_free or not of_pose.any()

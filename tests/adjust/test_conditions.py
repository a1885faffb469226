"""Points that lie on the water or on planes, and planes that are parallel."""

from dataclasses import replace

import numpy as np
import pytest

from pcfix.adjust.parameters import PLANES, Unknowns
from pcfix.adjust.precision import precision_of
from pcfix.adjust.problem import prepare
from pcfix.adjust.result import redundancy_of
from pcfix.model import WaterPlane
from tests.utils import tie_blocks
from tests.utils.curved_water import under_curved_water
from tests.utils.tie_blocks import block_of
from tests.utils.tie_points import simulate_tie_points

FREE = np.inf
LEVEL = Unknowns(lens=(), surface={"level": FREE})
HOME_M = 1e-6
SIGMA_M = 0.01


def scene(points, **settings):
    given = {"area_m": (50, 40), "greatest_depth_m": 5, "position_noise_m": 0.2,
             "attitude_noise_deg": 0.2, "obliques_deg": 30, "oblique_directions": 2,
             "oblique_share": 0.4, "block": "oblique"}  # fmt: skip
    return simulate_tie_points(points, **(given | settings))


def put(data, surfaces):
    """Return a scene with points moved onto surfaces, and the surface of each point.

    `surfaces` maps a name to rows of the points and a function from their coordinates to new ones.
    """
    truth, on = data.truth.copy(), np.full(len(data.truth), "", object)
    for name, (rows, place) in surfaces.items():
        truth[rows], on[rows] = place(truth[rows]), name
    return under_curved_water(replace(data, truth=truth), np.zeros(3)), on


def at_level(data, b=0.0, c=0.0, depth=0.0):
    """Return what moves points to a plane so deep under the water at the middle."""
    x, y = np.round(data.true_cameras.centres.mean(axis=0))[:2]
    level = data.water.a + data.water.b * x + data.water.c * y - depth
    return lambda q: np.column_stack([q[:, :2], level + (q[:, :2] - [x, y]) @ [b, c]])


def block_with(data, on, **how):
    """Return a block in which all points are control points, most of them without coordinates."""
    block = block_of(data, **how)
    m, control = len(on), block.control
    on = (*on, *[""] * len(control.names))
    control = replace(
        control, names=tuple(f"P{i}" for i in range(len(on))), is_check=np.zeros(len(on), bool),
        xyz=np.vstack([np.full((m, 3), np.nan), control.xyz]), on=on,
        sigma_m=np.vstack([np.full((m, 3), np.inf), control.sigma_m]),
        on_sigma_m=np.full(len(on), SIGMA_M),
    )  # fmt: skip
    return replace(block, wet=np.array(on) != "water", control=control)


def without_surfaces(block):
    return replace(block, control=replace(block.control, on=()))


def adjusted(block, unknowns):
    problem, found = tie_blocks.adjusted(block, unknowns)
    return problem, found, precision_of(problem, found)


def test_come_home():
    data = scene(90)
    data, on = put(data, {
        "water": (np.arange(8), at_level(data)),
        "floor": (np.arange(8, 20), at_level(data, 0.02, -0.01, 2.0)),
    })  # fmt: skip
    block = block_with(data, on, exact=True, water=WaterPlane(data.water.a + 0.2))
    problem, found, _ = adjusted(block, LEVEL)
    assert problem.names == ["level", "level of floor", "tilt_x of floor", "tilt_y of floor"]
    truth = data.truth - problem.origin
    np.testing.assert_allclose(found.state.xyz[: len(truth)], truth, atol=HOME_M)
    floor = data.water.a - 2.0 - problem.origin[2], 0.02, -0.01
    np.testing.assert_allclose(found.state.water[PLANES:], floor, atol=HOME_M)
    assert found.state.water[0] == pytest.approx(data.water.a - problem.origin[2], abs=HOME_M)


def test_wall():
    data = scene(60)
    middle = np.round(data.true_cameras.centres.mean(axis=0))
    rows = np.flatnonzero(~data.is_wet)[:9]
    east = lambda q: np.column_stack([middle[0] + 0.1 * (q[:, 2] - data.water.a), q[:, 1:]])  # noqa: E731
    data, on = put(data, {"wall": (rows, east)})
    problem, found, _ = adjusted(block_with(data, on, exact=True), Unknowns(lens=()))
    assert problem.given.axis.tolist() == [2, 0]
    np.testing.assert_allclose(found.state.water[PLANES + 1 :], [0.0, 0.1], atol=1e-7)
    np.testing.assert_allclose(found.state.xyz + problem.origin, data.truth, atol=HOME_M)


def test_waterline():
    data = scene(200)
    rows = np.arange(10)
    data, on = put(data, {"water": (rows, at_level(data))})
    block = block_with(data, on, water=WaterPlane(data.water.a + 0.2), control=True)
    _, found, precision = adjusted(block, LEVEL)
    sigma = precision.shared["level"].sigma
    assert abs(found.shared[0] + 0.2) < 3.5 * sigma
    assert sigma < 0.9 * adjusted(without_surfaces(block), LEVEL)[2].shared["level"].sigma
    redundancies = [
        redundancy_of(prepare(one, LEVEL)[0]) for one in (block, without_surfaces(block))
    ]
    assert redundancies[0] == 10 + redundancies[1]


@pytest.mark.parametrize("parallel", [("floor", "deck"), ("water", "floor", "deck")])
def test_parallel(parallel):
    data = scene(120, tilt_percent=1.0)
    b, c = data.water.b, data.water.c
    data, on = put(data, {
        "floor": (np.arange(8), at_level(data, b, c, 2.0)),
        "deck": (np.arange(8, 12), at_level(data, b, c, -0.5)),
    })  # fmt: skip
    unknowns = Unknowns(lens=(), surface={"tilt": FREE})
    separate = adjusted(block_with(data, on, control=True), unknowns)[2]
    block = replace(block_with(data, on, control=True), parallel=parallel)
    problem, found, precision = adjusted(block, unknowns)
    floor, deck = found.state.water[PLANES:].reshape(2, 3)
    assert (floor[1:] == deck[1:]).all()
    if "water" in parallel:
        assert (floor[1:] == found.state.water[1:3]).all()
        assert problem.names == ["tilt_x", "tilt_y", "level of floor", "level of deck"]
        sigma = precision.shared["tilt_x"].sigma
        assert sigma < separate.shared["tilt_x"].sigma
    else:
        sigma = precision.shared["tilt_x of floor"].sigma
        assert sigma < min(separate.shared[f"tilt_x of {name}"].sigma for name in ("floor", "deck"))
    assert abs(floor[1] - b) < 3.5 * sigma

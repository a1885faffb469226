"""The shape of the water as an unknown: exact light through bent water comes home."""

from functools import cache

import numpy as np

from pcfix.adjust.methods import undetermined
from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.precision import precision_of
from pcfix.adjust.problem import water_of
from pcfix.model import WaterPlane, WaterRaster
from pcfix.water.surface import surface_above
from tests.utils import tie_blocks
from tests.utils.curved_water import under_curved_water
from tests.utils.tie_blocks import block_of, clear_of_the_waterline
from tests.utils.tie_points import simulate_tie_points

FREE = np.inf
SHAPED = Unknowns(lens=(), surface={"level": FREE, "tilt": FREE, "shape": FREE})
CURVATURE = np.array([1.2e-4, -6e-5, -9e-5])
"""1/m: 6 cm at 25 m from the middle, as before a weir."""
SCENE = {
    "area_m": (50, 40), "greatest_depth_m": 5, "position_noise_m": 0.2, "attitude_noise_deg": 0.2,
    "block": "oblique", "obliques_deg": 30, "oblique_directions": 2, "oblique_share": 0.4,
}  # fmt: skip


@cache
def scene(points, curvature=tuple(CURVATURE), **settings):
    data = simulate_tie_points(points, **(SCENE | settings))
    # the straight images of points that the bend puts under water or lifts out of it have a kink
    return under_curved_water(clear_of_the_waterline(data, 0.4), np.array(curvature))


def adjusted(block, unknowns=SHAPED):
    problem, found = tie_blocks.adjusted(block, unknowns)
    return problem, found, precision_of(problem, found)


def test_comes_home():
    data = scene(150)
    start = WaterPlane(data.water.a + 0.1)
    block = block_of(data, exact=True, control=True, water=start)
    problem, found, _ = adjusted(block)
    np.testing.assert_allclose(
        found.state.water[4:7], CURVATURE, atol=1e-10
    )  # 1/m: 0.06 um at 25 m
    ties = found.state.xyz[: len(data.truth)] + problem.origin
    np.testing.assert_allclose(ties, data.truth, atol=1e-6)  # m: Newton's last step
    water = water_of(problem, found.state)
    assert isinstance(water, WaterRaster)
    x, y = (data.truth - problem.origin)[:, :2].T
    wanted = data.water.a + CURVATURE @ [x * x, x * y, y * y]
    # m: between the centres of cells of half a metre the raster is bilinear, and this much bent
    np.testing.assert_allclose(surface_above(water, data.truth).height_m, wanted, atol=2e-5)


def test_undetermined_shape():
    data = scene(60)
    precision = adjusted(block_of(data, control=True, sigma_px=8.0))[2]
    shape = {"shape_xx", "shape_xy", "shape_yy"}
    assert shape <= {one.values["unknown"] for one in undetermined(precision)}

"""The shape of the water as an unknown: exact light through curved water comes home."""

import numpy as np

from pcfix.adjust.methods import undetermined
from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.precision import precision_of
from pcfix.adjust.problem import water_of
from pcfix.model import WaterPlane, WaterRaster
from pcfix.water.surface import surface_above
from tests.adjust.test_conditions import scene
from tests.utils.curved_water import under_curved_water
from tests.utils.tie_blocks import adjusted, block_of, clear_of_the_waterline

FREE = np.inf
SHAPED = Unknowns(lens=(), surface={"level": FREE, "tilt": FREE, "shape": FREE})
CURVATURE = np.array([1.2e-4, -6e-5, -9e-5])  # 1/m: 6 cm at 25 m from the middle, as before a weir


def curved(points):
    # the straight images of points that the curve puts under water or lifts out of it have a kink
    return under_curved_water(clear_of_the_waterline(scene(points), 0.4), CURVATURE)


def test_comes_home():
    data = curved(150)
    start = WaterPlane(data.water.a + 0.1)
    problem, found = adjusted(block_of(data, exact=True, control=True, water=start), SHAPED)
    # 1/m: 0.06 um at 25 m
    np.testing.assert_allclose(found.state.water[4:7], CURVATURE, atol=1e-10)
    ties = found.state.xyz[: len(data.truth)] + problem.origin
    np.testing.assert_allclose(ties, data.truth, atol=1e-6)  # m: Newton's last step
    water = water_of(problem, found.state)
    assert isinstance(water, WaterRaster)
    x, y = (data.truth - problem.origin)[:, :2].T
    wanted = data.water.a + CURVATURE @ [x * x, x * y, y * y]
    # m: between the centres of cells of half a metre the raster is bilinear, and this much curved
    np.testing.assert_allclose(surface_above(water, data.truth).height_m, wanted, atol=2e-5)


def test_undetermined_shape():
    block = block_of(curved(60), control=True, sigma_px=8.0)
    shape = {"shape_xx", "shape_xy", "shape_yy"}
    found = undetermined(precision_of(*adjusted(block, SHAPED)))
    assert shape <= {one.values["unknown"] for one in found}

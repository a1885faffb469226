"""Every cell of a small cloud against a slow implementation; shades and contours."""

from fractions import Fraction

import numpy as np
import pytest

from pcfix.flow.dsm import grid_dsm
from pcfix.grid.lattice import cells_of
from pcfix.grid.maps import contours, depth_interval, hillshade
from tests.grid.clouds import EAST, NORTH, SCALE, scattered, write
from tests.grid.twins import exact, slow_hillshade, slow_raster
from tests.utils.nightly import mostly_nightly
from tests.utils.rasters import read_raster

pytestmark = pytest.mark.quick_but("test_every_cell")

METHODS = ("mean", "median", "min", "max", "tin")

# Heights reach 30 m; half the distance of neighbouring float32 numbers there is 1e-6 m.
FLOAT32_M = 2e-6


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    xyz = scattered(36, 6.0, 5.0)
    xyz[:3, :2] = (EAST + 2.0, NORTH + 3.0), (EAST + 2.7, NORTH + 3.0), (EAST + 3.0, NORTH + 1.9)
    xyz[3:5] = xyz[3] + ((0, 0, 0), (0, 0, 1.5))  # the same place twice
    return write(tmp_path_factory.mktemp("cells") / "cloud.las", xyz), xyz


KINDS = [(m, r) for m in METHODS for r in ("1", "0.7", "0.1") if (m, r) != ("tin", "0.1")]


@pytest.mark.parametrize(
    ("method", "resolution"), mostly_nightly(KINDS, *((m, r) for m, r in KINDS if r != "0.7"))
)
def test_every_cell(cloud, tmp_path, method, resolution):
    path, xyz = cloud
    files = tmp_path / "d.tif", tmp_path / "n.tif"
    options = {"resolution": float(resolution), "method": method, "counts": files[1]}
    summary = grid_dsm(path, files[0], **options)
    steps = np.rint((xyz - (EAST, NORTH, 0.0)) / float(SCALE))
    axes = [exact(steps[:, i], SCALE, (int(EAST), int(NORTH), 0)[i]) for i in range(3)]
    side, widest = Fraction(resolution), (summary.hole_m or 0.0) / float(resolution)
    left, top, height, count, spread = slow_raster(*axes, side, method.replace("tin", "mean"))
    if method == "tin":  # points and spread are still of all points
        height = slow_raster(*one_a_place(*axes), side, method, widest)[2]
    raster = read_raster(files[0])
    array = np.vstack([raster.array, read_raster(files[1]).array])
    found = np.where(array == raster.nodata, np.nan, array)
    assert array.shape == (3, *height.shape)
    assert raster.transform.c == pytest.approx(left * float(resolution), abs=1e-9)
    assert raster.transform.f == pytest.approx((top + 1) * float(resolution), abs=1e-9)
    np.testing.assert_allclose(found[0], height, rtol=0, atol=FLOAT32_M)
    np.testing.assert_array_equal(found[1], count)
    np.testing.assert_allclose(found[2], spread, rtol=0, atol=FLOAT32_M)
    assert summary.cells == (count > 0).sum()
    assert summary.empty == np.isnan(height).sum()
    assert summary.filled == ((count == 0) & ~np.isnan(height)).sum()
    assert summary.points_per_cell == pytest.approx(len(xyz) / summary.cells)


def one_a_place(x, y, z):
    places: dict = {}
    for a, b, c in zip(x, y, z, strict=True):
        places.setdefault((a, b), []).append(c)
    mean = [sum(heights) / len(heights) for heights in places.values()]
    return [a for a, _ in places], [b for _, b in places], mean


@pytest.mark.parametrize("resolution", ["0.1", "0.3", "0.05", "0.025", "7", "0.0007"])
def test_points_on_edges(resolution):
    """Whole multiples of the resolution are edges, whatever floating point makes of them."""
    size = Fraction(resolution)
    number = np.random.default_rng(1).integers(-60_000_000, 60_000_000, (500, 2))
    xy = np.array([[float(Fraction(int(v)) * size) for v in row] for row in number])
    cells = cells_of(xy, float(resolution))
    np.testing.assert_array_equal(cells[:, 0], number[:, 0])
    np.testing.assert_array_equal(cells[:, 1], -number[:, 1] - 1)


def test_hillshade():
    rng = np.random.default_rng(2)
    height = rng.normal(0.0, 0.4, (9, 11))
    height[rng.random(height.shape) < 0.2] = np.nan
    around = np.full((11, 13), np.nan)
    around[1:-1, 1:-1] = height
    light = hillshade(around, 0.5)
    np.testing.assert_array_equal(light, slow_hillshade(height, 0.5, 315.0, 45.0))


def test_rings_of_a_cone():
    """A bowl of 1 in 10 about the middle: the ring of a level has ten times its radius."""
    row, column = np.mgrid[:201, :201]
    depth = 0.1 * np.hypot(row - 100.0, column - 80.0)
    depth[:40, 150:] = np.nan
    found = contours(depth, 2.0)
    assert {level for level, _ in found} == {2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0}
    for level, place in found:
        radius = np.hypot(*(place - (80.0, 100.0)).T)
        away = place[:, 1] > 43.0  # by the gap the filter takes one side alone
        np.testing.assert_allclose(radius[away], 10.0 * level, atol=0.6)
        inside = np.rint(place).astype(int)
        assert np.isfinite(depth[inside[:, 1], inside[:, 0]]).all()
    assert contours(np.full((5, 5), np.nan), 1.0) == []


def test_depth_interval():
    depth, unknown = np.array([[0.0, 1.0], [np.nan, 12.0]]), np.array([np.nan, 1.5, 1.5])
    assert depth_interval(depth, np.zeros(0)) == 1.0
    assert depth_interval(np.array([1.0]), np.zeros(0)) == pytest.approx(0.1)
    assert depth_interval(np.array([1.0]), np.array([0.3])) == pytest.approx(0.5)
    assert depth_interval(np.array([80.0]), np.zeros(0)) == 10.0
    assert depth_interval(depth, unknown) == 2.0
    assert depth_interval(np.full((2, 2), np.nan), unknown) == 2.0

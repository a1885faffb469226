"""Rasters as water surfaces, and a level that moves: against planes, meshes and slow twins."""

import math

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

import pcfix
from pcfix.model import WaterRaster
from pcfix.water.surface import surface_above
from tests.utils.twins import correct_under

UTM = np.array([512_345.0, 4_987_654.0, 0.0])
MICROMETRE = 1e-6
HALF = 60.0  # metres from the middle to the edge of the rasters


def raster(surface, cell=(1.0, 1.0), half=HALF, origin=UTM):
    """Return a raster of z = surface(x, y), x and y from `origin`."""
    x = np.arange(-half + cell[0] / 2, half, cell[0])
    y = np.arange(half - cell[1] / 2, -half, -cell[1])
    heights = surface(x[None, :], y[:, None]) + np.zeros((len(y), len(x)))
    return WaterRaster(heights, origin[0] - half, origin[1] + half, cell)


def bilinear(water, origin=UTM):
    """Return scipy's interpolation of a raster, x and y from `origin`."""
    rows, columns = water.height_m.shape
    x = water.left_m - origin[0] + (np.arange(columns) + 0.5) * water.cell_m[0]
    y = water.top_m - origin[1] - (np.arange(rows) + 0.5) * water.cell_m[1]
    found = RegularGridInterpolator(
        (y[::-1], x), water.height_m[::-1], bounds_error=False, fill_value=None
    )
    return lambda px, py: float(found([[py, px]])[0])


def plane(a, b, c):
    return lambda x, y: a + b * x + c * y


def in_utm(abc):
    """Return z = a + b x + c y, x and y from `UTM`."""
    a, b, c = abc
    return pcfix.WaterPlane(a - b * UTM[0] - c * UTM[1], b, c)


def waves(x, y):
    return 0.3 + 0.003 * x + 0.15 * np.sin(x / 4.0) * np.cos(y / 3.0)


def weir(x, y):
    return 0.25 * np.tanh(-x / 1.5) + 0.002 * y  # half a metre over 3 m


def cameras(k=5, spread=35.0, height=60.0, seed=4):
    rng = np.random.default_rng(seed)
    centres = np.column_stack([rng.uniform(-spread, spread, (k, 2)), height + rng.normal(0, 2, k)])
    return pcfix.Cameras(tuple(map(str, range(k))), centres + UTM)


def bed(n=60, spread=20.0, seed=6):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-spread, spread, (n, 2)), rng.uniform(-8, -1, n)]) + UTM


def test_height():
    water = raster(waves, (0.7, 1.1), half=15.4)
    plan = np.random.default_rng(0).uniform(-18, 18, (4000, 2))
    found = surface_above(water, np.column_stack([plan, np.zeros(4000)]) + UTM)
    inside = (np.abs(plan) <= 15.4).all(axis=1)
    assert np.array_equal(np.isfinite(found.height_m), inside)
    expected = [bilinear(water)(*at) for at in plan[inside]]
    # coordinates of UTM have steps of 1e-9 m, the slope is below 0.1
    assert found.height_m[inside] == pytest.approx(expected, abs=1e-9)


def test_slope():
    water = raster(waves, (0.7, 1.1))
    plan, step = np.random.default_rng(1).uniform(-50, 50, (500, 2)), 1e-4
    here = np.column_stack([plan, np.zeros(500)]) + UTM
    slope = surface_above(water, here).slope
    for axis in (0, 1):
        aside = np.zeros(3)
        aside[axis] = step
        ends = [surface_above(water, here + sign * aside).height_m for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * step)
        # where the step crosses into another patch the slope differs
        assert np.mean(np.abs(slope[:, axis] - difference) < 1e-6) > 0.99


@pytest.mark.filterwarnings("ignore:.*does not cover:pcfix.errors.PcfixWarning")
def test_unknown_cell():
    water = raster(plane(0.0, 0, 0), half=5.0)
    water.height_m[4, 3] = np.nan  # its centre lies at (-1.5, 0.5)
    at = np.array([[-2.4, 0.5, -1], [-1.5, 1.4, -1], [-2.6, 0.5, -1], [-0.4, 0.5, -1], [9, 0, -1]])
    known = np.isfinite(surface_above(water, at + UTM).height_m)
    assert known.tolist() == [False, False, True, True, False]
    high = pcfix.Cameras(("a", "b"), np.array([[-9.0, 0, 50], [9, 0, 50]]) + UTM)
    result = pcfix.correct_points(at + UTM, high, water)
    assert result.water_known.tolist() == known.tolist()
    assert result.submerged.tolist() == known.tolist()
    assert np.array_equal(result.xyz[~known], (at + UTM)[~known])


@pytest.mark.parametrize("abc", [(0.4, 0.0, 0.0), (0.2, 0.003, -0.002), (-0.1, 0.04, 0.03)])
@pytest.mark.parametrize("options", [{}, {"max_angle": 25.0}])
def test_raster_of_plane(abc, options):
    one, other = (
        pcfix.correct_points(bed(), cameras(), water, **options)
        for water in (raster(plane(*abc)), in_utm(abc))
    )
    assert np.array_equal(one.outcome, other.outcome)
    assert one.corrected.any()
    assert one.xyz == pytest.approx(other.xyz, abs=MICROMETRE)
    assert one.depth_m == pytest.approx(other.depth_m, abs=MICROMETRE)
    assert one.incidence_deg == pytest.approx(other.incidence_deg, abs=1e-6)


@pytest.mark.parametrize("surface", [waves, weir])
def test_twin_on_raster(surface):
    water = raster(surface)
    points, block = bed(), cameras()
    result = pcfix.correct_points(points, block, water)
    assert result.corrected.all()
    field = bilinear(water)
    for point, found in zip(points - UTM, result.xyz - UTM, strict=True):
        expected = correct_under(field, point, block.centres - UTM, 1.34)
        # heights are known to 1e-9 m and slopes of the twin to 1e-8
        assert found == pytest.approx(expected, abs=MICROMETRE)


def test_beyond_edge():
    # the raster ends 0.3 m beyond the point; its rays pass the water 1.5 to 3 m away
    abc = (0.1, 0.02, -0.01)
    small = raster(plane(*abc), (0.25, 0.25), half=2.0)
    points = np.array([[1.7, 1.7, -4.0], [-1.9, 0.3, -6.0]]) + UTM
    one, other = (pcfix.correct_points(points, cameras(), water) for water in (small, in_utm(abc)))
    assert one.corrected.all()
    assert one.xyz == pytest.approx(other.xyz, abs=MICROMETRE)


# A level that moves


def surface_of(kind, up=0.0):
    corners = np.array([[-60.0, -60], [60, -60], [60, 60], [-60, 60]])
    vertices = np.column_stack([corners, 0.2 + up + 0.003 * corners[:, 0]]) + UTM
    return {
        "level": 0.2 + up,
        "plane": in_utm((0.2 + up, 0.003, 0.0)),
        "mesh": pcfix.WaterMesh(vertices, np.array([[0, 1, 2], [0, 2, 3]])),
        "raster": raster(lambda x, y: waves(x, y) + up),
    }[kind]


@pytest.mark.parametrize("kind", ["level", "plane", "mesh", "raster"])
def test_one_offset(kind):
    points, up = (bed(), cameras()), 0.31
    one = pcfix.correct_points(*points, surface_of(kind), level_offset_m=np.full(5, up))
    other = pcfix.correct_points(*points, surface_of(kind, up))
    assert one.xyz == pytest.approx(other.xyz, abs=1e-8)
    assert one.depth_m + up == pytest.approx(other.depth_m, abs=1e-8)  # of the surface given


@pytest.mark.parametrize("kind", ["plane", "raster"])
def test_twin_of_offsets(kind):
    offset = np.array([-0.4, 0.3, 0.0, 0.7, -0.2])
    result = pcfix.correct_points(bed(), cameras(), surface_of(kind), level_offset_m=offset)
    base = bilinear(surface_of("raster")) if kind == "raster" else plane(0.2, 0.003, 0.0)
    own = [lambda x, y, up=up: base(x, y) + up for up in offset]
    for point, found in zip(bed() - UTM, result.xyz - UTM, strict=True):
        expected = correct_under(own, point, cameras().centres - UTM, 1.34)
        assert found == pytest.approx(expected, abs=MICROMETRE)


def test_dry_camera():
    """Its own water lay below the apparent point, so that nothing bent its light."""
    centres = np.array([[-20.0, 0, 50], [20.0, 0, 50]])
    two, point = pcfix.Cameras(("wet", "dry"), centres), np.array([[0.0, 0, -0.1]])
    result = pcfix.correct_points(point, two, 0.0, level_offset_m=[0.2, -0.2])
    angle_in_water = math.asin(math.sin(math.atan2(20.0, 50.1)) / 1.34)
    entry = -20.0 + 20.0 * (50.0 - 0.2) / 50.1  # where the wet ray meets its water
    slope, dry = math.tan(angle_in_water), 20.0 / 50.1
    # entry + slope (0.2 - z) = (z + 0.1) dry
    z = (entry + 0.2 * slope - 0.1 * dry) / (slope + dry)
    assert result.xyz[0] == pytest.approx([(z + 0.1) * dry, 0.0, z], abs=1e-9)

"""The four backward tracers against brentq on planes, Snell forwards and Fermat by scipy."""

import math
from functools import partial

import numpy as np
import pytest

from pcfix.errors import SettingError
from pcfix.model import WaterDimension, WaterMesh, WaterPlane
from pcfix.refract.tracing import METHODS, trace
from tests.refract import test_surfaces as surfaces
from tests.utils.codes import refused
from tests.utils.tracing_twin import direction, through_plane, through_surface
from tests.utils.twins import refract_ray

INDEX = 1.34
UTM, HALF = surfaces.UTM, surfaces.HALF  # metres from the middle to the edge of rasters and meshes

each_method = pytest.mark.parametrize("method", METHODS)


def pairs(count, seed=0, steepest_deg=65.0, low=-8.0, high=-0.5):
    """Return points under a level of zero, and a camera for each."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-15, 15, (count, 2)), rng.uniform(low, high, count)])
    height = rng.uniform(15.0, 50.0, count)
    aside = height * np.tan(np.radians(rng.uniform(0.0, steepest_deg, count)))
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    centres = np.column_stack([aside * np.cos(angle), aside * np.sin(angle), height])
    centres[:, :2] += points[:, :2]
    return points, centres


def waves(slope_deg):
    """Return z(x, y) of crossing waves 6 m long."""
    wave = 2.0 * math.pi / 6.0
    high = 0.5 * math.tan(math.radians(slope_deg)) / wave
    return lambda x, y: high * (np.sin(wave * x) + np.sin(wave * y + 0.7))


raster = partial(surfaces.raster, cell=(0.5, 0.5), origin=(0.0, 0.0))
bilinear = partial(surfaces.bilinear, origin=(0.0, 0.0))


def folded(slope):
    """Return two facets that meet in a crease along y: a trough where the slope is positive."""
    corners = [[x, y, slope * abs(x)] for x in (-HALF, 0.0, HALF) for y in (-HALF, HALF)]
    triangles = [[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]]
    return WaterMesh(np.array(corners), np.array(triangles))


def normal_at(surface, x, y, d=1e-5):
    """Return the normal by differences inside a patch; None across the edge of one."""
    east, west = surface(x + d, y) - surface(x, y), surface(x, y) - surface(x - d, y)
    north, south = surface(x, y + d) - surface(x, y), surface(x, y) - surface(x, y - d)
    if max(abs(east - west), abs(north - south)) > 1e-3 * d:
        return None
    normal = np.array([-(east + west) / (2 * d), -(north + south) / (2 * d), 1.0])
    return normal / np.linalg.norm(normal)


@each_method
@pytest.mark.parametrize("plane", [(0.0, 0.0, 0.0), (0.3, 0.02, -0.01), (-0.2, 0.0, 0.1)])
def test_planes(method, plane):
    points, centres = pairs(60)
    points[:, 2] += plane[0] + points[:, :2] @ plane[1:]
    found = trace(centres, points, WaterPlane(*plane), refractive_index=INDEX, method=method)
    assert found.converged.all()
    assert not found.on_crease.any()
    for p, c, a, d in zip(points, centres, found.piercing_xyz, found.direction, strict=True):
        truth = through_plane(p, c, plane, INDEX)
        # a miss of 1e-9 m at the point is less than that at the surface, up to grazing light
        np.testing.assert_allclose(a, truth, rtol=0.0, atol=3e-9)
        np.testing.assert_allclose(d, direction(truth, c), rtol=0.0, atol=1e-9)


@each_method
@pytest.mark.parametrize("incidence_deg", [0.0, 30.0, 80.0, 89.0])
def test_there_and_back(method, incidence_deg):
    i = math.radians(incidence_deg)
    leaves = np.array([40.0 * math.tan(i), 0.0, 0.0])
    down = refract_ray(np.array([math.sin(i), 0.0, -math.cos(i)]), np.array([0.0, 0.0, 1.0]), INDEX)
    point = leaves + 6.0 * down
    found = trace([0.0, 0.0, 40.0], point, WaterPlane(0.0), refractive_index=INDEX, method=method)
    # at 89 degrees a miss of 1e-9 m is 1e-9 / cos^2 of the incidence at the surface
    np.testing.assert_allclose(found.piercing_xyz[0], leaves, rtol=0.0, atol=4e-6)


@each_method
@pytest.mark.parametrize("slope_deg", [1.0, 5.0])
def test_waves(method, slope_deg):
    water = raster(waves(slope_deg))
    surface = bilinear(water)
    points, centres = pairs(80, steepest_deg=45.0)
    found = trace(centres, points, water, refractive_index=INDEX, method=method)
    assert found.converged.all()
    tested = 0
    for i in np.flatnonzero(~found.on_crease):
        a = found.piercing_xyz[i]
        # heights of the raster are smooth to 1e-12 m
        assert abs(surface(a[0], a[1]) - a[2]) < 1e-9
        normal = normal_at(surface, a[0], a[1])
        if normal is None:
            continue
        down = refract_ray(direction(a, centres[i]), normal, INDEX)
        miss = (points[i] - a) - ((points[i] - a) @ down) * down
        # the normal by differences over 1e-5 m is good to 1e-9, times 8 m of water
        assert np.linalg.norm(miss) < 5e-8
        tested += 1
    assert tested > 50


@each_method
def test_crease(method):
    water = raster(waves(12.0), cell=(1.0, 1.0))
    surface = bilinear(water)
    points, centres = pairs(150, seed=4, steepest_deg=40.0)
    found = trace(centres, points, water, refractive_index=INDEX, method=method)
    creases = np.flatnonzero(found.on_crease)
    assert len(creases) > 3

    def length(a, i):
        return np.linalg.norm(a - centres[i]) + INDEX * np.linalg.norm(a - points[i])

    for i in creases:
        a = found.piercing_xyz[i]
        nearby = a[:2] + np.array([[0.0, 0.0], [2e-3, 1e-3], [-1e-3, 2e-3]])
        other = through_surface(points[i], centres[i], surface, INDEX, nearby)
        # a crease is met to 1e-7 m, across it the length changes by 0.1 a metre
        assert length(a, i) < length(other, i) + 1e-8


def test_several_paths():
    # under a ridge two rays hit the point; the one from the camera's side is the shorter
    water, point, centre = folded(-0.3), np.array([0.0, 0.0, -9.0]), np.array([0.5, 3.0, 30.0])
    found = trace(centre, point, water, refractive_index=INDEX, method="scattershot")

    def surface(x, y):
        return -0.3 * abs(x)

    starts = np.array([[-1.0, 0.0], [1.0, 0.0], [-0.1, 1.0], [0.1, 1.0]])
    truth = through_surface(point, centre, surface, INDEX, starts)
    assert truth[0] > 0.1
    # the length is flat within 1e-6 m of the truth, where Nelder-Mead ends
    np.testing.assert_allclose(found.piercing_xyz[0], truth, rtol=0.0, atol=5e-6)


@each_method
def test_shapes_far_from_origin(method):
    plane = (0.3, 0.02, -0.01)
    points, centres = pairs(40, steepest_deg=40.0)
    points[:, 2] += plane[0] + points[:, :2] @ plane[1:]
    surface = surfaces.plane(*plane)
    corners = np.array([[x, y, surface(x, y)] for x in (-HALF, HALF) for y in (-HALF, HALF)])
    mesh = WaterMesh(corners + UTM, np.array([[0, 2, 1], [1, 2, 3]]))
    # the plane's a of 40 km is good to 1e-11 m
    for water in (raster(surface, origin=UTM), mesh, surfaces.in_utm(plane)):
        found = trace(centres + UTM, points + UTM, water, refractive_index=INDEX, method=method)
        for p, c, d in zip(points, centres, found.direction, strict=True):
            truth = direction(through_plane(p, c, plane, INDEX), c)
            # northings of 5e6 m are good to 1e-9 m, seen from 15 m
            np.testing.assert_allclose(d, truth, rtol=0.0, atol=1e-9)


@each_method
@pytest.mark.parametrize("water", [WaterPlane(0.0), raster(waves(2.0)), folded(0.01)])
def test_seen_straight(method, water):
    points = np.array([[1.0, 2.0, 4.0], [500.0, 2.0, -4.0]])
    if isinstance(water, WaterPlane):
        points = points[:1]
    centre = np.array([5.0, 3.0, 40.0])
    found = trace(centre, points, water, refractive_index=INDEX, method=method)
    assert found.converged.all()
    np.testing.assert_array_equal(found.piercing_xyz, points)
    straight = (points - centre) / np.linalg.norm(points - centre, axis=1)[:, None]
    np.testing.assert_allclose(found.direction, straight, rtol=0.0, atol=1e-15)


@each_method
def test_lost(method):
    points = np.array([[0.0, 0.0, -3.0], [0.0, 0.0, -3.0], [59.9, 0.0, -9.0], [np.nan, 0.0, -1.0]])
    centres = np.array([[1, 0, 30.0], [1, 0, -0.5], [120, 0, 20.0], [1, 0, 30.0]])
    found = trace(centres, points, raster(waves(1.0)), refractive_index=INDEX, method=method)
    # seen; camera in the water; leaves beyond the edge; no point
    assert found.converged.tolist() == [True, False, False, False]
    assert np.isnan(found.direction[1:]).all()
    assert np.isfinite(found.direction[0]).all()


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"method": "newton"}, "option.choice"),
        ({"refractive_index": 0.75}, "option.range"),
        ({"refractive_index": math.nan}, "option.range"),
        ({"target": np.zeros((4, 3))}, "trace.shapes"),
        ({"target": np.zeros((2, 2))}, "trace.shapes"),
        ({"water": WaterDimension("w_surf")}, "trace.surface"),
    ],
)
def test_refused(change, code):
    given = {
        "target": np.zeros((3, 3)),
        "origin": np.ones((3, 3)),
        "water": WaterPlane(0.0),
        "refractive_index": INDEX,
    }
    with refused(code, SettingError):
        trace(**(given | change))

"""Formulas of Mulsow 2024, slides "Raytracing", as printed and as they hold; MDFRT's condition."""

import numpy as np
import pytest

import pcfix
from pcfix.model import WaterMesh, WaterPlane
from tests.refract.tracing.test_paths import HALF, bilinear, normal_at, raster, waves
from tests.utils.twins import bend

INDEX = 1.34
CENTRE = np.array([4.0, -7.0, 40.0])


def glassner(ray, normal, n_t):
    """Return L_(t+1) = L_t / n_t + (C / n_t - sqrt(1 + (C^2 - 1) / n_t^2)) N_t, C = -N_t.L_t."""
    c = -normal @ ray
    return ray / n_t + (c / n_t - np.sqrt(1.0 + (c * c - 1.0) / n_t**2)) * normal


def distance(point, pierced, ray):
    """Return the perpendicular from a line to a point: MDFRT's, with its signs put right."""
    return point - pierced - ray @ (point - pierced) / (ray @ ray) * ray


def test_glassners_index_is_that_of_the_next_medium_over_that_of_this():
    """The slide prints n_t = n_t / n_(t+1): with it a ray from air would bend off the normal."""
    ray = np.array([0.3, -0.2, -0.8]) / np.linalg.norm([0.3, -0.2, -0.8])
    normal = np.array([0.05, 0.02, 1.0]) / np.linalg.norm([0.05, 0.02, 1.0])
    bent = glassner(ray, normal, INDEX / 1.0)
    sines = [np.linalg.norm(np.cross(one, normal)) for one in (ray, bent)]
    assert sines[0] == pytest.approx(INDEX * sines[1], rel=1e-14)
    printed = glassner(ray, normal, 1.0 / INDEX)
    assert np.linalg.norm(np.cross(printed, normal)) == pytest.approx(INDEX * sines[0], rel=1e-14)


def test_the_printed_distance_is_no_perpendicular():
    """It has P_0 for P, and P_1 - P in the last term with the sign that P - P_1 asks for."""
    point, pierced, ray = np.array([[1.0, 2.0, -5.0], [1.5, 1.0, 0.1], [0.1, 0.2, -0.9]])
    right = distance(point, pierced, ray)
    assert right @ ray == pytest.approx(0.0, abs=1e-14)
    along = (point - pierced) @ ray
    for first in (point, CENTRE):
        printed = first - pierced - ray @ (pierced - point) / (ray @ ray) * ray
        assert abs(printed @ ray) > 0.1 * abs(along)


def crossing(height_at, aim):
    """Return where the straight line from the camera to an aim crosses a surface, by bisection."""
    low, high = 0.0, 1.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        x, y, z = CENTRE + middle * (aim - CENTRE)
        low, high = (middle, high) if z > height_at(x, y) else (low, middle)
    return CENTRE + low * (aim - CENTRE)


def surfaces():
    slope = WaterPlane(0.2, 0.03, -0.02)

    def tilted(x, y):
        return slope.a + slope.b * x + slope.c * y

    corners = [[x, y, tilted(x, y)] for x in (-HALF, HALF) for y in (-HALF, HALF)]
    mesh = WaterMesh(np.array(corners), np.array([[0, 2, 1], [1, 2, 3]]))
    wavy = raster(waves(4.0))
    return [
        pytest.param(WaterPlane(0.0), lambda x, y: 0.0, id="plane"),
        pytest.param(slope, tilted, id="tilted"),
        pytest.param(mesh, tilted, id="mesh"),
        pytest.param(wavy, bilinear(wavy), id="raster"),
    ]


@pytest.mark.parametrize(("water", "height_at"), surfaces())
def test_mdfrt_ends_where_the_distance_is_nothing(water, height_at):
    """Rays of the direction found, and of directions beside it, traced forwards in numpy."""
    rng = np.random.default_rng(8)
    points = np.column_stack([rng.uniform(-12, 12, (12, 2)), rng.uniform(-8.0, -1.0, 12)])
    found = pcfix.trace(CENTRE, points, water, refractive_index=INDEX, method="mdfrt", narrow=False)
    tested = 0
    for i in np.flatnonzero(found.converged):
        misses = []
        for step in ([0.0, 0.0], [1e-4, 0.0], [-1e-4, 0.0], [0.0, 1e-4], [0.0, -1e-4]):
            aim = found.piercing_xyz[i] + 0.5 * (found.piercing_xyz[i] - CENTRE) + [*step, 0.0]
            pierced = crossing(height_at, aim)
            normal = normal_at(height_at, *pierced[:2])
            if normal is None:
                break
            ray = (aim - CENTRE) / np.linalg.norm(aim - CENTRE)
            misses.append(np.linalg.norm(distance(points[i], pierced, bend(ray, normal, INDEX))))
        else:
            # m; the normal by differences over 1e-5 m is good to 1e-9, times 8 m of water
            assert misses[0] < 5e-8
            assert min(misses[1:]) > 1e-5
            tested += 1
    assert tested >= 10

"""Derivatives of traced directions against differences of the tracers themselves."""

import numpy as np
import pytest

from pcfix.errors import SettingError
from pcfix.model import WaterMesh, WaterPlane, WaterRaster
from pcfix.refract.tracing import METHODS, trace
from pcfix.refract.tracing.gradients import gradients

INDEX = 1.34
RELATIVE = 1e-6
STEPS = {"by_point": 0.02, "by_centre": 0.05, "by_level": 0.02, "by_slopes": 5e-4, "by_index": 5e-3}
"""So large that a tracer's 1e-9 m is below 1e-6 of the difference to the fourth order."""


def scene(count=25, seed=0):
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-10, 10, (count, 2)), rng.uniform(-9, -3, count)])
    centres = np.column_stack([rng.uniform(-20, 20, (count, 2)), rng.uniform(25, 50, count)])
    return points, centres


def moved_by(points, centres, plane, name, j, step, method):
    """Return directions with one of the unknowns changed."""
    points, centres, plane, n = points.copy(), centres.copy(), list(plane), INDEX
    if name == "by_point":
        points[:, j] += step
    elif name == "by_centre":
        centres[:, j] += step
    elif name == "by_level":
        plane[0] += step
    elif name == "by_slopes":
        plane[1 + j] += step
    else:
        n += step
    return trace(centres, points, WaterPlane(*plane), refractive_index=n, method=method).direction


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("plane", [(0.0, 0.0, 0.0), (0.4, 0.05, -0.03)])
@pytest.mark.parametrize(("name", "columns"), list(zip(STEPS, (3, 3, 1, 2, 1), strict=True)))
def test_on_planes_they_are_the_differences(method, plane, name, columns):
    points, centres = scene()
    found = trace(centres, points, WaterPlane(*plane), refractive_index=INDEX, method=method)
    ours = getattr(gradients(points, centres, found, INDEX), name).reshape(len(points), 3, columns)
    for j in range(columns):
        d = STEPS[name]
        there = [moved_by(points, centres, plane, name, j, s * d, method) for s in (-2, -1, 1, 2)]
        difference = (there[0] - 8 * there[1] + 8 * there[2] - there[3]) / (12 * d)
        size = np.abs(difference).max(axis=1)
        # kotowski is exact to rounding; the others end where a miss is below 1e-9 m at 35 m
        noise = 0.0 if method == "kotowski" else 1.5 * 1e-9 / 25.0 / d
        apart = np.abs(ours[:, :, j] - difference).max(axis=1)
        assert (apart <= RELATIVE * size + noise + 1e-12).all()


def test_a_raster_and_a_mesh_have_those_of_their_tangent_planes():
    points, centres = scene(12)
    plane = WaterPlane(0.2, 0.01, 0.02)
    x = np.arange(-59.5, 60.0)
    z = plane.a + plane.b * x[None, :] + plane.c * x[::-1, None]
    corners = np.array([[i, j, plane.a + plane.b * i + plane.c * j]
                        for i in (-60.0, 60.0) for j in (-60.0, 60.0)])  # fmt: skip
    expected = gradients(
        points, centres, trace(centres, points, plane, refractive_index=INDEX), INDEX
    )
    for water in (
        WaterRaster(z, -60.0, 60.0, (1.0, 1.0)),
        WaterMesh(corners, np.array([[0, 2, 1], [1, 2, 3]])),
    ):
        ours = gradients(
            points, centres, trace(centres, points, water, refractive_index=INDEX), INDEX
        )
        for name in STEPS:
            # the same path to 1e-9 m
            np.testing.assert_allclose(
                getattr(ours, name), getattr(expected, name), rtol=1e-7, atol=1e-9
            )


def test_the_pivot_is_where_the_tilt_leaves_the_level_alone():
    points, centres = scene(5)
    found = trace(centres, points, WaterPlane(0.0), refractive_index=INDEX)
    at, origin = (gradients(points, centres, found, INDEX, pivot=p) for p in ((7.0, -2.0), (0, 0)))
    shifted = at.by_slopes + np.array([7.0, -2.0]) * at.by_level[:, :, None]
    np.testing.assert_allclose(shifted, origin.by_slopes, rtol=0.0, atol=1e-15)


def test_straight_light_knows_nothing_of_the_water():
    point, centre = np.array([[2.0, 1.0, 3.0]]), np.array([[8.0, -4.0, 40.0]])
    ours = gradients(
        point, centre, trace(centre, point, WaterPlane(0.0), refractive_index=INDEX), INDEX
    )
    way = (point - centre)[0]
    size = np.linalg.norm(way)
    straight = (np.eye(3) - np.outer(way, way) / size**2) / size
    # rounding
    np.testing.assert_allclose(ours.by_point[0], straight, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(ours.by_centre[0], -straight, rtol=0.0, atol=1e-15)
    for water in (ours.by_level, ours.by_slopes, ours.by_index):
        np.testing.assert_allclose(water, 0.0, rtol=0.0, atol=1e-15)


def test_what_was_lost_has_none_and_other_points_are_refused():
    points, centres = np.array([[0.0, 0.0, -3.0]]), np.array([[1.0, 0.0, -1.0]])
    lost = trace(centres, points, WaterPlane(0.0), refractive_index=INDEX)
    assert np.isnan(gradients(points, centres, lost, INDEX).by_point).all()
    with pytest.raises(SettingError, match="tracing of 1 paths"):
        gradients(np.zeros((4, 3)), centres, lost, INDEX)

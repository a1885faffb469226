"""What refraction must do, whatever the code looks like."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pcfix
from tests.refract.test_literature import NANOMETRE, UTM, bed, block, named
from tests.utils.beyond_frames import BEYOND_FRAMES, DEEP
from tests.utils.twins import correct_slowly, light_path, stacked_intersection

pytestmark = [BEYOND_FRAMES, DEEP]


@pytest.mark.parametrize("plane", [(0.0, 0.0, 0.0), (0.5, 0.003, -0.002), (-0.3, 0.05, 0.08)])
def test_twin(plane):
    a, b, c = plane
    cameras, points = named(block()), bed(200)
    water = pcfix.WaterPlane(a - b * UTM[0] - c * UTM[1], b, c)
    result = pcfix.correct_points(points, cameras, water)
    local = cameras.centres - UTM
    assert result.corrected.sum() >= 60
    for i in np.flatnonzero(result.corrected)[:60]:
        true, miss, angle = correct_slowly(points[i] - UTM, local, plane, 1.34)
        # the plane's height at UTM is a difference of numbers near 4e5: 1e-10 m are lost there
        assert result.xyz[i] - UTM == pytest.approx(true, abs=2 * NANOMETRE)
        assert result.ray_miss_m[i] == pytest.approx(miss, abs=1e-7)  # square root of a difference
        assert result.incidence_deg[i] == pytest.approx(angle, abs=1e-6)


@given(
    x=st.floats(-40, 40),
    y=st.floats(-40, 40),
    depth=st.floats(0.05, 15),
    slope=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)),
    n=st.floats(1.01, 1.5),
)
def test_there_and_back(x, y, depth, slope, n):
    # two cameras symmetric about the vertical plane of the point see rays that truly meet;
    # their straight prolongations meet as well, at the apparent point
    plane = (0.0, *slope)
    point = np.array([x, y, slope[0] * x + slope[1] * y - depth])
    strike = math.atan2(slope[0], -slope[1])  # horizontal, along the contours of the surface
    across = np.array([math.cos(strike), math.sin(strike), 0.0])
    centres = point + np.array([0, 0, 70.0]) + np.outer([-20.0, 20.0], across)
    crossings = [light_path(point, c, plane, n) for c in centres]
    directions = [(a - c) / np.linalg.norm(a - c) for a, c in zip(crossings, centres, strict=True)]
    apparent = stacked_intersection(centres, directions)
    cameras = pcfix.Cameras(("a", "b"), centres)
    result = pcfix.correct_points([apparent], cameras, pcfix.WaterPlane(*plane), index=n)
    # the crossing is known to 1e-9 m, and a base of 40 m over 70 m multiplies that by a few
    assert result.xyz[0] == pytest.approx(point, abs=1e-7)


def test_wider_base():
    def shift(half_base):
        cameras = named(np.array([[-half_base, 0, 50.0], [half_base, 0, 50.0]]))
        return pcfix.correct_points([[0, 0, -3.0]], cameras, 0.0).shift_m[0, 2]

    shifts = [shift(b) for b in (2.0, 10.0, 25.0, 50.0)]
    assert shifts == sorted(shifts, reverse=True)
    assert shifts[0] == pytest.approx(-0.34 * 3.0, rel=0.01)


def test_land():
    xyz = np.array([[1.1, 2.2, 0.1], [1.1, 2.2, -1.0], [3.3, 4.4, 0.0]])
    result = pcfix.correct_points(xyz, named(np.array([[0.0, 0, 50], [9, 9, 50]])), 0.0)
    assert result.outcome.tolist() == [0, 1, 0]
    assert (result.xyz[[0, 2]] == xyz[[0, 2]]).all()
    for values in (result.shift_m, result.depth_m, result.ray_count, result.incidence_deg):
        assert (values[[0, 2]] == 0).all()

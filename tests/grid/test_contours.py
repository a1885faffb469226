"""Contours: their place, and the interval of a map."""

import numpy as np
import pytest

from pcfix.grid.maps import contours, depth_interval

pytestmark = pytest.mark.quick


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

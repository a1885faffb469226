"""Points in polygons against the even-odd rule."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcfix.label.labelling import WaterMask

shapely = pytest.importorskip("shapely")

EAST, NORTH = 456_000.0, 5_432_000.0


def even_odd(rings, x, y):
    """Count crossings of a ray to the east with every edge; borders are not special."""
    inside = np.zeros(x.size, bool)
    for ring in rings:
        for (x1, y1), (x2, y2) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            across = (y1 > y) != (y2 > y)
            with np.errstate(divide="ignore", invalid="ignore"):
                inside ^= across & (x < (x2 - x1) * (y - y1) / (y2 - y1) + x1)
    return inside


def star(rng, middle, low, high, corners):
    """Return a ring that does not cross itself."""
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, corners))
    radius = rng.uniform(low, high, corners)
    return middle + np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def lake(rng, corners=60):
    """Return a polygon with three holes, some of which may reach its border or one another."""
    middle = np.array([EAST, NORTH])
    rings = [star(rng, middle, 60.0, 100.0, corners)]
    rings += [star(rng, middle + rng.uniform(-30, 30, 2), 2.0, 9.0, 7) for _ in range(3)]
    area = shapely.make_valid(shapely.Polygon(rings[0]))
    for ring in rings[1:]:
        area = area.difference(shapely.make_valid(shapely.Polygon(ring)))
    parts = shapely.get_parts(area)
    return area, [shapely.get_coordinates(r)[:-1] for r in shapely.get_rings(parts)]


@given(seed=st.integers(0, 10**6))
def test_even_odd(seed):
    rng = np.random.default_rng(seed)
    area, rings = lake(rng)
    x, y = EAST + rng.uniform(-110, 110, 4000), NORTH + rng.uniform(-110, 110, 4000)
    off = shapely.distance(shapely.boundary(area), shapely.points(x, y)) > 1e-6
    found = WaterMask(area).inside(x, y)
    np.testing.assert_array_equal(found[off], even_odd(rings, x, y)[off])


def test_border_and_hole():
    square = shapely.box(EAST, NORTH, EAST + 10, NORTH + 10)
    hole = shapely.box(EAST + 4, NORTH + 4, EAST + 6, NORTH + 6)
    mask = WaterMask(square.difference(hole))
    east = np.array([0.0, 10, 0, 3.7, 10, 4, 6, 4.9, 5, 4.000001, -1e-6, 10.000001])
    north = np.array([0.0, 10, 5.1, 0, 2.2, 4, 5, 6, 5, 4.000001, 5, 5])
    expected = [True] * 8 + [False] * 4
    assert mask.inside(EAST + east, NORTH + north).tolist() == expected

"""Numbers of Skarlatos & Agrafiotis (2018), JMSE 6(3) 77, and Shan's iteration as told there."""

import math
from itertools import pairwise

import numpy as np
import pytest

import pcfix
from pcfix.report.papers import shan_rows, shan_text
from pcfix.simulate.refraction_effect import (
    SWINGLETCAM,
    ULTRACAM,
    StereoPair,
    effect,
    shan_iterations,
)

PAIR = StereoPair(SWINGLETCAM, 100.0)


def test_geometry_of_the_swinglet_pair():
    along, across = SWINGLETCAM.footprint_m(100.0)
    # m, the footprints and the base as their two decimals say
    assert (across, along) == pytest.approx((144.19, 108.14), abs=0.005)
    assert PAIR.base_m == pytest.approx(21.63, abs=0.005)


def test_published_error_in_the_corners():
    # m, to the last digit published
    assert effect(PAIR, 15.0).corner_m == pytest.approx(-8.23, abs=0.005)


def test_published_error_in_the_centre():
    # m; the paper has -5.15, which this reading of its geometry misses by 1.1 cm, 0.2 %: see
    # the docstring of pcfix.simulate.refraction_effect
    assert effect(PAIR, 15.0).centre_m == pytest.approx(-5.15, abs=0.012)


def test_the_ultracam_has_the_smaller_error():
    """Its field of view is half as wide: less to gain in the corners, nearly n in the centre."""
    narrow = effect(StereoPair(ULTRACAM, 1000.0), 15.0)
    assert effect(PAIR, 15.0).corner_m < narrow.corner_m < narrow.centre_m < -0.34 * 15.0


@pytest.mark.parametrize("pair", [PAIR, StereoPair(ULTRACAM, 1000.0)])
def test_shan_converges_on_the_truth(pair):
    table = shan_iterations(pair, 15.0)
    largest = np.abs([one.max_m for one in table])
    means = np.abs([one.mean_m for one in table])
    # each iteration leaves a tenth at most, until rounding (1e-10 m in sums of 100 m) rules
    assert all(b < 0.1 * a for a, b in pairwise(largest) if a > 1e-8)
    assert all(b < 0.1 * a for a, b in pairwise(means) if a > 1e-8)
    assert largest[2] < 1e-3  # m: the second iteration is below any survey's noise
    assert largest[-1] < 1e-7  # m: s is exact for a level surface, so nothing is left
    assert table[-1].change < 1e-9


def test_shan_starts_from_the_ordinary_intersection():
    """With s = 1 the centre of the model has the depth that two straight rays make of it."""
    half = PAIR.base_m / 2.0
    tan_air = tan_water = 0.0
    for _ in range(50):  # 100 tan a + 15 tan b = half the base, by substitution
        tan_air = (half - 15.0 * tan_water) / 100.0
        tan_water = math.tan(math.asin(math.sin(math.atan(tan_air)) / 1.34))
    apparent = half / tan_air - 100.0
    first = shan_iterations(PAIR, 15.0, nodes=1)[0]
    assert first.number == 0
    assert first.mean_m == pytest.approx(apparent - 15.0, abs=1e-9)  # m, rounding


def test_the_method_shan_of_the_correction_ends_there_too():
    """Where the rays of the apparent point are those of the images: in the centre."""
    start, *_, end = shan_iterations(PAIR, 15.0, nodes=1)
    cameras = pcfix.Cameras(("left", "right"), PAIR.centres)
    apparent = [[0.0, 0.0, -(15.0 + start.mean_m)]]
    corrected = pcfix.correct_points(apparent, cameras, 0.0, method="shan").xyz
    assert -corrected[0, 2] == pytest.approx(15.0 + end.mean_m, abs=1e-6)  # m; it stops at 1e-9


def test_without_refraction_there_is_nothing_to_iterate():
    table = shan_iterations(PAIR, 15.0, 1.0)
    assert len(table) == 2
    assert abs(table[0].max_m) < 1e-9


def test_the_page_of_the_iterations():
    table = shan_iterations(PAIR, 15.0)
    text = shan_text(PAIR, table, 15.0)
    assert len(text.splitlines()) == len(table) + 2
    rows = shan_rows(PAIR, table)
    assert rows[0]["camera"] == "SwingletCAM" and rows[0]["change_tan_a"] == ""
    assert rows[1]["max_residual_m"] == pytest.approx(table[1].max_m, rel=1e-3)

"""Numbers of Skarlatos & Agrafiotis (2018), JMSE 6(3) 77, and Shan's iteration as given there."""

from itertools import pairwise

import numpy as np
import pytest

import pcfix
from tests.papers.hsu_wang import simulate_bowl
from tests.papers.refraction_effect import (
    FLIGHTS,
    PAPER_INDEX,
    SWINGLETCAM,
    ULTRACAM,
    StereoPair,
    effect,
    shan_iterations,
    write_all,
)
from tests.papers.test_equations import pierced, refracted

PAIR = StereoPair(SWINGLETCAM, 100.0)
PAIRS = [
    StereoPair(camera, height, overlap)
    for camera, (heights, overlaps) in FLIGHTS.items()
    for overlap in overlaps
    for height in heights
]
each_pair = pytest.mark.parametrize(
    "pair", PAIRS, ids=lambda p: f"{p.flying_height_m:g}-{p.overlap}"
)


def true_depth(apparent, centres, index):
    """Return the depth of eqs 8, 10 and 11 as printed, by numpy alone."""
    system, right, up = np.zeros((6, 5)), np.zeros(6), np.array([0.0, 0.0, 1.0])
    for i, centre in enumerate(centres):
        ray = (apparent - centre) / np.linalg.norm(apparent - centre)
        rows = slice(3 * i, 3 * i + 3)
        system[rows, :3], system[rows, 3 + i] = np.eye(3), -refracted(ray, up, 1.0, index)
        right[rows] = pierced(apparent, centre)
    return -np.linalg.lstsq(system, right, rcond=None)[0][2]


def test_swinglet_geometry():
    along, across = SWINGLETCAM.footprint_m(100.0)
    assert (across, along) == pytest.approx((144.0, 108.0), abs=1e-9)  # m, as printed
    assert across / SWINGLETCAM.columns == pytest.approx(0.036, abs=1e-9)  # m of ground a pixel
    assert round(SWINGLETCAM.pixel_um, 2) == 1.55  # um, as printed
    assert PAIR.base_m == pytest.approx(21.6, abs=1e-9)


def test_published_errors():
    """Section 2.1.5: -8.23 and -5.15 m, to the last digit published; -15 m is truly -23.23 m."""
    found = effect(PAIR, 15.0, PAPER_INDEX)
    assert found.corner_m == pytest.approx(-8.23, abs=0.005)
    assert found.centre_m == pytest.approx(-5.15, abs=0.005)
    assert found.corner_m - 15.0 == pytest.approx(-23.23, abs=0.005)


@each_pair
@pytest.mark.parametrize("depth_m", [1.0, 15.0])
def test_figures_5_and_6(pair, depth_m):
    found = effect(pair, depth_m, PAPER_INDEX, nodes=5)
    for i, y in enumerate(found.y_m):
        for j, x in enumerate(found.x_m):
            true = true_depth(np.array([x, y, -depth_m]), pair.centres, PAPER_INDEX)
            # m; least squares of 6 by 5 with sums of 3000 m
            assert found.error_m[i, j] == pytest.approx(depth_m - true, abs=1e-7)


@each_pair
def test_largest_error(pair):
    """Section 2.1.5: about 1/3 of the real depth or half the apparent one.

    It holds as a round number: 0.31 to 0.37 and 0.45 to 0.57 in the models of Figures 5 and 6.
    """
    corner = -effect(pair, 15.0, PAPER_INDEX).corner_m
    assert corner / (15.0 + corner) == pytest.approx(1.0 / 3.0, abs=0.033)
    assert corner / 15.0 == pytest.approx(0.5, abs=0.076)


@pytest.mark.parametrize("pair", [PAIR, StereoPair(ULTRACAM, 1000.0)])
def test_shan_converges(pair):
    table = shan_iterations(pair, 15.0)
    largest, means = np.abs([(one.max_m, one.mean_m) for one in table]).T
    # each iteration leaves a tenth at most, until rounding (1e-10 m in sums of 100 m) rules
    assert all(b < 0.1 * a for a, b in pairwise(largest) if a > 1e-8)
    assert all(b < 0.1 * a for a, b in pairwise(means) if a > 1e-8)
    assert largest[2] < 1e-3  # m: the second iteration is below any survey's noise
    assert largest[-1] < 1e-7  # m: s is exact for a level surface, so nothing is left
    assert table[-1].change < 1e-9


def test_shan_of_the_correction():
    """In the centre, the rays of the apparent point are those of the images."""
    start, *_, end = shan_iterations(PAIR, 15.0, nodes=1)
    cameras = pcfix.Cameras(("left", "right"), PAIR.centres)
    apparent = [[0.0, 0.0, -(15.0 + start.mean_m)]]
    corrected = pcfix.correct_points(apparent, cameras, 0.0, method="shan").xyz
    assert -corrected[0, 2] == pytest.approx(15.0 + end.mean_m, abs=1e-6)  # m; it stops at 1e-9


def test_files(tmp_path):
    found = write_all(tmp_path, bowl=simulate_bowl(0.01))
    assert len(found) == (2 + 2 * 2) * 16
    assert {path.suffix for path in tmp_path.iterdir()} == {".csv", ".png"}
    assert all(path.stat().st_size > 100 for path in tmp_path.iterdir())

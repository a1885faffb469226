"""Distances, planes, statistics and tables against brute force and closed forms."""

import math

import numpy as np
import pytest

from pcfix.compare.figures import parse_line, section_along
from pcfix.compare.match import heights_at
from pcfix.compare.statistics import binned, fit_line, statistics_of

pytestmark = pytest.mark.quick

EAST_M, NORTH_M = 456_000.0, 5_432_000.0


def test_nearest_height_without_plane():
    """Neighbours on a line, places far outside, and coincident points."""
    line = np.column_stack([np.arange(20.0), np.zeros(20), np.arange(20.0)])
    x, y = (a.ravel() for a in np.meshgrid(np.arange(9.0), np.arange(9.0)))
    grid = np.column_stack([x, y, 2.0 + 0.1 * x - 0.2 * y])
    for xy, surface, expected in (
        (np.array([[3.2, 0.1], [7.9, 0.3]]), line, [3.0, 8.0]),
        (np.array([[-30.0, 0.0]]), grid, [2.0]),  # the corner
        (np.zeros((3, 2)), np.tile([0.0, 0.0, 7.0], (8, 1)), [7.0] * 3),
    ):
        assert heights_at(xy, surface, 8).tolist() == expected


def test_statistics():
    values = np.random.default_rng(8).gamma(2.0, 0.1, 1001) - 0.1
    found, plain = statistics_of(values), sorted(values.tolist())
    mean = math.fsum(plain) / 1001
    assert found.mean_m == pytest.approx(mean, rel=1e-12)
    assert found.sd_m == pytest.approx(
        math.sqrt(math.fsum((v - mean) ** 2 for v in plain) / 1001), rel=1e-12
    )
    assert found.rmse_m**2 == pytest.approx(found.mean_m**2 + found.sd_m**2, rel=1e-12)
    assert found.median_m == plain[500]
    assert found.nmad_m == 1.4826 * sorted(abs(v - plain[500]) for v in plain)[500]
    assert (found.min_m, found.max_m) == (plain[0], plain[-1])
    assert found.within_95_m == pytest.approx(sorted(abs(v) for v in plain)[950])
    # 5 % of 1000 steps between 1001 sorted values: the 50th from below
    assert found.percentiles_m["p5"] == pytest.approx(plain[50])
    assert found.percentiles_m["p95"] == pytest.approx(plain[950])


def test_fit_line():
    depth = np.linspace(0.5, 12.0, 400)
    line = fit_line(depth, -0.05 + depth / 1.34)
    assert (line.slope, line.intercept_m, line.r2) == pytest.approx((1 / 1.34, -0.05, 1.0))
    noisy = depth + np.random.default_rng(11).normal(0.0, 0.3, 400)
    line = fit_line(depth, noisy)
    assert (line.slope, line.intercept_m) == pytest.approx(tuple(np.polyfit(depth, noisy, 1)))
    assert line.r2 == pytest.approx(np.corrcoef(depth, noisy)[0, 1] ** 2)
    assert fit_line(np.full(50, 4.0), np.linspace(3.0, 4.0, 50)) is None
    assert fit_line(np.array([1.0, 2.0]), np.array([1.0, 2.0])) is None


def test_bins():
    rng = np.random.default_rng(12)
    depth, error = rng.uniform(0.0, 5.0, 3000), rng.normal(0.0, 0.1, 3000)
    depth = depth[(depth < 2.0) | (depth >= 3.0)]
    bins = binned(depth, error[: len(depth)], 2.0 * error[: len(depth)], 0.5)
    assert [b.from_m for b in bins] == [0.0, 0.5, 1.0, 1.5, 3.0, 3.5, 4.0, 4.5]
    for one in bins:
        inside = [
            e for d, e in zip(depth, error, strict=False) if one.from_m <= d < one.to_m
        ]  # fmt: skip
        assert one.after.count == len(inside)
        assert one.after.mean_m == pytest.approx(math.fsum(inside) / len(inside))
        assert one.before.rmse_m == pytest.approx(2.0 * one.after.rmse_m)


def test_section():
    """Points over a wavy bed, in UTM-like coordinates."""
    rng = np.random.default_rng(16)
    xy = rng.uniform(0.0, 40.0, (4000, 2))
    z = -3.0 + 0.4 * np.sin(xy[:, 0] / 5.0) + 0.05 * xy[:, 1] + rng.normal(0.0, 0.02, 4000)
    cloud = np.column_stack([xy[:, 0] + EAST_M, xy[:, 1] + NORTH_M, z])
    line = parse_line(f"{EAST_M + 5},{NORTH_M + 5},{EAST_M + 35},{NORTH_M + 25}")
    layers = {"corrected": cloud, "reference": np.add(cloud, (0, 0, 1.5))}
    section = section_along(line, layers, 2.0)
    east, north = 30.0 / math.hypot(30, 20), 20.0 / math.hypot(30, 20)
    for station in (3, 10, 20):
        s = section.distance_m[station]
        heights = [
            z
            for x, y, z in (cloud - [line.x1, line.y1, 0.0]).tolist()
            if abs(y * east - x * north) <= 2.0 and abs(x * east + y * north - s) <= 2.0
        ]
        assert section.heights_m["corrected"][station] == pytest.approx(np.median(heights))
    difference = section.heights_m["reference"] - section.heights_m["corrected"]
    np.testing.assert_allclose(difference, 1.5)

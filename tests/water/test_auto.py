"""The water surface found in simulated shores, real clouds, and clouds without water."""

import laspy
import numpy as np
import pytest

from pcfix.water.auto import Cue, Moments, find_water, gain_of, tile_moments
from tests.utils.codes import refused
from tests.utils.shared import needs

RENDERED, needs_rendered = needs("rendered_a", "cloud.las")
RIVER, needs_river = needs("river", "points.las")

LEVEL_M = 12.0
EAST_M, NORTH_M = 400_000.0, 5_000_000.0
LIFT = 1.36


def shore(n=30_000, *, slope=0.06, noise_m=0.01, bumps_m=0.04, seed=0):
    """Return apparent points and colours of a bumpy shore; the bed is lifted, red fades."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, 60.0, n), rng.uniform(0.0, 80.0, n)
    true = slope * (25.0 - x + 2.0 * np.sin(y / 6.0)) + bumps_m * np.sin(x / 2.0) * np.cos(y / 3.0)
    apparent = np.where(true < 0.0, true / LIFT, true) + rng.normal(0.0, noise_m, n)
    ground = rng.uniform(0.7, 1.3, n)[:, None] * [120.0, 110.0, 90.0]
    fading = np.exp(np.minimum(true, 0.0)[:, None] * [0.45, 0.12, 0.10])
    xyz = np.column_stack([x + EAST_M, y + NORTH_M, apparent + LEVEL_M])
    return xyz, ground * fading


def test_level():
    xyz, rgb = shore()
    found = find_water(xyz, rgb=rgb)
    assert found.surface.b == found.surface.c == 0.0
    assert abs(found.level_m - LEVEL_M) < 0.05  # m: the aim of a few centimetres
    assert abs(found.level_m - LEVEL_M) < 3.0 * found.sigma_level_m
    assert "red/green amplitude" in found.evidence
    assert 0.0 < found.confidence <= 1.0
    raised = find_water(xyz + np.array([0.0, 0.0, 100.0]), rgb=rgb)
    assert raised.level_m == pytest.approx(found.level_m + 100.0, abs=1e-6)


def test_slope_only():
    found = find_water(shore(noise_m=0.005, slope=0.12, bumps_m=0.02)[0])
    assert abs(found.level_m - LEVEL_M) < 0.05
    # a bend of the shore within a tile rounds the break off
    assert found.evidence["slope amplitude"] == pytest.approx(LIFT - 1.0, abs=0.12)


@pytest.mark.parametrize("offset_m", [+5.0, -12.0])
def test_land_or_bed_only_refused(offset_m):
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0.0, 60.0, (2, 20_000))
    z = 0.05 * x + 0.1 * np.sin(x / 4.0) * np.cos(y / 5.0) + rng.normal(0.0, 0.02, len(x))
    rgb = rng.uniform(0.8, 1.2, len(x))[:, None] * [120.0, 110.0, 90.0]
    if offset_m < 0.0:
        rgb = rgb * np.exp((z - 4.0)[:, None] * [0.45, 0.12, 0.10])
    xyz = np.column_stack([x + EAST_M, y + NORTH_M, z + offset_m])
    with refused("water.not_found"):
        find_water(xyz, rgb=rgb)


def test_bank_refused():
    xyz, _ = shore(noise_m=0.005, slope=0.12, bumps_m=0.01)
    above_m = xyz[:, 2] - LEVEL_M
    xyz[:, 2] = LEVEL_M + np.where(above_m < 0.0, above_m / 4.0, above_m)
    with refused("water.not_found", reason="bank"):
        find_water(xyz)


def test_refused():
    """Flat ground, and few points."""
    rng = np.random.default_rng(4)
    flat = np.column_stack([rng.uniform(0.0, 60.0, (5_000, 2)), rng.normal(0.0, 0.02, 5_000)])
    with refused("cloud.flat"):
        find_water(flat)
    with refused("cloud.too_few_points", points=1_999, least=2_000):
        find_water(flat[:1_999])


def test_amplitude_of_break():
    rng = np.random.default_rng(5)
    heights = np.array([0.0, 0.1])
    cue, tile = Cue("a colour", "", 1.0, 1e6), np.repeat(np.arange(3), 200)
    at = rng.uniform(-1.0, 1.0, 600)
    y = tile + 0.1 * at + 0.5 * np.minimum(at, 0.0) + rng.normal(0.0, 0.05, 600)
    level = np.ones((200, 1))
    parts = [tile_moments(level, y[tile == t], at[tile == t], heights, cue) for t in range(3)]
    sums, count = map(np.array, zip(*parts, strict=True))
    gain, amplitude, _ = gain_of(Moments(sums, count, heights, cue))
    design = np.column_stack([np.eye(3)[tile], at, np.maximum(-at, 0.0)])
    expected = np.linalg.lstsq(design, y, rcond=None)[0][-1]
    assert amplitude[0] == pytest.approx(expected, abs=1e-6)
    assert gain[0] > gain[1]


@needs_rendered
def test_real_cloud():
    cloud = laspy.read(RENDERED)
    found = find_water(cloud.xyz, rgb=np.column_stack([cloud.red, cloud.green, cloud.blue]))
    assert found.surface.b == found.surface.c == 0.0
    assert found.level_m == pytest.approx(0.37, abs=0.05)  # m: 1 GSD


@needs_river
def test_river_without_land_refused():
    cloud = laspy.read(RIVER)
    rgb = np.column_stack([cloud.red, cloud.green, cloud.blue])
    with refused("water.not_found", reason="weak"):
        find_water(cloud.xyz, rgb=rgb)

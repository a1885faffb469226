"""What is likely wrong where cameras do not lie over their cloud."""

import numpy as np
import pytest
from pyproj import CRS, Transformer

from pcfix.io.cameras.mistakes import likely_mistake

pytestmark = pytest.mark.quick

UTM = "EPSG:25830"
LOW, HIGH = np.array([725300.0, 4369000.0, 8.0]), np.array([725600.0, 4369250.0, 30.0])
RNG = np.random.default_rng(1)
FITS = RNG.uniform([725320.0, 4369020.0, 138.0], [725580.0, 4369230.0, 144.0], (60, 3))


def to(code, centres=FITS):
    step = Transformer.from_crs(UTM, code, always_xy=True)
    return np.column_stack([*step.transform(centres[:, 0], centres[:, 1]), centres[:, 2]])


@pytest.mark.parametrize("crs", [UTM, CRS(UTM), "EPSG:25830+5782", None, "EPSG:2154"])
def test_a_block_over_its_cloud_has_no_mistake(crs):
    assert likely_mistake(FITS, LOW, HIGH, crs) is None
    assert likely_mistake(FITS - [250.0, 0.0, 60.0], LOW, HIGH, crs) is None  # oblique, from aside


@pytest.mark.parametrize(
    ("centres", "words"),
    [
        (FITS[:, [1, 0, 2]], "with x and y exchanged: their axes are likely swapped"),
        (FITS / 0.3048, "multiplied by 0.3048: they are likely in feet"),
        (FITS * 3937 / 1200, "multiplied by 0.3048: they are likely in feet"),
        (FITS * 0.3048, "divided by 0.3048: they are likely in metres, it in feet"),
    ],
)
@pytest.mark.parametrize("crs", [UTM, None])
def test_numbers_alone(centres, words, crs):
    found = likely_mistake(centres, LOW, HIGH, crs)
    assert found.startswith(f"The cameras would lie over the cloud {words}")


@pytest.mark.parametrize(
    ("centres", "words"),
    [
        (to("EPSG:32629"), "read as UTM zone 29N (the cloud is in 30N); say so with --cameras-crs"),
        (to("EPSG:25831"), "read as UTM zone 31N (the cloud is in 30N)"),
        (to("EPSG:32730"), "read as UTM zone 30S (the cloud is in 30N)"),
        (
            to("EPSG:4326"),
            "read as longitude and latitude in degrees; say so with --cameras-crs EPSG:4326",
        ),
        (to("EPSG:4326")[:, [1, 0, 2]], "read as degrees, latitude before longitude"),
        (to("EPSG:3857"), "read as web Mercator"),
    ],
)
def test_another_crs(centres, words):
    assert words in likely_mistake(centres, LOW, HIGH, UTM)


@pytest.mark.parametrize("crs", [UTM, None])
def test_local_against_projected(crs):
    origin = np.array([725450.0, 4369125.0, 0.0])
    found = likely_mistake(FITS - origin, LOW, HIGH, crs)
    shift = (LOW + HIGH)[:2] / 2 - np.median(FITS[:, :2], axis=0) + origin[:2]
    assert f"an offset of {shift[0]:.0f}, {shift[1]:.0f} m; see --cameras-offset" in found


def test_a_constant_offset_is_given_in_metres():
    found = likely_mistake(FITS + np.array([3000.0, -4000.0, 0.0]), LOW, HIGH, UTM)
    shift = (LOW + HIGH)[:2] / 2 - np.median(FITS[:, :2], axis=0) - [3000.0, -4000.0]
    assert f"The cameras are {np.hypot(*shift):.0f} m from the cloud in plan" in found
    assert f"an offset of {shift[0]:.0f}, {shift[1]:.0f} m" in found


@pytest.mark.parametrize("shift", [-50.0 - 100.0, -110.0 - 100.0])
def test_cameras_below_the_ground_by_a_geoid(shift):
    found = likely_mistake(FITS + np.array([0.0, 0.0, shift]), LOW, HIGH, UTM)
    assert "below the lowest point of the cloud" in found
    assert "heights above the ellipsoid and geoid are mixed" in found


def test_heights_in_feet():
    found = likely_mistake(FITS * [1, 1, 20 / 0.3048], LOW, HIGH, UTM)
    assert "above the cloud" in found
    valley = np.array([0.0, 0.0, 1500.0])
    found = likely_mistake((FITS + valley) * [1, 1, 0.3048], LOW + valley, HIGH + valley, UTM)
    assert "their heights are likely in metres, not feet" in found
    found = likely_mistake((FITS + valley) / [1, 1, 0.3048], LOW + valley, HIGH + valley, UTM)
    assert "their heights are likely in feet." in found


def test_a_cloud_in_all_zones_at_once():
    assert "km from the cloud" in likely_mistake(FITS + 1e6, LOW, HIGH, "EPSG:32600")

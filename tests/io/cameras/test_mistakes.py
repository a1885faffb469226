"""What is likely wrong where cameras do not lie over their cloud."""

import numpy as np
import pytest
from pyproj import CRS, Transformer

from pcfix.io.cameras.georeference import likely_mistake

pytestmark = pytest.mark.quick

UTM = "EPSG:25830"
LOW, HIGH = np.array([725300.0, 4369000.0, 8.0]), np.array([725600.0, 4369250.0, 30.0])
RNG = np.random.default_rng(1)
FITS = RNG.uniform([725320.0, 4369020.0, 138.0], [725580.0, 4369230.0, 144.0], (60, 3))


def to(code):
    step = Transformer.from_crs(UTM, code, always_xy=True)
    return np.column_stack([*step.transform(FITS[:, 0], FITS[:, 1]), FITS[:, 2]])


@pytest.mark.parametrize("crs", [UTM, CRS(UTM), "EPSG:25830+5782", None, "EPSG:2154"])
def test_no_mistake(crs):
    assert likely_mistake(FITS, LOW, HIGH, crs) is None
    assert likely_mistake(FITS - [250.0, 0.0, 60.0], LOW, HIGH, crs) is None  # oblique, from aside


BY_NUMBERS = [
    (FITS[:, [1, 0, 2]], "axes are likely swapped"),
    (FITS / 0.3048, "likely in feet"),
    (FITS * 3937 / 1200, "likely in feet"),
    (FITS * 0.3048, "likely in metres, it in feet"),
    (FITS - [725450.0, 4369125.0, 0.0], "give an offset of"),
]
BY_CRS = [
    (to("EPSG:32629"), "UTM zone 29N"),
    (to("EPSG:25831"), "UTM zone 31N"),
    (to("EPSG:32730"), "UTM zone 30S"),
    (to("EPSG:4326"), "--cameras-crs EPSG:4326"),
    (to("EPSG:3857"), "web Mercator"),
    (FITS - [-3000.0, 4000.0, 0.0], "m from the cloud in plan"),
    (FITS - [0.0, 0.0, 150.0], "below the lowest point of the cloud"),
    (FITS * [1, 1, 20 / 0.3048], "above the cloud"),
]


@pytest.mark.parametrize(
    ("centres", "words", "crs"),
    [
        *((*one, crs) for one in BY_NUMBERS for crs in (UTM, None)),
        *((*one, UTM) for one in BY_CRS),
        (FITS + 1e6, "km from the cloud", "EPSG:32600"),  # all zones at once
    ],
)
def test_mistake(centres, words, crs):
    assert words in likely_mistake(centres, LOW, HIGH, crs)


@pytest.mark.parametrize("away", [[-725450.0, -4369125.0, 0.0], [3000.0, -4000.0, 0.0]])
def test_offset(away):
    shift = (LOW + HIGH)[:2] / 2 - np.median(FITS[:, :2], axis=0) - away[:2]
    found = likely_mistake(FITS + np.array(away), LOW, HIGH, UTM)
    assert f"an offset of {shift[0]:.0f}, {shift[1]:.0f} m" in found

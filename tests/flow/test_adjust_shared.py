"""A rendered block that ordinary software bent, mended with tie points and without."""

from __future__ import annotations

from functools import partial

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.adjust.block import usable_ties
from pcfix.flow.adjust import adjust_cameras
from tests.flow.test_carrying import FREE, TRUE, errors_gsd, free, true
from tests.utils.nightly import mostly_nightly

pytestmark = pytest.mark.filterwarnings("default::pcfix.errors.PcfixWarning")

WATER_M, FOCAL_PX = 0.37, 1500.0
TIES = 3000
"""Enough for these bounds; all of them take a minute."""


@free
@true
@pytest.mark.parametrize(
    ("ties", "bed_gsd", "land_gsd"),
    mostly_nightly([("measured", 1.00, 0.80), ("cloud", 0.98, 0.80)]),
)
def test_rendered_block(tmp_path, monkeypatch, ties, bed_gsd, land_gsd):
    """Before, land lies 19 GSD (of 5 cm) too low; the matcher's own noise is 0.9 and 0.7."""
    monkeypatch.setattr("pcfix.flow.adjust.usable_ties", partial(usable_ties, most=TIES))
    offset = tuple(np.loadtxt(FREE / "offset.txt"))
    found = adjust_cameras(
        FREE / "sparse", water=WATER_M, cameras_offset=offset, cloud=FREE / "cloud.las",
        gnss=FREE / "gnss.csv", gcps=FREE / "gcps.csv" if ties == "measured" else None, ties=ties,
    )  # fmt: skip
    right = pcfix.read_cameras(TRUE / "colmap")
    order = [right.labels.index(label) for label in found.cameras.labels]
    off = found.cameras.centres - right.centres[order] - np.loadtxt(TRUE / "offset.txt")
    # m: GNSS of 3 cm, which the images of 32 neighbours smooth; before 0.17 m
    assert np.sqrt((off**2).mean()) < 0.02
    # px: 0.07 %, which is 5 cm of the flying height; before 3.5
    assert abs(found.cameras.lenses[0].focal - FOCAL_PX) < 1.0
    pcfix.correct_file(
        FREE / "cloud.las", tmp_path / "out.las", cameras=found.cameras, water=WATER_M,
        adjusted_from=FREE / "sparse", cameras_offset=offset,
    )  # fmt: skip
    bed, land = (np.sqrt((e**2).mean()) for e in errors_gsd(laspy.read(tmp_path / "out.las")))
    assert bed < bed_gsd
    assert land < land_gsd

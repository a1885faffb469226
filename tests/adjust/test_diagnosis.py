"""Detect poses that absorbed the refraction, and no others."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pcfix.adjust.diagnosis import bed_sign, gnss_sign, tie_point_sign
from pcfix.adjust.from_cloud import undo_absorption
from pcfix.adjust.parameters import Unknowns
from pcfix.model import TiePoints, Views, WaterPlane
from tests.utils.block_kinds import KindBlock, N

WATER = WaterPlane(0.0)
LENS = Unknowns(lens=("f", "cx", "cy"))


@cache
def block(seed=1):
    return KindBlock("20 % land", seed)


def signs(true, cameras):
    """Return the signs of tie points and GNSS, and the apparent points."""
    ties = TiePoints(true.xyz, Views(true.start, true.camera), true.image_xy)
    by_ties, apparent = tie_point_sign(cameras, WATER, N, ties)
    undone = undo_absorption(apparent, cameras, WATER, N)
    assert len(undone.row) == len(cameras)
    return by_ties, gnss_sign(cameras, true.cameras.gnss, undone), apparent


@pytest.mark.parametrize("poses", ["true", "adjusted with water"])
def test_right_poses(poses):
    true = block()
    cameras = true.cameras if poses == "true" else true.adjusted(true.cameras, LENS, WATER)
    by_ties, by_gnss, _ = signs(true, cameras)
    assert by_ties.absorbed is False
    # 50 blocks with true poses gave 0.01 to 0.07
    assert abs(by_ties.share) < 0.15
    assert by_gnss.absorbed is not True
    assert abs(by_gnss.share) < 4.0 * by_gnss.sigma_share


def test_absorbed():
    true = block()
    by_ties, by_gnss, apparent = signs(true, true.adjusted(true.cameras, LENS))
    assert by_ties.absorbed is True
    assert by_gnss.absorbed is True
    # what the land is off in truth: the straight intersection against the true points; the
    # prediction does not know the GNSS, which placed the block as a whole, hence a third
    land = true.xyz[:, 2] > 0.5
    off = np.sqrt(np.nanmean((true.xyz[land, 2] - apparent[land, 2]) ** 2))
    assert by_gnss.error_m == pytest.approx(off, rel=0.34)


def test_random_errors():
    true, rng = block(4), np.random.default_rng(4)
    centres = true.cameras.centres + rng.normal(0.0, 0.1, true.cameras.centres.shape)
    by_ties, by_gnss, _ = signs(true, replace(true.cameras, centres=centres))
    assert by_ties.absorbed is not True
    assert by_gnss.absorbed is not True


def test_bed():
    true = np.linspace(2.0, 8.0, 40)
    assert bed_sign(true / 1.4, true, N).absorbed is False
    assert bed_sign(0.97 * true, true, N).absorbed is True
    assert bed_sign(0.97 * true[:2], true[:2], N) is None

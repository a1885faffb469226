"""Poses that absorbed the refraction are told from true ones."""

from dataclasses import replace

import numpy as np
import pytest

from pcfix.adjust.block import true_start
from pcfix.adjust.diagnosis import bed_sign, gnss_sign, tie_point_sign
from pcfix.adjust.from_cloud import undo_absorption
from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.problem import intersect_fixed
from pcfix.model import WaterPlane
from tests.utils.block_kinds import GNSS_M, KindBlock, N

WATER = WaterPlane(0.0)
LENS = Unknowns(lens=("f", "cx", "cy"))


def block(seed):
    return KindBlock("20 % land", seed)


def with_gnss(data, cameras):
    return replace(cameras, gnss=data.cameras.gnss)


def tie_sign(true, cameras, n=N):
    straight = intersect_fixed(true.block(cameras, None))
    depth = -straight.xyz[:, 2]
    wet = depth > 0
    begin = true_start(straight.xyz, WATER, n, wet)
    refracted = replace(true.block(cameras, WATER, wet), xyz=begin, refractive_index=n)
    return tie_point_sign(straight, intersect_fixed(refracted), depth), straight.xyz


def gnss_signs(cameras, apparent):
    off = cameras.centres - cameras.gnss.xyz
    sigma = np.full(off.shape, GNSS_M)
    found = undo_absorption(apparent, cameras, WATER, N)
    assert len(found.row) == len(cameras)
    return gnss_sign(cameras.centres, off, sigma, found), found


@pytest.mark.parametrize("poses", ["true", "adjusted with water"])
def test_right_poses(poses):
    true = block(1)
    cameras = true.cameras
    if poses != "true":
        cameras = with_gnss(true, true.adjusted(cameras, LENS, WATER))
    sign, apparent = tie_sign(true, cameras)
    assert sign.speaks is False
    # 50 blocks with true poses gave 0.01 to 0.07
    assert abs(sign.figures["share"]) < 0.15
    by_gnss, _ = gnss_signs(cameras, apparent)
    assert by_gnss.speaks is not True
    assert abs(by_gnss.figures["share"]) < 4.0 * by_gnss.figures["sigma_share"]


def test_absorbed():
    true = block(1)
    refracted = with_gnss(true, true.adjusted(true.cameras, LENS))
    sign, apparent = tie_sign(true, refracted)
    assert sign.speaks is True
    figures = sign.figures
    assert figures["wet_refracted_px"] > figures["wet_straight_px"]
    by_gnss, found = gnss_signs(refracted, apparent)
    assert by_gnss.speaks is True
    # what the land is off in truth: the straight intersection against the true points; the
    # prediction does not know the GNSS, which placed the block as a whole, hence a third
    land = true.xyz[:, 2] > 0.5
    off = np.sqrt(np.nanmean((true.xyz[land, 2] - apparent[land, 2]) ** 2))
    assert by_gnss.error_m == found.error_m == pytest.approx(off, rel=0.34)


def test_random_errors():
    true = block(4)
    rng = np.random.default_rng(4)
    centres = true.cameras.centres + rng.normal(0.0, 0.1, true.cameras.centres.shape)
    moved = replace(true.cameras, centres=centres)
    sign, apparent = tie_sign(true, moved)
    assert sign.speaks is not True
    assert gnss_signs(moved, apparent)[0].speaks is not True


def test_bed():
    true = np.linspace(2.0, 8.0, 40)
    assert bed_sign(true / 1.4, true, N).speaks is False
    assert bed_sign(0.97 * true, true, N).speaks is True
    assert bed_sign(0.97 * true[:2], true[:2], N) is None

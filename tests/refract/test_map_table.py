"""Depth maps by polynomials: as computed exactly, and independent of the other points."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from pcfix.model import WaterPlane
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import FLAT_DEG, Batch, Survey
from pcfix.refract.learning import learn_of_sample
from pcfix.refract.methods import correct, with_rays
from pcfix.running import threads
from pcfix.water.surface import is_submerged, surface_above
from tests.utils.batches import batch_of
from tests.utils.depth_map_twin import looking
from tests.utils.matchers import simulated
from tests.utils.nightly import mostly_nightly

BLOCKS = {"nadir": {}, "half oblique": {"obliques_deg": 30.0, "area_m": (70.0, 50.0)}}


@lru_cache(maxsize=4)
def dense(block):
    """Return the submerged points of a simulated cloud, their views, and the GSD."""
    scene = simulated(12_000, seed=1, lidar_per_m2=0.0, cloud="depth-maps", **BLOCKS[block])
    settings = ScienceOptions(
        method="consistent", matcher="depth-maps", camera_set="mvs", dimensions="none"
    )
    xyz = scene.apparent_xyz
    above = surface_above(scene.water, xyz)
    whole = Batch(xyz, above, Survey(scene.water, scene.cameras, settings))
    # as of a cloud of ten times as many points, whose cells have enough of them
    survey, _ = learn_of_sample(whole, 10 * len(whole))
    assert survey.learned.dense
    rows = np.flatnonzero(is_submerged(xyz[:, 2], above))
    return replace(whole, survey=survey).take(rows), scene.views.take(rows), scene.gsd_m


def some(with_list, block="nadir"):
    part, views, gsd_m = dense(block)
    if with_list:  # slow, computed exactly: a sixth of the area
        rows = np.flatnonzero(part.xyz[:, 0] < np.quantile(part.xyz[:, 0], 0.17))
        part = replace(part.take(rows), views=replace(views.take(rows), kind="depth-maps"))
    return part, gsd_m


with_and_without_list = pytest.mark.parametrize("with_list", [True, False], ids=["list", "no list"])


@with_and_without_list
@pytest.mark.parametrize("block", mostly_nightly(BLOCKS, "nadir"))
def test_as_exact(block, with_list):
    part, gsd_m = some(with_list, block)
    exact = replace(part.survey, settings=replace(part.survey.settings, exact=True))
    quick, alone = correct(part), correct(replace(part, survey=exact))
    apart_px = np.linalg.norm(quick.shift_m - alone.shift_m, axis=1) / gsd_m
    assert np.median(apart_px) < 0.005
    # whether two maps agree, or which group is nearer, is nearly open for some: 0.1 to 1.7 %
    assert (apart_px > 0.05).mean() < 0.02
    np.testing.assert_array_equal(quick.outcome, alone.outcome)
    assert (apart_px > 0.0).mean() > 0.5  # polynomials were used


@with_and_without_list
def test_any_chunk(with_list):
    part, _ = some(with_list)
    whole, rows = correct(part), np.random.default_rng(2).permutation(len(part))[:300]
    with threads(3):
        np.testing.assert_array_equal(correct(part.take(rows)).shift_m, whole.shift_m[rows])


def test_seen_flat():
    cameras = looking(
        [[0, 0, 70], [10, 0, 70], [160, 0, 70], [165, 5, 70]], [0, 0, 50, 50], [0, 0, 180, 180]
    )
    xyz = np.array([[5.0, 0.0, -2.0], [80.0, 0.0, -2.0], [900.0, 0.0, -2.0]])
    above = surface_above(WaterPlane(0.0), xyz)
    settings = ScienceOptions(method="consistent", camera_set="all")
    flat = with_rays(batch_of(xyz, above, WaterPlane(0.0), cameras, settings)).seen_flat()
    assert flat.tolist() == [False, True, False]  # from above; at 48 degrees; not at all
    assert FLAT_DEG < 48.0

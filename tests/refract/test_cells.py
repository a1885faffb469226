"""Neighbours corrected by polynomials: as each by itself, within 0.05 ground pixels."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from pcfix.kernels import threads
from pcfix.model import Outcome, Views, WaterPlane
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import FLAT_DEG, Batch, Survey
from pcfix.refract.cells import neighbours_in_cells
from pcfix.refract.choice import chosen_views
from pcfix.refract.learning import learn_of_sample
from pcfix.refract.methods import correct, with_rays
from pcfix.refract.pair_table import LEAST_POINTS
from pcfix.water.surface import is_submerged, surface_above
from tests.refract.test_consistent import (
    DISTORTED,
    FISHEYE,
    GSD_M,
    PLAIN,
    nadir_block,
    oblique_block,
)
from tests.utils.batches import batch_of
from tests.utils.depth_map_twin import looking
from tests.utils.nightly import mostly_nightly
from tests.utils.simulated import simulated

TOLERANCE_PX = 0.05
LEVEL, RIVER = WaterPlane(0.0), WaterPlane(0.0, 0.004, -0.002)


def bed(rng, deepest_m=8.0, m=6000):
    """Return apparent points of 20 m x 20 m, from the shore down; every hundredth is an outlier."""
    x, y = rng.uniform(-10.0, 10.0, (2, m))
    depth = deepest_m * (0.52 + 0.4 * np.sin(x / 6.0) * np.cos(y / 9.0)) + rng.normal(0, 0.03, m)
    depth[::100] += rng.uniform(-2.0, 2.0, len(depth[::100]))
    return np.column_stack([x, y, -np.maximum(depth, 1e-3)])


def levelled(xyz, cameras):
    """Return points under level water as a batch without lists."""
    settings = ScienceOptions(method="consistent", camera_set="all")
    return batch_of(xyz, surface_above(LEVEL, xyz), LEVEL, cameras, settings)


def both(xyz, cameras, water=LEVEL, views=None, offset=None, **settings):
    """Return the results with polynomials, and of every point by itself."""
    one = ScienceOptions(method="consistent", camera_set="all", **settings)
    batch = batch_of(xyz, surface_above(water, xyz), water, cameras, one, views, offset)
    alone = replace(batch, survey=replace(batch.survey, settings=replace(one, exact=True)))
    return correct(batch), correct(alone)


def assert_as_alone(quick, alone):
    apart_px = np.linalg.norm(quick.shift_m - alone.shift_m, axis=1) / GSD_M
    assert apart_px.max() < TOLERANCE_PX
    for name in ("outcome", "ray_count", "camera_used"):
        np.testing.assert_array_equal(getattr(quick, name), getattr(alone, name))
    np.testing.assert_allclose(quick.incidence_deg, alone.incidence_deg, atol=1e-9)
    np.testing.assert_allclose(quick.ray_miss_m, alone.ray_miss_m, atol=TOLERANCE_PX * GSD_M)
    np.testing.assert_allclose(quick.sigma_z_m, alone.sigma_z_m, rtol=0.01)
    return apart_px


@pytest.mark.parametrize("lens", [PLAIN, DISTORTED, FISHEYE], ids=["plain", "distorted", "fisheye"])
@pytest.mark.parametrize("water", [LEVEL, RIVER], ids=["level", "river"])
@pytest.mark.parametrize("block", [nadir_block, oblique_block])
def test_cells_as_exact(block, water, lens):
    rng = np.random.default_rng(1)
    xyz = bed(rng)
    apart_px = assert_as_alone(*both(xyz, block(rng, lens), water))
    assert np.mean(apart_px > 0.0) > 0.5  # else every point was solved by itself


def test_cells_with_lists():
    rng = np.random.default_rng(2)
    xyz, cameras = bed(rng), oblique_block(rng)
    count = rng.integers(0, 25, len(xyz))
    start = np.concatenate([[0], np.cumsum(count)])
    listed = np.concatenate([rng.choice(len(cameras), k, replace=False) for k in count])
    quick, alone = both(xyz, cameras, views=Views(start, listed))
    apart_px = assert_as_alone(quick, alone)
    assert np.mean(apart_px > 0.0) > 0.2  # cameras from all sides: the one step is often too long
    assert len(np.unique(quick.outcome)) == 3


def test_cells_with_offsets():
    rng = np.random.default_rng(3)
    xyz, cameras = bed(rng, 1.0), nadir_block(rng)
    apart_px = assert_as_alone(*both(xyz, cameras, offset=rng.uniform(-0.5, 0.0, len(cameras))))
    assert np.mean(apart_px > 0.0) > 0.1  # not where a ray stays dry beside those that do not


def test_camera_named_twice():
    rng = np.random.default_rng(6)
    xyz, cameras = bed(rng), nadir_block(rng)
    seen = chosen_views(levelled(xyz, cameras))
    twice = rng.random(len(seen.camera)) < 0.004
    more = np.concatenate([[0], np.cumsum(twice)])[seen.start]
    listed = np.repeat(seen.camera, 1 + twice)
    quick, alone = both(xyz, cameras, views=Views(seen.start + more, listed))
    assert np.mean(assert_as_alone(quick, alone) > 0.0) < 0.95  # as alone, where one is twice


def test_cells_hold_their_points_and_neighbours_are_near():
    rng = np.random.default_rng(7)
    xyz, cameras = bed(rng), nadir_block(rng)
    xyz[:, :2] -= 1e5
    batch = levelled(xyz, cameras)
    order, first = neighbours_in_cells(batch)
    assert np.array_equal(np.sort(order), np.arange(len(xyz)))
    cell = np.floor(xyz[order, :2] / 8.0)
    places = [np.unique(part, axis=0) for part in np.split(cell, first[1:-1])]
    assert all(len(part) == 1 for part in places)
    assert len(np.unique(np.vstack(places), axis=0)) == len(places)
    steps = np.linalg.norm(np.diff(xyz[order, :2], axis=0), axis=1)
    assert np.median(steps) < 2.0


def test_parts_are_nearly_the_whole():
    rng = np.random.default_rng(4)
    xyz, cameras = bed(rng), oblique_block(rng)
    one, _ = both(xyz, cameras)
    some = np.sort(rng.choice(len(xyz), 2500, replace=False))
    part, _ = both(xyz[some], cameras)
    apart_m = np.linalg.norm(part.shift_m - one.shift_m[some], axis=1)
    assert apart_m.max() < TOLERANCE_PX * GSD_M
    assert (one.outcome == Outcome.CORRECTED).all()


# dense matching

BLOCKS = {"nadir": {}, "half oblique": {"obliques_deg": 30.0}}


@lru_cache(maxsize=4)
def dense(block, cloud, area_m=(70.0, 50.0)):
    """Return the submerged points of a simulated cloud, their views, and the GSD."""
    how = BLOCKS[block] | {"cloud": cloud} | ({"area_m": area_m} if block != "nadir" else {})
    scene = simulated(12_000, seed=1, lidar_per_m2=0.0, **how)
    settings = ScienceOptions(
        method="consistent", matcher=cloud, camera_set="mvs", dimensions="none"
    )
    xyz = scene.apparent_xyz
    whole = Batch(
        xyz, surface_above(scene.water, xyz), Survey(scene.water, scene.cameras, settings)
    )
    survey, _ = learn_of_sample(whole, len(whole))
    rows = np.flatnonzero(is_submerged(xyz[:, 2], whole.surface))
    return replace(whole, survey=survey).take(rows), scene.views.take(rows), scene.gsd_m


def quick_and_exact(part):
    settings = replace(part.survey.settings, exact=True)
    return correct(part), correct(replace(part, survey=replace(part.survey, settings=settings)))


@pytest.mark.parametrize("with_list", [True, False], ids=["list", "no list"])
@pytest.mark.parametrize("block", mostly_nightly(BLOCKS, "nadir"))
def test_depth_maps_in_cells(block, with_list):
    part, views, gsd_m = dense(block, "depth-maps")
    if with_list:  # which is slow alone: a sixth of the area
        rows = np.flatnonzero(part.xyz[:, 0] < np.quantile(part.xyz[:, 0], 0.17))
        part = replace(part.take(rows), views=replace(views.take(rows), kind="depth-maps"))
    quick, alone = quick_and_exact(part)
    apart_px = np.linalg.norm(quick.shift_m - alone.shift_m, axis=1) / gsd_m
    assert np.median(apart_px) < 0.005
    # whether two maps agree, or which group is nearer, is nearly open for some: 0.1 to 1.7 %
    assert (apart_px > 0.05).mean() < 0.02
    np.testing.assert_array_equal(quick.outcome, alone.outcome)
    assert (quick.shift_m != alone.shift_m).any(axis=1).mean() > 0.5  # polynomials were used


@pytest.mark.parametrize("block", mostly_nightly(BLOCKS, "half oblique"))
def test_pairs_in_cells(block):
    part, _, gsd_m = dense(block, "pairs", (60.0, 40.0))
    quick, each = quick_and_exact(part)
    apart_px = np.linalg.norm(quick.shift_m - each.shift_m, axis=1) / gsd_m
    # twice what polynomials may lack at the corners of a cell, as depths grow by 1.3 to 2
    assert apart_px.max() < 0.05
    np.testing.assert_array_equal(quick.outcome, each.outcome)
    np.testing.assert_array_equal(quick.ray_count, each.ray_count)
    assert (quick.shift_m != each.shift_m).any(axis=1).mean() > 0.3  # polynomials were used
    few, exact = quick_and_exact(part.take(np.arange(LEAST_POINTS - 1)))
    np.testing.assert_array_equal(few.shift_m, exact.shift_m)  # cells of few points have none
    # the table is the same for any number of threads
    with threads(3):
        np.testing.assert_array_equal(correct(part).shift_m, quick.shift_m)


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

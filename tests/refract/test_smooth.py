"""Neighbours corrected by polynomials: as each by itself, within 0.05 ground pixels."""

from dataclasses import replace

import numpy as np
import pytest

from pcfix.kernels import threads
from pcfix.model import Outcome, Views, WaterPlane
from pcfix.options.correct import ScienceOptions
from pcfix.refract.cells import neighbours_in_cells
from pcfix.refract.choice import chosen_views
from pcfix.refract.methods import correct
from pcfix.water.surface import surface_above
from tests.refract.test_consistent import (
    DISTORTED,
    FISHEYE,
    GSD_M,
    PLAIN,
    nadir_block,
    oblique_block,
)
from tests.utils.batches import batch_of

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
def test_neighbours_are_as_alone(block, water, lens):
    rng = np.random.default_rng(1)
    xyz = bed(rng)
    apart_px = assert_as_alone(*both(xyz, block(rng, lens), water))
    assert np.mean(apart_px > 0.0) > 0.5  # else every point was solved by itself


def test_so_are_points_with_lists_of_their_own():
    rng = np.random.default_rng(2)
    xyz, cameras = bed(rng), oblique_block(rng)
    count = rng.integers(0, 25, len(xyz))
    start = np.concatenate([[0], np.cumsum(count)])
    listed = np.concatenate([rng.choice(len(cameras), k, replace=False) for k in count])
    quick, alone = both(xyz, cameras, views=Views(start, listed))
    apart_px = assert_as_alone(quick, alone)
    assert np.mean(apart_px > 0.0) > 0.2  # cameras from all sides: the one step is often too long
    assert len(np.unique(quick.outcome)) == 3


def test_so_they_are_where_the_water_fell_during_the_flight():
    rng = np.random.default_rng(3)
    xyz, cameras = bed(rng, 1.0), nadir_block(rng)
    apart_px = assert_as_alone(*both(xyz, cameras, offset=rng.uniform(-0.5, 0.0, len(cameras))))
    assert np.mean(apart_px > 0.0) > 0.1  # not where a ray stays dry beside those that do not


def test_a_camera_that_a_list_names_twice_counts_twice():
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


def test_threads_do_not_matter_and_parts_hardly():
    rng = np.random.default_rng(4)
    xyz, cameras = bed(rng), oblique_block(rng)
    with threads(1):
        one, _ = both(xyz, cameras)
    with threads(3):
        three, _ = both(xyz, cameras)
    np.testing.assert_array_equal(one.shift_m, three.shift_m)
    some = np.sort(rng.choice(len(xyz), 2500, replace=False))
    part, _ = both(xyz[some], cameras)
    apart_m = np.linalg.norm(part.shift_m - one.shift_m[some], axis=1)
    assert apart_m.max() < TOLERANCE_PX * GSD_M
    assert (one.outcome == Outcome.CORRECTED).all()

"""A block is put together from what there is, and nothing is mixed up on the way."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from pcfix.adjust.block import (
    Material,
    block_of,
    restricted,
    taken,
    ties_of_cloud,
    true_start,
    usable_ties,
    well_seen,
)
from pcfix.model import TiePoints, Views, WaterPlane
from pcfix.simulate.tracing import project
from tests.utils.codes import refused
from tests.utils.tie_points import simulate_tie_points


@cache
def scene():
    return simulate_tie_points(60, area_m=(50, 40), greatest_depth_m=5)


def gathered(**changes):
    made = scene()
    given = {
        "name": "model", "original": made.cameras, "water": made.water,
        "refractive_index": made.refractive_index, "gnss": made.cameras.gnss,
        "control": made.control,
    }  # fmt: skip
    return block_of(Material(**(given | changes)), made.ties, 0.7)


def observations(block):
    """Return point, image and place of all observations as a set."""
    rows = zip(block.owner, block.camera, *block.image_xy.T, strict=True)
    return {tuple(map(float, row)) for row in rows}


def test_observations():
    made, block = scene(), gathered()
    m, control = len(made.truth), made.control
    owner = np.repeat(np.arange(m), np.diff(made.views.start))
    ties = zip(owner, made.views.camera, *made.ties.image_xy.T, strict=True)
    marks = zip(m + control.point, control.camera, *control.image_xy.T, strict=True)
    assert observations(block) == {tuple(map(float, row)) for row in (*ties, *marks)}
    assert len(block.owner) == len(made.views.camera) + len(control.point)


def test_check_points():
    made, block = scene(), gathered()
    m, control = len(made.truth), made.control
    assert control.is_check.any()
    assert not control.is_check.all()
    of_check = np.isin(block.owner, m + np.flatnonzero(control.is_check))
    assert np.isinf(block.sigma_px[of_check]).all()
    assert np.isfinite(block.sigma_px[~of_check]).all()
    np.testing.assert_array_equal(block.is_surveyed[m:], ~control.is_check)
    assert not block.is_surveyed[:m].any()
    np.testing.assert_array_equal(block.surveyed_xyz[m:], control.xyz)
    np.testing.assert_array_equal(block.wet[m:], control.under_water)
    assert block.control_names == control.names


def test_true_start():
    water = WaterPlane(2.0, 0.01, 0.0)
    xyz = np.array([[0.0, 0.0, 1.0], [100.0, 0.0, 1.0], [0.0, 0.0, 2.5]])
    found = true_start(xyz, water, 1.34)
    np.testing.assert_allclose(found[:, 2], [2.0 - 1.34, 3.0 - 2.0 * 1.34, 2.5])
    np.testing.assert_array_equal(found[:, :2], xyz[:, :2])
    outside = true_start(xyz, water, 1.34, np.array([False, True, True]))
    assert outside[0, 2] == 1.0
    np.testing.assert_array_equal(true_start(xyz, None, 1.34), xyz)


def test_ties_of_cloud():
    made = scene()
    views = made.views
    ties = ties_of_cloud(made.truth, views, made.cameras)
    owner = np.repeat(np.arange(len(made.truth)), np.diff(views.start))
    expected, _ = project(made.truth[owner], made.cameras, views.camera, made.cameras.lenses[0])
    np.testing.assert_allclose(ties.image_xy, expected, atol=1e-6)  # px: of thousands
    np.testing.assert_array_equal(ties.views.start, views.start)
    np.testing.assert_array_equal(ties.views.camera, views.camera)


def test_usable_ties():
    made = scene()
    first = made.ties.views.start[1]
    lone = Views(np.array([0, 1, 1 + first, 1 + 2 * first]), np.zeros(1 + 2 * first, int))
    camera = made.ties.views.camera[:first]
    lone = replace(lone, camera=np.concatenate([camera[:1], camera, camera]))
    xyz = np.array([made.truth[0], made.truth[0], [np.nan] * 3])
    ties = TiePoints(xyz, lone, np.zeros((1 + 2 * first, 2)))
    found = usable_ties(ties, made.cameras)
    np.testing.assert_array_equal(found.xyz, xyz[1:2])
    # 40 m over 5 km is half a degree
    far = replace(ties, xyz=xyz - [0.0, 0.0, 5000.0])
    assert len(usable_ties(far, made.cameras).xyz) == 0


def test_many_ties():
    made = scene()
    one, two = (usable_ties(made.ties, made.cameras, most=20) for _ in range(2))
    assert len(one.xyz) == 20
    np.testing.assert_array_equal(one.image_xy, two.image_xy)
    rows = [int(np.flatnonzero((made.truth == xyz).all(axis=1))[0]) for xyz in one.xyz]
    same = taken(made.ties, np.array(rows))
    np.testing.assert_array_equal(one.image_xy, same.image_xy)
    np.testing.assert_array_equal(one.views.camera, same.views.camera)


def test_poor_image():
    made = scene()
    block = gathered(control=None)
    seen = np.flatnonzero(block.camera == 3)
    sigma = block.sigma_px.copy()
    sigma[seen[3:]] = np.inf
    poor = replace(block, sigma_px=sigma)
    rows = well_seen(poor)
    assert set(range(len(made.cameras))) - set(rows.tolist()) == {3}
    less = restricted(poor, rows)
    names = [made.cameras.labels[i] for i in rows]
    assert list(less.cameras.labels) == names
    back = {(int(p), names[c], *uv) for p, c, uv in
            zip(less.owner, less.camera, map(tuple, less.image_xy), strict=True)}  # fmt: skip
    all_of = {(int(p), made.cameras.labels[c], *uv) for p, c, uv in
              zip(block.owner, block.camera, map(tuple, block.image_xy), strict=True)
              if c != 3}  # fmt: skip
    assert back == all_of
    np.testing.assert_array_equal(less.gnss_xyz, made.cameras.gnss.xyz[rows])


def test_control_under_water():
    control = scene().control
    assert control.under_water.any()
    silent = replace(control, under_water=np.zeros(len(control.names), bool))
    names = [control.names[i] for i in np.flatnonzero(control.under_water)]
    with refused("gcps.under_water", points=names):
        gathered(control=silent)
    assert gathered(control=silent, water=None).control_names == control.names

"""A block is put together from what there is, and nothing is mixed up on the way."""

from dataclasses import replace
from functools import cache

import numpy as np

from pcfix.adjust.block import NO_CONTROL, block_of, restricted, usable_ties, well_seen
from pcfix.model import TiePoints, Views
from tests.utils.codes import refused
from tests.utils.tie_points import simulate_tie_points


@cache
def scene():
    return simulate_tie_points(60, area_m=(50, 40), greatest_depth_m=5)


def gathered(**changes):
    data = scene()
    given = {"water": data.water, "refractive_index": data.refractive_index,
             "control": data.control}  # fmt: skip
    block = block_of(data.cameras, data.ties, **(given | changes))
    return replace(block, gnss=data.cameras.gnss)


def test_usable_ties():
    data = scene()
    first = data.ties.views.start[1]
    single = Views(np.array([0, 1, 1 + first, 1 + 2 * first]), np.zeros(1 + 2 * first, int))
    camera = data.ties.views.camera[:first]
    single = replace(single, camera=np.concatenate([camera[:1], camera, camera]))
    xyz = np.array([data.truth[0], data.truth[0], [np.nan] * 3])
    ties = TiePoints(xyz, single, np.full((1 + 2 * first, 2), np.nan))
    found = usable_ties(ties, data.cameras)
    np.testing.assert_array_equal(found.xyz, xyz[1:2])
    # 40 m over 5 km is half a degree
    far = replace(ties, xyz=xyz - [0.0, 0.0, 5000.0])
    assert len(usable_ties(far, data.cameras).xyz) == 0


def test_poor_image():
    data = scene()
    block = gathered(control=NO_CONTROL)
    seen = np.flatnonzero(block.camera == 3)
    sigma = block.sigma_px.copy()
    sigma[seen[3:]] = np.inf
    poor = replace(block, sigma_px=sigma)
    rows = well_seen(poor)
    assert set(range(len(data.cameras))) - set(rows.tolist()) == {3}
    less = restricted(poor, rows)
    names = [data.cameras.labels[i] for i in rows]
    assert list(less.cameras.labels) == names
    back = {(int(p), names[c], *uv) for p, c, uv in
            zip(less.owner, less.camera, map(tuple, less.image_xy), strict=True)}  # fmt: skip
    all_of = {(int(p), data.cameras.labels[c], *uv) for p, c, uv in
              zip(block.owner, block.camera, map(tuple, block.image_xy), strict=True)
              if c != 3}  # fmt: skip
    assert back == all_of
    np.testing.assert_array_equal(less.gnss.xyz, data.cameras.gnss.xyz[rows])


def test_control_under_water():
    control = scene().control
    assert control.under_water.any()
    silent = replace(control, under_water=np.zeros(len(control.names), bool))
    names = [control.names[i] for i in np.flatnonzero(control.under_water)]
    with refused("gcps.under_water", points=names):
        gathered(control=silent)
    assert gathered(control=silent, water=None).control.names == control.names

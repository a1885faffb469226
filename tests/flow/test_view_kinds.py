"""The kind of a view list, detected from discontinuities between neighbours."""

from dataclasses import replace

import numpy as np
import pytest

import pcfix
from pcfix.io.views import ViewMatch, read_views
from pcfix.model import Views, WaterPlane
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Learned
from pcfix.refract.learning import weigh_lists
from pcfix.refract.matcher import matcher_of
from pcfix.refract.patches import FEWEST_POINTS
from pcfix.water.surface import surface_above
from tests.utils.batches import batch_of
from tests.utils.matchers import matched_scene
from tests.utils.nightly import mostly_nightly
from tests.utils.shared import needs

RENDERED, rendered = needs("rendered_a")


def kind_of(xyz, cameras, water, views, n=1.34):
    settings = ScienceOptions(method="consistent", index=n, dimensions="none")
    learned = Learned(matcher=matcher_of(cameras, xyz))
    above = surface_above(water, xyz)
    batch = batch_of(xyz, above, water, cameras, settings, views, learned=learned)
    return weigh_lists(batch, is_open=True)


def under_water(cloud, points=1200, **settings):
    scene = matched_scene(points, cloud=cloud, lidar_per_m2=0.0, **settings)
    return scene, np.flatnonzero(scene.depth_m(scene.xyz) > 0.0)


BLOCKS = {
    "nadir": {"detection": 0.6},
    "obliques": {"detection": 0.6, "obliques_deg": 35.0, "area_m": (70.0, 50.0)},
}


@pytest.mark.parametrize("block", mostly_nightly(BLOCKS, "obliques"))
@pytest.mark.parametrize("cloud", ["tracks", "depth-maps"])
def test_simulated(cloud, block):
    scene, rows = under_water(cloud, **BLOCKS[block])
    views = replace(scene.views.take(rows), kind="depth-maps")
    found = kind_of(scene.xyz[rows], scene.cameras, scene.water, views)
    assert found.chosen.kind == cloud and found.is_sure
    assert found.share < 0.3 < 0.7 < found.candidates[found.runner_up.words]


def test_not_enough_evidence():
    """Too few points, or points of one image each."""
    scene, rows = under_water("tracks", 800, bed="flat")
    few = rows[: FEWEST_POINTS - 1]
    views = replace(scene.views.take(few), kind="depth-maps")
    assert kind_of(scene.xyz[few], scene.cameras, scene.water, views) is None
    first = scene.views.camera[scene.views.start[rows]]
    views = Views(np.arange(len(rows) + 1), first, None, "depth-maps")
    assert len(rows) > FEWEST_POINTS
    assert kind_of(scene.xyz[rows], scene.cameras, scene.water, views) is None


@rendered
def test_real_dense_cloud():
    import laspy

    local = pcfix.read_cameras(RENDERED / "colmap")
    cameras = replace(local, centres=local.centres + np.loadtxt(RENDERED / "offset.txt"))
    xyz = np.ascontiguousarray(laspy.read(RENDERED / "cloud.las").xyz)
    match = ViewMatch(read_views(RENDERED / "dense.vis", cameras), cameras, points=len(xyz))
    rows = np.flatnonzero(xyz[:, 2] < 0.37)[::5]
    views = match.views_of(xyz, 0)[0].take(rows)
    assert kind_of(xyz[rows], cameras, WaterPlane(0.37), views).chosen.kind == "depth-maps"

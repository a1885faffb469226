"""How a cloud was made is told by the steps between neighbours, and `auto` corrects it so."""

from dataclasses import replace

import numpy as np
import pytest

import pcfix
from pcfix.model import Cameras, WaterPlane
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Batch, Survey
from pcfix.refract.learning import learn_of_sample
from pcfix.refract.reconstructions import IN_FRAME, hint_of, reconstructions_of
from pcfix.water.surface import surface_above
from tests.utils.matchers import simulated
from tests.utils.nightly import mostly_nightly
from tests.utils.shared import needs

RENDERED, rendered = needs("rendered_a")
AUTO = ScienceOptions(method="auto", index=1.34)


def detected(xyz, cameras, water, settings=AUTO):
    batch = Batch(xyz, surface_above(water, xyz), Survey(water, cameras, settings))
    survey, verdicts = learn_of_sample(batch)
    return survey.settings, verdicts[0] if verdicts else None


# two of them have the same bed and block: what differs is the software
CLOUDS = {
    "tracks": {"cloud": "tracks"},
    "depth-maps": {"cloud": "depth-maps"},
    "river of tracks": {"cloud": "tracks", "bed": "river"},
    "pairs": {"cloud": "pairs"},
}
COARSE = {"points": 40_000, "seed": 1, "lidar_per_m2": 0.0, "sensor_px": (1824, 1216)}
"""A cloud as dense as those of matchers, about 5 pixels from point to point."""


@pytest.mark.parametrize("name", mostly_nightly(CLOUDS, "tracks", "depth-maps"))
def test_simulated_cloud(name):
    scene = simulated(12_000, seed=1, lidar_per_m2=0.0, **CLOUDS[name])
    settings, verdict = detected(scene.apparent_xyz, scene.cameras, scene.water)
    kind = {"river of tracks": "tracks"}.get(name, name)
    place = ["tracks", "depth-maps", "pairs"].index(kind)
    assert verdict.chosen is IN_FRAME[place]
    assert settings.method == "consistent"
    assert verdict.share < verdict.candidates[verdict.runner_up.words]
    # the single maps of images predict nearly the scatter of simulated fused maps
    assert verdict.is_sure or name in ("pairs", "depth-maps")
    assert (verdict.confidence >= 0.99) == verdict.is_sure
    assert {one.words for one in IN_FRAME} == {verdict.chosen.words, *verdict.candidates}
    assert verdict.runner_up.words in str(verdict)


@pytest.mark.parametrize("kind", mostly_nightly(["single-map", "nearest-map"], "single-map"))
def test_single_maps(kind):
    scene = simulated(cloud=kind, **COARSE)
    rows = np.diff(scene.views.start) > 0
    settings, verdict = detected(scene.xyz[rows], scene.cameras, scene.water)
    assert verdict.chosen is IN_FRAME[["single-map", "nearest-map"].index(kind) + 3]
    assert (settings.camera_set, settings.matcher) == ("mvs", kind)
    assert verdict.confidence > 0.8


def test_software_is_a_prior():
    """It decides where the cloud does not, and not against it."""
    scene = simulated(cloud="single-map", **COARSE)
    rows = np.diff(scene.views.start) > 0
    xyz, water = scene.xyz[rows], scene.water
    batch = Batch(xyz, surface_above(water, xyz), Survey(water, scene.cameras, AUTO))
    _, (free,) = learn_of_sample(batch)
    _, (against,) = learn_of_sample(batch, hint=hint_of("openmvs"))
    _, (agreeing,) = learn_of_sample(batch, hint=hint_of("SURE 5.0"))
    assert free.chosen is against.chosen is agreeing.chosen is IN_FRAME[3]
    assert against.errors <= free.errors <= agreeing.errors


def test_no_limit_of_snell():
    """On tracks with obliques a limit would make snell twice as bad."""
    scene = simulated(12_000, seed=1, lidar_per_m2=0.0, obliques_deg=35.0)
    points, given = scene.apparent_xyz, (scene.cameras, scene.water)
    found, free = (
        pcfix.correct_points(points, *given, method="snell", max_angle=limit)
        for limit in ("auto", None)
    )
    np.testing.assert_array_equal(found.xyz, free.xyz)
    assert found.incidence_deg.max() > 60.0


def test_auto():
    scene = simulated(12_000, seed=1, lidar_per_m2=0.0)
    points, given = scene.apparent_xyz, (scene.cameras, scene.water)
    found = pcfix.correct_points(points, *given, method="auto")
    same = pcfix.correct_points(points, *given, method="consistent", camera_set="all")
    np.testing.assert_array_equal(found.xyz, same.xyz)
    listed = pcfix.correct_points(points, *given, method="auto", views=scene.views)
    same = pcfix.correct_points(points, *given, method="consistent", views=scene.views)
    np.testing.assert_array_equal(listed.xyz, same.xyz)


def test_no_lenses():
    scene = simulated(2_000, seed=1, lidar_per_m2=0.0)
    bare = Cameras(scene.cameras.labels, scene.cameras.centres)
    points = scene.apparent_xyz
    found = pcfix.correct_points(points, bare, scene.water, method="auto")
    same = pcfix.correct_points(points, bare, scene.water, method="snell")
    np.testing.assert_array_equal(found.xyz, same.xyz)


def test_camera_set():
    scene = simulated(500, seed=1, lidar_per_m2=0.0)
    batch = Batch(
        scene.apparent_xyz,
        surface_above(scene.water, scene.apparent_xyz),
        Survey(scene.water, scene.cameras, replace(AUTO, camera_set="mvs")),
    )
    assert reconstructions_of(batch) == IN_FRAME[1:]
    settings, verdict = detected(
        scene.apparent_xyz, scene.cameras, scene.water, replace(AUTO, camera_set="mvs")
    )
    assert verdict is None and (settings.camera_set, settings.matcher) == ("mvs", "depth-maps")


@rendered
def test_real_cloud():
    import laspy

    local = pcfix.read_cameras(RENDERED / "colmap")
    cameras = replace(local, centres=local.centres + np.loadtxt(RENDERED / "offset.txt"))
    xyz = np.ascontiguousarray(laspy.read(RENDERED / "cloud.las").xyz)
    _, verdict = detected(xyz[::2], cameras, WaterPlane(0.37))
    assert verdict.chosen is IN_FRAME[1] and verdict.is_sure


SGM = {
    "rendered_a_sgm/multi.laz": (1.3, IN_FRAME[3]),
    "rendered_a_sgm/steepest.laz": (1.0, IN_FRAME[4]),
    "rendered_c_sgm/multi.laz": (2.0, IN_FRAME[3]),
    "rendered_c_sgm/steepest.laz": (1.3, IN_FRAME[4]),
}
"""Clouds of semi-global matching: the largest RMSE of the bed in GSD of 5 cm, and the type."""


@rendered
@pytest.mark.parametrize("cloud", mostly_nightly(SGM, "rendered_c_sgm/steepest.laz"))
def test_semi_global_matching(cloud, tmp_path):
    import laspy
    import rasterio
    from scipy.ndimage import map_coordinates

    path, (most_gsd, kind) = RENDERED.parent / cloud, SGM[cloud]
    if not path.exists():
        pytest.skip(f"{path} is absent")
    block = path.parent.with_name(path.parent.name[:10])
    found = pcfix.correct_file(
        path, tmp_path / "out.las", cameras=block / "cameras.xml", water=0.37
    )
    assert found.reconstruction["type"] == kind.words
    las = laspy.read(tmp_path / "out.las")
    bed = np.flatnonzero(
        (np.asarray(las.classification) == 40) & (np.asarray(las.WaterDepth) > 0.2)
    )
    xyz, sigma = np.asarray(las.xyz)[bed], np.asarray(las.SigmaZ)[bed]
    with rasterio.open(block / "truth_dsm.tif") as raster:
        left, up = ~raster.transform @ (xyz[:, 0], xyz[:, 1])
        truth = map_coordinates(raster.read(1).astype(float), [up - 0.5, left - 0.5], order=1)
    error = xyz[:, 2] - truth
    assert np.sqrt(np.mean(error**2)) < most_gsd * 0.05
    assert np.mean(np.abs(error) < 1.96 * sigma) > 0.88


def test_list_of_base_images():
    """With the base image of each point: half a pixel in some images 0.2 flying heights away."""
    scene = simulated(8000, cloud="single-map", seed=1, lidar_per_m2=0.0, sensor_px=(1824, 1216))
    rows = np.flatnonzero(np.diff(scene.views.start) > 0)
    views = replace(scene.views.take(rows), kind="depth-maps")
    found = pcfix.correct_points(
        scene.xyz[rows], scene.cameras, scene.water, method="consistent", matcher="single-map",
        views=views,
    )  # fmt: skip
    deep = found.corrected & (scene.depth_m(scene.true_xyz[rows]) > 0.2)
    error = (found.xyz - scene.true_xyz[rows])[deep, 2] / scene.gsd_m
    assert abs(error.mean()) < 0.5
    assert np.sqrt(np.mean(error**2)) < 2.0


def test_rays_of_single_maps():
    """Their images were matched with others: 'pcfix clean' takes points of fewer rays for noise."""
    scene = simulated(8000, cloud="single-map", seed=1, lidar_per_m2=0.0, sensor_px=(1824, 1216))
    found = pcfix.correct_points(
        scene.xyz, scene.cameras, scene.water, method="consistent", matcher="single-map"
    )
    rays = found.ray_count[found.corrected]
    assert rays.min() >= 2 and np.median(rays) == 13

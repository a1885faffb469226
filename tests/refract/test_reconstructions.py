"""How a cloud was made is told by the steps between neighbours, and `auto` corrects it so."""

from dataclasses import replace

import laspy
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
from tests.utils.rendered import block_of, cloud_of, truth_m
from tests.utils.shared import needs

RENDERED, rendered = needs("rendered_a")
AUTO = ScienceOptions(method="auto", index=1.34)


def batch_of(xyz, cameras, water, settings=AUTO):
    return Batch(xyz, surface_above(water, xyz), Survey(water, cameras, settings))


def detected(*given):
    survey, verdicts = learn_of_sample(batch_of(*given))
    return survey.settings, verdicts[0] if verdicts else None


# A cloud as dense as those of matchers, about 5 pixels from point to point.
COARSE = {"points": 40_000, "sensor_px": (1824, 1216)}
CLOUDS = {
    "tracks": {},
    "depth-maps": {},
    "pairs": {},
    "single-map": COARSE,
    "nearest-map": COARSE,
    "river of tracks": {"bed": "river"},
}


def scene_of(kind, points=12_000, **choices):
    return simulated(points, cloud=kind, seed=1, lidar_per_m2=0.0, **choices)


@pytest.mark.parametrize("name", mostly_nightly(CLOUDS, "tracks", "depth-maps", "single-map"))
def test_simulated_cloud(name):
    kind, is_single = name.rpartition(" ")[2], CLOUDS[name] is COARSE
    scene = scene_of(kind, **CLOUDS[name])
    rows = np.diff(scene.views.start) > 0 if is_single else slice(None)
    settings, verdict = detected(scene.apparent_xyz[rows], scene.cameras, scene.water)
    place = ["tracks", "depth-maps", "pairs", "single-map", "nearest-map"].index(kind)
    assert verdict.chosen is IN_FRAME[place]
    assert settings.method == "consistent"
    assert {one.words for one in IN_FRAME} == {verdict.chosen.words, *verdict.candidates}
    assert verdict.runner_up.words in str(verdict)
    if is_single:
        assert (settings.camera_set, settings.matcher) == ("mvs", kind)
        assert verdict.confidence > 0.8
    else:
        assert verdict.share < verdict.candidates[verdict.runner_up.words]
        # the single maps of images predict nearly the scatter of simulated fused maps
        assert verdict.is_sure or name in ("pairs", "depth-maps")
        assert (verdict.confidence >= 0.99) == verdict.is_sure


def test_software_is_a_prior():
    """It decides where the cloud does not, and not against it."""
    scene = scene_of("single-map", **COARSE)
    rows = np.diff(scene.views.start) > 0
    batch = batch_of(scene.xyz[rows], scene.cameras, scene.water)
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
    found, same = (
        pcfix.correct_points(scene.xyz, bare, scene.water, method=method)
        for method in ("auto", "snell")
    )
    np.testing.assert_array_equal(found.xyz, same.xyz)


def test_camera_set():
    scene = simulated(500, seed=1, lidar_per_m2=0.0)
    given = scene.apparent_xyz, scene.cameras, scene.water, replace(AUTO, camera_set="mvs")
    assert reconstructions_of(batch_of(*given)) == IN_FRAME[1:]
    settings, verdict = detected(*given)
    assert verdict is None and (settings.camera_set, settings.matcher) == ("mvs", "depth-maps")


@rendered
def test_real_cloud():
    _, verdict = detected(
        cloud_of(RENDERED / "cloud.las")[::2], block_of(RENDERED)[1], WaterPlane(0.37)
    )
    assert verdict.chosen is IN_FRAME[1] and verdict.is_sure


# Clouds of semi-global matching: the largest RMSE of the bed in GSD of 5 cm, and the type.
SGM = {
    "rendered_a_sgm/multi.laz": (1.3, IN_FRAME[3]),
    "rendered_a_sgm/steepest.laz": (1.0, IN_FRAME[4]),
    "rendered_c_sgm/multi.laz": (2.0, IN_FRAME[3]),
    "rendered_c_sgm/steepest.laz": (1.3, IN_FRAME[4]),
}


@rendered
@pytest.mark.parametrize("cloud", mostly_nightly(SGM, "rendered_c_sgm/steepest.laz"))
def test_semi_global_matching(cloud, tmp_path):
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
    error = xyz[:, 2] - truth_m(block, xyz)
    assert np.sqrt(np.mean(error**2)) < most_gsd * 0.05
    assert np.mean(np.abs(error) < 1.96 * sigma) > 0.88


def test_base_images():
    """Half a pixel in some images 0.2 flying heights away, if the base image of each is listed.

    Without a list the rays are those of the images that it was matched with: 'pcfix clean' takes
    points of fewer rays for noise.
    """
    scene = simulated(8000, cloud="single-map", seed=1, lidar_per_m2=0.0, sensor_px=(1824, 1216))
    rows = np.flatnonzero(np.diff(scene.views.start) > 0)
    views, how = scene.views.take(rows), {"method": "consistent", "matcher": "single-map"}
    points, given = scene.xyz[rows], (scene.cameras, scene.water)
    found = pcfix.correct_points(points, *given, views=replace(views, kind="depth-maps"), **how)
    deep = found.corrected & (scene.depth_m(scene.true_xyz[rows]) > 0.2)
    error = (found.xyz - scene.true_xyz[rows])[deep, 2] / scene.gsd_m
    assert abs(error.mean()) < 0.5
    assert np.sqrt(np.mean(error**2)) < 2.0
    found = pcfix.correct_points(scene.xyz, *given, **how)
    rays = found.ray_count[found.corrected]
    assert rays.min() >= 2 and np.median(rays) == 13

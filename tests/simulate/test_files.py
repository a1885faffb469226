"""Files of a scene, read back by pcfix's own readers."""

import json

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.flow.demo import CLOUDS, colmap_vis, write_scene
from pcfix.io.views import read_views
from pcfix.model import Views
from tests.utils.program import run_pcfix


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    scene = pcfix.simulate_scene(
        300, tilt_percent=0.7, position_noise_m=0.02, lidar_per_m2=0.2,
        distortion=(-0.05, 0.02, -0.003, 0.0006, -0.0004),
    )  # fmt: skip
    write_scene(scene, folder, overwrite=False)
    return scene, folder


def test_files(written):
    scene, folder = written
    facts = json.loads((folder / "scene.json").read_text())
    names = {path.name for path in folder.iterdir()}
    tables = {"cameras.csv", "true_cameras.csv", "sensor.csv"}
    assert names == {*CLOUDS, *tables, "scene.json", "fused.ply.vis"}
    assert facts["arguments"]["tilt_percent"] == 0.7
    assert pcfix.read_water(facts["water"]) == scene.water
    with pytest.raises(pcfix.SettingError):
        write_scene(scene, folder, overwrite=False)


def test_cameras(written):
    scene, folder = written
    for name, cameras in (("cameras", scene.cameras), ("true_cameras", scene.true_cameras)):
        read = pcfix.read_cameras(folder / f"{name}.csv")
        assert read.labels == cameras.labels
        assert read.centres == pytest.approx(cameras.centres, abs=0.6e-4)  # four decimals
        assert read.rotations == pytest.approx(cameras.rotations, abs=1e-7)  # 1e-6 degrees
        assert read.lenses[0].radial == cameras.lenses[0].radial
        assert read.lenses[0].tangential == cameras.lenses[0].tangential
        assert read.lenses[0].focal == cameras.lenses[0].focal


def test_view_lists(tmp_path):
    counts = np.array([0, 300, 2, 0])
    camera = np.concatenate([np.arange(300), [4, 1]])
    views = Views(np.concatenate([[0], np.cumsum(counts)]), camera)
    cameras = pcfix.Cameras(tuple(map(str, range(300))), np.zeros((300, 3)))
    (tmp_path / "other.vis").write_bytes(colmap_vis(views))
    raw = read_views(tmp_path / "other.vis", cameras)
    assert np.array_equal(raw.listed.start, views.start)
    assert np.array_equal(raw.listed.camera, camera)


def test_flume_step(tmp_path):
    scene = pcfix.simulate_scene(
        100, bed="steps", area_m=(4, 2), flying_height_m=2.0, greatest_depth_m=0.3, lidar_per_m2=9
    )
    write_scene(scene, tmp_path, overwrite=False)
    assert np.abs(laspy.read(tmp_path / "cloud.laz").xyz - scene.xyz).max() < 0.000051


def test_command(tmp_path):
    words = "--points 150 --obliques-deg 35 --area-m 60 40 --bed river --quiet"
    words += " --distortion -0.03 0 0 0 0 --lidar-per-m2 0.5"
    done = run_pcfix("simulate", tmp_path, *words.split())
    assert done.returncode == 0, done.stderr
    facts = json.loads((tmp_path / "scene.json").read_text())
    scene = pcfix.simulate_scene(**facts["arguments"])
    assert scene.settings["bed"] == "river"
    assert np.abs(laspy.read(tmp_path / "cloud.laz").xyz - scene.xyz).max() < 0.00051

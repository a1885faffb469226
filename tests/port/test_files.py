"""A file of points taken under water, through the doors."""

import json

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.errors import GeometryError, SettingError
from pcfix.options.correct import ScienceOptions
from pcfix.port.methods import correct_through_port
from pcfix.port.shapes import FlatPort
from pcfix.report.text import summary_text
from tests.utils.port_scenes import simulate_port
from tests.utils.program import run_pcfix

SPEC = "flat:distance=0.02,thickness=0.008"


@pytest.fixture(scope="module")
def scene():
    return simulate_port(FlatPort(0.02, 0.008), points=500)


@pytest.fixture(scope="module")
def cloud(scene, tmp_path_factory):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.0001] * 3, scene.apparent[0].round()
    las = laspy.LasData(header)
    las.xyz = scene.apparent
    las.classification = np.where(np.arange(len(las)) % 10 == 0, 7, 2)
    path = tmp_path_factory.mktemp("port") / "cloud.las"
    las.write(path)
    return path


def test_a_file_is_what_the_arrays_are(scene, cloud, tmp_path):
    told = pcfix.correct_file(
        cloud, tmp_path / "out.las", cameras=scene.cameras, port=SPEC, method="consistent",
        respect_classes=(7,), summary=tmp_path / "run.json",
    )  # fmt: skip
    before, after = laspy.read(cloud), laspy.read(tmp_path / "out.las")
    noise = np.asarray(before.classification) == 7
    found = correct_through_port(
        np.array(before.xyz)[~noise], scene.cameras, scene.port, ScienceOptions(method="consistent")
    )
    moved = np.array(after.xyz) - np.array(before.xyz)
    assert not moved[noise].any()
    # half a step of the file
    assert np.abs(moved[~noise] - found.shift_m).max() <= 0.5001e-4
    assert np.asarray(after.SigmaZ)[~noise] == pytest.approx(found.sigma_z_m, abs=0.000051)
    assert set(np.asarray(after.classification)[~noise]) == {40}
    # no surface, no depth: the least that marks a submerged point
    assert set(np.asarray(after.WaterDepth)[~noise]) == {0.001}
    assert told.submerged == told.corrected == (~noise).sum()
    report = json.loads((tmp_path / "run.json").read_text())
    assert report["settings"]["port"]["thickness_m"] == 0.008
    assert report["depth_m"] == {}
    assert "seen through a flat port 20 mm before the projection centre" in summary_text(told)


def test_forward_intersection_says_what_it_leaves_out(scene, cloud, tmp_path):
    told = pcfix.correct_file(
        cloud, tmp_path / "out.las", cameras=scene.cameras, port=scene.port, method="snell"
    )
    (note,) = [one["message"] for one in told.warnings if one["code"] == "port.ray_distance"]
    assert "--method consistent" in note


def test_restored_to_the_bit(scene, cloud, tmp_path):
    pcfix.correct_file(cloud, tmp_path / "out.las", cameras=scene.cameras, port=SPEC)
    pcfix.restore_file(tmp_path / "out.las", tmp_path / "back.las")
    before, back = laspy.read(cloud), laspy.read(tmp_path / "back.las")
    assert np.array_equal(before.xyz, back.xyz)
    assert np.array_equal(before.classification, back.classification)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "water is missing"),
        ({"port": SPEC, "water": 0.0}, "water and port exclude each other"),
        ({"port": "flat"}, "distance is missing"),
        ({"port": SPEC, "method": "murase"}, "method murase has no effect with a port"),
        ({"port": SPEC, "camera_set": "mvs"}, "camera-set mvs has no effect with a port"),
        ({"port": SPEC, "unsure": "withhold"}, "unsure withhold has no effect with a port"),
        ({"port": SPEC, "connected": True}, "connected True has no effect with a port"),
        ({"port": SPEC, "tide": "tide.csv"}, "tide tide.csv has no effect with a port"),
    ],
)
def test_what_does_not_go_together_is_refused(scene, cloud, tmp_path, given, words):
    with pytest.raises(SettingError) as raised:
        pcfix.correct_file(cloud, tmp_path / "out.las", cameras=scene.cameras, **given)
    assert words in str(raised.value)
    assert not list(tmp_path.iterdir())


def test_cameras_elsewhere_are_refused(scene, cloud, tmp_path):
    away = pcfix.Cameras(
        scene.cameras.labels, scene.cameras.centres + np.array([5000.0, 0.0, 0.0]),
        scene.cameras.rotations, scene.cameras.lenses,
    )  # fmt: skip
    with pytest.raises(GeometryError, match="no camera has a point in sight"):
        pcfix.correct_file(cloud, tmp_path / "out.las", cameras=away, port=SPEC)
    assert not list(tmp_path.iterdir())


def test_command_line(cloud, tmp_path):
    def run(*words):
        return run_pcfix(
            "correct", cloud, tmp_path / "out.las", "--cameras", tmp_path / "none.csv", *words
        )

    neither = run()
    assert neither.returncode == 2
    assert "--port" in neither.stderr
    both = run("--water", "0", "--port", SPEC)
    assert both.returncode == 1
    assert "exclude each other" in both.stderr
    bad = run("--port", "flat:distance=-1")
    assert bad.returncode == 1
    assert "must not be negative" in bad.stderr
    missing = run("--port", SPEC)
    assert missing.returncode == 1
    assert "none.csv" in missing.stderr

"""Files of points taken under water, from Python and the command line."""

import json

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.errors import GeometryError, SettingError
from pcfix.options.correct import ScienceOptions
from pcfix.port.housing import FlatPort
from pcfix.port.methods import correct_through_port
from pcfix.report.text import text_of
from tests.utils.clouds import write_las
from tests.utils.port_scenes import simulate_port

SPEC = "flat:distance=0.02,thickness=0.008"


@pytest.fixture(scope="module")
def scene():
    return simulate_port(FlatPort(0.02, 0.008), points=500)


@pytest.fixture(scope="module")
def cloud(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("port") / "cloud.las"
    classes = np.where(np.arange(len(scene.apparent)) % 10 == 0, 7, 2)
    return write_las(path, scene.apparent, classes, crs=None, scale=0.0001)


def test_file(scene, cloud, tmp_path):
    found_summary = pcfix.correct_file(
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
    assert found_summary.submerged == found_summary.corrected == (~noise).sum()
    report = json.loads((tmp_path / "run.json").read_text())
    assert report["settings"]["port"]["thickness_m"] == 0.008
    assert report["depth_m"] == {}
    assert str(scene.port) in text_of("correct", found_summary)


def test_restored(scene, cloud, tmp_path):
    pcfix.correct_file(cloud, tmp_path / "out.las", cameras=scene.cameras, port=scene.port)
    pcfix.restore_file(tmp_path / "out.las", tmp_path / "back.las")
    before, back = laspy.read(cloud), laspy.read(tmp_path / "back.las")
    assert np.array_equal(before.xyz, back.xyz)
    assert np.array_equal(before.classification, back.classification)


@pytest.mark.parametrize(
    "given",
    [
        {}, {"port": SPEC, "water": 0.0}, {"port": "flat"}, {"port": SPEC, "method": "snell"},
        {"port": SPEC, "camera_set": "mvs"},
        {"port": SPEC, "connected": True}, {"port": SPEC, "tide": "tide.csv"},
    ],
    ids=str,
)  # fmt: skip
def test_options_refused(scene, cloud, tmp_path, given):
    with pytest.raises(SettingError):
        pcfix.correct_file(cloud, tmp_path / "out.las", cameras=scene.cameras, **given)
    assert not list(tmp_path.iterdir())


def test_other_cameras_refused(scene, cloud, tmp_path):
    away = pcfix.Cameras(
        scene.cameras.labels, scene.cameras.centres + np.array([5000.0, 0.0, 0.0]),
        scene.cameras.rotations, scene.cameras.lenses,
    )  # fmt: skip
    with pytest.raises(GeometryError):
        pcfix.correct_file(cloud, tmp_path / "out.las", cameras=away, port=SPEC)
    assert not list(tmp_path.iterdir())

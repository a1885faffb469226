"""The table of formats, and files that are known but not read: each is refused by its name."""

import json
import re

import pytest

import pcfix
from tests.io.cameras.test_blocksexchange import photo, simple
from tests.utils.codes import refused

pytestmark = pytest.mark.quick

PATB = "1 153.2\n 456010.1 5432010.2 90.3\n 0 1 0\n -1 0 0\n 0 0 1\n"
SFM = {"version": ["1", "2", "0"], "featuresFolders": [], "views": [{"viewId": "1"}]}

FILES = {
    "a.jpg": (b"\xff\xd8\xff\xe0\0\x10JFIF", "an image"),
    "a.las": (b"LASF\0\0", "a point cloud (LAS, LAZ)"),
    "a.p4d": (b'<?xml version="1.0"?>\n<!DOCTYPE Pix4D>\n', "a project of Pix4D"),
    "a.rcproj": (b"<RealityCaptureProject>", "a project of RealityCapture"),
    "a.prj": (b"$PROJECT 15.0.0\n  $ANGULAR_UNITS : deg\n$END\n", "Inpho"),
    "a.ori": (PATB.encode(), "a table without a header"),
    "a.sfm": (json.dumps(SFM).encode(), "AliceVision"),
    "gcp_list.txt": (b"EPSG:32632\n500 5000 10 120 80 a.jpg\n", "ground control points"),
    "sensor.csv": (b"focal,sensor_x,sensor_y\n8.8,13.2,8.8\n", "a table of the sensor"),
    "cameras.json": (b'{"v2 dji": {"projection_type": "brown"}}', "without poses"),
    "bare.csv": (b"a.jpg,456010,5432010,90\nb.jpg,456060,5432010,90\n", "without a header"),
    "AutoCal_Foc-8800.xml": (b"<ExportAPERO><CalibrationInternConique>", "MicMac"),
    "a_calibrated_images_position.txt": (b"a.jpg,456010.1,5432010.2,90.3\n", "of Pix4D"),
    # standard errors have the very header of a table of poses
    "a_calibrated_external_camera_parameters_error.txt": (
        b"imageName X Y Z Omega Phi Kappa\na.jpg 0.01 0.01 0.02 0.001 0.001 0.001\n",
        "of Pix4D",
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_file_and_its_folder(tmp_path, name):
    data, what = FILES[name]
    (tmp_path / name).write_bytes(data)
    (tmp_path / "a page.html").write_text("<html>")
    for given in (tmp_path / name, tmp_path):
        with refused("cameras.not_read", path=given) as caught:
            pcfix.read_cameras(given)
        assert what in caught.value.values["what"]


@pytest.mark.parametrize("data", [b"", b"some words\nand more\n", b"<other/>", b'{"a": "b"}'])
def test_unknown(tmp_path, data):
    (tmp_path / "what").write_bytes(data)
    with refused("cameras.unknown"):
        pcfix.read_cameras(tmp_path / "what")


@pytest.mark.parametrize("angles", [True, False])
def test_a_sensor_of_positions_alone_is_refused(tmp_path, angles):
    """BlocksExchange without a lens: with rotations the sensor counts, without it says nothing."""
    text = simple(photo(), head="<Name>g</Name>")
    text = text if angles else re.sub("<Rotation>.*</Rotation>", "", text)
    (tmp_path / "b.xml").write_text(text)
    sensor = tmp_path / "s.csv"
    sensor.write_text("focal,sensor_x,sensor_y\n8.8,13.2,8.8\n")
    if angles:
        assert pcfix.read_cameras(tmp_path / "b.xml", sensor).lenses[0].focal == 8.8
    else:
        with refused("cameras.sensor_unused"):
            pcfix.read_cameras(tmp_path / "b.xml", sensor)

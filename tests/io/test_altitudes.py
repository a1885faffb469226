"""How high drones flew, as their photographs and Metashape's projects have it."""

import numpy as np
import pytest

from pcfix.io.altitudes import read_altitudes
from pcfix.io.cameras import read_cameras
from tests.utils.shared import needs

CAMERAS, real = needs("cameras")


@pytest.mark.parametrize("text", ['="+30.10"', ">30.10</drone-dji:RelativeAltitude>", "='30.1'"])
def test_photographs_beside_the_camera_file(tmp_path, text):
    (tmp_path / "a.JPG").write_text(f"<x drone-dji:RelativeAltitude{text} y>")
    (tmp_path / "b.JPG").write_text("<x drone-dji:AbsoluteAltitude='88.0'>")
    (tmp_path / "c.txt").write_text("RelativeAltitude='99.0'")
    for place in (tmp_path, tmp_path / "cameras.csv"):
        found = read_altitudes(place, ["folder/a", "b", "c"])
        np.testing.assert_array_equal(found, [30.1, np.nan, np.nan])


@pytest.mark.parametrize("name", ["none/cameras.csv", "none.psx", "cameras.csv"])
def test_nothing_is_known_where_nothing_is_there(tmp_path, name):
    assert np.isnan(read_altitudes(tmp_path / name, ["a", "b"])).all()


@real
def test_a_project_of_metashape():
    path = CAMERAS / "metashape" / "easyidp_wheat_psx" / "wheat_tanashi.psx"
    found = read_altitudes(path, read_cameras(path).labels)
    assert len(found) == 138
    assert found[:3].tolist() == [30.0, 29.9, 29.8]
    assert np.ptp(found) < 2.0

"""Pix4D params folders."""

import numpy as np
import pytest
from pyproj import CRS
from scipy.spatial.transform import Rotation

from pcfix.lens.imaging import project
from tests.utils.camera_files import notes, read, read_ties
from tests.utils.codes import refused

pytestmark = pytest.mark.quick_but("test_fisheye", "test_what_is_missing")


HEADER = """fileName imageWidth imageHeight
camera matrix K [3x3]
radial distortion [3x1]
tangential distortion [2x1]
camera position t [3x1]
camera rotation R [3x3]
camera model m = K [R|-Rt] X

"""
DOWN = np.diag([1.0, -1.0, -1.0])


WKT = CRS.from_epsg(32647).to_wkt("WKT1_GDAL")


def block(label, position, rotation=DOWN, k=((4000, 0, 3010), (0, 4000, 1990), (0, 0, 1))):
    rows = [" ".join(repr(float(x)) for x in row) for row in (*k, (0.1, -0.2, 0.3), (0.01, 0.02))]
    rows += [" ".join(map(str, position))]
    rows += [" ".join(repr(float(x)) for x in row) for row in rotation]
    return "\n".join([f"{label} 6000 4000", *rows]) + "\n"


def external(*rows):
    return "imageName X Y Z Omega Phi Kappa\n" + "".join(" ".join(map(str, r)) + "\n" for r in rows)


def params(tmp_path, **files):
    """Write files named by the end of their name, and return the folder."""
    names = {
        "parameters": "job_calibrated_camera_parameters.txt",
        "external": "job_calibrated_external_camera_parameters.txt",
        "offset": "job_offset.xyz",
        "wkt": "job_wkt.prj",
        "bingo": "job_tp_bingo.txt",
        "gcps": "job_measured_estimated_gcps_position.txt",
    }
    folder = tmp_path / "job" / "1_initial" / "params"
    folder.mkdir(parents=True, exist_ok=True)
    for key, text in files.items():
        (folder / names[key]).write_text(text)
    return folder


def test_poses_of_either_table_agree(tmp_path):
    opk = (12.0, -7.0, 140.0)
    turn = Rotation.from_euler("XYZ", opk, degrees=True).as_matrix()
    rotation = DOWN @ turn.T
    centre = np.array([500_010.5, 4_000_020.25, 130.0])
    files = {
        "parameters": HEADER + block("a b.jpg", (10.5, 20.25, 30.0), rotation),
        "offset": "500000.000 4000000.000 100.000\n",
        "external": external(("a b.jpg", *centre, *opk)),
        "wkt": WKT,
    }
    everything = read(params(tmp_path / "all", **files))
    del files["external"]
    relative = read(params(tmp_path / "relative", **files))
    for cameras in (everything, relative):
        assert cameras.labels == ("a b.jpg",)
        assert cameras.centres[0] == pytest.approx(centre)
        assert cameras.rotations[0] == pytest.approx(rotation, abs=1e-9)
        assert cameras.notes == ()
        assert cameras.crs.startswith("PROJCS")


FISHEYE_HEADER = """fileName imageWidth imageHeight
principal point [2x1]
affine transformation c d e f [4x1]
polynomial p0 p1 p2 p3 [4x1]
camera position t [3x1]
camera rotation R [3x3]

"""


def fisheye_uv(direction):
    """Return where the fisheye of the texts above sees a direction."""
    x, y, z = direction
    theta = 2.0 / np.pi * np.arctan2(np.hypot(x, y), z)
    rho = theta + 0.02 * theta**2 - 0.15 * theta**3
    xh, yh = rho * x / np.hypot(x, y), rho * y / np.hypot(x, y)
    return 1780.0 * xh + 2.0 * yh + 3005.0, -3.0 * xh + 1790.0 * yh + 1990.0


def test_fisheye(tmp_path):
    numbers = "3005 1990\n1780 2 -3 1790\n0 1 0.02 -0.15\n"
    pose = "1 2 3\n1 0 0\n0 -1 0\n0 0 -1\n"
    parameters = FISHEYE_HEADER + "f.jpg 6000 4000\n" + numbers + pose
    cameras = read(params(tmp_path, parameters=parameters, offset="10 20 30"))
    assert cameras.centres.tolist() == [[11, 22, 33]]
    lens = cameras.lenses[0]
    for direction in ((0.3, 0.4, 1.0), (-2.0, 1.0, 0.1)):
        found = project(lens, np.array([direction]))[0]
        assert found == pytest.approx(fisheye_uv(direction), abs=1e-6)


@pytest.mark.parametrize(
    ("files", "codes"),
    [
        ({"parameters": HEADER + block("a.jpg", (1, 2, 3))}, ["cameras.no_offset"]),
        ({"external": external(("a.jpg", 1, 2, 3, 0, 0, 0))}, []),
    ],
)
def test_what_is_missing(tmp_path, files, codes):
    folder = params(tmp_path, **files)
    cameras = read(folder)
    assert cameras.centres.tolist() == [[1, 2, 3]]
    assert cameras.rotations[0] == pytest.approx(DOWN)
    assert notes(cameras) == codes
    assert (cameras.lenses is None) == ("external" in files)
    (folder / "sensor.csv").write_text("focal,sensor_x,sensor_y\n8.8,13.2,8.8\n")
    assert read(folder).lenses[0].unit == ("mm" if "external" in files else "px")


BINGO = """a H_12.0_8.0
7 -6.0 4.0
GCP_G1 1.0 -1.0
-99
lost H_12.0_8.0
7 0 0
-99
b H_12.0_8.0
7 0.002 0.0
-99
"""
GCPS = "GCP label, mx, my, mz, ex, ey, ez, weight, n\nG1, 1, 2, 3, 4, 5, 6, 0.9, 1\n"


def test_tie_points(tmp_path):
    parameters = HEADER + block("b.jpg", (1, 2, 3)) + block("a.jpg", (1, 2, 3))
    path = params(tmp_path, parameters=parameters, offset="0 0 0", gcps=GCPS, bingo=BINGO)
    ties = read_ties(path)
    assert ties.views.start.tolist() == [0, 2, 3]
    assert ties.views.camera.tolist() == [1, 0, 1]
    assert ties.image_xy == pytest.approx(np.array([[0, 0], [3001, 2000], [3500, 2500]]))
    assert np.isnan(ties.xyz[0]).all()
    assert ties.xyz[1].tolist() == [4, 5, 6]


GOOD = {"parameters": HEADER + block("a.jpg", (1, 2, 3)), "offset": "0 0 0"}


@pytest.mark.parametrize(
    ("files", "code"),
    [
        ({"parameters": GOOD["parameters"][:-30]}, "cameras.damaged"),
        ({"parameters": HEADER}, "cameras.no_pose"),
        ({"external": external()}, "cameras.no_pose"),
        ({**GOOD, "offset": "1 2"}, "cameras.damaged"),
        ({**GOOD, "wkt": "PROJCS[nothing"}, "cameras.crs"),
        (GOOD, "cameras.no_tie_points"),
        ({**GOOD, "bingo": "z H_12.0_8.0\n7 1 2\n-99\n"}, "cameras.no_tie_points"),
    ],
)
def test_refused(tmp_path, files, code):
    with refused(code):
        read_ties(params(tmp_path, **files))

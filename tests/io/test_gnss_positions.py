"""Positions of the GNSS from a file, and in the frame of the cameras."""

from dataclasses import replace

import numpy as np
import pytest
from pyproj import CRS, Transformer

from pcfix.io.cameras import read_cameras
from pcfix.io.ground_control import gnss_in_frame_of, read_gnss
from pcfix.model import Cameras, GnssPositions
from tests.utils.codes import refused, warned
from tests.utils.shared import needs

pytestmark = pytest.mark.quick_but("test_camera_files")

SAMPLES, samples = needs("cameras")

XYZ = np.array([[500010.0, 4000010.0, 82.5], [500030.5, 4000020.25, 81.75]])


def block(crs="EPSG:32636", labels=("a.jpg", "b.jpg"), **more):
    adjusted = XYZ[: len(labels)] + np.array([0.1, -0.2, 0.3])
    return Cameras(labels, adjusted, crs=crs, **more)


def write(tmp_path, text, name="gnss.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("head", "rows"),
    [
        ("image,x,y,z,sx,sy,sz", "{i},{x},{y},{z},0.01,0.02,0.03"),
        ("Label;Easting;Northing;Height;Sigma_X;Sigma_Y;Sigma_Z", "{i};{x};{y};{z};.01;.02;.03"),
        (
            "#Label,X/Easting,Y/Northing,Z/Altitude,Accuracy_X (m),Accuracy_Y (m),Accuracy_Z (m)",
            "{i},{x},{y},{z},0.01,0.02,0.03",
        ),
    ],
)
def test_tables(tmp_path, head, rows):
    named = zip(("B", "x/a.jpg"), XYZ[::-1].tolist(), strict=True)
    lines = [rows.format(i=name, x=x, y=y, z=z) for name, (x, y, z) in named]
    cameras = read_gnss(write(tmp_path, "\n".join([head, *lines])), block())
    assert cameras.gnss.xyz.tolist() == XYZ.tolist()
    assert cameras.gnss.sigma_m.tolist() == [[0.01, 0.02, 0.03]] * 2
    assert cameras.gnss.crs is None
    found, _ = gnss_in_frame_of(cameras)
    assert found.xyz == pytest.approx(XYZ, abs=1e-9)


def degrees(crs="EPSG:4979"):
    to = Transformer.from_crs(CRS("EPSG:32636").to_3d(), crs, always_xy=True)
    return np.column_stack(to.transform(*XYZ.T))


def test_degrees(tmp_path):
    rows = [f"{n},{y!r},{x!r},{z!r}" for n, (x, y, z) in zip("ab", degrees().tolist(), strict=True)]
    cameras = read_gnss(write(tmp_path, "\n".join(["image,lat,lon,height", *rows])), block())
    assert cameras.gnss.crs == "EPSG:4326"
    assert np.isnan(cameras.gnss.sigma_m).all()
    found, reason = gnss_in_frame_of(cameras)
    assert found.xyz == pytest.approx(XYZ, abs=1e-6)
    assert np.isnan(found.sigma_m).all()
    assert reason == ""


def test_given_crs(tmp_path):
    to_35 = Transformer.from_crs("EPSG:32636", "EPSG:32635", always_xy=True)
    x, y = (each.tolist() for each in to_35.transform(XYZ[:, 0], XYZ[:, 1]))
    rows = [f"{n}.jpg,{x[i]!r},{y[i]!r},{XYZ[i, 2]}" for i, n in enumerate("ab")]
    path = write(tmp_path, "\n".join(["image,x,y,z", *rows]))
    found, _ = gnss_in_frame_of(read_gnss(path, block(), crs="EPSG:32635"))
    assert found.xyz == pytest.approx(XYZ, abs=1e-6)
    with refused("crs.unknown"):
        read_gnss(path, block(), crs="EPSG:1")


def test_images_without_position(tmp_path):
    path = write(
        tmp_path, "image,x,y,z\nb.jpg,500001,4000002,3\na.jpg,,,\nq.jpg,4,5,6\nu.jpg,7,8,9\n"
    )
    with warned("gnss.images_without", images=1):
        cameras = read_gnss(path, block(unposed=("u",)))
    assert np.isnan(cameras.gnss.xyz[0]).all()
    assert cameras.gnss.xyz[1].tolist() == [500001.0, 4000002.0, 3.0]
    assert np.isnan(gnss_in_frame_of(cameras)[0].xyz).tolist() == [[True] * 3, [False] * 3]


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("image,x,y,z\nq.jpg,1,2,3\n", "gnss.no_image"),
        ("image,x,y,z\na.jpg,,,\n", "gnss.no_image"),
        ("image,x,y,z\na.jpg,1,2,3\na.jpg,1,2,4\n", "gnss.two_positions"),
        ("image,x,y,z\na.jpg,4000010,500010,80\n", "gnss.far"),
        ("image,x,y,z,sx,sy,sz\na.jpg,1,2,3,0,1,1\n", "gnss.sigma"),
        ("image,x_est,y_est,z_est\na.jpg,1,2,3\n", "gnss.none"),
    ],
)
def test_bad_files(tmp_path, text, code):
    path = write(tmp_path, text)
    with refused(code, path=path):
        read_gnss(path, block())


def test_cameras_that_do_not_fit():
    assert gnss_in_frame_of(block(), "a.xml")[1] == "a.xml: has no GNSS positions."
    gnss = GnssPositions(degrees(), np.full((2, 3), np.nan), "EPSG:4979")
    for crs in ("EPSG:4978", "EPSG:4979", "ENU:1,2,3"):
        found, reason = gnss_in_frame_of(block(crs, gnss=gnss), "a.xml")
        assert np.isnan(found.xyz).all()
        assert reason.startswith(f"a.xml: {crs} is no map")
    enu = replace(gnss, xyz=XYZ, crs="ENU:1,2,3")
    assert gnss_in_frame_of(block("ENU:1,2,3", gnss=enu))[0].xyz == pytest.approx(XYZ, abs=1e-9)
    assert gnss_in_frame_of(block("local", gnss=gnss), "a.xml")[1]


@samples
@pytest.mark.filterwarnings("ignore::pcfix.errors.PcfixWarning")
@pytest.mark.parametrize("name", ["odm/hectorsosa", "metashape/uclm_sorolla/markers.xml"])
def test_camera_files(name):
    stored = read_cameras(SAMPLES / name)
    found = read_gnss(SAMPLES / name, replace(stored, gnss=None)).gnss
    assert found.xyz.tolist() == stored.gnss.xyz.tolist()
    assert found.sigma_m == pytest.approx(stored.gnss.sigma_m, nan_ok=True)
    assert found.crs == stored.gnss.crs

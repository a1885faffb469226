"""OpenSfM's reconstruction.json."""

import json
import math

import numpy as np
import pytest

from pcfix.lens.imaging import project
from tests.utils.camera_files import brown, read_ties
from tests.utils.camera_files import read as read_file
from tests.utils.codes import refused

pytestmark = pytest.mark.quick_but("test_every_camera_model")

CAMERA = {"projection_type": "perspective", "width": 4000, "height": 3000, "focal": 0.8}
SHOT = {"camera": "c", "rotation": [0.1, 2.9, 0.3], "translation": [1.0, 2.0, 30.0]}
LLA = {"latitude": 47.0, "longitude": 8.0, "altitude": 400.0}


def scene(**changes):
    return {"cameras": {"c": CAMERA}, "shots": {"a.jpg": SHOT}, "reference_lla": LLA, **changes}


def write(tmp_path, *reconstructions):
    path = tmp_path / "reconstruction.json"
    path.write_text(json.dumps(list(reconstructions)))
    return path


def read(tmp_path, *reconstructions):
    return read_file(write(tmp_path, *reconstructions))


def seen_by(model, camera, direction):
    """The place in the image as OpenSfM's formulas give it, one direction at a time."""
    x, y, z = direction
    r = math.hypot(x, y)
    theta = math.atan2(r, z)
    scale = {
        "perspective": 1.0 / z,
        "fisheye": theta / r,
        "dual": camera.get("transition", 0.5) / z
        + (1.0 - camera.get("transition", 0.5)) * theta / r,
    }[model]
    x, y = x * scale, y * scale
    r2 = x * x + y * y
    k = [camera.get(f"k{i}", 0.0) for i in range(1, 7)]
    p1, p2 = camera.get("p1", 0.0), camera.get("p2", 0.0)
    s = [camera.get(f"s{i}", 0.0) for i in range(4)]
    xd, yd = brown(x, y, k, (p2, p1))
    xd, yd = xd + s[0] * r2 + s[1] * r2 * r2, yd + s[2] * r2 + s[3] * r2 * r2
    fx = camera.get("focal_x", camera.get("focal"))
    fy = camera.get("focal_y", camera.get("focal"))
    u = fx * xd + camera.get("c_x", 0.0)
    v = fy * yd + camera.get("c_y", 0.0)
    return u * 4000 + 2000, v * 4000 + 1500


AFFINE = {"focal_x": 0.8, "focal_y": 0.79, "c_x": 0.01, "c_y": -0.02}
FOUR = {"k1": -0.02, "k2": 0.01, "k3": -0.003, "k4": 0.001}


@pytest.mark.parametrize(
    ("kind", "model", "parameters"),
    [
        ("perspective", "perspective", {"focal": 0.8, "k1": -0.1, "k2": 0.02}),
        ("simple_radial", "perspective", {**AFFINE, "k1": -0.1}),
        ("radial", "perspective", {**AFFINE, "k1": -0.1, "k2": 0.02}),
        (
            "brown",
            "perspective",
            {**AFFINE, "k1": -0.1, "k2": 0.02, "k3": -0.001, "p1": 0.002, "p2": -0.003},
        ),
        ("fisheye", "fisheye", {"focal": 0.5, "k1": -0.02, "k2": 0.01}),
        ("fisheye_opencv", "fisheye", {**AFFINE, **FOUR}),
        (
            "fisheye62",
            "fisheye",
            {**AFFINE, **FOUR, "k5": 1e-4, "k6": -1e-5, "p1": 0.002, "p2": -0.003},
        ),
        (
            "fisheye624",
            "fisheye",
            {**AFFINE, **FOUR, "p1": 0.002, "p2": -0.003}
            | {"s0": 0.001, "s1": -0.002, "s2": 0.003, "s3": 0.0005},
        ),
        ("dual", "dual", {"focal": 0.8, "k1": -0.02, "k2": 0.01, "transition": 0.3}),
    ],
)
def test_every_camera_model(tmp_path, kind, model, parameters):
    camera = {"projection_type": kind, "width": 4000, "height": 3000, **parameters}
    lens = read(tmp_path, scene(cameras={"c": camera})).lenses[0]
    for direction in [(0.3, 0.2, 1.0), (-0.4, 0.1, 1.0), (0.05, -0.45, 1.0)]:
        expected = seen_by(model, camera, direction)
        assert project(lens, np.array([direction]))[0] == pytest.approx(expected, abs=1e-6)


def test_gnss_positions(tmp_path):
    shots = {
        "a.jpg": {**SHOT, "gps_position": [1.0, 2.0, 3.0], "gps_dop": 0.05},
        "b.jpg": {**SHOT, "gps_position": [0.0, 0.0, 0.0], "gps_dop": 999999.0},
        "c.jpg": {**SHOT, "gps_position": [4.0, 5.0, 6.0]},
        "d.jpg": SHOT,
    }
    gnss = read(tmp_path, scene(shots=shots)).gnss
    assert gnss.xyz[0] == pytest.approx([1, 2, 3])
    assert gnss.sigma_m[0] == pytest.approx([0.05] * 3)
    assert np.isnan(gnss.xyz[[1, 3]]).all()
    assert gnss.xyz[2] == pytest.approx([4, 5, 6])
    assert np.isnan(gnss.sigma_m[2]).all()
    assert gnss.crs == "ENU:47.0,8.0,400.0"


@pytest.mark.parametrize("beside", [None, "../elsewhere/reference_lla.json"])
def test_without_reference_the_frame_is_local(tmp_path, beside):
    if beside:
        (tmp_path / "reference_lla.json").write_text(beside)
    without = scene(shots={"a.jpg": {**SHOT, "gps_position": [1.0, 2.0, 3.0]}})
    del without["reference_lla"]
    cameras = read(tmp_path, without)
    assert (cameras.crs, cameras.gnss) == ("local", None)


@pytest.mark.parametrize(
    ("header", "tail"),
    [
        ("", "\t200\t10\t20"),
        ("OPENSFM_TRACKS_VERSION_v1\n", "\t0.01\t200\t10\t20"),
        ("OPENSFM_TRACKS_VERSION_v2\n", "\t0.01\t200\t10\t20\t-1\t-1"),
    ],
)
def test_tracks_of_every_version(tmp_path, header, tail):
    lines = [
        "b.jpg\t12\t5\t0.25\t-0.125" + tail,
        "a.jpg\t11\t6\t0\t1e-3" + tail,
        "a.jpg\t99\t6\t0\t0" + tail,  # a track that was not triangulated
        "c.jpg\t11\t6\t0\t0" + tail,  # an image that was not
        "a.jpg\t12\t7\t-0.5\t0.375" + tail,
    ]
    (tmp_path / "tracks.csv").write_text(header + "\n".join(lines) + "\n")
    points = {"12": {"coordinates": [1, 2, 3]}, "11": {"coordinates": [4, 5, 6]}}
    path = write(tmp_path, scene(shots={"a.jpg": SHOT, "b.jpg": SHOT}, points=points))
    found = read_ties(path)
    assert found.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert found.views.start.tolist() == [0, 2, 3]
    assert found.views.camera.tolist() == [0, 1, 0]
    assert found.image_xy == pytest.approx(np.array([[0, 3000], [3000, 1000], [2000, 1504]]))


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"shots": {}}, "cameras.no_pose"),
        ({"cameras": {"c": {**CAMERA, "projection_type": "pinhole9"}}}, "cameras.unsupported"),
        ({"cameras": {"c": {"width": 4000, "height": 3000}}}, "cameras.damaged"),
        ({"cameras": {"c": {"projection_type": "equirectangular"}}}, "cameras.unsupported"),
        ({"reference_lla": {**LLA, "latitude": 4700.0}}, "cameras.damaged"),
        ({"points": {"1": {"coordinates": [1, 2, 3]}}}, "cameras.no_tie_points"),  # no tracks
    ],
)
def test_refused(tmp_path, change, code):
    path = write(tmp_path, scene(**change))
    with refused(code, path=path):
        read_ties(path)

"""Poses from CSV tables."""

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pcfix
from tests.utils.shared import needs

RENDERED, rendered = needs("rendered_a")
RIVER, river = needs("river")


def write(tmp_path, text, sensor="focal,sensor_x,sensor_y\n8.8,13.2,8.8\n"):
    if sensor:
        (tmp_path / "sensor.csv").write_text(sensor)
    path = tmp_path / "cameras.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def looks(cameras, i=0):
    """Return where the camera looks, and where the top and right of its image point."""
    forward, down, right = cameras.rotations[i][2], cameras.rotations[i][1], cameras.rotations[i][0]
    return forward, -down, right


@pytest.mark.parametrize(
    ("angles", "forward", "top", "right"),
    [
        ((0, 0, 0), (0, 0, -1), (0, 1, 0), (1, 0, 0)),
        ((90, 0, 0), (0, 0, -1), (1, 0, 0), (0, -1, 0)),
        ((0, 90, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0)),
        ((90, 90, 0), (1, 0, 0), (0, 0, 1), (0, -1, 0)),
        ((0, 0, 90), (-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ],
)
def test_yaw_pitch_roll(tmp_path, angles, forward, top, right):
    path = write(tmp_path, "label,x,y,z,yaw,pitch,roll\na,1,2,3," + ",".join(map(str, angles)))
    found = looks(pcfix.read_cameras(path))
    for vector, expected in zip(found, (forward, top, right), strict=True):
        assert vector == pytest.approx(expected, abs=1e-12)


@rendered
def test_yaw_pitch_roll_agree_with_quaternions_of_the_same_block():
    cameras = pcfix.read_cameras(RENDERED / "cameras.csv")
    lines = [
        line.split()
        for line in (RENDERED / "colmap/images.txt").read_text().splitlines()
        if not line.startswith("#")
    ][::2]
    offset = np.loadtxt(RENDERED / "offset.txt", comments="#")
    for fields in lines:
        i = cameras.labels.index(fields[9])
        w, *xyz = (float(f) for f in fields[1:5])
        rotation = Rotation.from_quat([*xyz, w]).as_matrix()
        centre = -rotation.T @ np.array(fields[5:8], float) + offset
        assert cameras.centres[i] == pytest.approx(centre, abs=1e-4)  # the CSV has 0.1 mm
        turn = Rotation.from_matrix(cameras.rotations[i] @ rotation.T).magnitude()
        assert np.degrees(turn) < 1e-5  # the CSV has 1e-6 degrees


@rendered
def test_tie_points_project_where_they_were_measured():
    # f and the sensor come from millimetres, the principal point as the centre (it is 6 and 5
    # px off): 10 px tell a right reading of the angles from a wrong one, which is hundreds off
    cameras = pcfix.read_cameras(RENDERED / "cameras.csv")
    text = (RENDERED / "colmap/images.txt").read_text().splitlines()
    rows = [line for line in text if not line.startswith("#")]
    offset = np.loadtxt(RENDERED / "offset.txt", comments="#")
    points = {}
    for line in (RENDERED / "colmap/points3D.txt").read_text().splitlines():
        if not line.startswith("#"):
            fields = line.split()
            points[int(fields[0])] = np.array(fields[1:4], float) + offset
    lens = cameras.lenses[0]
    misses = []
    for head, tail in zip(rows[::2], rows[1::2], strict=True):
        i = cameras.labels.index(head.split()[9])
        seen = np.array(tail.split(), float).reshape(-1, 3)
        seen = seen[np.isin(seen[:, 2], list(points))]
        world = np.array([points[int(p)] for p in seen[:, 2]])
        x, y, z = cameras.rotations[i] @ (world - cameras.centres[i]).T
        uv = np.column_stack(
            [lens.focal * x / z + lens.principal_x, lens.focal * y / z + lens.principal_y]
        )
        misses.append(np.hypot(*(uv * 1600 / lens.width - seen[:, :2]).T))
    assert len(np.concatenate(misses)) > 10_000
    assert np.median(np.concatenate(misses)) < 10.0


def test_plain_table_has_no_frames(tmp_path):
    cameras = pcfix.read_cameras(write(tmp_path, "Label,X,Y,Z\na,1,2,3\nb,4,5,6\n", sensor=None))
    assert cameras.labels == ("a", "b")
    assert cameras.centres.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cameras.rotations is None
    assert cameras.lenses is None


@pytest.mark.parametrize(
    "text",
    [
        "z;label;x;y\n3;a;1;2\n",
        "label\tx\ty\tz\textra\na\t1\t2\t3\tword\n",
        b"\xef\xbb\xbflabel,x,y,z\r\n\r\na,1,2,3\r\n\r\n",
        '"label","x","y","z"\n"a, b",1,2,3\n',
        b"label,x,y,z\nStra\xdfe.jpg,1,2,3\n",
    ],
)
def test_dialects(tmp_path, text):
    cameras = pcfix.read_cameras(write(tmp_path, text, sensor=None))
    assert cameras.centres.tolist() == [[1, 2, 3]]


@river
def test_river_keeps_cameras_that_share_a_label():
    with pytest.warns(pcfix.PcfixWarning, match="7 labels occur more than once") as caught:
        cameras = pcfix.read_cameras(RIVER / "cameras.csv")
    assert len(caught) == 1
    assert len(cameras) == 31
    with (RIVER / "cameras.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["Label"] for row in rows] == list(cameras.labels)


def test_exact_copies_count_once(tmp_path):
    text = "label,x,y,z\na,1,2,3\na,1,2,3\na,1,2,4\nb,1,2,3\n"
    with pytest.warns(pcfix.PcfixWarning, match="1 exact copies dropped"):
        cameras = pcfix.read_cameras(write(tmp_path, text, sensor=None))
    assert cameras.labels == ("a", "a", "b")
    assert cameras.centres[:, 2].tolist() == [3, 4, 3]


def test_sensor_elsewhere(tmp_path):
    path = write(tmp_path, "label,x,y,z,yaw,pitch,roll\na,1,2,3,0,0,0\n", sensor=None)
    sensor = tmp_path / "p4p.csv"
    sensor.write_text("focal,sensor_x,sensor_y\n8.8,13.2,8.8\n")
    lens = pcfix.read_cameras(path, sensor).lenses[0]
    assert lens == pcfix.Lens(8.8, 13.2, 8.8, 6.6, 4.4)

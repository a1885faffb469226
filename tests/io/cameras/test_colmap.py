"""COLMAP models, text and binary."""

import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.io.cameras.colmap import BY_NAME, MODELS, make_lens
from pcfix.lens.imaging import project
from tests.utils.camera_files import read, read_ties
from tests.utils.codes import refused

pytestmark = pytest.mark.quick_but("test_binary_knows_the_models_by_their_numbers")

CAMERAS = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
3 PINHOLE 800 600 500 510 410 290

7 SIMPLE_RADIAL 640 480 400 320 240 0.1
"""
IMAGES = """# Image list with two lines of data per image:
12 0.5 -0.5 0.5 0.5 1 2 3 7 south wing/b 2.jpg
10 20 5 30 40 -1 50 60 6
4 1 0 0 0 -1 -2 -3 3 a.jpg

9 1 0 0 0 0 0 0 3 c.jpg
7 8 6
"""
POINTS = """# 3D point list
6 1.5 2.5 3.5 1 2 3 0.5 12 2 9 0
5 -1 -2 10 255 255 255 0.25 12 0
8 0 0 1 0 0 0 -1
"""


def folder(path, cameras=CAMERAS, images=IMAGES, points=POINTS):
    path.mkdir(parents=True, exist_ok=True)
    (path / "cameras.txt").write_text(cameras)
    (path / "images.txt").write_text(images)
    (path / "points3D.txt").write_text(points)
    return path


def binary_folder(path):
    """Write the same model as `folder`, byte by byte."""
    path.mkdir(parents=True, exist_ok=True)
    (path / "cameras.bin").write_bytes(
        struct.pack("<Q", 2)
        + struct.pack("<IiQQ4d", 3, 1, 800, 600, 500, 510, 410, 290)
        + struct.pack("<IiQQ4d", 7, 2, 640, 480, 400, 320, 240, 0.1)
    )
    (path / "images.bin").write_bytes(
        struct.pack("<Q", 3)
        + struct.pack("<I7dI", 12, 0.5, -0.5, 0.5, 0.5, 1, 2, 3, 7)
        + b"south wing/b 2.jpg\0"
        + struct.pack("<Q2dq2dq2dq", 3, 10, 20, 5, 30, 40, -1, 50, 60, 6)
        + struct.pack("<I7dI", 4, 1, 0, 0, 0, -1, -2, -3, 3)
        + b"a.jpg\0"
        + struct.pack("<Q", 0)
        + struct.pack("<I7dI", 9, 1, 0, 0, 0, 0, 0, 0, 3)
        + b"c.jpg\0"
        + struct.pack("<Q2dq", 1, 7, 8, 6)
    )
    (path / "points3D.bin").write_bytes(
        struct.pack("<Q", 3)
        + struct.pack("<Q3d3BdQ4I", 6, 1.5, 2.5, 3.5, 1, 2, 3, 0.5, 2, 12, 2, 9, 0)
        + struct.pack("<Q3d3BdQ2I", 5, -1, -2, 10, 255, 255, 255, 0.25, 1, 12, 0)
        + struct.pack("<Q3d3BdQ", 8, 0, 0, 1, 0, 0, 0, -1, 0)
    )
    return path


@pytest.mark.parametrize("make", [folder, binary_folder])
def test_a_small_model(tmp_path, make):
    path = make(tmp_path)
    cameras = read(path)
    assert cameras.labels == ("south wing/b 2.jpg", "a.jpg", "c.jpg")
    turn = Rotation.from_quat([-0.5, 0.5, 0.5, 0.5])
    assert cameras.rotations[0] == pytest.approx(turn.as_matrix())
    assert cameras.centres[0] == pytest.approx(-turn.inv().apply([1, 2, 3]))
    assert cameras.centres[1] == pytest.approx([1, 2, 3])
    lenses = [(x.focal, x.b1, x.width) for x in cameras.lenses]
    assert lenses == [(400, 0, 640), (510, -10, 800), (510, -10, 800)]
    assert cameras.lenses[0].radial == (0.1,)
    assert cameras.crs is None
    assert cameras.notes == ()
    assert cameras.gnss is None
    points = read_ties(path)
    assert points.xyz.tolist() == [[1.5, 2.5, 3.5], [-1, -2, 10], [0, 0, 1]]
    assert points.views.start.tolist() == [0, 2, 3, 3]
    assert points.views.camera.tolist() == [0, 2, 0]
    assert points.image_xy.tolist() == [[50, 60], [7, 8], [10, 20]]


def test_largest_of_several_models(tmp_path):
    folder(tmp_path / "sparse/0", images="1 1 0 0 0 0 0 0 3 x.jpg\n\n")
    folder(tmp_path / "sparse/1")
    cameras = read(tmp_path)
    assert len(cameras) == 3
    assert cameras.notes[0].values.items() >= {"models": 2, "images": 3}.items()


@pytest.mark.parametrize("number", range(len(MODELS)))
def test_binary_knows_the_models_by_their_numbers(tmp_path, number):
    pycolmap = pytest.importorskip("pycolmap")
    twin = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(number), 500.0, 800, 600)
    model = MODELS[number]
    names = BY_NAME[model].names.split()
    assert (twin.model_name, len(twin.params)) == (model, len(names))
    extra = np.linspace(0.01, 0.03, len(names) - len(names[:4]))
    values = [*twin.params[: len(twin.params) - len(extra)], *extra] if len(extra) else twin.params
    twin.params = values
    rays = np.random.default_rng(1).uniform((-0.4, -0.4, 1), (0.4, 0.4, 1), (100, 3))
    made = make_lens(tmp_path, 1, model, (800, 600, *values))
    assert project(made, rays) == pytest.approx(np.array(twin.img_from_cam(rays)), abs=1e-8)


@pytest.mark.parametrize(
    ("part", "old", "new", "code"),
    [
        ("cameras", "3 PINHOLE", "3 KANNALA", "cameras.unsupported"),
        ("cameras", "800 600 500 510 410 290", "", "cameras.damaged"),
        ("cameras", "500 510", "0 510", "cameras.lens"),
        ("images", "4 1 0 0 0", "4 2 0 0 0", "cameras.rotation"),
        ("images", IMAGES, "# none\n", "cameras.no_pose"),
        ("images", "a.jpg\n\n", "a.jpg\n", "cameras.damaged"),
        ("points", POINTS, "# none\n", "cameras.no_tie_points"),
    ],
)  # fmt: skip
def test_text_refused(tmp_path, part, old, new, code):
    text = {"cameras": CAMERAS, "images": IMAGES, "points": POINTS}
    assert old in text[part]
    text[part] = text[part].replace(old, new)
    with refused(code):
        read_ties(folder(tmp_path, **text))


@pytest.mark.parametrize(
    ("name", "at", "layout", "value"),
    [
        *((name, 0, "<Q", 2**40) for name in ("cameras", "images", "points3D")),
        ("images", 8 + 64 + len(b"south wing/b 2.jpg\0"), "<Q", 2**40),
        ("points3D", 8 + 43, "<Q", 2**40),
        ("cameras", 12, "<i", 99),
    ],
)
def test_binary_refused(tmp_path, name, at, layout, value):
    path = binary_folder(tmp_path)
    data = bytearray((path / f"{name}.bin").read_bytes())
    struct.pack_into(layout, data, at, value)
    (path / f"{name}.bin").write_bytes(data)
    with refused("cameras.unsupported" if value == 99 else "cameras.damaged"):
        read_ties(path)

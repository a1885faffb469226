"""Bundler's bundle.out and MVE's synth_0.out."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix.lens.imaging import project
from tests.utils.camera_files import notes, read, read_ties
from tests.utils.codes import refused

pytestmark = pytest.mark.quick_but("test_pose_lens_and_tie_points")

TURN = Rotation.from_euler("xyz", [170, 12, 34], degrees=True).as_matrix()
CENTRE = np.array([3.0, -2.0, 50.0])
POINTS = np.array([[0.0, 1.0, 2.0], [8.0, -6.0, 1.0], [4.0, -3.0, -1.0]])


def seen_by_bundler(points, matrix, shift, f, k1, k2):
    """Return the image of points by the formulas of Bundler's manual."""
    camera = points @ matrix.T + shift
    p = -camera[:, :2] / camera[:, 2:]
    r2 = (p**2).sum(axis=1, keepdims=True)
    return f * (1 + k1 * r2 + k2 * r2**2) * p


def bundle(views=4, head="# Bundle file v0.3", second_f=0.0):
    """Return a file of two cameras, of which the second has no pose, and the true places."""
    matrix = np.diag([1, -1, -1]) @ TURN
    shift = -matrix @ CENTRE
    places = seen_by_bundler(POINTS, matrix, shift, 700.0, -0.1, 0.02)
    lines = [head, "2 3", "700 -0.1 0.02", *rows(matrix), words(shift)]
    lines += [f"{second_f} 0 0", *rows(np.eye(3) if second_f else np.zeros((3, 3))), "0 0 0"]
    for i, (point, place) in enumerate(zip(POINTS, places, strict=True)):
        other = f" 1 5 {1} {2}" if i == 1 else ""
        lines += [words(point), "1 2 3", f"{2 if other else 1} 0 {i} {words(place)}{other}"]
    return "\n".join(lines) + "\n", places


def words(numbers):
    return " ".join(f"{number:.12g}" for number in numbers)


def rows(matrix):
    return [words(row) for row in matrix]


def write(tmp_path, text, name="bundle.out"):
    path = tmp_path / name
    path.write_text(text)
    return path


def picture(path, width, height):
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", (width, height)).save(path)


def test_pose_lens_and_tie_points(tmp_path):
    text, places = bundle()
    path = write(tmp_path, text)
    (tmp_path / "list.txt").write_text("img/north 1.jpg 0 690.5\nimg/b.jpg\n")
    picture(tmp_path / "img" / "north 1.jpg", 400, 300)
    cameras = read(path)
    assert cameras.labels == ("img/north 1.jpg",)
    assert cameras.unposed == ("img/b.jpg",)
    assert cameras.notes == ()
    assert cameras.centres[0] == pytest.approx(CENTRE)
    assert cameras.rotations[0] == pytest.approx(TURN, abs=1e-9)
    points = read_ties(path)
    assert points.views.start.tolist() == [0, 1, 2, 3]
    assert points.views.camera.tolist() == [0, 0, 0]
    assert points.image_xy == pytest.approx(np.array([200, 150]) + places * [1, -1])
    rays = (points.xyz - cameras.centres[0]) @ cameras.rotations[0].T
    assert project(cameras.lenses[0], rays) == pytest.approx(points.image_xy, abs=1e-6)


def test_frame_from_tie_points(tmp_path):
    text, places = bundle()
    cameras = read(write(tmp_path, text))
    assert cameras.labels == ("camera 0",)
    lens = cameras.lenses[0]
    assert [lens.width, lens.height] == pytest.approx(2 * np.abs(places).max(axis=0))
    assert (lens.principal_x, lens.principal_y) == (lens.width / 2, lens.height / 2)
    assert notes(cameras) == ["cameras.frames_estimated"]


@pytest.mark.parametrize("name", ["list.txt", "x.list.txt", "x.bundle.out.list.txt", "../list.txt"])
def test_places_of_the_list(tmp_path, name):
    path = tmp_path / "bundle" / "x.bundle.out"
    path.parent.mkdir()
    write(path.parent, bundle()[0], path.name)
    (path.parent / name).write_text("one.jpg\ntwo.jpg\n")
    assert read(path).labels == ("one.jpg",)


def test_mve_with_its_images(tmp_path):
    lines = ["drews 1.0", "1 1", "0.8 0 0", *rows(TURN), words(-TURN @ CENTRE)]
    path = write(tmp_path, "\n".join([*lines, "1 2 3", "4 5 6", "1 0 7 0"]), "synth_0.out")
    (tmp_path / "list.txt").write_text("a.png\n")
    picture(tmp_path / "images" / "a.png", 400, 300)
    cameras = read(path)
    assert cameras.rotations[0] == pytest.approx(TURN, abs=1e-9)
    assert cameras.centres[0] == pytest.approx(CENTRE)
    assert cameras.lenses[0].focal == pytest.approx(320)


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("v0.3", "v0.4", "cameras.unsupported"),
        ("2 3\n", "2 x\n", "cameras.damaged"),
        ("1 0 0 ", "1 7 0 ", "cameras.damaged"),
        ("700 -0.1", "0 -0.1", "cameras.no_pose"),
        (words(TURN[0]), words(-TURN[0]), "cameras.rotation"),
    ],
)
def test_refused(tmp_path, old, new, code):
    text, _ = bundle()
    assert old in text
    path = write(tmp_path, text.replace(old, new, 1))
    with refused(code, path=path):
        read(path)

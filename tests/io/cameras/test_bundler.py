"""Bundler's bundle.out and MVE's synth_0.out."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix import InputError
from pcfix.io.cameras import bundler
from pcfix.io.cameras.formats import Source
from pcfix.lens.imaging import project
from tests.utils.reprojection import check_file
from tests.utils.shared import needs

KERMIT, kermit = needs("cameras", "bundler", "kermit")
TESTERARM, on_testerarm = needs("cameras", "bundler", "mve_testerarm")

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


def read(path):
    source = Source(path)
    assert bundler.recognises(source)
    return bundler.read(source)


def picture(path, width, height):
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", (width, height)).save(path)


def residuals(cameras, observations):
    """Return residuals of places that are from the middle of the frame, y up, px."""
    misses = []
    for seen in observations:
        i = cameras.labels.index(seen["image"])
        ray = cameras.rotations[i] @ ([seen[axis] for axis in "XYZ"] - cameras.centres[i])
        u, v = project(cameras.lenses[i], ray[None])[0]
        x, y = u - cameras.lenses[i].width / 2, cameras.lenses[i].height / 2 - v
        misses.append(np.hypot(x - seen["u"], y - seen["v"]))
    return np.array(misses)


def same_as_expected(cameras, check):
    for expected in check["projection_centres"]:
        i = cameras.labels.index(expected["image"].partition(" (")[0])
        xyz = [expected[axis] for axis in "XYZ"]
        assert cameras.centres[i] == pytest.approx(
            xyz, abs=2e-4 if check["n_images"] == 7 else 2e-6
        )
        assert cameras.rotations[i][2] == pytest.approx(expected["view_dir"], abs=2e-6)
        assert -cameras.rotations[i][1] == pytest.approx(expected["up_dir_minus_cam_y"], abs=2e-6)


@kermit
def test_kermit():
    check = check_file(KERMIT)
    source = Source(KERMIT / "bundle.out")
    cameras = read(source.path)
    assert (len(cameras), len(cameras.unposed)) == (check["n_registered"], 2)
    assert len(cameras.notes) == 1
    listed = residuals(cameras, check["observations"])
    assert listed == pytest.approx([o["res_px"] for o in check["observations"]], abs=2e-3)
    same_as_expected(cameras, check)
    assert {(lens.width, lens.height) for lens in cameras.lenses} == {(625.32, 468.98)}  # 640 x 480

    points = bundler.tie_points(source, cameras)
    of_point = np.repeat(np.arange(len(points.xyz)), np.diff(points.views.start))
    misses = []
    for camera, point, place in zip(points.views.camera, of_point, points.image_xy, strict=True):
        ray = cameras.rotations[camera] @ (points.xyz[point] - cameras.centres[camera])
        misses.append(np.hypot(*(project(cameras.lenses[camera], ray[None])[0] - place)))
    assert len(misses) == check["n_observations_used_for_rms"]
    assert np.median(misses) == pytest.approx(check["reprojection_median_px"], abs=1e-3)
    assert np.sqrt(np.mean(np.square(misses))) == pytest.approx(
        check["reprojection_rms_px"], abs=1e-3
    )


@on_testerarm
def test_mve():
    cameras = read(TESTERARM / "synth_0.out")
    assert cameras.source == "MVE"
    assert cameras.lenses is None
    assert "tells no size of 7 images" in cameras.notes[0]
    same_as_expected(cameras, check_file(TESTERARM))
    with pytest.raises(InputError, match="no image coordinates"):
        bundler.tie_points(Source(TESTERARM / "synth_0.out"), cameras)


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
    points = bundler.tie_points(Source(path), cameras)
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
    assert "tells no size of 1 images" in cameras.notes[0]
    assert str(tmp_path) in cameras.notes[0]


def test_frame_is_of_images_of_about_the_focal_length(tmp_path):
    near, far = (read(write(tmp_path, bundle(second_f=f)[0])).lenses for f in (720, 1500))
    assert near[0].width == near[1].width
    assert (far[1].width, far[1].height) == (2, 4)


@pytest.mark.parametrize("name", ["list.txt", "x.list.txt", "x.bundle.out.list.txt", "../list.txt"])
def test_places_of_the_list(tmp_path, name):
    path = tmp_path / "bundle" / "x.bundle.out"
    path.parent.mkdir()
    write(path.parent, bundle()[0], path.name)
    (path.parent / name).write_text("one.jpg\ntwo.jpg\n")
    assert read(path).labels == ("one.jpg",)


def test_list_of_other_images(tmp_path):
    path = write(tmp_path, bundle()[0])
    (tmp_path / "list.txt").write_text("one.jpg\n")
    cameras = read(path)
    assert cameras.labels == ("camera 0",)
    assert [n for n in cameras.notes if "lists 1 images, but bundle.out has 2 cameras" in n]


def test_mve_with_its_images(tmp_path):
    lines = ["drews 1.0", "1 1", "0.8 0 0", *rows(TURN), words(-TURN @ CENTRE)]
    path = write(tmp_path, "\n".join([*lines, "1 2 3", "4 5 6", "1 0 7 0"]), "synth_0.out")
    (tmp_path / "list.txt").write_text("a.png\n")
    picture(tmp_path / "images" / "a.png", 400, 300)
    cameras = read(path)
    assert cameras.rotations[0] == pytest.approx(TURN, abs=1e-9)
    assert cameras.centres[0] == pytest.approx(CENTRE)
    assert cameras.lenses[0].focal == pytest.approx(320)


def test_poses_without_points(tmp_path):
    text = bundle()[0].replace("2 3\n", "2 0\n", 1)
    path = write(tmp_path, "\n".join(text.splitlines()[:12]) + "\n")
    cameras = read(path)
    assert cameras.lenses is None
    with pytest.raises(InputError, match="no tie points"):
        bundler.tie_points(Source(path), cameras)


def test_images_that_are_none(tmp_path):
    path = write(tmp_path, bundle()[0])
    (tmp_path / "list.txt").write_text("a.jpg\nb.jpg\n")
    (tmp_path / "a.jpg").write_bytes(b"no image")
    assert "tells no size" in read(path).notes[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("v0.3", "v0.4", r"bundle\.out: is of Bundler's format v0\.4.* export v0\.3"),
        ("2 3\n", "2 x\n", "is a word that is none"),
        ("2 3\n", "2.5 3\n", "line 2 must give the numbers"),
        ("2 3\n", "2 -3\n", "line 2 must give the numbers"),
        ("2 3\n", "nan 3\n", "line 2 must give the numbers"),
        ("2 3\n", "9000000000 3\n", "announces 9000000000 cameras"),
        ("2 3\n", "2 9000000000\n", "cut off or damaged at point 3 of 9000000000"),
        ("2 3\n", "0 3\n", "announces 0 cameras"),
        ("1 0 0 ", "1 7 0 ", "point 0 was seen by image 7, but there are 2"),
        ("1 0 0 ", "1 0.5 0 ", "point 0 was seen by image 0.5"),
        ("1 0 0 ", "1e300 0 0 ", "damaged at point 0"),
        ("1 0 0 ", "-1 0 0 ", "damaged at point 0"),
        ("1 0 0 ", "nan 0 0 ", "damaged at point 0"),
        ("700 -0.1", "0 -0.1", "no image has a pose"),
        ("700 -0.1", "-700 -0.1", r"camera of image camera 0: focal length -700"),
        ("700 -0.1", "nan -0.1", r"camera of image camera 0: .* not finite"),
    ],
)
def test_damaged(tmp_path, old, new, message):
    text, _ = bundle()
    assert old in text
    with pytest.raises(InputError, match=message) as caught:
        read(write(tmp_path, text.replace(old, new, 1)))
    assert "bundle.out" in str(caught.value)


def test_damaged_poses(tmp_path):
    text, _ = bundle()
    lines = text.splitlines()
    mirrored = [*lines[:3], *rows(-np.diag([1, -1, -1]) @ TURN), *lines[6:]]
    with pytest.raises(InputError, match="image camera 0: the rotation matrix mirrors"):
        read(write(tmp_path, "\n".join(mirrored)))
    with pytest.raises(InputError, match="image camera 0: its position is not finite"):
        read(write(tmp_path, "\n".join([*lines[:6], "nan 0 0", *lines[7:]])))


def test_cut_anywhere(tmp_path):
    text, _ = bundle()
    for length in range(len("# Bundle file v0.3"), text.rindex(" ")):
        with pytest.raises(InputError):
            read(write(tmp_path, text[:length]))

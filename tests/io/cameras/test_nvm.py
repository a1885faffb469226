"""VisualSFM's NVM files, those of OpenSfM and ODM, and files of Bundler and MVE."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.utils.camera_files import notes, read, read_ties
from tests.utils.codes import refused
from tests.utils.reprojection import tie_point_residuals_px

pytestmark = pytest.mark.quick_but(
    "test_bundle",
    "test_matrix_and_translation",
    "test_places_from_the_corner",
    "test_pose_and_lens",
)

TURN = Rotation.from_euler("xyz", [170, 12, 34], degrees=True)
CENTRE = np.array([3.0, -2.0, 50.0])
POINTS = np.random.default_rng(8).uniform((-10, -12, -2), (16, 8, 4), (40, 3))
F, K = 700.0, 0.05


def measured(f=F, k=K):
    """Return where VisualSFM would have measured the points: the undistorted place is m(1+k r2)."""
    x, y, z = TURN.as_matrix() @ (POINTS - CENTRE).T
    ideal = np.column_stack([x / z, y / z])
    m = ideal.copy()
    for _ in range(100):
        m = ideal / (1 + k * (m**2).sum(axis=1, keepdims=True))
    return f * m


def words(numbers):
    return " ".join(f"{number:.12g}" for number in numbers)


def camera_line(name, f=F, k=K):
    return f"{name} {f:g} {words(np.roll(TURN.as_quat(), 1))} {words(CENTRE)} {k:g} 0"


def point_lines(places, image=0):
    pairs = zip(POINTS, places, strict=True)
    return [f"{words(p)} 1 2 3 1 {image} {i} {words(m)}" for i, (p, m) in enumerate(pairs)]


def model(*cameras, points=()):
    return "\n".join([str(len(cameras)), *cameras, "", str(len(points)), *points])


def write(tmp_path, *models, head="NVM_V3 "):
    path = tmp_path / "x.nvm"
    path.write_text("\n\n".join([head, *models, "0", "#the last part of NVM file points to PLY"]))
    return path


def residuals(path):
    return tie_point_residuals_px(read(path), read_ties(path))


def test_pose_and_lens(tmp_path):
    path = write(tmp_path, model(camera_line("a.jpg"), points=point_lines(measured())))
    cameras = read(path)
    assert cameras.centres[0] == pytest.approx(CENTRE)
    assert cameras.rotations[0] == pytest.approx(TURN.as_matrix())
    lens = cameras.lenses[0]
    assert [lens.width, lens.height] == pytest.approx(2 * np.abs(measured()).max(axis=0))
    assert notes(cameras) == ["cameras.frames_estimated"]
    assert residuals(path).max() < 1e-5


def test_frame_of_the_image(tmp_path):
    picture(tmp_path / "my a.png", 600, 400)
    path = write(tmp_path, model(camera_line('my"a.png'), points=point_lines(measured())))
    cameras = read(path)
    assert cameras.labels == ("my a.png",)
    assert cameras.notes == ()
    assert (cameras.lenses[0].width, cameras.lenses[0].height) == (600, 400)
    points = read_ties(path)
    assert points.image_xy == pytest.approx(measured() + np.array([300, 200]))


def test_matrix_and_translation(tmp_path):
    matrix = TURN.as_matrix()
    numbers = words([F, *matrix.ravel(), *(-matrix @ CENTRE), K, 0])
    text = model(f"a.jpg {numbers}", points=point_lines(measured()))
    cameras = read(write(tmp_path, text, head="NVM_V3_R9T"))
    assert cameras.centres[0] == pytest.approx(CENTRE)
    assert cameras.rotations[0] == pytest.approx(matrix)
    assert residuals(tmp_path / "x.nvm").max() < 1e-5


@pytest.mark.parametrize(("width", "height"), [(600, 380), (380, 600), (500, 500)])
def test_places_from_the_corner(tmp_path, width, height):
    """As OpenSfM writes them, which scales the shorter side by its own length."""
    frame = np.array([width, height])
    places = measured(f=250.0, k=0.0)
    outlier = np.zeros((len(places), 1))
    outlier[7] = 40.0
    seen = places * frame / frame.max() + frame / 2 + outlier
    path = write(tmp_path, model(camera_line("a.jpg", f=250, k=0.0), points=point_lines(seen)))
    lens = read(path).lenses[0]
    assert (lens.width, lens.height) == (width, height)
    every = residuals(path)
    assert np.delete(every, 7).max() < 1e-6
    assert every[7] > 30


def test_largest_of_several_models_and_the_rest(tmp_path):
    lost = model(camera_line("lost.jpg"), camera_line("x.jpg"), camera_line("y.jpg"))
    small = model(camera_line("small.jpg"), points=point_lines(measured()))
    large = model(
        camera_line("a.jpg"), camera_line("b.jpg"), points=point_lines(measured(), image=1)
    )
    path = write(tmp_path, small, large, lost)
    cameras = read(path)
    assert cameras.labels == ("a.jpg", "b.jpg")
    assert cameras.unposed == ("lost.jpg", "small.jpg", "x.jpg", "y.jpg")
    assert cameras.notes[0].values.items() >= {"models": 2, "images": 2}.items()
    points = read_ties(path)
    assert set(points.views.camera.tolist()) == {1}


# Bundler's bundle.out and MVE's synth_0.out

MATRIX = TURN.as_matrix()
THREE = np.array([[0.0, 1.0, 2.0], [8.0, -6.0, 1.0], [4.0, -3.0, -1.0]])


def bundle():
    """Return a file of two cameras, of which the second has no pose."""
    matrix = np.diag([1, -1, -1]) @ MATRIX
    lines = ["# Bundle file v0.3", "2 3", "700 -0.1 0.02", *rows(matrix), words(-matrix @ CENTRE)]
    lines += ["0 0 0", *rows(np.zeros((3, 3))), "0 0 0"]
    for i, point in enumerate(THREE):
        other = " 1 5 1 2" if i == 1 else ""
        lines += [words(point), "1 2 3", f"{2 if other else 1} 0 {i} {10 * i} 20{other}"]
    return "\n".join(lines) + "\n"


def rows(matrix):
    return [words(row) for row in matrix]


def write_bundle(tmp_path, text, name="bundle.out"):
    path = tmp_path / name
    path.write_text(text)
    return path


def picture(path, width, height):
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", (width, height)).save(path)


def test_bundle(tmp_path):
    path = write_bundle(tmp_path, bundle())
    (tmp_path / "list.txt").write_text("img/north 1.jpg 0 690.5\nimg/b.jpg\n")
    picture(tmp_path / "img" / "north 1.jpg", 400, 300)
    cameras = read(path)
    assert cameras.labels == ("img/north 1.jpg",)
    assert cameras.unposed == ("img/b.jpg",)
    assert cameras.notes == ()
    assert cameras.centres[0] == pytest.approx(CENTRE)
    assert cameras.rotations[0] == pytest.approx(MATRIX, abs=1e-9)
    points = read_ties(path)
    assert points.views.start.tolist() == [0, 1, 2, 3]
    assert points.views.camera.tolist() == [0, 0, 0]
    assert points.image_xy.tolist() == [[200, 130], [210, 130], [220, 130]]


@pytest.mark.parametrize("name", ["list.txt", "x.list.txt", "../list.txt"])
def test_places_of_the_list(tmp_path, name):
    path = tmp_path / "bundle" / "x.bundle.out"
    path.parent.mkdir()
    write_bundle(path.parent, bundle(), path.name)
    (path.parent / name).write_text("one.jpg\ntwo.jpg\n")
    assert read(path).labels == ("one.jpg",)


def test_mve_with_its_images(tmp_path):
    lines = ["drews 1.0", "1 1", "0.8 0 0", *rows(MATRIX), words(-MATRIX @ CENTRE)]
    path = write_bundle(tmp_path, "\n".join([*lines, "1 2 3", "4 5 6", "1 0 7 0"]), "synth_0.out")
    (tmp_path / "list.txt").write_text("a.png\n")
    picture(tmp_path / "images" / "a.png", 400, 300)
    cameras = read(path)
    assert cameras.rotations[0] == pytest.approx(MATRIX, abs=1e-9)
    assert cameras.centres[0] == pytest.approx(CENTRE)
    assert cameras.lenses[0].focal == pytest.approx(320)


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("v0.3", "v0.4", "cameras.unknown"),
        ("1 0 0 ", "1 7 0 ", "cameras.damaged"),
        ("700 -0.1", "0 -0.1", "cameras.no_pose"),
    ],
)
def test_bundle_refused(tmp_path, old, new, code):
    text = bundle()
    assert old in text
    path = write_bundle(tmp_path, text.replace(old, new, 1))
    with refused(code, path=path):
        read(path)

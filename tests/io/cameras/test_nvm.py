"""VisualSFM's NVM files, and those of OpenSfM and ODM."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.utils.camera_files import notes, read, read_ties
from tests.utils.codes import refused
from tests.utils.reprojection import tie_point_residuals_px

pytestmark = pytest.mark.quick_but(
    "test_fixed_calibration",
    "test_images_without_focal_length_have_no_pose",
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


def camera_line(name, f=F, k=K, turn=TURN, centre=CENTRE):
    return f"{name} {f:g} {words(np.roll(turn.as_quat(), 1))} {words(centre)} {k:g} 0"


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
    from PIL import Image

    Image.new("L", (600, 400)).save(tmp_path / "my a.png")
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
@pytest.mark.parametrize("squeezed", [True, False])
def test_places_from_the_corner(tmp_path, width, height, squeezed):
    frame = np.array([width, height])
    places = measured(f=250.0, k=0.0)
    outlier = np.zeros((len(places), 1))
    outlier[7] = 40.0
    seen = places * (frame / frame.max() if squeezed else 1) + frame / 2 + outlier
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
    assert cameras.unposed == ("small.jpg", "lost.jpg", "x.jpg", "y.jpg")
    assert cameras.notes[0].values.items() >= {"models": 2, "images": 2}.items()
    points = read_ties(path)
    assert set(points.views.camera.tolist()) == {1}


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("1\na.jpg", "x\na.jpg", "cameras.damaged"),
        ("a.jpg 700 ", "a.jpg ", "cameras.damaged"),
        (" 1 2 3 1 0 0 ", " 1 2 3 1 3 0 ", "cameras.damaged"),
        ("a.jpg 700 ", "a.jpg 0 ", "cameras.no_pose"),
        (words(np.roll(TURN.as_quat(), 1)), "1 1 0 0", "cameras.rotation"),
    ],
)
def test_refused(tmp_path, old, new, code):
    path = write(tmp_path, model(camera_line("a.jpg"), points=point_lines(measured())))
    text = path.read_text().replace("\n\n", "\n")
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with refused(code):
        read(path)

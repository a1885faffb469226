"""VisualSFM's NVM files, and those of OpenSfM and ODM."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix import InputError
from pcfix.io.cameras import nvm
from pcfix.io.cameras.formats import Source
from pcfix.lens.imaging import project
from tests.utils.reprojection import check_file, residuals_px, row_of
from tests.utils.shared import needs

TESTERARM, on_testerarm = needs("cameras", "nvm", "testerarm_undistorted")

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


def read(path):
    source = Source(path)
    assert nvm.recognises(source)
    return nvm.read(source)


def all_residuals(path):
    cameras = read(path)
    points = nvm.tie_points(Source(path), cameras)
    of_point = np.repeat(np.arange(len(points.xyz)), np.diff(points.views.start))
    misses = []
    for camera, point, place in zip(points.views.camera, of_point, points.image_xy, strict=True):
        ray = cameras.rotations[camera] @ (points.xyz[point] - cameras.centres[camera])
        misses.append(np.hypot(*(project(cameras.lenses[camera], ray[None])[0] - place)))
    return np.array(misses)


@on_testerarm
def test_testerarm():
    check = check_file(TESTERARM)
    path = TESTERARM / "reconstruction.nvm"
    cameras = read(path)
    listed = residuals_px(cameras, check["observations"])
    assert listed == pytest.approx([o["res_px"] for o in check["observations"]], abs=2e-3)
    assert [cameras.lenses[0].width, cameras.lenses[0].height] == check["image_size"]
    every = all_residuals(path)
    assert len(every) == check["n_observations_used_for_rms"]
    assert np.median(every) == pytest.approx(check["reprojection_median_px"], abs=1e-3)
    assert np.sqrt(np.mean(every**2)) == pytest.approx(check["reprojection_rms_px"], abs=1e-3)
    for expected in check["projection_centres"]:
        i = row_of(cameras, expected["image"])
        assert cameras.centres[i] == pytest.approx([expected[a] for a in "XYZ"], abs=1e-4)
        assert cameras.rotations[i][2] == pytest.approx(expected["view_dir"], abs=1e-6)
        assert -cameras.rotations[i][1] == pytest.approx(expected["up_dir_minus_cam_y"], abs=1e-6)


def test_pose_and_lens(tmp_path):
    path = write(tmp_path, model(camera_line("a.jpg"), points=point_lines(measured())))
    cameras = read(path)
    assert cameras.centres[0] == pytest.approx(CENTRE)
    assert cameras.rotations[0] == pytest.approx(TURN.as_matrix())
    lens = cameras.lenses[0]
    assert [lens.width, lens.height] == pytest.approx(2 * np.abs(measured()).max(axis=0))
    assert "estimated from the tie points" in cameras.notes[0]
    assert all_residuals(path).max() < 1e-5


def test_frame_of_the_image(tmp_path):
    from PIL import Image

    Image.new("L", (600, 400)).save(tmp_path / "my a.png")
    path = write(tmp_path, model(camera_line('my"a.png'), points=point_lines(measured())))
    cameras = read(path)
    assert cameras.labels == ("my a.png",)
    assert cameras.notes == ()
    assert (cameras.lenses[0].width, cameras.lenses[0].height) == (600, 400)
    points = nvm.tie_points(Source(path), cameras)
    assert points.image_xy == pytest.approx(measured() + np.array([300, 200]))


@pytest.mark.parametrize("name", ['"b c.jpg"', "b c.jpg", 'b"c.jpg', "b c.jpg\t"])
def test_names_with_spaces(tmp_path, name):
    path = write(tmp_path, model(camera_line(name), points=point_lines(measured())))
    assert read(path).labels == ("b c.jpg",)


def test_fixed_calibration(tmp_path):
    places = measured(k=0.0) * [1.0, 710 / 700]
    text = model(camera_line("a.jpg", k=0.0), points=point_lines(places))
    path = write(tmp_path, text, head="NVM_V3 FixedK 700 310 710 245")
    lens = read(path).lenses[0]
    assert (lens.focal, lens.b1, lens.principal_x, lens.principal_y) == (710, -10, 310, 245)
    assert (lens.width, lens.height) == (620, 490)
    assert all_residuals(path).max() < 1e-6


def test_matrix_and_translation(tmp_path):
    matrix = TURN.as_matrix()
    numbers = words([F, *matrix.ravel(), *(-matrix @ CENTRE), K, 0])
    text = model(f"a.jpg {numbers}", points=point_lines(measured()))
    cameras = read(write(tmp_path, text, head="NVM_V3_R9T"))
    assert cameras.centres[0] == pytest.approx(CENTRE)
    assert cameras.rotations[0] == pytest.approx(matrix)
    assert all_residuals(tmp_path / "x.nvm").max() < 1e-5


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
    every = all_residuals(path)
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
    assert [n for n in cameras.notes if "has 2 models" in n and "with 2 images" in n]
    points = nvm.tie_points(Source(path), cameras)
    assert set(points.views.camera.tolist()) == {1}


def test_images_without_focal_length_have_no_pose(tmp_path):
    text = model(
        camera_line("lost.jpg", f=0), camera_line("a.jpg"), points=point_lines(measured(), image=1)
    )
    path = write(tmp_path, text)
    assert read(path).labels == ("a.jpg",)
    assert read(path).unposed == ("lost.jpg",)
    assert all_residuals(path).max() < 1e-5


def test_poses_without_points(tmp_path):
    path = write(tmp_path, model(camera_line("a.jpg")))
    cameras = read(path)
    assert cameras.lenses is None
    assert "every point is taken as inside" in cameras.notes[0]
    with pytest.raises(InputError, match="no tie points"):
        nvm.tie_points(Source(path), cameras)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1\na.jpg", "x\na.jpg", "a number of cameras is 'x'"),
        ("1\na.jpg", "99999999999\na.jpg", "a number of cameras is '99999999999'"),
        ("a.jpg 700 ", "a.jpg ", r"image a\.jpg: its line must have 10 numbers"),
        ("a.jpg 700 ", "a.jpg x ", r"image a\.jpg: its line must have 10 numbers"),
        ("\n40\n", "\n41\n", "cut off or damaged at point 40 of 41"),
        ("\n40\n", "\n4000\n", "a number of points is '4000'"),
        (" 1 2 3 1 0 0 ", " 1 2 3 1 3 0 ", "point 0 was seen by image 3, but there are 1"),
        (" 1 2 3 1 0 0 ", " 1 2 3 2 0 0 ", "cut off or damaged at point"),
        (" 1 2 3 1 0 0 ", " 1 2 word 1 0 0 ", "is a word that is none"),
        ("a.jpg 700 ", "a.jpg 0 ", "no image has a pose"),
        ("a.jpg 700 ", "a.jpg inf ", r"camera of image a\.jpg: .* not finite"),
        ("NVM_V3 ", "NVM_V3 FixedK 700 310", "FixedK must be followed"),
        ("NVM_V3 ", "NVM_V3 FixedK 700 310 0 200", "FixedK must be followed"),
    ],
)
def test_damaged(tmp_path, old, new, message):
    path = write(tmp_path, model(camera_line("a.jpg"), points=point_lines(measured())))
    text = path.read_text().replace("\n\n", "\n")
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert "x.nvm" in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (f"700 {words(np.roll(TURN.as_quat(), 1))}", "700 1 1 0 0", "the quaternion has length"),
        (words(CENTRE), "nan 0 0", "its position is not finite"),
    ],
)
def test_damaged_poses(tmp_path, old, new, message):
    line = camera_line("a.jpg").replace(old, new)
    path = write(tmp_path, model(line, points=point_lines(measured())))
    with pytest.raises(InputError, match=rf"x\.nvm: image a\.jpg: {message}"):
        read(path)


def test_no_model_at_all(tmp_path):
    with pytest.raises(InputError, match=r"x\.nvm: has no model"):
        read(write(tmp_path))


def test_cut_anywhere(tmp_path):
    path = write(tmp_path, model(camera_line("a.jpg"), points=point_lines(measured())[:3]))
    text = path.read_text().partition("\n\n0\n")[0]
    for length in range(len("NVM_V3"), text.rindex(" "), 3):
        path.write_text(text[:length])
        with pytest.raises(InputError, match=r"x\.nvm: "):
            read(path)

"""COLMAP models, text and binary."""

import shutil
import sqlite3
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pcfix import InputError, PcfixWarning
from pcfix.io.cameras import colmap, read_tie_points
from pcfix.io.cameras.colmap.files import MODELS, Camera, lens
from pcfix.io.cameras.formats import Source
from pcfix.lens.imaging import project
from tests.utils.reprojection import check_file, residuals_px, row_of
from tests.utils.shared import needs

AR_BOXES, ar_boxes = needs("cameras", "colmap", "ar_boxes")
WESLEY, wesley = needs("cameras", "colmap", "wesley_dense")
RENDERED, rendered = needs("rendered_a")

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
    if points is not None:
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


def read(path):
    source = Source(path)
    assert colmap.recognises(source)
    return colmap.read(source)


def all_residuals(path):
    """Return the reprojection residual of every observation of a model, px."""
    cameras, points = read(path), colmap.tie_points(Source(path), read(path))
    of_point = np.repeat(np.arange(len(points.xyz)), np.diff(points.views.start))
    misses = []
    for i in range(len(cameras)):
        rows = points.views.camera == i
        rays = (points.xyz[of_point[rows]] - cameras.centres[i]) @ cameras.rotations[i].T
        misses.append(np.hypot(*(project(cameras.lenses[i], rays) - points.image_xy[rows]).T))
    return np.concatenate(misses)


@ar_boxes
@pytest.mark.parametrize("form", ["bin", "txt"])
def test_ar_boxes(form):
    check = check_file(AR_BOXES)
    cameras = read(AR_BOXES / form)
    found = residuals_px(cameras, check["observations"])
    assert found == pytest.approx([o["res_px"] for o in check["observations"]], abs=0.01)
    every = all_residuals(AR_BOXES / form)
    assert len(every) == check["n_observations_used_for_rms"]
    assert np.sqrt(np.mean(every**2)) == pytest.approx(check["reprojection_rms_px"], abs=1e-3)
    assert np.median(every) == pytest.approx(check["reprojection_median_px"], abs=1e-3)
    same_as_expected(cameras, check)


@wesley
def test_wesley_dense():
    check = check_file(WESLEY)
    every = all_residuals(WESLEY)
    assert len(every) == check["n_observations_used_for_rms"]
    assert np.median(every) == pytest.approx(check["reprojection_median_px"], abs=1e-3)
    same_as_expected(read(WESLEY), check)


def same_as_expected(cameras, check):
    for expected in check["projection_centres"]:
        i = row_of(cameras, expected["image"])
        xyz = [expected[axis] for axis in "XYZ"]
        assert cameras.centres[i] == pytest.approx(xyz, abs=1e-5)
        assert cameras.rotations[i][2] == pytest.approx(expected["view_dir"], abs=1e-5)
        assert -cameras.rotations[i][1] == pytest.approx(expected["up_dir_minus_cam_y"], abs=1e-5)


@ar_boxes
def test_text_and_binary_of_one_model_agree():
    one, other = (read(AR_BOXES / form) for form in ("bin", "txt"))
    rows = [other.labels.index(label) for label in one.labels]
    assert one.centres == pytest.approx(other.centres[rows], abs=1e-3)  # the text is rounded
    assert one.rotations == pytest.approx(other.rotations[rows], abs=1e-5)


@rendered
def test_rendered_a():
    assert np.median(all_residuals(RENDERED / "colmap")) < 0.5
    cameras = read(RENDERED / "colmap")
    assert cameras.labels == tuple(sorted(cameras.labels))
    assert cameras.lenses[0].principal_x == pytest.approx(806.3)


@pytest.mark.parametrize("make", [folder, binary_folder])
def test_a_small_model(tmp_path, make):
    cameras = read(make(tmp_path))
    assert cameras.labels == ("south wing/b 2.jpg", "a.jpg", "c.jpg")
    turn = Rotation.from_quat([-0.5, 0.5, 0.5, 0.5])
    assert cameras.rotations[0] == pytest.approx(turn.as_matrix())
    assert cameras.centres[0] == pytest.approx(-turn.inv().apply([1, 2, 3]))
    assert cameras.centres[1] == pytest.approx([1, 2, 3])
    assert [(x.focal, x.b1, x.width) for x in cameras.lenses] == [
        (400, 0, 640),
        (510, -10, 800),
        (510, -10, 800),
    ]
    assert cameras.lenses[0].radial == (0.1,)
    assert cameras.crs is None
    assert cameras.notes == ()
    assert cameras.gnss is None


@pytest.mark.parametrize("make", [folder, binary_folder])
def test_its_tie_points(tmp_path, make):
    source = Source(make(tmp_path))
    points = colmap.tie_points(source, colmap.read(source))
    assert points.xyz.tolist() == [[1.5, 2.5, 3.5], [-1, -2, 10], [0, 0, 1]]
    assert points.views.start.tolist() == [0, 2, 3, 3]
    assert points.views.camera.tolist() == [0, 2, 0]
    assert points.image_xy.tolist() == [[50, 60], [7, 8], [10, 20]]


@pytest.mark.parametrize("make", [folder, binary_folder])
@pytest.mark.parametrize("given", [".", "project", "project/sparse", "project/sparse/0"])
def test_places_of_a_model(tmp_path, make, given):
    make(tmp_path / ("sparse" if given == "." else "project/sparse/0"))
    assert len(read(tmp_path / given)) == 3


@pytest.mark.parametrize(
    ("make", "suffix"), [(folder, "txt"), (binary_folder, "bin")], ids=["txt", "bin"]
)
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_each_file_stands_for_the_model(tmp_path, make, suffix, name):
    make(tmp_path)
    assert len(read(tmp_path / f"{name}.{suffix}")) == 3


def test_the_file_named_is_the_form_that_is_read(tmp_path):
    binary_folder(tmp_path)
    folder(tmp_path, images="1 1 0 0 0 0 0 0 3 only.jpg\n\n")
    assert len(read(tmp_path)) == 3
    assert read(tmp_path / "images.txt").labels == ("only.jpg",)


def test_largest_of_several_models(tmp_path):
    folder(tmp_path / "sparse/0", images="1 1 0 0 0 0 0 0 3 x.jpg\n\n")
    folder(tmp_path / "sparse/1")
    cameras = read(tmp_path)
    assert len(cameras) == 3
    assert [note for note in cameras.notes if "largest of 2 models" in note]


def test_incomplete_models_beside_the_one_that_is_read(tmp_path):
    used = folder(tmp_path / "sparse/0")
    (used / "images.bin").write_bytes(b"")
    folder(tmp_path / "sparse/1", points=None)
    (tmp_path / "sparse/1/cameras.txt").unlink()
    notes = "\n".join(read(tmp_path).notes)
    assert "sparse/0: a model beside the one that is read lacks cameras.bin and points" in notes
    assert "sparse/1: a model beside the one that is read lacks cameras.txt and points" in notes


def test_tie_points_that_are_not_finite(tmp_path):
    points = POINTS.replace("6 1.5", "6 nan") + "10 1 2 3 0 0 0 0\n"
    path = folder(tmp_path, images=IMAGES.replace("50 60 6", "inf 60 10"), points=points)
    with pytest.warns(PcfixWarning, match="1 tie points and 1 image places .* left out"):
        ties = read_tie_points(path, read(path))
    assert np.isfinite(ties.xyz).all()
    assert len(ties.xyz) == 3
    assert ties.image_xy.tolist() == [[10.0, 20.0]]
    assert ties.views.start.tolist() == [0, 1, 1, 1]


def test_other_files_are_not_recognised(tmp_path):
    (tmp_path / "cameras.txt").write_text("a table\n")
    (tmp_path / "images.txt").write_text("of something else\n")
    (tmp_path / "frames.txt").write_text("1\n")
    assert not colmap.recognises(Source(tmp_path))
    assert not colmap.recognises(Source(tmp_path / "frames.txt"))
    assert not colmap.recognises(Source(tmp_path / "absent"))


def test_images_without_a_pose(tmp_path):
    images = IMAGES + "5 nan nan nan nan nan nan nan 3 lost.jpg\n\n"
    path = folder(tmp_path, images=images)
    assert read(path).unposed == ("lost.jpg",)
    assert "lost.jpg" not in read(path).labels


def test_rigs_do_not_matter(tmp_path):
    path = folder(tmp_path)
    (path / "rigs.txt").write_text("1 2 CAMERA 3 CAMERA 7 1 1 0 0 0 0 0 0\n")
    (path / "frames.txt").write_text("1 1 1 0 0 0 0 0 0 2 CAMERA 3 4 CAMERA 7 12\n")
    assert len(read(path)) == 3
    assert len(read(path / "frames.txt")) == 3


def brown(x, y, k=(), below=(), p=(0, 0), s=(0, 0, 0, 0)):
    """Return Brown's distortion with p1 and p2 in OpenCV's order."""
    r2 = x * x + y * y
    radial = 1 + sum(c * r2 ** (i + 1) for i, c in enumerate(k))
    radial = radial / (1 + sum(c * r2 ** (i + 1) for i, c in enumerate(below)))
    return (
        x * radial + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x) + s[0] * r2 + s[1] * r2 * r2,
        y * radial + p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y + s[2] * r2 + s[3] * r2 * r2,
    )


def fisheye(x, y):
    theta = np.arctan(np.hypot(x, y)) / np.hypot(x, y)
    return x * theta, y * theta


def fov(x, y, w):
    r = np.hypot(x, y)
    return np.array([x, y]) * np.arctan(r * 2 * np.tan(w / 2)) / (r * w)


def division(x, y, k):
    return np.array([x, y]) * 2 / (1 + np.sqrt(1 - 4 * k * (x * x + y * y)))


def eucm(x, y, a, b):
    return np.array([x, y]) / (a * np.sqrt(b * (x * x + y * y) + 1) + 1 - a)


def aria(x, y, k, p, s):
    return brown(*brown(*fisheye(x, y), k), p=(p[1], p[0]), s=s)


@pytest.mark.parametrize(
    ("name", "extra", "plane"),
    [
        ("SIMPLE_PINHOLE", [], lambda x, y: (x, y)),
        ("PINHOLE", [], lambda x, y: (x, y)),
        ("SIMPLE_RADIAL", [0.1], lambda x, y: brown(x, y, (0.1,))),
        ("RADIAL", [0.1, -0.02], lambda x, y: brown(x, y, (0.1, -0.02))),
        (
            "OPENCV",
            [0.1, -0.02, 0.003, -0.004],
            lambda x, y: brown(x, y, (0.1, -0.02), p=(0.003, -0.004)),
        ),
        (
            "OPENCV_FISHEYE",
            [0.1, -0.02, 0.03, 0.01],
            lambda x, y: brown(*fisheye(x, y), (0.1, -0.02, 0.03, 0.01)),
        ),
        (
            "FULL_OPENCV",
            [0.1, 0.02, 0.003, -0.004, 0.01, 0.2, 0.03, 0.004],
            lambda x, y: brown(x, y, (0.1, 0.02, 0.01), (0.2, 0.03, 0.004), (0.003, -0.004)),
        ),
        ("FOV", [0.8], lambda x, y: fov(x, y, 0.8)),
        ("FOV", [0.0], lambda x, y: (x, y)),
        ("SIMPLE_RADIAL_FISHEYE", [0.1], lambda x, y: brown(*fisheye(x, y), (0.1,))),
        ("RADIAL_FISHEYE", [0.1, 0.02], lambda x, y: brown(*fisheye(x, y), (0.1, 0.02))),
        (
            "THIN_PRISM_FISHEYE",
            [0.1, 0.02, 0.003, -0.004, 0.01, 0.02, 0.005, -0.006],
            lambda x, y: brown(
                *fisheye(x, y), (0.1, 0.02, 0.01, 0.02), p=(0.003, -0.004), s=(0.005, 0, -0.006, 0)
            ),
        ),
        (
            "RAD_TAN_THIN_PRISM_FISHEYE",
            [0.1, 0.02, 0.01, 0.02, 0.01, 0.03, 0.003, -0.004, 0.005, 0.006, 0.007, 0.008],
            lambda x, y: aria(
                x,
                y,
                (0.1, 0.02, 0.01, 0.02, 0.01, 0.03),
                (0.003, -0.004),
                (0.005, 0.006, 0.007, 0.008),
            ),
        ),
        ("SIMPLE_DIVISION", [-0.1], lambda x, y: division(x, y, -0.1)),
        ("DIVISION", [0.1], lambda x, y: division(x, y, 0.1)),
        ("SIMPLE_FISHEYE", [], fisheye),
        ("FISHEYE", [], fisheye),
        ("EUCM", [0.6, 1.1], lambda x, y: eucm(x, y, 0.6, 1.1)),
    ],
)
def test_every_model(tmp_path, name, extra, plane):
    model = next(m for m in MODELS if m.name == name)
    fx, fy = (500, 510) if "fx" in model.parameters else (500, 500)
    focals = [fx, fy] if "fx" in model.parameters else [fx]
    line = " ".join(map(str, (1, name, 800, 600, *focals, 410, 290, *extra)))
    path = folder(tmp_path, cameras=line, images="1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    x, y = np.random.default_rng(5).uniform(-0.4, 0.4, (2, 50))
    px, py = plane(x, y)
    seen = project(read(path).lenses[0], np.column_stack([x, y, np.ones(50)]) * 3)
    assert seen == pytest.approx(np.column_stack([fx * px + 410, fy * py + 290]), abs=1e-9)


@pytest.mark.parametrize("number", range(len(MODELS)))
def test_binary_knows_the_models_by_their_numbers(tmp_path, number):
    pycolmap = pytest.importorskip("pycolmap")
    twin = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(number), 500.0, 800, 600)
    model = MODELS[number]
    assert (twin.model_name, len(twin.params)) == (model.name, len(model.parameters))
    if model.projection is None:
        return
    extra = np.linspace(0.01, 0.03, len(model.parameters) - len(model.parameters[:4]))
    values = [*twin.params[: len(twin.params) - len(extra)], *extra] if len(extra) else twin.params
    twin.params = values
    rays = np.random.default_rng(1).uniform((-0.4, -0.4, 1), (0.4, 0.4, 1), (100, 3))
    made = lens(tmp_path, 1, Camera(model, 800.0, 600.0, tuple(values)))
    assert project(made, rays) == pytest.approx(np.array(twin.img_from_cam(rays)), abs=1e-8)


def test_pycolmap_reads_the_same(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 2, 3
    options.num_points3D = 50
    twin = pycolmap.synthesize_dataset(options)
    for form, write in (("bin", twin.write_binary), ("txt", twin.write_text)):
        path = tmp_path / form
        path.mkdir()
        write(path)
        cameras = read(path)
        by_name = {image.name: image for image in twin.images.values()}
        assert len(cameras) == len(by_name)
        for label, centre in zip(cameras.labels, cameras.centres, strict=True):
            assert centre == pytest.approx(by_name[label].projection_center(), abs=1e-9)
        points = colmap.tie_points(Source(path), cameras)
        assert len(points.xyz) == twin.num_points3D()
        assert len(points.image_xy) == twin.compute_num_observations()
        assert all_residuals(path).max() < 1e-6


def database(path, rows, *, rigs=True, names=("a.jpg", "c.jpg", "other.jpg")):
    """Write a database with pose priors (row of `names`, position, covariance, system)."""
    with sqlite3.connect(path) as sql:
        sql.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id)")
        keys = "corr_data_id, corr_sensor_id, corr_sensor_type" if rigs else "image_id"
        sql.execute(
            f"CREATE TABLE pose_priors ({keys}, position, position_covariance, coordinate_system)"
        )
        sql.executemany("INSERT INTO images VALUES (?, ?, 1)", enumerate(names, start=40))
        for row, position, covariance, system in rows:
            key = (40 + row, 1, 0) if rigs else (40 + row,)
            blobs = [
                None if v is None else np.array(v, "<f8").tobytes() for v in (position, covariance)
            ]
            marks = ", ".join("?" * (len(key) + 3))
            sql.execute(f"INSERT INTO pose_priors VALUES ({marks})", (*key, *blobs, system))
    sql.close()


@pytest.mark.parametrize("rigs", [True, False])
def test_pose_priors_of_wgs84(tmp_path, rigs):
    path = folder(tmp_path / "sparse" / "0")
    sigma = np.diag([0.04, 0.09, np.nan]).tolist()
    rows = [(0, (47.5, 8.25, 440), sigma, 0), (2, (1, 2, 3), None, 0)]
    database(tmp_path / "database.db", rows, rigs=rigs)
    cameras = read(path)
    assert cameras.gnss.crs == "EPSG:4979"
    assert cameras.gnss.xyz[1].tolist() == [8.25, 47.5, 440]
    assert cameras.gnss.sigma_m[1] == pytest.approx([0.2, 0.3, np.nan], nan_ok=True)
    assert np.isnan(cameras.gnss.xyz[[0, 2]]).all()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["database.db", "sparse"]


def test_cartesian_pose_priors(tmp_path):
    path = folder(tmp_path)
    rows = [(1, (10, 20, 30), None, 1), (0, (np.nan, np.nan, np.nan), None, 1)]
    database(tmp_path / "database.db", rows)
    gnss = read(path).gnss
    assert gnss.crs is None
    assert gnss.xyz[2].tolist() == [10, 20, 30]
    assert np.isnan(gnss.xyz[[0, 1]]).all()
    assert np.isnan(gnss.sigma_m).all()


def test_databases_that_say_nothing(tmp_path):
    path = folder(tmp_path)
    database(tmp_path / "database.db", [(2, (1, 2, 3), None, 0)])
    assert read(path).gnss is None
    assert read(path).notes == ()
    (tmp_path / "database.db").unlink()
    with sqlite3.connect(tmp_path / "database.db") as sql:
        sql.execute("CREATE TABLE images (image_id, name)")
    sql.close()
    assert read(path).gnss is None
    assert read(path).notes == ()


def test_databases_that_are_left_out(tmp_path):
    path = folder(tmp_path)
    (tmp_path / "database.db").write_bytes(b"no database" * 200)
    assert [n for n in read(path).notes if "cannot be read" in n and "database.db" in n]
    (tmp_path / "database.db").unlink()
    database(tmp_path / "database.db", [(0, (1, 2, 3), None, 0), (1, (1, 2, 3), None, 1)])
    assert read(path).gnss is None
    assert [n for n in read(path).notes if "several systems" in n]


@pytest.mark.parametrize(
    ("part", "old", "new", "message"),
    [
        ("cameras", "3 PINHOLE", "3 KANNALA", r"cameras\.txt: line 3: camera 3 .* model KANNALA"),
        ("cameras", "510 410 290", "510 410", r"cameras\.txt: line 3 .* 4 parameters of PINHOLE"),
        ("cameras", "510 410", "x 410", r"cameras\.txt: line 3 has a word"),
        ("cameras", "800 600 500 510 410 290", "800", r"cameras\.txt: line 3 must give a camera"),
        ("cameras", "500 510", "500 0", r"camera 3: focal length 0 .* positive"),
        ("cameras", "500 510", "0 510", r"camera 3: focal length fx 0 must be positive"),
        ("cameras", "800 600", "0 600", r"camera 3: .* frame 0 x 600 must be positive"),
        ("cameras", "410 290", "nan 290", r"camera 3: .* not finite"),
        ("cameras", "3 PINHOLE 800 600 500 510 410 290", "3 EQUIRECTANGULAR 8 6 8 6",
         r"camera 3: pcfix has no lens for the model EQUIRECTANGULAR"),
        ("cameras", "3 PINHOLE", "2 PINHOLE", r"image a\.jpg: its camera 3 is not in cameras"),
        ("images", "4 1 0 0 0", "4 2 0 0 0", r"images\.txt: image a\.jpg: the quaternion has"),
        ("images", "4 1 0 0 0", "4 0 0 0 0", r"image a\.jpg: the quaternion has length 0 "),
        ("images", " 3 a.jpg", "", r"images\.txt: line 4 must give an image"),
        ("images", "4 1 0", "4 one 0", r"images\.txt: line 4 has a word"),
        ("cameras", "# Cam", "# Number of cameras: 3\n# Cam", r"cameras\.txt: is cut short: .* 3"),
        ("images", "# Im", "# Number of images: 32, mean 8\n# Im", r"counts 32 images, .* has 3"),
        ("images", "a.jpg\n\n", "a.jpg\n", r"images\.txt: line 5 must give the image points"),
    ],
)  # fmt: skip
def test_damaged_text(tmp_path, part, old, new, message):
    text = {"cameras": CAMERAS, "images": IMAGES}
    assert old in text[part]
    text[part] = text[part].replace(old, new)
    with pytest.raises(InputError, match=message):
        read(folder(tmp_path, **text))


def test_no_image_has_a_pose(tmp_path):
    with pytest.raises(InputError, match=r"images\.txt: has no image with a pose"):
        read(folder(tmp_path, images="# none\n"))


def tie_points_of(path):
    source = Source(path)
    return colmap.tie_points(source, colmap.read(source))


def test_tie_points_that_are_not_there(tmp_path):
    with pytest.raises(InputError, match=r"points3D\.txt: there is no such file"):
        tie_points_of(folder(tmp_path, points=None))
    with pytest.raises(InputError, match="no points that its images saw"):
        tie_points_of(folder(tmp_path, points="# none\n"))
    with pytest.raises(InputError, match=r"points3D\.txt: line 1 must give a point"):
        tie_points_of(folder(tmp_path, points="1 2 x 4\n"))
    with pytest.raises(InputError, match="counts 9 points, the file has 3"):
        tie_points_of(folder(tmp_path, points="# Number of points: 9\n" + POINTS))
    with pytest.raises(InputError, match=r"images\.txt: line 3 must give the image points"):
        tie_points_of(folder(tmp_path, images=IMAGES.replace("10 20 5", "10 20 5 9")))


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_binary_files_cut_anywhere(tmp_path, name):
    whole = binary_folder(tmp_path / "whole")
    data = (whole / f"{name}.bin").read_bytes()
    for length in range(len(data)):
        path = tmp_path / "cut"
        shutil.copytree(whole, path, dirs_exist_ok=True)
        (path / f"{name}.bin").write_bytes(data[:length])
        with pytest.raises(InputError, match=rf"{name}\.bin: is cut off"):
            tie_points_of(path)


@pytest.mark.parametrize(
    ("name", "at"),
    [
        ("cameras", 0),
        ("images", 0),
        ("points3D", 0),
        ("images", 8 + 64 + len(b"south wing/b 2.jpg\0")),
        ("points3D", 8 + 43),
    ],
)
@pytest.mark.parametrize("count", [2**64 - 1, 2**40])
def test_counts_that_cannot_be(tmp_path, name, at, count):
    path = binary_folder(tmp_path)
    data = bytearray((path / f"{name}.bin").read_bytes())
    data[at : at + 8] = struct.pack("<Q", count)
    (path / f"{name}.bin").write_bytes(data)
    with pytest.raises(InputError, match=rf"{name}\.bin: is cut off"):
        tie_points_of(path)


def test_binary_model_that_nobody_knows(tmp_path):
    path = binary_folder(tmp_path)
    data = bytearray((path / "cameras.bin").read_bytes())
    data[12:16] = struct.pack("<i", 99)
    (path / "cameras.bin").write_bytes(data)
    with pytest.raises(InputError, match=r"camera 3 has the model number 99"):
        read(path)

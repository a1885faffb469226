"""Blocks that pcfix writes: COLMAP's and tables; read by pcfix and by COLMAP itself."""

import json
from dataclasses import replace

import numpy as np
import pytest
from pyproj import CRS

from pcfix.errors import InputError, SettingError
from pcfix.io.cameras import read_cameras, read_tie_points
from pcfix.io.cameras.colmap import write_colmap
from pcfix.io.cameras.table import write_table
from pcfix.lens.imaging import project
from pcfix.model import Lens, TiePoints, Views
from tests.utils.blocks import PLAIN, small_block, some_ties
from tests.utils.codes import refused
from tests.utils.reprojection import bring_to

FRAME = (1600.0, 1200.0, 810.0, 590.0)
RAYS = np.random.default_rng(1).uniform([-0.4, -0.4, 1], [0.4, 0.4, 1], (50, 3))
DISTORTED = {"radial": (-0.1, 0.02, -0.003), "tangential": (1e-3, -2e-3)}
FISH = {"projection": "equidistant"}
COLMAP_LENSES = {
    "SIMPLE_PINHOLE": PLAIN,
    "PINHOLE": Lens(1500.0, *FRAME, b1=0.25),
    "SIMPLE_RADIAL": Lens(1500.0, *FRAME, radial=(-0.1, 0.0)),
    "RADIAL": Lens(1500.0, *FRAME, radial=(-0.1, 0.02, 0.0)),
    "OPENCV": Lens(1500.0, *FRAME, b1=-2.0, radial=(-0.1, 0.02), tangential=(1e-3, -2e-3)),
    "FULL_OPENCV": Lens(1500.0, *FRAME, **DISTORTED, denominator=(0.01, 0.002)),
    "SIMPLE_RADIAL_FISHEYE": Lens(800.0, *FRAME, **FISH),
    "RADIAL_FISHEYE": Lens(800.0, *FRAME, **FISH, radial=(0.01, 0.002)),
    "OPENCV_FISHEYE": Lens(800.0, *FRAME, **FISH, radial=(0.01, 2e-3, 3e-4, 1e-5)),
    "THIN_PRISM_FISHEYE": Lens(
        *(800.0, *FRAME),
        **FISH,
        radial=(0.01, 2e-3),
        tangential=(1e-3, 2e-3),
        thin_prism=(1e-4, 0.0, 2e-4, 0.0),
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": Lens(
        *(800.0, *FRAME),
        **FISH,
        radial=(0.01, 2e-3, 1e-4, 1e-5, 1e-6, 1e-7),
        tangential=(1e-3, 2e-3),
        thin_prism=(1e-4, 3e-5, 2e-4, -2e-5),
        in_turn=True,
    ),
    "FOV": Lens(800.0, *FRAME, projection="fov", shape=(0.9,)),
    "SIMPLE_DIVISION": Lens(1500.0, *FRAME, projection="division", shape=(-0.05,)),
    "EUCM": Lens(1500.0, *FRAME, projection="eucm", shape=(0.6, 1.1)),
}
OPENCV = Lens(1500.0, *FRAME, **DISTORTED, denominator=(0.01, 0.0, 0.002))
FOUR = Lens(1400.0, *FRAME, radial=(-0.1, 0.02, -0.003, 1e-4), tangential=(1e-3, -2e-3))
FILM = Lens(3.6, 3.8, 2.8, 1.9, 1.4, unit="mm")


def write(form, folder, cameras):
    """Write a block into a folder, and return what is read again."""
    if form == "colmap":
        write_colmap(folder, cameras)
        return folder
    write_table(folder, cameras)
    return folder / "cameras.csv"


def check_block(found, given, centres_m=1e-9):
    assert found.labels == given.labels
    # map coordinates of 4e6 m have steps of 5e-10 m
    assert found.centres == pytest.approx(given.centres, abs=centres_m, rel=0.0)
    assert found.rotations == pytest.approx(given.rotations, abs=1e-12)
    for read, wrote in zip(found.lenses, given.lenses, strict=True):
        assert project(read, RAYS) == pytest.approx(project(wrote, RAYS), abs=1e-8)


def test_colmap_there_and_back(tmp_path):
    cameras = small_block(tuple(COLMAP_LENSES.values()), k=16)
    ties = some_ties(cameras)
    write_colmap(tmp_path / "m", cameras, ties)
    place = json.loads((tmp_path / "m" / "georeference.json").read_text())
    assert place["offset_m"] == [320000.0, 3842800.0, 0.0]  # near the block
    found = read_cameras(tmp_path / "m")
    assert found.crs == cameras.crs
    check_block(found, cameras)
    read = read_tie_points(tmp_path / "m", found)
    assert read.xyz == pytest.approx(ties.xyz, abs=1e-9, rel=0.0)
    for name in ("start", "camera"):
        np.testing.assert_array_equal(getattr(read.views, name), getattr(ties.views, name))
    np.testing.assert_array_equal(read.image_xy, ties.image_xy)
    check_block(bring_to(found, "EPSG:32636"), cameras, 3e-9)
    names = {path.name for path in (tmp_path / "m").iterdir()}
    assert names == {"cameras.bin", "images.bin", "points3D.bin", "georeference.json"}


@pytest.mark.parametrize("lenses", [(PLAIN,), (OPENCV,), (FILM,)])
@pytest.mark.parametrize("crs", ["EPSG:32636", CRS("EPSG:32636").to_3d().to_wkt(), None])
def test_table_there_and_back(tmp_path, lenses, crs):
    cameras = small_block(lenses, crs)
    cameras = replace(cameras, labels=('a, "b".jpg', "c d.jpg", *cameras.labels[2:]))
    found = read_cameras(write("table", tmp_path / "new", cameras))
    assert found.crs == crs
    check_block(found, cameras, 0.0)


def test_colmap_reads_it(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    cameras = small_block(tuple(COLMAP_LENSES.values()), k=16)
    ties = some_ties(cameras)
    write_colmap(tmp_path, cameras, ties)
    offset = np.array([320000.0, 3842800.0, 0.0])
    model = pycolmap.Reconstruction(str(tmp_path))
    assert len(model.points3D) == len(ties.xyz)
    for i, label in enumerate(cameras.labels):
        image = model.images[i + 1]
        assert image.name == label
        assert image.projection_center() == pytest.approx(cameras.centres[i] - offset, abs=1e-9)
        matrix = image.cam_from_world().rotation.matrix()
        assert matrix == pytest.approx(cameras.rotations[i], abs=1e-12)
        seen = np.array([model.cameras[image.camera_id].img_from_cam(ray) for ray in RAYS])
        assert seen == pytest.approx(project(cameras.lenses[i], RAYS), abs=1e-7)
    for i, xyz in enumerate(ties.xyz):
        point = model.points3D[i + 1]
        assert point.xyz == pytest.approx(xyz - offset, abs=1e-9)
        views = [
            (e.image_id - 1, model.images[e.image_id].points2D[e.point2D_idx].xy)
            for e in point.track.elements
        ]
        rows = slice(*ties.views.start[i : i + 2])
        assert [camera for camera, _ in views] == ties.views.camera[rows].tolist()
        assert np.array([xy for _, xy in views]) == pytest.approx(ties.image_xy[rows], abs=0)


ODD = (
    Lens(1500.0, *FRAME, b2=0.1),
    Lens(1500.0, *FRAME, radial=(0.1, 0.01, 0.001, 1e-4)),
    Lens(1500.0, *FRAME, radial=(0.1,), inverse=True),
    FILM,
)


@pytest.mark.parametrize(
    ("form", "lenses"),
    [
        *(("colmap", (lens,)) for lens in ODD),
        ("colmap", (Lens(1500.0, *FRAME, tangential=(1e-3, 1e-3, 1e-4)),)),
        ("colmap", (Lens(1500.0, *FRAME, thin_prism=(1e-3,)),)),
        ("table", (FOUR,)),
        ("table", (replace(FILM, radial=(0.1,)),)),
        ("table", (PLAIN, OPENCV)),
    ],
)
def test_lens_not_held(tmp_path, form, lenses):
    with refused("output.lens"):
        write(form, tmp_path / "new", small_block(lenses))
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("form", "changes", "code"),
    [
        *((form, {"lenses": None}, "output.no_lenses") for form in ("colmap", "table")),
        ("colmap", {"labels": ("a\nb", *"cdefg")}, "output.label"),
        ("table", {"crs": "ENU:1,2,3"}, "output.crs"),
    ],
)
def test_block_not_held(tmp_path, form, changes, code):
    with refused(code, InputError):
        write(form, tmp_path, replace(small_block(), **changes))


def test_unseen_points_are_left_out(tmp_path):
    xyz = np.array([[1.0, 2, 3], [np.nan] * 3, [4.0, 5, 6], [7.0, 8, 9]])
    views = Views(np.array([0, 2, 4, 4, 6]), np.array([0, 1, 0, 1, 2, 0]))
    ties = TiePoints(xyz, views, np.arange(12.0).reshape(6, 2))
    write_colmap(tmp_path, small_block(crs=None, origin=(0, 0, 0)), ties)
    found = read_tie_points(tmp_path, read_cameras(tmp_path))
    assert found.xyz.tolist() == [[1.0, 2, 3], [7.0, 8, 9]]
    assert found.views.start.tolist() == [0, 2, 4]
    assert found.views.camera.tolist() == [0, 1, 0, 2]
    assert found.image_xy[:, 0] == pytest.approx([0.0, 2.0, 10.0, 8.0], abs=1e-9)


@pytest.mark.parametrize(("form", "name"), [("colmap", "points3D.bin"), ("table", "sensor.csv")])
def test_nothing_is_replaced(tmp_path, form, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(SettingError):
        write(form, tmp_path, small_block())
    assert [path.name for path in tmp_path.iterdir()] == [name]

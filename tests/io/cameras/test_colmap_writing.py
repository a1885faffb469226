"""COLMAP models that pcfix writes: read by COLMAP itself, and by pcfix."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pcfix.errors import SettingError
from pcfix.io.cameras import read_cameras, read_tie_points
from pcfix.io.cameras.colmap.writing import colmap_camera, write_colmap
from pcfix.lens.imaging import project
from pcfix.model import Lens, TiePoints, Views
from tests.utils.blocks import PLAIN, small_block, some_ties
from tests.utils.codes import refused
from tests.utils.reprojection import bring_to
from tests.utils.shared import needs

FREE, free = needs("rendered_a_free")

FRAME = (1600.0, 1200.0, 810.0, 590.0)
LENSES = {
    "SIMPLE_PINHOLE": PLAIN,
    "PINHOLE": Lens(1500.0, *FRAME, b1=0.25),
    "SIMPLE_RADIAL": Lens(1500.0, *FRAME, radial=(-0.1, 0.0)),
    "RADIAL": Lens(1500.0, *FRAME, radial=(-0.1, 0.02, 0.0)),
    "OPENCV": Lens(1500.0, *FRAME, b1=-2.0, radial=(-0.1, 0.02), tangential=(1e-3, -2e-3)),
    "FULL_OPENCV": Lens(
        *(1500.0, *FRAME),
        radial=(-0.1, 0.02, -0.003),
        denominator=(0.01, 0.002),
        tangential=(1e-3, -2e-3),
    ),
    "SIMPLE_RADIAL_FISHEYE": Lens(800.0, *FRAME, projection="equidistant"),
    "RADIAL_FISHEYE": Lens(800.0, *FRAME, projection="equidistant", radial=(0.01, 0.002)),
    "OPENCV_FISHEYE": Lens(
        800.0, *FRAME, projection="equidistant", radial=(0.01, 2e-3, 3e-4, 1e-5)
    ),
    "THIN_PRISM_FISHEYE": Lens(
        *(800.0, *FRAME),
        projection="equidistant",
        radial=(0.01, 2e-3),
        tangential=(1e-3, 2e-3),
        thin_prism=(1e-4, 0.0, 2e-4, 0.0),
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": Lens(
        *(800.0, *FRAME),
        projection="equidistant",
        radial=(0.01, 2e-3, 1e-4, 1e-5, 1e-6, 1e-7),
        tangential=(1e-3, 2e-3),
        thin_prism=(1e-4, 3e-5, 2e-4, -2e-5),
        in_turn=True,
    ),
    "FOV": Lens(800.0, *FRAME, projection="fov", shape=(0.9,)),
    "SIMPLE_DIVISION": Lens(1500.0, *FRAME, projection="division", shape=(-0.05,)),
    "EUCM": Lens(1500.0, *FRAME, projection="eucm", shape=(0.6, 1.1)),
}  # fmt: skip


def same_block(found, given, centres_m=1e-9):
    assert found.labels == given.labels
    # map coordinates of 4e6 m have steps of 5e-10 m
    assert found.centres == pytest.approx(given.centres, abs=centres_m, rel=0.0)
    assert found.rotations == pytest.approx(given.rotations, abs=1e-12)
    assert found.crs == given.crs


def same_ties(found, given):
    assert found.xyz == pytest.approx(given.xyz, abs=1e-9, rel=0.0)
    assert found.views.start.tolist() == given.views.start.tolist()
    assert found.views.camera.tolist() == given.views.camera.tolist()
    assert found.image_xy.tolist() == given.image_xy.tolist()


@pytest.mark.parametrize("offset", [None, (0.0, 0.0, 0.0), (319900.5, 3842700.25, 10.0)])
def test_there_and_back(tmp_path, offset):
    cameras = small_block(tuple(LENSES.values()), k=16)
    ties = some_ties(cameras)
    write_colmap(tmp_path / "m", cameras, ties, offset_m=offset)
    found = read_cameras(tmp_path / "m")
    same_block(found, cameras, 1e-9 if offset != (0.0, 0.0, 0.0) else 3e-9)
    same_ties(read_tie_points(tmp_path / "m", found), ties)
    rays = np.random.default_rng(1).uniform([-0.4, -0.4, 1], [0.4, 0.4, 1], (50, 3))
    for read, wrote in zip(found.lenses, cameras.lenses, strict=True):
        assert project(read, rays) == pytest.approx(project(wrote, rays), abs=1e-9)
    same_block(bring_to(found, "EPSG:32636"), cameras, 3e-9)
    names = {path.name for path in (tmp_path / "m").iterdir()}
    assert names == {"cameras.bin", "images.bin", "points3D.bin", "georeference.json"}


def test_the_default_offset_is_near_the_block(tmp_path):
    write_colmap(tmp_path, small_block())
    place = json.loads((tmp_path / "georeference.json").read_text())
    assert place == {
        "crs": "EPSG:32636", "offset_m": [320000.0, 3842800.0, 0.0], "written_by": "pcfix"
    }  # fmt: skip


def test_colmap_reads_it(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    cameras = small_block(tuple(LENSES.values()), k=16)
    ties = some_ties(cameras)
    offset = np.array([319900.0, 3842700.0, 0.0])
    write_colmap(tmp_path, cameras, ties, offset_m=tuple(offset))
    model = pycolmap.Reconstruction(str(tmp_path))
    assert len(model.points3D) == len(ties.xyz)
    rays = np.random.default_rng(1).uniform([-0.3, -0.3, 1], [0.3, 0.3, 1], (20, 3))
    for i, label in enumerate(cameras.labels):
        image = model.images[i + 1]
        assert image.name == label
        assert image.projection_center() == pytest.approx(cameras.centres[i] - offset, abs=1e-9)
        matrix = image.cam_from_world().rotation.matrix()
        assert matrix == pytest.approx(cameras.rotations[i], abs=1e-12)
        lens = model.cameras[image.camera_id]
        seen = np.array([lens.img_from_cam(ray) for ray in rays])
        # COLMAP itself must see what the lens sees
        assert seen == pytest.approx(project(cameras.lenses[i], rays), abs=1e-7)
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


@pytest.mark.parametrize("name", LENSES)
def test_the_simplest_model_that_is_the_lens(tmp_path, name):
    assert colmap_camera(tmp_path, LENSES[name]).model.name == name


@pytest.mark.parametrize(
    "lens",
    [
        Lens(1500.0, *FRAME, b2=0.1),
        Lens(1500.0, *FRAME, radial=(0.1, 0.01, 0.001, 1e-4)),
        Lens(1500.0, *FRAME, tangential=(1e-3, 1e-3, 1e-4)),
        Lens(1500.0, *FRAME, radial=(0.1,), inverse=True),
        Lens(1500.0, *FRAME, radial=(0.1,), distortion_centre=(0.01, 0.0)),
        Lens(1500.0, *FRAME, projection="polynomial", shape=(0.0, 1.0)),
        Lens(1500.0, *FRAME, projection="fov", shape=(0.9,), radial=(0.1,)),
        Lens(1500.0, *FRAME, thin_prism=(1e-3,)),
        Lens(3.6, 3.8, 2.8, 1.9, 1.4, unit="mm"),
    ],
)
def test_a_lens_that_no_model_holds(tmp_path, lens):
    with refused("output.lens"):
        write_colmap(tmp_path / "m", small_block((lens,)))
    assert not (tmp_path / "m").exists()


def test_points_that_nothing_can_hold_are_left_out(tmp_path):
    xyz = np.array([[1.0, 2, 3], [np.nan] * 3, [4.0, 5, 6], [7.0, 8, 9]])
    views = Views(np.array([0, 2, 4, 4, 6]), np.array([0, 1, 0, 1, 2, 0]))
    uv = np.arange(12.0).reshape(6, 2)
    write_colmap(tmp_path, small_block(), TiePoints(xyz, views, uv), offset_m=(0, 0, 0))
    found = read_tie_points(tmp_path, read_cameras(tmp_path))
    assert found.xyz.tolist() == [[1.0, 2, 3], [7.0, 8, 9]]
    assert found.views.start.tolist() == [0, 2, 4]
    assert sorted(zip(found.views.camera[2:], found.image_xy[2:, 0], strict=True)) == [
        (0, 10),
        (2, 8),
    ]


def test_a_block_without_tie_points(tmp_path):
    cameras = small_block()
    write_colmap(tmp_path, cameras)
    same_block(read_cameras(tmp_path), cameras)
    with refused("cameras.no_tie_points"):
        read_tie_points(tmp_path, cameras)


def test_nothing_is_replaced_unasked(tmp_path):
    (tmp_path / "points3D.bin").write_text("mine")
    with pytest.raises(SettingError):
        write_colmap(tmp_path, small_block())
    assert [path.name for path in tmp_path.iterdir()] == ["points3D.bin"]


def test_cameras_that_are_not_whole(tmp_path):
    bare = replace(small_block(), lenses=None, rotations=None)
    with refused("output.no_lenses"):
        write_colmap(tmp_path, bare)
    odd = replace(small_block(), labels=("a\nb", *small_block().labels[1:]))
    with refused("output.label"):
        write_colmap(tmp_path, odd)
    spaced = replace(small_block(), labels=("a b.jpg", *small_block().labels[1:]))
    write_colmap(tmp_path, spaced)
    same_block(read_cameras(tmp_path), spaced)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("{", "cameras.damaged"),
        ('{"written_by": "pcfix"}', "cameras.damaged"),
        ('{"written_by": "pcfix", "crs": null, "offset_m": [1, 2]}', "cameras.damaged"),
        ('{"written_by": "pcfix", "crs": 7, "offset_m": [1, 2, 3]}', "cameras.damaged"),
        ('{"written_by": "pcfix", "crs": "EPSG:1", "offset_m": [1, 2, 3]}', "cameras.crs"),
    ],
)
def test_a_damaged_georeference(tmp_path, text, word):
    write_colmap(tmp_path, small_block())
    (tmp_path / "georeference.json").write_text(text)
    with refused(word):
        read_cameras(tmp_path)


def test_a_georeference_of_others_says_nothing(tmp_path):
    write_colmap(tmp_path, small_block(), offset_m=(1.0, 2.0, 3.0))
    (tmp_path / "georeference.json").write_text('{"offset_m": [1, 2, 3], "crs": "EPSG:32636"}')
    found = read_cameras(tmp_path)
    assert found.crs is None
    assert found.centres == pytest.approx(small_block().centres - [1, 2, 3], abs=2e-9, rel=0.0)


@free
def test_a_real_model_there_and_back(tmp_path):
    cameras = read_cameras(FREE / "sparse")
    ties = read_tie_points(FREE / "sparse", cameras)
    moved = bring_to(cameras, "EPSG:32636", offset_m=(319900.0, 3842700.0, 0.0))
    ties = replace(ties, xyz=ties.xyz + np.array([319900.0, 3842700.0, 0.0]))
    write_colmap(tmp_path, moved, ties)
    found = read_cameras(tmp_path)
    same_block(found, moved)
    same_ties(read_tie_points(tmp_path, found), ties)

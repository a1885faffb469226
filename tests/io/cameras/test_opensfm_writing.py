"""OpenSfM reconstructions that pcfix writes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from pyproj import CRS, Transformer

from pcfix.errors import InputError, SettingError
from pcfix.io.cameras import read_cameras, read_tie_points
from pcfix.io.cameras.georeference import georeference
from pcfix.io.cameras.opensfm.models import opensfm_camera, write_opensfm
from pcfix.lens.imaging import project
from pcfix.model import Lens, TiePoints, Views
from tests.utils.blocks import PLAIN, small_block, some_ties
from tests.utils.codes import refused
from tests.utils.reprojection import bring_to
from tests.utils.shared import needs

FREE, free = needs("rendered_a_free")

FRAME = (1600.0, 1200.0, 810.0, 590.0)
CENTRED = (1600.0, 1200.0, 800.0, 600.0)
FISH = {"projection": "equidistant"}
LENSES = {
    "perspective": Lens(1500.0, *CENTRED, radial=(-0.1, 0.02)),
    "brown": Lens(1500.0, *FRAME, b1=-2.0, radial=(-0.1, 0.02, -0.003), tangential=(1e-3, -2e-3)),
    "fisheye": Lens(800.0, *CENTRED, **FISH, radial=(0.01,)),
    "fisheye_opencv": Lens(800.0, *FRAME, **FISH, b1=0.5, radial=(0.01, 2e-3, 3e-4, 1e-5)),
    "fisheye62": Lens(
        800.0, *FRAME, **FISH, radial=(0.01, 0.0, 0.0, 0.0, 1e-5, 1e-6), tangential=(1e-3, 2e-3)
    ),
    "fisheye624": Lens(800.0, *FRAME, **FISH, thin_prism=(1e-4, 2e-4, 3e-4, 4e-4)),
    "dual": Lens(800.0, *CENTRED, projection="dual", shape=(0.7,), radial=(0.01, 0.002)),
}


def back(path, crs, **more):
    """Return cameras and tie points as `pcfix correct` gets them."""
    read = read_cameras(path)
    ties = read_tie_points(path, read)
    way = georeference(read, crs, **more)
    return way.cameras(read), replace(ties, xyz=way.points(ties.xyz))


def same(found, given, ties=None, given_ties=None):
    assert found.labels == given.labels
    assert found.centres == pytest.approx(given.centres, abs=1e-4, rel=0.0)
    assert found.rotations == pytest.approx(given.rotations, abs=1e-7)
    rays = np.random.default_rng(1).uniform([-0.4, -0.4, 1], [0.4, 0.4, 1], (50, 3))
    for read, wrote in zip(found.lenses, given.lenses, strict=True):
        assert project(read, rays) == pytest.approx(project(wrote, rays), abs=1e-8)
    if given_ties is not None:
        np.testing.assert_allclose(ties.xyz, given_ties.xyz, rtol=0.0, atol=1e-4)
        np.testing.assert_array_equal(ties.views.start, given_ties.views.start)
        np.testing.assert_array_equal(ties.views.camera, given_ties.views.camera)
        np.testing.assert_allclose(ties.image_xy, given_ties.image_xy, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize(
    ("crs", "origin"),
    [
        ("EPSG:32636", (319900.0, 3842700.0, 0.0)),
        ("EPSG:25830", (725400.0, 4369900.0, 120.0)),
        ("EPSG:2154", (652000.0, 6862000.0, 30.0)),
        (CRS("EPSG:32636").to_3d().to_wkt(), (319900.0, 3842700.0, 0.0)),
        ("ENU:34.7,31.2,12.5", (0.0, 0.0, 0.0)),
        ("local", (0.0, 0.0, 0.0)),
    ],
)
def test_there_and_back(tmp_path, crs, origin):
    cameras = small_block(tuple(LENSES.values()), crs, origin, k=8)
    ties = some_ties(cameras, origin)
    path = tmp_path / "reconstruction.json"
    write_opensfm(path, cameras, ties)
    tied = not crs.startswith(("ENU", "local"))
    found = back(path, crs) if tied else (read_cameras(path), read_tie_points(path, cameras))
    same(found[0], cameras, found[1], ties)
    assert (tmp_path / "reference_lla.json").exists() == (crs != "local")
    if not tied:
        assert found[0].crs == crs


def test_the_world_is_topocentric(tmp_path):
    cameras = small_block()
    write_opensfm(tmp_path / "reconstruction.json", cameras)
    read = read_cameras(tmp_path)
    lla = json.loads((tmp_path / "reference_lla.json").read_text())
    step = Transformer.from_pipeline(
        f"+proj=topocentric +ellps=WGS84 +lat_0={lla['latitude']!r} +lon_0={lla['longitude']!r}"
        f" +h_0={lla['altitude']!r}"
    )
    ecef = step.transform(*read.centres.T, direction="INVERSE")
    to_map = Transformer.from_crs("EPSG:4978", CRS("EPSG:32636").to_3d(), always_xy=True)
    assert np.column_stack(to_map.transform(*ecef)) == pytest.approx(cameras.centres, abs=1e-6)
    # the axes at the origin, by differences over 100 m; those at a camera 100 m away differ by
    # the curvature of the earth between the two, 100 m / 6400 km
    steps = np.vstack([np.zeros(3), 100.0 * np.eye(3)])
    ecef = step.transform(*steps.T, direction="INVERSE")
    there = np.column_stack(to_map.transform(*ecef))
    turn = (there[1:] - there[0]).T / 100.0
    assert abs(turn[0, 1]) > 0.01  # the meridian convergence
    u, _, v = np.linalg.svd(turn)
    assert read.rotations == pytest.approx(cameras.rotations @ (u @ v), abs=3e-5)


@pytest.mark.parametrize("name", LENSES)
def test_the_simplest_model_that_is_the_lens(tmp_path, name):
    assert opensfm_camera(tmp_path, LENSES[name])["projection_type"] == name


@pytest.mark.parametrize(
    "lens",
    [
        Lens(1500.0, *FRAME, b2=0.1),
        Lens(1500.0, *FRAME, radial=(0.1, 0.01, 0.001, 1e-4)),
        Lens(1500.0, *FRAME, denominator=(0.1,)),
        Lens(1500.0, *FRAME, radial=(0.1,), inverse=True),
        Lens(800.0, *FRAME, projection="dual", shape=(0.7,)),
        Lens(800.0, *FRAME, projection="equisolid"),
        Lens(800.0, *FRAME, **FISH, tangential=(1e-3, 1e-3), in_turn=True),
        Lens(3.6, 3.8, 2.8, 1.9, 1.4, unit="mm"),
    ],
)
def test_a_lens_that_no_model_holds(tmp_path, lens):
    with refused("output.lens"):
        write_opensfm(tmp_path / "reconstruction.json", small_block((lens,)))
    assert not list(tmp_path.iterdir())


def test_points_that_nothing_can_hold_are_left_out(tmp_path):
    xyz = np.array([[1.0, 2, 3], [np.nan] * 3, [4.0, 5, 6], [7.0, 8, 9]])
    views = Views(np.array([0, 2, 4, 4, 6]), np.array([0, 1, 0, 1, 2, 0]))
    ties = TiePoints(xyz, views, np.arange(12.0).reshape(6, 2))
    write_opensfm(tmp_path / "reconstruction.json", small_block(crs=None, origin=(0, 0, 0)), ties)
    found = read_tie_points(tmp_path, read_cameras(tmp_path))
    assert found.xyz.tolist() == [[1.0, 2, 3], [7.0, 8, 9]]
    assert found.views.start.tolist() == [0, 2, 4]
    assert found.views.camera.tolist() == [0, 1, 0, 2]
    assert found.image_xy[:, 0] == pytest.approx([0.0, 2.0, 10.0, 8.0], abs=1e-9)


def test_heights_need_a_grid_or_are_refused(tmp_path):
    with pytest.raises(InputError):
        write_opensfm(tmp_path / "reconstruction.json", small_block(crs="EPSG:32636+5773"))


@pytest.mark.parametrize("crs", ["EPSG:4979", "EPSG:4978"])
def test_another_kind_of_crs_is_refused(tmp_path, crs):
    with refused("output.crs"):
        write_opensfm(tmp_path / "reconstruction.json", small_block(crs=crs))


def test_blocks_that_opensfm_cannot_key(tmp_path):
    path, cameras = tmp_path / "reconstruction.json", small_block()
    for labels, word in ((("a",) * 6, "output.label"), (("a\tb", *"cdefg"), "output.label")):
        with refused(word):
            write_opensfm(path, replace(cameras, labels=labels))
    with refused("output.no_lenses"):
        write_opensfm(path, replace(cameras, lenses=None))


def test_nothing_is_replaced_unasked(tmp_path):
    path, cameras = tmp_path / "reconstruction.json", small_block((PLAIN,))
    (tmp_path / "reference_lla.json").write_text("{}")
    with pytest.raises(SettingError):
        write_opensfm(path, cameras)
    assert not path.exists()


@free
def test_a_real_block_reprojects_as_before(tmp_path):
    cameras = read_cameras(FREE / "sparse")
    ties = read_tie_points(FREE / "sparse", cameras)
    offset = np.array([319900.0, 3842700.0, 0.0])
    cameras = bring_to(cameras, "EPSG:32636", offset_m=tuple(offset))
    ties = replace(ties, xyz=ties.xyz + offset)
    write_opensfm(tmp_path / "reconstruction.json", cameras, ties)
    found = back(tmp_path, "EPSG:32636")
    same(found[0], cameras, found[1], ties)
    for i in (0, len(cameras) // 2):
        point = np.repeat(np.arange(len(ties.xyz)), np.diff(ties.views.start))
        point = point[ties.views.camera == i]
        seen = [
            project(c.lenses[i], (t.xyz[point] - c.centres[i]) @ c.rotations[i].T)
            for c, t in ((cameras, ties), found)
        ]
        np.testing.assert_allclose(seen[0], seen[1], rtol=0.0, atol=1e-4)

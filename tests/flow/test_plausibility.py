"""Cameras, clouds and water that do not belong together are noticed."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pcfix
from pcfix.flow.inputs import Inputs
from pcfix.flow.plausibility import CloudSample, plausible
from pcfix.flow.poses import quick_ties
from pcfix.flow.surfaces import view_of
from pcfix.io.las.source import read_xyz
from tests.utils.codes import refused, warned
from tests.utils.shared import SCENE, needs

RENDERED, rendered = needs("rendered_a")
LEVEL_M = 0.37


@pytest.fixture(scope="module")
def scene():
    cameras = pcfix.read_cameras(SCENE / "cameras.csv")
    return SimpleNamespace(cameras=cameras, xyz=read_xyz(SCENE / "cloud.laz"), ties=None)


@pytest.fixture(scope="module")
def with_ties():
    offset = tuple(np.loadtxt(RENDERED / "offset.txt"))
    inputs = Inputs(cameras=RENDERED / "colmap", water=LEVEL_M, cameras_offset=offset)
    cameras, ties = inputs.block("EPSG:32636")[0], quick_ties(inputs, "EPSG:32636")
    return SimpleNamespace(cameras=cameras, xyz=read_xyz(RENDERED / "cloud.las")[::8], ties=ties)


def moved(block, *by):
    return replace(block.cameras, centres=block.cameras.centres + np.array(by))


def turned(block, degrees):
    """Turn every camera about the vertical, clockwise."""
    turn = Rotation.from_euler("z", -degrees, degrees=True).as_matrix()
    return replace(block.cameras, rotations=block.cameras.rotations @ turn.T)


def in_radians(block):
    """The table with its angles in radians, read as degrees."""
    up = np.diag([1.0, -1.0, -1.0])
    to_world = np.swapaxes(up @ block.cameras.rotations, 1, 2)
    angles = np.radians(Rotation.from_matrix(to_world).as_euler("ZXY", degrees=True))
    read = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    return replace(block.cameras, rotations=up @ np.swapaxes(read, 1, 2))


FAULTS = {
    "47 m too high": lambda b: moved(b, 0, 0, 47),
    "47 m too low": lambda b: moved(b, 0, 0, -47),
    "feet": lambda b: replace(b.cameras, centres=b.cameras.centres / [1.0, 1.0, 0.3048]),
    "radians": in_radians,
    "yaw + 90": lambda b: turned(b, 90),
    "yaw + 180": lambda b: turned(b, 180),
    "40 m beside": lambda b: moved(b, 40, 0, 0),
}
# Of the sample scene, which has neither tie points nor GNSS positions.
DOUBTED = {
    "47 m too low": "cameras.no_overlap",
    "yaw + 180": "cameras.yaw",
    "radians": "cameras.yaw",
}
UNCHECKED = {
    "47 m too high": "heights (no tie points; cameras 129 m above the cloud)",
    "feet": "heights (no tie points; cameras 26",
    "yaw + 90": "yaw (the images are across the flight lines)",
    "40 m beside": "a shift in plan (no GNSS positions)",
}


def codes(found):
    return [problem.code for problem in found.problems]


def test_good_block(scene):
    found = plausible(scene.cameras, scene.xyz)
    assert not found.problems
    assert (len(found.fits), len(found.unchecked)) == (2, 2)
    bare = plausible(replace(scene.cameras, rotations=None, lenses=None), scene.xyz)
    assert not bare.fits
    listed = plausible(scene.cameras, scene.xyz, listed=True)
    assert len(listed.fits) == 3


@pytest.mark.parametrize("fault", FAULTS)
def test_faults(scene, fault):
    """Each is noticed, or the test that would notice it is listed as not checked."""
    found = plausible(FAULTS[fault](scene), scene.xyz)
    if fault in DOUBTED:
        assert DOUBTED[fault] in codes(found)
    else:
        assert not found.problems
        assert UNCHECKED[fault] in ", ".join(found.unchecked)


@rendered
@pytest.mark.parametrize("fault", [None, *FAULTS])
def test_residuals_of_tie_points(with_ties, fault):
    cameras = FAULTS[fault](with_ties) if fault else with_ties.cameras
    found = codes(plausible(cameras, with_ties.xyz, with_ties.ties))
    assert ("cameras.residuals" in found) is bool(fault), found


@rendered
def test_residuals_of_one_image(with_ties):
    """The median of the block does not show it."""
    turns = with_ties.cameras.rotations.copy()
    turns[3] = turns[3] @ Rotation.from_euler("x", 10, degrees=True).as_matrix()
    cameras = replace(with_ties.cameras, rotations=turns)
    (problem,) = plausible(cameras, with_ties.xyz, with_ties.ties).problems
    assert (problem.code, problem.values["image"]) == ("cameras.residuals", cameras.labels[3])


@rendered
def test_heights_of_tie_points(with_ties):
    """Cameras and tie points moved alike: an offset, or another datum."""
    ties = replace(with_ties.ties, xyz=with_ties.ties.xyz + np.array([0.0, 0.0, 47.0]))
    found = plausible(moved(with_ties, 0, 0, 47), with_ties.xyz, ties)
    (off_m,) = (one.values["off_m"] for one in found.problems if one.code == "cameras.height")
    assert off_m == pytest.approx(47.0, abs=0.05)


def sample_of(path, above_m):
    """Return the sample of a cloud under water that is this much above `LEVEL_M`."""
    sample, row, view = CloudSample(), 0, view_of(path)
    for points in view.chunks():
        water = np.full(len(points.xyz), LEVEL_M + above_m)
        sample += CloudSample.of(points, water, row, view.points)
        row += len(points.xyz)
    return sample


@pytest.mark.parametrize(("off_m", "found_m"), [(0.0, []), (3.0, [-3.03])])
def test_shoreline_of_the_cloud(off_m, found_m):
    problems = sample_of(SCENE / "cloud.laz", off_m).level_notes()
    assert [problem.code for problem in problems] == ["water.shoreline_level"] * len(found_m)
    assert [problem.values["off_m"] for problem in problems] == pytest.approx(found_m, abs=0.005)


# Cameras and clouds that belong together, and the water if there is a shore.
REAL = {
    "river": ("river/cameras.csv", "river/points.las", None),
    "a as table": ("rendered_a/cameras.csv", "rendered_a/cloud.las", LEVEL_M),
    "a, absorbed": ("rendered_a_free/cameras.xml", "rendered_a_free/cloud.las", LEVEL_M),
    "c": ("rendered_c/cameras.xml", "rendered_c/cloud.las", LEVEL_M),
    "c, absorbed": ("rendered_c_free/cameras.xml", "rendered_c_free/cloud.las", LEVEL_M),
    "ODM": (
        "cameras/odm/testerarm_sub0",
        "cameras/odm/testerarm_sub0/odm_georeferencing/odm_georeferenced_model.laz",
        None,
    ),
}


@rendered
@pytest.mark.filterwarnings("default::pcfix.PcfixWarning")
@pytest.mark.parametrize("name", REAL)
def test_real_blocks(name):
    cameras, cloud, level = REAL[name]
    path, view = RENDERED.parent / cameras, view_of(RENDERED.parent / cloud)
    inputs = Inputs(cameras=path, water=0.0)
    above_m = np.nan if level is None else level - LEVEL_M
    sample = sample_of(RENDERED.parent / cloud, above_m)
    ties = quick_ties(inputs, view.crs)
    block = inputs.block(view.crs)[0]
    found = plausible(block, sample.rows[:, :3], ties, file=path)
    assert not found.problems and not sample.level_notes()
    assert found.fits[0].startswith("100 % of the points")


@rendered
def test_gnss_positions():
    cameras = Inputs(cameras=RENDERED / "cameras.xml", water=LEVEL_M).block("EPSG:32636")[0]
    xyz = read_xyz(RENDERED / "cloud.las")[::50]
    assert "positions 1.6 m in plan from their GNSS" in plausible(cameras, xyz).fits
    shifted = replace(cameras, centres=cameras.centres + np.array([40.0, 0.0, 0.0]))
    assert codes(plausible(shifted, xyz)) == ["cameras.no_overlap", "cameras.gnss"]


@pytest.mark.parametrize("drone_m", [78.0, 33.0, 130.0])
def test_recorded_heights(scene, tmp_path, drone_m):
    """As DJI writes them, beside the camera file; the cameras are 80 m above the water."""
    (tmp_path / "images").mkdir()
    for label in scene.cameras.labels:
        xmp = f'\xff\xd8 <rdf drone-dji:RelativeAltitude="{drone_m:+.2f}" drone-dji:Roll="0">'
        (tmp_path / "images" / label).write_bytes(xmp.encode("latin-1"))
    found = plausible(scene.cameras, scene.xyz, file=tmp_path / "cameras.csv", water_m=LEVEL_M)
    assert codes(found) == ([] if drone_m == 78.0 else ["cameras.flying_height"])
    assert not any(one.startswith("heights") for one in found.unchecked)


def test_great_depths(scene):
    some = scene.xyz[::10], scene.cameras
    with refused("water.too_deep"):
        pcfix.correct_points(*some, 45.0, method="snell")
    with warned("water.deep"):
        deep = pcfix.correct_points(*some, 45.0, method="snell", deep=True)
    with warned("water.deep"):
        pcfix.correct_points(*some, 30.0, method="snell")
    assert deep.corrected.all()

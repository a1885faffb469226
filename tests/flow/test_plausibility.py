"""What does not belong together is said: a table of faults and their sentences."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pcfix
from pcfix.flow.diagnosis import quick_ties
from pcfix.flow.inputs import Inputs
from pcfix.flow.plausibility import CloudSample, plausible
from pcfix.flow.surfaces import file_points, view_of
from pcfix.io.las.source import read_xyz
from tests.utils.shared import ROOT, needs

SCENE = ROOT / "samples" / "scene"
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


def in_feet(block):
    return replace(block.cameras, centres=block.cameras.centres / [1.0, 1.0, 0.3048])


def in_radians(block):
    """The table with its angles in radians, read as degrees."""
    up = np.diag([1.0, -1.0, -1.0])
    to_world = np.swapaxes(up @ block.cameras.rotations, 1, 2)
    angles = np.radians(Rotation.from_matrix(to_world).as_euler("ZXY", degrees=True))
    read = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    return replace(block.cameras, rotations=up @ np.swapaxes(read, 1, 2))


def half_elsewhere(block):
    centres = block.cameras.centres.copy()
    centres[::2, :2] += 3.3e6
    return replace(block.cameras, centres=centres)


ALONE = {
    "47 m too low": (lambda b: moved(b, 0, 0, -47), "fewer than two frames"),
    "yaw + 180": (lambda b: turned(b, 180), "point 180 degrees"),
    "radians": (in_radians, "read as radians"),
    "half of another place": (half_elsewhere, "20 of 40 cameras stand more than 50 km"),
}
BY_TIES = {
    "47 m too high": lambda b: moved(b, 0, 0, 47),
    "47 m too low": lambda b: moved(b, 0, 0, -47),
    "feet": in_feet,
    "radians": in_radians,
    "yaw + 90": lambda b: turned(b, 90),
    "yaw + 180": lambda b: turned(b, 180),
    "40 m beside": lambda b: moved(b, 40, 0, 0),
}


def test_images_across_the_flight_lines_are_said_not_to_be_tested(scene):
    """As cameras are mounted in aircraft, so that the base runs along the short side."""
    found = plausible(turned(scene, 90), scene.xyz)
    assert "yaw (the images lie across the flight lines)" in found.unchecked


def test_a_good_block_says_what_was_tested(scene):
    found = plausible(scene.cameras, scene.xyz)
    assert not found.doubts
    assert str(found) == (
        "cameras and cloud fit; tested: 100 % of the points in two frames or more, yaw along the"
        " flight lines; not checked: heights (no tie points)"
    )
    bare = replace(scene.cameras, rotations=None, lenses=None)
    assert str(plausible(bare, scene.xyz)).startswith("nothing was tested; not checked: frames")


@pytest.mark.parametrize("fault", ALONE)
def test_cameras_that_do_not_belong(scene, fault):
    change, sentence = ALONE[fault]
    found = plausible(change(scene), scene.xyz)
    assert sentence in " ".join(found.doubts)
    assert str(found).startswith("in doubt, see the warnings")


@rendered
def test_tie_points_of_a_good_block(with_ties):
    found = plausible(with_ties.cameras, with_ties.xyz, with_ties.ties)
    assert not found.doubts
    assert "tie points in their image places" in str(found)


@rendered
@pytest.mark.parametrize("fault", BY_TIES)
def test_tie_points_tell_of_poses(with_ties, fault):
    found = plausible(BY_TIES[fault](with_ties), with_ties.xyz, with_ties.ties)
    assert "frame's width from their image places" in " ".join(found.doubts)


@rendered
def test_tie_points_tell_of_heights(with_ties):
    """Cameras and tie points moved alike: an offset, or another datum."""
    ties = replace(with_ties.ties, xyz=with_ties.ties.xyz + np.array([0.0, 0.0, 47.0]))
    found = plausible(moved(with_ties, 0, 0, 47), with_ties.xyz, ties)
    assert "The tie points of the cameras lie 47.0 m above the cloud" in " ".join(found.doubts)


@pytest.mark.parametrize(("off_m", "says"), [(0.0, ""), (3.0, "3.03 m below")])
def test_the_shoreline_of_the_cloud_speaks_against_a_level(off_m, says):
    sample = CloudSample(view_of(SCENE / "cloud.laz").points)
    for points in file_points(SCENE / "cloud.laz", None):
        sample.add(points, np.full(len(points.xyz), LEVEL_M + off_m))
    doubts = " ".join(sample.level_doubts())
    assert says in doubts
    assert bool(doubts) == bool(says)


@pytest.mark.parametrize("chunk", [100, 7000])
def test_a_sample_does_not_depend_on_chunks(scene, chunk):
    sample = CloudSample(60_000)
    for start in range(0, 20_000, chunk):
        xyz = scene.xyz[start : start + chunk]
        sample.add(SimpleNamespace(xyz=xyz, colours=None), np.zeros(len(xyz)))
    assert np.array_equal(sample.xyz, scene.xyz[::2])


def test_depths_that_are_not_seen_through_water(scene):
    some = scene.xyz[::10], scene.cameras
    with pytest.raises(pcfix.GeometryError, match=r"deeper than 60 m.*no point is left as"):
        pcfix.correct_points(*some, 45.0, method="snell")
    with pytest.warns(pcfix.PcfixWarning, match="deeper than 30 m"):
        deep = pcfix.correct_points(*some, 45.0, method="snell", deep=True)
    with pytest.warns(pcfix.PcfixWarning, match="deeper than 30 m"):
        pcfix.correct_points(*some, 30.0, method="snell")
    assert deep.corrected.all()

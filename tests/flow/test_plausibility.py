"""What does not belong together is said: a table of faults and their sentences."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pcfix
from pcfix.flow.diagnosis import quick_ties
from pcfix.flow.inputs import Inputs
from pcfix.flow.plausibility import CloudSample, Flight, plausible
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


FAULTS = {
    "47 m too high": lambda b: moved(b, 0, 0, 47),
    "47 m too low": lambda b: moved(b, 0, 0, -47),
    "feet": in_feet,
    "radians": in_radians,
    "yaw + 90": lambda b: turned(b, 90),
    "yaw + 180": lambda b: turned(b, 180),
    "40 m beside": lambda b: moved(b, 40, 0, 0),
    "half of another place": half_elsewhere,
}
DOUBTED = {
    "47 m too low": "fewer than two frames",
    "yaw + 180": "point 180 degrees",
    "radians": "read as radians",
    "half of another place": "20 of 40 cameras stand more than 50 km",
}
"""Of the sample scene, which has neither tie points nor positions of the GNSS."""
UNCHECKED = {
    "47 m too high": "heights (no tie points; by them 129 m above the cloud)",
    "feet": "heights (no tie points; by them 26",
    "yaw + 90": "yaw (the images lie across the flight lines)",
    "40 m beside": "a shift in plan (the frames reach far beyond the cloud)",
}


def test_a_good_block_says_what_was_tested(scene):
    found = plausible(scene.cameras, scene.xyz)
    assert not found.doubts
    assert str(found) == (
        "cameras and cloud fit; tested: 100 % of the points in two frames or more, yaw along the"
        " flight lines; not checked: a shift in plan (the frames reach far beyond the cloud),"
        " heights (no tie points; by them 82 m above the cloud)"
    )
    bare = replace(scene.cameras, rotations=None, lenses=None)
    assert str(plausible(bare, scene.xyz)).startswith("nothing was tested; not checked: frames")


@pytest.mark.parametrize("fault", FAULTS)
def test_cameras_that_do_not_belong(scene, fault):
    """Each is doubted, or what it would show in is said not to be checked."""
    found = plausible(FAULTS[fault](scene), scene.xyz)
    assert (fault in DOUBTED) == bool(found.doubts)
    if found.doubts:
        assert DOUBTED[fault] in " ".join(found.doubts)
        assert str(found).startswith("in doubt, see the warnings")
    else:
        assert UNCHECKED[fault] in ", ".join(found.unchecked)


@rendered
def test_tie_points_of_a_good_block(with_ties):
    found = plausible(with_ties.cameras, with_ties.xyz, with_ties.ties)
    assert not found.doubts
    assert "tie points in their image places" in str(found)


@rendered
@pytest.mark.parametrize("fault", FAULTS)
def test_tie_points_tell_of_poses(with_ties, fault):
    found = plausible(FAULTS[fault](with_ties), with_ties.xyz, with_ties.ties)
    said = "frame's width from their image places"
    assert (said if fault != "half of another place" else "50 km") in " ".join(found.doubts)


@rendered
def test_tie_points_tell_of_heights(with_ties):
    """Cameras and tie points moved alike: an offset, or another datum."""
    ties = replace(with_ties.ties, xyz=with_ties.ties.xyz + np.array([0.0, 0.0, 47.0]))
    found = plausible(moved(with_ties, 0, 0, 47), with_ties.xyz, ties)
    assert "The tie points of the cameras lie 47.0 m above the cloud" in " ".join(found.doubts)


@pytest.mark.parametrize(
    ("off_m", "north", "says"),
    [(0.0, 0.0, ""), (3.0, 0.0, "3.03 m below"), (0.0, 0.01, "rises to the south")],
)
def test_the_shoreline_of_the_cloud_speaks_against_a_level(off_m, north, says):
    sample = CloudSample(view_of(SCENE / "cloud.laz").points)
    for points in file_points(SCENE / "cloud.laz", None):
        up = points.xyz[:, 1] - 4_650_320.0
        sample.add(points, LEVEL_M + off_m + north * up)
    doubts = " ".join(sample.level_doubts())
    assert says in doubts
    assert bool(doubts) == bool(says)


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
"""Cameras and clouds that belong together, and the water where there is a shore."""


@rendered
@pytest.mark.filterwarnings("default::pcfix.PcfixWarning")
@pytest.mark.parametrize("name", REAL)
def test_no_real_block_is_accused(name):
    cameras, cloud, level = REAL[name]
    path, view = RENDERED.parent / cameras, view_of(RENDERED.parent / cloud)
    inputs = Inputs(cameras=path, water=0.0)
    sample = CloudSample(view.points)
    for points in file_points(RENDERED.parent / cloud, None):
        sample.add(points, np.full(len(points.xyz), np.nan if level is None else level))
    ties, flight = quick_ties(inputs, view.crs), Flight(path, level, every=sample.every)
    block = inputs.block(view.crs)[0]
    found = plausible(block, sample.xyz, ties, sample.level_doubts(), flight)
    assert not found.doubts
    assert str(found).startswith("cameras and cloud fit; tested: 100 % of the points")


@rendered
def test_positions_of_the_gnss_tell_of_shifts():
    cameras = Inputs(cameras=RENDERED / "cameras.xml", water=LEVEL_M).block("EPSG:32636")[0]
    xyz = read_xyz(RENDERED / "cloud.las")[::50]
    assert "positions 1.6 m in plan from their GNSS" in plausible(cameras, xyz).fits
    beside = replace(cameras, centres=cameras.centres + np.array([40.0, 0.0, 0.0]))
    doubts = " ".join(plausible(beside, xyz).doubts)
    assert "m in plan from the positions that their GNSS recorded (median of 32)" in doubts
    assert "points lie in fewer than two frames" in doubts


@rendered
def test_points_closer_than_pixels_tell_of_feet(with_ties):
    """A cloud of about a point a pixel, of which some are here."""
    every = Flight(every=8.0 * 25.0)
    assert not plausible(with_ties.cameras, with_ties.xyz, flight=every).doubts
    doubts = plausible(in_feet(with_ties), with_ties.xyz, flight=every).doubts
    assert "points for each pixel of 16.8 cm" in " ".join(doubts)


def test_listed_images_that_hold_their_points_are_a_test(scene):
    """Lists of which they do not are refused when they are read."""
    found = plausible(scene.cameras, scene.xyz, flight=Flight(listed=True))
    assert "listed points in the frames of their images" in found.fits


@pytest.mark.parametrize(
    ("drone_m", "says"),
    [(78.0, ""), (33.0, "which would be 47 m above the water"), (130.0, "50 m below the water")],
)
def test_drones_record_their_heights(scene, tmp_path, drone_m, says):
    """As DJI writes them, beside the camera file."""
    (tmp_path / "images").mkdir()
    for label in scene.cameras.labels:
        xmp = f'\xff\xd8 <rdf drone-dji:RelativeAltitude="{drone_m:+.2f}" drone-dji:Roll="0">'
        (tmp_path / "images" / label).write_bytes(xmp.encode("latin-1"))
    found = plausible(scene.cameras, scene.xyz, flight=Flight(tmp_path / "cameras.csv", LEVEL_M))
    assert says in " ".join(found.doubts)
    assert bool(found.doubts) == bool(says)
    assert says or "heights as recorded in flight, from a take-off 2 m above" in str(found)
    assert "heights (no tie points" not in str(found)


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

"""One block of cameras in the files of every package gives one corrected cloud.

The files are written by `tests.utils.pose_files`, which shares nothing with the readers. A
corrected point depends on the projection centres of its rays, and on the angles and the lens only
through the question whose frames hold it. So two things are asked: that nearly every point has as
many rays, and that the points which do agree to the rounding of the LAS file. A reading with a
wrong turn fails the first, one with wrong positions the second.
"""

import csv
import warnings
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np
import pytest
from pyproj import CRS
from scipy.spatial.transform import Rotation

import pcfix
from tests.utils.pose_files import WRITERS
from tests.utils.pose_files.block import Y_UP, Block, convergence
from tests.utils.reprojection import bring_to
from tests.utils.shared import needs

RIVER, river_is_there = needs("river")
EVERY = 20
SAME_RAYS = 0.99
"""Share of points. A point on the border of a frame goes in or out with the last digit of an angle,
and between two datums with the difference of their norths, see OTHER_TURN_DEG."""
STEPS = 2
"""Of the file: each run rounds coordinates once. The scale of the map, 4e-4 beside that of the
ground, does not enter by way of geocentric or topocentric axes either: centres are brought to the
map one by one, and turns at their own centre."""
SAME_PLACE_M, SAME_TURN_DEG = 1e-6, 1e-6
"""Geocentric coordinates have 1e-9 m."""
OTHER_DATUM = {("river", "OpenSfM"), ("river", "BlocksExchange, ENU")}
"""In WGS 84, where the river is in OSGB36."""
OTHER_PLACE_M, OTHER_TURN_DEG, OTHER_POINT_M = 1e-3, 2e-3, 2e-5
"""PROJ's seven parameters and back are 0.9 mm off, as it leaves out the heights. Seen from 30 m
above, points half a metre deep move by 0.01 mm. North in WGS 84 is 4.5 seconds of arc from that of
OSGB36, which the writer does not know: 0.08 px."""


class Scene(NamedTuple):
    """A block, a cloud in its CRS and how to correct that, and the corrected cloud."""

    name: str
    block: Block
    cloud: Path
    step: np.ndarray
    options: dict
    xyz: np.ndarray
    rays: np.ndarray


def corrected(cloud, out, options):
    """Return coordinates and ray counts of a corrected file, and what was warned of.

    The other dimensions, which take longer, are left out unless they are asked for.
    """
    how = {"method": "snell", "max_angle": None, "dimensions": "minimal", **options}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", pcfix.PcfixWarning)
        pcfix.correct_file(cloud, out, **how)
    las = laspy.read(out)
    said = [str(w.message) for w in caught if issubclass(w.category, pcfix.PcfixWarning)]
    return np.asarray(las.xyz), np.asarray(las.RayCount), said


def river(folder):
    """The real river, from the table of pyBathySfM; some labels are there twice, so they change."""
    with (RIVER / "cameras.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    centres = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
    angles = np.array([[float(row[name]) for name in ("yaw", "pitch", "roll")] for row in rows])
    to_world = Rotation.from_euler("ZXY", angles * [-1.0, 1.0, 1.0], degrees=True).as_matrix()
    labels = tuple(f"{i:02d}_{row['Label']}" for i, row in enumerate(rows))
    turns = Y_UP @ to_world.transpose(0, 2, 1)
    block = Block(labels, centres, turns, 3648.0, 5472, 3648, 27700)
    las = laspy.read(RIVER / "points.las")
    las.points = las.points[np.arange(0, len(las.points), EVERY)]
    las.write(folder / "cloud.las")
    options = {"water": "dim:w_surf", "index": 1.337, "max_angle": 35.0}
    return block, options, RIVER / "cameras.csv"


def simulated(folder):
    """A small block with obliques, from its cameras themselves."""
    made = pcfix.simulate_scene(3000, block="oblique", cameras=12)
    cameras, lens = made.cameras, made.cameras.lenses[0]
    block = Block(
        cameras.labels, cameras.centres, cameras.rotations,
        lens.focal, int(lens.width), int(lens.height), made.epsg,
    )  # fmt: skip
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = [1e-5] * 3, made.apparent_xyz.round().mean(axis=0).round()
    header.add_crs(CRS.from_epsg(made.epsg))
    las = laspy.LasData(header)
    las.x, las.y, las.z = made.apparent_xyz.T
    las.write(folder / "cloud.las")
    return block, {"water": made.water_level_m, "max_angle": 35.0}, cameras


@pytest.fixture(
    scope="module", params=[pytest.param("river", marks=river_is_there), "simulated"]
)  # fmt: skip
def scene(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    make = {"river": river, "simulated": simulated}[request.param]
    block, options, cameras = make(folder)
    cloud = folder / "cloud.las"
    xyz, rays, _ = corrected(cloud, folder / "out.las", {**options, "cameras": cameras})
    with laspy.open(cloud) as stream:
        step = stream.header.scales
    return Scene(request.param, block, cloud, step, options, xyz, rays)


def compare(scene, out, options):
    """Return the share of points with as many rays, their largest difference, and warnings."""
    xyz, rays, said = corrected(scene.cloud, out, {**scene.options, **options})
    same = rays == scene.rays
    return same.mean(), np.abs(xyz - scene.xyz)[same].max(axis=0), said


def test_the_reference_corrects_the_cloud(scene):
    with laspy.open(scene.cloud) as stream:
        before = stream.read()
    moved = before.z - scene.xyz[:, 2]
    assert np.quantile(moved, 0.9) > {"river": 0.1, "simulated": 2.0}[scene.name]
    assert len(np.unique(scene.rays[moved > 0])) > 3
    assert (scene.rays > 1).mean() > 0.6


@pytest.mark.parametrize("form", WRITERS)
def test_same_corrected_cloud(scene, form, tmp_path):
    path, options = WRITERS[form](tmp_path, scene.block)
    share, apart, said = compare(scene, tmp_path / "out.las", {"cameras": path, **options})
    print(f"\n{scene.name:>10} {form:<26} {share:8.2%} {1e6 * apart.max():6.1f} um", end="")
    assert share > SAME_RAYS
    if (scene.name, form) in OTHER_DATUM:
        assert (apart < OTHER_POINT_M).all()
        assert len(said) <= 2  # one less where the grid OSTN15 is installed
        assert "does not say what its heights are" in said[-1]
    else:
        assert (apart < STEPS * scene.step).all()
        assert said == []


@pytest.mark.parametrize("form", WRITERS)
def test_same_poses(scene, form, tmp_path):
    block = scene.block
    path, options = WRITERS[form](tmp_path, block)
    crs, offset = (options.pop(name, None) for name in ("cameras_crs", "cameras_offset"))
    read = pcfix.read_cameras(path, **options)
    found = bring_to(read, f"EPSG:{block.epsg}", cameras_crs=crs, offset_m=offset)
    rows = [found.labels.index(label) for label in block.labels]
    assert len(found) == len(rows)
    apart = np.abs(found.centres[rows] - block.centres).max()
    turns = Rotation.from_matrix(found.rotations[rows] @ block.rotations.transpose(0, 2, 1))
    turned_deg = np.degrees(turns.magnitude()).max()
    if (scene.name, form) in OTHER_DATUM:
        assert apart < OTHER_PLACE_M and turned_deg < OTHER_TURN_DEG
    else:
        assert apart < SAME_PLACE_M and turned_deg < SAME_TURN_DEG
    for lens in found.lenses:
        unit = block.width / lens.width  # some files are in mm
        numbers = lens.focal, lens.height, lens.principal_x, lens.principal_y
        expected = block.focal_px, block.height, block.width / 2, block.height / 2
        assert np.array(numbers) * unit == pytest.approx(expected, abs=1e-6)


def turned(block):
    """Angles from north where those from grid north belong, 0.7 degrees."""
    return block._replace(rotations=block.rotations @ convergence(block))


def transposed(block):
    """Camera to world where world to camera belongs."""
    return block._replace(rotations=block.rotations.transpose(0, 2, 1))


def raised(block):
    """Heights above another ellipsoid or geoid."""
    return block._replace(centres=block.centres + np.array([0.0, 0.0, 2.0]))


def moved(block):
    """Another datum."""
    return block._replace(centres=block.centres + np.array([2.0, -1.0, 0.0]))


@pytest.mark.parametrize("wrong", [turned, transposed, raised, moved])
def test_wrong_poses_would_be_noticed(scene, wrong, tmp_path):
    path, options = WRITERS["table, matrices"](tmp_path, wrong(scene.block))
    share, apart, _ = compare(scene, tmp_path / "out.las", {"cameras": path, **options})
    print(
        f"\n{scene.name:>10} {wrong.__name__:<26} {share:8.2%} {1e6 * apart.max():6.1f} um", end=""
    )
    assert share < SAME_RAYS or (apart > 10 * STEPS * scene.step).any()

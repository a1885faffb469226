"""One block of cameras in the files of every package gives the same poses and lenses.

The files are written by `tests.utils.pose_files`, which shares nothing with the readers.
"""

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pcfix
from tests.utils.pose_files import WRITERS
from tests.utils.pose_files.block import Y_UP, Block
from tests.utils.reprojection import bring_to
from tests.utils.shared import needs

RIVER, river_is_there = needs("river")
SAME_PLACE_M, SAME_TURN_DEG = 1e-6, 1e-6
"""Geocentric coordinates have 1e-9 m."""
OTHER_DATUM = {("river", "OpenSfM"), ("river", "BlocksExchange, ENU")}
"""In WGS 84, where the river is in OSGB36."""
OTHER_PLACE_M, OTHER_TURN_DEG = 1e-3, 2e-3
"""PROJ's seven parameters and back are 0.9 mm off, as it leaves out the heights. North in WGS 84 is
4.5 seconds of arc from that of OSGB36, which the writer does not know: 0.08 px."""


def river():
    """The real river, from the table of pyBathySfM; some labels are there twice, so they change."""
    with (RIVER / "cameras.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    centres = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
    angles = np.array([[float(row[name]) for name in ("yaw", "pitch", "roll")] for row in rows])
    to_world = Rotation.from_euler("ZXY", angles * [-1.0, 1.0, 1.0], degrees=True).as_matrix()
    labels = tuple(f"{i:02d}_{row['Label']}" for i, row in enumerate(rows))
    return Block(labels, centres, Y_UP @ to_world.transpose(0, 2, 1), 3648.0, 5472, 3648, 27700)


def simulated():
    """A small block with obliques, from its cameras themselves."""
    made = pcfix.simulate_scene(100, block="oblique", cameras=12)
    cameras, lens = made.cameras, made.cameras.lenses[0]
    frame = lens.focal, int(lens.width), int(lens.height)
    return Block(cameras.labels, cameras.centres, cameras.rotations, *frame, made.epsg)


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("make", [pytest.param(river, marks=river_is_there), simulated])
def test_same_poses(make, form, tmp_path):
    block = make()
    path, options = WRITERS[form](tmp_path, block)
    crs, offset = (options.pop(name, None) for name in ("cameras_crs", "cameras_offset"))
    read = pcfix.read_cameras(path, **options)
    found = bring_to(read, f"EPSG:{block.epsg}", cameras_crs=crs, offset_m=offset)
    rows = [found.labels.index(label) for label in block.labels]
    assert len(found) == len(rows)
    apart = np.abs(found.centres[rows] - block.centres).max()
    turns = Rotation.from_matrix(found.rotations[rows] @ block.rotations.transpose(0, 2, 1))
    turned_deg = np.degrees(turns.magnitude()).max()
    if (make.__name__, form) in OTHER_DATUM:
        assert apart < OTHER_PLACE_M and turned_deg < OTHER_TURN_DEG
        assert "cameras.heights_assumed" in [note.code for note in found.notes]
    else:
        assert apart < SAME_PLACE_M and turned_deg < SAME_TURN_DEG
        assert found.notes == ()
    for lens in found.lenses:
        unit = block.width / lens.width  # some files are in mm
        numbers = lens.focal, lens.height, lens.principal_x, lens.principal_y
        expected = block.focal_px, block.height, block.width / 2, block.height / 2
        assert np.array(numbers) * unit == pytest.approx(expected, abs=1e-6)

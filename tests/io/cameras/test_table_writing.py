"""Tables of poses that pcfix writes."""

from dataclasses import replace

import numpy as np
import pytest
from pyproj import CRS

from pcfix.errors import SettingError
from pcfix.io.cameras import read_cameras
from pcfix.io.cameras.table.sensor import write_table
from pcfix.lens.imaging import project
from pcfix.model import Lens
from tests.utils.blocks import PLAIN, small_block
from tests.utils.codes import refused

FRAME = (1600.0, 1200.0, 810.0, 590.0)
OPENCV = Lens(
    *(1500.0, *FRAME),
    radial=(-0.1, 0.02, -0.003),
    denominator=(0.01, 0.0, 0.002),
    tangential=(1e-3, -2e-3),
)
FOUR = Lens(1400.0, *FRAME, radial=(-0.1, 0.02, -0.003, 1e-4), tangential=(1e-3, -2e-3))
FILM = Lens(3.6, 3.8, 2.8, 1.9, 1.4, unit="mm")


@pytest.mark.parametrize("lenses", [(PLAIN,), (OPENCV,), (FILM,), (PLAIN, FOUR)])
@pytest.mark.parametrize("crs", ["EPSG:32636", CRS("EPSG:32636").to_3d().to_wkt(), None])
def test_there_and_back(tmp_path, lenses, crs):
    cameras = small_block(lenses, crs)
    cameras = replace(cameras, labels=('a, "b".jpg', "c d.jpg", *cameras.labels[2:]))
    write_table(tmp_path / "new", cameras)
    found = read_cameras(tmp_path / "new" / "cameras.csv")
    assert found.labels == cameras.labels
    assert found.crs == crs
    assert found.centres.tolist() == cameras.centres.tolist()
    assert found.rotations == pytest.approx(cameras.rotations, abs=1e-12)
    rays = np.random.default_rng(1).uniform([-0.4, -0.4, 1], [0.4, 0.4, 1], (50, 3))
    for read, wrote in zip(found.lenses, cameras.lenses, strict=True):
        assert project(read, rays) == pytest.approx(project(wrote, rays), abs=1e-9)


@pytest.mark.parametrize(
    ("lenses", "word"),
    [
        ((FOUR,), "output.lens"),
        ((replace(PLAIN, b1=0.1),), "output.lens"),
        ((replace(PLAIN, projection="equidistant"),), "output.lens"),
        ((replace(FILM, radial=(0.1,)),), "output.lens"),
        ((PLAIN, OPENCV), "output.lens"),
        ((PLAIN, replace(PLAIN, width=1700.0)), "output.lens"),
        ((FILM, replace(FILM, focal=3.7)), "output.lens"),
    ],
)
def test_lenses_that_a_table_cannot_hold(tmp_path, lenses, word):
    with refused(word):
        write_table(tmp_path / "new", small_block(lenses))
    assert not (tmp_path / "new").exists()


def test_blocks_that_a_table_cannot_hold(tmp_path):
    with refused("output.no_lenses"):
        write_table(tmp_path, replace(small_block(), lenses=None))
    with refused("output.crs"):
        write_table(tmp_path, small_block(crs="ENU:1,2,3"))


def test_nothing_is_replaced_unasked(tmp_path):
    (tmp_path / "sensor.csv").write_text("mine")
    with pytest.raises(SettingError):
        write_table(tmp_path, small_block())
    assert not (tmp_path / "cameras.csv").exists()

"""GNSS positions beside the projection centres, and too few of them: what is said, and what not."""

from __future__ import annotations

import numpy as np
import pytest

from pcfix.adjust.datum import offset_of
from pcfix.flow.adjust import adjust_cameras
from tests.utils.adjust_files import write_block, write_gnss

pytestmark = pytest.mark.filterwarnings("ignore::pcfix.errors.PcfixWarning")
UP_M = 0.3


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_block(tmp_path_factory.mktemp("block"), points=900)


@pytest.fixture
def adjust(files, tmp_path):
    """Return a function that adjusts with some of the positions, moved."""

    def call(up_m=0.0, rows=slice(None), model="model", **more):
        gnss, labels = files.scene.cameras.gnss, np.array(files.scene.cameras.labels)
        xyz = gnss.xyz + np.array([0.0, 0.0, up_m])
        path = tmp_path / "gnss.csv"
        write_gnss(path, labels[rows], xyz[rows], gnss.sigma_m[rows])
        return adjust_cameras(files.folder / model, water=files.water, gnss=path, **more)

    return call


def said(found, words):
    return [note for note in found.notes if words in note]


def test_an_offset_in_height_is_found_and_said_where_the_lens_is_known(files, adjust):
    """The water level tells it; where the focal length is free that takes it up."""
    lens = files.folder / "lens.csv"
    right, moved = adjust(lens=lens), adjust(UP_M, lens=lens)
    first, second = offset_of(right), offset_of(moved)
    assert second.m - first.m == pytest.approx([0.0, 0.0, UP_M], abs=0.02)
    # as well as the level is known where it is free, which is the same question
    level = adjust(lens=lens, free=("level",)).precision.sigma_of("level")
    assert second.sigma_m[2] == pytest.approx(level, rel=0.05)
    assert abs(first.m[2]) < 3.0 * first.sigma_m[2]
    note = said(moved, "above the projection centres")[0]
    for words in ("0.3", "standard error 0.04 m", "lever arm", "water level that is too low"):
        assert words in note
    assert not said(right, "the projection centres")
    assert offset_of(adjust(UP_M)).sigma_m[2] > 2.0 * second.sigma_m[2]


def test_positions_in_a_line_are_said_to_hold_a_block_weakly(adjust):
    note = said(adjust(rows=slice(0, 3)), "hold the block weakly")[0]
    for words in ("3 GNSS positions and 0 control points", "in a line", "0.18 m", "0.03 m", "more"):
        assert words in note
    assert not said(adjust(), "hold the block")
    assert not said(adjust(rows=[0, 4, 10, 14]), "hold the block")


def test_few_positions_and_the_cloud_alone(files, adjust):
    cloud = files.folder / "cloud.las"
    note = said(adjust(rows=[0, 4, 14], model="bare", cloud=cloud), "how much the cloud counts")[0]
    assert "only 3 GNSS positions and 0 control points" in note

"""GNSS positions with an offset, too few of them, or on a line."""

import numpy as np
import pytest

import pcfix
from pcfix.adjust.methods import height_offset
from pcfix.flow.adjust import adjust_cameras
from tests.utils.adjust_files import write_block, write_gnss
from tests.utils.block_kinds import write_kind

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


def note_of(found, code):
    return next((one for one in found.notes if one.code == code), None)


def test_offset(files, adjust):
    """The water level shows it; a free focal length absorbs it."""
    lens = files.folder / "lens.csv"
    right, moved = adjust(lens=lens), adjust(UP_M, lens=lens)
    (first, sigma), (second, sigma_m) = height_offset(right), height_offset(moved)
    assert second - first == pytest.approx(UP_M, abs=0.02)
    # as well as the level is known where it is free, which is the same question
    level = adjust(lens=lens, free=("level",)).precision.sigma_of("level")
    assert sigma_m == pytest.approx(level, rel=0.05)
    assert abs(first) < 3.0 * sigma
    note = note_of(moved, "gnss.offset_found")
    assert note.values["offset_m"] == pytest.approx(UP_M, abs=0.1)
    assert note.values["sigma_m"] == pytest.approx(0.04, abs=0.005)
    assert "a water level that is too low" in str(note)
    assert note_of(right, "gnss.offset_found") is None
    assert height_offset(adjust(UP_M))[1] > 2.0 * sigma_m


def test_few_positions_and_the_cloud(files, adjust):
    cloud = files.folder / "cloud.las"
    note = note_of(adjust(rows=[0, 4, 14], model="bare", cloud=cloud), "gnss.few")
    assert note.values == {"gnss": 3, "control": 0}


@pytest.fixture(scope="module")
def strip(tmp_path_factory):
    """A single strip whose adjustment without water had a full lens, and its true cameras."""
    folder = tmp_path_factory.mktemp("strip")
    write_kind(folder, "single strip", 4, points=700, cloud=10)
    found = adjust_cameras(folder / "model", water=0.0, gnss=folder / "gnss.csv")
    return found, pcfix.read_cameras(folder / "true")


def test_strip(strip):
    """The principal point is hardly determined; fixing it would bend the bed by 20 GSD."""
    found, true = strip
    before, after, truth = (c.lenses[0] for c in (found.block.cameras, found.cameras, true))
    assert abs(before.principal_y - truth.principal_y) > 20.0
    # standard errors: four of a normal distribution, which chance exceeds once in 16,000
    for name in ("principal_x", "principal_y", "focal"):
        sigma = found.precision.sigma_of({"focal": "f"}.get(name, f"c{name[-1]}"))
        assert abs(getattr(after, name) - getattr(truth, name)) < 4.0 * sigma
    off = (found.cameras.centres - true.centres) / found.precision.centre_sigma_m
    # rms of 42 normalised errors: 1 with a standard deviation of a tenth, more as neighbours agree
    assert np.sqrt((off**2).mean()) < 1.3
    assert note_of(found, "adjust.weak_lens") is None
    assert note_of(found, "gnss.offset_found") is None
    # the positions lie on a line, so the tilt across it is unknown
    assert note_of(found, "adjust.imprecise_bed").values["gsd"] > 1.5

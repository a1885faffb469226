"""Rounds: when they stop, what is kept, and the cloud that stereo pairs give."""

import sys
import warnings

import numpy as np
import pytest

pytest.importorskip("cv2", reason="photographs need the extra 'photos'")

import cv2

import pcfix
from pcfix.errors import SettingError
from pcfix.io.las.writing import write_points
from pcfix.photos.mapping import Ground
from pcfix.photos.ortho import Picture
from pcfix.photos.stereo import pairs_of, stereo_cloud
from tests.photos.test_mapping import GSD_M, photo, relief
from tests.utils.codes import refused
from tests.utils.renderer import Texture, rendered

# Of the cloud that each round's command writes; the first one is 2 m deep.
DEPTHS_M = (2.5, 2.66, 2.71, 2.73)

COMMAND = """
import pathlib, sys, laspy, numpy as np
images, cameras, cloud, notes = map(pathlib.Path, sys.argv[1:])
assert len(list(images.iterdir())) == 2 and cameras.exists()
if (notes / "broken").exists():
    print("reading images"); print("no licence left"); sys.exit(3)
calls = notes / "calls"
done = calls.read_text() if calls.exists() else ""
depth = {depths}[len(done)]
calls.write_text(done + "x")
first = laspy.read(notes / "apparent.laz")
first.z = np.where(np.asarray(first.z) > 0.0, first.z, -depth)
first.write(cloud)
"""


@pytest.fixture
def block(tmp_path):
    """Two photographs of land and flat bed, a command that deepens it, and how to call it."""
    images = tmp_path / "images with space"
    images.mkdir()
    for name in ("P0.png", "P1.png"):
        cv2.imwrite(str(images / name), np.full((60, 80, 3), 99, np.uint8))
    (tmp_path / "cameras.csv").write_text(
        "label,x,y,z,yaw,pitch,roll\nP0.png,-4,0,60,0,0,0\nP1.png,4,0,60,0,0,0\n"
    )
    (tmp_path / "sensor.csv").write_text("focal,sensor_x,sensor_y\n10,8,6\n")
    x, y = (one.ravel() for one in np.meshgrid(np.arange(-29.5, 30), np.arange(-29.5, 30)))
    xyz = np.column_stack([x, y, np.where(x < -20.0, 1.0, -2.0)])
    write_points(tmp_path / "apparent.laz", xyz, ("EPSG:32636", 0.001))
    (tmp_path / "command.py").write_text(COMMAND.format(depths=DEPTHS_M))
    words = [sys.executable, tmp_path / "command.py", "{images}", "{cameras}", "{cloud}", tmp_path]
    how = {
        "cameras": tmp_path / "cameras.csv", "dsm": tmp_path / "apparent.laz", "resolution": 1.0,
        "water": 0.0, "mapping": "paper", "rebuild": " ".join(f'"{word}"' for word in words),
    }  # fmt: skip
    return images, tmp_path / "out", how


def rounds(block, **more):
    images, out, how = block
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pcfix.rebuild_rounds(images, out, **(how | more))


def calls(block):
    return (block[1].parent / "calls").read_text()


def test_rounds_stop(block):
    # the ground pixel is 0.62 m: 62 m over 100 px
    found = rounds(block, until_gsd=0.04)
    assert found.gsd_m == pytest.approx(0.62, abs=0.01)
    assert [one.mean_m for one in found.rounds] == pytest.approx([-0.5, -0.16, -0.05, -0.02])
    assert found.converged
    assert found.rounds[0].sd_m == pytest.approx(0.0, abs=1e-3)
    assert all(one.within_gsd == 1.0 for one in found.rounds)
    assert len(rounds(block, until_gsd=0.5).rounds) == 2  # the same, and asked for less
    assert not rounds(block, until_gsd=0.001).converged
    assert calls(block) == "xxxx"


def test_resumed(block):
    out = block[1]
    broken = out.parent / "broken"
    first = rounds(block, most_rounds=1)
    broken.touch()
    with refused("rebuild.failed", exit_code=3, round=2):
        rounds(block, until_gsd=0.05, most_rounds=2)
    broken.unlink()
    found = rounds(block, until_gsd=0.05, most_rounds=2)
    assert calls(block) == "xx"
    assert found.done_before == 1
    assert found.rounds[0] == first.rounds[0]
    assert not list(out.parent.glob("*.part*"))


@pytest.mark.parametrize(
    "more", [{"rebuild": "odm {images}"}, {"rebuild": None}, {"until_gsd": 0}, {"most_rounds": 0}]
)
def test_bad_options(block, more):
    with pytest.raises(SettingError):
        rounds(block, **more)


@pytest.mark.nightly
def test_stereo():
    photos = [photo(x, tilt) for x, tilt in ((-8, (2, 1)), (0, (-1, 2)), (8, (1, -2)))]
    assert pairs_of(photos, 0.0) == [(0, 1), (0, 2), (1, 2)]
    texture = Texture(3.0 * GSD_M, 3.0)
    seen = [rendered(one, relief(), texture)[0] for one in photos]
    pictures = [Picture(one, blank=np.zeros(one.shape, bool)) for one in seen]
    ground = relief()
    xyz = stereo_cloud(photos, Ground(*ground), 2.0 * GSD_M, lambda k: pictures[k])
    off = xyz[:, 2] - ground.at(xyz[:, :2])
    assert len(xyz) > 10_000
    # m: a pixel of parallax is 0.5 m at the best base; ledge and boulders are steeper than cells
    assert abs(np.median(off)) < 0.02
    assert np.quantile(np.abs(off), [0.5, 0.95]) == pytest.approx([0.0, 0.0], abs=0.25)

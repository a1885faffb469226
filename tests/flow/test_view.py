"""What `pcfix view` shows: points in the colours of their values, cameras and water in place."""

from __future__ import annotations

import numpy as np
import pytest

import pcfix
from pcfix.errors import PcfixWarning, SettingError
from pcfix.flow import view
from pcfix.io.scenes import write_scene
from pcfix.io.viewer import Scene3d, render
from pcfix.report.view import GREY, Scale


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    write_scene(pcfix.simulate_scene(2000), folder, overwrite=True)
    pcfix.correct_file(
        folder / "cloud.laz", folder / "corrected.laz", cameras=folder / "cameras.csv", water=0.37,
        method="snell",
    )  # fmt: skip
    return folder


@pytest.fixture
def shown(monkeypatch):
    """Catch what would be drawn, as on a machine where open3d cannot draw."""
    caught = []
    monkeypatch.setattr(view, "render", lambda scene, *size: (caught.append(scene), ([], "no"))[1])
    return caught


def test_clouds_cameras_and_water(folder, tmp_path, shown):
    with pytest.warns(PcfixWarning, match=r"cannot draw without a screen here \(no\).*apt-get"):
        said = pcfix.view_clouds(
            [folder / "corrected.laz"], cameras=folder / "cameras.csv", water=0.37,
            reference=folder / "lidar.laz", image=tmp_path / "view.png",
        )  # fmt: skip
    (scene,) = shown
    assert scene.names == ["corrected.laz before", "corrected.laz", "reference lidar.laz"]
    assert said.endswith("by depth")
    assert (tmp_path / "view.png").stat().st_size > 20_000
    before, after, _ = scene.xyz
    grey = (scene.rgb[1] == GREY).all(axis=1)
    assert np.abs(before[grey] - after[grey]).max() < 1e-6
    level = scene.water[0, 2]
    assert np.ptp(scene.water[:, 2]) == 0.0
    assert (grey == (after[:, 2] >= level - 1e-3)).mean() > 0.999
    cameras = pcfix.read_cameras(folder / "cameras.csv")
    assert len(scene.lines) == 8 * len(cameras)
    tops = scene.lines[::8, 0]
    assert tops[:, 2] - level == pytest.approx(cameras.centres[:, 2] - 0.37, abs=1e-6)
    assert (scene.lines[:, 1, 2] < tops.max()).all()  # they look down


@pytest.mark.filterwarnings("ignore:open3d cannot draw")
def test_errors_shrink(folder, tmp_path, shown, monkeypatch):
    values = []
    monkeypatch.setattr(
        Scale, "colours", lambda self, one: (values.append(one), np.ones((len(one), 3)))[1]
    )
    pcfix.view_clouds(
        [folder / "corrected.laz"], reference=folder / "lidar.laz", colour="error",
        image=tmp_path / "view.png",
    )  # fmt: skip
    before, after, target = (
        np.nanmean(np.abs(one)) if np.isfinite(one).any() else None for one in values
    )
    assert before > 1.0
    assert after < 0.2
    assert target is None


@pytest.mark.parametrize(
    ("name", "given", "sentence"),
    [
        ("cloud.laz", {}, "colour depth: no cloud has it; give --water, or a cloud that 'pcfix"),
        ("cloud.laz", {"colour": "uncertainty"}, "no cloud has it; give a cloud that 'pcfix corr"),
        ("cloud.laz", {"colour": "error"}, "is the height above a reference; give --reference too"),
        ("corrected.laz", {}, "there is no screen to open a viewer on; give --image"),
    ],
)
def test_refused(folder, monkeypatch, name, given, sentence):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(SettingError, match=sentence):
        pcfix.view_clouds([folder / name], **given)


def test_open3d_draws_off_the_screen():
    """A red cloud about the origin; skipped where open3d has nothing to draw with."""
    xyz = np.random.default_rng(0).uniform(-1.0, 1.0, (20_000, 3))
    red = np.tile([1.0, 0.0, 0.0], (len(xyz), 1))
    nothing = np.zeros((0, 3))
    scene = Scene3d(["a"], [xyz], [red], np.zeros((0, 2, 3)), nothing, nothing.astype(int))
    images, why = render(scene, 80, 60)
    if not images:
        pytest.skip(why)
    (image,) = images
    assert image.shape == (60, 80, 3)
    assert image[30, 40].tolist() == [255, 0, 0]
    assert image[0, 0].tolist() == [255, 255, 255]

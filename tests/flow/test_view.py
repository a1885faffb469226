"""`pcfix view`: points in the colours of their values, cameras and water in place."""

import numpy as np
import pytest

import pcfix
from pcfix.flow import view
from pcfix.flow.demo import write_scene
from pcfix.flow.view import GREY, view_figure
from tests.utils.codes import refused


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    write_scene(pcfix.simulate_scene(2000), folder, overwrite=True)
    pcfix.correct_file(
        folder / "cloud.laz", folder / "corrected.laz", cameras=folder / "cameras.csv", water=0.37,
        method="snell",
    )  # fmt: skip
    return folder


def test_scene(folder, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(view, "view_figure", lambda *a: (drawn.append(a[:2]), view_figure(*a))[1])
    pcfix.view_clouds(
        [folder / "corrected.laz"], cameras=folder / "cameras.csv", water=0.37,
        reference=folder / "lidar.laz", image=tmp_path / "view.png",
    )  # fmt: skip
    ((shown, lines),) = drawn
    assert [one.name for one in shown] == [
        "corrected.laz before",
        "corrected.laz",
        "reference lidar.laz",
    ]
    assert (tmp_path / "view.png").stat().st_size > 20_000
    before, after, _ = (one.xyz for one in shown)
    grey = (shown[1].rgb == GREY).all(axis=1)
    assert np.abs(before[grey] - after[grey]).max() < 1e-6
    water, axes = lines["water"], lines["cameras"]
    level = water[0, 0, 2]
    assert np.ptp(water[..., 2]) == 0.0
    assert (grey == (after[:, 2] >= level - 1e-3)).mean() > 0.999
    cameras = pcfix.read_cameras(folder / "cameras.csv")
    assert axes[:, 0, 2] - level == pytest.approx(cameras.centres[:, 2] - 0.37, abs=1e-6)
    assert (axes[:, 1, 2] < axes[:, 0, 2]).all()  # they look down


@pytest.mark.parametrize(
    ("name", "given", "code"),
    [
        ("cloud.laz", {}, "view.no_values"),
        ("cloud.laz", {"colour": "uncertainty"}, "view.no_values"),
        ("cloud.laz", {"colour": "error"}, "option.missing"),
        ("corrected.laz", {}, "view.no_screen"),
    ],
)
def test_refused(folder, monkeypatch, name, given, code):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with refused(code):
        pcfix.view_clouds([folder / name], **given)

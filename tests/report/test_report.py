"""The page of a run: all inside one file, right values, no script that fails."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import pcfix
from pcfix.flow.report import write_report
from pcfix.grid.maps import MapsBuilder
from pcfix.report.page import Layer, Report, Table, render
from pcfix.report.run import histogram_figure, relief
from tests.utils.browser import needs_browser, open_page

SCENE = Path(__file__).parents[2] / "samples" / "scene"


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Return the folder of a report on the sample scene, and the summary."""
    folder = tmp_path_factory.mktemp("report")
    cloud, cameras = SCENE / "cloud.laz", SCENE / "cameras.csv"
    summary = pcfix.correct_file(
        cloud, folder / "corrected.laz", cameras=cameras, water=0.37, method="snell", max_angle=None
    )
    write_report(
        folder / "corrected.laz", folder, summary=summary,
        cameras=pcfix.read_cameras(cameras), water=pcfix.read_water(0.37), inputs=[cloud, cameras],
    )  # fmt: skip
    return folder, summary


class Elements(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def all(self, tag):
        return [attributes for name, attributes in self.found if name == tag]


def test_page_needs_nothing_outside_itself(report):
    text = (report[0] / "report.html").read_text()
    elements = Elements(text)
    for _, attributes in elements.found:
        for key in ("src", "href", "srcset", "action", "data"):
            if key in attributes:
                assert attributes[key].startswith("data:")
    assert not re.search(r"https?://|@import|url\((?!data:)", text)


def test_every_picture_says_what_it_shows_and_is_a_file_too(report):
    folder, _ = report
    pictures = Elements((folder / "report.html").read_text()).all("img")
    files = sorted((folder / "figures").glob("*.png"))
    assert len(pictures) == len(files) == 5
    assert all(len(picture["alt"]) > 20 for picture in pictures)
    for path in files:
        assert path.read_bytes().startswith(b"\x89PNG")


def test_map_holds_the_values_of_the_cloud(report):
    folder, summary = report
    text = (folder / "report.html").read_text()
    data = json.loads(re.search(r'id="data">(.*?)</script>', text, re.S)[1])
    layers = {layer["name"]: layer for layer in data["layers"]}
    assert list(layers) == ["Depth", "Height", "Shift in Z", "Shift in plan", "Rays"]
    depth = layers["Depth"]
    whole = np.frombuffer(base64.b64decode(depth["values"]), "<i2")
    assert whole.size == data["rows"] * data["columns"]
    values = depth["offset"] + depth["step"] * whole[whole != data["noData"]]
    # cells have about the same number of points each, so their mean is near that of the points
    assert values.mean() == pytest.approx(summary.depth_m["mean"], abs=0.1)
    assert summary.depth_m["min"] - 0.001 <= values.min()
    assert values.max() <= summary.depth_m["max"] + 0.001


def test_figures_of_the_run_are_on_the_page(report):
    folder, summary = report
    text = (folder / "report.html").read_text()
    for word in ("14,736 of 20,000", "12.21 m", "level 0.37 m", "40 of 40", "SHA-256"):
        assert word in text
    assert f"mean {summary.shift_z_m['mean']:.3f} m" in text


@needs_browser
@pytest.mark.parametrize("width", [1000, 360], ids=["desk", "phone"])
def test_scripts_run_without_complaint(report, tmp_path, width):
    done = open_page(report[0] / "report.html", tmp_path, f"--window-size={width},900")
    complaints = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert complaints == []
    assert re.search(r'<output id="value"[^>]*>E 4102\d\d\.\d, N 46503\d\d\.\d: Depth', done.stdout)
    assert done.stdout.count('type="radio"') == 5


@needs_browser
def test_nothing_is_wider_than_a_phone(report, tmp_path):
    text = (report[0] / "report.html").read_text()
    probe = "<script>document.title='width '+document.documentElement.scrollWidth</script></body>"
    page = tmp_path / "probe.html"
    page.write_text(text.replace("</body>", probe))
    done = open_page(page, tmp_path / "profile", "--window-size=500,900")
    assert int(re.search(r"<title>width (\d+)", done.stdout)[1]) <= 500


def test_names_cannot_become_markup():
    maps = MapsBuilder(np.zeros(2), np.ones(2), 10)
    ones = np.ones(10)
    maps.add(np.random.default_rng(1).random((10, 3)), ones, np.zeros((10, 3)), ones, ones > 0)
    evil = "</script><script>alert(1)</script>"
    built = maps.maps()
    page = render(
        Report(evil, evil, Table(evil, [], [[evil, evil]]), [evil], built,
               [Layer(evil, "m", built.depth_m)], [], [Table(evil, [evil], [[evil]])])
    )  # fmt: skip
    assert evil not in page
    assert len(Elements(page).all("script")) == 2


def test_cells_are_means_of_their_points():
    rng = np.random.default_rng(4)
    xyz = rng.uniform((0, 0, -5), (30, 12, 0), (5000, 3)) + np.array([5e5, 4e6, 0.0])
    depth, shift = rng.random(5000), rng.normal(size=(5000, 3))
    rays, moved = rng.integers(2, 9, 5000), rng.random(5000) < 0.6
    builder = MapsBuilder(xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0), 5000)
    for part in np.array_split(np.arange(5000), 3):
        builder.add(xyz[part], depth[part], shift[part], rays[part], moved[part])
    maps = builder.maps()
    west, _, south, north = maps.extent_m
    expected = np.full((*maps.height_m.shape, 2), np.nan)
    for row, column in np.ndindex(*maps.height_m.shape):
        x, y = xyz[:, 0] - west, north - xyz[:, 1]
        inside = (np.floor(x / maps.cell_m) == column) & (np.floor(y / maps.cell_m) == row)
        if row == 0:
            inside |= (np.floor(x / maps.cell_m) == column) & (y < 0)
        if column == maps.height_m.shape[1] - 1:
            inside |= (x >= (column + 1) * maps.cell_m) & (np.floor(y / maps.cell_m) == row)
        if inside.any():
            expected[row, column, 0] = xyz[inside, 2].mean()
        if (inside & moved).any():
            expected[row, column, 1] = np.hypot(*shift[inside & moved, :2].T).mean()
    assert south == pytest.approx(xyz[:, 1].min())
    corner = np.isclose(expected[..., 0], maps.height_m, equal_nan=True)
    # points on the very edge of a cell may fall to either side
    assert corner.mean() > 0.97
    assert np.isclose(expected[..., 1], maps.shift_xy_m, equal_nan=True).mean() > 0.97


def test_a_slope_facing_the_light_is_bright():
    columns, rows = np.meshgrid(np.arange(20.0), np.arange(20.0))
    rising_to_southeast = columns + rows
    assert relief(rising_to_southeast, 1.0).mean() > 0.9
    assert relief(-rising_to_southeast, 1.0).mean() < 0.2
    # half a step of the 254 that the shade has
    assert relief(np.zeros((20, 20)), 1.0) == pytest.approx(np.sqrt(0.5), abs=0.5 / 254)


def test_values_all_alike_have_a_histogram():
    figure = histogram_figure(np.full(10, 2.0), "before", "m")
    assert len(figure.axes[0].patches) > 0

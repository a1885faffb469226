"""The page of a run: self-contained, with the right values, and a script that works."""

import base64
import json
import re
import shutil
import zlib
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest

import pcfix
from pcfix.flow.run_folder import RunFolder, report_run
from pcfix.grid.lattice import Lattice
from pcfix.options.correct import RunOptions
from pcfix.report.page import Layer, Report, Table, Tile, render
from tests.utils.browser import needs_browser, open_page
from tests.utils.shared import SCENE


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Return the folder of a report on the sample scene, and the summary."""
    folder = tmp_path_factory.mktemp("report")
    cloud, cameras = SCENE / "cloud.laz", SCENE / "cameras.csv"
    summary = pcfix.correct_file(
        cloud, folder / "corrected.laz", cameras=cameras, water=0.37, method="snell", max_angle=None
    )
    for what in ("surface", "depth", "uncertainty"):
        more = {} if what == "surface" else {"what": what}
        pcfix.grid_dsm(folder / "corrected.laz", folder / f"{what}.tif", resolution=1.0, **more)
    shutil.copy(folder / "corrected.laz", folder / "cleaned.laz")
    run = RunFolder(folder, str(cloud), RunOptions(cameras=str(cameras), water="0.37"))
    report_run(run, [cloud, cameras], {"why": "", "model": None}, vars(summary), {})
    return folder, summary


class Elements(HTMLParser):
    """The elements of a page, whose tags close in turn, and what a reader sees."""

    def __init__(self, text):
        super().__init__()
        self.found, self.open, self.texts = [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        if tag not in ("meta", "link", "img", "br", "input", "hr"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("script", "style"):
            self.texts.append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.found if name == tag]


def test_self_contained(report):
    folder, _ = report
    text = (folder / "report.html").read_text()
    elements = Elements(text)
    for _, attributes in elements.found:
        for key in {"src", "href", "srcset", "action", "data"} & attributes.keys():
            inside = attributes[key].startswith("data:")
            assert inside or (folder / attributes[key]).is_file()
    assert not re.search(r"https?://|@import|url\((?!data:)", text)
    pictures = elements.all("img")
    files = sorted((folder / "figures").glob("*.png"))
    assert len(pictures) == len(files) == 3
    assert all(len(picture["alt"]) > 20 for picture in pictures)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in files)
    assert str(folder) not in text and str(SCENE) not in text
    texts = " ".join(elements.texts)
    assert not re.search(r"\b(None|nan|inf|True|False)\b|[{}]", texts)
    assert len(text) < 4_000_000


def map_data(text):
    return json.loads(re.search(r'id="data">(.*?)</script>', text, re.S)[1])


def values_of(data, name):
    layer = next(one for one in data["layers"] if one["name"] == name)
    steps = np.frombuffer(zlib.decompress(base64.b64decode(layer["values"])), "<i2")
    whole = np.cumsum(steps, dtype="<i2").reshape(data["rows"], data["columns"])
    return np.where(whole == data["noData"], np.nan, layer["offset"] + layer["step"] * whole)


def test_map_values(report):
    folder, summary = report
    data = map_data((folder / "report.html").read_text())
    layers = {layer["name"]: layer for layer in data["layers"]}
    assert list(layers) == ["Depth", "Uncertainty (95 %)", "Height"]
    depth = layers["Depth"]
    assert depth["plusMinus"] in layers
    # light is shallow: the sum of red, green and blue falls with depth
    assert all(sum(a) >= sum(b) for a, b in pairwise(depth["colours"]))
    values = values_of(data, "Depth")
    values = values[np.isfinite(values)]
    # cells have about the same number of points each, so their mean is near that of the points
    assert values.mean() == pytest.approx(summary.depth_m["mean"], abs=0.1)
    assert summary.depth_m["min"] - 0.001 <= values.min()
    assert values.max() <= summary.depth_m["max"] + 0.001
    levels = [one["level"] for one in data["contours"]]
    assert levels and min(levels) > 0.0 and max(levels) < depth["high"]


PROBE = """<script>const ready = setInterval(() => {
  const map = document.getElementById("map");
  if (!map.clientWidth || map.width !== map.clientWidth) return; /* not drawn yet */
  clearInterval(ready);
  const box = map.getBoundingClientRect(), said = [];
  const middle = box.left + box.width / 2;
  const at = { clientX: middle, clientY: box.top + box.height / 2, bubbles: true };
  const place = x => {
    map.dispatchEvent(new PointerEvent("pointermove", { ...at, clientX: middle + x }));
    said.push(document.getElementById("value").textContent);
  };
  place(0); place(60);
  map.dispatchEvent(new WheelEvent("wheel", { ...at, deltaY: -400, cancelable: true }));
  place(0); place(60);
  said.push(document.documentElement.scrollWidth);
  document.title = said.join("|");
}, 50)</script></body>"""


@needs_browser
def test_map_in_browser(report, tmp_path):
    text = (report[0] / "report.html").read_text()
    page = tmp_path / "probe.html"
    page.write_text(text.replace("</body>", PROBE))
    done = open_page(page, tmp_path / "profile", "--window-size=500,900")
    assert [line for line in done.stderr.splitlines() if "CONSOLE" in line] == []
    *texts, width = re.search(r"<title>([^<]*)", done.stdout)[1].split("|")
    assert int(width) <= 500  # nothing is wider than the page
    tips = [
        re.match(r"X ([\d.]+), Y ([\d.]+), Depth ([\d.]+) m ± ([\d.]+) m,", one) for one in texts
    ]
    x, y, depth, error = np.array([one.groups() for one in tips], float).T
    assert abs(x[2] - x[0]) < 2.0  # a cell: the place under the wheel stays
    assert (x[1] - x[0]) / (x[3] - x[2]) == pytest.approx(np.e, rel=0.2)
    data = map_data(text)
    column = ((x - data["west"]) / data["cell"]).astype(int)
    row = ((data["north"] - y) / data["cell"]).astype(int)
    values, errors = (
        values_of(data, name)[row, column] for name in ("Depth", "Uncertainty (95 %)")
    )
    # written with two and three digits
    np.testing.assert_allclose(depth, values, atol=0.006)
    np.testing.assert_allclose(error, errors, atol=0.0011)


def test_escaped():
    depth, evil = np.random.default_rng(1).random((4, 5)), "</script><script>alert(1)</script>"
    table = Table(evil, [evil], [[evil, evil]])
    page = render(
        Report(
            evil, evil, table, [evil], [table, table], Lattice(0.5, 0, 0, 5, 4), depth,
            [Layer(evil, evil, depth, plus_minus=evil)], [], [table],
            [Tile(evil, evil, [(evil, evil)], [evil])], [(f"compare/{evil}.csv", evil)],
        )
    )  # fmt: skip
    assert "<script>alert" not in page
    assert len(Elements(page).all("script")) == 2

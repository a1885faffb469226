"""All steps in one call: what it leaves, and how it resumes."""

import json
import os
import re
import shutil
import sqlite3
import warnings
from contextlib import closing, nullcontext
from pathlib import Path
from xml.etree import ElementTree

import laspy
import numpy as np
import pytest
import rasterio
import shapely

import pcfix
from pcfix.errors import InputError
from pcfix.flow.run import Record
from pcfix.flow.run_folder import STEPS, RunFolder
from pcfix.io import vectors
from pcfix.io.rasters import values_at
from pcfix.options.correct import RunOptions
from pcfix.report.text import Summary, tvu_sentence
from tests.utils.program import run_pcfix
from tests.utils.shared import SCENE
from tests.utils.tiles import finished as finished_in
from tests.utils.tiles import records, write

WORDS = [
    str(SCENE / "cloud.laz"), "out", "--cameras", str(SCENE / "cameras.csv"), "--water", "0.37",
    "--reference", str(SCENE / "lidar.laz"),
]  # fmt: skip
RESULTS = [
    "bed.qml", "bed.tif", "cleaned.laz", "compare", "corrected.laz", "depth.qml", "depth.tif",
    "figures", "map.gpkg", "report.html", "run.json", "shaded.tif", "surface.qml", "surface.tif",
    "surface_counts.tif", "uncertainty.qml", "uncertainty.tif",
]  # fmt: skip


def run(folder, *words):
    return run_pcfix("run", *words, folder=folder)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    done = run(folder, *WORDS)
    assert (done.returncode, done.stderr) == (0, "")
    return folder / "out", done.stdout


@pytest.fixture
def copied(finished, tmp_path):
    shutil.copytree(finished[0], tmp_path / "out")  # with the times of the files
    record = tmp_path / "out" / "run.json"
    record.write_text(record.read_text().replace(str(finished[0]), "out"))
    return tmp_path


def test_files_of_steps(finished):
    folder, printed = finished
    assert sorted(path.name for path in folder.iterdir()) == RESULTS
    assert [line.split()[0] for line in printed.splitlines()] == [
        "adjust", "correct", "clean", "dsm", "compare", "map", "report",
    ]  # fmt: skip


def test_dod(finished):
    names = ("surface.tif", "compare/reference_dsm.tif", "compare/dod.tif")
    dsm, reference, dod = (rasterio.open(finished[0] / name) for name in names)
    with dsm, reference, dod:
        window = rasterio.windows.from_bounds(*dod.bounds, reference.transform)
        expected = dsm.read(1, masked=True) - reference.read(
            1, window=window, masked=True, boundless=True, fill_value=reference.nodata
        )
        found = dod.read(1, masked=True)
    both = ~np.ma.getmaskarray(expected) & ~np.ma.getmaskarray(found)
    assert both.sum() > 0.95 * found.count()
    # float32 heights of about 10 m are stored to 1e-6 m
    np.testing.assert_allclose(found[both], expected[both], atol=2e-6)
    assert abs(np.median(found.compressed())) < 0.02  # a bed gridded at 2 m, noise of 4 cm


def test_depth_and_bed(finished):
    """Where no hole was filled both are of the same points; each is kept to the millimetre."""
    bed, depth, surface, shaded = (
        rasterio.open(finished[0] / f"{name}.tif") for name in ("bed", "depth", "surface", "shaded")
    )
    with bed, depth, surface, shaded:
        assert bed.transform == depth.transform
        level = bed.read(1, masked=True) + depth.read(1, masked=True)
        assert level.count() > 5000
        np.testing.assert_allclose(level.compressed(), 0.37, atol=1.1e-3)
        red, _, blue, alpha = shaded.read().astype(float)
        np.testing.assert_array_equal(alpha == 0.0, surface.read_masks(1) == 0)
        height = surface.read(1)
    deep, land = (height < -8.0) & (alpha > 0), (height > 1.0) & (alpha > 0)
    assert (blue[deep] > red[deep]).all()
    assert (red[land] > blue[land]).all()


def layer(folder, name):
    pyogrio = pytest.importorskip("pyogrio")
    meta, _, wkb, values = pyogrio.raw.read(folder / "map.gpkg", layer=name)
    return shapely.from_wkb(wkb), dict(zip(meta["fields"], values, strict=True))


def test_map(finished):
    folder = finished[0]
    lines, values = layer(folder, "depth_contours")
    assert set(values["interval_m"]) == {1.0}
    for line, depth in zip(lines, values["depth_m"], strict=True):
        found = values_at(folder / "depth.tif", shapely.get_coordinates(line))
        assert np.nanmedian(np.abs(found - depth)) < 0.2  # half a cell on slopes of 1 in 8
    (area,), _ = layer(folder, "corrected_area")
    with rasterio.open(folder / "depth.tif") as raster:
        assert area.area == pytest.approx(raster.read(1, masked=True).count(), rel=0.02)
    shore, of_shore = layer(folder, "waterline")
    assert area.buffer(1.5).contains(shore[0])
    assert 0.0 < of_shore["sigma_m"][0] < 2.0
    assert of_shore["level_m"][0] == pytest.approx(0.37, abs=1e-3)
    cameras, of_cameras = layer(folder, "cameras")
    assert (len(cameras), set(of_cameras["use"])) == (40, {"used"})
    assert shapely.get_z(cameras).min() > 10.0
    assert len(layer(folder, "cross_sections")[0]) == 3
    with closing(sqlite3.connect(folder / "map.gpkg")) as store:
        styled = store.execute(
            "select f_table_name, styleQML from layer_styles where useAsDefault"
        ).fetchall()
    assert {name for name, _ in styled} == {
        "corrected_area", "depth_contours", "waterline", "cross_sections", "cameras",
    }  # fmt: skip
    for _, text in styled:
        assert ElementTree.fromstring(text.split("\n", 1)[1]).find("renderer-v2") is not None


def steps_and_page(folder):
    steps = json.loads((folder / "run.json").read_text())["steps"]
    return {name: step["result"] for name, step in steps.items()}, (folder / "report.html")


def test_measured_uncertainty(finished):
    steps, page = steps_and_page(finished[0])
    measured, text = steps["compare"]["figures"]["tvu"], page.read_text()
    # the noise of cloud and reference is 4 cm at most, of which 95 % lie within 1.96
    assert 0.04 < measured["tvu_95_m"] < 1.96 * 0.04
    assert 0.95 < measured["s44"]["Exclusive"] < 1.0 == measured["s44"]["1a/1b"]
    assert f"{measured['tvu_95_m']:.3f} m at 95 %, at {measured['count']:,} points" in text
    assert "Exclusive Order (" in text
    assert f"<td>{steps['correct']['reconstruction']['because']}</td>" in text


@pytest.mark.usefixtures("undrawn")
def test_order_not_claimed(tmp_path):
    wrong = ["--water", "0.87", "--sigma-image", "0.01"]  # half a metre too high, and too proud
    done = run(tmp_path, *WORDS, *wrong)
    assert done.returncode == 0, done.stderr
    steps, page = steps_and_page(tmp_path / "out")
    formal = tvu_sentence(Summary(**steps["correct"]).uncertainty)
    assert formal.startswith("Exclusive Order")
    text = page.read_text()
    assert "Order 1a/1b (" in text  # the bed is off by nearly half of the level
    assert formal not in text and "Exclusive Order" not in text


def test_done_before(copied):
    before = {path: path.stat().st_mtime_ns for path in (copied / "out").glob("*.*")}
    done = run(copied, *WORDS)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("already done") == 6
    after = {path: path.stat().st_mtime_ns for path in (copied / "out").glob("*.*")}
    changed = {path.name for path in before if before[path] != after[path]}
    assert changed == {"run.json"}


@pytest.mark.usefixtures("undrawn")
def test_file_missing(copied):
    (copied / "out" / "surface.tif").unlink()
    done = run(copied, *WORDS)
    assert (done.returncode, done.stderr) == (0, "")
    steps = {line.split()[0]: "already done" in line for line in done.stdout.splitlines()}
    assert steps == {
        "adjust": False, "correct": True, "clean": True, "dsm": False, "compare": False,
        "map": False, "report": False,
    }  # fmt: skip
    assert (copied / "out" / "surface.tif").exists()


@pytest.mark.usefixtures("undrawn")
def test_other_request(copied):
    done = run(copied, *WORDS, "--index", "1.33")
    assert done.code == "run.other"
    done = run(copied, *WORDS, "--index", "1.33", "--overwrite")
    assert (done.returncode, done.stderr) == (0, "")
    assert "already done" not in done.stdout
    record = json.loads((copied / "out" / "run.json").read_text())
    assert record["options"]["index"] == 1.33


@pytest.mark.parametrize(
    ("more", "first"),
    [
        (["--project", "Lake <2>", "--date", "2024-06-01"], "report"),
        pytest.param(["--share", "0,0.5"], "compare", marks=pytest.mark.nightly),
        (["--resolution", "2"], "dsm"),
    ],
)
@pytest.mark.usefixtures("undrawn")
def test_later_option(copied, more, first):
    done = run(copied, *WORDS, *more)
    assert (done.returncode, done.stderr) == (0, "")
    again = [line.split()[0] for line in done.stdout.splitlines() if line.split()[1] == "done:"]
    assert again == ["correct", "clean", "dsm", "compare", "map", "report"][-len(again) :]
    assert again[0] == first
    assert ("Lake &lt;2&gt;" in (copied / "out" / "report.html").read_text()) is (first == "report")


def steps_done(run, steps=STEPS):
    """Do the steps of a run that are not done yet, and return their names."""
    printed = []
    record = Record(run, printed.append)
    for name in steps:
        record.step(name, name, [Path(name)], lambda _: {"model": ""})
    return [line.split()[0] for line in printed if line.split()[1] == "done:"]


def asked(folder, **options):
    options = {"cameras": str(SCENE / "cameras.csv"), "water": "0.37", "overwrite": True, **options}
    return RunFolder(folder, str(SCENE / "cloud.laz"), RunOptions(**options))


def test_files_and_version(tmp_path, monkeypatch):
    """What is read with a named file counts: of the same stem, sensor.csv, a project's folder."""
    for name in ("cameras.csv", "sensor.csv"):
        shutil.copy(SCENE / name, tmp_path)
    project = tmp_path / "project.files" / "0"
    project.mkdir(parents=True)
    (tmp_path / "project.psx").touch()
    (project / "doc.xml").touch()
    (tmp_path / "out").mkdir()
    named = {"cameras": str(tmp_path / "cameras.csv"), "views": str(tmp_path / "project.psx")}

    def done():
        return steps_done(asked(tmp_path / "out", **named))

    assert done() == list(STEPS)
    assert done() == []
    for name in ("sensor.csv", "project.files/0/doc.xml", "cameras.prj"):
        (tmp_path / name).write_text("another")
        assert done() == list(STEPS)
    (tmp_path / "unread.prj").write_text("another")
    assert done() == []
    monkeypatch.setattr("pcfix.flow.run_folder.__version__", "9.9")
    assert done() == list(STEPS)


def test_reference_added(tmp_path):
    touched = tmp_path / "lidar.laz"
    shutil.copy(SCENE / "lidar.laz", touched)

    before = [name for name in STEPS if name != "compare"]
    assert steps_done(asked(tmp_path), before) == before
    run = asked(tmp_path, reference=str(touched))
    assert steps_done(run) == ["compare", "map", "report"]
    os.utime(touched)
    assert steps_done(asked(tmp_path, reference=str(touched))) == ["compare", "map", "report"]
    for other in ({"index": 1.33}, {"water": "0.4"}):
        assert steps_done(asked(tmp_path, reference=str(touched), **other)) == list(STEPS)


@pytest.fixture(scope="module")
def tiled(tmp_path_factory):
    """Return a folder with the rows of the cloud and of the reference in files of their own."""
    folder = tmp_path_factory.mktemp("tiled")
    for name in ("cloud", "lidar"):
        (folder / name).mkdir()
        las = laspy.read(SCENE / f"{name}.laz")
        for i, rows in enumerate(np.array_split(np.arange(len(las)), 3)):
            write(folder / name / f"{name}{i}.laz", las, rows)
    return folder


def without_names(value):
    """Return plain values without those of a call, and words without the names of files."""
    own = ("seconds", "input", "output", "counts")
    own += ("cloud", "reference")
    if isinstance(value, dict):
        return {name: without_names(one) for name, one in value.items() if name not in own}
    if isinstance(value, list):
        return [without_names(one) for one in value]
    return value.replace("lidar.laz", "lidar") if isinstance(value, str) else value


def test_tiles(finished, tiled, tmp_path):
    """The first call is stopped after a tile, and the next goes on; a third has nothing to do."""
    out = tmp_path / "out"
    asked = {
        "cameras": str(SCENE / "cameras.csv"), "water": "0.37", "jobs": 1,
        "reference": f"{tiled}/lidar/*.laz",
    }  # fmt: skip

    def stop(title):
        def progress(done, total):
            if finished_in(out / "corrected"):
                raise KeyboardInterrupt

        return nullcontext(progress if title == "Correcting" else None)

    with warnings.catch_warnings():  # tiles of rows lie in each other
        warnings.simplefilter("ignore", pcfix.PcfixWarning)
        with pytest.raises(KeyboardInterrupt):
            pcfix.run(tiled / "cloud", out, bar=stop, **asked)
        before = finished_in(out / "corrected")
        found = pcfix.run(tiled / "cloud", out, **asked)
        assert before.items() < finished_in(out / "corrected").items()
        printed = []
        pcfix.run(tiled / "cloud", out, say=printed.append, **asked)
    assert [line.split()[1:3] for line in printed[1:]] == [["already", "done:"]] * 6
    for name in ("corrected", "cleaned"):
        whole = laspy.read(finished[0] / f"{name}.laz").points.array
        np.testing.assert_array_equal(records(*sorted((out / name).glob("*.laz"))), whole)
    names = [path.relative_to(finished[0]) for path in finished[0].rglob("*")]
    for name in names:
        if name.suffix in (".tif", ".csv", ".qml", ".png"):
            assert (out / name).read_bytes() == (finished[0] / name).read_bytes(), name
    both = [json.loads((folder / "run.json").read_text()) for folder in (out, finished[0])]
    many, one = (without_names({n: s["result"] for n, s in b["steps"].items()}) for b in both)
    assert many == one
    pages = [(folder / "report.html").read_text() for folder in (out, finished[0])]
    maps = [re.search(r'id="data">.*?</script>', page, re.DOTALL).group() for page in pages]
    assert maps[0] == maps[1]
    assert '<a href="corrected/">' in pages[0]
    assert found.summary.points == 20_000


@pytest.mark.usefixtures("undrawn")
def test_without_reference_and_vectors(tmp_path, monkeypatch):
    printed: list[str] = []

    def lacking():
        raise InputError("library.missing", "Vector files need pyogrio.")

    monkeypatch.setattr(vectors, "load_pyogrio", lacking)
    found = pcfix.run(
        SCENE / "cloud.laz", tmp_path / "out", cameras=SCENE / "cameras.csv", water=0.37,
        say=printed.append,
    )  # fmt: skip
    assert sum(line.startswith("map       not written: ") for line in printed) == 1
    text = found.report.read_text()
    assert "Cross-section" not in text
    assert "<td>Exclusive</td>" not in text
    assert ">predicted</span>" in text and ">measured</span>" not in text
    assert not (tmp_path / "out" / "compare").exists()


@pytest.mark.usefixtures("undrawn")
def test_check_points(tmp_path):
    lidar = laspy.read(SCENE / "lidar.laz")
    rows = np.random.default_rng(2).choice(len(lidar), 300, replace=False)
    lines = [f"{x:.3f},{y:.3f},{z:.3f}" for x, y, z in lidar.xyz[rows]]
    (tmp_path / "check.csv").write_text("\n".join(["x,y,z", *lines]))
    with pytest.warns(pcfix.PcfixWarning):
        found = pcfix.run(
            SCENE / "cloud.laz", tmp_path / "out", cameras=SCENE / "cameras.csv", water=0.37,
            reference=tmp_path / "check.csv",
        )  # fmt: skip
    assert "check.csv" in found.report.read_text()
    points, values = layer(tmp_path / "out", "check_points")
    assert len(points) > 280
    np.testing.assert_allclose(shapely.get_z(points), values["z_m"])
    assert np.sqrt(np.mean(values["residual_m"] ** 2)) < 0.06  # the noise of cloud and reference
    assert not (tmp_path / "out" / "compare" / "dod.tif").exists()


def test_refused(tmp_path):
    done = run(tmp_path, *WORDS[:-2], "--m3c2")
    assert (done.code, done.error.values["needs"]) == ("option.needs", "reference")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("years")
    assert run(tmp_path, *WORDS).code == "run.other"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.txt"]
    for text in ("", "{}", "[]", '{"steps": {"correct": {}}}'):
        (tmp_path / "out" / "run.json").write_text(text)
        assert run(tmp_path, *WORDS).code == "run.record"

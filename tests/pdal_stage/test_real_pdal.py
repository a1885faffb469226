"""The stage and its recipes in a real PDAL: the program, and ``pdal.Pipeline`` in Python."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

import pcfix
from pcfix.io.las.columns import COLUMNS, UPGRADE
from pcfix.io.pdal import CLASS_FLAGS, add_dimension
from tests.utils.clouds import WATER_M, block, cameras_csv, framed_block, random_cloud, write_cloud
from tests.utils.codes import warned
from tests.utils.nightly import mostly_nightly
from tests.utils.real_pdal import ROOT, needs_pdal, pdal, python
from tests.utils.shared import SCENE

RECIPES = sorted((ROOT / "pipelines").glob("*.json"))

EXECUTE = """
import json, sys, pdal
pipeline = pdal.Pipeline(open(sys.argv[1]).read())
pipeline.execute()
"""


def run_pipeline(door: str, job: dict[str, Any] | list[Any], folder: Path) -> Any:
    """Run a pipeline through one of the doors that PDAL has."""
    (folder / "job.json").write_text(json.dumps(job))
    if door == "program":
        return pdal("pipeline", "job.json", folder=folder)
    return python(EXECUTE, "job.json", folder=folder)


def job_of(point_format: int, **options: object) -> list[dict[str, Any]]:
    """Return a pipeline from cloud.las to stage.las."""
    writer = {"type": "writers.las", "forward": "all", "minor_version": 4, "extra_dims": "all"}
    writer |= {"dataformat_id": UPGRADE[point_format], "filename": "stage.las"}
    stage = stage_of() | {"pdalargs": {"cameras": "cameras.csv", **options}}
    return [{"type": "readers.las", "filename": "cloud.las"}, stage, writer]


def stage_of() -> dict[str, Any]:
    return {
        "type": "filters.python",
        "source": "from pcfix.pdal_stage import correct",
        "module": "pcfix_stage",
        "function": "correct",
        "add_dimension": f"{add_dimension(COLUMNS)},{CLASS_FLAGS}",
        "pdalargs": {"cameras": "cameras.csv", "water": WATER_M, "max_angle": 80.0},
    }


def assert_same(one: Path, other: Path) -> None:
    """Compare coordinates, classes, flags and dimensions, to the last bit of the scale."""
    a, b = laspy.read(one), laspy.read(other)
    assert str(a.header.version) == str(b.header.version) == "1.4"
    assert a.header.point_format.id == b.header.point_format.id
    np.testing.assert_array_equal(a.header.scales, b.header.scales)
    np.testing.assert_array_equal(a.header.offsets, b.header.offsets)
    standard = set(a.point_format.standard_dimension_names) - {"scan_angle"}
    for name in standard:
        np.testing.assert_array_equal(np.array(b[name]), np.array(a[name]), name)
    for column in COLUMNS:
        found, expected = np.array(b[column.name]), np.array(a[column.name])
        np.testing.assert_array_equal(found, expected.astype(found.dtype), column.name)


@needs_pdal
@pytest.mark.parametrize("door", ["program", "python"])
@pytest.mark.parametrize("number", mostly_nightly([0, 1, 2, 3, 6, 7, 8], 7))
def test_stage_and_command(tmp_path: Path, number: int, door: str) -> None:
    write_cloud(tmp_path / "cloud.las", number, plain=True)
    cameras_csv(tmp_path / "cameras.csv", framed_block(), angles=True)
    (tmp_path / "sensor.csv").write_text("focal,sensor_x,sensor_y\n24,24,9.6\n")
    done = run_pipeline(door, job_of(number, water=WATER_M), tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("PcfixWarning" if door == "python" else "warning:") == 1
    with warned("cameras.no_overlap"):
        pcfix.correct_file(
            tmp_path / "cloud.las", tmp_path / "cli.las",
            cameras=tmp_path / "cameras.csv", water=WATER_M,
        )  # fmt: skip
    assert_same(tmp_path / "cli.las", tmp_path / "stage.las")


@needs_pdal
@pytest.mark.parametrize("door", mostly_nightly(["program", "python"], "python"))
def test_water_of_a_dimension(tmp_path: Path, door: str) -> None:
    las = random_cloud(7, plain=True)
    las.add_extra_dim(laspy.ExtraBytesParams("w_surf", "float64"))
    las.w_surf = 12.0 + 0.01 * (np.array(las.x) - np.mean(las.x))
    las.write(tmp_path / "cloud.las")
    cameras_csv(tmp_path / "cameras.csv", block())
    done = run_pipeline(door, job_of(7, water="dim:w_surf", max_angle=80.0), tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    pcfix.correct_file(
        tmp_path / "cloud.las", tmp_path / "cli.las",
        cameras=tmp_path / "cameras.csv", water="dim:w_surf", max_angle=80.0,
    )  # fmt: skip
    assert_same(tmp_path / "cli.las", tmp_path / "stage.las")


def options_of(recipe: str, folder: Path) -> list[str]:
    """Return the words that send a recipe to the sample scene and its outputs to a folder."""
    # the doors are compared, not the methods: the quickest one will do
    quick = {"method": "snell", "max_angle": "none"}
    given = {"cameras": str(SCENE / "cameras.csv"), "water": 0.37, **quick}
    args = json.dumps(given)
    words = [f"--readers.las.filename={SCENE / 'cloud.laz'}"]
    if recipe != "label.json":
        words.append(f"--filters.python.pdalargs={args}")
    return [*words, f"--writers.las.filename={folder / 'out.las'}"]


@needs_pdal
def test_correct_recipe(tmp_path: Path) -> None:
    recipe = ROOT / "pipelines" / "correct.json"
    words = [*options_of("correct.json", tmp_path), "--metadata", "meta.json"]
    done = pdal("pipeline", recipe, *words, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    pcfix.correct_file(
        SCENE / "cloud.laz", tmp_path / "cli.las", cameras=SCENE / "cameras.csv", water=0.37,
        method="snell", max_angle=None,
    )  # fmt: skip
    assert_same(tmp_path / "cli.las", tmp_path / "out.las")
    assert laspy.read(tmp_path / "out.las").header.parse_crs().to_epsg() == 32633
    report = (tmp_path / "meta.json").read_text()
    assert '"corrected": 14736' in report
    assert '"pcfix": "0.' in report


@needs_pdal
def test_raster_recipe(tmp_path: Path) -> None:
    """The cells of a raster are the same points for PDAL, in the same order."""
    pcfix.grid_dsm(SCENE / "cloud.laz", tmp_path / "dsm.tif", resolution=1.0, method="tin")
    words = options_of("correct_raster.json", tmp_path)[1:]
    words += [f"--readers.gdal.filename={tmp_path / 'dsm.tif'}"]
    words += [f"--writers.gdal.filename={tmp_path / 'out.tif'}"]
    recipe = ROOT / "pipelines" / "correct_raster.json"
    done = pdal("pipeline", recipe, *words, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    pcfix.correct_file(
        tmp_path / "dsm.tif", tmp_path / "cli.las", cameras=SCENE / "cameras.csv", water=0.37,
        method="snell", max_angle=None,
    )  # fmt: skip
    one, other = laspy.read(tmp_path / "cli.las"), laspy.read(tmp_path / "out.las")
    # pcfix rounds the places of cells of 1 m to 1 mm, PDAL to 0.1 mm
    np.testing.assert_allclose(other.xyz, one.xyz, rtol=0, atol=6e-4)
    np.testing.assert_array_equal(np.array(other.classification), np.array(one.classification))
    assert (tmp_path / "out.tif").stat().st_size > 1000


@needs_pdal
def test_label_recipe(tmp_path: Path) -> None:
    recipe = ROOT / "pipelines" / "label.json"
    done = pdal("pipeline", recipe, *options_of("label.json", tmp_path), folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    before, after = laspy.read(SCENE / "cloud.laz"), laspy.read(tmp_path / "out.las")
    for axis in "XYZ":
        np.testing.assert_array_equal(after[axis], before[axis])
    wet = np.array(before.z) < 0.37
    expected = np.where(wet, 40, np.array(before.classification))
    np.testing.assert_array_equal(np.array(after.classification), expected)


@needs_pdal
@pytest.mark.parametrize("point_format", mostly_nightly([2, 7], 7))
def test_recipe_with_cleaning(tmp_path: Path, point_format: int) -> None:
    """Correct and clean in one pipeline do what the commands do, one after the other."""
    before = laspy.convert(laspy.read(SCENE / "cloud.laz"), point_format_id=point_format)
    before.write(tmp_path / "cloud.las")
    quick = {"method": "snell", "max-angle": "none"}  # an option's dashes are understood
    args = {"cameras": str(SCENE / "cameras.csv"), "water": 0.37, **quick}
    done = pdal(
        "pipeline", ROOT / "pipelines" / "correct_clean.json",
        f"--readers.las.filename={tmp_path / 'cloud.las'}",
        f"--writers.las.filename={tmp_path / 'out.las'}",
        f"--stage.correct.pdalargs={json.dumps(args)}",
        "--metadata", "meta.json", folder=tmp_path,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    pcfix.correct_file(
        tmp_path / "cloud.las", tmp_path / "corrected.las",
        cameras=SCENE / "cameras.csv", water=0.37, method="snell", max_angle=None,
    )  # fmt: skip
    cleaned = pcfix.clean_file(tmp_path / "corrected.las", tmp_path / "cleaned.las")
    assert cleaned.noise > 0
    assert_same(tmp_path / "cleaned.las", tmp_path / "out.las")
    assert f'"noise": {cleaned.noise}' in (tmp_path / "meta.json").read_text()


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_options_of_recipes(path: Path) -> None:
    """PDAL's defaults are LAS 1.2 and centimetres; 2.2 and current releases share these options."""
    stages = json.loads(path.read_text())["pipeline"]
    for stage in (s for s in stages if s["type"] == "filters.python"):
        assert stage["source"] == f"from pcfix.pdal_stage import {stage['function']}"
        assert "script" not in stage
        if stage["function"] == "correct":
            assert stage["add_dimension"].startswith(f"{add_dimension(COLUMNS)},{CLASS_FLAGS}")
    writer = next(s for s in stages if s["type"] == "writers.las")
    assert writer["minor_version"] == 4
    assert writer["dataformat_id"] >= 6
    assert writer["forward"] == "all"
    assert {s["type"] for s in stages} <= {
        "readers.las", "readers.gdal", "filters.python", "filters.merge", "filters.splitter",
        "filters.outlier", "filters.range", "writers.las", "writers.gdal",
    }  # fmt: skip


SURVIVE = """
import json, os, signal, sys, pdal
from tests.utils.program import run_pcfix
job = open(sys.argv[1]).read()
before = sys.stdout, os.getcwd(), signal.getsignal(signal.SIGINT), sys.getdlopenflags()
for attempt in range(30):
    try:
        pdal.Pipeline(job).execute()
    except RuntimeError as error:
        message = str(error)
    else:
        raise SystemExit("no error")
    after = sys.stdout, os.getcwd(), signal.getsignal(signal.SIGINT), sys.getdlopenflags()
    assert after == before, after
good = json.loads(job)
good[1]["pdalargs"] = {"cameras": "cameras.csv", "water": float(sys.argv[2]), "max_angle": 80.0}
assert pdal.Pipeline(json.dumps(good)).execute() == 300
assert sys.stdout is before[0]
print(message)
"""


@needs_pdal
def test_fault_of_pcfix(tmp_path: Path) -> None:
    write_cloud(tmp_path / "cloud.las", 7, plain=True, count=300)
    cameras_csv(tmp_path / "cameras.csv", block())
    writer = {"type": "writers.las", "filename": "out.las", "forward": "all",
              "minor_version": 4, "dataformat_id": 7}  # fmt: skip
    (tmp_path / "job.json").write_text(json.dumps(["cloud.las", stage_of(), writer]))
    breaking = (
        "import pcfix.flow.correction\n"
        "whole = pcfix.flow.correction.correct_chunk\n"
        "def broken(*a, calls=[]):\n"
        "    calls.append(1)\n"
        "    if len(calls) < 31: raise ZeroDivisionError('a fault')\n"
        "    return whole(*a)\n"
        "pcfix.flow.correction.correct_chunk = broken\n"
    )
    done = python(breaking + SURVIVE, "job.json", WATER_M, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "ZeroDivisionError: a fault" in done.stdout

"""A run from Python, and its results as xarray, GeoPandas and pandas have them."""

import contextlib
import json
import sys
from pathlib import Path

import laspy
import matplotlib
import numpy as np
import pytest
import rasterio

import pcfix
from tests.utils.codes import refused

SAMPLES = Path(__file__).parents[2] / "samples"
SCENE = SAMPLES / "scene"
pytest.importorskip("rioxarray")
pytest.importorskip("geopandas")


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """Run the cells of the notebook one after the other; return the names that it leaves."""
    matplotlib.use("agg")
    cells = json.loads((SAMPLES / "07_analyse.ipynb").read_text())["cells"]
    cells = [one for one in cells if one["cell_type"] == "code"]
    assert all(one["outputs"] == [] and one["execution_count"] is None for one in cells)
    folder = tmp_path_factory.mktemp("notebook")
    (folder / "scene").symlink_to(SCENE)
    found = {}
    with contextlib.chdir(folder):
        for one in cells:
            exec("".join(one["source"]), found)
        yield found


@pytest.fixture
def result(names):
    return names["result"]


def test_notebook(names):
    truth = laspy.read(SCENE / "truth.laz")
    area_m2 = np.prod(truth.header.maxs[:2] - truth.header.mins[:2])  # its points lie at random
    expected = area_m2 * np.maximum(0.37 - np.asarray(truth.z), 0.0).mean()
    assert names["volume_m3"] == pytest.approx(expected, rel=0.02)
    assert names["area_m2"].sum() == names["depth"].count()
    with rasterio.open("depth_west.tif") as raster:
        assert raster.read(1, masked=True).max() == pytest.approx(float(names["part"].max()))


def test_opened(result):
    printed = []
    again = pcfix.run(
        "scene/cloud.laz", "out", cameras="scene/cameras.csv", water="0.37",
        reference="scene/lidar.laz", say=printed.append,
    )  # fmt: skip
    assert printed and all("already done" in line for line in printed[1:])
    assert pcfix.open_run("out") == again == result


def test_arrays(result):
    for name in ("depth", "bed", "surface", "uncertainty"):
        array = getattr(result, name)
        assert not array.variable._in_memory
        with rasterio.open(result.folder / f"{name}.tif") as raster:
            expected = raster.read(1, masked=True).filled(np.nan)
            assert (array.rio.crs, array.rio.transform()) == (raster.crs, raster.transform)
        np.testing.assert_array_equal(array.to_numpy(), expected)
        assert (array.name, array.attrs["units"]) == (name, "metre")
    # the water is level, so that depth and bed make its height, which is 0.37
    np.testing.assert_allclose((result.depth + result.bed).median(), 0.37, atol=1e-3)


def test_tables(result):
    tables = result.tables
    assert {"depth_bins", "section_03"} <= tables.keys()
    bed = result.compared["bed"]["after"]
    assert tables["depth_bins"].count_after.sum() == bed["count"]
    assert result.summary.corrected == 14_736


def test_refused(result, tmp_path, monkeypatch):
    with pytest.raises(pcfix.InputError):
        pcfix.open_run(tmp_path)
    record = json.loads((result.folder / "run.json").read_text())
    del record["steps"]["report"]
    (tmp_path / "run.json").write_text(json.dumps(record))
    with pytest.raises(pcfix.InputError):
        pcfix.open_run(tmp_path)
    with pytest.raises(pcfix.InputError):
        type(result)(tmp_path).layer("waterline")
    for given in ({"water": pcfix.WaterPlane(0.0, 0.0, 0.37)}, {"water": 0.37, "camera": "a.csv"}):
        with pytest.raises(pcfix.SettingError):
            pcfix.run(SCENE / "cloud.laz", tmp_path / "o", cameras=SCENE / "cameras.csv", **given)
    monkeypatch.setitem(sys.modules, "rioxarray", None)
    with refused("library.missing", library="rioxarray"):
        _ = result.depth

"""The whole raster: seams, files, surfaces, holes, and refused input."""

import json
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio

from pcfix.errors import InputError, SettingError
from pcfix.flow import dsm as flow
from pcfix.flow.dsm import grid_dsm
from pcfix.io.las import source
from tests.grid.clouds import EAST, NORTH, awkward, scattered, write
from tests.utils.codes import refused
from tests.utils.nightly import mostly_nightly
from tests.utils.program import run_pcfix
from tests.utils.rasters import HAS_STATISTICS, read_raster

METHODS = ("mean", "median", "min", "max", "tin")


def heights(path):
    raster = read_raster(path)
    return np.where(raster.array[0] == raster.nodata, np.nan, raster.array[0])


@pytest.fixture(scope="module")
def awkward_cloud(tmp_path_factory):
    return write(tmp_path_factory.mktemp("dsm") / "awkward.laz", awkward())


SIZES = {
    "chunks": {"CHUNK_POINTS": 700},
    "squares": {"BIN_POINTS": 90},
    "windows": {"BLOCK_CELLS": 16, "BIN_POINTS": 300},
    "all": {"CHUNK_POINTS": 1234, "BIN_POINTS": 40, "BLOCK_CELLS": 32, "WINDOW_POINTS": 100},
}


@pytest.mark.parametrize("fill", mostly_nightly([None, 2.0], 2.0))
@pytest.mark.parametrize("method", mostly_nightly(METHODS, "median", "tin"))
def test_no_seams(awkward_cloud, tmp_path, monkeypatch, method, fill):
    """Chunks, squares of the store and windows of any size give the same raster, bit by bit."""

    def run(name):
        files = tmp_path / f"{name}.tif", tmp_path / f"{name}_counts.tif"
        options = {"resolution": 0.3, "method": method, "fill": fill, "counts": files[1]}
        grid_dsm(awkward_cloud, files[0], **options)
        return [read_raster(one).array for one in files]

    whole = run("whole")
    for name, sizes in SIZES.items():
        with monkeypatch.context() as patch:
            for key, value in sizes.items():
                for module in (source, flow):
                    if hasattr(module, key):
                        patch.setattr(module, key, value)
            parts = run(name)
        for one, other in zip(whole, parts, strict=True):
            np.testing.assert_array_equal(one, other, err_msg=name)


def test_uncertainty(tmp_path):
    xyz = scattered(4000, 20.0, 15.0)
    sigma = np.round(np.random.default_rng(1).uniform(0.01, 0.3, 4000), 4)
    sigma[xyz[:, 0] < EAST + 8.0] = 0.0  # land
    path = write(tmp_path / "cloud.las", xyz, classes=40)
    las = laspy.read(path)
    tenths_mm = {"scales": np.array([1e-4]), "offsets": np.zeros(1)}  # as a correction writes it
    las.add_extra_dim(laspy.ExtraBytesParams("SigmaZ", "uint16", **tenths_mm))
    las["SigmaZ"] = sigma
    las.write(path)
    with pytest.raises(InputError):  # no dimension WaterDepth
        grid_dsm(path, tmp_path / "d.tif", what="depth")
    summary = grid_dsm(path, tmp_path / "d.tif", resolution=1.0, what="uncertainty")
    with rasterio.open(tmp_path / "d.tif") as dsm:
        assert (dsm.descriptions, dsm.units) == (("uncertainty",), ("metre",))
        assert dsm.bounds.left == EAST + 8.0
        found = dsm.read(1)
    expected = np.full((15, 20), np.nan)
    for row in range(15):
        for column in range(8, 20):
            x, y = xyz[:, 0] - EAST - column, NORTH + 15.0 - row - xyz[:, 1]
            own = sigma[(x >= 0) & (x < 1) & (y > 0) & (y <= 1)]
            expected[row, column] = 1.959964 * np.sqrt((own**2).mean())
    np.testing.assert_allclose(found, expected[:, 8:], rtol=1e-6)  # float32
    known = expected[:, 8:]
    assert summary.values["mean"] == pytest.approx(known.mean(), abs=5e-5)
    assert summary.values["max"] == pytest.approx(known.max(), abs=5e-5)


def test_chosen_resolution(tmp_path):
    """Points at random: so many a cell are as many as those of the cells without any, too."""
    for count, side in ((4000, 40.0), (9000, 25.0)):
        cloud = write(tmp_path / "c.las", scattered(count, side, side))
        summary = grid_dsm(cloud, tmp_path / "d.tif", overwrite=True)
        assert 2.0 <= count / (side / summary.settings["resolution"]) ** 2 <= 4.0


def test_file(tmp_path):
    cloud = write(tmp_path / "cloud.laz", scattered(20_000, 80.0, 70.0), crs="EPSG:32633+5773")
    counts = tmp_path / "n.tif"
    grid_dsm(cloud, tmp_path / "d.tif", resolution=0.2, counts=counts)
    with rasterio.open(tmp_path / "n.tif") as counts:
        assert counts.descriptions == ("count", "spread")
        assert counts.crs.to_epsg() == 32633, "no vertical datum of what is no height"
        count, spread = counts.read()
    with rasterio.open(tmp_path / "d.tif") as dsm:
        assert dsm.descriptions == ("height",)
        assert dsm.dtypes == ("float32",)
        assert ("STATISTICS_MEAN" in dsm.tags(1)) is HAS_STATISTICS
        assert dsm.nodata == -9999.0
        assert dsm.crs.to_wkt().count("32633") == 1
        assert "EGM96" in dsm.crs.to_wkt()
        assert dsm.overviews(1) == [2]
        assert dsm.profile["tiled"]
        assert dsm.profile["blockysize"] == 256
        assert dsm.profile["compress"] == "deflate"
        assert dsm.tags(ns="IMAGE_STRUCTURE")["PREDICTOR"] == "3"
        assert dsm.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert dsm.bounds == pytest.approx((EAST, NORTH, EAST + 80.0, NORTH + 70.0), abs=1e-6)
        assert json.loads(dsm.tags()["PCFIX"])["resolution"] == 0.2
        assert count.sum() == 20_000
        np.testing.assert_array_equal(dsm.read(1) == -9999.0, count == 0)
        np.testing.assert_array_equal(spread == -9999.0, count == 0)
    assert {p.name for p in tmp_path.iterdir()} == {"cloud.laz", "d.tif", "n.tif"}


def test_fill(tmp_path):
    """A hole of 3 cells is filled, one of 6 is not; plane heights go on across the small one."""
    x, y = (g.ravel() for g in np.meshgrid(np.arange(0.5, 30.0), np.arange(0.5, 20.0)))
    small = (np.abs(x - 6.5) < 1.6) & (np.abs(y - 6.5) < 1.6)
    large = (np.abs(x - 20.0) < 3.1) & (np.abs(y - 10.0) < 3.1)
    x, y = (v[~(small | large)] for v in (x, y))
    cloud = write(tmp_path / "c.las", np.column_stack([x + EAST, y + NORTH, 5.0 + x / 4.0]))
    plain = grid_dsm(cloud, tmp_path / "plain.tif", resolution=1.0)
    assert (plain.cells, plain.filled, plain.empty) == (600 - 45, 0, 45)
    counts = tmp_path / "counts.tif"
    summary = grid_dsm(cloud, tmp_path / "filled.tif", resolution=1.0, fill=3.0, counts=counts)
    found = np.vstack([read_raster(one).array for one in (tmp_path / "filled.tif", counts)])
    filled = (found[1] == 0) & (found[0] != -9999.0)
    assert filled[12:15, 5:8].all()
    assert (found[2][found[1] == 0] == -9999.0).all()
    assert (found[0, 8:12, 18:22] == -9999.0).all(), "the large hole stays open"
    assert summary.filled == filled.sum()
    assert summary.cells + summary.filled + summary.empty == 600
    # cells are at their own points here, so the plane x / 4 is exact in float32
    np.testing.assert_array_equal(
        found[0, 12:15, 5:8], [[5.0 + v / 4.0 for v in (5.5, 6.5, 7.5)]] * 3
    )


def test_surfaces(tmp_path):
    """Noise and withheld points never count; of the bed, only class 40 does."""
    xyz = np.column_stack([np.arange(8) + EAST, np.full(8, NORTH), np.arange(8.0)])
    classes = np.array([2, 40, 40, 7, 18, 9, 1, 40])
    cloud = write(tmp_path / "c.las", xyz, classes, withheld=np.array([0, 0, 1, 0, 0, 0, 0, 0]))
    everything = grid_dsm(cloud, tmp_path / "all.tif", resolution=1.0)
    assert everything.points_used == 5
    np.testing.assert_array_equal(
        heights(tmp_path / "all.tif")[0], [0, 1, np.nan, np.nan, np.nan, 5, 6, 7]
    )
    bed = grid_dsm(cloud, tmp_path / "bed.tif", resolution=3.0, surface="bed", method="max")
    assert (bed.points_used, bed.width) == (2, 3)
    np.testing.assert_array_equal(heights(tmp_path / "bed.tif")[0], [1, np.nan, 7])


def test_wrong_header(tmp_path):
    """Bounds in the header set sizes of work, not the raster."""
    xyz = scattered(3000, 20.0, 20.0)
    right, wrong = (write(tmp_path / f"{n}.las", xyz) for n in ("right", "wrong"))
    with wrong.open("r+b") as stream:
        stream.seek(179)
        stream.write(np.array([1e300, -5.0, np.nan, 0.0, 9.0, 9.0]).tobytes())
    for path in (right, wrong):
        grid_dsm(path, path.with_suffix(".tif"), resolution=0.7, method="median")
    one, other = (read_raster(p.with_suffix(".tif")) for p in (right, wrong))
    np.testing.assert_array_equal(one.array, other.array)
    assert one.transform == other.transform


@pytest.mark.parametrize(
    "change",
    [
        {"resolution": 0.0}, {"resolution": -1.0}, {"resolution": float("nan")},
        {"resolution": float("inf")}, {"method": "kriging"}, {"surface": "water"}, {"fill": 0.0},
        {"fill": 2000.0},
        {"what": "uncertainty", "method": "tin"}, {"what": "Colour"}, {"output": "d.asc"},
        {"counts": "n.png"}, {"counts": "d.tif"}, {"output": "nowhere/d.tif"},
        {"output": "there.tif"},
    ],
    ids=str,
)  # fmt: skip
def test_settings_refused(tmp_path, monkeypatch, change):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "c.las", scattered(500, 10.0, 10.0))
    Path("there.tif").touch()
    options = {"output": "d.tif", "resolution": 1.0} | change
    with pytest.raises(SettingError):
        grid_dsm("c.las", options.pop("output"), **options)
    assert {p.name for p in tmp_path.iterdir()} == {"c.las", "there.tif"}


def test_clouds_refused(tmp_path, monkeypatch):
    """Too many cells, only noise, no bed, degrees or feet, no COG driver."""
    large = write(tmp_path / "large.las", scattered(5000, 900.0, 300.0))
    with refused("option.resolution", value=0.001, finest=0.017):
        grid_dsm(large, tmp_path / "d.tif", resolution=0.001)
    xyz = scattered(50, 10.0, 10.0)
    noise = write(tmp_path / "noise.las", xyz, classes=np.full(50, 7))
    at = (15.0, 50.0, 0.0)
    degrees = write(tmp_path / "deg.las", xyz - (EAST, NORTH, 0.0) + at, crs=4326, offsets=at)
    feet = write(tmp_path / "feet.las", xyz, crs=2263)
    for cloud, options, kind in (
        (noise, {}, InputError), (noise, {"surface": "bed"}, InputError), (degrees, {}, InputError),
        (feet, {}, InputError),
    ):  # fmt: skip
        with pytest.raises(kind):
            grid_dsm(cloud, tmp_path / "d.tif", resolution=2.0, **options)
    assert {p.suffix for p in tmp_path.iterdir()} == {".las"}


def test_summary_and_progress(tmp_path):
    cloud = write(tmp_path / "c.las", scattered(500, 10.0, 10.0))
    steps = []
    summary = grid_dsm(
        cloud,
        tmp_path / "d.tif",
        resolution=1.0,
        summary=tmp_path / "s.json",
        progress=lambda done, total: steps.append((done, total)),
    )
    saved = json.loads((tmp_path / "s.json").read_text())
    assert saved == json.loads(json.dumps(summary.as_dict()))
    assert saved["settings"]["method"] == "mean"
    assert saved["bounds_m"] == [EAST, NORTH, EAST + 10.0, NORTH + 10.0]
    assert steps == sorted(steps)
    assert steps[-1] == (500, 500)


def test_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "c.laz", scattered(2000, 20.0, 10.0), classes=40)
    words = "c.laz d.tif --resolution 0.5 --method max --surface bed --fill 1.5 --summary s.json"
    words += " --counts n.tif --what height --style"
    answer = run_pcfix("dsm", *words.split())
    assert answer.returncode == 0, answer.stderr
    assert json.loads((tmp_path / "s.json").read_text())["settings"] == {
        "resolution": 0.5, "what": "height", "method": "max", "surface": "bed", "fill": 1.5,
    }  # fmt: skip
    assert read_raster("d.tif").array.shape == (1, 20, 40)
    assert read_raster("n.tif").array.shape == (2, 20, 40)
    assert (tmp_path / "d.qml").exists()
    words = ["dsm", "c.laz", "d.tif", "--resolution", "1"]
    assert run_pcfix(*words).returncode == 1  # without --overwrite
    again = run_pcfix(*words, "--overwrite", "--quiet")
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")
    assert run_pcfix(*words, "--method", "kriging").returncode == 2

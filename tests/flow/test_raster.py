"""Rasters of heights as clouds: truth, untouched land, stored types, and refused input.

The method factor multiplies the apparent depth and moves no point in plan, so that the height of
every cell under water is known exactly: level - factor (level - apparent height).
"""

import json

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import from_origin

import pcfix
from pcfix.flow import raster as flow
from pcfix.io import raster_cloud
from tests.utils.codes import refused, warned
from tests.utils.program import run_pcfix
from tests.utils.rasters import read_raster
from tests.utils.shared import SCENE

LEVEL_M, FACTOR = 0.37, 1.4
FACTORED = {"water": LEVEL_M, "method": "factor", "depth_factor": FACTOR}
EAST, NORTH = 500_000.0, 5_400_000.0


def bay(rows=60, columns=80):
    """Return heights of land that falls into water to the east, with a hole in each."""
    row, column = np.indices((rows, columns))
    height = 3.0 - 0.1 * column + 0.2 * np.sin(row / 5.0)
    height[10:14, 5:9] = height[30:40, 60:70] = np.nan
    return height


def write(path, *bands, dtype="float32", nodata=-9999.0, crs="EPSG:32633", scale=1.0, offset=0.0,
          cell=0.5, kinds=None, names=(), unit=None):  # fmt: skip
    rows, columns = bands[0].shape
    profile = {
        "driver": "GTiff", "height": rows, "width": columns, "count": len(bands), "dtype": dtype,
        "nodata": nodata, "crs": crs, "transform": from_origin(EAST, NORTH, cell, cell),
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as out:
        # GDAL loses these of a file with a vertical datum if they are set after the data
        out.scales, out.offsets = [scale] * len(bands), [offset] * len(bands)
        for number, band in enumerate(bands, start=1):
            stored = (band - offset) / scale
            stored = stored if dtype.startswith("float") else np.rint(stored)
            out.write(np.where(np.isnan(band), nodata or 0, stored).astype(dtype), number)
        if kinds:
            out.colorinterp = kinds
        for number, name in enumerate(names, start=1):
            out.set_band_description(number, name)
        if unit:
            out.set_band_unit(1, unit)
    return path


def heights(path, band=1):
    """Return the heights of a raster, NaN for none."""
    with rasterio.open(path) as source:
        stored = source.read(band, masked=True).astype(np.float64).filled(np.nan)
        return stored * source.scales[band - 1] + source.offsets[band - 1]


STORED = [
    {},
    {"dtype": "float64", "nodata": np.nan},
    {"dtype": "float32", "nodata": None},
    {"dtype": "int16", "nodata": -32768, "scale": 0.01, "offset": -20.0},
    {"dtype": "uint16", "nodata": 0, "scale": 0.005, "offset": -50.0},
]


@pytest.mark.parametrize("stored", STORED, ids=lambda one: one.get("dtype", "plain"))
def test_stored(tmp_path, stored):
    """Land keeps its bits, water gets its depth, and type, scale, grid and CRS stay."""
    height = bay()
    if "nodata" in stored and stored["nodata"] is None:
        height = np.where(np.isnan(height), -32767.0, height)  # as Metashape has it
    dsm = write(tmp_path / "dsm.tif", height, crs="EPSG:32633+5773", **stored)
    out, depth = tmp_path / "out.tif", tmp_path / "depth.tif"
    summary = pcfix.correct_file(dsm, out, depth=depth, **FACTORED)
    before, after = read_raster(dsm), read_raster(out)
    assert after.transform == before.transform
    assert after.array.dtype == before.array.dtype
    with rasterio.open(dsm) as one, rasterio.open(out) as other:
        assert (one.scales, one.offsets) == (other.scales, other.offsets)
        assert "EGM96" in other.crs.to_wkt()
        assert other.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert json.loads(other.tags()["PCFIX"])["water_plane"] == [LEVEL_M, 0.0, 0.0]
    apparent, found = heights(dsm), heights(out)
    apparent[apparent < -1000.0] = np.nan
    wet = apparent < LEVEL_M - 1e-9
    np.testing.assert_array_equal(before.array[0][~wet & np.isfinite(apparent)],
                                  after.array[0][~wet & np.isfinite(apparent)])  # fmt: skip
    np.testing.assert_array_equal(np.isnan(found), np.isnan(apparent))
    # points are rounded to 0.1 mm, and heights to the steps of the raster
    step = 1.1e-4 + stored.get("scale", 0.0) / 2.0
    expected = LEVEL_M - FACTOR * (LEVEL_M - apparent)
    np.testing.assert_allclose(found[wet], expected[wet], atol=step)
    deep = heights(depth)
    np.testing.assert_array_equal(np.isfinite(deep), wet)
    np.testing.assert_allclose(deep[wet], LEVEL_M - expected[wet], atol=1.2e-3)  # of WaterDepth
    with rasterio.open(depth) as one:
        assert (one.crs.to_epsg(), one.descriptions, one.units) == (32633, ("depth",), ("metre",))
    assert summary.raster == {"cells_changed": wet.sum(), "cells_empty": 0}
    assert (summary.input, summary.output) == (str(dsm), str(out))
    assert {one.name for one in tmp_path.iterdir()} == {"dsm.tif", "out.tif", "depth.tif"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return a DSM of the sample scene, and what a correction with its cameras makes of it."""
    folder = tmp_path_factory.mktemp("raster")
    dsm, out = folder / "dsm.tif", folder / "out.tif"
    pcfix.grid_dsm(SCENE / "cloud.laz", dsm, resolution=1.0, method="tin")
    more = {name: folder / f"{name}.tif" for name in ("shift", "uncertainty", "outcome")}
    correct = {"cameras": SCENE / "cameras.csv", "water": LEVEL_M, "method": "snell"}
    summary = pcfix.correct_file(
        dsm, out, max_angle=None, depth=folder / "d.tif", **correct, **more
    )
    return folder, summary


def truth_at(path):
    """Return the true heights of the sample scene at the cells of a raster."""
    import laspy
    from scipy.interpolate import LinearNDInterpolator

    with rasterio.open(path) as source:
        row, column = np.indices(source.shape)
        x, y = source.transform * (column + 0.5, row + 0.5)
    las = laspy.read(SCENE / "truth.laz")
    origin = np.array([410_200.0, 4_650_300.0])
    surface = LinearNDInterpolator(np.column_stack([las.x, las.y]) - origin, las.z)
    return surface(np.dstack([x, y]) - origin)


def test_truth(scene):
    folder, summary = scene
    truth, before, after = truth_at(folder / "dsm.tif"), *map(
        heights, (folder / "dsm.tif", folder / "out.tif")
    )  # fmt: skip
    bed = truth < LEVEL_M - 0.2
    rmse = [np.sqrt(np.nanmean((one - truth)[bed] ** 2)) for one in (before, after)]
    assert rmse[0] > 2.0
    assert rmse[1] < 0.05  # cells of 1 m among stones of 0.5 to 2 m
    outcome = heights(folder / "outcome.tif")
    np.testing.assert_array_equal(np.isnan(outcome), np.isnan(before))
    np.testing.assert_array_equal(outcome == pcfix.Outcome.CORRECTED, before < LEVEL_M)
    land = outcome == pcfix.Outcome.LAND
    np.testing.assert_array_equal(before[land], after[land])
    assert summary.corrected == (outcome == 1).sum()
    shift = np.stack([heights(folder / "shift.tif", band) for band in (1, 2, 3)])
    assert np.isnan(shift[:, land]).all()
    # where the bed is level, cells have moved by their own shift
    np.testing.assert_allclose(np.nanmedian(after - before - shift[2]), 0.0, atol=0.002)
    depth = heights(folder / "d.tif")
    known = np.isfinite(depth)
    np.testing.assert_allclose((depth + after)[known], LEVEL_M, atol=1e-3)
    tvu, sigma = (heights(folder / "uncertainty.tif", band) for band in (1, 2))
    np.testing.assert_allclose(tvu[known], 1.959964 * sigma[known], rtol=1e-6)
    assert np.nanmin(sigma) > 0.0


def test_no_seams(scene, tmp_path, monkeypatch):
    """Windows of any size give the same raster, bit by bit."""
    folder, _ = scene
    monkeypatch.setattr(flow, "PART_CELLS", 17)
    for module in (flow, raster_cloud):
        monkeypatch.setattr(module, "WINDOW_CELLS", 40)
    correct = {"cameras": SCENE / "cameras.csv", "water": LEVEL_M, "method": "snell"}
    pcfix.correct_file(
        folder / "dsm.tif", tmp_path / "out.tif", max_angle=None, dimensions="none", **correct
    )
    one, other = (read_raster(at / "out.tif").array for at in (folder, tmp_path))
    np.testing.assert_array_equal(one, other)


def test_compare(scene):
    """A corrected raster remembers its water, and is compared like a cloud."""
    folder, _ = scene
    off = [
        pcfix.compare_clouds(path, SCENE / "lidar.laz", submerged=True, **water)
        for path, water in ((folder / "dsm.tif", {"water": LEVEL_M}), (folder / "out.tif", {}))
    ]
    before, after = (one.vertical.after.statistics for one in off)
    assert before.mean_m > 1.5
    assert abs(after.mean_m) < 0.02  # of cells of 1 m


def test_twice(scene, tmp_path):
    with refused("cloud.corrected"):
        pcfix.correct_file(scene[0] / "out.tif", tmp_path / "again.tif", **FACTORED)


def test_label(tmp_path):
    dsm = write(tmp_path / "dsm.tif", bay())
    pcfix.label_file(dsm, tmp_path / "classes.tif", water=LEVEL_M)
    found = read_raster(tmp_path / "classes.tif")
    expected = np.where(np.isnan(bay()), 255, np.where(bay() < LEVEL_M, 40, 0))
    np.testing.assert_array_equal(found.array[0], expected)
    assert found.nodata == 255


def test_as_cloud(tmp_path):
    """An output that is a cloud has a point for each cell."""
    import laspy

    dsm = write(tmp_path / "dsm.tif", bay())
    pcfix.correct_file(dsm, tmp_path / "out.laz", **FACTORED)
    las = laspy.read(tmp_path / "out.laz")
    assert len(las) == np.isfinite(bay()).sum()
    row, column = np.nonzero(np.isfinite(bay()))
    np.testing.assert_allclose(las.x, EAST + 0.5 * (column + 0.5), atol=1e-4)
    np.testing.assert_allclose(las.y, NORTH - 0.5 * (row + 0.5), atol=1e-4)
    np.testing.assert_array_equal(np.asarray(las["Outcome"]), bay()[row, column] < LEVEL_M)


def test_bands(tmp_path):
    """One band of several, by its number; transparent cells have no height."""
    high, alpha = np.full((60, 80), 300.0), np.where(np.isnan(bay()), 0.0, 255.0)
    plain = np.nan_to_num(bay(), nan=1.0)
    kinds = [ColorInterp.gray, ColorInterp.undefined]
    dsm = write(tmp_path / "two.tif", high, bay(), kinds=kinds)
    with refused("raster.bands", bands=2):
        pcfix.correct_file(dsm, tmp_path / "out.tif", **FACTORED)
    with refused("raster.band", band=3):
        pcfix.correct_file(dsm, tmp_path / "out.tif", band=3, **FACTORED)
    done = run_pcfix(
        "correct", "two.tif", "out.tif", "--band", 2, "--water", LEVEL_M, "--method", "factor",
        "--depth-factor", FACTOR, folder=tmp_path,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert "cells changed, 0 of them" in done.stdout
    kinds = [ColorInterp.gray, ColorInterp.alpha]
    clear = write(tmp_path / "clear.tif", plain, alpha, nodata=None, kinds=kinds)
    pcfix.correct_file(clear, tmp_path / "same.tif", **FACTORED)
    one, other = (heights(tmp_path / name) for name in ("out.tif", "same.tif"))
    np.testing.assert_array_equal(one, other)


WRONG = {
    "cloud.crs_unit": {"crs": "EPSG:4326", "cell": 1e-6},
    "raster.no_crs": {"crs": None},
    "raster.unit": {"unit": "ft"},
    "raster.picture": {"dtype": "uint8", "nodata": 0},
    "raster.depths": {"names": ["depth"]},
    "raster.empty": {},
    "raster.type": {"dtype": "int16", "nodata": -32768, "scale": 0.00016},
}


@pytest.mark.parametrize("code", WRONG)
@pytest.mark.parametrize("door", ["correct", "label", "compare"])
def test_wrong_raster(tmp_path, door, code):
    if (door, code) in {("label", "raster.type"), ("compare", "raster.type")}:
        pytest.skip("it writes no heights")
    height = bay() * (np.nan if code == "raster.empty" else 1.0)
    dsm = write(tmp_path / "dsm.tif", height, **WRONG[code])
    doors = {
        "correct": lambda: pcfix.correct_file(dsm, tmp_path / "out.tif", **FACTORED),
        "label": lambda: pcfix.label_file(dsm, tmp_path / "out.tif", water=LEVEL_M),
        "compare": lambda: pcfix.compare_clouds(dsm, SCENE / "lidar.laz"),
    }
    with refused(code):
        doors[door]()
    assert [one.name for one in tmp_path.iterdir()] == ["dsm.tif"]


def test_may_be_depths(tmp_path):
    depth = np.clip(0.1 * np.indices((60, 80))[1], 0.0, None)
    dsm = write(tmp_path / "depth.tif", depth)
    with warned("raster.depths"):
        pcfix.correct_file(dsm, tmp_path / "out.tif", **FACTORED)


@pytest.mark.parametrize(
    ("code", "paths", "options"),
    [
        ("output.suffix", (SCENE / "cloud.laz", "out.tif"), {}),
        ("option.needs", (SCENE / "cloud.laz", "out.laz"), {"depth": "d.tif"}),
        ("option.needs", (SCENE / "cloud.laz", "out.laz"), {"band": 2}),
        ("output.is_input", ("dsm.tif", "dsm.tif"), {}),
        ("output.is_input", ("dsm.tif", "out.tif"), {"depth": "out.tif"}),
        ("water.below_cloud", ("dsm.tif", "out.tif"), {"water": -30.0}),
        ("cloud.rasters", (["dsm.tif", "other.tif"], "out"), {}),
    ],
)
def test_refused(tmp_path, monkeypatch, code, paths, options):
    monkeypatch.chdir(tmp_path)
    for name in ("dsm.tif", "other.tif"):
        write(tmp_path / name, bay())
    with refused(code):
        pcfix.correct_file(*paths, **FACTORED | options)
    assert {one.name for one in tmp_path.iterdir()} == {"dsm.tif", "other.tif"}


def test_no_way_back(tmp_path):
    dsm = write(tmp_path / "dsm.tif", bay())
    with refused("raster.no_restore", path=dsm):
        pcfix.restore_file(dsm, tmp_path / "out.laz")


def test_run(tmp_path):
    """All steps; the corrected raster has the grid of the input."""
    dsm = write(tmp_path / "dsm.tif", bay())
    pcfix.run(dsm, tmp_path / "out", **FACTORED)
    before, after = heights(dsm), heights(tmp_path / "out" / "corrected.tif")
    wet = before < LEVEL_M
    np.testing.assert_array_equal(after[~wet], before[~wet])
    expected = LEVEL_M - FACTOR * (LEVEL_M - before[wet])
    known = np.isfinite(after[wet])  # the others were noise: a few at the edges
    assert known.mean() > 0.95
    np.testing.assert_allclose(after[wet][known], expected[known], atol=0.02)
    with rasterio.open(tmp_path / "out" / "depth.tif") as source:
        assert source.res == (0.5, 0.5)

"""Rasters of heights as clouds: truth, untouched land, stored types, and refused input.

The method factor multiplies the apparent depth and moves no point in plan, so that the height of
every cell under water is known exactly: level - factor (level - apparent height).
"""

import json
from types import SimpleNamespace

import laspy
import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import from_origin
from scipy.interpolate import griddata

import pcfix
from pcfix.flow import raster as flow
from pcfix.grid.lattice import Window
from tests.utils.codes import refused, warned
from tests.utils.program import run_pcfix
from tests.utils.shared import SCENE

LEVEL_M, FACTOR = 0.37, 1.4
FACTORED = {"water": LEVEL_M, "method": "factor", "depth_factor": FACTOR}
WORDS = ["--water", LEVEL_M, "--method", "factor", "--depth-factor", FACTOR]
EAST, NORTH = 500_000.0, 5_400_000.0


def bay():
    """Return heights of land that falls into water to the east, with a hole in each."""
    row, column = np.indices((60, 80))
    height = 3.0 - 0.1 * column + 0.2 * np.sin(row / 5.0)
    height[10:14, 5:9] = height[30:40, 60:70] = np.nan
    return height


def write(path, *bands, scale=1.0, offset=0.0, kinds=(), name="", unit="", **more):
    profile = {
        "driver": "GTiff", "height": 60, "width": 80, "count": len(bands), "dtype": "float32",
        "nodata": -9999.0, "crs": "EPSG:32633", "transform": from_origin(EAST, NORTH, 0.5, 0.5),
    } | more  # fmt: skip
    with rasterio.open(path, "w", **profile) as out:
        # GDAL loses these of a file with a vertical datum if they are set after the data
        out.scales, out.offsets = [scale] * len(bands), [offset] * len(bands)
        for number, band in enumerate(bands, start=1):
            values = (band - offset) / scale
            values = values if "float" in profile["dtype"] else np.rint(values)
            values[np.isnan(band)] = profile["nodata"] or 0
            out.write(values.astype(profile["dtype"]), number)
        if kinds:
            out.colorinterp = [getattr(ColorInterp, kind) for kind in kinds]
        if name or unit:
            out.set_band_description(1, name)
            out.set_band_unit(1, unit)
    return path


def stored(path):
    with rasterio.open(path) as source:
        return source.read(1)


def heights(path, band=1):
    """Return the heights of a raster, NaN for none."""
    with rasterio.open(path) as source:
        values = source.read(band, masked=True).astype(np.float64).filled(np.nan)
        return values * source.scales[band - 1] + source.offsets[band - 1]


STORED = [
    {},
    {"dtype": "float64", "nodata": np.nan},
    {"nodata": None},
    {"dtype": "int16", "nodata": -32768, "scale": 0.01, "offset": -20.0},
    {"dtype": "uint16", "nodata": 0, "scale": 0.005, "offset": -50.0},
]


@pytest.mark.parametrize("kind", STORED, ids=str)
def test_stored(tmp_path, kind):
    """Land keeps its bits, water gets its depth, and type, scale, grid and CRS stay."""
    apparent = bay()
    if kind == {"nodata": None}:
        apparent[np.isnan(apparent)] = -32767.0  # as Metashape has it
    dsm = write(tmp_path / "dsm.tif", apparent, **kind | {"crs": "EPSG:32633+5773"})
    out, depth = tmp_path / "out.tif", tmp_path / "depth.tif"
    summary = pcfix.correct_file(dsm, out, depth=depth, **FACTORED)
    with rasterio.open(dsm) as one, rasterio.open(out) as other:
        for same in ("transform", "dtypes", "scales", "offsets", "shape"):
            assert getattr(one, same) == getattr(other, same)
        assert "EGM96" in other.crs.to_wkt()
        assert other.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert json.loads(other.tags()["PCFIX"])["water_plane"] == [LEVEL_M, 0.0, 0.0]
    apparent, found, deep = heights(dsm), heights(out), heights(depth)
    apparent[apparent < -1000.0] = np.nan
    wet = apparent < LEVEL_M - 1e-9
    land = ~wet & np.isfinite(apparent)
    np.testing.assert_array_equal(stored(dsm)[land], stored(out)[land])
    np.testing.assert_array_equal(np.isnan(found), np.isnan(apparent))
    # points are rounded to 0.1 mm, and heights to the steps of the raster
    expected = LEVEL_M - FACTOR * (LEVEL_M - apparent)
    step = 1.1e-4 + kind.get("scale", 0.0) / 2.0
    np.testing.assert_allclose(found[wet], expected[wet], atol=step)
    np.testing.assert_array_equal(np.isfinite(deep), wet)
    np.testing.assert_allclose(deep[wet], LEVEL_M - expected[wet], atol=1.2e-3)  # of WaterDepth
    with rasterio.open(depth) as one:
        assert (one.crs.to_epsg(), one.descriptions, one.units) == (32633, ("depth",), ("metre",))
    assert (summary.output, summary.corrected) == (str(out), wet.sum())
    assert {one.name for one in tmp_path.iterdir()} == {"dsm.tif", "out.tif", "depth.tif"}


def test_deformed_grid():
    """Points of a plane that have moved in plan give the plane, in windows of any size."""
    row, column = np.indices((60, 60)).astype(np.float64)
    right, down = 2.5 + 0.8 * np.sin(row / 7.0), 0.7 * np.cos(column / 9.0)
    apparent = 0.3 * (column + right) - 0.2 * (row + down)
    apparent[20:22, 30:32] = np.nan  # a hole, which moves to the east
    cells = np.zeros((60, 60), flow.CELL)
    cells["shift"][..., 0], cells["shift"][..., 1], cells["code"] = right / 2, -down / 2, 1
    whole = Window(0, 60, 0, 60)
    source = SimpleNamespace(
        window=whole, read=lambda window: apparent[window.within(whole)],
        raster=SimpleNamespace(transform=from_origin(EAST, NORTH, 0.5, 0.5)),
    )  # fmt: skip
    one, parts = np.full((2, 60, 60), np.nan)
    for result, side in ((one, 60), (parts, 17)):
        for window in whole.parts(side):
            here = window.within(whole)
            wanted = np.isfinite(apparent[here])
            result[here] = flow._moved_heights(source, cells, window, wanted, margin=7)
    np.testing.assert_array_equal(one, parts)
    off = np.abs(one - 0.3 * column + 0.2 * row)
    assert off[2:-2, 20:26].max() < 2e-3  # of the curvature of the shift between two cells
    assert off[20:22, 33:36].max() < 0.2  # where the hole is now
    assert np.isnan(off[right[:, 0] > 2.1, 0]).all()  # more than two cells from any point


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return a folder with a DSM of the sample scene and rasters of its correction."""
    folder = tmp_path_factory.mktemp("raster")
    pcfix.grid_dsm(SCENE / "cloud.laz", folder / "dsm.tif", resolution=1.0, method="tin")
    names = ("depth", "shift", "uncertainty", "outcome")
    pcfix.correct_file(
        folder / "dsm.tif", folder / "out.tif", cameras=SCENE / "cameras.csv", water=LEVEL_M,
        method="snell", max_angle=None, **{name: folder / f"{name}.tif" for name in names},
    )  # fmt: skip
    return folder


def test_truth(scene):
    before, after = heights(scene / "dsm.tif"), heights(scene / "out.tif")
    las, (row, column) = laspy.read(SCENE / "truth.laz"), np.indices(before.shape)
    with rasterio.open(scene / "dsm.tif") as source:
        place = source.transform @ (column.ravel() + 0.5, row.ravel() + 0.5)
    origin = las.xyz.mean(axis=0)
    near, place = (las.xyz - origin)[:, :2], np.column_stack(place) - origin[:2]
    truth = griddata(near, las.z, place).reshape(before.shape)
    bed = truth < LEVEL_M - 0.2
    rmse = [np.sqrt(np.nanmean((one - truth)[bed] ** 2)) for one in (before, after)]
    assert rmse[0] > 2.0
    assert rmse[1] < 0.05  # cells of 1 m among stones of 0.5 to 2 m
    outcome, land = heights(scene / "outcome.tif"), before >= LEVEL_M
    np.testing.assert_array_equal(outcome, np.where(np.isnan(before), np.nan, ~land))
    np.testing.assert_array_equal(before[land], after[land])
    shift, depth = heights(scene / "shift.tif", 3), heights(scene / "depth.tif")
    # where the bed is level, cells have moved by their own shift
    np.testing.assert_allclose(np.nanmedian(after - before - shift), 0.0, atol=0.002)
    tvu, sigma = (heights(scene / "uncertainty.tif", band) for band in (1, 2))
    known = np.isfinite(depth)
    for one in (shift, tvu, sigma):
        np.testing.assert_array_equal(np.isfinite(one), known)
    np.testing.assert_allclose((depth + after)[known], LEVEL_M, atol=1e-3)
    np.testing.assert_allclose(tvu[known], 1.959964 * sigma[known], rtol=1e-6)
    assert np.nanmin(sigma) > 0.0


def test_corrected(scene, tmp_path):
    """A corrected raster is compared like a cloud with its water, and not corrected again."""
    for name, least, most in (("dsm.tif", 1.5, 3.0), ("out.tif", -0.02, 0.02)):
        water = {"water": LEVEL_M} if name == "dsm.tif" else {}
        found = pcfix.compare_clouds(scene / name, SCENE / "lidar.laz", submerged=True, **water)
        assert least < found.vertical.after.statistics.mean_m < most  # of cells of 1 m
    with refused("cloud.corrected"):
        pcfix.correct_file(scene / "out.tif", tmp_path / "again.tif", **FACTORED)
    with refused("raster.no_restore"):
        pcfix.restore_file(scene / "out.tif", tmp_path / "out.laz")


def test_label(tmp_path):
    pcfix.label_file(write(tmp_path / "dsm.tif", bay()), tmp_path / "out.tif", water=LEVEL_M)
    expected = np.where(np.isnan(bay()), 255, np.where(bay() < LEVEL_M, 40, 0))
    np.testing.assert_array_equal(stored(tmp_path / "out.tif"), expected)


def test_as_cloud(tmp_path):
    """An output that is a cloud has a point for each cell with a height."""
    pcfix.correct_file(write(tmp_path / "dsm.tif", bay()), tmp_path / "out.laz", **FACTORED)
    las = laspy.read(tmp_path / "out.laz")
    row, column = np.nonzero(np.isfinite(bay()))
    np.testing.assert_allclose(las.x, EAST + 0.5 * (column + 0.5), atol=1e-4)
    np.testing.assert_allclose(las.y, NORTH - 0.5 * (row + 0.5), atol=1e-4)
    np.testing.assert_array_equal(np.asarray(las["Outcome"]), bay()[row, column] < LEVEL_M)


def test_bands(tmp_path):
    """One band of several, by its number; transparent cells have no height."""
    write(tmp_path / "two.tif", np.full((60, 80), 300.0), bay(), kinds=("gray", "undefined"))
    with refused("raster.band", band=3):
        pcfix.correct_file(tmp_path / "two.tif", tmp_path / "out.tif", band=3, **FACTORED)
    done = run_pcfix("correct", "two.tif", "out.tif", "--band", 2, *WORDS, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    bands = np.nan_to_num(bay(), nan=1.0), np.where(np.isnan(bay()), 0.0, 255.0)
    clear = write(tmp_path / "clear.tif", *bands, nodata=None, kinds=("gray", "alpha"))
    pcfix.correct_file(clear, tmp_path / "same.tif", **FACTORED)
    np.testing.assert_array_equal(heights(tmp_path / "out.tif"), heights(tmp_path / "same.tif"))


BYTES = {"dtype": "uint8", "nodata": None}
NARROW = {"dtype": "int16", "nodata": -32768, "scale": 0.00016}
WRONG = [
    ("cloud.crs_unit", "degrees.tif", 1, {"crs": "EPSG:4326"}),
    ("raster.no_crs", "plain.tif", 1, {"crs": None}),
    ("raster.unit", "feet.tif", 1, {"unit": "ft"}),
    ("raster.depths", "depth.tif", 1, {"name": "depth"}),
    ("raster.bands", "bands.tif", 2, {"kinds": ("gray", "undefined")}),
    ("raster.type", "narrow.tif", 1, NARROW),
    ("raster.picture", "hillshade.tif", 1, BYTES),
    ("raster.picture", "rgb.tif", 3, {"kinds": ("red", "green", "blue")}),
    ("raster.picture", "picture.png", 3, BYTES | {"driver": "PNG"}),
    ("raster.picture", "picture.jpg", 3, BYTES | {"driver": "JPEG"}),
]


@pytest.mark.parametrize(("code", "name", "bands", "kind"), WRONG)
def test_wrong_raster(tmp_path, code, name, bands, kind):
    """Each gets one sentence with the name of the file, from all commands."""
    raster = write(tmp_path / name, *[bay()] * bands, **kind)
    before = {one.name for one in tmp_path.iterdir()}
    done = run_pcfix("correct", name, "out.tif", *WORDS, folder=tmp_path)
    assert (done.returncode, done.error.code) == (1, code)
    assert (done.stderr.count("\n"), name in done.stderr) == (1, True), done.stderr
    if code != "raster.type":  # these write no heights
        with refused(code):
            pcfix.label_file(raster, tmp_path / "out.tif", water=LEVEL_M)
        with refused(code):
            pcfix.compare_clouds(raster, SCENE / "lidar.laz")
    assert {one.name for one in tmp_path.iterdir()} == before


def test_may_be_depths(tmp_path):
    dsm = write(tmp_path / "dsm.tif", np.maximum(LEVEL_M - bay(), 0.0))
    with warned("raster.depths"):
        pcfix.correct_file(dsm, tmp_path / "out.tif", **FACTORED)


REFUSED = [
    ("output.suffix", SCENE / "cloud.laz", "out.tif", {}),
    ("option.needs", SCENE / "cloud.laz", "out.laz", {"depth": "d.tif"}),
    ("option.needs", SCENE / "cloud.laz", "out.laz", {"band": 2}),
    ("output.is_input", "dsm.tif", "out.tif", {"depth": "out.tif"}),
    ("cloud.rasters", ["dsm.tif", "empty.tif"], "out", {}),
    ("raster.empty", "empty.tif", "out.tif", {}),
]


@pytest.mark.parametrize(("code", "input", "output", "options"), REFUSED)
def test_refused(tmp_path, monkeypatch, code, input, output, options):
    monkeypatch.chdir(tmp_path)
    write("dsm.tif", bay())
    write("empty.tif", np.nan * bay())
    with refused(code):
        pcfix.correct_file(input, output, **FACTORED | options)
    assert {one.name for one in tmp_path.iterdir()} == {"dsm.tif", "empty.tif"}


def test_run(tmp_path):
    """All steps; noise in the corrected raster is interpolated, or with few neighbours empty."""
    dsm = write(tmp_path / "dsm.tif", bay())
    with warned("raster.empty_cells"):
        pcfix.run(dsm, tmp_path / "out", **FACTORED)
    before, after = heights(dsm), heights(tmp_path / "out" / "corrected.tif")
    wet = before < LEVEL_M
    np.testing.assert_array_equal(after[~wet], before[~wet])
    off = np.abs(after[wet] - LEVEL_M + FACTOR * (LEVEL_M - before[wet]))
    assert (off < 0.001).mean() > 0.95
    assert np.nanmax(off) < 0.2  # the height of the next cell
    with rasterio.open(tmp_path / "out" / "depth.tif") as source:
        assert source.res == (0.5, 0.5)

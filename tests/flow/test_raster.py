"""Rasters of heights as clouds: truth, untouched land, stored types, and refused input.

The method factor multiplies the apparent depth and moves no point in plan, so that the height of
every cell under water is known exactly: level - factor (level - apparent height).
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import from_origin

import pcfix
from pcfix.flow import raster as flow
from pcfix.grid.lattice import Window
from tests.utils.codes import refused, warned
from tests.utils.program import run_pcfix
from tests.utils.shared import SCENE

LEVEL_M, FACTOR = 0.37, 1.4
FACTORED = {"water": LEVEL_M, "method": "factor", "depth_factor": FACTOR}
EAST, NORTH = 500_000.0, 5_400_000.0
WORDS = ["--water", LEVEL_M, "--method", "factor", "--depth-factor", FACTOR]


def bay(rows=60, columns=80):
    """Return heights of land that falls into water to the east, with a hole in each."""
    row, column = np.indices((rows, columns))
    height = 3.0 - 0.1 * column + 0.2 * np.sin(row / 5.0)
    height[10:14, 5:9] = height[30:40, 60:70] = np.nan
    return height


def write(path, *bands, dtype="float32", nodata=-9999.0, crs="EPSG:32633", scale=1.0, offset=0.0,
          cell=0.5, kinds=None, name="", unit="", driver="GTiff"):  # fmt: skip
    rows, columns = bands[0].shape
    profile = {
        "driver": driver, "height": rows, "width": columns, "count": len(bands), "dtype": dtype,
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
    height = bay()
    if kind == {"nodata": None}:
        height = np.where(np.isnan(height), -32767.0, height)  # as Metashape has it
    dsm = write(tmp_path / "dsm.tif", height, crs="EPSG:32633+5773", **kind)
    out, depth = tmp_path / "out.tif", tmp_path / "depth.tif"
    summary = pcfix.correct_file(dsm, out, depth=depth, **FACTORED)
    with rasterio.open(dsm) as one, rasterio.open(out) as other:
        for same in ("transform", "dtypes", "scales", "offsets", "shape"):
            assert getattr(one, same) == getattr(other, same)
        assert "EGM96" in other.crs.to_wkt()
        assert other.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert json.loads(other.tags()["PCFIX"])["water_plane"] == [LEVEL_M, 0.0, 0.0]
    apparent, found = heights(dsm), heights(out)
    apparent[apparent < -1000.0] = np.nan
    wet = apparent < LEVEL_M - 1e-9
    land = ~wet & np.isfinite(apparent)
    np.testing.assert_array_equal(stored(dsm)[land], stored(out)[land])
    np.testing.assert_array_equal(np.isnan(found), np.isnan(apparent))
    # points are rounded to 0.1 mm, and heights to the steps of the raster
    step = 1.1e-4 + kind.get("scale", 0.0) / 2.0
    expected = LEVEL_M - FACTOR * (LEVEL_M - apparent)
    np.testing.assert_allclose(found[wet], expected[wet], atol=step)
    deep = heights(depth)
    np.testing.assert_array_equal(np.isfinite(deep), wet)
    np.testing.assert_allclose(deep[wet], LEVEL_M - expected[wet], atol=1.2e-3)  # of WaterDepth
    with rasterio.open(depth) as one:
        assert (one.crs.to_epsg(), one.descriptions, one.units) == (32633, ("depth",), ("metre",))
    assert (summary.input, summary.output) == (str(dsm), str(out))
    assert summary.corrected == wet.sum()
    assert {one.name for one in tmp_path.iterdir()} == {"dsm.tif", "out.tif", "depth.tif"}


@pytest.mark.parametrize("side", [60, 17])
def test_deformed_grid(side):
    """Points of a plane that have moved in plan give the plane, in windows of any size."""
    row, column = np.indices((60, 60)).astype(np.float64)
    right, down = 2.5 + 0.8 * np.sin(row / 7.0), 0.7 * np.cos(column / 9.0)
    apparent = 0.3 * (column + right) - 0.2 * (row + down)
    apparent[20:22, 30:32] = np.nan  # a hole, which moves to the east
    cells = np.zeros((60, 60), flow.CELL)
    cells["shift"][..., 0], cells["shift"][..., 1], cells["code"] = right / 2, -down / 2, 1
    source = SimpleNamespace(
        window=Window(0, 60, 0, 60), read=lambda window: apparent[window.within(source.window)],
        raster=SimpleNamespace(transform=from_origin(EAST, NORTH, 0.5, 0.5)),
    )  # fmt: skip
    whole = flow._moved_heights(source, cells, source.window, np.isfinite(apparent), 7)
    found = np.full_like(whole, np.nan)
    for window in source.window.parts(side):
        here = window.within(source.window)
        wanted = np.isfinite(apparent[here])
        found[here] = flow._moved_heights(source, cells, window, wanted, 7)
    np.testing.assert_array_equal(found, whole)
    off = np.abs(found - 0.3 * column + 0.2 * row)
    assert off[2:-2, 20:26].max() < 2e-3  # of the curvature of the shift between two cells
    assert off[20:22, 33:36].max() < 0.2  # where the hole is now
    assert np.isnan(off[:, 0]).all()  # more than two cells from any point


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return a DSM of the sample scene, and what a correction with its cameras makes of it."""
    folder = tmp_path_factory.mktemp("raster")
    pcfix.grid_dsm(SCENE / "cloud.laz", folder / "dsm.tif", resolution=1.0, method="tin")
    names = ("depth", "shift", "uncertainty", "outcome")
    summary = pcfix.correct_file(
        folder / "dsm.tif", folder / "out.tif", cameras=SCENE / "cameras.csv", water=LEVEL_M,
        method="snell", max_angle=None, **{name: folder / f"{name}.tif" for name in names},
    )  # fmt: skip
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
    truth = truth_at(folder / "dsm.tif")
    before, after = heights(folder / "dsm.tif"), heights(folder / "out.tif")
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
    depth = heights(folder / "depth.tif")
    known = np.isfinite(depth)
    np.testing.assert_allclose((depth + after)[known], LEVEL_M, atol=1e-3)
    tvu, sigma = (heights(folder / "uncertainty.tif", band) for band in (1, 2))
    np.testing.assert_allclose(tvu[known], 1.959964 * sigma[known], rtol=1e-6)
    assert np.nanmin(sigma) > 0.0


def test_corrected(scene, tmp_path):
    """A corrected raster is compared like a cloud with its water, and not corrected again."""
    folder, _ = scene
    found = [
        pcfix.compare_clouds(path, SCENE / "lidar.laz", submerged=True, **water).vertical.after
        for path, water in ((folder / "dsm.tif", {"water": LEVEL_M}), (folder / "out.tif", {}))
    ]
    assert found[0].statistics.mean_m > 1.5
    assert abs(found[1].statistics.mean_m) < 0.02  # of cells of 1 m
    with refused("cloud.corrected"):
        pcfix.correct_file(folder / "out.tif", tmp_path / "again.tif", **FACTORED)
    with refused("raster.no_restore"):
        pcfix.restore_file(folder / "out.tif", tmp_path / "out.laz")


def test_label(tmp_path):
    dsm = write(tmp_path / "dsm.tif", bay())
    pcfix.label_file(dsm, tmp_path / "classes.tif", water=LEVEL_M)
    expected = np.where(np.isnan(bay()), 255, np.where(bay() < LEVEL_M, 40, 0))
    np.testing.assert_array_equal(stored(tmp_path / "classes.tif"), expected)


def test_part_as_cloud(tmp_path):
    """An output that is a cloud has a point for each cell within the bounds."""
    import laspy

    dsm = write(tmp_path / "dsm.tif", bay())
    box = (EAST + 20.0, NORTH - 30.0, EAST + 30.0, NORTH)
    for name in ("out.laz", "out.tif"):
        summary = pcfix.correct_file(dsm, tmp_path / name, bounds=box, **FACTORED)
    las, part = laspy.read(tmp_path / "out.laz"), bay()
    part[:, :40] = part[:, 60:] = np.nan
    row, column = np.nonzero(np.isfinite(part))
    assert summary.part["points"] == len(row)
    np.testing.assert_allclose(las.x, EAST + 0.5 * (column + 0.5), atol=1e-4)
    np.testing.assert_allclose(las.y, NORTH - 0.5 * (row + 0.5), atol=1e-4)
    np.testing.assert_array_equal(np.asarray(las["Outcome"]), bay()[row, column] < LEVEL_M)
    outside = np.isnan(part)
    np.testing.assert_array_equal(stored(tmp_path / "out.tif")[outside], stored(dsm)[outside])


def test_bands(tmp_path):
    """One band of several, by its number; transparent cells have no height."""
    high, alpha = np.full((60, 80), 300.0), np.where(np.isnan(bay()), 0.0, 255.0)
    write(tmp_path / "two.tif", high, bay(), kinds=("gray", "undefined"))
    with refused("raster.band", band=3):
        pcfix.correct_file(tmp_path / "two.tif", tmp_path / "out.tif", band=3, **FACTORED)
    done = run_pcfix("correct", "two.tif", "out.tif", "--band", 2, *WORDS, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    plain = np.nan_to_num(bay(), nan=1.0)
    clear = write(tmp_path / "clear.tif", plain, alpha, nodata=None, kinds=("gray", "alpha"))
    pcfix.correct_file(clear, tmp_path / "same.tif", **FACTORED)
    np.testing.assert_array_equal(heights(tmp_path / "out.tif"), heights(tmp_path / "same.tif"))


BYTES = {"dtype": "uint8", "nodata": 0}
WRONG = [
    ("cloud.crs_unit", "degrees.tif", 1, {"crs": "EPSG:4326", "cell": 1e-6}),
    ("raster.no_crs", "plain.tif", 1, {"crs": None}),
    ("raster.unit", "feet.tif", 1, {"unit": "ft"}),
    ("raster.depths", "depth.tif", 1, {"name": "depth"}),
    ("raster.bands", "bands.tif", 2, {"kinds": ("gray", "undefined")}),
    ("raster.type", "narrow.tif", 1, {"dtype": "int16", "nodata": -32768, "scale": 0.00016}),
    ("raster.picture", "hillshade.tif", 1, BYTES),
    (
        "raster.picture",
        "rgb.tif",
        3,
        BYTES | {"dtype": "uint16", "kinds": ("red", "green", "blue")},
    ),
    ("raster.picture", "picture.png", 3, BYTES | {"driver": "PNG"}),
    ("raster.picture", "picture.jpg", 3, BYTES | {"driver": "JPEG", "nodata": None}),
]


@pytest.mark.parametrize(("code", "name", "bands", "kind"), WRONG)
@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
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
    dsm = write(tmp_path / "dsm.tif", np.clip(0.1 * np.indices((60, 80))[1], 0.0, None))
    with warned("raster.depths"):
        pcfix.correct_file(dsm, tmp_path / "out.tif", **FACTORED)


@pytest.mark.parametrize(
    ("code", "paths", "options"),
    [
        ("output.suffix", (SCENE / "cloud.laz", "out.tif"), {}),
        ("option.needs", (SCENE / "cloud.laz", "out.laz"), {"depth": "d.tif"}),
        ("option.needs", (SCENE / "cloud.laz", "out.laz"), {"band": 2}),
        ("option.conflict", ("dsm.tif", "out.tif"), {"uncorrected": "drop"}),
        ("output.is_input", ("dsm.tif", "dsm.tif"), {}),
        ("output.is_input", ("dsm.tif", "out.tif"), {"depth": "out.tif"}),
        ("cloud.not_copc", ("dsm.tif", "out.tif"), {"read_resolution": 1.0}),
        ("cloud.bounds", ("dsm.tif", "out.tif"), {"bounds": "0,0,1,1"}),
        ("water.below_cloud", ("dsm.tif", "out.tif"), {"water": -30.0}),
        ("cloud.rasters", (["dsm.tif", "other.tif"], "out"), {}),
        ("raster.empty", ("other.tif", "out.tif"), {}),
    ],
)
def test_refused(tmp_path, monkeypatch, code, paths, options):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "dsm.tif", bay())
    write(tmp_path / "other.tif", np.nan * bay())
    with refused(code):
        pcfix.correct_file(*paths, **FACTORED | options)
    assert {one.name for one in tmp_path.iterdir()} == {"dsm.tif", "other.tif"}


def test_run(tmp_path):
    """All steps; the corrected raster has the grid of the input."""
    dsm = write(tmp_path / "dsm.tif", bay())
    with warned("raster.empty_cells"):  # which were noise
        pcfix.run(dsm, tmp_path / "out", **FACTORED)
    before, after = heights(dsm), heights(tmp_path / "out" / "corrected.tif")
    wet = before < LEVEL_M
    np.testing.assert_array_equal(after[~wet], before[~wet])
    expected = LEVEL_M - FACTOR * (LEVEL_M - before[wet])
    known = np.isfinite(after[wet])
    assert known.mean() > 0.95
    np.testing.assert_allclose(after[wet][known], expected[known], atol=0.02)
    with rasterio.open(tmp_path / "out" / "depth.tif") as source:
        assert source.res == (0.5, 0.5)

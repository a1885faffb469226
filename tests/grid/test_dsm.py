"""The raster as a whole: seams, files, surfaces, holes, and what is refused."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio

import pcfix
from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.flow import dsm as flow
from pcfix.flow import sorted_points
from pcfix.flow.dsm import grid_dsm
from pcfix.grid.lattice import round_resolution
from pcfix.io.las import source
from pcfix.io.rasters import read_raster
from pcfix.report.text import dsm_text
from tests.grid.clouds import EAST, NORTH, awkward, scattered, write
from tests.utils.gdal import HAS_STATISTICS
from tests.utils.nightly import mostly_nightly
from tests.utils.shared import ROOT

SCENE = ROOT / "samples" / "scene"
METHODS = ("mean", "median", "min", "max", "idw", "tin")


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
    "all": {"CHUNK_POINTS": 1234, "BIN_POINTS": 40, "BLOCK_CELLS": 32, "BLOCK_POINTS": 100},
}


@pytest.mark.filterwarnings("ignore::pcfix.errors.PcfixWarning")
@pytest.mark.parametrize("fill", mostly_nightly([None, 2.0], 2.0))
@pytest.mark.parametrize("method", mostly_nightly(METHODS, "median", "idw", "tin"))
def test_no_seams(awkward_cloud, tmp_path, monkeypatch, method, fill):
    """Chunks, squares of the store and windows of any size give the same raster, bit by bit."""

    def run(name):
        shade = tmp_path / f"{name}_shade.tif"
        files = {"hillshade": shade, "counts": tmp_path / f"{name}_counts.tif"}
        options = {"resolution": 0.3, "method": method, "fill": fill, **files}
        grid_dsm(awkward_cloud, tmp_path / f"{name}.tif", **options)
        return [read_raster(one).array for one in (tmp_path / f"{name}.tif", *files.values())]

    whole = run("whole")
    for name, sizes in SIZES.items():
        with monkeypatch.context() as patch:
            for key, value in sizes.items():
                for module in (source, flow, sorted_points):
                    if hasattr(module, key):
                        patch.setattr(module, key, value)
            patch.setattr(flow, "TIN_BLOCK_POINTS", sizes.get("BLOCK_POINTS", 400_000))
            parts = run(name)
        for one, other in zip(whole, parts, strict=True):
            np.testing.assert_array_equal(one, other, err_msg=name)


@pytest.mark.filterwarnings("ignore::pcfix.errors.PcfixWarning")
@pytest.mark.parametrize("method", METHODS)
def test_order_of_points_does_not_matter(tmp_path, method):
    xyz = scattered(3000, 20.0, 20.0)
    for name, rows in (("a", xyz), ("b", xyz[::-1])):
        write(tmp_path / f"{name}.las", rows)
        grid_dsm(tmp_path / f"{name}.las", tmp_path / f"{name}.tif", resolution=0.5, method=method)
    one, other = (read_raster(tmp_path / f"{n}.tif").array for n in "ab")
    np.testing.assert_array_equal(one, other)


def sloping(x, y):
    return 20.0 + 0.3 * (x - EAST) - 0.2 * (y - NORTH)


@pytest.mark.parametrize("method", METHODS)
def test_a_plane(tmp_path, method):
    """Four points a cell, alike about its centre, on a plane.

    Their heights are whole millimetres, so they lie on it, and float32 rounds by 1e-6 m at most
    up to 32 m. Lowest and highest are those of the points at the corners. Inverse distances reach
    into the cells around, which are not alike at the edge of the raster.
    """
    x, y = (
        grid.ravel() for grid in np.meshgrid(np.arange(0.25, 20, 0.5), np.arange(0.25, 15, 0.5))
    )
    x, y = x + EAST, y + NORTH
    cloud = write(tmp_path / "plane.las", np.column_stack([x, y, sloping(x, y)]))
    grid_dsm(cloud, tmp_path / "plane.tif", resolution=1.0, method=method)
    found = heights(tmp_path / "plane.tif")
    centre_x, centre_y = np.meshgrid(EAST + np.arange(20) + 0.5, NORTH + 14.5 - np.arange(15))
    corner = {"min": -0.125, "max": 0.125}.get(method, 0.0)
    expected = sloping(centre_x, centre_y) + corner
    part = (slice(1, -1),) * 2 if method == "idw" else ...
    np.testing.assert_allclose(found[part], expected[part], rtol=0, atol=2e-6)


def test_a_plane_between_scattered_points(tmp_path):
    """Triangles give the plane back wherever points lie; these are rounded to 1 mm in height."""
    xyz = scattered(3000, 30.0, 20.0)
    xyz[:, 2] = sloping(xyz[:, 0], xyz[:, 1])
    cloud = write(tmp_path / "plane.las", xyz)
    grid_dsm(cloud, tmp_path / "plane.tif", resolution=0.5, method="tin")
    found = heights(tmp_path / "plane.tif")
    x, y = np.meshgrid(EAST + 0.25 + np.arange(60) / 2, NORTH + 19.75 - np.arange(40) / 2)
    known = ~np.isnan(found)
    assert known[1:-1, 1:-1].all()
    np.testing.assert_allclose(found[known], sloping(x, y)[known], rtol=0, atol=5.1e-4)


def with_sigma(path, xyz, sigma):
    """Write a cloud with the dimension that a correction leaves, in tenths of a millimetre."""
    las = laspy.read(write(path, xyz, classes=40))
    las.add_extra_dim(
        laspy.ExtraBytesParams("SigmaZ", "uint16", scales=np.array([1e-4]), offsets=np.zeros(1))
    )
    las["SigmaZ"] = sigma
    las.write(path)
    return path


def test_uncertainty_is_the_root_mean_square_of_the_points(tmp_path):
    xyz = scattered(4000, 20.0, 15.0)
    sigma = np.round(np.random.default_rng(1).uniform(0.01, 0.3, 4000), 4)
    sigma[xyz[:, 0] < EAST + 8.0] = 0.0  # land
    path = with_sigma(tmp_path / "cloud.las", xyz, sigma)
    with pytest.raises(InputError, match="no dimension WaterDepth, of which the depth is made"):
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
    assert "m at 95 %, formal" in dsm_text(summary)


def test_any_dimension_has_its_mean(tmp_path):
    xyz = scattered(2000, 10.0, 10.0)
    path = write(tmp_path / "c.las", xyz)
    las = laspy.read(path)
    las.intensity[:] = 100.0 * (xyz[:, 0] - EAST)
    las.write(path)
    grid_dsm(path, tmp_path / "d.tif", resolution=1.0, what="intensity", style=True)
    with rasterio.open(tmp_path / "d.tif") as dsm:
        assert (dsm.descriptions, dsm.units) == (("intensity",), (None,))
        rows = dsm.read(1)[-10:, :10].mean(axis=0)
    np.testing.assert_allclose(rows, 100.0 * np.arange(0.5, 10.0), atol=8.0)
    assert "singlebandpseudocolor" in (tmp_path / "d.qml").read_text()


def test_a_resolution_is_chosen_by_the_distance_of_the_points(tmp_path):
    """Points at random: so many a cell are as many as those of the cells without any, too."""
    for count, side in ((4000, 40.0), (9000, 25.0)):
        cloud = write(tmp_path / "c.las", scattered(count, side, side))
        summary = grid_dsm(cloud, tmp_path / "d.tif", overwrite=True)
        assert 2.0 <= count / (side / summary.settings["resolution"]) ** 2 <= 4.0
        assert "chosen for 2 to 4 points each" in dsm_text(summary)


def test_a_pixel_is_the_least_side_of_a_cell():
    for spacing in np.geomspace(0.003, 30.0, 200):
        assert 1.99 < (round_resolution(spacing, 0.0) / spacing) ** 2 < 4.01
        assert round_resolution(spacing, 0.5) >= 0.5


@pytest.mark.parametrize("cog", [False, True])
def test_the_file(tmp_path, cog):
    cloud = write(tmp_path / "cloud.laz", scattered(20_000, 80.0, 70.0), crs="EPSG:32633+5773")
    shade = tmp_path / "shade.tif"
    with pytest.warns(PcfixWarning, match=r"resolution 0\.2 m is finer .* apart, so there are 0\."):
        grid_dsm(
            cloud, tmp_path / "d.tif", resolution=0.2, hillshade=shade, cog=cog,
            counts=tmp_path / "n.tif",
        )  # fmt: skip
    with rasterio.open(tmp_path / "n.tif") as counts:
        assert counts.descriptions == ("count", "spread")
        assert counts.crs.to_epsg() == 32633, "no vertical datum of what is no height"
        count, spread = counts.read()
    with rasterio.open(tmp_path / "d.tif") as dsm:
        assert dsm.descriptions == ("height",)
        assert dsm.dtypes == ("float32",)
        assert ("STATISTICS_MEAN" in dsm.tags(1)) is (cog and HAS_STATISTICS)
        assert dsm.nodata == -9999.0
        assert dsm.crs.to_wkt().count("32633") == 1
        assert "EGM96" in dsm.crs.to_wkt()
        assert dsm.overviews(1) == [2]
        assert dsm.profile["tiled"]
        assert dsm.profile["blockysize"] == 256
        assert dsm.profile["compress"] == "deflate"
        assert dsm.tags(ns="IMAGE_STRUCTURE")["PREDICTOR"] == "3"
        assert (dsm.tags(ns="IMAGE_STRUCTURE").get("LAYOUT") == "COG") is cog
        assert dsm.bounds == pytest.approx((EAST, NORTH, EAST + 80.0, NORTH + 70.0), abs=1e-6)
        assert json.loads(dsm.tags()["PCFIX"])["resolution"] == 0.2
        assert count.sum() == 20_000
        np.testing.assert_array_equal(dsm.read(1) == -9999.0, count == 0)
        np.testing.assert_array_equal(spread == -9999.0, count == 0)
    with rasterio.open(shade) as light:
        assert (light.dtypes, light.nodata, light.overviews(1)) == (("uint8",), 0, [2])
        np.testing.assert_array_equal(light.read(1) == 0, count == 0)
    assert {p.name for p in tmp_path.iterdir()} == {"cloud.laz", "d.tif", "n.tif", "shade.tif"}


@pytest.mark.skipif(shutil.which("gdalinfo") is None, reason="gdalinfo is not installed")
def test_gdalinfo_reads_it(tmp_path):
    cloud = write(tmp_path / "cloud.laz", scattered(2000, 9.99, 7.99))
    grid_dsm(cloud, tmp_path / "d.tif", resolution=0.5)
    command = ["gdalinfo", "-json", "-checksum", str(tmp_path / "d.tif")]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    info = json.loads(answer.stdout)
    assert info["size"] == [20, 16]
    assert [band["description"] for band in info["bands"]] == ["height"]
    assert not answer.stderr


def test_fills_are_marked(tmp_path):
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


@pytest.fixture(scope="module")
def corrected(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "corrected.laz"
    pcfix.correct_file(SCENE / "cloud.laz", path, cameras=SCENE / "cameras.csv", water=0.37)
    return path


@pytest.mark.parametrize(("method", "fill"), [("mean", None), ("tin", None), ("mean", 1.5)])
def test_the_scene_against_its_truth(corrected, tmp_path, method, fill):
    """A DSM of the corrected cloud is that of the true one.

    Corrected points lie where true ones do to within the image noise of 0.5 px, which the scene's
    GSD of 2.2 cm and intersections of a few rays make some centimetres in height. On cells of 2 m
    with 8 points of a slope of 1 in 8 a point that changes cells adds a few more, so half of the
    cells must agree to 1 cm, and 99 of 100 to 10 cm; uncorrected, the bed is metres too high.
    """
    inputs = {"ours": corrected, "truth": SCENE / "truth.laz", "apparent": SCENE / "cloud.laz"}
    found = {}
    for name, path in inputs.items():
        target = tmp_path / f"{name}.tif"
        summary = grid_dsm(path, target, resolution=2.0, method=method, fill=fill)
        left, _, _, top = summary.bounds_m
        column, row = round((left - 410_200.0) / 2.0), round((4_650_382.0 - top) / 2.0)
        found[name] = np.full((43, 62), np.nan)
        values = heights(target)
        found[name][row : row + values.shape[0], column : column + values.shape[1]] = values
    both = ~np.isnan(found["ours"] + found["truth"])
    assert both.sum() > 0.95 * 60 * 40
    error = np.abs(found["ours"] - found["truth"])[both]
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.99) < 0.10
    assert np.nanmax(found["apparent"] - found["truth"]) > 2.0


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


def test_the_header_may_be_wrong(tmp_path):
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


BAD = {
    "zero": ({"resolution": 0.0}, "resolution 0.0 must be at least"),
    "minus": ({"resolution": -1.0}, "resolution -1.0 must"),
    "nan": ({"resolution": float("nan")}, "resolution nan"),
    "infinite": ({"resolution": float("inf")}, "resolution inf"),
    "method": ({"method": "kriging"}, "method 'kriging' is not one of mean, median, min"),
    "surface": ({"surface": "water"}, "surface 'water' is not one of all, bed"),
    "fill": ({"fill": 0.0}, "fill 0.0 must be above 0"),
    "far": ({"fill": 2000.0}, "at most 1000, 1,000 cells"),
    "sun": ({"altitude": 0.0}, "altitude 0.0 must"),
    "azimuth": ({"azimuth": float("nan")}, "azimuth nan must be a finite number"),
    "rms": ({"what": "uncertainty", "method": "tin"}, "Leave --method and --fill out"),
    "what": ({"what": "Colour"}, "no dimension Colour; --what is one of height, depth, "),
    "suffix": ({"output": "d.asc"}, "written as GeoTIFF; end the name in .tif"),
    "shade": ({"hillshade": "h.png"}, "h.png: a raster is written as GeoTIFF"),
    "twice": ({"hillshade": "d.tif"}, "are the same file"),
    "folder": ({"output": "nowhere/d.tif"}, "does not exist; make it first"),
    "exists": ({"output": "there.tif"}, "the output exists; add --overwrite"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_settings(tmp_path, monkeypatch, case):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "c.las", scattered(500, 10.0, 10.0))
    Path("there.tif").touch()
    change, message = BAD[case]
    options = {"output": "d.tif", "resolution": 1.0} | change
    with pytest.raises(SettingError, match=message):
        grid_dsm("c.las", options.pop("output"), **options)
    assert {p.name for p in tmp_path.iterdir()} == {"c.las", "there.tif"}


def test_too_many_cells(tmp_path):
    cloud = write(tmp_path / "c.las", scattered(5000, 900.0, 300.0))
    with pytest.raises(SettingError, match=r"899,\d{3} x 299,\d{3} cells,.* 1,000,.*0\.0165 m or"):
        grid_dsm(cloud, tmp_path / "d.tif", resolution=0.001)
    assert [p.name for p in tmp_path.iterdir()] == ["c.las"]


def test_no_points_left(tmp_path):
    cloud = write(tmp_path / "c.las", scattered(50, 10.0, 10.0), classes=np.full(50, 7))
    with pytest.raises(InputError, match="all points are noise"):
        grid_dsm(cloud, tmp_path / "d.tif", resolution=2.0)
    with pytest.raises(InputError, match=r"no point of class 40 .bed. that is not withheld"):
        grid_dsm(cloud, tmp_path / "d.tif", resolution=2.0, surface="bed")
    assert [p.name for p in tmp_path.iterdir()] == ["c.las"]


@pytest.mark.parametrize(("crs", "unit"), [(4326, "degree"), (2263, "US survey foot")])
def test_not_in_metres(tmp_path, crs, unit):
    offsets = (15.0, 50.0, 0.0) if crs == 4326 else (EAST, NORTH, 0.0)
    xyz = scattered(50, 10.0, 10.0) - (EAST, NORTH, 0.0) + offsets
    cloud = write(tmp_path / "c.las", xyz, crs=crs, offsets=offsets)
    with pytest.raises(InputError, match=f"is in {unit}; reproject the cloud to one in metres"):
        grid_dsm(cloud, tmp_path / "d.tif", resolution=2.0)


def test_no_cog_driver(tmp_path, monkeypatch):
    cloud = write(tmp_path / "c.las", scattered(50, 10.0, 10.0))
    monkeypatch.setattr(rasterio.Env, "drivers", lambda self: {"GTiff": "GeoTIFF"})
    with pytest.raises(SettingError, match=r"has no COG driver.*leave --cog out"):
        grid_dsm(cloud, tmp_path / "d.tif", resolution=2.0, cog=True)


@pytest.mark.parametrize("content", [b"", b"not a raster", None])
def test_not_a_raster(tmp_path, content):
    path = tmp_path / "r.tif"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"r\.tif: (is damaged, or is not a raster|there is no)"):
        read_raster(path)


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("method", METHODS)
def test_very_few_points(tmp_path, method, count):
    """Points on one line make no triangle; all else has a height in each cell."""
    xyz = np.column_stack([EAST + np.arange(count), np.full(count, NORTH), np.full(count, 4.0)])
    cloud = write(tmp_path / "c.las", xyz, crs=None)
    summary = grid_dsm(cloud, tmp_path / "d.tif", resolution=1.0, method=method)
    assert (summary.width, summary.height, summary.crs) == (count, 1, None)
    expected = np.nan if method == "tin" else 4.0
    np.testing.assert_array_equal(heights(tmp_path / "d.tif"), np.full((1, count), expected))
    assert read_raster(tmp_path / "d.tif").crs is None


def test_no_harm_when_it_fails(tmp_path, monkeypatch):
    """Whatever breaks in the middle, an older raster stays and nothing else is left."""
    cloud = write(tmp_path / "c.las", scattered(500, 10.0, 10.0))
    (tmp_path / "d.tif").write_bytes(b"older")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(flow.rasters, "write_part", full)
    with pytest.raises(InputError, match=r"cannot be written .No space left"):
        grid_dsm(cloud, tmp_path / "d.tif", resolution=1.0, overwrite=True)
    assert {p.name for p in tmp_path.iterdir()} == {"c.las", "d.tif"}
    assert (tmp_path / "d.tif").read_bytes() == b"older"


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


def test_a_stray_point_does_not_make_the_raster_huge(tmp_path):
    cloud = laspy.read(SCENE / "cloud.laz")
    cloud.x[5] += 200_000.0
    cloud.write(tmp_path / "stray.laz")
    with pytest.warns(pcfix.PcfixWarning, match="1 point lies far from all others .* at 610,"):
        found = pcfix.grid_dsm(tmp_path / "stray.laz", tmp_path / "d.tif", resolution=1.0)
    whole = pcfix.grid_dsm(SCENE / "cloud.laz", tmp_path / "w.tif", resolution=1.0)
    assert (found.stray, found.points_used) == (1, 19_999)
    assert (found.width, found.height) == (whole.width, whole.height)
    with rasterio.open(tmp_path / "d.tif") as one, rasterio.open(tmp_path / "w.tif") as other:
        differ = one.read(1) != other.read(1)
    assert differ.sum() <= 1  # the cell that the point came from


def test_a_cloud_of_two_places_keeps_both(tmp_path):
    cloud = laspy.read(SCENE / "cloud.laz")
    cloud.x[: len(cloud.x) // 10] += 3_000.0
    cloud.write(tmp_path / "two.laz")
    found = pcfix.grid_dsm(tmp_path / "two.laz", tmp_path / "d.tif", resolution=1.0)
    assert (found.stray, found.points_used) == (0, 20_000)
    assert found.width > 3_000

"""The comparison of files, through Python and the command line."""

import csv
import importlib
import json
import math
import sys
import warnings

import laspy
import numpy as np
import pytest
from pyproj import CRS

import pcfix
from pcfix.flow.compare import compare_clouds
from tests.utils.clouds import write_las
from tests.utils.codes import refused
from tests.utils.rasters import write_raster
from tests.utils.shared import SCENE

LIDAR = SCENE / "lidar.laz"
EAST_M, NORTH_M = 410_000.0, 4_650_000.0
py4dgeo = pytest.mark.skipif(
    importlib.util.find_spec("py4dgeo") is None, reason="needs the extra m3c2"
)


def plane(count, seed, side_m=60.0, noise_m=0.01):
    """Return points on z = -2 - 0.05 x (x from the corner) with noise."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, side_m, (2, count))
    z = -2.0 - 0.05 * x + rng.normal(0.0, noise_m, count)
    return np.column_stack([x + EAST_M, y + NORTH_M, z])


def lifted(xyz, by_m):
    return xyz + np.array([0.0, 0.0, by_m])


@pytest.fixture(scope="module")
def corrected(tmp_path_factory):
    path = tmp_path_factory.mktemp("corrected") / "corrected.laz"
    pcfix.correct_file(SCENE / "cloud.laz", path, cameras=SCENE / "cameras.csv", water=0.37)
    return path


@pytest.fixture(scope="module")
def sample(corrected):
    return compare_clouds(corrected, LIDAR)


def test_correction(sample):
    before, after = (d.statistics for d in (sample.vertical.before, sample.vertical.after))
    assert sample.counts.compared == 20_000
    # refraction lifts the bed by a quarter of its depth, up to 12 m deep, three in four points wet
    assert before.mean_m > 1.0
    # what remains: image noise (GSD 2 cm, growing with depth) and the lidar's own
    assert abs(after.mean_m) < 0.02
    assert after.rmse_m < 0.05
    assert after.rmse_m < before.rmse_m / 20.0
    # the floor of C2C is half the reference's spacing of 0.7 m
    assert sample.c2c.after.statistics.mean_m < 0.4 < sample.c2c.before.statistics.mean_m


def test_depth_fit(sample):
    # 1 / 1.34 straight down; less under oblique rays, which a block always has
    assert 1 / 1.34 - 0.06 < sample.depth.before.slope < 1 / 1.34
    assert sample.depth.after.slope == pytest.approx(1.0, abs=0.005)
    assert abs(sample.depth.after.intercept_m) < 0.02
    assert sample.depth.after.r2 > 0.999
    assert sample.depth.after.count == sum(b.after.count for b in sample.depth_bins)
    deep = [b for b in sample.depth_bins if b.from_m >= 1.0]
    assert len(deep) == 12
    for one in deep:
        # at least a quarter of the depth before, never a twentieth after
        assert one.before.mean_m > 0.2 * one.from_m
        assert abs(one.after.mean_m) < 0.05
        assert one.after.count == one.before.count


def test_uncorrected_cloud(sample):
    plain = compare_clouds(SCENE / "cloud.laz", LIDAR)
    assert plain.depth is None
    assert plain.vertical.before is None
    assert "water.missing" in [note.code for note in plain.notes]
    with_water = compare_clouds(SCENE / "cloud.laz", LIDAR, water="0.37")
    assert with_water.vertical.after.statistics == plain.vertical.after.statistics
    # the shift dimensions give the same apparent cloud, to rounding of the coordinates
    assert with_water.depth.after.slope == pytest.approx(sample.depth.before.slope, abs=1e-4)
    before = sample.vertical.before.statistics
    assert with_water.vertical.after.statistics.rmse_m == pytest.approx(before.rmse_m, abs=1e-6)


@pytest.mark.parametrize("lift", [0.03, -0.03])
def test_lifted_plane(lift, tmp_path):
    reference = write_las(tmp_path / "ref.laz", plane(40_000, 1))
    cloud = write_las(tmp_path / "cloud.laz", lifted(plane(20_000, 2), lift))
    has_m3c2 = importlib.util.find_spec("py4dgeo") is not None
    found = compare_clouds(cloud, reference, m3c2=has_m3c2)
    vertical = found.vertical.after.statistics
    # noise 1 cm per point, 20,000 points; 8 neighbours each, shared: under 0.3 mm
    assert vertical.mean_m == pytest.approx(lift, abs=0.0005)
    # 1 cm of the point, and its plane's: 1 cm times sqrt(1/8 to 1/2)
    assert 0.0105 < vertical.sd_m < 0.0125
    if has_m3c2:
        along = found.m3c2.after
        # along the normal of a slope of 5 %: 0.1 % shorter than along the vertical
        assert along.statistics.mean_m == pytest.approx(lift, abs=0.0005)
        assert along.core_points == 20_000
        # 1.96 times 1 cm of noise over some 28 and more points of each cloud
        assert 0.001 < along.mean_level_of_detection_m < 0.01
        assert along.significant_share > 0.95


def test_ignored_points(tmp_path):
    xyz = plane(3000, 5)
    classes, withheld = np.zeros(3000, int), np.zeros(3000, int)
    classes[:300], classes[300:400], withheld[400:500] = 7, 18, 1
    xyz[:500, 2] += 50.0
    spoilt = lifted(plane(3500, 6), 0.0)
    spoilt[:500, 2] += 80.0
    of_reference = np.r_[np.full(300, 7), np.full(100, 9), np.full(100, 41), np.full(3000, 2)]
    reference = write_las(tmp_path / "ref.las", spoilt, of_reference)
    found = compare_clouds(
        write_las(tmp_path / "a.las", xyz, classes, withheld=withheld), reference
    )
    assert (found.counts.cloud_excluded, found.counts.reference_excluded) == (500, 500)
    assert found.counts.compared == 2500
    assert found.vertical.after.statistics.max_m < 0.1


def test_outside_overlap(tmp_path):
    reference = write_las(tmp_path / "ref.las", plane(10_000, 7, side_m=30.0))
    cloud = plane(10_000, 8, side_m=60.0)
    found = compare_clouds(write_las(tmp_path / "a.las", cloud), reference, max_gap=1.0)
    inside = (cloud[:, :2] <= [EAST_M + 30.0, NORTH_M + 30.0]).all(axis=1).sum()
    within = (cloud[:, :2] <= [EAST_M + 33.0, NORTH_M + 33.0]).all(axis=1).sum()
    assert inside <= found.counts.compared <= within
    assert found.counts.compared + found.counts.outside_overlap == 10_000


def test_check_points(tmp_path, corrected):
    cloud = write_las(tmp_path / "a.las", lifted(plane(30_000, 9), 0.05))
    checks = plane(12, 10, noise_m=0.0)
    rows = [f"P{i},{x:.3f},{y:.3f},{z:.4f}" for i, (x, y, z) in enumerate(checks)]
    (tmp_path / "checks.csv").write_text("\n".join(["name,x,y,z", *rows]) + "\n")
    with pytest.warns(pcfix.PcfixWarning):  # the table has no CRS
        found = compare_clouds(cloud, tmp_path / "checks.csv", water=0.0, submerged=True)
    assert found.measured_at == "reference"
    assert found.counts.compared == found.depth.after.count == 12
    # a plane through 8 points of 1 cm noise, 12 times: 1.5 mm; four of them
    assert found.vertical.after.statistics.mean_m == pytest.approx(0.05, abs=0.006)


def test_raster(tmp_path):
    side, step = 50, 1.0
    x = EAST_M + (np.arange(side) + 0.5) * step
    y = NORTH_M + side * step - (np.arange(side) + 0.5) * step
    height = -2.0 - 0.05 * (x[np.newaxis] - EAST_M) + 0.02 * (y[:, np.newaxis] - NORTH_M)
    height[:5, :5] = -9999.0
    corner = EAST_M, NORTH_M + side * step
    write_raster(tmp_path / "ref.tif", height, *corner, step, nodata=-9999.0, crs="EPSG:32633")
    rng = np.random.default_rng(11)
    u, v = rng.uniform(2.0, 40.0, (2, 5000))
    xyz = np.column_stack([u + EAST_M, v + NORTH_M, -2.0 - 0.05 * u + 0.02 * v + 0.25])
    found = compare_clouds(write_las(tmp_path / "a.las", xyz), tmp_path / "ref.tif")
    assert found.counts.reference == side * side
    assert found.counts.reference_excluded == 25
    # a wrong corner would give 0.035 m; coordinates are rounded to 1 mm
    assert found.vertical.after.statistics.mean_m == pytest.approx(0.25, abs=1e-4)
    assert found.vertical.after.statistics.max_m < 0.251


def test_water(tmp_path, sample):
    """Levels, planes and dimensions; the water that a corrected cloud knows itself."""
    reference = write_las(tmp_path / "ref.las", plane(9000, 12))
    xyz = lifted(plane(9000, 13), 0.1)
    cloud = write_las(tmp_path / "a.las", xyz, w_surf=np.full(9000, 0.5))
    one, *others = (
        compare_clouds(cloud, reference, water=water).depth
        for water in (0.5, "plane:0.5,0,0", "dim:w_surf")
    )
    assert others == [one, one]
    assert one.after.count == 9000
    assert one.after.intercept_m == pytest.approx(-0.1, abs=0.005)
    low = laspy.read(SCENE / "cloud.laz").header.mins
    tilt = f"plane:{0.37 - 1e-3 * low[0]},1e-3,0"
    for name, water in (("level", 0.37), ("tilted", tilt)):
        path = tmp_path / f"{name}.las"
        given = {"cameras": SCENE / "cameras.csv", "water": water, "dimensions": "minimal"}
        pcfix.correct_file(SCENE / "cloud.laz", path, **given)
        found = compare_clouds(path, LIDAR)
        assert found.vertical.before is None
        if name == "level":  # the depth that the full cloud stores per point is rounded to 1 mm
            slope = sample.depth.after.slope
            assert found.depth.after.slope == pytest.approx(slope, abs=1e-3)
        else:
            assert found.depth.after == compare_clouds(path, LIDAR, water=tilt).depth.after


def test_crs(tmp_path):
    """One CRS in two spellings, a missing one, and different ones."""
    wkt1 = CRS.from_epsg(32633).to_wkt("WKT1_GDAL")
    cloud = write_las(tmp_path / "a.las", plane(100, 16), crs=wkt1)
    other = write_las(tmp_path / "b.las", plane(100, 17), crs=32633)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compare_clouds(cloud, other).counts.compared == 100
    bare = write_las(tmp_path / "bare.las", plane(100, 18), crs=None)
    with pytest.warns(pcfix.PcfixWarning):
        compare_clouds(bare, other)
    compare_clouds(bare, bare)
    egm96 = write_las(tmp_path / "v1.las", plane(100, 15), crs="EPSG:32633+5773")
    egm2008 = write_las(tmp_path / "v2.las", plane(100, 15), crs="EPSG:32633+3855")
    assert compare_clouds(egm96, egm96).c2c.after.statistics.max_m == 0.0
    for files in (
        (egm96, egm2008),
        (other, write_las(tmp_path / "zone.las", plane(100, 15), crs=32634)),
        (write_las(tmp_path / "deg.las", plane(100, 15), crs=4326), LIDAR),
    ):
        with pytest.raises(pcfix.InputError):
            compare_clouds(*files)


def test_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "py4dgeo", None)
    cloud = write_las(tmp_path / "a.las", plane(100, 20))
    few = write_las(tmp_path / "few.las", plane(5, 21))
    far = write_las(tmp_path / "far.las", plane(100, 14) + np.array([5000.0, 0.0, 0.0]))
    for code, reference, options in [
        ("reference.too_few_points", few, {"max_gap": 100.0}),
        ("reference.no_overlap", far, {}),
        ("cloud.not_submerged", cloud, {"submerged": True}),
        ("cloud.not_submerged", cloud, {"submerged": True, "water": -99.0}),
        ("option.section", cloud, {"section": ["1,2"]}),
        ("output.no_folder", cloud, {"out_dir": tmp_path / "no" / "where"}),
        ("output.no_folder", cloud, {"out_dir": cloud}),
        ("library.missing", cloud, {"m3c2": True}),
    ]:
        with refused(code):
            compare_clouds(cloud, reference, **options)
    noise = write_las(tmp_path / "noise.las", plane(10, 22), 7)
    for name, content in [
        ("broken.tif", b"II*\0 no grid at all"), ("note.pdf", b"x"), ("t.csv", b"x,y,q\n1,2,3\n")
    ]:  # fmt: skip
        (tmp_path / name).write_bytes(content)
    for files, options in [
        ((noise, cloud), {}),
        ((cloud, noise), {}),
        *(((cloud, tmp_path / one), {}) for one in ("broken.tif", "note.pdf", "t.csv", "none.laz")),
        ((cloud, cloud), {"water": "dim:w_surf"}),
        *(((cloud, cloud), {"bin_width": width}) for width in (0.0, -1.0, math.nan, math.inf)),
        ((cloud, cloud), {"neighbours": 5}),
        ((cloud, cloud), {"max_gap": -1.0}),
    ]:
        with pytest.raises(pcfix.PcfixError):
            compare_clouds(*files, **options)


def test_output_files(tmp_path, corrected):
    out = tmp_path / "out"
    options = {"out_dir": out, "sections": 2, "summary": tmp_path / "s.json"}
    line = "410210,4650290,410310,4650300"
    found = compare_clouds(corrected, LIDAR, section=[line], **options)
    assert sorted(p.name for p in out.iterdir()) == [
        "compare.json", "depth_bins.csv",
        "section_01.csv", "section_02.csv", "section_03.csv",
    ]  # fmt: skip
    written = json.loads((out / "compare.json").read_text())
    assert written == json.loads((tmp_path / "s.json").read_text()) == found.as_dict()
    assert written["vertical"]["after"]["statistics"]["rmse_m"] < 0.05
    with (out / "depth_bins.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(found.depth_bins)
    assert float(rows[5]["bias_before_m"]) == pytest.approx(
        found.depth_bins[5].before.mean_m, abs=5e-5
    )
    with pytest.raises(pcfix.SettingError):
        compare_clouds(corrected, LIDAR, **options)
    compare_clouds(corrected, LIDAR, overwrite=True, **options)  # fewer sections
    assert [p.name for p in sorted(out.glob("section_*"))] == ["section_01.csv", "section_02.csv"]

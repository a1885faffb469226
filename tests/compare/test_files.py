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
import rasterio
from pyproj import CRS

import pcfix
from pcfix.compare import m3c2
from pcfix.compare.figures import CORRECTED_BEFORE
from pcfix.compare.statistics import own_of, statistics_of
from pcfix.flow.compare import compare_clouds
from pcfix.report.comparison import comparison_text, in_a_sentence
from tests.utils.program import run_pcfix
from tests.utils.shared import ROOT

SCENE = ROOT / "samples" / "scene"
LIDAR = SCENE / "lidar.laz"
EAST_M, NORTH_M = 410_000.0, 4_650_000.0
py4dgeo = pytest.mark.skipif(
    importlib.util.find_spec("py4dgeo") is None, reason="needs the extra m3c2"
)


def write_las(path, xyz, classes=0, crs=32633, withheld=0, **extra):
    """Write a cloud of mm steps and return its path."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(np.min(xyz, axis=0))
    for name in extra:
        header.add_extra_dim(laspy.ExtraBytesParams(name, "float64"))
    if crs is not None:
        header.add_crs(CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.xyz = np.asarray(xyz)
    las.classification = np.broadcast_to(classes, len(xyz))
    las.withheld = np.broadcast_to(withheld, len(xyz))
    for name, values in extra.items():
        las[name] = values
    las.write(path)
    return path


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


def test_correction_brings_the_sample_to_its_lidar(sample):
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


def test_depth_against_reference_depth_has_slope_one_after(sample):
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
    biases = [b.before.mean_m for b in sample.shore_bins]
    assert biases == sorted(biases)  # the bed falls away from the shore


def test_an_uncorrected_cloud_needs_to_be_told_its_water(sample):
    plain = compare_clouds(SCENE / "cloud.laz", LIDAR)
    assert plain.depth is None
    assert plain.vertical.before is None
    assert any("--water" in note for note in plain.notes)
    told = compare_clouds(SCENE / "cloud.laz", LIDAR, water="0.37")
    assert told.vertical.after.statistics == plain.vertical.after.statistics
    # the shift dimensions give the same apparent cloud, to rounding of the coordinates
    assert told.depth.after.slope == pytest.approx(sample.depth.before.slope, abs=1e-4)
    before = sample.vertical.before.statistics
    assert told.vertical.after.statistics.rmse_m == pytest.approx(before.rmse_m, abs=1e-6)


def test_submerged_leaves_out_the_land(corrected):
    wet = compare_clouds(corrected, LIDAR, submerged=True)
    classes = np.asarray(laspy.read(corrected).classification)
    assert wet.counts.compared == (classes == 40).sum()
    assert wet.counts.not_submerged == (classes != 40).sum()
    assert wet.depth.after.count == wet.counts.compared
    assert wet.shore_bins


def test_a_lifted_plane_is_found_to_be_lifted(tmp_path):
    reference = write_las(tmp_path / "ref.laz", plane(40_000, 1))
    cloud = write_las(tmp_path / "cloud.laz", lifted(plane(20_000, 2), 0.03))
    found = compare_clouds(cloud, reference).vertical.after.statistics
    # noise 1 cm per point, 20,000 points; 8 neighbours each, shared: under 0.3 mm
    assert found.mean_m == pytest.approx(0.03, abs=0.0005)
    # 1 cm of the point, and its plane's: 1 cm times sqrt(1/8 to 1/2)
    assert 0.0105 < found.sd_m < 0.0125


@py4dgeo
def test_m3c2_finds_the_lift_too_and_its_sign(tmp_path):
    reference = write_las(tmp_path / "ref.laz", plane(40_000, 1))
    for lift in (0.03, -0.03):
        cloud = write_las(tmp_path / "cloud.laz", lifted(plane(20_000, 2), lift))
        found = compare_clouds(cloud, reference, m3c2=True).m3c2.after
        # along the normal of a slope of 5 %: 0.1 % shorter than along the vertical
        assert found.statistics.mean_m == pytest.approx(lift, abs=0.0005)
        assert found.core_points == 20_000
        # 1.96 times 1 cm of noise over some 28 and more points of each cloud
        assert 0.001 < found.mean_level_of_detection_m < 0.01
        assert found.significant_share > 0.95


@py4dgeo
def test_m3c2_takes_fewer_core_points_and_says_nothing(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(m3c2, "MAX_CORE_POINTS", 700)
    first, again = (
        m3c2.m3c2_distances(lifted(plane(5000, 3), 0.1), plane(9000, 4), 1.0) for _ in range(2)
    )
    assert first == again
    assert first.core_points == 700
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


def test_without_py4dgeo_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "py4dgeo", None)
    with pytest.raises(pcfix.SettingError, match=r"pip install .*\[m3c2\]'"):
        compare_clouds(SCENE / "cloud.laz", LIDAR, m3c2=True)


def test_noise_and_withheld_points_do_not_count(tmp_path):
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
    assert (found.counts.cloud_left_out, found.counts.reference_left_out) == (500, 500)
    assert found.counts.compared == 2500
    assert found.vertical.after.statistics.max_m < 0.1


def test_points_outside_the_reference_are_left_out_and_counted(tmp_path):
    reference = write_las(tmp_path / "ref.las", plane(10_000, 7, side_m=30.0))
    cloud = plane(10_000, 8, side_m=60.0)
    found = compare_clouds(write_las(tmp_path / "a.las", cloud), reference, max_gap=1.0)
    inside = (cloud[:, :2] <= [EAST_M + 30.0, NORTH_M + 30.0]).all(axis=1).sum()
    within = (cloud[:, :2] <= [EAST_M + 33.0, NORTH_M + 33.0]).all(axis=1).sum()
    assert inside <= found.counts.compared <= within
    assert found.counts.compared + found.counts.outside_overlap == 10_000


def test_check_points_measure_the_surface_of_the_cloud(tmp_path, corrected):
    cloud = write_las(tmp_path / "a.las", lifted(plane(30_000, 9), 0.05))
    checks = plane(12, 10, noise_m=0.0)
    rows = [f"P{i},{x:.3f},{y:.3f},{z:.4f}" for i, (x, y, z) in enumerate(checks)]
    (tmp_path / "checks.csv").write_text("\n".join(["name,x,y,z", *rows]) + "\n")
    with pytest.warns(pcfix.PcfixWarning, match=r"checks\.csv names no CRS"):
        found = compare_clouds(cloud, tmp_path / "checks.csv", water=0.0, submerged=True)
    assert found.measured_at == "reference"
    assert found.counts.compared == found.depth.after.count == 12
    # a plane through 8 points of 1 cm noise, 12 times: 1.5 mm; four of them
    assert found.vertical.after.statistics.mean_m == pytest.approx(0.05, abs=0.006)


def test_a_grid_counts_by_the_centres_of_its_cells(tmp_path):
    side, step = 50, 1.0
    x = EAST_M + (np.arange(side) + 0.5) * step
    y = NORTH_M + side * step - (np.arange(side) + 0.5) * step
    height = -2.0 - 0.05 * (x[np.newaxis] - EAST_M) + 0.02 * (y[:, np.newaxis] - NORTH_M)
    height[:5, :5] = -9999.0
    with rasterio.open(
        tmp_path / "ref.tif", "w", driver="GTiff", width=side, height=side, count=1,
        dtype="float64", nodata=-9999.0, crs="EPSG:32633",
        transform=rasterio.transform.from_origin(EAST_M, NORTH_M + side * step, step, step),
    ) as grid:  # fmt: skip
        grid.write(height, 1)
    rng = np.random.default_rng(11)
    u, v = rng.uniform(2.0, 40.0, (2, 5000))
    xyz = np.column_stack([u + EAST_M, v + NORTH_M, -2.0 - 0.05 * u + 0.02 * v + 0.25])
    found = compare_clouds(write_las(tmp_path / "a.las", xyz), tmp_path / "ref.tif")
    assert found.counts.reference == side * side
    assert found.counts.reference_left_out == 25
    # a wrong corner would give 0.035 m; coordinates are rounded to 1 mm
    assert found.vertical.after.statistics.mean_m == pytest.approx(0.25, abs=1e-4)
    assert found.vertical.after.statistics.max_m < 0.251


@pytest.mark.parametrize("spec", ["plane:0.5,0,0", "dim:w_surf"])
def test_every_kind_of_water_gives_the_same_depths(tmp_path, spec):
    reference = write_las(tmp_path / "ref.las", plane(9000, 12))
    xyz = lifted(plane(9000, 13), 0.1)
    cloud = write_las(tmp_path / "a.las", xyz, w_surf=np.full(9000, 0.5))
    one, other = (compare_clouds(cloud, reference, water=water) for water in (0.5, spec))
    assert one.depth == other.depth
    assert one.depth.after.count == 9000
    assert one.depth.after.intercept_m == pytest.approx(-0.1, abs=0.005)


def test_minimal_dimensions_leave_the_level_and_no_apparent_cloud(tmp_path, sample):
    path = tmp_path / "minimal.las"
    words = {"cameras": SCENE / "cameras.csv", "water": 0.37, "dimensions": "minimal"}
    pcfix.correct_file(SCENE / "cloud.laz", path, **words)
    found = compare_clouds(path, LIDAR)
    assert found.vertical.before is None
    # the depth that the full cloud keeps per point is rounded to 1 mm
    assert found.depth.after.slope == pytest.approx(sample.depth.after.slope, abs=1e-3)


def refused(error, match, *paths, **options):
    with pytest.raises(error, match=match) as caught:
        compare_clouds(*paths, **options)
    assert "\n" not in str(caught.value)


def test_a_tilted_water_plane_stays_known_to_the_cloud(tmp_path):
    low = laspy.read(SCENE / "cloud.laz").header.mins
    tilt = f"plane:{0.37 - 1e-3 * low[0]},1e-3,0"
    corrected = tmp_path / "tilted.laz"
    pcfix.correct_file(
        SCENE / "cloud.laz", corrected, cameras=SCENE / "cameras.csv", water=tilt,
        dimensions="minimal",
    )  # fmt: skip
    said = compare_clouds(corrected, LIDAR).depth
    told = compare_clouds(corrected, LIDAR, water=tilt).depth
    assert said is not None
    assert said.after == told.after


def test_sections_of_an_earlier_comparison_go_with_it(tmp_path, corrected):
    folder = tmp_path / "out"
    compare_clouds(corrected, LIDAR, out_dir=folder, sections=3)
    compare_clouds(corrected, LIDAR, out_dir=folder, sections=1, overwrite=True)
    assert [path.name for path in folder.glob("section_*.csv")] == ["section_01.csv"]


def test_what_does_not_overlap_is_refused_with_both_places(tmp_path):
    far = write_las(tmp_path / "far.las", plane(100, 14) + np.array([5000.0, 0.0, 0.0]))
    refused(pcfix.GeometryError, r"do not overlap.*x 415000.*the reference in x 4102", far, LIDAR)


def test_different_crs_are_refused_with_both_names(tmp_path):
    other = write_las(tmp_path / "ref.las", plane(100, 15), crs=32634)
    refused(
        pcfix.InputError,
        "UTM zone 33N.*UTM zone 34N.*bring the reference",
        SCENE / "cloud.laz",
        other,
    )
    degrees = write_las(tmp_path / "deg.las", plane(100, 15), crs=4326)
    refused(pcfix.InputError, "is in degrees", degrees, LIDAR)
    first = write_las(tmp_path / "v1.las", plane(100, 15), crs="EPSG:32633+5773")
    second = write_las(tmp_path / "v2.las", plane(100, 15), crs="EPSG:32633+3855")
    refused(pcfix.InputError, "heights in EGM96 height.*EGM2008 height", first, second)
    assert compare_clouds(first, first).c2c.after.statistics.max_m == 0.0


def test_one_crs_in_two_spellings_is_one(tmp_path):
    wkt1 = CRS.from_epsg(32633).to_wkt("WKT1_GDAL")
    cloud = write_las(tmp_path / "a.las", plane(100, 16), crs=wkt1)
    other = write_las(tmp_path / "b.las", plane(100, 17), crs=32633)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compare_clouds(cloud, other).counts.compared == 100


def test_a_missing_crs_is_taken_on_trust_with_a_warning(tmp_path):
    bare = write_las(tmp_path / "a.las", plane(100, 18), crs=None)
    other = write_las(tmp_path / "b.las", plane(100, 19))
    with pytest.warns(pcfix.PcfixWarning, match=r"a\.las names no CRS; taken to be in WGS 84"):
        compare_clouds(bare, other)
    compare_clouds(bare, bare)


def test_bad_input_is_one_clear_sentence(tmp_path):
    cloud = write_las(tmp_path / "a.las", plane(100, 20))
    few = write_las(tmp_path / "few.las", plane(5, 21))
    noise = write_las(tmp_path / "noise.las", plane(10, 22), 7)
    broken = tmp_path / "broken.tif"
    broken.write_bytes(b"II*\0 no grid at all")
    text = tmp_path / "note.pdf"
    text.write_text("x")
    table = tmp_path / "t.csv"
    table.write_text("x,y,h\n1,2,3\n")
    bad = pcfix.InputError
    refused(pcfix.GeometryError, "5 points are too few.*neighbours", cloud, few, max_gap=100.0)
    refused(bad, "every point is withheld or of a class", noise, cloud)
    refused(bad, "every point is withheld or of a class", cloud, noise)
    refused(bad, "no point is of class 40 or below", cloud, cloud, submerged=True)
    refused(bad, "no point is of class 40 or below", cloud, cloud, submerged=True, water=-99.0)
    refused(bad, "not a readable GeoTIFF", cloud, broken)
    refused(bad, "not a reference that pcfix reads", cloud, text)
    refused(bad, "z missing", cloud, table)
    refused(bad, "no such file", cloud, tmp_path / "none.laz")
    refused(bad, "no dimension w_surf", cloud, cloud, water="dim:w_surf")
    setting = pcfix.SettingError
    for width in (0.0, -1.0, math.nan, math.inf):
        refused(setting, "bin width", cloud, cloud, bin_width=width)
    refused(setting, "neighbours 5 is less than 6", cloud, cloud, neighbours=5)
    refused(setting, "max-gap -1", cloud, cloud, max_gap=-1.0)
    refused(setting, "section '1,2' is not", cloud, cloud, section=["1,2"])
    refused(setting, "does not exist", cloud, cloud, out_dir=tmp_path / "no" / "where")


@pytest.mark.parametrize(("came", "twice"), [(1.0, True), (0.92, True), (0.75, False)])
def test_a_cloud_that_came_as_deep_as_the_reference_was_corrected_before(tmp_path, came, twice):
    true = plane(500, 24, noise_m=0.0)
    depth, up = -true[:, 2], np.array([0.0, 0.0, 1.0])
    shift = {"ShiftX": 0.0 * depth, "ShiftY": 0.0 * depth, "ShiftZ": -0.34 * came * depth}
    xyz = true + up * (depth * (1.0 - 1.34 * came))[:, np.newaxis]
    cloud = write_las(tmp_path / "cloud.las", xyz, 40, WaterDepth=-xyz[:, 2], **shift)
    found = compare_clouds(cloud, write_las(tmp_path / "lidar.las", true))
    assert (CORRECTED_BEFORE in found.notes) == twice
    said = in_a_sentence(found.as_dict())
    assert (CORRECTED_BEFORE in said) == ("bed grew" in said) == twice
    assert found.tvu.count == 500


def test_equal_clouds_differ_by_nothing(tmp_path):
    cloud = write_las(tmp_path / "a.las", plane(500, 23))
    found = compare_clouds(cloud, cloud)
    assert found.c2c.after.statistics.max_m == 0.0
    assert "equal" in found.c2c.after.normal.note


def test_files_are_written_whole_and_not_over_others(tmp_path, corrected):
    out = tmp_path / "out"
    options = {"out_dir": out, "sections": 2, "summary": tmp_path / "s.json"}
    line = "410210,4650290,410310,4650300"
    found = compare_clouds(corrected, LIDAR, section=[line], **options)
    assert sorted(p.name for p in out.iterdir()) == [
        "compare.json", "depth_bins.csv",
        "section_01.csv", "section_02.csv", "section_03.csv", "shore_bins.csv",
    ]  # fmt: skip
    said = json.loads((out / "compare.json").read_text())
    assert said == json.loads((tmp_path / "s.json").read_text()) == found.as_dict()
    assert said["vertical"]["after"]["statistics"]["rmse_m"] < 0.05
    with (out / "depth_bins.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(found.depth_bins)
    assert float(rows[5]["bias_before_m"]) == pytest.approx(
        found.depth_bins[5].before.mean_m, abs=5e-5
    )
    with pytest.raises(pcfix.SettingError, match="--overwrite"):
        compare_clouds(corrected, LIDAR, **options)
    compare_clouds(corrected, LIDAR, overwrite=True, **options)


def test_sections_show_the_bed_before_and_after(corrected):
    (found,) = compare_clouds(corrected, LIDAR, sections=1, corridor=2.0).sections
    heights = found.heights_m
    assert list(heights) == ["water", "apparent", "corrected", "reference"]
    deep = heights["reference"] < -3.0
    assert deep.sum() > 20
    # medians of a few dozen points of a few cm of noise, on a bed that falls one in ten
    assert np.nanmedian(np.abs(heights["corrected"] - heights["reference"])[deep]) < 0.1
    assert np.nanmin((heights["apparent"] - heights["reference"])[deep]) > 0.5
    np.testing.assert_allclose(heights["water"][deep], 0.37, atol=0.001)


def test_the_command_says_what_python_says(tmp_path, corrected, sample):
    words = [corrected, LIDAR, "--out-dir", tmp_path / "o", "--sections", "1"]
    done = run_pcfix("compare", *words)
    assert done.returncode == 0, done.stderr
    assert f"dZ after{sample.vertical.after.statistics.mean_m:21.3f}" in done.stdout
    assert "depth fit after" in done.stdout
    said = json.loads((tmp_path / "o" / "compare.json").read_text())
    assert said["c2c"]["after"]["statistics"] == sample.as_dict()["c2c"]["after"]["statistics"]
    quiet = run_pcfix("compare", corrected, LIDAR, "--c2c-only", "--quiet")
    assert (quiet.returncode, quiet.stdout) == (0, "")


@pytest.mark.parametrize(
    ("stated", "rmse"),
    # the bias of 4 cm stays, of a scatter of 5 cm that of the reference goes: 3^2 = 5^2 - 4^2
    [(0.04, 0.05), (0.0, np.hypot(0.04, 0.05)), (0.05, None), (0.08, None)],
)
def test_the_noise_of_the_reference_is_taken_out_of_the_scatter_and_not_of_the_bias(stated, rmse):
    errors = statistics_of(0.04 + 0.05 * np.array([-1.0, 1.0] * 50))
    own = own_of(errors, "bed", stated, "cloud")
    assert (own.mean_m, own.is_assumed) == (pytest.approx(0.04), False)
    assert own.rmse_m == (None if rmse is None else pytest.approx(rmse))
    if rmse is not None:
        assert own.within_95_m / errors.within_95_m == pytest.approx(rmse / errors.rmse_m)


def test_without_a_word_the_noise_is_that_of_the_kind_of_reference(tmp_path):
    cloud = write_las(tmp_path / "a.las", plane(500, 31, noise_m=0.1), crs=None)
    lidar = write_las(tmp_path / "b.las", plane(500, 32, noise_m=0.0), crs=None)
    points = tmp_path / "points.csv"
    rows = (f"{x},{y},{z}" for x, y, z in plane(100, 33, noise_m=0.0))
    points.write_text("x,y,z\n" + "\n".join(rows))
    for reference, sigma in ((lidar, 0.03), (points, 0.02)):
        own = compare_clouds(cloud, reference).own
        assert (own.of, own.sigma_reference_m, own.is_assumed) == ("all", sigma, True)
    told = compare_clouds(cloud, lidar, sigma_reference=0.05)
    raw = told.vertical.after.statistics
    assert told.own.rmse_m == pytest.approx(np.sqrt(raw.rmse_m**2 - 0.05**2))
    assert f"RMSE {told.own.rmse_m:.3f} m" in comparison_text(told)
    assert "the reference's noise (0.050 m, stated)" in comparison_text(told)
    with pytest.raises(pcfix.SettingError, match=r"sigma-reference -0\.1 must be at least 0"):
        compare_clouds(cloud, lidar, sigma_reference=-0.1)

"""C2C in both directions, of several clouds, against scipy and numpy."""

import csv
import json
import math

import laspy
import numpy as np
import pytest
from scipy.spatial import cKDTree

import pcfix
from pcfix.compare.statistics import distribution_of
from pcfix.flow.compare import compare_clouds
from tests.compare.test_files import LIDAR, SCENE, lifted, plane, write_las
from tests.utils.codes import refused
from tests.utils.program import run_pcfix

ALL_POINTS = {"max_gap": 1000.0}  # no point is too far outside the other cloud
# Those of which Skarlatos & Agrafiotis 2018 give the share, at Amathounta and at Agia Napa.
BANDS = [(0.6, 1.0), (3.0, 6.0)]


@pytest.fixture(scope="module")
def corrected(tmp_path_factory):
    path = tmp_path_factory.mktemp("c2c") / "corrected.laz"
    pcfix.correct_file(SCENE / "cloud.laz", path, cameras=SCENE / "cameras.csv", water=0.37)
    return path


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    path = tmp_path_factory.mktemp("c2c") / "other.laz"
    given = {"cameras": SCENE / "cameras.csv", "water": 0.37, "method": "dietrich"}
    pcfix.correct_file(SCENE / "cloud.laz", path, **given)
    return path


@pytest.fixture(scope="module")
def both(corrected, other):
    given = {"direction": "both", "share": BANDS, "also": {"Dietrich": other}}
    return compare_clouds(corrected, LIDAR, sections=1, **given, **ALL_POINTS)


def places(path):
    return np.asarray(laspy.read(path).xyz)


def far(compared, reference):
    return cKDTree(reference).query(compared)[0]


def agrees(found, expected):
    """Check a distribution against distances that SciPy found; coordinates of 5e6 m, float64."""
    s, count = found.statistics, len(expected)
    assert s.count == count
    own = (expected.mean(), expected.std(), expected.max(), np.median(expected))
    np.testing.assert_allclose((s.mean_m, s.sd_m, s.max_m, s.median_m), own, rtol=0, atol=1e-8)
    classes = math.ceil(math.sqrt(count))
    assert len(found.histogram.counts) == classes
    counts, edges = np.histogram(expected, classes)
    np.testing.assert_allclose(found.histogram.edges_m, edges, rtol=0, atol=1e-8)
    # a distance on an edge falls to either side of it
    assert np.abs(np.cumsum(found.histogram.counts) - np.cumsum(counts)).max() <= 2
    for share, (low, high) in zip(found.shares, BANDS, strict=True):
        inside = np.count_nonzero((expected >= low) & (expected < high))
        assert share.share == pytest.approx(inside / count, abs=1.5 / count)


def test_directions(both, corrected):
    las, lidar = laspy.read(corrected), places(LIDAR)
    now = np.asarray(las.xyz)
    apparent = now - np.column_stack([las["ShiftX"], las["ShiftY"], las["ShiftZ"]])
    agrees(both.c2c.after, far(now, lidar))
    agrees(both.c2c.before, far(apparent, lidar))
    agrees(both.c2c_from_reference.after, far(lidar, now))
    agrees(both.c2c_from_reference.before, far(lidar, apparent))
    assert both.counts.reference_compared == len(lidar)


def test_further_cloud(both, other):
    (one,) = both.also
    assert (one.name, one.cloud) == ("Dietrich", str(other))
    agrees(one.c2c, far(places(other), places(LIDAR)))
    agrees(one.c2c_from_reference, far(places(LIDAR), places(other)))
    (section,) = both.sections
    assert list(section.heights_m)[-2:] == ["reference", "Dietrich"]
    single = compare_clouds(other, LIDAR, section=[section.line]).sections[0]
    np.testing.assert_array_equal(section.heights_m["Dietrich"], single.heights_m["corrected"])


def test_submerged(corrected):
    lidar, las = places(LIDAR), laspy.read(corrected)
    given = {"submerged": True, "direction": "from-reference", "water": 0.37}
    found = compare_clouds(
        corrected, LIDAR, also={"raw": SCENE / "cloud.laz"}, **given, **ALL_POINTS
    )
    wet = lidar[lidar[:, 2] < 0.37]
    assert 0 < found.counts.reference_compared == len(wet) < len(lidar)
    bed = np.asarray(las.xyz)[np.asarray(las.z) < 0.37]
    expected = far(wet, bed)
    after = found.c2c_from_reference.after.statistics
    assert after.mean_m == pytest.approx(expected.mean(), abs=1e-8)
    # the raw cloud is what the corrected one came as, but for rounding to the file's scale
    before = found.c2c_from_reference.before.statistics
    assert found.also[0].c2c_from_reference.statistics.mean_m == pytest.approx(
        before.mean_m, abs=0.001
    )
    # S: refraction left 0.4 and 2.2 m; here a bed of twelve metres
    assert before.mean_m > 1.5 > 0.5 > after.mean_m


@pytest.mark.parametrize(("count", "classes"), [(1_288_760, 1136), (2209, 47), (2210, 48), (1, 1)])
def test_classes_of_cloudcompare(count, classes):
    """1136 are those of Figure 18 of Skarlatos & Agrafiotis 2018, with so many points of LiDAR."""
    values = np.abs(np.random.default_rng(40).normal(0.5, 0.3, count))
    found = distribution_of(values)
    assert len(found.histogram.counts) == classes
    assert sum(found.histogram.counts) == count
    assert found.histogram.edges_m[-1] >= found.statistics.max_m
    assert len(distribution_of(values, 20).histogram.counts) == 20
    touching = [(0.0, 0.5), (0.5, 1.0), (1.0, 3.0)]
    shares = distribution_of(np.array([0.0, 0.5, 0.5, 1.0, 2.0]), None, touching).shares
    assert [one.share for one in shares] == [0.2, 0.4, 0.4]


def test_sparse_reference(tmp_path, corrected):
    """As at Amathounta, where the LiDAR of Skarlatos & Agrafiotis 2018 was a grid of 5 m."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(2.0, 60.0, 5.0), np.arange(2.0, 60.0, 5.0)))
    corner = plane(1, 1, side_m=0.0)[0, :2]
    grid = np.column_stack([x + corner[0], y + corner[1], -2.0 - 0.05 * x])
    reference = write_las(tmp_path / "grid.las", grid)
    cloud = write_las(tmp_path / "cloud.las", lifted(plane(90_000, 50), 0.2))

    def sparse(*files, **options):
        found = compare_clouds(*files, **options)
        return found, {note.code for note in found.notes} & {"reference.sparse", "cloud.sparse"}

    there, codes = sparse(cloud, reference)
    assert codes == {"reference.sparse"}
    # the mean distance to the nearest node of a grid of 5 m is 0.383 times that; not 0.2 m
    assert there.c2c.after.statistics.mean_m == pytest.approx(0.383 * 5.0, rel=0.05)
    back, codes = sparse(cloud, reference, direction="from-reference")
    assert not codes
    # points every 0.2 m: at most 2 cm beside the vertical
    assert back.c2c_from_reference.after.statistics.mean_m == pytest.approx(0.2, abs=0.03)
    assert sparse(reference, cloud, direction="from-reference")[1] == {"cloud.sparse"}
    assert sparse(cloud, reference, direction="both")[1] == {"reference.sparse"}
    assert not sparse(corrected, LIDAR)[1]


def test_settings_refused(tmp_path):
    cloud = write_las(tmp_path / "a.las", plane(100, 53))
    shares = ("1.0,0.6", "-1,2", "1,1", "x,1", "1", "1,2,3", "nan,1", "0,inf", (2.0, 1.0))
    also = ("a.las", "=a.las", "one=", "a,b=a.las", " =a.las", "a\tb=a.las", "water=a.las")
    other = write_las(tmp_path / "b.las", plane(100, 53), crs=32634)
    for options in [
        *({"share": [share]} for share in shares),
        *({"also": [one]} for one in also),
        {"also": ["one=a.las", "one=b.las"]},
        {"also": {"one": tmp_path / "none.las"}},
        {"also": {"one": other}},
        {"direction": "back"},
        {"plot": cloud, "overwrite": True},
    ]:
        with pytest.raises(pcfix.PcfixError):
            compare_clouds(cloud, cloud, **options)
    dry = {"direction": "from-reference", "submerged": True, "water": -3.0}
    high = write_las(tmp_path / "high.las", lifted(plane(100, 54), 50.0))
    with refused("reference.not_submerged", path=high):
        compare_clouds(cloud, high, **dry)


def test_command(tmp_path, both, corrected, other):
    done = run_pcfix(
        "compare", corrected, LIDAR, "--direction", "both", "--share", "0.6,1", "--share", "3,6",
        "--also", f"Dietrich={other}", "--max-gap", "1000", "--sections", "1", "--plot", "c.png",
        "--out-dir", "out", folder=tmp_path,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    written = json.loads((tmp_path / "out" / "compare.json").read_text())
    for name in ("c2c", "c2c_from_reference", "also"):
        assert written[name] == json.loads(json.dumps(both.as_dict()[name]))
    assert written["settings"]["also"] == [["Dietrich", str(other)]]
    assert (tmp_path / "c.png").read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "out" / "section_01.csv").open() as stream:
        assert next(csv.reader(stream))[-1] == "Dietrich_m"
    assert run_pcfix("compare", corrected, LIDAR, "--share", "-1,2").returncode == 1

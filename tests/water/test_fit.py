"""Water surfaces fitted to shoreline points: planes, levels, rivers; points without heights."""

import json
import math

import numpy as np
import pytest

from pcfix.io.vectors import read_shoreline
from pcfix.water.fit import fit_water, heights_from_cloud
from pcfix.water.river import fit_river, locate
from pcfix.water.surface import surface_above
from tests.utils.codes import refused
from tests.utils.nightly import mostly_nightly

UTM = np.array([512_345.0, 4_987_654.0])


def reach(seed, *, noise_m=0.025, n=30, share=0.2, length_m=200.0, width_m=25.0, tilt=0.003):
    """Return points on two banks, the corners of the river, their heights, and who is good."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0.0, 2.0 * np.pi)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    along = rng.uniform(-length_m / 2, length_m / 2, n)
    across = np.where(np.arange(n) % 2, 0.5, -0.5) * width_m + rng.normal(0.0, 1.0, n)
    z = 100.0 - tilt * along + rng.normal(0.0, noise_m, n)
    wrong = rng.permutation(n)[: round(share * n)]
    z[wrong] += rng.choice([-1.0, 1.0], len(wrong)) * rng.uniform(0.3, 2.0, len(wrong))
    corners = np.array([[i * length_m / 2, j * width_m / 2] for i in (-1, 1) for j in (-1, 1)])
    good = np.ones(n, bool)
    good[wrong] = False
    points = np.column_stack([UTM + np.column_stack([along, across]) @ axes, z])
    return points, UTM + corners @ axes, 100.0 - tilt * corners[:, 0], good


def height_at(fit, places):
    return surface_above(fit.surface, np.column_stack([places, places[:, :1]])).height_m


@pytest.mark.parametrize("noise_m", mostly_nightly([0.02, 0.03], 0.02))
def test_as_good_as_without_outliers(noise_m):
    error, known, masks = [], [], 0
    for seed in range(60):
        points, corners, true, good = reach(seed, noise_m=noise_m)
        fit = fit_water(points)
        masks += bool((fit.accepted == good).all())
        error.append(np.abs(height_at(fit, corners) - true).max())
        # the plane of least squares through the points that are right
        xy, z = points[good, :2] - UTM, points[good, 2]
        a, b, c = np.linalg.lstsq(np.column_stack([np.ones(len(z)), xy]), z, rcond=None)[0]
        known.append(np.abs(a + (corners - UTM) @ [b, c] - true).max())
    assert masks >= 59  # 0.3 m is ten sigma and more
    assert np.mean(error) < 1.05 * np.mean(known)


def test_standard_errors():
    scores, levels = [], []
    for seed in range(100):
        points, corners, true, _ = reach(seed, n=40)
        fit = fit_water(points, model="plane")
        scores.append((height_at(fit, corners) - true) / fit.sigma_at(corners))
        levels.append(fit.as_dict()["sigma_level_m"])
    # Student's t of about 29 degrees of freedom has the variance 1.07
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.04, abs=0.12)
    assert np.mean(levels) == pytest.approx(0.025 / math.sqrt(32), rel=0.1)


@pytest.mark.parametrize("share", mostly_nightly([0.0, 0.3, 0.4], 0.4))
def test_two_fifths_wrong(share):
    for seed in range(20):
        points, corners, true, _ = reach(seed, share=share, n=40)
        assert np.abs(height_at(fit_water(points), corners) - true).max() < 0.07  # 4 sigma


def test_tilt():
    xy = np.array([[x, y] for x in range(0, 100, 10) for y in range(0, 100, 10)], float)
    found = fit_water(np.column_stack([xy, 5.0 - 0.01 * xy[:, 0]]), model="plane").as_dict()
    assert (found["tilt_percent"], found["downhill_deg"]) == pytest.approx((1.0, 90.0))
    assert found["accepted"] == 100
    level = fit_water(np.column_stack([xy, xy[:, 0] * 0]), model="level").as_dict()
    assert level["downhill_deg"] is None


def model_of(points, **options):
    return fit_water(points, **options).as_dict()["model"]


def test_auto_level():
    models = [model_of(reach(seed, tilt=0.0)[0]) for seed in range(60)]
    # chance gives a tilt in 5 % of them: more than 9 of 60 in one case of 200
    assert models.count("level") >= 51


def test_auto_along():
    points = reach(4, width_m=0.0, n=40)[0]
    assert model_of(points) == "along"
    assert fit_water(points).as_dict()["tilt_percent"] == pytest.approx(0.3, abs=0.05)


def test_auto_plane():
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 100, (40, 2))
    z = 0.01 * xy[:, 1] + rng.normal(0, 0.02, 40)
    assert model_of(np.column_stack([xy, z])) == "plane"


@pytest.mark.parametrize(
    "xy", [np.zeros((5, 2)), np.zeros((2, 2)), np.eye(3)[:, :2], np.zeros((1, 2))]
)
def test_auto_of_few_points(xy):
    fit = fit_water(np.column_stack([xy, np.full(len(xy), 1.5)]))
    assert fit.as_dict()["model"] == "level"
    assert fit.surface.a == pytest.approx(1.5, abs=1e-12)
    assert fit.surface.b == fit.surface.c == 0.0
    assert math.isnan(fit.as_dict()["sigma_level_m"]) == (len(xy) == 1)


def test_rounded_heights():
    z = np.array([0.37] * 9 + [0.38] * 4 + [0.36] * 2)
    xy = np.random.default_rng(0).uniform(0, 50, (15, 2))
    assert fit_water(np.column_stack([xy, z])).accepted.all()


@pytest.mark.parametrize(
    ("points", "model", "code"),
    [
        (np.zeros((2, 3)), "plane", "water.too_few_points"),
        (np.zeros((1, 3)), "along", "water.too_few_points"),
        (np.zeros((5, 3)), "plane", "water.on_line"),
        (np.outer(np.arange(6), [10, 5, 0]), "plane", "water.on_line"),
        (np.full((4, 3), np.nan), "auto", "water.too_few_points"),
        (np.empty((0, 3)), "auto", "water.too_few_points"),
        ([[x, y, 0.08 * x] for x in range(9) for y in range(9)], "auto", "water.tilt"),
    ],
)
def test_fit_refused(points, model, code):
    with refused(code):
        fit_water(np.asarray(points, float), model=model)


WEIR_M = 300.5


def winding(seed, n, *, noise_m=0.025, share=0.15, length_m=500.0, width_m=20.0):
    """Return shoreline points of a winding river, places on it and their heights and stations.

    Pools fall 0.1 %, three riffles of 20 m fall 1.5 %, and a weir of 0.3 m is 1 m long.
    """
    rng = np.random.default_rng(seed)
    step = 0.15
    s = np.arange(-50.0, length_m + 50.0, step)
    angle = 0.9 * np.sin(2.0 * np.pi * s / 320.0) + rng.uniform(0.0, 6.0)
    axis = np.cumsum(np.column_stack([np.cos(angle), np.sin(angle)]) * step, axis=0) + UTM
    normal = np.column_stack([-np.sin(angle), np.cos(angle)])

    def place(station, away):
        i = np.searchsorted(s, station)
        return axis[i] + away[:, None] * normal[i]

    def height(station):
        z = 100.0 - 0.001 * station - 0.3 * np.clip(station - WEIR_M + 0.5, 0, 1)
        return z - sum(0.014 * np.clip(station - start, 0, 20) for start in (100, 200, 425))

    at = rng.uniform(0.0, length_m, n)
    away = np.where(rng.random(n) < 0.5, 0.5, -0.5) * width_m + rng.normal(0.0, 0.7, n)
    z = height(at) + rng.normal(0.0, noise_m, n)
    wrong = rng.permutation(n)[: round(share * n)]
    z[wrong] += rng.choice([-1, 1], len(wrong)) * rng.uniform(0.3, 2.0, len(wrong))
    asked = rng.uniform(0.0, length_m, 2000)
    places = place(asked, rng.uniform(-0.5, 0.5, 2000) * width_m)
    return np.column_stack([place(at, away), z]), places, height(asked), asked


def profile_at(fit, places):
    return np.interp(locate(fit.axis, places)[0], fit.station_m, fit.height_m)


def bounds_of(places, margin=10.0):
    return (*(places.min(axis=0) - margin), *(places.max(axis=0) + margin))


@pytest.mark.parametrize(
    ("n", "rms_m", "worst_m"),
    mostly_nightly([(80, 0.05, 0.30), (300, 0.02, 0.15)], (300, 0.02, 0.15)),
)
def test_winding_river(n, rms_m, worst_m):
    """More than 10 m from the weir; the worst is at the ends of riffles, between points."""
    for seed in range(6):
        points, places, true, asked = winding(seed, n)
        fit = fit_river(points, bounds_of(places))
        error = (profile_at(fit, places) - true)[np.abs(asked - WEIR_M) > 10.0]
        assert np.sqrt(np.mean(error**2)) < rms_m
        assert np.abs(error).max() < worst_m
        assert fit.sigma_m == pytest.approx(0.025, abs=0.012)
        assert fit.as_dict()["width_m"] == pytest.approx(20.0, rel=0.2)
        assert (np.diff(fit.height_m) < 1e-3).all()


def test_weir_and_raster():
    """The weir stays sharp; the raster has the heights of the profile, constant beyond its ends."""
    points, places, true, asked = winding(1, 400)
    fit = fit_river(points, bounds_of(places, 200.0))
    for low, high in ((280, 290), (312, 322)):
        near = (asked > low) & (asked < high)
        assert np.mean((profile_at(fit, places) - true)[near]) == pytest.approx(0.0, abs=0.03)
    calm = np.abs(asked - WEIR_M) > 20.0
    off = height_at(fit, places) - profile_at(fit, places)
    assert np.abs(off[calm]).max() < 0.02  # a cell beside a riffle's end
    ends = fit.height_m[[0, -1]]
    raster = fit.surface.height_m
    assert (raster.max(), raster.min()) == pytest.approx(tuple(ends), abs=1e-3)
    assert fit.as_dict()["drop_m"] == pytest.approx(ends[0] - ends[1])


@pytest.mark.parametrize(
    ("points", "bounds", "code"),
    [
        (np.zeros((9, 3)), (0, 0, 1, 1), "water.too_few_points"),
        (np.zeros((12, 3)), (0, 0, 1, 1), "water.too_few_points"),
        (winding(0, 20)[0], (0, 0, 0, 1), "cloud.no_extent"),
    ],
)
def test_river_refused(points, bounds, code):
    with refused(code):
        fit_river(points, bounds)


def test_heights_on_even_bank():
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 50, (40_000, 2))
    z = 3.0 + 0.1 * (xy[:, 0] - 25.0) + rng.normal(0, 0.02, len(xy))
    cloud = np.column_stack([xy, z])
    shore = np.column_stack([np.full(30, 25.0), np.linspace(5, 45, 30)])
    found = heights_from_cloud(shore, [cloud], 1.0)
    # median of 25 points of 0.02 m and a slope of 0.1 over 0.7 m: 0.007 m
    assert found == pytest.approx(np.full(30, 3.0), abs=0.03)
    pieces = np.array_split(cloud, 7)
    np.testing.assert_array_equal(heights_from_cloud(shore, pieces, 1.0), found)
    # fewer than three points, and none
    cloud = np.array([[0.0, 0, 1], [0.1, 0, 1], [0, 0.1, 2], [9, 9, 4]])
    found = heights_from_cloud(np.array([[0.0, 0], [9, 9], [50, 50]]), [cloud], 0.5)
    assert found[0] == 1.0
    assert np.isnan(found[1:]).all()


def drawn_by_hand(seed, folder, every_m=30.0, off_m=0.3):
    """Return what is read of a line along a beach of 300 m and 1 in 10, off at each vertex."""
    rng = np.random.default_rng(seed)
    along = np.arange(0.0, 301.0, every_m)
    vertices = np.column_stack([along, rng.normal(0.0, off_m, len(along))])
    path = folder / "shore.geojson"
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25830"}}
    line = {"type": "LineString", "coordinates": vertices.tolist(), "crs": crs}
    path.write_text(json.dumps(line))
    shore = read_shoreline(path)
    xyz = shore.xyz.copy()
    xyz[:, 2] = 0.1 * xyz[:, 1] + rng.normal(0.0, 0.004, len(xyz))  # medians of the cloud
    return xyz, shore.counts


@pytest.mark.filterwarnings("ignore::pcfix.PcfixWarning")  # the file names no CRS
def test_drawn_line(tmp_path):
    """Of 300 points along it 11 were drawn: its standard error is theirs."""
    level, sigma, naive = [], [], []
    drawn = [drawn_by_hand(seed, tmp_path) for seed in range(60)]
    for xyz, counts in drawn:
        fit = fit_water(xyz, model="level", counts=counts)
        level.append(fit.as_dict()["level_m"])
        sigma.append(fit.as_dict()["sigma_level_m"])
        naive.append(fit_water(xyz, model="level").as_dict()["sigma_level_m"])
    error, stated = np.sqrt(np.mean(np.square([level, sigma]), axis=1))
    assert 0.75 < error / stated < 1.3  # of 60: a standard deviation of 0.09
    assert error / np.mean(naive) > 4.0
    with_tilt = sum(model_of(xyz, counts=counts) != "level" for xyz, counts in drawn[:15])
    assert with_tilt <= 3  # of 15 at 5 %: more in 1 of 100 cases

"""The regression on check depths."""

import math

import numpy as np
import pytest

import pcfix
from pcfix.errors import GeometryError
from pcfix.flow.planning import fit_check_depths
from pcfix.model import Outcome, WaterPlane
from pcfix.options.correct import ScienceOptions
from pcfix.points.labelling import Part
from pcfix.refract.batch import Learned
from pcfix.refract.methods import correct
from pcfix.refract.regression import NEIGHBOURS, DepthRegression, apparent_depths, fit_depths
from pcfix.water.fit import FEWEST
from pcfix.water.surface import surface_above
from tests.utils.batches import batch_of
from tests.utils.codes import refused

ORIGIN = np.array([500_000.0, 4_600_000.0])
LEVEL = WaterPlane(12.0)
A, B = 0.05, 1.42
SETTINGS = ScienceOptions(method="regression")


def apparent_at(xy):
    """The apparent bed: an even slope from 0.1 m to 5 m of water over 50 m, level across."""
    return 0.1 + 0.098 * (xy[:, 0] - ORIGIN[0])


def cloud(n=20_000, seed=1, noise_m=0.0, water=LEVEL):
    rng = np.random.default_rng(seed)
    xy = ORIGIN + rng.uniform(0, 50, (n, 2))
    height = surface_above(water, np.column_stack([xy, np.zeros(n)])).height_m
    return np.column_stack([xy, height - apparent_at(xy) + rng.normal(0, noise_m, n)])


def parts(xyz, chunks=4, water=LEVEL, classes=None):
    given = np.ones(len(xyz), np.uint8) if classes is None else classes
    rows = np.array_split(np.arange(len(xyz)), chunks)
    return (Part(xyz[r], surface_above(water, xyz[r]), given[r]) for r in rows)


def places(p=30, seed=2):
    return ORIGIN + np.random.default_rng(seed).uniform(2, 48, (p, 2))


def table(tmp_path, xy, values, column="depth"):
    path = tmp_path / "checks.csv"
    rows = [f"{x:.4f},{y:.4f},{v:.6f}" for (x, y), v in zip(xy, values, strict=True)]
    path.write_text("\n".join([f"x,y,{column}", *rows]) + "\n")
    return path


def true_at(xy):
    return A + B * apparent_at(xy)


def test_known_line(tmp_path):
    xy = places()
    found = fit_check_depths(table(tmp_path, xy, true_at(xy)), parts(cloud()))
    # without noise; the median of 3 to 16 points within 0.7 m on a slope of 0.098 is off by some
    # centimetres, which 30 places bring down to a third of it
    assert found.intercept_m == pytest.approx(A, abs=0.05)
    assert found.slope == pytest.approx(B, abs=0.02)
    assert found.count == 30
    assert found.r2 > 0.999
    assert found.notes == ()
    assert 0.1 < found.shallowest_m < found.deepest_m < 5.0


def test_definitions():
    rng = np.random.default_rng(8)
    x = rng.uniform(0.2, 5.0, 15)
    y = A + B * x + rng.normal(0, 0.2, 15)
    design = np.column_stack([np.ones(15), x])
    answer, (squares,), _, _ = np.linalg.lstsq(design, y, rcond=None)
    covariance = np.linalg.inv(design.T @ design) * squares / 13
    errors = np.sqrt(np.diag(covariance))
    found = fit_depths(x, y)
    assert [found.intercept_m, found.slope] == pytest.approx(answer.tolist(), rel=1e-9)
    assert [found.intercept_se_m, found.slope_se] == pytest.approx(errors.tolist(), rel=1e-9)
    assert found.covariance_m == pytest.approx(covariance[0, 1], rel=1e-9)
    assert found.rmse_m == pytest.approx(math.sqrt(squares / 15), rel=1e-9)
    assert found.r2 == pytest.approx(1.0 - squares / ((y - y.mean()) ** 2).sum(), rel=1e-9)
    missed = []  # each one, by the line of the others
    for i in range(15):
        slope, intercept = np.polyfit(np.delete(x, i), np.delete(y, i), 1)
        missed.append(y[i] - intercept - slope * x[i])
    assert found.cv_rmse_m == pytest.approx(math.sqrt(np.mean(np.square(missed))), 1e-9)


def test_heights(tmp_path):
    tilted = WaterPlane(12.0 - 0.01 * ORIGIN[0] - 0.004 * ORIGIN[1], 0.01, 0.004)
    xy, xyz = places(), cloud(water=tilted)
    level = surface_above(tilted, np.column_stack([xy, np.zeros(30)])).height_m
    by_depth = fit_check_depths(table(tmp_path, xy, true_at(xy)), parts(xyz, water=tilted))
    by_height = fit_check_depths(
        table(tmp_path, xy, level - true_at(xy), "z"), parts(xyz, water=tilted)
    )
    # six decimals in the table, and heights at 4e6 m times 0.004 that lose 1e-9 m
    assert by_height.slope == pytest.approx(by_depth.slope, abs=2e-6)
    assert by_height.intercept_m == pytest.approx(by_depth.intercept_m, abs=4e-6)


def test_noise_and_land(tmp_path):
    xy, xyz = places(), cloud()
    path = table(tmp_path, xy, true_at(xy))
    single = fit_check_depths(path, parts(xyz))
    low, land = xyz - [0, 0, 9.0], xyz - [0, 0, -30.0]
    classes = np.repeat([1, 7, 1], len(xyz)).astype(np.uint8)
    mixed = fit_check_depths(path, parts(np.vstack([xyz, low, land]), classes=classes))
    assert mixed == single


def test_nearest_points():
    xyz, xy = cloud(3000, noise_m=0.1), places(8)
    depth, level, _, radius = apparent_depths(xy, parts(xyz, 7))
    for i, place in enumerate(xy):
        distance = np.hypot(*(xyz[:, :2] - place).T)
        wet = xyz[:, 2] < 12.0
        rows = np.argsort(np.where(wet, distance, np.inf))[:NEIGHBOURS]
        rows = rows[distance[rows] <= radius]
        assert len(rows) >= FEWEST
        assert depth[i] == pytest.approx(np.median(12.0 - xyz[rows, 2]), abs=1e-12)
        assert level[i] == 12.0


def test_check_depths_off_the_cloud(tmp_path):
    xy = places(12)
    xy[[3, 8]] += 200.0
    found = fit_check_depths(table(tmp_path, xy, true_at(xy)), parts(cloud()))
    assert found.count == 10
    assert "line 5" in str(found.notes[0])


def test_depths_refused(tmp_path):
    xy, far, flat = places(10), places(5), cloud()
    xy[:, 0] = np.sort(xy[:, 0])
    far[1:4] += 300.0
    flat[:, 2] = 10.0
    for code, at, values, column, points in (
        ("low_r2", xy, 3.0 + np.arange(10) % 2, "depth", cloud()),
        ("falling", xy, 9.0 - true_at(xy), "depth", cloud()),
        ("above_water", xy, np.full(10, 12.5), "z", cloud()),
        ("no_bed", far, true_at(far), "depth", cloud()),
        ("no_bed", far, true_at(far), "depth", cloud() - [0, 0, -50.0]),
        ("one_depth", places(9), np.full(9, 2.7), "depth", flat),
    ):
        with refused(f"check_depths.{code}", GeometryError) as error:
            fit_check_depths(table(tmp_path, at, values, column), parts(points))
        assert "checks.csv" in str(error.value)


def test_applied(tmp_path):
    xy, xyz = places(), cloud(500)
    found = fit_check_depths(table(tmp_path, xy, true_at(xy)), parts(cloud()))
    assert isinstance(found, DepthRegression)
    above = surface_above(LEVEL, xyz)
    cameras = pcfix.Cameras(("a",), np.array([[*ORIGIN, 100.0]]))
    result = correct(
        batch_of(xyz, above, LEVEL, cameras, SETTINGS, learned=Learned(regression=found))
    )
    assert (result.outcome == Outcome.CORRECTED).all()
    depth = 12.0 - xyz[:, 2]
    expected = found.intercept_m + found.slope * depth
    assert depth - result.shift_m[:, 2] == pytest.approx(expected, abs=1e-12)
    # the line itself is off by some centimetres, see the first test
    assert depth - result.shift_m[:, 2] == pytest.approx(true_at(xyz), abs=0.06)


def test_sigma_beyond_the_depths():
    line = DepthRegression(0.1, 1.4, 0.3, 0.1, 0.9, 0.2, 0.25, 20, 1.0, 4.0, -0.02)
    sigma = line.sigma_m(np.array([1.0, 2.5, 4.0, 8.0]))
    # 0.09 - 0.04 x + 0.01 x^2: 0.41 at 8 m, 0.09 at 4 m
    assert sigma == pytest.approx([0.25, 0.25, 0.25, np.sqrt(0.25**2 + 0.32)])

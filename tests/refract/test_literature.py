"""The literature's methods: exact where their geometry is, off by known amounts elsewhere."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pcfix
from pcfix.model import Outcome, Views, WaterPlane
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Learned
from pcfix.refract.methods import correct
from pcfix.refract.regression import DepthRegression
from pcfix.water.surface import surface_above
from tests.utils.batches import batch_of
from tests.utils.twins import light_path, refract_ray, stacked_intersection

UTM = np.array([512_345.678, 4_987_654.321, 0.0])
NANOMETRE = 1e-9  # doubles at UTM coordinates have steps of 1e-9 m; results are relative to P
LEVEL = WaterPlane(0.0)
BY_CAMERAS = ("shan", "butler", "murase", "dietrich")
MEANS = ("butler", "dietrich")
ALL = (*BY_CAMERAS, "factor", "regression")


def line(a=0.0, b=1.0):
    return DepthRegression(a, b, 0.0, 0.0, 1.0, 0.0, 0.0, 10, 0.0, 10.0)


def named(centres):
    return pcfix.Cameras(tuple(f"c{i}" for i in range(len(centres))), np.asarray(centres, float))


def run(method, points, centres, n=1.34, *, water=LEVEL, views=None, offset=None, **more):
    xyz = np.array(points, float)
    learned = Learned(regression=line(more.pop("a", 0.0), more.pop("b", n)))
    chosen = ScienceOptions(index=n, method=method, max_angle=90.0, **more)
    above = surface_above(water, xyz)
    return correct(
        batch_of(xyz, above, water, named(centres), chosen, views, offset, learned=learned)
    )


def block(k=6, seed=0, height=80.0, spread=50.0):
    rng = np.random.default_rng(seed)
    plan = rng.uniform(-spread, spread, (k, 2))
    return np.column_stack([plan, height + rng.normal(0, 2, k)]) + UTM


def bed(n=60, seed=1, deepest=10.0):
    rng = np.random.default_rng(seed)
    plan = rng.uniform(-20, 20, (n, 2))
    return np.column_stack([plan, -rng.uniform(0.01, deepest, n)]) + UTM


def seen_straight(true, centres, n):
    """Return the apparent point: where straight rays through the traced images meet best."""
    crossings = [light_path(true, c, (0.0, 0.0, 0.0), n) for c in centres]
    rays = [(a - c) / np.linalg.norm(a - c) for a, c in zip(crossings, centres, strict=True)]
    return stacked_intersection(centres, rays)


@pytest.mark.parametrize("method", ["snell", *ALL])
def test_index_one(method):
    found = run(method, bed(), block(), n=1.0)
    assert (found.outcome == Outcome.CORRECTED).all()
    assert np.abs(found.shift_m).max() < NANOMETRE


@pytest.mark.parametrize("n", [1.333, 1.42])
@pytest.mark.parametrize("method", ["snell", *ALL])
def test_straight_down(method, n):
    # two cameras almost overhead, 0.3 degrees apart from the vertical: the next term is
    # (n^2 - 1) / (2 n) depth tan^2 = 0.05 mm at 5 m
    found = run(method, [[0, 0, -5.0]], [[-0.5, 0, 100.0], [0.5, 0, 100.0]], n)
    assert 5.0 - found.shift_m[0, 2] == pytest.approx(5.0 * n, abs=1e-4)
    assert np.abs(found.shift_m[0, :2]).max() < NANOMETRE


@given(
    depth=st.floats(0.05, 20),
    aside=st.floats(-40, 40),
    base=st.floats(5, 60),
    n=st.floats(1.01, 1.5),
)
def test_same_incidence(depth, aside, base, n):
    # each line of sight lies in the vertical plane through its camera and the true point, so that
    # the apparent point lies on the plumb line of the true one and no method needs to move XY
    true = np.array([3.0, aside, -depth])
    centres = np.array([[3.0 - base / 2, 0, 70.0], [3.0 + base / 2, 0, 70.0]])
    apparent = seen_straight(true, centres, n)
    for method in BY_CAMERAS:
        found = run(method, [apparent], centres, n)
        # the crossings are known to 1e-9 m; a base of 5 m over 70 m multiplies that by 30
        assert apparent + found.shift_m[0] == pytest.approx(true, abs=1e-6)
        assert found.ray_miss_m[0] < 1e-6


def test_vertical_plane():
    # one camera straight above, one 40 m aside at 60 m: both rays pass the plumb line, at n d
    # and s d, and only the second says how deep the point is: d = D / s
    n, true = 1.34, np.array([0.0, 0.0, -5.0])
    centres = np.array([[0.0, 0, 60.0], [40.0, 0, 60.0]])
    apparent = seen_straight(true, centres, n)
    for method in ("shan", "murase"):
        found = run(method, [apparent], centres, n)
        assert apparent + found.shift_m[0] == pytest.approx(true, abs=1e-7)
    s, d = 5.0 / -apparent[2], -apparent[2]
    a = math.atan(40.0 / (60.0 + d))
    assert s == pytest.approx(math.tan(a) / math.tan(math.asin(math.sin(a) / n)), abs=1e-9)
    expected = d * (n + s) / 2.0
    for method in MEANS:
        found = run(method, [apparent], centres, n)
        assert d - found.shift_m[0, 2] == pytest.approx(expected, abs=1e-8)
        assert 4.75 < expected < 4.81  # 4 to 5 % too shallow: the steep ray has half a say


def angles(point, centre, n):
    """Return r of Hsu & Wang's eq 1, and i."""
    r = math.atan(math.dist(centre[:2], point[:2]) / (centre[2] - point[2]))
    return r, math.asin(math.sin(r) / n)


@pytest.mark.parametrize("images", [1, 6])
@pytest.mark.parametrize("method", MEANS)
def test_hsu_wang_1(method, images):
    points, centres = bed(), block()[:images]
    found = run(method, points, centres)
    for i, point in enumerate(points - UTM):
        depths = []
        for centre in centres - UTM:
            r, _ = angles(point, centre, 1.34)
            depths.append(-point[2] * math.tan(r) / math.tan(math.asin(math.sin(r) / 1.34)))
        assert -point[2] - found.shift_m[i, 2] == pytest.approx(np.mean(depths), abs=NANOMETRE)
    assert (found.shift_m[:, :2] == 0.0).all()
    assert (found.ray_count == images).all()


def by_eq_2(point, s1, s2, n):
    """Return the true depth of a stereo pair by Hsu & Wang's eqs 2 to 4, and its parallax."""
    (r1, i1), (r2, i2) = angles(point, s1, n), angles(point, s2, n)
    along = (s2 - s1)[:2] / math.dist(s1[:2], s2[:2])  # the axis X
    x_a, x_s1, x_s2 = point[:2] @ along, s1[:2] @ along, s2[:2] @ along
    cos1 = (x_a - x_s1) / math.dist(point[:2], s1[:2])
    cos2 = (x_s2 - x_a) / math.dist(point[:2], s2[:2])
    parallax = math.tan(i1) * cos1 + math.tan(i2) * cos2
    return (math.tan(r1) * cos1 + math.tan(r2) * cos2) / parallax * -point[2], parallax


@pytest.mark.parametrize("images", [2, 5])
def test_hsu_wang_2_to_4(images):
    points, centres = bed(), block(images)
    found = run("murase", points, centres)
    for i, point in enumerate(points - UTM):
        pairs = [by_eq_2(point, *two, 1.34) for two in itertools.combinations(centres - UTM, 2)]
        depth, parallax = np.array(pairs).T
        expected = np.average(depth, weights=parallax**2)
        # of the weakest pair here a nanometre of UTM becomes 30
        assert -point[2] - found.shift_m[i, 2] == pytest.approx(expected, abs=30 * NANOMETRE)
    assert (found.shift_m[:, :2] == 0.0).all()


def test_shan_ray_miss():
    points, centres = bed(20), block(4)
    found = run("shan", points, centres)
    for i, point in enumerate(points - UTM):
        square = 0.0
        for centre in centres - UTM:
            ray = (point - centre) / np.linalg.norm(point - centre)
            entry = point + ray * point[2] / -ray[2]
            refracted = refract_ray(ray, np.array([0.0, 0.0, 1.0]), 1.34)
            away = point + found.shift_m[i] - entry
            square += away @ away - (away @ refracted) ** 2
        assert found.ray_miss_m[i] == pytest.approx(math.sqrt(square / 4), abs=1e-9)


def test_few_rays():
    views = Views(np.array([0, 0, 1, 4]), np.array([2, 0, 1, 2]))
    xyz, cameras = bed(3), named(block(3))
    for methods, outcomes, counts in (
        (("shan", "murase"), "NO_CAMERA ONE_CAMERA CORRECTED", [0, 0, 3]),
        (MEANS, "NO_CAMERA CORRECTED CORRECTED", [0, 1, 3]),
        (("factor", "regression"), "CORRECTED CORRECTED CORRECTED", [1, 1, 3]),
    ):
        for method in methods:
            found = run(method, xyz, cameras.centres, views=views)
            assert [Outcome(value).name for value in found.outcome] == outcomes.split()
            assert found.ray_count.tolist() == counts
            assert (found.shift_m[found.outcome != Outcome.CORRECTED] == 0.0).all()


@pytest.mark.parametrize("method", BY_CAMERAS)
def test_offset_for_all(method):
    points, centres = bed(), block()
    higher = run(method, points, centres, water=WaterPlane(0.7))
    risen = run(method, points, centres, offset=np.full(6, 0.7))
    assert risen.shift_m == pytest.approx(higher.shift_m, abs=NANOMETRE)
    # water that fell below the point bends no ray
    fallen = run(method, points, centres, offset=np.full(6, -20.0))
    assert np.abs(fallen.shift_m).max() < NANOMETRE


@pytest.mark.parametrize("method", ALL)
def test_tilted_as_level(method):
    tilted = WaterPlane(-0.03 * UTM[0] + 0.01 * UTM[1], 0.03, -0.01)
    points, centres = bed(5) - [0, 0, 2.0], block()
    found = run(method, points, centres, water=tilted)
    for i, point in enumerate(points):
        height = surface_above(tilted, points[i : i + 1]).height_m[0]
        single = run(method, [point], centres, water=WaterPlane(height))
        # the plane's height at UTM is a difference of numbers near 4e4: 1e-11 m are lost there
        assert found.shift_m[i] == pytest.approx(single.shift_m[0], abs=NANOMETRE)


@given(
    method=st.sampled_from(ALL),
    depth=st.sampled_from([1e-12, 1e-6, 0.01, 1.0, 30.0]),
    aside=st.lists(st.sampled_from([0.0, 1e-9, 0.01, 5.0, 60.0, 3e4]), min_size=1, max_size=5),
    turn=st.lists(st.floats(0, 6.28), min_size=5, max_size=5),
    height=st.sampled_from([1e-3, 1.0, 60.0, 2000.0]),
    n=st.floats(1.0, 1.5),
)
def test_never_above_water(method, depth, aside, turn, height, n):
    centres = [
        [r * math.cos(a), r * math.sin(a), height] for r, a in zip(aside, turn, strict=False)
    ]
    found = run(method, [[0.0, 0.0, -depth]], centres, n)
    for values in (found.shift_m, found.ray_miss_m, found.sigma_z_m, found.incidence_deg):
        assert np.isfinite(values).all()
    assert -depth + found.shift_m[0, 2] <= 1e-12

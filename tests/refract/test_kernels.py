"""Both kernels, any number of threads, tiles and orders: the same bits."""

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pcfix
from pcfix.model import WaterPlane, WaterRaster
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import Learned
from pcfix.refract.matcher import matcher_of
from pcfix.refract.methods import correct
from pcfix.refract.tiling import TILE
from pcfix.running import threads
from pcfix.water.surface import surface_above
from tests.utils.batches import batch_of
from tests.utils.beyond_frames import BEYOND_FRAMES

pytestmark = BEYOND_FRAMES

snell = partial(pcfix.correct_points, method="snell", max_angle=None)

RNG = np.random.default_rng(7)
N = 2 * TILE + 17  # fewer than tell how a list was made, which SigmaZ would have


@pytest.fixture(scope="module")
def cameras(k=25):
    """Return nadir cameras with some tilt; each sees part of the points."""
    centres = np.column_stack([RNG.uniform(0, 100, (k, 2)), RNG.uniform(55, 65, k)])
    tilt = Rotation.from_euler("zyx", RNG.normal(0, [90, 5, 5], (k, 3)), degrees=True)
    rotations = np.diag([1.0, -1.0, -1.0]) @ tilt.as_matrix().transpose(0, 2, 1)
    lens = pcfix.Lens(3000.0, 4000.0, 3000.0, 2010.0, 1490.0)
    return pcfix.Cameras(tuple(map(str, range(k))), centres, rotations, (lens,) * k)


@pytest.fixture(scope="module")
def points():
    return np.column_stack([RNG.uniform(0, 100, (N, 2)), -RNG.uniform(0.1, 8, N)])


def same(one, other):
    for name in ("xyz", "outcome", "ray_count", "ray_miss_m", "incidence_deg", "sigma_z_m"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name


WAVES = WaterRaster(
    0.15 * np.sin(np.arange(-20.0, 120.0) / 4.0) * np.ones((140, 1)), -20.0, 120.0, (1.0, 1.0)
)
PAIRS = {"camera_set": "mvs", "matcher": "pairs"}
CASES = {
    "snell": {"method": "snell"},
    "snell, waves": {"method": "snell", "water": WAVES},
    "consistent": {"method": "consistent", "camera_set": "all"},
    "consistent, waves": {"method": "consistent", "camera_set": "all", "water": WAVES},
    **{name: {"method": name} for name in ("shan", "butler", "murase", "factor")},
    "depth maps": {"method": "consistent", "camera_set": "mvs", "matcher": "depth-maps"},
    "pairs": {"method": "consistent", **PAIRS},
}
OF_ALL = ("depth maps", "pairs")  # matchers depend on all points


def corrected(points, cameras, *, water=0.0, **how):
    return pcfix.correct_points(points, cameras, water, **how)


@pytest.mark.parametrize("case", CASES)
def test_any_threads_and_chunks(points, cameras, case):
    how, shuffled = CASES[case], np.random.default_rng(1).permutation(N)
    whole = corrected(points, cameras, **how)
    assert whole.corrected.any()
    for count in (1, 3):
        with threads(count):
            same(whole, corrected(points, cameras, **how))
    if case not in OF_ALL:
        assert np.array_equal(whole.xyz[shuffled], corrected(points[shuffled], cameras, **how).xyz)
        for i in range(0, N, 61):
            single = corrected(points[i : i + 1], cameras, **how)
            assert np.array_equal(single.xyz[0], whole.xyz[i])


@pytest.mark.parametrize("case", CASES)
def test_no_points(points, cameras, case):
    how, none = dict(CASES[case]), np.zeros((0, 3))
    water = how.pop("water", WaterPlane(0.0))
    learned = Learned(matcher=matcher_of(cameras, points) if "matcher" in how else None)
    above = surface_above(water, none)
    batch = batch_of(none, above, water, cameras, ScienceOptions(**how), learned=learned)
    assert correct(batch).shift_m.shape == (0, 3)


def test_max_angle(points, cameras):
    result = snell(points, cameras, 0.0, max_angle=15.0)
    assert 0 < result.incidence_deg.max() <= 15.0 + 1e-6
    assert set(result.outcome.tolist()) >= {pcfix.Outcome.CORRECTED, pcfix.Outcome.FLAT_RAYS}


def test_unusable_rays():
    two_at_one_place = pcfix.Cameras(("a", "b"), np.array([[0.0, 0, 50], [0, 0, 50]]))
    below = snell([[0, 0, -1.0]], two_at_one_place, 0.0)
    assert below.outcome.tolist() == [pcfix.Outcome.PARALLEL_RAYS]
    one = pcfix.Cameras(("a",), np.array([[0.0, 0, 50]]))
    result = snell([[3, 0, -1.0]], one, 0.0)
    assert result.outcome.tolist() == [pcfix.Outcome.ONE_CAMERA]
    assert result.xyz.tolist() == [[3, 0, -1.0]]
    assert result.depth_m.tolist() == [1.0]

"""The depth-bin table of Hsu & Wang on a simulated flume: what physics asks of each method.

The paper's own numbers are not asserted: its flume and its cameras are not those simulated here.
"""

import numpy as np
import pytest

import pcfix
from pcfix.errors import SettingError
from pcfix.flow.papers import flume_bins
from pcfix.report.papers import depth_bins_figure, depth_bins_rows, depth_bins_text
from pcfix.simulate.flume import GSD_M, simulate_flume
from pcfix.simulate.hsu_wang import METHODS, mean_of_cameras
from tests.utils.twins import light_path

COLUMN = {name: i for i, name in enumerate(METHODS)}


@pytest.fixture(scope="module")
def flume():
    return simulate_flume(seed=3)


@pytest.fixture(scope="module")
def bins(flume):
    return flume_bins(flume)


def test_the_flume_is_what_it_says(flume):
    assert flume.true_depth_m.min() > 0.0
    assert flume.true_depth_m.max() <= 0.6 + 1e-12
    assert np.diff(flume.views.start).min() >= 3
    ratio = (flume.true_depth_m / flume.apparent_depth_m)[flume.true_depth_m > 0.3]
    # oblique rays look shallower than n says, up to 43 degrees in air: 1.34 to 1.55
    assert 1.34 < ratio.min() < ratio.max() < 1.55


def test_straight_water_needs_no_method():
    flume = simulate_flume(300, refractive_index=1.0, image_noise_px=0.0)
    assert np.abs(flume.apparent_xyz - flume.true_xyz).max() < 1e-6  # m, the last Gauss-Newton step


def test_rays_bend_as_fermat_says():
    """The apparent point without noise lies within the bundle of its straight image rays."""
    flume = simulate_flume(3, image_noise_px=0.0, seed=5)
    for i in range(3):
        seen = flume.views.camera[flume.views.start[i] : flume.views.start[i + 1]]
        for centre in flume.cameras.centres[seen]:
            level = np.array([0.0, 0.0, flume.water_level_m])
            surface = light_path(flume.true_xyz[i] - level, centre - level, (0.0, 0.0, 0.0), 1.34)
            sight = surface + level - centre
            away = np.cross(flume.apparent_xyz[i] - centre, sight) / np.linalg.norm(sight)
            # m: rays of a refracted point miss each other by some per cent of its depth of 0.6 m
            assert np.linalg.norm(away) < 0.03


def test_uncorrected_grows_with_depth(bins):
    rmse = bins.rmse_m[:-1, COLUMN["uncorrected"]]
    assert (np.diff(rmse) > 0.0).all()
    middle = (bins.edges_m[:-1] + bins.edges_m[1:]) / 2.0
    # at least 1 - 1 / n of the depth is missing; the bins' own width smears it by a few per cent
    assert (rmse > 0.95 * (1.0 - 1.0 / 1.34) * middle).all()


def test_each_method_beats_the_one_before_it(bins):
    """In every bin deeper than 0.2 m: the shallow ones are the noise's."""
    deep = bins.rmse_m[2:-1]
    order = [COLUMN[name] for name in ("uncorrected", "I", "II", "III", "pcfix")]
    assert (np.diff(deep[:, order], axis=1) < 0.0).all()


def test_the_index_alone_leaves_the_bed_too_high(bins):
    """Factor n is the limit of vertical rays; slanted ones need more."""
    assert (bins.mean_m[:, COLUMN["I"]] > 0.0).all()
    assert bins.slope > 1.34
    assert bins.r2 > 0.999


def test_regression_has_no_mean_error_left(bins):
    # m: 60 check points of 2 mm, residuals of some mm about the line
    assert abs(bins.mean_m[-1, COLUMN["III"]]) < 0.001


def test_pcfix_reaches_the_noise_at_every_depth(bins):
    # half a pixel in some ten images gives about 0.5 mm of height; 1.3 GSD leaves room for chance
    assert (bins.rmse_m[:, COLUMN["pcfix"]] < 1.3 * GSD_M).all()


def test_method_two_lies_between_the_index_and_the_flattest_ray():
    """tan r / tan i is n straight down and grows with r."""
    flume = simulate_flume(200, seed=8)
    factor = mean_of_cameras(flume) / flume.apparent_depth_m
    widest = np.radians(50.0)  # the corner of the frame is 42 degrees off its axis, tilts are small
    most = np.tan(widest) / np.tan(np.arcsin(np.sin(widest) / 1.34))
    assert 1.34 < factor.min() < factor.max() < most


@pytest.mark.parametrize("method", ["factor", "dietrich"])
def test_the_correction_has_methods_one_and_two_as_well(flume, method):
    own = {
        "factor": flume.refractive_index * flume.apparent_depth_m,
        "dietrich": mean_of_cameras(flume),
    }
    corrected = pcfix.correct_points(
        flume.apparent_xyz, flume.cameras, flume.water_level_m, method=method, views=flume.views
    ).xyz
    depth = flume.water_level_m - corrected[:, 2]
    assert depth == pytest.approx(own[method], abs=1e-9)  # m, rounding


def test_check_points_are_left_out(flume, bins):
    assert bins.points.sum() == len(flume.true_xyz) - 10 * len(bins.points)


def test_the_page(bins):
    text = depth_bins_text(bins)
    assert len(text.splitlines()) == len(bins.points) + 3
    rows = depth_bins_rows(bins)
    assert [row["depth_m"] for row in rows] == [
        "0.0-0.1", "0.1-0.2", "0.2-0.3", "0.3-0.4", "0.4-0.5", "0.5-0.6", "all",
    ]  # fmt: skip
    assert rows[-1]["rmse_pcfix_mm"] == pytest.approx(1e3 * bins.rmse_m[-1, -1], abs=1e-3)
    assert depth_bins_figure(bins).axes


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        ({"points": 0}, "points 0 is less than 1"),
        ({"image_noise_px": -1.0}, "image noise -1 px is negative"),
        ({"refractive_index": 2.0}, "2"),
    ],
)
def test_mistakes_are_told(arguments, what):
    with pytest.raises(SettingError, match=what):
        simulate_flume(**arguments)

"""The experiment of Hsu & Wang, simulated: what physics asks of each method.

The paper's own table is not asserted: refraction does not explain it (see
`pcfix.simulate.hsu_wang`).
"""

import numpy as np
import pytest
from scipy.stats import linregress

from pcfix.errors import SettingError
from pcfix.flow.papers import bowl_bins
from pcfix.report.papers import depth_bins_figure, depth_bins_rows, depth_bins_text
from pcfix.simulate.hsu_wang import (
    EDGES_M,
    GSD_M,
    METHODS,
    PRINTED_RMSE_MM,
    WATER_LEVEL_M,
    bed_height_m,
    depth_bins,
    probe_line,
    simulate_bowl,
)
from tests.utils.twins import light_path

COLUMN = {name: i for i, name in enumerate(METHODS)}
SPACING_M = 2e-3


@pytest.fixture(scope="module")
def bowl():
    return simulate_bowl(SPACING_M, seed=3)


@pytest.fixture(scope="module")
def bins(bowl):
    return bowl_bins(bowl)


def test_the_bowl_is_what_it_says(bowl):
    depth = WATER_LEVEL_M - bowl.true_xyz[:, 2]
    assert np.hypot(*bowl.true_xyz[:, :2].T).max() < 0.075
    # m: 3 cm high, its rim 1 mm under water
    assert (depth.min(), depth.max()) == pytest.approx((0.001, 0.031), abs=0.002)
    assert len(bowl.cameras) == 24
    assert np.diff(bowl.views.start).min() >= 20  # the corner images cut a little off
    assert bowl.cameras.lenses[0].focal * 6.1e-6 == pytest.approx(0.060, abs=1e-12)
    ratio = depth / (WATER_LEVEL_M - bowl.apparent_xyz[:, 2])
    # rays of up to 12 degrees: (n^2 - 1) tan^2 a / (2 n) is 0.013; four times 0.08 mm of 20 mm
    assert 1.32 < ratio[depth > 0.02].min() < ratio[depth > 0.02].max() < 1.37


def test_straight_water_needs_no_method():
    bowl = simulate_bowl(0.02, refractive_index=1.0, image_noise_px=0.0)
    assert np.abs(bowl.apparent_xyz - bowl.true_xyz).max() < 1e-6  # m, the last Gauss-Newton step


def test_rays_bend_as_fermat_says():
    """The apparent point without noise lies within the bundle of its straight image rays."""
    bowl = simulate_bowl(0.03, image_noise_px=0.0, seed=5)
    level = np.array([0.0, 0.0, WATER_LEVEL_M])
    for i in range(len(bowl.true_xyz)):
        for centre in bowl.cameras.centres[
            bowl.views.camera[bowl.views.start[i] : bowl.views.start[i + 1]]
        ]:
            surface = light_path(bowl.true_xyz[i] - level, centre - level, (0.0, 0.0, 0.0), 1.34)
            sight = surface + level - centre
            away = np.cross(bowl.apparent_xyz[i] - centre, sight) / np.linalg.norm(sight)
            # m: rays of a refracted point at 12 degrees miss each other by a hundredth of 3 cm
            assert np.linalg.norm(away) < 0.0003


def test_the_uncorrected_error_is_what_refraction_takes(bins):
    rmse = bins.rmse_m[:-1, COLUMN["uncorrected"]]
    middle = (EDGES_M[:-1] + EDGES_M[1:]) / 2.0
    # a quarter of the depth by n, 1 % more by the slant; bins of 5 mm smear by 2 % at most
    assert rmse == pytest.approx((1.0 - 1.0 / 1.34) * middle, rel=0.04)
    assert (np.diff(rmse) > 0.0).all()
    printed = np.array(PRINTED_RMSE_MM["uncorrected"][:-1])
    assert (np.diff(printed) < 0.0).all()  # which refraction cannot do


@pytest.mark.parametrize("method", ["I", "II", "III", "pcfix"])
def test_every_method_reaches_the_noise(bins, method):
    # 0.2 px in 24 images whose places differ by 7 cm rms along a base: 0.2 px x 1 m / (9836 px x
    # 0.34 x sqrt(24) x 0.075) is 0.08 mm once the depth is 1.34 times as deep
    assert (bins.rmse_m[:, COLUMN[method]] < 1.3 * 0.08e-3).all()
    assert (np.abs(bins.mean_m[:, COLUMN[method]]) < 0.5 * GSD_M).all()


def test_the_mean_over_images_is_too_shallow(bins):
    """Slanting rays set the apparent depth, and have no more say than the steep ones."""
    assert (bins.mean_m[:, COLUMN["I"]] > 0.01e-3).all()
    assert np.abs(bins.mean_m[:, COLUMN["II"]]).max() < 0.01e-3


def test_the_line_is_that_of_sixteen_probes():
    true = np.linspace(0.001, 0.031, 500)
    offset, slope, r2 = probe_line(true / 1.34, true, seed=2)
    places = np.linspace(0, 499, 16).astype(int)
    noise = np.random.default_rng(2).normal(0.0, 1e-4, 16)
    line = linregress(true[places] / 1.34, true[places] + noise)
    assert (offset, slope, r2) == pytest.approx((line.intercept, line.slope, line.rvalue**2))
    assert slope == pytest.approx(1.34, abs=4 * line.stderr)


def test_errors_are_those_of_the_surface_model(bowl):
    """A point that slid along the bed is no error."""
    slid = bowl.true_xyz + np.array([0.001, 0.0, 0.0])
    slid[:, 2] = bed_height_m(slid[:, :2])
    found = depth_bins(bowl, dict.fromkeys(("I", "II", "pcfix"), slid))
    assert found.rmse_m[:, [COLUMN[name] for name in ("I", "II", "pcfix")]].max() < 1e-15


def test_the_page(bins):
    text = depth_bins_text(bins)
    assert len(text.splitlines()) == 2 * len(bins.points) + 3
    assert "8.320        7.511        6.188        2.080" in text
    rows = depth_bins_rows(bins)
    assert [row["depth_mm"] for row in rows] == ["10-15", "15-20", "20-25", "25-30", "overall"]
    assert rows[-1]["rmse_pcfix_mm"] == pytest.approx(1e3 * bins.rmse_m[-1, -1], abs=1e-3)
    assert depth_bins_figure(bins).axes


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        ({"spacing_m": 0.0}, "spacing 0 m is not between 0 and"),
        ({"image_noise_px": -1.0}, "image noise -1 px is negative"),
        ({"refractive_index": 2.0}, "2"),
    ],
)
def test_mistakes_are_told(arguments, what):
    with pytest.raises(SettingError, match=what):
        simulate_bowl(**arguments)

"""The experiment of Hsu & Wang, simulated: what physics asks of each method.

The paper's own table is not asserted: refraction does not explain it (see `tests.papers.hsu_wang`).
"""

import numpy as np
import pytest
from scipy.stats import linregress

from tests.papers.hsu_wang import (
    EDGES_M,
    GSD_M,
    METHODS,
    bowl_bins,
    probe_line,
    rows_of,
    simulate_bowl,
)

COLUMN = {name: i for i, name in enumerate(METHODS)}


@pytest.fixture(scope="module")
def bowl():
    return simulate_bowl(2e-3, seed=3)


@pytest.fixture(scope="module")
def bins(bowl):
    return bowl_bins(bowl)


def test_uncorrected(bins):
    rmse = bins.rmse_m[:-1, COLUMN["uncorrected"]]
    middle = (EDGES_M[:-1] + EDGES_M[1:]) / 2.0
    # a quarter of the depth by n, 1 % more by the slant; bins of 5 mm smear by 2 % at most
    assert rmse == pytest.approx((1.0 - 1.0 / 1.34) * middle, rel=0.04)
    # as printed, mm (their Fig 11): 8.32, 8.12, 7.28, 5.88, which refraction cannot do


@pytest.mark.parametrize("method", ["I", "II", "III", "pcfix"])
def test_methods(bins, method):
    # 0.2 px in 24 images whose places differ by 7 cm rms along a base: 0.2 px x 1 m / (9836 px x
    # 0.34 x sqrt(24) x 0.075) is 0.08 mm once the depth is 1.34 times as deep
    assert (bins.rmse_m[:, COLUMN[method]] < 1.3 * 0.08e-3).all()
    assert (np.abs(bins.mean_m[:, COLUMN[method]]) < 0.5 * GSD_M).all()


def test_butler_is_shallow(bins):
    """Slanting rays set the apparent depth, and have no more say than the steep ones."""
    assert (bins.mean_m[:, COLUMN["I"]] > 0.01e-3).all()
    assert np.abs(bins.mean_m[:, COLUMN["II"]]).max() < 0.01e-3


def test_probe_line():
    true = np.linspace(0.001, 0.031, 500)
    found = probe_line(true / 1.34, true, seed=2)
    places = np.linspace(0, 499, 16).astype(int)
    noise = np.random.default_rng(2).normal(0.0, 1e-4, 16)
    line = linregress(true[places] / 1.34, true[places] + noise)
    assert tuple(found) == pytest.approx(tuple(line))
    assert found.slope == pytest.approx(1.34, abs=4 * line.stderr)


def test_table(bins):
    rows = rows_of(bins)
    assert [row["depth_mm"] for row in rows] == ["10-15", "15-20", "20-25", "25-30", "overall"]
    assert rows[-1]["rmse_pcfix_mm"] == pytest.approx(1e3 * bins.rmse_m[-1, -1], abs=1e-3)

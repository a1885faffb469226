"""Standard errors in the terms of IHO S-44."""

import json
from pathlib import Path

import numpy as np
import pytest

import pcfix
from pcfix.compare.statistics import tvu_of
from pcfix.model import Correction, Outcome
from pcfix.refract.tally import Tally
from pcfix.report.text import (
    FEWEST,
    Summary,
    formal_words,
    order_sentence,
    summary_rows,
    tvu_sentence,
)

# Edition 6, table 1: the largest TVU at the surface and at 40 m, m, by hand
BY_HAND = {
    "Exclusive": (0.15, 0.3354),
    "Special": (0.25, 0.3905),
    "1a/1b": (0.5, 0.7214),
    "2": (1.0, 1.3588),
}


def tally_of(sigma, depth):
    n = len(sigma)
    corrected = Correction(
        apparent_xyz=np.zeros((n, 3)),
        shift_m=np.zeros((n, 3)),
        outcome=np.full(n, Outcome.CORRECTED, np.uint8),
        ray_count=np.full(n, 2, np.int32),
        ray_miss_m=np.zeros(n),
        depth_m=depth,
        incidence_deg=np.zeros(n),
        sigma_z_m=sigma,
        camera_used=np.ones(2, np.bool_),
        water_known=np.ones(n, np.bool_),
        lowest_water_m=0.0,
    )
    return Tally.of(corrected).uncertainty()


def test_shares_and_percentiles():
    # 1.96 sigma: 0.098, 0.196, 0.294, 0.588, 1.176 m, all at 0 m
    found = tally_of(np.array([0.05, 0.1, 0.15, 0.3, 0.6]), np.zeros(5))
    assert found["s44"] == {"Exclusive": 0.2, "Special": 0.4, "1a/1b": 0.6, "2": 0.8}
    assert found["sigma_z_m"] == {"mean": 0.24, "p5": 0.05, "p50": 0.15, "p95": 0.6, "max": 0.6}
    assert found["tvu_95_m"]["mean"] == pytest.approx(1.96 * 0.24, abs=5e-5)
    json.dumps(found)
    deep = tally_of(np.full(2, 0.1), np.array([0.0, 20.0]))  # TVU 0.196 m; 0.2121 m at 20 m
    assert deep["s44"]["Exclusive"] == 0.5


@pytest.mark.parametrize(
    ("shares", "order"),
    [((0.5, 0.9499, 0.95, 1.0), "1a/1b"), ((0.95, 1.0, 1.0, 1.0), "Exclusive"), ((0.0,) * 4, None)],
)
def test_strictest_order(shares, order):
    found = {"s44": dict(zip(BY_HAND, shares, strict=True))}
    assert (order or "no order") in tvu_sentence(found)


def test_measured_tvu():
    # 21 from 0 to 0.20 m at the surface, of which 16 are within 0.15 m, and 0.20 m at 20 m
    error, depth = np.append(np.arange(21) * 0.01, -0.2), np.append(np.zeros(21), 20.0)
    found = tvu_of(error, depth)
    assert found.s44 == {"Exclusive": round(17 / 22, 6), "Special": 1.0, "1a/1b": 1.0, "2": 1.0}
    assert found.tvu_95_m == pytest.approx(0.2 - 0.05 * 0.01)  # 95 % of 21 steps: 19.95 of them
    assert found.count == 22


@pytest.fixture(scope="module")
def summary(tmp_path_factory):
    scene = Path(__file__).parents[2] / "samples" / "scene"
    out = tmp_path_factory.mktemp("tvu") / "c.laz"
    return pcfix.correct_file(scene / "cloud.laz", out, cameras=scene / "cameras.csv", water=0.37)


def test_measured_replaces_predicted(summary):
    assert summary.why_no_order in order_sentence(summary)
    predicted = order_sentence(Summary(**vars(summary) | {"poses": {"absorbed": False}}))
    assert "Exclusive Order" in predicted
    far = tvu_of(np.full(100, 0.3), np.full(100, 2.0)).as_dict()
    rows = dict(summary_rows(summary, far))
    assert rows["Uncertainty"].endswith("(predicted)")
    assert rows["Measured"].startswith("0.300 m at 95 %, at 100 points")
    assert "Order 1a/1b" in rows["IHO S-44"] and "Exclusive" not in rows["IHO S-44"]
    few = tvu_of(np.full(FEWEST - 1, 0.01), np.full(FEWEST - 1, 2.0)).as_dict()
    assert f"fewer than {FEWEST} points" in order_sentence(summary, few)


def test_model_uncertainty(summary):
    made = summary.reconstruction
    found = {"scatter_m": made["scatter_m"], "per_depth": made["per_depth"]}
    assert summary.uncertainty["of_cloud"] == found
    assert found["per_depth"] > 0.0
    assert f"model uncertainty {100.0 * found['per_depth']:.1f} % of depth" in formal_words(summary)


def test_summary_rows(summary):
    rows = dict(summary_rows(summary))
    assert rows["Submerged"] == "14,736 points (74 %), all corrected"
    assert "Uncertainty" not in dict(summary_rows(Summary(**vars(summary) | {"uncertainty": None})))

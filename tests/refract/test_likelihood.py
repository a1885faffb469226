"""The likelihood of patches, against a slow twin, and of clouds whose types are known."""

import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import t as student

from pcfix.refract.patches import (
    FOLDS,
    FREEDOM,
    MODEL_ERROR,
    MOST_A_POINT,
    OUTLIER_GSD,
    Candidates,
    log_likelihood,
    smooth_surfaces,
    standard_errors,
)

GSD_M, LEVEL_M, POINTS = 0.05, 0.0, 32


def patches(count, rng):
    """Return points of patches 3 m wide, and the heights of a curved bed 4 m deep at them."""
    xy = rng.uniform(-1.5, 1.5, (count, POINTS, 2))
    slope, bow = rng.normal(0.0, 0.05, (2, count, 1))
    return xy, -4.0 + slope * xy[..., 0] + bow * xy[..., 1] ** 2


def likelihoods(xy, apparent, *candidates):
    """Return the log likelihoods of patches for candidates of several types."""
    terms, level = smooth_surfaces(np.dstack([xy, apparent])), np.full_like(apparent, LEVEL_M)
    return [log_likelihood(terms, apparent, level, one, GSD_M) for one in candidates]


def test_slow_twin():
    """One candidate for each point: a robust fit of each patch by a general minimiser."""
    rng = np.random.default_rng(1)
    xy, bed = patches(6, rng)
    apparent = bed / 1.34 + rng.normal(0.0, GSD_M, bed.shape)
    true, terms = 1.34 * apparent, smooth_surfaces(np.dstack([xy, apparent]))
    (found,) = likelihoods(xy, apparent, Candidates(true[..., None], np.ones((*true.shape, 1))))

    def rest_of(sigma):
        rest = np.empty_like(true)
        for p in range(len(true)):
            for fold in range(FOLDS):
                others = np.arange(POINTS) % FOLDS != fold
                a, z = terms[p, others], true[p, others]

                def misfit(bed, a=a, z=z):
                    return -student.logpdf((z - a @ bed) / 1.34 / sigma, FREEDOM).sum()

                start = np.linalg.lstsq(a, z, rcond=None)[0]
                fitted = minimize(misfit, start, method="BFGS").x
                rest[p, ~others] = (true[p, ~others] - terms[p, ~others] @ fitted) / 1.34
        return rest

    def log_density(log_sigma, rest):
        sigma = np.exp(log_sigma)
        t = student.pdf(rest / sigma, FREEDOM) / sigma
        return np.log(t + OUTLIER_GSD / GSD_M)

    best = minimize_scalar(
        lambda s: -log_density(s, rest_of(np.exp(s))).sum(),
        bounds=np.log([0.5 * GSD_M, 3.0 * GSD_M]), method="bounded", options={"xatol": 0.05},
    )  # fmt: skip
    slow = log_density(best.x, rest_of(np.exp(best.x))).mean(axis=1)
    # the fit is stopped after a few steps, and sigma is found to 2 %: 0.01 of a log likelihood
    assert found == pytest.approx(slow, abs=0.01)


@pytest.mark.parametrize("is_mixed", [True, False])
def test_mixture(is_mixed):
    """Points of one of five images, or of all in the mean: each type is found for its own cloud."""
    rng = np.random.default_rng(2)
    xy, bed = patches(200, rng)
    ratio = 1.34 + 0.05 * np.arange(5)
    used_ratio = ratio[rng.integers(0, 5, bed.shape)] if is_mixed else np.mean(ratio)
    apparent = bed / used_ratio + rng.normal(0.0, 0.5 * GSD_M, bed.shape)
    several = Candidates(apparent[..., None] * ratio, np.ones((*bed.shape, 5)))
    mean = Candidates(apparent[..., None] * np.mean(ratio), np.ones((*bed.shape, 1)))
    errors = standard_errors(*likelihoods(xy, apparent, several, mean))
    assert (errors > 2.33) if is_mixed else (errors < -2.33)


def test_missing_candidates():
    """NaN is no candidate, whatever its prior."""
    rng = np.random.default_rng(3)
    xy, bed = patches(20, rng)
    apparent = bed / 1.34
    height = np.dstack([1.34 * apparent, np.full(bed.shape, np.nan)])
    padded = Candidates(height, np.ones(height.shape))
    single = Candidates(height[..., :1], np.ones((*bed.shape, 1)))
    with_none, without = likelihoods(xy, apparent, padded, single)
    # the starts of the search differ, by the spread of the candidates: 0 here
    assert with_none == pytest.approx(without, abs=1e-9)


def test_one_patch_decides_nothing():
    rng = np.random.default_rng(4)
    one = rng.normal(0.0, 0.01, 100)
    other = one.copy()
    other[0] += 1000.0
    assert abs(standard_errors(one, other)) < MOST_A_POINT / MODEL_ERROR
    assert standard_errors(one, other) == pytest.approx(-standard_errors(other, one))
    assert standard_errors(one + 0.2, one) == pytest.approx(0.2 / MODEL_ERROR)

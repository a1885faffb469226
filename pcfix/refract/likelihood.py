"""Compare reconstruction types by how well they predict points from their neighbours.

A reconstruction type says where the true point of an apparent one may be: at one place or, where
one of several images or groups of images reconstructed it, at candidates k with probabilities p_k.
With the bed of a patch of neighbours as a quadratic surface, the apparent point has the density

    sum_k p_k t(r_k / sigma) / sigma,    r_k = (z_k - bed) / g_k,

where g_k is the true by the apparent depth, so that sigma is the noise of apparent heights for all
types, and t is Student's distribution of 7 degrees of freedom. A wrong type leaves discontinuities
where the images change, or predicts another scatter of neighbours than they have.

The bed is fitted to three quarters of a patch and predicts the others, in turn: a type with many
candidates gains nothing by fitting noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.model import FloatArray

FOLDS = 4
STARTS = (0.0, 0.75, -0.75, 1.5, -1.5)
"""First beds, above that through the mean candidates, by the spread of these."""
WIDER = (3.0, 2.0, 1.4, 1.0, 1.0)
"""Noise of the steps to the bed, by sigma: wide at first, so that no candidate is excluded."""
AGAIN = WIDER[-2:]
"""The same from a bed that was found with another sigma."""
FREEDOM, DENSITY = 7.0, 0.385
"""Degrees of freedom of t, with which the power is a whole number, and t(0)."""
SIGMA_GSD, SIGMAS_GSD = 0.8, (0.05, 30.0)
"""First noise, and its range."""
OUTLIER_GSD = 0.01
"""Density of points that are mismatches, per ground pixel."""
MOST_A_POINT = 0.25
"""Largest difference of two log likelihoods, per point: one patch decides nothing."""
MODEL_ERROR = 0.0125
"""Standard error of the mean difference, per point, as no model is exact: of simulated and rendered
clouds of every type."""


class Candidates(NamedTuple):
    """Where the true points of m apparent ones may be; NaN and 0 where there are fewer."""

    height_m: FloatArray  # (m, k)
    prior: FloatArray  # (m, k), relative probabilities


def log_likelihood(
    terms: FloatArray, apparent_m: FloatArray, level_m: FloatArray, candidates: Candidates,
    gsd_m: float,
) -> FloatArray:  # fmt: skip
    """Return the log likelihood of each of p patches of n points, per point, shape (p,).

    `terms`, shape (p, n, 6), is a basis of quadratic surfaces, the first of them constant;
    `apparent_m` and `level_m`, shape (p, n), are the heights of the points and of the water, and
    the candidates have the shape (p, n, k).
    """
    known = np.isfinite(candidates.height_m)
    height = np.where(known, candidates.height_m, 0.0).astype(np.float64)
    prior = np.where(known, candidates.prior, 0.0)
    prior /= np.maximum(prior.sum(axis=2, keepdims=True), 1e-12)
    depth = np.maximum(level_m - apparent_m, 0.05)
    gain = np.clip((level_m[..., None] - height) / depth[..., None], 1.0, 4.0)
    # of the candidates of each patch about their means: how far apart beds may be
    mean = (prior * height).sum(axis=2, keepdims=True)
    spread = np.sqrt((prior * (height - mean) ** 2).sum(axis=2).mean(axis=1))
    rest, sigma = np.empty_like(height), SIGMA_GSD * gsd_m
    beds = np.full((len(terms), FOLDS, terms.shape[2]), np.nan)

    def log_density(log_sigma: float) -> FloatArray:
        sigma = np.exp(log_sigma)
        near = 1.0 + (rest / sigma) ** 2 / FREEDOM
        near *= near  # twice, as powers of numpy are slow
        near *= near
        t = DENSITY / sigma * (prior / near).sum(axis=2)
        return np.asarray(np.log(t + OUTLIER_GSD / gsd_m))

    def misfit(log_sigma: float) -> float:
        return -float(log_density(log_sigma).sum())

    bounds = np.log(np.multiply(SIGMAS_GSD, gsd_m)).tolist()
    for _ in range(2):
        in_tiles(_predict, len(terms), terms, height, gain, prior, spread, sigma, beds, rest)
        found = minimize_scalar(misfit, bounds=bounds, method="bounded", options={"xatol": 0.02})
        sigma = float(np.exp(found.x))
    return np.asarray(log_density(found.x).mean(axis=1))


def standard_errors(of: FloatArray, other: FloatArray, model_error: float = MODEL_ERROR) -> float:
    """Return by how many standard errors one type is more likely than another.

    From their log likelihoods of the same patches, per point.
    """
    gain = np.clip(of - other, -MOST_A_POINT, MOST_A_POINT)
    return float(gain.mean() / np.hypot(gain.std() / np.sqrt(len(gain)), model_error))


@kernel(allocates=True)
def _predict(
    span: Span, terms: FloatArray, height: FloatArray, gain: FloatArray, prior: FloatArray,
    spread: FloatArray, sigma: float, beds: FloatArray, rest: FloatArray,
) -> None:  # fmt: skip
    """Set the residuals of all candidates from the bed of the other points of their patch.

    `beds`, shape (p, FOLDS, 6), are NaN at first, later where the search begins.
    """
    n, k = height.shape[1:]
    bed, best, normal = np.zeros(6), np.zeros(6), np.empty((6, 7))
    for p in range(*span):
        for fold in range(FOLDS):
            most, best[:] = -np.inf, beds[p, fold]
            if not np.isnan(best[0]):
                for wider in AGAIN:
                    _step(terms[p], height[p], gain[p], prior[p], fold, wider * sigma, normal, best)
            else:
                for start in range(len(STARTS) if k > 1 else 1):
                    bed[:] = 0.0
                    # through the mean candidates, with the largest noise that there can be
                    _step(terms[p], height[p], gain[p], prior[p], fold, 1e6, normal, bed)
                    bed[0] += STARTS[start] * spread[p] / terms[p, 0, 0]
                    likelihood = 0.0
                    for wider in WIDER:
                        likelihood = _step(
                            terms[p], height[p], gain[p], prior[p], fold, wider * sigma, normal, bed
                        )
                    if likelihood > most:
                        most = likelihood
                        best[:] = bed
            beds[p, fold] = best
            # the best bed predicts the points that it was not fitted to
            for i in range(fold, n, FOLDS):
                for c in range(k):
                    rest[p, i, c] = (height[p, i, c] - _height(terms[p, i], best)) / gain[p, i, c]


@device
def _height(terms: FloatArray, bed: FloatArray) -> float:
    """Return the height of a bed at a point."""
    total = 0.0
    for a in range(6):
        total += terms[a] * bed[a]
    return total


# sums over candidates in any order are vectorised: three times as fast, equal to 1e-13
@device(fastmath={"reassoc", "contract", "arcp", "nsz"})
def _step(
    terms: FloatArray, height: FloatArray, gain: FloatArray, prior: FloatArray, fold: int,
    sigma: float, normal: FloatArray, bed: FloatArray,
) -> float:  # fmt: skip
    """Fit the bed to the points of the other folds, weighted by the probability of each candidate.

    A step of expectation maximisation. Returns the log likelihood of the bed before it.
    """
    normal[:] = 0.0
    likelihood = 0.0
    for i in range(len(height)):
        if i % FOLDS == fold:
            continue
        at, total, weight, sum_height = _height(terms[i], bed), 0.0, 0.0, 0.0
        for c in range(height.shape[1]):
            r = (height[i, c] - at) / gain[i, c] / sigma
            near = 1.0 / (1.0 + r * r / FREEDOM)
            # probability of the candidate; the weight of a point in t falls with its residual
            likely = prior[i, c] * near * near * near * near
            total += likely
            w = likely * near / (gain[i, c] * gain[i, c])
            weight += w
            sum_height += w * height[i, c]
        if not total > 0.0:
            continue
        likelihood += np.log(total)
        # normal equations of the surface, with the mean candidate as the height of the point
        for a in range(6):
            for b in range(a, 6):
                normal[a, b] += weight / total * terms[i, a] * terms[i, b]
            normal[a, 6] += sum_height / total * terms[i, a]
    _solve(normal, bed)
    return likelihood


@device
def _solve(normal: FloatArray, bed: FloatArray) -> None:
    """Solve six normal equations, of which the upper triangle and the right side are given."""
    for a in range(6):
        normal[a, a] *= 1.0 + 1e-9
        for b in range(a):
            normal[a, b] = normal[b, a]
    for a in range(6):
        pivot = normal[a, a] + 1e-12
        for b in range(a + 1, 6):
            factor = normal[b, a] / pivot
            for c in range(a, 7):
                normal[b, c] -= factor * normal[a, c]
    for a in range(5, -1, -1):
        value = normal[a, 6]
        for b in range(a + 1, 6):
            value -= normal[a, b] * bed[b]
        bed[a] = value / (normal[a, a] + 1e-12)

"""Linear regression that nearly half of the observations cannot spoil.

MM-estimation (Yohai 1987, Annals of Statistics 15: 642-656): first the solution with the smallest
S-scale of its residuals, found from exact fits to a few points each and refined (the fast-S
algorithm: Salibian-Barrera & Yohai 2006, J. Comp. Graph. Stat. 15: 414-427); then, with that
scale, Tukey's weights, which lose little to least squares where nothing is wrong. The points that
are drawn are the same every time.
"""

from __future__ import annotations

from itertools import combinations
from math import comb, inf
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray

START_C, FINAL_C = 1.547645, 4.685061
"""Tukey's constants: against half of the data; with 95 % of the efficiency of least squares."""
LEAST_SCALE_M = 0.005
"""Residuals are weighed as if they scattered at least so much: the edge of water is no sharper."""
SUBSETS, SAMPLE, REFINED, FINALISTS = 3000, 400, 20, 3
_ROUNDS, _CONVERGED_M, _CONVERGED, _ROUGHLY = 200, 1e-10, 1e-7, 1e-2


class Regression(NamedTuple):
    """The fit of z = X beta.

    beta : shape (p,).
    covariance : shape (p, p), of beta; NaN where no observation is to spare.
    sigma_m : standard deviation of one accepted observation; NaN where none is to spare.
    residual_m : shape (n,), observed minus fitted.
    weight : shape (n,), 0 to 1; 0 of what is rejected.
    """

    beta: FloatArray
    covariance: FloatArray
    sigma_m: float
    residual_m: FloatArray
    weight: FloatArray


def robust_regression(X: FloatArray, z: FloatArray) -> Regression | None:
    """Fit z = X beta.

    Parameters
    ----------
    X : array, shape (n, p)
        Columns of similar size, n at least p.
    z : array, shape (n,)
        Metres.

    Returns
    -------
    Regression or None
        None where no p observations determine beta.
    """
    rows = _evenly(len(z), SAMPLE)
    starts = _exact_fits(X[rows], z[rows])
    if len(starts) == 0:
        return None
    beta, scale = _best(X[rows], z[rows], starts)
    if len(rows) < len(z):
        beta, scale = _least_s_scale(X, z, beta)
    limit = FINAL_C * max(scale, LEAST_SCALE_M)
    beta = _reweighted(X, z, beta, limit)
    residual = z - X @ beta
    covariance, sigma = _spread(X, residual, limit)
    return Regression(beta, covariance, sigma, residual, tukey_weight(residual / limit))


def tukey_weight(u: FloatArray) -> FloatArray:
    """Return Tukey's biweight (1 - u^2)^2, zero beyond |u| = 1."""
    return np.asarray(np.where(np.abs(u) < 1.0, (1.0 - u * u) ** 2, 0.0))


def s_scale(residual_m: FloatArray, unknowns: int = 0, precision: float = _CONVERGED) -> float:
    """Return the scale s with sum rho(r / (c s)) = (n - p) / 2; the standard deviation of normals.

    rho(u) = 1 - (1 - u^2)^3, and 1 beyond |u| = 1. Zero where more than half are zero.
    """
    square = residual_m**2
    spare = max(len(square) - unknowns, 1)
    scale = float(np.median(np.abs(residual_m))) / 0.6745 or float(np.sqrt(square.mean()))
    for _ in range(_ROUNDS):
        if scale < _CONVERGED_M:
            return 0.0
        inside = 1.0 - np.minimum(square / (START_C * scale) ** 2, 1.0)
        factor = float(np.sqrt(2.0 * (1.0 - inside**3).sum() / spare))
        scale *= factor
        if abs(factor - 1.0) < precision:
            break
    return scale


def _evenly(n: int, most: int) -> IntArray:
    """Return at most `most` of n row numbers, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).astype(np.int64))


def _exact_fits(X: FloatArray, z: FloatArray) -> FloatArray:
    """Return the exact fits with the least median residuals, shape (up to `REFINED`, p)."""
    rows = _subsets(*X.shape)
    size = np.abs(np.linalg.det(X[rows])) if X.shape[0] >= X.shape[1] else np.empty(0)
    good = size > 1e-9
    if not good.any():
        return np.empty((0, X.shape[1]))
    fits = np.linalg.solve(X[rows[good]], z[rows[good]][..., None])[..., 0]
    middle = (len(z) + X.shape[1]) // 2
    residual = np.abs(z[:, None] - X @ fits.T)
    median = np.partition(residual, min(middle, len(z) - 1), axis=0)[min(middle, len(z) - 1)]
    return np.asarray(fits[np.argsort(median, kind="stable")[:REFINED]])


def _subsets(n: int, p: int) -> IntArray:
    """Return p different row numbers of n a row: all that there are, or `SUBSETS` drawn ones."""
    if comb(n, p) <= SUBSETS:
        return np.array(list(combinations(range(n), p)), np.int64).reshape(-1, p)
    drawn = np.random.default_rng(0).integers(0, n, (2 * SUBSETS, p))
    ordered = np.sort(drawn, axis=1)
    different = (np.diff(ordered, axis=1) > 0).all(axis=1)
    return np.asarray(ordered[different][:SUBSETS])


def _best(X: FloatArray, z: FloatArray, starts: FloatArray) -> tuple[FloatArray, float]:
    """Return the fit with the least S-scale that the starts lead to, and that scale."""

    def scale(found: tuple[FloatArray, float]) -> float:
        return found[1]

    briefly = sorted((_least_s_scale(X, z, start, 3, _ROUGHLY) for start in starts), key=scale)
    return min((_least_s_scale(X, z, beta) for beta, _ in briefly[:FINALISTS]), key=scale)


def _least_s_scale(
    X: FloatArray,
    z: FloatArray,
    beta: FloatArray,
    rounds: int = _ROUNDS,
    precision: float = _CONVERGED,
) -> tuple[FloatArray, float]:
    """Return beta refined to a local least of the S-scale, and that scale."""
    best, least = beta, inf
    for _ in range(rounds):
        residual = z - X @ beta
        scale = s_scale(residual, X.shape[1], precision)
        if not scale < least * (1.0 - precision):
            break
        best, least = beta, scale
        if scale == 0.0:
            break
        beta = _weighted(X, z, tukey_weight(residual / (START_C * scale)), beta)
    return best, least


def _reweighted(X: FloatArray, z: FloatArray, beta: FloatArray, limit: float) -> FloatArray:
    """Return beta with Tukey's weights at a fixed limit."""
    for _ in range(_ROUNDS):
        after = _weighted(X, z, tukey_weight((z - X @ beta) / limit), beta)
        moved = float(np.abs(X @ (after - beta)).max())
        beta = after
        if moved < _CONVERGED_M:
            break
    return beta


def _weighted(X: FloatArray, z: FloatArray, weight: FloatArray, beta: FloatArray) -> FloatArray:
    """Return the weighted least squares solution, or beta where there is none."""
    root = np.sqrt(weight)
    solution, _, rank, _ = np.linalg.lstsq(X * root[:, None], z * root, rcond=1e-10)
    return np.asarray(solution) if rank == X.shape[1] else beta


def _spread(X: FloatArray, residual: FloatArray, limit: float) -> tuple[FloatArray, float]:
    """Return the covariance of an M-estimate, and the standard deviation of one observation.

    K^2 sum psi^2 / (m - p) / mean(psi')^2 (X' X)^-1 over the m accepted, with
    K = 1 + p / m var(psi') / mean(psi')^2 (Huber & Ronchetti 2009, Robust Statistics, eq 7.81).
    """
    inside = np.abs(residual) < limit
    X, residual = X[inside], residual[inside]
    spare = len(residual) - X.shape[1]
    if spare <= 0:
        return np.full((X.shape[1],) * 2, np.nan), np.nan
    u2 = (residual / limit) ** 2
    psi = residual * (1.0 - u2) ** 2
    slopes = (1.0 - u2) * (1.0 - 5.0 * u2)
    slope = float(slopes.mean())
    k = 1.0 + X.shape[1] / len(residual) * float(slopes.var()) / slope**2
    inverse = np.linalg.pinv(X.T @ X)
    sigma = float(np.sqrt((residual**2).sum() / spare))
    return np.asarray(k**2 * (psi**2).sum() / spare / slope**2 * inverse), sigma

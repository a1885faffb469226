"""Robust fits: linear regression, and a height profile along a river.

Regression is for nearly half of the observations wrong: first the least median of residuals, found
among exact fits to a few points each (Rousseeuw 1984, J. Am. Stat. Assoc. 79: 871-880); then, with
that median as the scale, Tukey's weights, which are nearly as efficient as least squares without
outliers. The samples are the same every time. (scipy's `least_squares` with a robust loss is only
the second half; it needs a start and a scale, and gives every observation a weight.)

The profile is robust, smooth, and falling: linear B-splines with a penalty on bends (P-splines:
Eilers & Marx 1996, Statistical Science 11: 89-121). The penalty grows with the size of a bend
instead of its square (trend filtering: Kim et al. 2009, SIAM Review 51: 339-360), so that pools,
riffles and weirs keep their edges; its weight comes from cross-validation. Rises have a penalty of
their own (Bollaerts et al. 2006, Statistics in Medicine 25: 1189-1206).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from typing import Any, NamedTuple

import numpy as np

from pcfix.model import BoolArray, FloatArray, IntArray

FINAL_C = 4.685061
"""Tukey's constant for 95 % efficiency."""
LEAST_SCALE_M = 0.005
"""Least scatter of residuals for their weights: the edge of water is no sharper."""
SUBSETS, SAMPLE = 3000, 400
_ROUNDS, _CONVERGED_M = 200, 1e-10
_TO_SIGMA = 1.4826  # from the median of absolute values of normal numbers


@dataclass(frozen=True, eq=False, kw_only=True)
class ShoreFit:
    """The fit of a water surface to n shoreline points."""

    residual_m: FloatArray  # (n,), point minus surface; NaN for points without a height
    weight: FloatArray  # (n,), 0 (rejected) to 1
    sigma_m: float  # standard deviation of one accepted point; NaN without redundancy
    notes: tuple[str, ...]  # reasons for this surface, and warnings

    @property
    def accepted(self) -> BoolArray:
        """Which points have a weight, shape (n,)."""
        return np.asarray(self.weight > 0.0)

    def figures(self) -> dict[str, Any]:
        """Return the figures of the points as plain values."""
        return {
            "sigma_point_m": self.sigma_m,
            "points": len(self.weight),
            "accepted": int(self.accepted.sum()),
            "without_height": int(np.isnan(self.residual_m).sum()),
            "notes": list(self.notes),
        }


def usable_rows(xyz: FloatArray) -> IntArray:
    """Return the rows of finite points, sorted, so that the order of the points does not matter."""
    known = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    return known[np.lexsort(xyz[known].T)]


def of_all(values: FloatArray, known: IntArray, count: int, otherwise: float) -> FloatArray:
    """Return an array of shape (count,) with the values of known rows, `otherwise` elsewhere."""
    whole = np.full(count, otherwise)
    whole[known] = values
    return whole


class Regression(NamedTuple):
    """The fit of z = X beta."""

    beta: FloatArray  # (p,)
    covariance: FloatArray  # (p, p), of beta; NaN without redundancy
    sigma_m: float  # standard deviation of one accepted observation; NaN without redundancy
    residual_m: FloatArray  # (n,), observed minus fitted
    weight: FloatArray  # (n,), 0 (rejected) to 1


def robust_regression(X: FloatArray, z: FloatArray) -> Regression | None:
    """Fit z = X beta; None if no p observations determine beta.

    The columns of X, shape (n, p), are of similar size; z, shape (n,), is in metres.
    """
    rows = np.unique(np.linspace(0, len(z) - 1, min(len(z), SAMPLE)).astype(np.int64))
    beta = _least_median(X[rows], z[rows])
    if beta is None:
        return None
    # a few observations are fitted too well (Rousseeuw & Leroy 1987, p. 202)
    few = 1.0 + 5.0 / max(len(z) - X.shape[1], 1)
    scale = few * _TO_SIGMA * float(np.median(np.abs(z - X @ beta)))
    limit = FINAL_C * max(scale, LEAST_SCALE_M)
    for _ in range(_ROUNDS):
        before = beta
        beta = _weighted(X, z, tukey_weight((z - X @ beta) / limit), beta)
        if float(np.abs(X @ (beta - before)).max()) < _CONVERGED_M:
            break
    residual = z - X @ beta
    covariance, sigma = _spread(X, residual, limit)
    return Regression(beta, covariance, sigma, residual, tukey_weight(residual / limit))


def shared(weight: FloatArray, worth: FloatArray, unknowns: float) -> float:
    """Return the factor of a covariance for points that depend on their neighbours.

    If the k accepted ones are `worth` m independent observations, the covariance of p unknowns is
    (k - p) / (m - p) times as large; NaN if m does not exceed p.
    """
    accepted = weight > 0.0
    k, m = float(accepted.sum()), float(worth[accepted].sum())
    if m >= k:
        return 1.0
    return (k - unknowns) / (m - unknowns) if m > unknowns else np.nan


def tukey_weight(u: FloatArray) -> FloatArray:
    """Return Tukey's biweight (1 - u^2)^2, zero beyond |u| = 1."""
    return np.asarray(np.where(np.abs(u) < 1.0, (1.0 - u * u) ** 2, 0.0))


def _least_median(X: FloatArray, z: FloatArray) -> FloatArray | None:
    """Return the exact fit to p observations with the least median residual, if there is one."""
    rows = _subsets(*X.shape)
    size = np.abs(np.linalg.det(X[rows])) if X.shape[0] >= X.shape[1] else np.empty(0)
    good = size > 1e-9
    if not good.any():
        return None
    fits = np.linalg.solve(X[rows[good]], z[rows[good]][..., None])[..., 0]
    middle = min((len(z) + X.shape[1]) // 2, len(z) - 1)
    median = np.partition(np.abs(z[:, None] - X @ fits.T), middle, axis=0)[middle]
    return np.asarray(fits[np.argmin(median)])


def _subsets(n: int, p: int) -> IntArray:
    """Return subsets of p of n row numbers: all, or `SUBSETS` random ones."""
    if comb(n, p) <= SUBSETS:
        return np.array(list(combinations(range(n), p)), np.int64).reshape(-1, p)
    drawn = np.random.default_rng(0).integers(0, n, (2 * SUBSETS, p))
    ordered = np.sort(drawn, axis=1)
    different = (np.diff(ordered, axis=1) > 0).all(axis=1)
    return np.asarray(ordered[different][:SUBSETS])


def _weighted(X: FloatArray, z: FloatArray, weight: FloatArray, beta: FloatArray) -> FloatArray:
    """Return the weighted least squares solution, or beta if there is none."""
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


FOLDS = 5
PENALTIES = tuple(10.0 ** np.arange(-4.0, 3.5, 0.5))
MOST_NODES, NODES_A_POINT = 400, 2
STIFF_PENALTY = 1e3
"""Penalty on rises, and on bends near the ends."""
END_POINTS = 7
"""The outermost points are on one straight piece, so that a single one cannot bend it."""
RISES_IF_WORSE = 1.25
"""The surface may rise downstream if the scatter of the points is larger by this otherwise."""
_TURNS, _BEND_M, _HUBER_M = 12, 1e-3, 0.02
_LEAST = 1e-12  # keeps the equations solvable without points


@dataclass(frozen=True, eq=False)
class Profile:
    """Heights along a river."""

    station_m: FloatArray  # (m,), evenly spaced, from the first point to the last
    height_m: FloatArray  # (m,)
    sigma_height_m: FloatArray  # (m,), standard errors
    weight: FloatArray  # (n,), of the points, 0 to 1
    residual_m: FloatArray  # (n,)
    sigma_m: float  # standard deviation of one accepted point
    falls: bool  # whether it was forced to fall

    def height_at(self, station_m: FloatArray) -> FloatArray:
        """Return heights at stations, constant beyond the ends."""
        return np.interp(station_m, self.station_m, self.height_m)

    def sigma_at(self, station_m: FloatArray) -> FloatArray:
        """Return standard errors of heights, constant beyond the ends."""
        return np.interp(station_m, self.station_m, self.sigma_height_m)


def fit_profile(station_m: FloatArray, z: FloatArray, worth: FloatArray | None = None) -> Profile:
    """Fit the height of the water, shape (n,), which falls with the station, downstream.

    Each point is `worth` a number of independent observations, 1 by default; see `shared`.
    """
    order = np.lexsort((z, station_m))
    count = int(np.clip(NODES_A_POINT * len(z), 20, MOST_NODES))
    nodes = np.linspace(station_m.min(), station_m.max(), count)
    falling, free = (
        _fit(station_m[order], z[order], nodes, falls=falls) for falls in (True, False)
    )
    held = falling.sigma_m <= RISES_IF_WORSE * max(free.sigma_m, LEAST_SCALE_M)
    fit, back = falling if held else free, np.argsort(order)
    fit = replace(fit, weight=fit.weight[back], residual_m=fit.residual_m[back])
    if worth is None:
        return fit
    grown = np.sqrt(shared(fit.weight, worth, 0.0))
    return replace(fit, sigma_height_m=fit.sigma_height_m * grown)


def _fit(station: FloatArray, z: FloatArray, nodes: FloatArray, *, falls: bool) -> Profile:
    """Fit heights, with the penalty that cross-validation prefers, and their standard errors."""
    from scipy.linalg import solveh_banded

    # each fold is predicted from the others; its errors count up to a limit, for the outliers
    fold = np.arange(len(z)) % FOLDS
    missed = np.empty((len(PENALTIES), len(z)))
    for row, penalty in enumerate(PENALTIES):
        for k in range(FOLDS):
            rest, out = fold != k, fold == k
            height = _solve(station[rest], z[rest], nodes, penalty, falls=falls)[0]
            missed[row, out] = np.abs(z[out] - np.interp(station[out], nodes, height))
    limit = FINAL_C * max(_TO_SIGMA * float(np.median(missed, axis=1).min()), LEAST_SCALE_M)
    best = PENALTIES[int(np.argmin((np.minimum(missed, limit) ** 2).mean(axis=1)))]
    height, weight, band = _solve(station, z, nodes, best, falls=falls)
    inverse = solveh_banded(band, np.eye(len(nodes)), lower=True)
    splines = _splines(station, nodes)
    variance = splines.multiply(splines @ inverse).sum(axis=1)
    residual, accepted = z - np.interp(station, nodes, height), weight > 0.0
    spare = accepted.sum() - float((weight * np.asarray(variance).ravel()).sum())
    sigma = float(np.sqrt((residual[accepted] ** 2).sum() / max(spare, 1.0)))
    sigma_height = sigma * np.sqrt(np.diag(inverse))
    return Profile(nodes, height, sigma_height, weight, residual, sigma, falls)


def _splines(station: FloatArray, nodes: FloatArray) -> Any:
    """Return the linear B-splines of the nodes at stations, a sparse matrix (n, nodes)."""
    from scipy.interpolate import BSpline

    return BSpline.design_matrix(station, np.pad(nodes, 1, "edge"), 1)


def _solve(
    station: FloatArray, z: FloatArray, nodes: FloatArray, penalty: float, *, falls: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return heights, the points' weights, and the lower band of the normal equations.

    Iteratively reweighted least squares: bends weigh 1 / |bend|, rises 1 or 0, points first by
    Huber, then by Tukey with the scale of the Huber solution.
    """
    from scipy.linalg import solveh_banded

    splines = _splines(station, nodes)
    squares, products = splines.power(2).T, splines[:, :-1].multiply(splines[:, 1:]).T
    before = np.searchsorted(station, nodes[1:-1])
    stiff = np.minimum(before, len(z) - before) < END_POINTS
    weight: FloatArray = np.ones(len(z))
    bend: FloatArray = np.ones(len(nodes) - 2)
    rise: FloatArray = np.zeros(len(nodes) - 1)
    limit, band = np.inf, np.zeros((3, len(nodes)))
    for turn in range(2 * _TURNS):
        bends = np.where(stiff, STIFF_PENALTY, penalty * bend)
        # the squares of second differences (1, -2, 1) and of first ones (-1, 1)
        band[0] = squares @ weight + np.convolve(bends, [1.0, 4.0, 1.0]) + _LEAST
        band[0] += np.convolve(STIFF_PENALTY * rise, [1.0, 1.0])
        band[1, :-1] = products @ weight - np.convolve(bends, [2.0, 2.0]) - STIFF_PENALTY * rise
        band[2, :-2] = bends
        height = solveh_banded(band, splines.T @ (weight * z), lower=True)
        bend = 1.0 / np.maximum(np.abs(np.diff(height, 2)), _BEND_M)
        rise = np.where(np.diff(height) > 0.0, float(falls), 0.0)
        residual = np.abs(z - np.interp(station, nodes, height))
        if turn < _TURNS:
            weight = np.minimum(_HUBER_M / np.maximum(residual, 1e-9), 1.0)
            limit = FINAL_C * max(_TO_SIGMA * float(np.median(residual)), LEAST_SCALE_M)
        else:
            weight = tukey_weight(residual / limit)
    return height, weight, band

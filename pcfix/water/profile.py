"""The height of the water along a river: robust, smooth, and falling.

Linear B-splines with a penalty on bends (P-splines: Eilers & Marx 1996, Statistical Science 11:
89-121). The penalty grows with the size of a bend and not with its square (trend filtering: Kim et
al. 2009, SIAM Review 51: 339-360), so that pools, riffles and weirs keep their edges; its weight
comes from cross-validation. Rises are held down by a penalty of their own (Bollaerts et al. 2006,
Statistics in Medicine 25: 1189-1206).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.water.robust import FINAL_C, LEAST_SCALE_M, tukey_weight

if TYPE_CHECKING:
    from pcfix.model import BoolArray, FloatArray, IntArray

FOLDS = 5
PENALTIES = tuple(10.0 ** np.arange(-4.0, 3.5, 0.5))
MOST_NODES, NODES_A_POINT = 400, 2
STIFF_PENALTY = 1e3
"""On rises, and on bends near the ends."""
END_POINTS = 7
"""So many outermost points are on one straight piece, so that one of them alone cannot bend it."""
RISES_IF_WORSE = 1.25
"""The surface may rise downstream where forbidding it makes the points scatter so much more."""
_ROUNDS, _BEND_M, _HUBER_M = 12, 1e-3, 0.02
_LEAST = 1e-12  # keeps the equations solvable where no point decides
_TO_SIGMA = 1.4826  # from the median of absolute values of normal numbers


@dataclass(frozen=True, eq=False)
class Profile:
    """Heights along a river.

    Attributes
    ----------
    station_m : array, shape (m,)
        Evenly spaced, from the first point to the last.
    height_m, sigma_height_m : array, shape (m,)
    weight : array, shape (n,)
        Of the points, 0 to 1.
    residual_m : array, shape (n,)
    sigma_m : float
        Standard deviation of one accepted point.
    falls : bool
        Whether it was held to fall.
    """

    station_m: FloatArray
    height_m: FloatArray
    sigma_height_m: FloatArray
    weight: FloatArray
    residual_m: FloatArray
    sigma_m: float
    falls: bool

    def height_at(self, station_m: FloatArray) -> FloatArray:
        """Return heights at stations; beyond the ends those of the ends."""
        return np.interp(station_m, self.station_m, self.height_m)

    def sigma_at(self, station_m: FloatArray) -> FloatArray:
        """Return standard errors of heights; beyond the ends those of the ends."""
        return np.interp(station_m, self.station_m, self.sigma_height_m)


class _Data(NamedTuple):
    """Points between nodes: the node before each, the share of the next one, the height."""

    node: IntArray
    share: FloatArray
    z: FloatArray
    nodes: int

    def take(self, rows: BoolArray) -> _Data:
        return self._replace(node=self.node[rows], share=self.share[rows], z=self.z[rows])

    def stiff(self) -> BoolArray:
        """Return which bends have too few points on one side, shape (nodes - 2,)."""
        before = np.cumsum(np.bincount(self.node, minlength=self.nodes))[: self.nodes - 2]
        return np.asarray(np.minimum(before, len(self.z) - before) < END_POINTS)

    def fitted(self, height: FloatArray) -> FloatArray:
        return (1.0 - self.share) * height[self.node] + self.share * height[self.node + 1]


def fit_profile(station_m: FloatArray, z: FloatArray) -> Profile:
    """Fit the height of the water, which falls with the station.

    Parameters
    ----------
    station_m : array, shape (n,)
        Distance along the river, downstream.
    z : array, shape (n,)
        Metres.
    """
    order = np.lexsort((z, station_m))
    at = np.linspace(station_m.min(), station_m.max(), _node_count(len(z)))
    position = (station_m[order] - at[0]) / (at[1] - at[0])
    node = np.clip(np.floor(position).astype(np.int64), 0, len(at) - 2)
    data = _Data(node, position - node, z[order], len(at))
    fits = {
        falls: _fit(data, _best_penalty(data, falls=falls), falls=falls) for falls in (True, False)
    }
    falls = fits[True].sigma <= RISES_IF_WORSE * max(fits[False].sigma, LEAST_SCALE_M)
    fit = fits[falls]
    back = np.argsort(order)
    residual = data.z - data.fitted(fit.height)
    return Profile(
        at, fit.height, fit.sigma_height, fit.weight[back], residual[back], fit.sigma, falls
    )


def _node_count(n: int) -> int:
    return int(np.clip(NODES_A_POINT * n, 20, MOST_NODES))


class _Fit(NamedTuple):
    height: FloatArray
    weight: FloatArray
    sigma: float
    sigma_height: FloatArray


def _best_penalty(data: _Data, *, falls: bool) -> float:
    """Return the penalty with which left-out points are met best, outliers aside."""
    fold = np.arange(len(data.z)) % FOLDS
    missed = np.empty((len(PENALTIES), len(data.z)))
    for row, penalty in enumerate(PENALTIES):
        for k in range(FOLDS):
            height = _solve(data.take(fold != k), penalty, falls=falls)[0]
            out = data.take(fold == k)
            missed[row, fold == k] = np.abs(out.z - out.fitted(height))
    limit = FINAL_C * max(_TO_SIGMA * float(np.median(missed, axis=1).min()), LEAST_SCALE_M)
    return PENALTIES[int(np.argmin((np.minimum(missed, limit) ** 2).mean(axis=1)))]


def _fit(data: _Data, penalty: float, *, falls: bool) -> _Fit:
    """Return heights with their standard errors."""
    from scipy.linalg import solveh_banded

    height, weight, band = _solve(data, penalty, falls=falls)
    inverse = solveh_banded(band, np.eye(data.nodes), lower=True)
    i, j, share = data.node, data.node + 1, data.share
    variance = (
        (1.0 - share) ** 2 * inverse[i, i]
        + 2.0 * share * (1.0 - share) * inverse[i, j]
        + share**2 * inverse[j, j]
    )
    kept = weight > 0.0
    spare = kept.sum() - float((weight * variance).sum())
    residual = (data.z - data.fitted(height))[kept]
    sigma = float(np.sqrt((residual**2).sum() / max(spare, 1.0)))
    return _Fit(height, weight, sigma, sigma * np.sqrt(np.diag(inverse)))


def _solve(
    data: _Data, penalty: float, *, falls: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return heights, the points' weights, and the band of the normal equations.

    All weights are set anew in each round: of bends by 1 / |bend|, of rises 1 or 0, of points
    first by Huber, then by Tukey about what that found.
    """
    from scipy.linalg import solveh_banded

    weight: FloatArray = np.ones(len(data.z))
    bend: FloatArray = np.ones(data.nodes - 2)
    rise: FloatArray = np.zeros(data.nodes - 1)
    stiff, limit = data.stiff(), np.inf
    for turn in range(2 * _ROUNDS):
        bends = np.where(stiff, STIFF_PENALTY, penalty * bend)
        band, right = _normal_equations(data, weight, bends, STIFF_PENALTY * rise)
        height = solveh_banded(band, right, lower=True)
        bend = 1.0 / np.maximum(np.abs(np.diff(height, 2)), _BEND_M)
        rise = np.where(np.diff(height) > 0.0, float(falls), 0.0)
        residual = np.abs(data.z - data.fitted(height))
        if turn < _ROUNDS:
            weight = np.minimum(_HUBER_M / np.maximum(residual, 1e-9), 1.0)
            limit = FINAL_C * max(_TO_SIGMA * float(np.median(residual)), LEAST_SCALE_M)
        else:
            weight = tukey_weight(residual / limit)
    return height, weight, band


def _normal_equations(
    data: _Data, weight: FloatArray, bend: FloatArray, rise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the lower band, shape (3, nodes), and the right side."""
    n, i, s = data.nodes, data.node, data.share
    band, right = np.zeros((3, n)), np.zeros(n)
    for at, part in ((i, 1.0 - s), (i + 1, s)):
        band[0] += np.bincount(at, weight * part**2, n)
        right += np.bincount(at, weight * part * data.z, n)
    band[1] += np.bincount(i, weight * s * (1.0 - s), n)
    for k, (one, two, three) in enumerate(((1.0, 4.0, 1.0), (-2.0, -2.0, 0.0), (1.0, 0.0, 0.0))):
        for shift, factor in enumerate((one, two, three)):
            band[k, shift : shift + n - 2] += factor * bend
    band[0, :-1] += rise
    band[0, 1:] += rise
    band[1, :-1] -= rise
    band[0] += _LEAST
    return band, right

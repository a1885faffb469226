"""Fit a water surface to shoreline points, and take their heights from the cloud.

The regression is for nearly half of the observations wrong: first the least median of residuals,
found among exact fits to a few points each (Rousseeuw 1984, J. Am. Stat. Assoc. 79: 871-880); then,
with that median as the scale, Tukey's weights, which are nearly as efficient as least squares
without outliers. The samples are the same every time. (scipy's `least_squares` with a robust loss
is only the second half; it needs a start and a scale, and gives every observation a weight.)
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal, NamedTuple

import numpy as np

from pcfix.errors import GeometryError
from pcfix.model import BoolArray, FloatArray, IntArray, WaterPlane
from pcfix.water.checks import check_tilt
from pcfix.water.surface import FoundSurface

Model = Literal["auto", "level", "plane", "along"]
SIGNIFICANCE = 0.05  # a tilt is significant if chance gives it more rarely
LINE_RATIO = 0.1  # points are on a line if their spread across it is a smaller share of that along
LONG_RATIO = 1.0 / 3.0  # points are along a river or a coast, level across, below this ratio
WIDE_SCATTER_M = 0.1
_SAME_PLACE_M = 1e-3
_FEWEST_FOR_PLANE = 3
_ON_LINE = 0.01
_NO_SCATTER_M = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class ShoreFit(FoundSurface):
    """The fit of a water surface to its n shoreline points."""

    points: FloatArray  # (n, 3), metres, the cloud's CRS
    residual_m: FloatArray  # (n,), point minus surface; NaN for points without a height
    weight: FloatArray  # (n,), 0 (rejected) to 1
    sigma_m: float  # standard deviation of one accepted point; NaN without redundancy
    figures: dict[str, Any]  # of the fitted model, as plain values

    @property
    def accepted(self) -> BoolArray:
        """Which points have a weight, shape (n,)."""
        return np.asarray(self.weight > 0.0)

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        return {
            **self.figures,
            "sigma_point_m": self.sigma_m,
            "points": len(self.weight),
            "accepted": int(self.accepted.sum()),
            "without_height": int(np.isnan(self.residual_m).sum()),
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class WaterFit(ShoreFit):
    """A level or a plane, and its accuracy without errors that all points share."""

    centre_xy: FloatArray  # (2,), centre of the accepted points
    # Of the height there and of dz/dx and dz/dy, shape (3, 3): zero for what the model does not
    # have, NaN without redundancy.
    covariance: FloatArray

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """Return the standard error (m) of the height at places (m, 2)."""
        row = np.column_stack([np.ones(len(xy)), xy - self.centre_xy])
        return np.sqrt(np.einsum("ij,jk,ik->i", row, self.covariance, row))


def fit_water(
    xyz: FloatArray, *, model: Model = "auto", counts: FloatArray | None = None
) -> WaterFit:
    """Fit the water surface to shoreline points, nearly half of which may be wrong.

    Of the points, shape (n, 3), world frame, those that are not finite are ignored; their order
    does not matter. ``along`` is tilted in the direction of the points and level across it;
    ``auto`` is tilted only if that is significant, and only along the points if these are nearly on
    one line, or along a river without tilt across it. `counts`, shape (n,), are how many
    independent observations each point is worth: 1 by default, less if neighbours share their
    errors. Standard errors and tests of tilts use their sum.
    """
    known = usable_rows(xyz)
    if len(known) == 0:
        text = f"None of {len(xyz)} shoreline points has a height. Give heights, or the cloud."
        raise GeometryError("water.too_few_points", text, points=0, least=1)
    worth = np.ones(len(known)) if counts is None else np.asarray(counts, np.float64)[known]
    origin = xyz[known, :2].mean(axis=0)
    local = xyz[known, :2] - origin
    variance, vectors = np.linalg.eigh(local.T @ local / len(known))
    spread = np.sqrt(np.maximum(variance[::-1], 0.0))
    # level, and rise over one spread along and across the points: unknowns of similar size
    units = vectors[:, ::-1] / np.maximum(spread, _SAME_PLACE_M)
    design = np.column_stack([np.ones(len(known)), local @ units])
    shore = _Shore(design, xyz[known, 2], worth, *spread.tolist())
    if model == "auto":
        model, found, notes = _choose(shore)
    else:
        found, notes = _regression(shore, model), []
    accepted, p = found.weight > 0.0, len(found.beta)
    centre = xyz[known[accepted], :2].mean(axis=0)
    # level at the centre of the accepted points, and slopes in x and y
    to_world = np.zeros((3, p))
    to_world[0, 0], to_world[1:, 1:] = 1.0, units[:, : p - 1]
    to_world[0] += (centre - origin) @ to_world[1:]
    covariance = to_world @ found.covariance @ to_world.T
    level, east, north = (to_world @ found.beta).tolist()
    surface = WaterPlane(level - float(centre @ [east, north]), east, north)
    check_tilt(surface)
    steepest = math.hypot(east, north)
    uphill = np.array([east, north]) / steepest if steepest else np.zeros(2)
    if math.isnan(found.sigma_m):
        notes.append("There is no redundancy, so the accuracy of the surface is unknown.")
    if found.sigma_m > WIDE_SCATTER_M:
        notes.append(
            f"The points scatter by {found.sigma_m:.2f} m. They may not belong to one surface, or"
            " not be on the edge of the water."
        )
    residual, weight = np.full(len(xyz), np.nan), np.zeros(len(xyz))
    residual[known], weight[known] = found.residual_m, found.weight
    return WaterFit(
        surface=surface,
        points=xyz,
        notes=tuple(notes),
        residual_m=residual,
        weight=weight,
        sigma_m=found.sigma_m,
        centre_xy=centre,
        covariance=covariance,
        figures={
            "model": model,
            "level_m": level,
            "sigma_level_m": math.sqrt(covariance[0, 0]),
            "at_xy": centre.tolist(),
            "tilt_percent": 100.0 * steepest,
            "sigma_tilt_percent": 100.0 * math.sqrt(uphill @ covariance[1:, 1:] @ uphill),
            # clockwise from the y axis; a level has no downhill direction
            "downhill_deg": math.degrees(math.atan2(-east, -north)) % 360.0 if steepest else None,
        },
    )


class _Shore(NamedTuple):
    """Shoreline points with heights, in their principal axes."""

    design: FloatArray  # (n, 3), 1, and the place along and across the points, in spreads
    z: FloatArray  # (n,), metres
    worth: FloatArray  # (n,), independent observations that each is worth
    along_m: float  # spread: rms distance from the centre along and across the points
    across_m: float


def _choose(shore: _Shore) -> "tuple[Model, Regression, list[str]]":
    """Return the model with significant tilts only, its fit, and why."""
    from scipy.special import fdtrc

    along, across = shore.along_m, shore.across_m
    if len(shore.z) <= _FEWEST_FOR_PLANE or along < _SAME_PLACE_M:
        few = f"{len(shore.z)} points are too few or too close together for a tilt"
        return "level", _regression(shore, "level"), [f"{few}: a level is fitted."]
    model: Model = "along" if across < LINE_RATIO * along else "plane"
    found = _regression(shore, model)
    # the p-value of the tilt, if the surface is level (Wald's test, F distribution); points without
    # scatter have no covariance, which a micrometre of it makes invertible
    rise, p = found.beta[1:], len(found.beta)
    covariance = found.covariance[1:, 1:] + _NO_SCATTER_M**2 * np.eye(p - 1)
    statistic = rise @ np.linalg.solve(covariance, rise) / len(rise)
    spare = float(shore.worth[found.weight > 0.0].sum()) - p
    chance = float(np.nan_to_num(fdtrc(p - 1, spare, statistic), nan=1.0))  # NaN: no redundancy
    if not chance < SIGNIFICANCE:
        note = f"The tilt of the points is not significant (p = {chance:.2f}): a level is fitted."
        return "level", _regression(shore, "level"), [note]
    notes = [f"The tilt of the points is significant (p = {chance:.2g})."]
    if model == "along":
        notes.append(
            f"The points are nearly on one line (rms {across:.1f} m across, {along:.1f} m along):"
            " the surface is level across it."
        )
    elif across < LONG_RATIO * along and found.beta[2] ** 2 < 4.0 * found.covariance[2, 2]:
        notes.append(
            "There is no tilt across the direction of the points: the surface is level across it."
        )
        model, found = "along", _regression(shore, "along")
    return model, found, notes


TUKEY = 4.685061  # Tukey's constant for 95 % efficiency
LEAST_SCALE_M = 0.005  # least scatter of residuals for their weights: no edge of water is sharper
SUBSETS, SAMPLE = 3000, 400
_ROUNDS, _CONVERGED_M = 200, 1e-10
TO_SIGMA = 1.4826  # from the median of absolute values of normal numbers


def _regression(shore: _Shore, model: Model) -> "Regression":
    """Fit the p unknowns beta of a model: level, and rise along and across the points."""
    p, n = {"level": 1, "along": 2, "plane": 3}[model], len(shore.z)
    X, z, along, across = shore.design[:, :p], shore.z, shore.along_m, shore.across_m
    on_line = (p > 1 and along < _SAME_PLACE_M) or (p > 2 and across < _ON_LINE * along)
    if n < p or on_line:
        raise GeometryError(
            "water.on_line" if n >= p else "water.too_few_points",
            f"The water model '{model}' needs at least {p} shoreline points with heights, not at"
            f" one place or on one line, and there are {n} (rms {along:.4g} m along their line,"
            f" {across:.2g} m across). Fit a level, or a tilt along them.",
            points=n, least=p,
        )  # fmt: skip
    rows = np.unique(np.linspace(0, n - 1, min(n, SAMPLE)).astype(np.int64))
    beta = _least_median(X[rows], z[rows])
    # the scale for Tukey's weights; few observations are fitted too well (Rousseeuw & Leroy 1987,
    # p. 202)
    few = 1.0 + 5.0 / max(n - p, 1)
    scale = few * TO_SIGMA * float(np.median(np.abs(z - X @ beta)))
    limit = TUKEY * max(scale, LEAST_SCALE_M)
    for _ in range(_ROUNDS):
        root = np.sqrt(tukey_weight((z - X @ beta) / limit))
        better, _, rank, _ = np.linalg.lstsq(X * root[:, None], z * root, rcond=1e-10)
        if rank < p:  # too few weights are left to determine beta
            break
        change, beta = np.abs(X @ (better - beta)).max(), np.asarray(better, np.float64)
        if change < _CONVERGED_M:
            break
    residual = z - X @ beta
    covariance, sigma = _spread(X, residual, limit)
    weight = tukey_weight(residual / limit)
    covariance *= shared(weight, shore.worth, p)
    return Regression(beta, covariance, sigma, residual, weight)


def usable_rows(xyz: FloatArray) -> IntArray:
    """Return the rows of finite points, sorted, so that the order of the points does not matter."""
    known = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    return known[np.lexsort(xyz[known].T)]


class Regression(NamedTuple):
    """The fit of z = X beta."""

    beta: FloatArray  # (p,)
    covariance: FloatArray  # (p, p), of beta; NaN without redundancy
    sigma_m: float  # standard deviation of one accepted observation; NaN without redundancy
    residual_m: FloatArray  # (n,), observed minus fitted
    weight: FloatArray  # (n,), 0 (rejected) to 1


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


def _least_median(X: FloatArray, z: FloatArray) -> FloatArray:
    """Return the exact fit to p observations with the least median residual."""
    n, p = X.shape
    # all subsets of p rows, or a random sample of them: with nearly half of the observations wrong,
    # one of eight of three rows is right
    if math.comb(n, p) <= SUBSETS:
        rows = np.array(list(combinations(range(n), p)), np.int64).reshape(-1, p)
    else:
        drawn = np.random.default_rng(0).integers(0, n, (2 * SUBSETS, p))
        ordered = np.sort(drawn, axis=1)
        rows = ordered[(np.diff(ordered, axis=1) > 0).all(axis=1)][:SUBSETS]
    good = rows[np.abs(np.linalg.det(X[rows])) > 1e-9]  # not at one place, or on one line
    fits = np.linalg.solve(X[good], z[good][..., None])[..., 0]
    middle = min((n + p) // 2, n - 1)  # p residuals are zero whatever the others are
    median = np.partition(np.abs(z[:, None] - X @ fits.T), middle, axis=0)[middle]
    return np.asarray(fits[np.argmin(median)])


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


NEIGHBOURS, FEWEST = 25, 3  # points whose median is the height of a place, at most and at least


class NearestPoints:
    """The k points nearest to some places in plan, (p, 2), gathered from a cloud chunk by chunk.

    `rows`, shape (p, k, c), are their coordinates and whatever else was added with them, the
    nearest first; `distance_m`, shape (p, k), is infinite where there is none. Only those within a
    radius, if there is one, are complete.
    """

    def __init__(self, places: FloatArray, k: int, radius_m: float = np.inf, columns: int = 3):
        self._places, self._radius_m = places, radius_m
        self.distance_m = np.full((len(places), k), np.inf)
        self.rows = np.full((len(places), k, columns), np.nan)

    def add(self, points: FloatArray) -> None:
        """Add n points, shape (n, c), that begin with x, y and z, metres, world frame."""
        from scipy.spatial import cKDTree

        if not len(self._places):
            return
        low, high = self._places.min(axis=0), self._places.max(axis=0)
        away = np.maximum(low - points[:, :2], points[:, :2] - high).max(axis=1, initial=-np.inf)
        points = points[away <= self._radius_m]
        if not len(points):
            return
        # built faster, as it has few queries
        tree = cKDTree(points[:, :2], balanced_tree=False, compact_nodes=False)
        k = self.rows.shape[1]
        distance, at = map(np.asarray, tree.query(self._places, k=range(1, k + 1)))
        rows = np.concatenate([self.rows, points[np.where(np.isfinite(distance), at, 0)]], axis=1)
        distance = np.hstack([self.distance_m, distance])
        # of equal distances the lower point, whatever the chunks are
        order = np.lexsort((rows[..., 2], distance), axis=-1)[:, :k]
        self.distance_m = np.take_along_axis(distance, order, axis=1)
        self.rows = np.take_along_axis(rows, order[..., None], axis=1)

    def medians(self, values: FloatArray, radius_m: float) -> FloatArray:
        """Return the median of values (p, k) of the points within a radius, shape (p,).

        NaN for places with fewer than `FEWEST`. On the edge of the water half of the neighbours are
        on land and half on the bed, so that on an even bank the median of their heights is that of
        the edge.
        """
        near = self.distance_m <= radius_m
        found, enough = np.full(len(near), np.nan), near.sum(axis=1) >= FEWEST
        found[enough] = np.nanmedian(np.where(near, values, np.nan)[enough], axis=1)
        return found


def heights_from_cloud(xy: FloatArray, chunks: Iterable[FloatArray], radius_m: float) -> FloatArray:
    """Return the heights of a cloud at places (n, 2); see `NearestPoints.medians`."""
    near = NearestPoints(xy, NEIGHBOURS, radius_m)
    for xyz in chunks:
        near.add(xyz)
    return near.medians(near.rows[..., 2], radius_m)

"""Depths by regression: true depth = a + b * apparent depth, fitted to check depths."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pcfix.errors import GeometryError
from pcfix.model import NOISE_CLASSES, FloatArray
from pcfix.points.labelling import Part
from pcfix.water.fit import NearestPoints
from pcfix.water.surface import is_submerged

# A line through two check depths fits whatever they are; a third is the first that can disagree.
# Below ten the standard errors are themselves only known to a quarter or worse.
LEAST_COUNT, FEW = 3, 10
_SAME_M = 1e-3


@dataclass(frozen=True)
class DepthRegression:
    """The line true depth = `intercept_m` + `slope` * apparent depth, and how well it fits."""

    intercept_m: float
    slope: float
    intercept_se_m: float  # standard errors
    slope_se: float
    r2: float
    rmse_m: float  # of the residuals
    cv_rmse_m: float | None  # leave-one-out; None if the slope would be open without one
    count: int  # check depths that were fitted
    shallowest_m: float  # of their apparent depths; the line is extrapolated beyond
    deepest_m: float
    covariance_m: float = 0.0  # of intercept and slope
    notes: tuple[str, ...] = ()

    def depth_m(self, apparent_m: FloatArray) -> FloatArray:
        """Return the true depths of apparent ones; never above the water, where a line may lead."""
        return np.asarray(np.maximum(self.intercept_m + self.slope * apparent_m, 0.0))

    def sigma_m(self, apparent_m: FloatArray) -> FloatArray:
        """Return the standard errors of true depths, metres, shape (m,), from apparent ones.

        The leave-one-out error holds whatever the poses and the water were. Beyond the fitted
        depths the standard errors of the line are added.
        """
        inside = self.rmse_m if self.cv_rmse_m is None else self.cv_rmse_m
        nearest = np.clip(apparent_m, self.shallowest_m, self.deepest_m)
        # the variance of the line at x is se_a^2 + se_b^2 x^2 + 2 cov x
        more = self.slope_se**2 * (apparent_m**2 - nearest**2)
        more += 2.0 * self.covariance_m * (apparent_m - nearest)
        return np.asarray(np.sqrt(inside**2 + np.maximum(more, 0.0)))

    @property
    def words(self) -> str:
        """The line and its errors in words."""
        again = "" if self.cv_rmse_m is None else f", cross-validated {self.cv_rmse_m:.3f} m"
        return (
            f"Regression: depth = {self.intercept_m:.3f} m + {self.slope:.3f} x apparent depth"
            f" ({self.count} check depths at {self.shallowest_m:.2f} to {self.deepest_m:.2f} m,"
            f" extrapolated beyond; r2 {self.r2:.3f}); standard errors"
            f" {self.intercept_se_m:.3f} m and {self.slope_se:.3f}, RMSE {self.rmse_m:.3f} m"
            f"{again}."
        )


def fit_depths(apparent_m: FloatArray, true_m: FloatArray) -> DepthRegression:
    """Fit the line by least squares to depths, shape (m,), metres, positive down.

    Raises GeometryError if there are fewer than three, all have one apparent depth, or the line
    falls.
    """
    from scipy.stats import linregress

    x, y = np.asarray(apparent_m, np.float64), np.asarray(true_m, np.float64)
    if len(x) < LEAST_COUNT:
        raise GeometryError(
            "check_depths.few",
            f"{len(x)} check depths are too few for a regression. Give at least {LEAST_COUNT},"
            f" better {FEW} or more.",
            count=len(x),
        )
    if np.ptp(x) < _SAME_M:
        raise GeometryError(
            "check_depths.one_depth",
            f"All {len(x)} check depths have the apparent depth {x.mean():.3f} m, so the slope is"
            " undetermined. Give check depths from shallow to deep.",
            apparent_m=float(x.mean()),
        )
    line = linregress(x, y)
    if not line.slope > 0.0:
        raise GeometryError(
            "check_depths.falling",
            f"The check depths do not grow with the depths of the cloud (slope {line.slope:.3f})."
            " Check that they are positive down and in the cloud's CRS.",
            slope=float(line.slope),
        )
    notes = []
    if len(x) < FEW:
        notes.append(
            f"The regression has only {len(x)} check depths; with fewer than {FEW} its standard"
            " errors are unreliable."
        )
    if not 1.0 <= line.slope <= 2.0:
        notes.append(
            f"The slope {line.slope:.3f} of the regression is not that of refraction (1.33 to 1.6)."
            " Check the water level and the check depths."
        )
    residual = y - (line.intercept + line.slope * x)
    leverage = 1.0 / len(x) + (x - x.mean()) ** 2 / ((x - x.mean()) ** 2).sum()
    # without value i the line is off it by residual_i / (1 - h_i), with the diagonal h of the hat
    # matrix; where h_i is 1 the others all have one depth
    cross_validated = None
    if not (leverage > 1.0 - 1e-9).any():
        cross_validated = float(np.sqrt(np.mean((residual / (1.0 - leverage)) ** 2)))
    return DepthRegression(
        intercept_m=float(line.intercept),
        slope=float(line.slope),
        intercept_se_m=float(line.intercept_stderr),
        slope_se=float(line.stderr),
        r2=float(line.rvalue**2),
        rmse_m=float(np.sqrt(np.mean(residual**2))),
        cv_rmse_m=cross_validated,
        count=len(x),
        shallowest_m=float(x.min()),
        deepest_m=float(x.max()),
        covariance_m=float(-x.mean() * line.stderr**2),
        notes=tuple(notes),
    )


NEIGHBOURS = 16
MOST_PLACES = 1000  # that the distance between neighbours is taken at
# In distances between neighbours. On a grid that is 50 points; of points strewn at random, where
# the nearest neighbour is closer than on a grid, 10.
REACH = 4.0


def apparent_depths(
    places: FloatArray, parts: Iterable[Part]
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the medians of the submerged points nearest to places, shape (p, 2), in plan.

    They are 3 to `NEIGHBOURS`, within `REACH` times the distance between neighbouring points there.
    Points of noise (classes 7 and 18) do not count. The parts are read once, in bounded memory.
    Returns the apparent depths and the water levels, shape (p,), NaN without a bed around a place;
    the distance of the nearest submerged point, infinite without any; and the distance within which
    points count. Metres.
    """
    near = NearestPoints(places, NEIGHBOURS, columns=6)
    for xyz, surface, classes in parts:
        wet = is_submerged(xyz[:, 2], surface) & ~np.isin(classes, NOISE_CLASSES)
        near.add(np.column_stack([xyz, surface.height_m, surface.slope])[wet])
    xy, height, slope = near.rows[..., :2], near.rows[..., 3], near.rows[..., 4:]
    some = xy[:: -(-len(xy) // MOST_PLACES) or 1]
    away = np.hypot(*np.moveaxis(some[:, :, None] - some[:, None], -1, 0))
    nearest = np.where(away > 0.0, away, np.inf).min(axis=2)  # not NaN: missing points
    known = nearest[np.isfinite(nearest)]
    radius = REACH * (float(np.median(known)) if len(known) else 0.0)
    # the height of the water over the place itself, where the surface is tilted
    level = height + (slope * (places[:, None] - xy)).sum(axis=2)
    depth = near.medians(height - near.rows[..., 2], radius)
    return depth, near.medians(level, radius), near.distance_m[:, 0], radius

"""The error by depth of Hsu & Wang, remade on the simulated flume, method by method.

The paper was not at hand; the methods are read as follows, depths from the water surface, D true
and d apparent.

=========== =====================================================================================
uncorrected D = d
I           D = n d
II          Snell's law along the line of sight of each camera that made the point, at the place of
            the apparent point; the mean of their depths (Dietrich 2017): D = d tan r / tan i,
            sin r = n sin i, r from the vertical
III         D = a + b d, fitted by least squares to check points of known depth, which are then
            left out of the table
pcfix       `pcfix.correct_points` with the cameras that made each point
=========== =====================================================================================

Methods I to III change the height only. The error is that of the height of each point against its
own true position, not against the bed below or above it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.model import BoolArray, FloatArray, IntArray
from pcfix.simulate.flume import Flume

METHODS = ("uncorrected", "I", "II", "III", "pcfix")
BIN_M = 0.1
CHECKS_PER_BIN = 10
CHECK_SD_M = 0.002  # of a depth read from a point gauge


@dataclass(frozen=True, eq=False)
class DepthBins:
    """The errors of the methods, bin by bin of true depth.

    Attributes
    ----------
    edges_m : array, shape (b + 1,)
    points : array, shape (b,)
        Points of each bin; the check points are not among them.
    rmse_m, mean_m : array, shape (b + 1, len(METHODS))
        Of the heights; the last row is for all points.
    offset_m, slope, r2 : float
        The regression of method III, and its coefficient of determination.
    """

    edges_m: FloatArray
    points: IntArray
    rmse_m: FloatArray
    mean_m: FloatArray
    offset_m: float
    slope: float
    r2: float


def depth_bins(flume: Flume, corrected_depth_m: FloatArray, seed: int = 1) -> DepthBins:
    """Return the errors of every method by depth, with those of pcfix's own depths, shape (n,)."""
    bins = int(np.ceil(flume.true_depth_m.max() / BIN_M - 1e-9))
    edges = BIN_M * np.arange(bins + 1)
    which = np.clip(np.digitize(flume.true_depth_m, edges) - 1, 0, bins - 1)
    rng = np.random.default_rng(seed)
    check = _check_points(which, rng)
    slope, offset, r2 = _regression(flume, check, rng)
    estimates = [
        flume.apparent_depth_m,
        flume.refractive_index * flume.apparent_depth_m,
        mean_of_cameras(flume),
        offset + slope * flume.apparent_depth_m,
        corrected_depth_m,
    ]
    errors = flume.true_depth_m[:, None] - np.column_stack(estimates)
    groups = [(which == i) & ~check for i in range(bins)]
    rows = [errors[group] for group in [*groups, ~check]]
    return DepthBins(
        edges_m=np.asarray(edges, dtype=np.float64),
        points=np.array([group.sum() for group in groups]),
        rmse_m=np.array([np.sqrt((row**2).mean(axis=0)) for row in rows]),
        mean_m=np.array([row.mean(axis=0) for row in rows]),
        offset_m=offset,
        slope=slope,
        r2=r2,
    )


def _check_points(which: IntArray, rng: np.random.Generator) -> BoolArray:
    """Choose the same number of points from every bin."""
    check = np.zeros(len(which), dtype=bool)
    for i in range(int(which.max()) + 1):
        own = np.flatnonzero(which == i)
        check[rng.choice(own, min(CHECKS_PER_BIN, len(own) // 2), replace=False)] = True
    return check


def _regression(
    flume: Flume, check: BoolArray, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Return slope, offset and r^2 of the measured depth of the check points on the apparent."""
    apparent = flume.apparent_depth_m[check]
    measured = flume.true_depth_m[check] + rng.normal(0.0, CHECK_SD_M, len(apparent))
    slope, offset = np.polyfit(apparent, measured, 1)
    return float(slope), float(offset), float(np.corrcoef(apparent, measured)[0, 1] ** 2)


def mean_of_cameras(flume: Flume) -> FloatArray:
    """Return the depth by method II, shape (n,)."""
    counts = np.diff(flume.views.start)
    owner = np.repeat(np.arange(len(counts)), counts)
    sight = flume.cameras.centres[flume.views.camera] - flume.apparent_xyz[owner]
    r = np.arctan2(np.hypot(sight[:, 0], sight[:, 1]), sight[:, 2])
    i = np.arcsin(np.sin(r) / flume.refractive_index)
    ratio = np.divide(
        np.tan(r), np.tan(i), out=np.full(len(r), flume.refractive_index), where=i > 0
    )
    return np.asarray(flume.apparent_depth_m * np.bincount(owner, ratio) / counts)

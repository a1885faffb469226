"""What a sample of distances or of signed errors says, in numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from pcfix.compare.nearest import Neighbours
from pcfix.errors import GeometryError, SettingError
from pcfix.model import FloatArray
from pcfix.options.steps import SIGMA_REFERENCE_M
from pcfix.refract.tally import share_of_orders, within_orders

PERCENTILES = (5, 25, 50, 75, 95)
NMAD_FACTOR = 1.4826
"""Of the median absolute deviation: makes it the standard deviation of a normal sample."""
BINS = 64
TAIL_PERCENT = 0.5
"""A histogram leaves out so much on either side, so that one outlier does not set its width."""


@dataclass(frozen=True, slots=True)
class Histogram:
    """Counts between edges (m), and how many values lie outside on either side."""

    edges_m: list[float]
    counts: list[int]
    below: int
    above: int


@dataclass(frozen=True, slots=True)
class Normal:
    """A normal distribution fitted to a sample.

    Attributes
    ----------
    mu_m, sigma_m : float
        By maximum likelihood: mean and standard deviation of the sample.
    histogram_mu_m, histogram_sigma_m : float or None
        Of the parabola fitted to the histogram's logarithm, which outliers hardly move; None
        where there is no solution.
    note : str
        Why something is missing; empty when nothing is.
    """

    mu_m: float
    sigma_m: float
    histogram_mu_m: float | None
    histogram_sigma_m: float | None
    note: str = ""


@dataclass(frozen=True, slots=True)
class Statistics:
    """A sample of distances or errors, metres.

    For signed errors the mean is the bias. The standard deviation is that of the sample itself
    (divided by n), so that rmse^2 = mean^2 + sd^2; 95 % of the sample are no larger than
    `within_95_m`, whatever their sign.
    """

    count: int
    mean_m: float
    sd_m: float
    rmse_m: float
    nmad_m: float
    median_m: float
    min_m: float
    max_m: float
    within_95_m: float
    percentiles_m: dict[str, float]


@dataclass(frozen=True, slots=True)
class Share:
    """The share of a sample, 0 to 1, from one value up to, and without, another."""

    low_m: float
    high_m: float
    share: float


@dataclass(frozen=True, slots=True)
class Distribution:
    """Statistics of a sample with its histogram and the fitted normal distribution."""

    statistics: Statistics
    histogram: Histogram
    normal: Normal
    shares: tuple[Share, ...] = ()


def statistics_of(values: FloatArray) -> Statistics:
    """Return the statistics of a sample, shape (n,), metres, finite; none is a `GeometryError`."""
    if len(values) == 0:
        raise GeometryError("There is no difference to take statistics of: no point is left.")
    marks = np.percentile(values, (*PERCENTILES, 0, 100))
    median = float(marks[PERCENTILES.index(50)])
    return Statistics(
        count=len(values),
        mean_m=float(values.mean()),
        sd_m=float(values.std()),
        rmse_m=float(np.sqrt(np.mean(values * values))),
        nmad_m=float(NMAD_FACTOR * np.median(np.abs(values - median))),
        median_m=median,
        min_m=float(marks[-2]),
        max_m=float(marks[-1]),
        within_95_m=float(np.percentile(np.abs(values), 95)),
        percentiles_m={
            f"p{name}": float(mark) for name, mark in zip(PERCENTILES, marks, strict=False)
        },
    )


def distribution_of(values: FloatArray) -> Distribution:
    """Return statistics, histogram and fitted normal distribution of a sample, shape (n,), m."""
    statistics, histogram = statistics_of(values), histogram_of(values)
    return Distribution(statistics, histogram, normal_of(statistics, histogram))


def distances_of(
    values: FloatArray, classes: int | None, bands: Iterable[tuple[float, float]]
) -> Distribution:
    """Return the same of distances, with the histogram that CloudCompare draws, and shares.

    The histogram has all values, shape (n,), metres; without a number of classes it has the square
    root of n, rounded up. A band is from its lower bound up to, and without, its upper one, m.
    """
    plain = distribution_of(values)
    counts, edges = np.histogram(values, classes or math.ceil(math.sqrt(len(values))))
    shares = [
        Share(low, high, float(np.mean((values >= low) & (values < high)))) for low, high in bands
    ]
    histogram = Histogram(edges.tolist(), counts.tolist(), 0, 0)
    return replace(plain, histogram=histogram, shares=tuple(shares))


def histogram_of(values: FloatArray) -> Histogram:
    """Return the histogram of a sample, shape (n,), metres, between its outer half percents."""
    tails = np.percentile(values, (TAIL_PERCENT, 100.0 - TAIL_PERCENT))
    low, high = float(tails[0]), float(tails[1])
    if not high > low:
        low, high = low - 0.5e-3, high + 0.5e-3
    counts, edges = np.histogram(values, BINS, (low, high))
    below, above = int((values < low).sum()), int((values > high).sum())
    return Histogram(edges.tolist(), counts.tolist(), below, above)


def normal_of(statistics: Statistics, histogram: Histogram) -> Normal:
    """Fit a normal distribution, by maximum likelihood and to the histogram.

    The logarithm of a normal density is a parabola. It is fitted to the logarithms of the counts
    by least squares, each weighted with its count, as the logarithm of a small count says little.
    """
    mu, sigma = statistics.mean_m, statistics.sd_m
    if sigma <= abs(mu) * 1e-12:
        return Normal(mu, 0.0, None, None, "all values are equal: no normal distribution fits")
    edges, counts = np.array(histogram.edges_m), np.array(histogram.counts, np.float64)
    held = counts > 0
    if held.sum() < 3:
        return Normal(mu, sigma, None, None, "the histogram holds too few values to fit")
    scale = edges[-1] - edges[0]
    x = (0.5 * (edges[:-1] + edges[1:])[held] - statistics.median_m) / scale
    square, linear, _ = np.polyfit(x, np.log(counts[held]), 2, w=counts[held])
    if square >= 0.0:
        return Normal(mu, sigma, None, None, "the histogram has no peak: no normal one fits")
    centre = statistics.median_m - scale * float(linear / (2.0 * square))
    return Normal(mu, sigma, centre, scale * float(np.sqrt(-0.5 / square)))


MAX_BINS = 10_000


@dataclass(frozen=True, slots=True)
class Line:
    """depth = intercept + slope * reference depth, by least squares; 1 and 0 are perfect.

    An uncorrected cloud under nadir images has a slope of about 1 / n.
    """

    slope: float
    intercept_m: float
    r2: float
    count: int


@dataclass(frozen=True, slots=True)
class Bin:
    """The errors between two depths, or two distances from the shore.

    `before` is None where the cloud does not say where its points were.
    """

    from_m: float
    to_m: float
    after: Statistics
    before: Statistics | None


@dataclass(frozen=True, slots=True)
class Tvu:
    """Total vertical uncertainty at 95 % as it was measured, in the terms of IHO S-44.

    Attributes
    ----------
    count : int
        Differences that it is of.
    tvu_95_m : float
        That 95 % of them do not exceed.
    s44 : dict
        The share of them, 0 to 1, within the TVU of each order at the depth of the reference.
    """

    count: int
    tvu_95_m: float
    s44: dict[str, float]


@dataclass(frozen=True, slots=True)
class Own:
    """Errors without the noise of the reference, metres; the bias stays as it is.

    Attributes
    ----------
    of : {"bed", "all"}
    sigma_reference_m : float
    is_assumed : bool
        Whether the noise is that of its kind of reference, as none was stated.
    mean_m : float
    rmse_m, within_95_m : float or None
        None where the errors scatter no more than the reference is said to, so that nothing is
        known of the cloud's own part. 95 % shrink as the RMSE does.
    """

    of: str
    sigma_reference_m: float
    is_assumed: bool
    mean_m: float
    rmse_m: float | None
    within_95_m: float | None


def own_of(s: Statistics, of: str, stated_m: float | None, kind: str) -> Own:
    """Return errors without the noise of the reference: variances of independent errors add up."""
    sigma = SIGMA_REFERENCE_M[kind] if stated_m is None else stated_m
    if 0.0 < s.sd_m <= sigma:
        return Own(of, sigma, stated_m is None, s.mean_m, None, None)
    rmse = math.sqrt(s.rmse_m**2 - min(sigma, s.sd_m) ** 2)
    within = s.within_95_m * (rmse / s.rmse_m if s.rmse_m else 1.0)
    return Own(of, sigma, stated_m is None, s.mean_m, rmse, within)


def tvu_of(error_m: FloatArray, depth_m: FloatArray) -> Tvu:
    """Return the vertical uncertainty that errors at reference depths, shape (n,), m, come to."""
    size = np.abs(error_m)
    shares = share_of_orders(within_orders(size, depth_m), len(size))
    return Tvu(len(size), float(np.percentile(size, 95)), shares)


def fit_line(reference_depth_m: FloatArray, depth_m: FloatArray) -> Line | None:
    """Fit depth against reference depth, both of shape (n,), metres.

    None where fewer than three depths, or only equal ones, leave the line undefined.
    """
    if len(depth_m) < 3:
        return None
    x, y = reference_depth_m - reference_depth_m.mean(), depth_m - depth_m.mean()
    xx, yy, xy = float(x @ x), float(y @ y), float(x @ y)
    scale = max(float(np.abs(reference_depth_m).max()), 1e-9)
    if xx <= len(x) * (1e-9 * scale) ** 2:
        return None
    slope = xy / xx
    intercept = float(depth_m.mean() - slope * reference_depth_m.mean())
    r2 = xy * xy / (xx * yy) if yy > 0.0 else 1.0
    return Line(slope, intercept, r2, len(x))


def binned(
    by_m: FloatArray, after_m: FloatArray, before_m: FloatArray | None, width_m: float
) -> tuple[Bin, ...]:
    """Return the bins of reference depth, or of distance, that hold points, in order.

    Errors after and before, shape (n,), metres, are sorted `by_m`; edges of bins are multiples of
    the width. A width that makes too many bins is a `SettingError`.
    """
    if len(by_m) == 0:
        return ()
    place = np.floor(by_m / width_m)
    numbers = np.unique(place)
    if len(numbers) > MAX_BINS:
        raise SettingError(f"bin width {width_m:g} m makes {len(numbers):,} bins; widen it.")
    order = np.argsort(place, kind="stable")
    groups = np.split(order, np.searchsorted(place[order], numbers[1:]))
    return tuple(
        Bin(
            float(number * width_m),
            float((number + 1) * width_m),
            statistics_of(after_m[rows]),
            None if before_m is None else statistics_of(before_m[rows]),
        )
        for number, rows in zip(numbers, groups, strict=True)
    )


def distance_from_shore(xy: FloatArray, dry_xy: FloatArray) -> FloatArray:
    """Return the distance in plan, metres, of places (n, 2) to the nearest dry point of (m, 2)."""
    return Neighbours(dry_xy).nearest(xy)[0]


def errors_against_truth(xyz: FloatArray, true_xyz: FloatArray) -> tuple[float, float, float]:
    """Return mean and rms error of Z, and in plan, of points (n, 3), metres, same frame.

    The error in plan is the root mean square length of the horizontal difference.
    """
    error = xyz - true_xyz
    return (
        float(error[:, 2].mean()),
        float(np.sqrt((error[:, 2] ** 2).mean())),
        float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())),
    )

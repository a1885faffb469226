"""Statistics of a sample of distances or of signed errors."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pcfix.blocks import blocks, grouped, mapped
from pcfix.errors import SettingError
from pcfix.model import FloatArray
from pcfix.options.steps import SIGMA_REFERENCE_M
from pcfix.refract.tally import share_of_orders, within_orders

PERCENTILES = (5, 25, 50, 75, 95)
NMAD_FACTOR = 1.4826
"""The median absolute deviation times this is the standard deviation of a normal sample."""
BINS, MAX_BINS = 64, 10_000
TAIL_PERCENT = 0.5
"""Percentage outside a histogram on either side, so that one outlier does not set its width."""


@dataclass(frozen=True, slots=True)
class Histogram:
    """Counts between edges, metres."""

    edges_m: list[float]
    counts: list[int]


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of distances or errors, metres.

    The mean of signed errors is the bias. The standard deviation is that of the sample itself
    (divided by n), so that rmse^2 = mean^2 + sd^2.
    """

    count: int
    mean_m: float
    sd_m: float
    rmse_m: float
    nmad_m: float
    median_m: float
    min_m: float
    max_m: float
    within_95_m: float  # 95 % of the absolute values are no larger
    percentiles_m: dict[str, float]


@dataclass(frozen=True, slots=True)
class Share:
    """Share of a sample, 0 to 1, from one value up to and without another."""

    low_m: float
    high_m: float
    share: float


@dataclass(frozen=True, slots=True)
class Distribution:
    """Statistics of a sample with its histogram."""

    statistics: Statistics
    histogram: Histogram
    shares: tuple[Share, ...] = ()


def statistics_of(values: FloatArray) -> Statistics:
    """Return the statistics of one value or more, shape (n,), metres, finite."""
    count = len(values)
    marks = np.percentile(values, (*PERCENTILES, 0, 100))
    median, mean = float(marks[PERCENTILES.index(50)]), float(values.mean())
    return Statistics(
        count=count,
        mean_m=mean,
        sd_m=float(values.std()),
        rmse_m=math.sqrt(np.einsum("i,i", values, values) / count),  # one thread, unlike np.dot
        nmad_m=float(NMAD_FACTOR * np.median(np.abs(values - median))),
        median_m=median,
        min_m=float(marks[-2]),
        max_m=float(marks[-1]),
        within_95_m=float(np.percentile(np.abs(values), 95)),
        percentiles_m={f"p{p}": float(m) for p, m in zip(PERCENTILES, marks, strict=False)},
    )


def distribution_of(values: FloatArray) -> Distribution:
    """Return the statistics and the histogram of values, shape (n,), metres.

    The histogram lies between the outer half percents.
    """
    low, high = np.percentile(values, (TAIL_PERCENT, 100.0 - TAIL_PERCENT)).tolist()
    if not high > low:
        low, high = low - 0.5e-3, high + 0.5e-3
    counts, edges = np.histogram(values, BINS, (low, high))
    return Distribution(statistics_of(values), Histogram(edges.tolist(), counts.tolist()))


def distances_of(
    values: FloatArray, classes: int | None, bands: Iterable[tuple[float, float]]
) -> Distribution:
    """Return the same of distances, with shares and the histogram that CloudCompare draws.

    The histogram has all values, shape (n,), metres, in as many classes as given, by default the
    square root of n, rounded up. A band is from its lower bound up to, and without, its upper one.
    """
    counts, edges = np.histogram(values, classes or math.ceil(math.sqrt(len(values))))
    shares = [
        Share(low, high, float(((values >= low) & (values < high)).mean())) for low, high in bands
    ]
    histogram = Histogram(edges.tolist(), counts.tolist())
    return Distribution(statistics_of(values), histogram, tuple(shares))


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
    """The errors between two depths, or two distances from the shore."""

    from_m: float
    to_m: float
    after: Statistics
    before: Statistics | None  # None if the cloud has no shift dimensions


@dataclass(frozen=True, slots=True)
class Tvu:
    """Measured total vertical uncertainty at 95 %, as IHO S-44 defines it."""

    count: int  # differences
    tvu_95_m: float  # 95 % of them are no larger
    s44: dict[str, float]  # share within the TVU of each order at the reference depth, 0 to 1


@dataclass(frozen=True, slots=True)
class Own:
    """Errors without the noise of the reference, metres; the bias stays as it is.

    RMSE and 95 % bound are None if the errors scatter no more than the reference, so that nothing
    is known about the cloud's own share. The bound shrinks as the RMSE does.
    """

    of: str  # "bed" or "all"
    sigma_reference_m: float
    is_assumed: bool  # whether the noise is the usual one of this kind of reference
    mean_m: float
    rmse_m: float | None
    within_95_m: float | None


def own_of(s: Statistics, of: str, stated_m: float | None, kind: str) -> Own:
    """Return errors without the noise of the reference: variances of independent errors add up."""
    sigma = SIGMA_REFERENCE_M[kind] if stated_m is None else stated_m
    rmse = within = None
    if not 0.0 < s.sd_m <= sigma:
        rmse = math.sqrt(s.rmse_m**2 - min(sigma, s.sd_m) ** 2)
        within = s.within_95_m * (rmse / s.rmse_m if s.rmse_m else 1.0)
    return Own(of, sigma, stated_m is None, s.mean_m, rmse, within)


def tvu_of(error_m: FloatArray, depth_m: FloatArray) -> Tvu:
    """Return the vertical uncertainty of errors at reference depths, both (n,), metres."""
    size = mapped(np.abs, error_m)
    within = sum(within_orders(size[rows], depth_m[rows]) for rows in blocks(len(size)))
    shares = share_of_orders(np.asarray(within), len(size))
    return Tvu(len(size), float(np.percentile(size, 95)), shares)


def fit_line(reference_depth_m: FloatArray, depth_m: FloatArray) -> Line | None:
    """Fit depth against reference depth, both of shape (n,), metres.

    None if fewer than three depths, or only equal ones, leave the line undefined.
    """
    if len(depth_m) < 3:
        return None
    x_mean, y_mean = float(reference_depth_m.mean()), float(depth_m.mean())
    x, y = reference_depth_m - x_mean, depth_m - y_mean
    xx, yy, xy = float(x @ x), float(y @ y), float(x @ y)
    scale = max(float(-reference_depth_m.min()), float(reference_depth_m.max()), 1e-9)
    if xx <= len(depth_m) * (1e-9 * scale) ** 2:
        return None
    r2 = xy * xy / (xx * yy) if yy > 0.0 else 1.0
    return Line(xy / xx, y_mean - xy / xx * x_mean, r2, len(depth_m))


def binned(
    by_m: FloatArray, after_m: FloatArray, before_m: FloatArray | None, width_m: float
) -> tuple[Bin, ...]:
    """Return the bins of reference depth, or of distance, that hold points, in order.

    Errors after and before, shape (n,), metres, are sorted `by_m`; edges of bins are multiples of
    the width. Raises SettingError ``option.range`` if there are more than `MAX_BINS`.
    """
    if len(by_m) == 0:
        return ()
    place = mapped(lambda some: np.floor(some / width_m), by_m)
    numbers = np.unique(np.hstack([np.unique(place[rows]) for rows in blocks(len(place))]))
    if len(numbers) > MAX_BINS:
        sentence = f"A bin width of {width_m:g} m makes {len(numbers):,} bins. Use a larger one."
        raise SettingError("option.range", sentence, value=width_m, bins=len(numbers))
    group = mapped(lambda some: np.searchsorted(numbers, some).astype(np.uint16), place)
    errors = [after_m] if before_m is None else [after_m, before_m]
    start, errors = grouped(group, len(numbers), *errors)
    return tuple(
        Bin(
            float(number * width_m),
            float((number + 1) * width_m),
            *(statistics_of(one[first:last]) for one in errors),
            *([None] if before_m is None else []),
        )
        for number, first, last in zip(numbers, start, start[1:], strict=False)
    )

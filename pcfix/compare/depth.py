"""Error against depth and against the distance from the shore.

Depth is positive down, along the vertical from the water surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.compare.neighbours import Neighbours
from pcfix.compare.statistics import Statistics, statistics_of
from pcfix.errors import SettingError
from pcfix.model import FloatArray  # noqa: TC001 - dataclass fields

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


def fit_line(reference_depth_m: FloatArray, depth_m: FloatArray) -> Line | None:
    """Fit depth against reference depth, both of shape (n,), metres.

    Returns
    -------
    Line, or None where fewer than three depths, or only equal ones, leave it undefined.
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
    """Return the errors in bins of reference depth, or of distance.

    Parameters
    ----------
    by_m : array, shape (n,)
        What to sort by, metres. Bin edges are multiples of the width.
    after_m, before_m : array, shape (n,)
        Errors, metres.
    width_m : float

    Returns
    -------
    tuple of Bin
        Those that hold points, in order.

    Raises
    ------
    SettingError
        If the width is not positive, or makes too many bins.
    """
    check_width(width_m)
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


def check_width(width_m: float) -> None:
    """Refuse a bin width that is not positive.

    Raises
    ------
    SettingError
    """
    if not (np.isfinite(width_m) and width_m > 0.0):
        raise SettingError(f"bin width {width_m:g} is not positive; give metres, such as 1.")


def distance_from_shore(xy: FloatArray, dry_xy: FloatArray) -> FloatArray:
    """Return the distance in plan to the nearest dry point.

    Parameters
    ----------
    xy : array, shape (n, 2)
        Metres, world frame.
    dry_xy : array, shape (m, 2)
        Points above the water, the same frame.

    Returns
    -------
    array, shape (n,)
        Metres.
    """
    distance, _ = Neighbours(dry_xy).nearest(xy)
    return distance

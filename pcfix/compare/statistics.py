"""Statistics of distances or signed errors, by the names of ``compare.json``; M3C2 distances."""

import logging
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from pcfix.errors import GeometryError, SettingError, optional_library
from pcfix.model import FloatArray, IntArray
from pcfix.points.neighbours import Neighbours, make_tiles
from pcfix.refract.tally import share_of_orders, within_orders
from pcfix.running import blocks, distinct, grouped, mapped
from pcfix.sums import Figures

PERCENTILES = (5, 25, 50, 75, 95)
MAX_BINS = 10_000
MAX_CORE_POINTS = 100_000


def statistics_of(values: FloatArray) -> Figures:
    """Return the statistics of one distance or error or more, shape (n,), metres, finite.

    The mean of signed errors is the bias. The standard deviation is that of the sample itself
    (divided by n), so that rmse^2 = mean^2 + sd^2.
    """
    marks = np.percentile(values, (*PERCENTILES, 0, 100)).tolist()
    median = marks[PERCENTILES.index(50)]
    return Figures(
        count=len(values),
        mean_m=float(values.mean()),
        sd_m=float(values.std()),
        # in one thread, unlike np.dot
        rmse_m=math.sqrt(np.einsum("i,i", values, values) / len(values)),
        nmad_m=float(1.4826 * np.median(np.abs(values - median))),  # the sd of a normal sample
        median_m=median,
        min_m=marks[-2],
        max_m=marks[-1],
        within_95_m=float(np.percentile(np.abs(values), 95)),  # of the absolute values
        percentiles_m={f"p{p}": mark for p, mark in zip(PERCENTILES, marks, strict=False)},
    )


def distribution_of(
    values: FloatArray,
    classes: int | None = None,
    bands: Iterable[tuple[float, float]] = (),
    tail_percent: float = 0.0,
) -> Figures:
    """Return statistics of values, shape (n,), metres, with a histogram and shares.

    By default the histogram is the one that CloudCompare draws: of all values, in as many classes
    as the square root of n, rounded up. It leaves out `tail_percent` of the values on either side,
    so that an outlier does not set its width. A band is from its lower bound up to, and without,
    its upper one; its share is between 0 and 1.
    """
    ends = np.percentile(values, (tail_percent, 100.0 - tail_percent)).tolist()
    counts, edges = np.histogram(values, classes or math.ceil(math.sqrt(len(values))), ends)
    shares = [
        Figures(low_m=low, high_m=high, share=float(((values >= low) & (values < high)).mean()))
        for low, high in bands
    ]
    histogram = Figures(edges_m=edges.tolist(), counts=counts.tolist())
    return Figures(statistics=statistics_of(values), histogram=histogram, shares=shares)


def tvu_of(error_m: FloatArray, depth_m: FloatArray) -> Figures:
    """Return the total vertical uncertainty at 95 %, as IHO S-44 defines it.

    Errors and reference depths have the shape (n,), metres. ``s44`` is the share of the errors
    within the TVU of each order at their depth, 0 to 1.
    """
    size = mapped(np.abs, error_m)
    within = sum(within_orders(size[rows], depth_m[rows]) for rows in blocks(len(size)))
    shares = share_of_orders(np.asarray(within), len(size))
    return Figures(count=len(size), tvu_95_m=float(np.percentile(size, 95)), s44=shares)


def fit_line(reference_depth_m: FloatArray, depth_m: FloatArray) -> Figures | None:
    """Fit depth = intercept + slope * reference depth, both of shape (n,), metres.

    A slope of 1 and an intercept of 0 are perfect; an uncorrected cloud under nadir images has a
    slope of about 1 / n. None if fewer than three depths, or only equal ones, leave the line
    undefined.
    """
    if len(depth_m) < 3 or np.ptp(reference_depth_m) <= 1e-9 * np.abs(reference_depth_m).max():
        return None
    x_mean, y_mean = float(reference_depth_m.mean()), float(depth_m.mean())
    x, y = reference_depth_m - x_mean, depth_m - y_mean  # np.cov would take more memory
    xx, xy, yy = float(x @ x), float(x @ y), float(y @ y)
    r2 = xy * xy / (xx * yy) if yy > 0.0 else 1.0
    intercept = y_mean - xy / xx * x_mean
    return Figures(slope=xy / xx, intercept_m=intercept, r2=r2, count=len(depth_m))


def binned(
    depth_m: FloatArray, after_m: FloatArray, before_m: FloatArray | None, width_m: float
) -> list[Figures]:
    """Return the statistics of bins of reference depth that hold points.

    Depths, and errors after and before the correction, have the shape (n,), metres; edges of bins
    are multiples of the width. ``before`` is None if it is not known. Raises SettingError
    ``option.range`` if there are more than `MAX_BINS`.
    """
    place = mapped(lambda some: np.floor(some / width_m), depth_m)
    numbers = distinct(np.hstack([distinct(place[rows]) for rows in blocks(len(place))]))
    if len(numbers) > MAX_BINS:
        sentence = f"A bin width of {width_m:g} m makes {len(numbers):,} bins. Use a larger one."
        raise SettingError("option.range", sentence, value=width_m, bins=len(numbers))
    group = mapped(lambda some: np.searchsorted(numbers, some).astype(np.uint16), place)
    start, errors = grouped(group, len(numbers), *[e for e in (after_m, before_m) if e is not None])
    bins = []
    for number, first, last in zip(numbers.tolist(), start, start[1:], strict=False):
        found = [statistics_of(one[first:last]) for one in errors]
        ends = {"from_m": number * width_m, "to_m": (number + 1) * width_m}
        bins.append(Figures(**ends, after=found[0], before=None if before_m is None else found[1]))
    return bins


# M3C2, by the library py4dgeo (extra ``m3c2``)


def load_py4dgeo() -> Any:
    """Import py4dgeo; InputError ``library.missing`` if it is not installed."""
    with _silence():
        return optional_library("py4dgeo", "m3c2", "M3C2")


@contextmanager
def _silence() -> Iterator[None]:
    """Keep py4dgeo's progress from stdout and from a log file in the working folder."""
    logger = logging.getLogger("py4dgeo")
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


def sample_rows(count: int, most: int) -> IntArray:
    """Return at most `most` of `count` row numbers, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def m3c2_distances(xyz: FloatArray, reference: FloatArray, max_distance_m: float) -> Figures:
    """Return M3C2 distances of a cloud from a reference, at `MAX_CORE_POINTS` points at most.

    They are along the local normal, positive where the cloud is above. The core points are rows of
    the cloud, (n, 3), which also gives the normals; the reference has the shape (m, 3), both
    metres, world frame. The cylinders reach at least `max_distance_m` to either side. Raises
    GeometryError ``reference.no_overlap`` if no cylinder holds points of both. py4dgeo needs about
    100 bytes of memory per point.
    """
    py4dgeo = load_py4dgeo()
    spacing = 1e-3  # median distance to the nearest other point, of the sparser cloud
    for one in xyz, reference:
        sample = one[sample_rows(len(one), 10_000)]
        near, _ = Neighbours(make_tiles(one), 3).nearest(sample, min(2, len(one)))
        spacing = max(spacing, float(np.median(near[:, -1])))
    normal, cylinder = 6.0 * spacing, 3.0 * spacing  # radii; a cylinder holds about 28 points
    # py4dgeo cuts a cylinder into lengths of its radius: an odd number of them, as a core point on
    # the border of two would count twice, once or not at all
    pieces = 2 * math.ceil((max_distance_m / cylinder - 1.0) / 2.0) + 1
    max_distance_m = (max(pieces, 1) - 1e-6) * cylinder
    core = xyz[sample_rows(len(xyz), MAX_CORE_POINTS)]
    origin = np.floor(reference.min(axis=0))
    with _silence():
        cloud = py4dgeo.Epoch(xyz - origin)
        distance, uncertainty = py4dgeo.M3C2(
            epochs=(py4dgeo.Epoch(reference - origin), cloud),
            corepoints=core - origin,
            normal_radii=[normal],
            cyl_radius=cylinder,
            max_distance=max_distance_m,
            cloud_for_normals=cloud,
        ).run()
    detection = uncertainty["lodetection"]
    known = np.isfinite(distance)
    if not known.any():
        sentence = (
            f"M3C2: no cylinder of {cylinder:.3g} m radius holds points of both clouds within"
            f" {max_distance_m:.3g} m. Check that they overlap."
        )
        values = {"radius_m": cylinder, "max_distance_m": max_distance_m}
        raise GeometryError("reference.no_overlap", sentence, **values)
    distance, detection = distance[known], detection[known]
    certain = np.isfinite(detection)
    beyond = np.abs(distance[certain]) > detection[certain]
    return Figures(
        core_points=len(core),
        statistics=statistics_of(distance),  # where both clouds have points in the cylinder
        # at 95 %, from roughness and density; and the share of distances beyond it
        mean_level_of_detection_m=float(detection[certain].mean()) if certain.any() else math.nan,
        significant_share=float(beyond.mean()) if certain.any() else 0.0,
        normal_radius_m=normal,
        cylinder_radius_m=cylinder,
        max_distance_m=max_distance_m,
    )

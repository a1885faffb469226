"""M3C2 distances by the library py4dgeo (extra ``m3c2``)."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from pcfix.compare.statistics import statistics_of
from pcfix.errors import GeometryError
from pcfix.libraries import optional_library
from pcfix.model import FloatArray, IntArray
from pcfix.points.neighbours import Neighbours, make_tiles
from pcfix.sums import Figures

MAX_CORE_POINTS = 100_000


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

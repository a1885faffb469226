"""The tests, each of which sets its bit of `Reason` in the rows that fail it.

They are independent of each other: each looks at all used points, whatever another found.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pcfix.clean.neighbours import SLACK, Neighbours, height_quartiles, mean_of_first
from pcfix.clean.settings import Reason
from pcfix.clean.tiles import Empty, in_memory, make_tiles, used_rows

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from pcfix.clean.settings import CleanSettings
    from pcfix.model import BoolArray, FloatArray, IntArray

    ReasonArray = npt.NDArray[np.uint8]

PIECE_ROWS = 65_536


def flag_weak(
    settings: CleanSettings,
    reasons: ReasonArray,
    ray_count: npt.NDArray[np.number],
    ray_miss_m: FloatArray | None = None,
    incidence_deg: FloatArray | None = None,
) -> None:
    """Flag weak intersections among the corrected points, those with a ray count above zero.

    Parameters
    ----------
    settings : CleanSettings
    reasons : array of uint8, shape (n,)
        Gets `Reason.FEW_RAYS`, `RAY_MISS` and `INCIDENCE`.
    ray_count : array, shape (n,)
    ray_miss_m, incidence_deg : array, shape (n,), optional
        See `pcfix.Correction`; without them their test is not run.
    """
    corrected = ray_count > 0
    if settings.min_rays is not None:
        _set(reasons, corrected & (ray_count < settings.min_rays), Reason.FEW_RAYS)
    if settings.max_ray_miss_m is not None and ray_miss_m is not None:
        _set(reasons, corrected & (ray_miss_m > settings.max_ray_miss_m), Reason.RAY_MISS)
    if settings.max_incidence_deg is not None and incidence_deg is not None:
        _set(reasons, corrected & (incidence_deg > settings.max_incidence_deg), Reason.INCIDENCE)


def flag_sparse(
    xyz: FloatArray,
    used: BoolArray,
    settings: CleanSettings,
    reasons: ReasonArray,
    *,
    tile_m: float | None = None,
    empty: Empty = in_memory,
    jobs: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[str, float]:
    """Flag statistical and radius outliers.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Metres, world frame.
    used : array of bool, shape (n,)
        The points to test; more than ``settings.nearest`` of them.
    settings : CleanSettings
    reasons : array of uint8, shape (n,)
        Gets `Reason.STATISTICAL` and `RADIUS`.
    tile_m, empty, jobs
        See `make_tiles` and `Neighbours`; without effect on the result.
    progress : callable, optional
        Called with the number of points after each piece.

    Returns
    -------
    dict
        Mean, sd and limit of the mean distances to the neighbours, metres; empty without the
        statistical test.

    Notes
    -----
    Both tests find what open3d's ``remove_statistical_outlier`` and ``remove_radius_outlier``
    find, but for two kinds of clouds: where so many points coincide that the mean distance is
    zero, and where it is the same for all points, open3d takes them for outliers and pcfix does
    not.
    """
    tiles = make_tiles(xyz, used, tile_m, empty)
    near = Neighbours(tiles, 3, jobs)
    mean_m = np.zeros(len(xyz)) if settings.statistical else None
    for piece in tiles.pieces(PIECE_ROWS):
        rows = tiles.row[piece]
        distance, _ = near.nearest(tiles.xyz[piece], settings.nearest)
        if mean_m is not None:
            mean_m[rows] = mean_of_first(distance, settings.neighbours)
        if settings.radius_m is not None:
            alone = distance[:, settings.radius_neighbours] * SLACK >= settings.radius_m
            _set(reasons, rows[alone], Reason.RADIUS)
        if progress is not None:
            progress(len(rows))
    return {} if mean_m is None else _flag_far(mean_m, used, settings, reasons)


def _flag_far(
    mean_m: FloatArray, used: BoolArray, settings: CleanSettings, reasons: ReasonArray
) -> dict[str, float]:
    """Flag the points whose mean distance is beyond the limit of all; sums go by file order."""
    count = int(used.sum())
    mean = math.fsum(float(mean_m[rows].sum()) for rows in used_rows(used)) / count
    squares = math.fsum(float(((mean_m[rows] - mean) ** 2).sum()) for rows in used_rows(used))
    sd = math.sqrt(squares / (count - 1))
    limit = mean + (settings.deviations or 0.0) * sd
    for rows in used_rows(used):
        _set(reasons, rows[mean_m[rows] > limit * SLACK], Reason.STATISTICAL)
    return {"mean": mean, "sd": sd, "limit": limit}


def flag_off_bed(
    xyz: FloatArray,
    submerged: BoolArray,
    settings: CleanSettings,
    reasons: ReasonArray,
    *,
    tile_m: float | None = None,
    empty: Empty = in_memory,
    jobs: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Flag submerged points below the bed and floating in the water.

    The bed about a point is the middle half, by height, of the submerged points nearest to it in
    plan; see `CleanSettings`.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Metres, world frame.
    submerged : array of bool, shape (n,)
        The points to test; at least ``settings.bed_neighbours`` of them.
    settings : CleanSettings
    reasons : array of uint8, shape (n,)
        Gets `Reason.BELOW_BED` and `FLOATING`.
    tile_m, empty, jobs, progress
        See `flag_sparse`.
    """
    tiles = make_tiles(xyz, submerged, tile_m, empty)
    near = Neighbours(tiles, 2, jobs)
    for piece in tiles.pieces(PIECE_ROWS):
        rows, points = tiles.row[piece], tiles.xyz[piece]
        lower, upper = height_quartiles(near, points, settings.bed_neighbours).T
        fence = settings.fences * (upper - lower)
        z = points[:, 2]
        if settings.below_m is not None:
            below = lower - z > np.maximum(fence, settings.below_m)
            _set(reasons, rows[below], Reason.BELOW_BED)
        if settings.floating_m is not None:
            above = z - upper > np.maximum(fence, settings.floating_m)
            _set(reasons, rows[above], Reason.FLOATING)
        if progress is not None:
            progress(len(rows))


def _set(reasons: ReasonArray, where: BoolArray | IntArray, reason: Reason) -> None:
    """Set a bit in the rows of a mask, or with the given numbers."""
    reasons[where] |= np.uint8(reason)

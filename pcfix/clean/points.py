"""The tests for noise, each of which sets its bit of `Reason` in the rows that fail it.

They are independent of each other: each looks at all used points, whatever another found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from enum import IntFlag
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.clean.neighbours import PIECE_ROWS, SLACK, Neighbours, height_quartiles, make_tiles
from pcfix.errors import bad_file
from pcfix.model import BoolArray, FloatArray, IntArray, WaterSurface
from pcfix.options.steps import LEAST_NEIGHBOURS, CleanRules
from pcfix.running import threads
from pcfix.water.checks import as_surface, checked_column, checked_points
from pcfix.water.surface import is_submerged, surface_above

ReasonArray = npt.NDArray[np.uint8]
Counted = Callable[[int], None]


class Reason(IntFlag):
    """Why a point is noise; one point may have several reasons, one bit each."""

    STATISTICAL = 1
    RADIUS = 2
    FEW_RAYS = 4
    RAY_MISS = 8
    INCIDENCE = 16
    BELOW_BED = 32
    FLOATING = 64


class Cloud(NamedTuple):
    """What the tests need of n points."""

    xyz: FloatArray  # (n, 3), metres, world frame
    used: BoolArray  # (n,), the points to test; the others are not neighbours of any
    submerged: BoolArray  # (n,), those of them to test against the bed
    reasons: ReasonArray  # (n,), bits of `Reason`, set by the tests


def flag_weak(
    settings: CleanRules,
    reasons: ReasonArray,
    ray_count: npt.NDArray[np.number],
    ray_miss_m: FloatArray | None = None,
    incidence_deg: FloatArray | None = None,
) -> None:
    """Flag weak intersections among the corrected points, those with a ray count above zero.

    Sets `Reason.FEW_RAYS`, `RAY_MISS` and `INCIDENCE`. All arrays have the shape (n,); without ray
    distances or incidence angles (see `pcfix.Correction`) their test is skipped.
    """
    corrected = ray_count > 0
    if settings.min_rays is not None:
        _set(reasons, corrected & (ray_count < settings.min_rays), Reason.FEW_RAYS)
    if settings.max_ray_miss is not None and ray_miss_m is not None:
        _set(reasons, corrected & (ray_miss_m > settings.max_ray_miss), Reason.RAY_MISS)
    if settings.max_incidence is not None and incidence_deg is not None:
        _set(reasons, corrected & (incidence_deg > settings.max_incidence), Reason.INCIDENCE)


def flag_neighbours(
    name: str, cloud: Cloud, settings: CleanRules, progress: Counted | None = None
) -> dict[str, float]:
    """Run the tests that look at neighbours: see `flag_sparse` and `flag_off_bed`.

    `progress` is called with the number of points of each piece that a test has done.
    """
    least = max(LEAST_NEIGHBOURS, settings.nearest)
    used, submerged = int(cloud.used.sum()), int(cloud.submerged.sum())
    if used < least + 1:
        sentence = (
            f"has {used:,} points that are neither withheld nor noise, too few for a neighbourhood"
            f" of {least}. Use fewer neighbours, or skip the cleaning."
        )
        raise bad_file(name, "cloud.too_few_points", sentence, points=used, least=least + 1)
    least = settings.bed_neighbours
    if settings.below_or_floating and 0 < submerged < least + 1:
        sentence = (
            f"has {submerged:,} submerged points, too few for a neighbourhood of {least} on the"
            " bed. Use fewer bed-neighbours, or switch off the tests below and floating."
        )
        raise bad_file(name, "cloud.too_few_points", sentence, points=submerged, least=least + 1)
    distances = flag_sparse(cloud, settings, progress) if settings.nearest else {}
    if settings.below_or_floating and submerged:
        flag_off_bed(cloud, settings, progress)
    return distances


def flag_sparse(cloud: Cloud, settings: CleanRules, progress: Counted | None) -> dict[str, float]:
    """Flag statistical and radius outliers: `Reason.STATISTICAL` and `RADIUS`.

    More than ``settings.nearest`` points are used. Returns mean, standard deviation and limit of
    the mean distances to the neighbours, metres; empty without the statistical test.

    Both tests find what open3d's ``remove_statistical_outlier`` and ``remove_radius_outlier``
    find, except in clouds where enough points coincide that the mean distance is zero, or where it
    is the same for all points. There open3d takes all points for outliers, and pcfix none.
    """
    mean_m = np.zeros(len(cloud.xyz)) if settings.statistical else None
    for near, rows, xyz in _pieces(cloud.xyz, cloud.used, 3, progress):
        distance, _ = near.nearest(xyz, settings.nearest)
        if mean_m is not None:
            mean_m[rows] = distance[:, : settings.neighbours].mean(axis=1)
        if settings.radius is not None:
            lonely = distance[:, settings.radius_neighbours] * SLACK >= settings.radius
            _set(cloud.reasons, rows[lonely], Reason.RADIUS)
    if mean_m is None:
        return {}
    known = mean_m[cloud.used]  # in the order of the file
    mean, sd = float(known.mean()), float(known.std(ddof=1))
    limit = mean + (settings.deviations or 0.0) * sd
    _set(cloud.reasons, cloud.used & (mean_m > limit * SLACK), Reason.STATISTICAL)
    return {"mean": mean, "sd": sd, "limit": limit}


def flag_off_bed(cloud: Cloud, settings: CleanRules, progress: Counted | None) -> None:
    """Flag submerged points below the bed (`Reason.BELOW_BED`) and above it (`FLOATING`).

    The bed at a point is the middle half, by height, of the submerged points nearest to it in plan;
    see `CleanRules`. At least ``settings.bed_neighbours`` points are submerged.
    """
    for near, rows, xyz in _pieces(cloud.xyz, cloud.submerged, 2, progress):
        lower, upper = height_quartiles(near, xyz, settings.bed_neighbours).T
        fence, z = settings.fences * (upper - lower), xyz[:, 2]
        if settings.below is not None:
            below = lower - z > np.maximum(fence, settings.below)
            _set(cloud.reasons, rows[below], Reason.BELOW_BED)
        if settings.floating is not None:
            above = z - upper > np.maximum(fence, settings.floating)
            _set(cloud.reasons, rows[above], Reason.FLOATING)


def _pieces(
    xyz: FloatArray, used: BoolArray, axes: int, progress: Counted | None
) -> Iterator[tuple[Neighbours, IntArray, FloatArray]]:
    """Yield the search, and rows and coordinates of the used points, piece by piece."""
    tiles = make_tiles(xyz, used)
    near = Neighbours(tiles, axes)
    for piece in tiles.pieces(PIECE_ROWS):
        yield near, tiles.row[piece], tiles.xyz[piece]
        if progress is not None:
            progress(piece.stop - piece.start)


def _set(reasons: ReasonArray, where: BoolArray | IntArray, reason: Reason) -> None:
    """Set a bit in the rows of a mask, or with the given numbers."""
    reasons[where] |= np.uint8(reason)


def clean_points(
    xyz: npt.ArrayLike,
    *,
    water: WaterSurface | float | npt.ArrayLike | None = None,
    ray_count: npt.ArrayLike | None = None,
    ray_miss_m: npt.ArrayLike | None = None,
    incidence_deg: npt.ArrayLike | None = None,
    used: npt.ArrayLike | None = None,
    settings: CleanRules | None = None,
    jobs: int | None = None,
) -> npt.NDArray[np.uint8]:
    """Find the points that are noise, and the reasons.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Points, metres, world frame; corrected ones where the cloud was corrected.
    water : WaterSurface, float, or array of shape (n,), optional
        See `pcfix.correct_points`. Without it the points with rays are the submerged ones, and
        without rays no point is tested against the bed.
    ray_count : array, shape (n,), optional
        Rays that were intersected, 0 for points that were not corrected. Without it no
        intersection is weak.
    ray_miss_m, incidence_deg : array, shape (n,), optional
        Metres, degrees in air; see `pcfix.Correction`.
    used : array of bool, shape (n,), optional
        Points to test; the others are not neighbours of any. Default: all.
    settings : CleanRules, optional
        The thresholds.
    jobs : int, optional
        Threads; default all cores.

    Returns
    -------
    array of uint8, shape (n,)
        Bits of `Reason`; 0 for a good point.

    Raises
    ------
    SettingError
        If an argument breaks its rule.
    InputError
        If there are fewer points than a neighbourhood has.

    Examples
    --------
    A bed of 30 by 30 points, 2 m under the water, and one point 1 m above it:

    >>> import numpy as np
    >>> from pcfix.clean.points import Reason, clean_points
    >>> from pcfix.options.steps import CleanRules
    >>> x, y = (grid.ravel() / 4 for grid in np.mgrid[:30, :30])
    >>> cloud = np.column_stack([x, y, -2 + 0.01 * np.sin(9 * x + 7 * y)])
    >>> cloud[450, 2] += 1
    >>> reasons = clean_points(cloud, water=0.0, settings=CleanRules(deviations=None))
    >>> [(int(row), Reason(int(reasons[row])).name) for row in np.flatnonzero(reasons)]
    [(450, 'FLOATING')]
    """
    points = checked_points(xyz)
    settings = settings or CleanRules()
    n = len(points)
    given, rays, miss, incidence = (
        None if one is None else checked_column(name, one, (n,))
        for name, one in {
            "used": used, "ray_count": ray_count, "ray_miss_m": ray_miss_m,
            "incidence_deg": incidence_deg,
        }.items()
    )  # fmt: skip
    mask = np.ones(n, np.bool_) if given is None else given.astype(np.bool_)
    submerged, reasons = np.zeros(n, np.bool_), np.zeros(n, np.uint8)
    if rays is not None:
        flag_weak(settings, reasons, rays, miss, incidence)
        reasons[~mask] = 0
        submerged = rays > 0
    if water is not None:
        surface, heights = as_surface(water, n)
        submerged = is_submerged(points[:, 2], surface_above(surface, points, heights))
    with threads(jobs):
        cloud = Cloud(points, mask, mask & submerged, reasons)
        flag_neighbours("xyz", cloud, settings)
    return reasons

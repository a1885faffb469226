"""The tests, each of which sets its bit of `Reason` in the rows that fail it.

They are independent of each other: each looks at all used points, whatever another found.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntFlag
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.blocks import empty
from pcfix.clean.neighbours import (
    PIECE_ROWS,
    SLACK,
    Neighbours,
    height_quartiles,
    make_tiles,
    mean_of_first,
    used_rows,
)
from pcfix.errors import InputError, SettingError
from pcfix.kernels import threads
from pcfix.model import BoolArray, FloatArray, IntArray, WaterSurface
from pcfix.options.steps import LEAST_NEIGHBOURS, CleanRules
from pcfix.water.checks import as_surface, checked_points
from pcfix.water.surface import is_submerged, surface_above

ReasonArray = npt.NDArray[np.uint8]


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
    """What the tests need of n points.

    Attributes
    ----------
    xyz : array, shape (n, 3)
        Metres, world frame.
    used, submerged : array of bool, shape (n,)
        The points to test, and those of them to test against the bed; the others are no one's
        neighbour.
    reasons : array of uint8, shape (n,)
        Bits of `Reason`; the tests set them.
    """

    xyz: FloatArray
    used: BoolArray
    submerged: BoolArray
    reasons: ReasonArray


class Resources(NamedTuple):
    """With what the tests work, without effect on the result; see `make_tiles`, `Neighbours`.

    `progress` is called with the number of points after each piece.
    """

    tile_m: float | None = None
    jobs: int | None = None
    progress: Callable[[int], None] | None = None


def flag_weak(
    settings: CleanRules,
    reasons: ReasonArray,
    ray_count: npt.NDArray[np.number],
    ray_miss_m: FloatArray | None = None,
    incidence_deg: FloatArray | None = None,
) -> None:
    """Flag weak intersections among the corrected points, those with a ray count above zero.

    Parameters
    ----------
    settings : CleanRules
    reasons : array of uint8, shape (n,)
        Gets `Reason.FEW_RAYS`, `RAY_MISS` and `INCIDENCE`.
    ray_count : array, shape (n,)
    ray_miss_m, incidence_deg : array, shape (n,), optional
        See `pcfix.Correction`; without them their test is not run.
    """
    corrected = ray_count > 0
    if settings.min_rays is not None:
        _set(reasons, corrected & (ray_count < settings.min_rays), Reason.FEW_RAYS)
    if settings.max_ray_miss is not None and ray_miss_m is not None:
        _set(reasons, corrected & (ray_miss_m > settings.max_ray_miss), Reason.RAY_MISS)
    if settings.max_incidence is not None and incidence_deg is not None:
        _set(reasons, corrected & (incidence_deg > settings.max_incidence), Reason.INCIDENCE)


def flag_sparse(cloud: Cloud, settings: CleanRules, resources: Resources) -> dict[str, float]:
    """Flag statistical and radius outliers: `Reason.STATISTICAL` and `RADIUS`.

    More than ``settings.nearest`` points are used.

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
    mean_m = empty((len(cloud.xyz),)) if settings.statistical else None
    for near, rows, xyz in _pieces(cloud.xyz, cloud.used, 3, resources):
        distance, _ = near.nearest(xyz, settings.nearest)
        if mean_m is not None:
            mean_m[rows] = mean_of_first(distance, settings.neighbours)
        if settings.radius is not None:
            alone = distance[:, settings.radius_neighbours] * SLACK >= settings.radius
            _set(cloud.reasons, rows[alone], Reason.RADIUS)
    return {} if mean_m is None else _flag_far(mean_m, cloud, settings)


def _pieces(
    xyz: FloatArray, used: BoolArray, axes: int, resources: Resources
) -> Iterator[tuple[Neighbours, IntArray, FloatArray]]:
    """Yield the used points piece by piece, with their rows and what finds their neighbours."""
    tiles = make_tiles(xyz, used, resources.tile_m)
    near = Neighbours(tiles, axes, resources.jobs)
    for piece in tiles.pieces(PIECE_ROWS):
        yield near, tiles.row[piece], tiles.xyz[piece]
        if resources.progress is not None:
            resources.progress(piece.stop - piece.start)


def _flag_far(mean_m: FloatArray, cloud: Cloud, settings: CleanRules) -> dict[str, float]:
    """Flag the points whose mean distance is beyond the limit of all; sums go by file order."""
    used, count = cloud.used, int(cloud.used.sum())
    mean = math.fsum(float(mean_m[rows].sum()) for rows in used_rows(used)) / count
    squares = math.fsum(float(((mean_m[rows] - mean) ** 2).sum()) for rows in used_rows(used))
    sd = math.sqrt(squares / (count - 1))
    limit = mean + (settings.deviations or 0.0) * sd
    for rows in used_rows(used):
        _set(cloud.reasons, rows[mean_m[rows] > limit * SLACK], Reason.STATISTICAL)
    return {"mean": mean, "sd": sd, "limit": limit}


def flag_off_bed(cloud: Cloud, settings: CleanRules, resources: Resources) -> None:
    """Flag submerged points below the bed and floating in the water.

    They get `Reason.BELOW_BED` and `FLOATING`. The bed about a point is the middle half, by
    height, of the submerged points nearest to it in plan; see `CleanRules`. At least
    ``settings.bed_neighbours`` points are submerged.
    """
    for near, rows, xyz in _pieces(cloud.xyz, cloud.submerged, 2, resources):
        lower, upper = height_quartiles(near, xyz, settings.bed_neighbours).T
        fence, z = settings.fences * (upper - lower), xyz[:, 2]
        if settings.below is not None:
            below = lower - z > np.maximum(fence, settings.below)
            _set(cloud.reasons, rows[below], Reason.BELOW_BED)
        if settings.floating is not None:
            above = z - upper > np.maximum(fence, settings.floating)
            _set(cloud.reasons, rows[above], Reason.FLOATING)


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
    tile_m: float | None = None,
    jobs: int | None = None,
) -> npt.NDArray[np.uint8]:
    """Find the points that are noise, and say why.

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
        Points to test; the others are no one's neighbour. Default: all.
    settings : CleanRules, optional
        The thresholds.
    tile_m : float, optional
        Side of the square tiles that are worked on; without effect on the result.
    jobs : int, optional
        Threads; default all cores.

    Returns
    -------
    array of uint8, shape (n,)
        Bits of `Reason`; 0 for a good point.

    Raises
    ------
    SettingError
        If an argument is outside its rule.
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
    check_tile(tile_m)
    n = len(points)
    given, rays = _column("used", used, n), _column("ray_count", ray_count, n)
    mask = np.ones(n, np.bool_) if given is None else given.astype(np.bool_)
    reasons = np.zeros(n, np.uint8)
    if rays is not None:
        miss = _column("ray_miss_m", ray_miss_m, n)
        flag_weak(settings, reasons, rays, miss, _column("incidence_deg", incidence_deg, n))
        reasons[~mask] = 0
    cloud = Cloud(points, mask, mask & _submerged(points, water, rays), reasons)
    with threads(jobs):
        flag_neighbours("xyz", cloud, settings, Resources(tile_m, jobs=jobs))
    return reasons


def check_tile(tile_m: float | None) -> None:
    """Refuse a side of the tiles that is none.

    Raises
    ------
    SettingError
    """
    if tile_m is not None and not 0.0 < tile_m < np.inf:
        raise SettingError(f"tile_m {tile_m:g} must be above 0: give metres, or None.")


def _column(name: str, values: npt.ArrayLike | None, n: int) -> FloatArray | None:
    if values is None:
        return None
    column = np.asarray(values, dtype=np.float64)
    if column.shape != (n,):
        raise SettingError(
            f"{name} must have one value per point, shape ({n},), not {column.shape}."
        )
    return column


def _submerged(
    points: FloatArray, water: WaterSurface | float | npt.ArrayLike | None, rays: FloatArray | None
) -> BoolArray:
    if water is not None:
        surface, heights = as_surface(water, len(points))
        return is_submerged(points[:, 2], surface_above(surface, points, heights))
    return np.zeros(len(points), np.bool_) if rays is None else rays > 0


def flag_neighbours(
    name: str, cloud: Cloud, settings: CleanRules, resources: Resources
) -> dict[str, float]:
    """Run the tests that look at neighbours: see `flag_sparse` and `flag_off_bed`.

    Raises
    ------
    InputError
        If there are fewer used or submerged points than a neighbourhood has; no submerged ones
        are allowed.
    """
    _check_enough(name, int(cloud.used.sum()), int(cloud.submerged.sum()), settings)
    distances = flag_sparse(cloud, settings, resources) if settings.nearest else {}
    if settings.below_or_floating and cloud.submerged.any():
        flag_off_bed(cloud, settings, resources)
    return distances


def _check_enough(name: str, used: int, submerged: int, settings: CleanRules) -> None:
    least = max(LEAST_NEIGHBOURS, settings.nearest)
    if used < least + 1:
        raise InputError(
            f"{name}: has {used:,} points that are neither withheld nor noise already, too few"
            f" for a neighbourhood of {least}; choose fewer neighbours, or do without cleaning."
        )
    if settings.below_or_floating and 0 < submerged < settings.bed_neighbours + 1:
        raise InputError(
            f"{name}: has {submerged:,} submerged points, too few for a neighbourhood of"
            f" {settings.bed_neighbours} on the bed; choose fewer bed-neighbours, or leave out the"
            " tests below and floating."
        )


@dataclass(frozen=True)
class CleanSummary:
    """What a cleaning did, in numbers; `as_dict` is what ``--summary`` writes.

    Attributes
    ----------
    input, output, pcfix : str
        The files and the version.
    points : int
        Points read.
    set_aside : int
        Points that came withheld or as noise (class 7 or 18): neither tested nor a neighbour.
    submerged : int
        Points that were tested against the bed.
    noise : int
        Points flagged.
    reasons : dict
        Points for each `Reason`; a point may count under several.
    dropped : int
        Points left out of the output.
    neighbour_distance_m : dict
        Of the statistical test: mean, sd and limit of the mean distances to the neighbours.
    not_run : list of str
        Tests that were asked for and could not be run, and why.
    water : str or None
    settings : dict
    seconds : float
    """

    input: str
    output: str
    pcfix: str
    points: int
    set_aside: int
    submerged: int
    noise: int
    reasons: dict[str, int]
    dropped: int
    neighbour_distance_m: dict[str, float]
    not_run: list[str]
    water: str | None
    settings: dict[str, Any]
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return dict(vars(self))

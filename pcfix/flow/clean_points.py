"""The cleaning of arrays, and the order of its tests, which files share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.clean.flags import flag_off_bed, flag_sparse, flag_weak
from pcfix.clean.settings import LEAST_NEIGHBOURS, CleanSettings
from pcfix.clean.tiles import in_memory
from pcfix.errors import InputError, SettingError
from pcfix.threads import threads
from pcfix.water.checks import as_surface, checked_points
from pcfix.water.surface import is_submerged, surface_above

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from pcfix.clean.tiles import Empty
    from pcfix.model import BoolArray, FloatArray, WaterSurface


def clean_points(
    xyz: npt.ArrayLike,
    *,
    water: WaterSurface | float | npt.ArrayLike | None = None,
    ray_count: npt.ArrayLike | None = None,
    ray_miss_m: npt.ArrayLike | None = None,
    incidence_deg: npt.ArrayLike | None = None,
    used: npt.ArrayLike | None = None,
    settings: CleanSettings | None = None,
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
    settings : CleanSettings, optional
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
    >>> from pcfix.clean import CleanSettings, Reason, clean_points
    >>> x, y = (grid.ravel() / 4 for grid in np.mgrid[:30, :30])
    >>> cloud = np.column_stack([x, y, -2 + 0.01 * np.sin(9 * x + 7 * y)])
    >>> cloud[450, 2] += 1
    >>> reasons = clean_points(cloud, water=0.0, settings=CleanSettings(deviations=None))
    >>> [(int(row), Reason(int(reasons[row])).name) for row in np.flatnonzero(reasons)]
    [(450, 'FLOATING')]
    """
    points = checked_points(xyz)
    settings = settings or CleanSettings()
    check_tile(tile_m)
    n = len(points)
    mask = np.ones(n, np.bool_) if used is None else _column("used", used, n).astype(np.bool_)
    rays = None if ray_count is None else _column("ray_count", ray_count, n)
    reasons = np.zeros(n, np.uint8)
    if rays is not None:
        miss = None if ray_miss_m is None else _column("ray_miss_m", ray_miss_m, n)
        angle = None if incidence_deg is None else _column("incidence_deg", incidence_deg, n)
        flag_weak(settings, reasons, rays, miss, angle)
        reasons[~mask] = 0
    submerged = mask & _submerged(points, water, rays)
    with threads(jobs):
        flag_neighbours("xyz", points, mask, submerged, settings, reasons, tile_m=tile_m, jobs=jobs)
    return reasons


def check_tile(tile_m: float | None) -> None:
    """Refuse a side of the tiles that is none.

    Raises
    ------
    SettingError
    """
    if tile_m is not None and not 0.0 < tile_m < np.inf:
        raise SettingError(f"tile_m {tile_m:g} must be above 0: give metres, or None.")


def _column(name: str, values: npt.ArrayLike, n: int) -> npt.NDArray[np.float64]:
    column = np.asarray(values, dtype=np.float64)
    if column.shape != (n,):
        raise SettingError(
            f"{name} must have one value per point, shape ({n},), not {column.shape}."
        )
    return column


def _submerged(
    points: FloatArray,
    water: WaterSurface | float | npt.ArrayLike | None,
    rays: FloatArray | None,
) -> BoolArray:
    if water is not None:
        surface, heights = as_surface(water, len(points))
        return is_submerged(points[:, 2], surface_above(surface, points, heights))
    return np.zeros(len(points), np.bool_) if rays is None else rays > 0


def flag_neighbours(
    name: str,
    xyz: FloatArray,
    used: BoolArray,
    submerged: BoolArray,
    settings: CleanSettings,
    reasons: npt.NDArray[np.uint8],
    *,
    tile_m: float | None = None,
    empty: Empty = in_memory,
    jobs: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[str, float]:
    """Run the tests that look at neighbours: see `flag_sparse` and `flag_off_bed`.

    Raises
    ------
    InputError
        If there are fewer used or submerged points than a neighbourhood has; no submerged ones
        are allowed.
    """
    _check_enough(name, int(used.sum()), int(submerged.sum()), settings)
    work: dict[str, Any] = {"tile_m": tile_m, "empty": empty, "jobs": jobs, "progress": progress}
    distances = flag_sparse(xyz, used, settings, reasons, **work) if settings.nearest else {}
    if settings.below_or_floating and submerged.any():
        flag_off_bed(xyz, submerged, settings, reasons, **work)
    return distances


def _check_enough(name: str, used: int, submerged: int, settings: CleanSettings) -> None:
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

"""Heights of shoreline points that have none, from the cloud around them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import SettingError

if TYPE_CHECKING:
    from pcfix.model import BoolArray, FloatArray, IntArray

NEIGHBOURS = 25
FEWEST = 3


class CloudHeights(NamedTuple):
    """What the cloud says at n places.

    height_m : shape (n,), the median of its nearest points; NaN where there are too few.
    used : shape (n,), how many counted, at most `NEIGHBOURS`.
    spread_m : shape (n,), their robust standard deviation, NaN likewise.
    """

    height_m: FloatArray
    used: IntArray
    spread_m: FloatArray

    @property
    def missing(self) -> int:
        """Places without a height."""
        return int(np.isnan(self.height_m).sum())


def is_near(xy: FloatArray, cloud_xyz: FloatArray, radius_m: float) -> BoolArray:
    """Return which points of a cloud lie within a radius of a place, in plan.

    A cloud that comes in chunks is thinned with it first; `heights_from_cloud` gives the same.

    Parameters
    ----------
    xy : array, shape (n, 2)
    cloud_xyz : array, shape (m, 3)
    radius_m : float
    """
    from scipy.spatial import cKDTree

    low, high = xy.min(axis=0) - radius_m, xy.max(axis=0) + radius_m
    plan = cloud_xyz[:, :2]
    near = ((plan >= low) & (plan <= high)).all(axis=1)
    rows = np.flatnonzero(near)
    beyond = np.nextafter(radius_m, np.inf)
    near[rows] = np.isfinite(cKDTree(xy).query(plan[rows], distance_upper_bound=beyond)[0])
    return near


def heights_from_cloud(xy: FloatArray, cloud_xyz: FloatArray, radius_m: float) -> CloudHeights:
    """Return the height of the cloud at places: the median of the nearest points.

    On the edge of the water half of the neighbours are dry and half wet, so that on an even bank
    their median is the height of the edge.

    Parameters
    ----------
    xy : array, shape (n, 2)
        Metres, the cloud's frame.
    cloud_xyz : array, shape (m, 3)
    radius_m : float
        Points farther off in plan do not count.

    Returns
    -------
    CloudHeights
        One row per place.

    Raises
    ------
    SettingError
        If the radius is not positive.
    """
    from scipy.spatial import cKDTree

    if not radius_m > 0.0:
        raise SettingError(f"radius {radius_m:g} m around shoreline points must be positive.")
    xy = np.asarray(xy, np.float64)[:, :2]
    near = cloud_xyz[is_near(xy, cloud_xyz, radius_m)] if len(xy) else cloud_xyz[:0]
    if len(near) == 0:
        nothing = np.full(len(xy), np.nan)
        return CloudHeights(nothing, np.zeros(len(xy), np.int64), nothing)
    beyond = np.nextafter(radius_m, np.inf)
    away, row = cKDTree(near[:, :2]).query(xy, NEIGHBOURS, distance_upper_bound=beyond)
    found = np.isfinite(away)
    z = np.where(found, near[np.where(found, row, 0), 2], np.nan)
    return _medians(z, found.sum(axis=1))


def _medians(z: FloatArray, used: IntArray) -> CloudHeights:
    """Return median and spread of each row, shape (n, k), of which NaN does not count."""
    enough = used >= FEWEST
    height, spread = np.full(len(z), np.nan), np.full(len(z), np.nan)
    height[enough] = np.nanmedian(z[enough], axis=1)
    away = np.abs(z[enough] - height[enough, None])
    spread[enough] = 1.4826 * np.nanmedian(away, axis=1)
    return CloudHeights(height, used, spread)

"""How many cameras have a point in their frame, and where a frame lies on the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from pcfix.lens.frames import frames_of, holds
from pcfix.lens.imaging import unproject
from pcfix.threads import one_caller

if TYPE_CHECKING:
    from pcfix.lens.frames import Frames
    from pcfix.model import Cameras, FloatArray, IntArray

BORDER_POINTS = 8
"""On each side of a footprint: enough to show the curve of a distorted frame."""


def cameras_in_sight(xyz: FloatArray, cameras: Cameras) -> IntArray:
    """Return how many cameras have each point in their frame; nothing hides a point.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Metres, world frame.
    cameras : Cameras

    Returns
    -------
    array of int, shape (n,)
    """
    with one_caller():
        return _count(np.ascontiguousarray(xyz), cameras.centres, frames_of(cameras))


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _count(xyz: FloatArray, centres: FloatArray, frames: Frames) -> IntArray:
    counts = np.zeros(len(xyz), np.int64)
    for i in prange(len(xyz)):
        for c in range(len(centres)):
            ex, ey, ez = centres[c, 0] - xyz[i, 0], centres[c, 1] - xyz[i, 1], 0.0
            ez = centres[c, 2] - xyz[i, 2]
            counts[i] += holds(frames, c, ex, ey, ez)
    return counts


def footprint(cameras: Cameras, row: int, height_m: float) -> FloatArray:
    """Return the border of a frame on a level, shape (p, 2); NaN where it looks past it.

    Parameters
    ----------
    cameras : Cameras
        With rotations and lenses.
    row : int
    height_m : float
        Of the level, world frame.
    """
    if cameras.rotations is None or cameras.lenses is None:
        return np.zeros((0, 2))
    lens = cameras.lenses[row]
    t = np.linspace(0.0, 1.0, BORDER_POINTS, endpoint=False)
    zero, one = np.zeros_like(t), np.ones_like(t)
    u = np.concatenate([t, one, 1.0 - t, zero])
    v = np.concatenate([zero, t, one, 1.0 - t])
    rays = unproject(lens, np.column_stack([u * lens.width, v * lens.height]))
    rays = rays @ cameras.rotations[row]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (height_m - cameras.centres[row, 2]) / rays[:, 2]
    reach = np.where(reach > 0.0, reach, np.nan)
    return np.asarray(cameras.centres[row, :2] + reach[:, None] * rays[:, :2])

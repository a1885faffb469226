"""Which cameras have a point in their frame, and which can have one of a whole tile.

The frame of a central projection is a pyramid with its tip in the projection centre. Four
planes bound it; a point is in the frame when it is on the inner side of all four.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from pcfix.model import Cameras, FloatArray

Plane: TypeAlias = tuple[float, float, float]
Pyramid: TypeAlias = tuple[Plane, Plane, Plane, Plane]


def frame_planes(cameras: Cameras) -> FloatArray:
    """Return the inward normals of each camera's pyramid.

    Parameters
    ----------
    cameras : Cameras

    Returns
    -------
    array, shape (k, 4, 3)
        World frame. Zero for cameras without angles: then everything is inside.
    """
    planes = np.zeros((len(cameras), 4, 3))
    if cameras.rotations is None or cameras.lenses is None:
        return planes
    for i, lens in enumerate(cameras.lenses):
        planes[i] = [
            (lens.focal, 0.0, lens.principal_x),
            (-lens.focal, 0.0, lens.width - lens.principal_x),
            (0.0, lens.focal, lens.principal_y),
            (0.0, -lens.focal, lens.height - lens.principal_y),
        ]
    return np.ascontiguousarray(planes @ cameras.rotations)


@njit(cache=True, error_model="numpy", nogil=True)
def pyramid(g: FloatArray) -> Pyramid:
    """Return the planes of one camera, shape (4, 3), as twelve numbers.

    As numbers they stay in registers; as an array they would be read again for every point.
    """
    return (
        (g[0, 0], g[0, 1], g[0, 2]),
        (g[1, 0], g[1, 1], g[1, 2]),
        (g[2, 0], g[2, 1], g[2, 2]),
        (g[3, 0], g[3, 1], g[3, 2]),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def in_frame(g: Pyramid, ex: float, ey: float, ez: float) -> bool:
    """Whether the point at C - e is on the inner side of all four planes."""
    return (
        (g[0][0] * ex + g[0][1] * ey + g[0][2] * ez <= 0.0)
        & (g[1][0] * ex + g[1][1] * ey + g[1][2] * ez <= 0.0)
        & (g[2][0] * ex + g[2][1] * ey + g[2][2] * ez <= 0.0)
        & (g[3][0] * ex + g[3][1] * ey + g[3][2] * ez <= 0.0)
    )


@njit(cache=True, error_model="numpy", nogil=True)
def may_hold(g: FloatArray, centre: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    """Whether a frame can hold any point of an upright box; never wrongly False."""
    for p in range(4):
        reach = 0.0
        for axis in range(3):
            corner = high[axis] if g[p, axis] > 0.0 else low[axis]
            reach += g[p, axis] * (corner - centre[axis])
        if reach < 0.0:
            return False
    return True

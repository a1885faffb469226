"""Derivatives of traced directions by point, camera, water and index.

By the implicit function theorem at the solution (`pcfix.refract.tracing.derivatives`). The surface
is taken as its tangent plane where the light leaves the water: exact for planes and facets; on a
raster the slope's own change from place to place (its curvature) is left out; on a crease the
plane is the one that bends the light as the crease does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from pcfix.errors import SettingError
from pcfix.refract.tracing.derivatives import (
    BY_CENTRE,
    BY_INDEX,
    BY_LEVEL,
    BY_POINT,
    BY_SLOPES,
    COLUMNS,
    DIRECTION,
    light_and_gradients,
)
from pcfix.threads import one_caller

if TYPE_CHECKING:
    import numpy.typing as npt

    from pcfix.model import FloatArray
    from pcfix.refract.tracing.paths import Tracing


@dataclass(frozen=True, eq=False)
class Gradients:
    """Derivatives of n unit directions; [i, j] is that of component i by unknown j.

    Attributes
    ----------
    by_point, by_centre : array, shape (n, 3, 3)
        Per metre.
    by_level : array, shape (n, 3)
        By the height of the water, per metre.
    by_slopes : array, shape (n, 3, 2)
        By its tilts dz/dx and dz/dy about the pivot.
    by_index : array, shape (n, 3)
        By the refractive index.
    """

    by_point: FloatArray
    by_centre: FloatArray
    by_level: FloatArray
    by_slopes: FloatArray
    by_index: FloatArray


def gradients(
    points: npt.ArrayLike,
    centres: npt.ArrayLike,
    tracing: Tracing,
    refractive_index: float,
    *,
    pivot: tuple[float, float] = (0.0, 0.0),
) -> Gradients:
    """Differentiate the directions of a tracing.

    Parameters
    ----------
    points, centres : array, shape (n, 3) or (3,)
        As they were traced, metres, world frame.
    tracing : Tracing
        Of `pcfix.refract.tracing.paths.trace`.
    refractive_index : float
    pivot : tuple of 2 float
        The place about which the water tilts, metres, world frame: for the b and c of a
        `WaterPlane` the origin.

    Returns
    -------
    Gradients
        NaN where no path was found. Where light goes straight, the water and the index have no
        part in it: zero.

    Raises
    ------
    SettingError
        If points and centres are not those of the tracing.
    """
    shape = tracing.direction.shape
    try:
        xyz = np.ascontiguousarray(np.broadcast_to(np.asarray(points, float), shape))
        seen_from = np.ascontiguousarray(np.broadcast_to(np.asarray(centres, float), shape))
    except ValueError:
        raise SettingError(
            f"points of shape {np.shape(points)} and centres of shape {np.shape(centres)} are not"
            f" those of a tracing of {shape[0]} paths."
        ) from None
    result = np.empty((len(xyz), 3, COLUMNS))
    with one_caller():
        _differentiate(
            xyz, seen_from, tracing.piercing_xyz, tracing.slope, float(refractive_index), result
        )
    by_slopes = result[:, :, BY_SLOPES:BY_INDEX].copy()
    from_pivot = xyz[:, :2] - np.asarray(pivot, float)
    by_slopes += from_pivot[:, None, :] * result[:, :, BY_LEVEL, None]
    return Gradients(
        by_point=result[:, :, BY_POINT:BY_CENTRE],
        by_centre=result[:, :, BY_CENTRE:BY_LEVEL],
        by_level=result[:, :, BY_LEVEL],
        by_slopes=by_slopes,
        by_index=result[:, :, BY_INDEX],
    )


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _differentiate(
    points: FloatArray, centres: FloatArray, piercing: FloatArray, slope: FloatArray, n: float,
    result: FloatArray,
) -> None:  # fmt: skip
    """Fill in the columns of `light_and_gradients`, made those of the unit direction.

    In coordinates about the point. Of d = w / |w| any derivative is (I - d d') w' / |w|.
    """
    for i in prange(len(points)):
        p, out = points[i], result[i]
        ax, ay, az = piercing[i, 0] - p[0], piercing[i, 1] - p[1], piercing[i, 2] - p[2]
        b, c = slope[i, 0], slope[i, 1]
        up = 1.0 / np.sqrt(1.0 + b * b + c * c)
        h = up * (az - b * ax - c * ay)
        if ax == 0.0 and ay == 0.0 and az == 0.0:
            h = 0.0  # straight: of a point in the plane itself
        light_and_gradients(
            0.0, 0.0, 0.0, centres[i, 0] - p[0], centres[i, 1] - p[1], centres[i, 2] - p[2],
            -b * up, -c * up, up, h, n, out,
        )  # fmt: skip
        _of_unit_direction(out)


@njit(cache=True, error_model="numpy", nogil=True)
def _of_unit_direction(out: FloatArray) -> None:
    """Scale the direction to one, and its derivatives with it."""
    w = out[:, DIRECTION]
    size = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    for row in range(3):
        out[row, DIRECTION] /= size
    for column in range(1, COLUMNS):
        along = 0.0
        for row in range(3):
            along += out[row, DIRECTION] * out[row, column]
        for row in range(3):
            out[row, column] = (out[row, column] - along * out[row, DIRECTION]) / size

"""The water surface as the points see it: its height and its normal above each of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import SettingError
from pcfix.model import WaterDimension, WaterMesh, WaterPlane, WaterRaster
from pcfix.water.raster import build_field, heights_above
from pcfix.water.tin import build_tin, facets_above

if TYPE_CHECKING:
    import numpy.typing as npt

    from pcfix.model import BoolArray, FloatArray, WaterSurface


class SurfaceAbove(NamedTuple):
    """The plane of the water surface above each of n points.

    height_m : shape (n,), world Z of the surface; NaN where the surface is not known.
    slope : shape (n, 2), dz/dx and dz/dy.
    """

    height_m: FloatArray
    slope: FloatArray


def surface_above(
    water: WaterSurface, xyz: FloatArray, dimension: npt.ArrayLike | None = None
) -> SurfaceAbove:
    """Return the water surface above (or below) points.

    Parameters
    ----------
    water : WaterSurface
    xyz : array, shape (n, 3)
        Metres, world frame. Only the plan position matters.
    dimension : array, shape (n,), optional
        The values of the cloud's dimension, for a `WaterDimension`.

    Raises
    ------
    SettingError
        If a `WaterDimension` comes without its values, or with the wrong number of them.
    """
    match water:
        case WaterPlane(a, b, c):
            # summed in this order, a level comes out as exactly that level
            height = a + (b * xyz[:, 0] + c * xyz[:, 1])
            return SurfaceAbove(height, np.broadcast_to([b, c], (len(xyz), 2)))
        case WaterDimension(name):
            height = np.asarray([] if dimension is None else dimension, dtype=np.float64)
            if height.shape != (len(xyz),):
                raise SettingError(
                    f"The water surface is the dimension {name}: give one height per point,"
                    f" shape ({len(xyz)},), not {height.shape}."
                )
            return SurfaceAbove(
                np.where(np.isfinite(height), height, np.nan), np.zeros((len(xyz), 2))
            )
        case WaterMesh():
            return _mesh_above(water, xyz)
        case WaterRaster():
            x, y = np.ascontiguousarray(xyz[:, 0]), np.ascontiguousarray(xyz[:, 1])
            return SurfaceAbove(*heights_above(build_field(water), x, y))


def _mesh_above(mesh: WaterMesh, xyz: FloatArray) -> SurfaceAbove:
    tin = build_tin(mesh)
    facet = facets_above(tin, np.ascontiguousarray(xyz[:, 0]), np.ascontiguousarray(xyz[:, 1]))
    plane = tin.planes[facet]
    height = (
        plane[:, 0]
        + plane[:, 1] * (xyz[:, 0] - tin.origin_x)
        + plane[:, 2] * (xyz[:, 1] - tin.origin_y)
    )
    return SurfaceAbove(np.where(facet >= 0, height, np.nan), plane[:, 1:])


def is_submerged(z: FloatArray, surface: SurfaceAbove) -> BoolArray:
    """Return which points lie below the water surface; unknown surface means no."""
    return np.asarray(z < surface.height_m)

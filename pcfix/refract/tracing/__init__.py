"""Find where the light of object points leaves the water towards the projection centres.

In the refractive collinearity of Mulsow's multimedia bundle the image of a point is that of its
piercing point. Four methods find it, `kotowski`, `afrt`, `mdfrt` and `scattershot`
(`pcfix.refract.tracing.tracers`); they agree where all of them arrive.

The first three look for a refracted ray that hits the point. On facets, and on the bilinear
patches of a raster, there may be none: through a crease that is a trough light comes that obeys
Fermat but no one facet's normal. Where they end without a ray, `trace` lets the grids of
`scattershot` narrow from there to the path of the least optical length near by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Vector, dot, minus, plus, row_of, scaled, vector
from pcfix.model import BoolArray, FloatArray, IntArray, WaterMesh, WaterPlane, WaterRaster
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX
from pcfix.refract.tracing.tracers import (
    Water,
    afrt,
    height_of,
    kotowski,
    mdfrt,
    miss_through,
    narrowed,
    scattershot,
)
from pcfix.water.surface import Field, Tin, build_field, build_tin

Surface: TypeAlias = WaterPlane | WaterRaster | WaterMesh

METHODS = ("kotowski", "afrt", "mdfrt", "scattershot")
_KOTOWSKI, _AFRT, _MDFRT, _SCATTERSHOT = range(4)
_LOST, _HIT, _CREASE = 0, 1, 2

# Columns of the result.
_SLOPE, _STEPS, _STATE, _WIDTH = 3, 5, 6, 7

HIGHEST_AIM = 0.95
"""Of the camera's height over the point: rays are aimed below the camera even where a tilted
water stands higher above the point than the camera."""
CREASE_M = 1e-7
"""A path by which the ray misses the point by more goes through a crease."""
NEAR = 0.25
"""Of the depth: how far around the end of a method its path is narrowed down."""


@dataclass(frozen=True, eq=False)
class Tracing:
    """Paths of n pairs of an object point and a projection centre.

    Attributes
    ----------
    piercing_xyz : array, shape (n, 3)
        Where the light leaves the water, metres, world frame. The point itself where the light
        goes straight; NaN where no path was found.
    direction : array, shape (n, 3)
        Unit vectors from the projection centre to there, world frame.
    slope : array, shape (n, 2)
        dz/dx and dz/dy of the surface there. On a crease those of the plane that bends light as
        the crease does.
    iterations : array of int, shape (n,)
        Steps of the method; shots, for grids.
    converged : array of bool, shape (n,)
        Whether a path was found.
    on_crease : array of bool, shape (n,)
        Whether it leaves through a crease: the shortest path near by, but no refracted ray.
    """

    piercing_xyz: FloatArray
    direction: FloatArray
    slope: FloatArray
    iterations: IntArray
    converged: BoolArray
    on_crease: BoolArray


def trace(
    origin: npt.ArrayLike,
    target: npt.ArrayLike,
    surfaces: Surface | float | Sequence[Surface | float],
    *,
    refractive_index: float = DEFAULT_REFRACTIVE_INDEX,
    method: str = "kotowski",
    narrow: bool = True,
) -> Tracing:
    """Trace light backwards, from projection centres to object points under water.

    Parameters
    ----------
    origin : array, shape (n, 3) or (3,)
        Projection centres, metres, world frame.
    target : array, shape (n, 3) or (3,)
        The true object point that each of them sees, metres, world frame. One that is above the
        water, or has none above it, is seen straight.
    surfaces : WaterPlane, WaterRaster, WaterMesh or float, or a sequence with one of them
        What the light passes on its way: the water's surface, or its level in metres.
    refractive_index : float, default 1.34
        Of the water against air, at least 1.
    method : {"kotowski", "afrt", "mdfrt", "scattershot"}
        How the path is found; see `pcfix.refract.tracing.tracers`. They agree where all arrive.
    narrow : bool, default True
        Where the method finds no ray, look for the shortest path near by.

    Returns
    -------
    Tracing
        Where the light leaves the water, and its direction at the projection centre. Nothing is
        found for a camera that is not above the water, nor where the light would leave the water
        beyond its edge. Positions are good to about 1e-9 m, on creases 1e-6 m.

    Raises
    ------
    SettingError
        If the shapes do not fit, the method or surface is unknown or the index is below one.

    Notes
    -----
    With the unit vectors u from the centre to the piercing point and v from there to the target,
    u - n v stands upright on the surface (Snell); the optical length is stationary (Fermat).

    Examples
    --------
    >>> import pcfix
    >>> found = pcfix.trace([20.0, 0.0, 100.0], [0.0, 0.0, -2.0], 0.0)
    >>> found.piercing_xyz.round(3).tolist()
    [[0.292, 0.0, 0.0]]
    """
    xyz, seen_from = np.atleast_2d(target), np.atleast_2d(origin)
    fit = xyz.ndim == seen_from.ndim == 2 and xyz.shape[1] == seen_from.shape[1] == 3
    if not (fit and (len(xyz) == len(seen_from) or 1 in (len(xyz), len(seen_from)))):
        raise SettingError(
            "trace.shapes",
            f"An origin of shape {np.shape(origin)} and a target of shape {np.shape(target)} do not"
            " form pairs. Give both as (n, 3), or one of them as (3,).",
        )
    xyz, seen_from = (np.ascontiguousarray(a, float) for a in np.broadcast_arrays(xyz, seen_from))
    n = float(refractive_index)
    if method not in METHODS:
        raise SettingError(
            "option.choice",
            f"Method {method!r} is not known. Give one of {', '.join(METHODS)}.",
            value=method,
        )
    if not 1.0 <= n < np.inf:
        raise SettingError(
            "option.range",
            f"The refractive index {n:g} is below 1. Give that of the water, about 1.34.",
            value=n,
        )
    plane, tin, field = _as_kernels_take(surfaces)
    result = np.empty((len(xyz), _WIDTH))
    how = n, METHODS.index(method), narrow
    in_tiles(_trace, len(xyz), xyz, seen_from, plane, tin, field, how, result)
    piercing = xyz + result[:, :_SLOPE]
    way = (xyz - seen_from) + result[:, :_SLOPE]
    return Tracing(
        piercing_xyz=piercing,
        direction=way / np.linalg.norm(way, axis=1)[:, None],
        slope=result[:, _SLOPE:_STEPS].copy(),
        iterations=result[:, _STEPS].astype(np.int64),
        converged=result[:, _STATE] != _LOST,
        on_crease=result[:, _STATE] == _CREASE,
    )


def _as_kernels_take(
    surfaces: Surface | float | Sequence[Surface | float],
) -> tuple[FloatArray, Tin | None, Field | None]:
    """Return plane, mesh and raster of a surface; what it is not is zero or None."""
    if isinstance(surfaces, list | tuple):
        if len(surfaces) != 1:
            raise SettingError(
                "trace.surfaces",
                f"Light is traced through one surface, not {len(surfaces)}. Give the water's.",
                count=len(surfaces),
            )
        surfaces = surfaces[0]
    surface = WaterPlane(float(surfaces)) if isinstance(surfaces, int | float) else surfaces
    plane = np.zeros(3)
    if isinstance(surface, WaterPlane):
        plane[:] = surface.a, surface.b, surface.c
        return plane, None, None
    if isinstance(surface, WaterMesh):
        return plane, build_tin(surface), None
    if isinstance(surface, WaterRaster):
        return plane, None, build_field(surface)
    raise SettingError(
        "trace.surface", f"Light cannot be traced through {surface}. Give a plane, raster or mesh."
    )


@kernel(allocates=True)
def _trace(
    span: Span, points: FloatArray, centres: FloatArray, plane: FloatArray, tin: Tin | None,
    field: Field | None, how: tuple[float, int, bool], result: FloatArray,
) -> None:  # fmt: skip
    """Trace every pair on its own, in coordinates about the object point."""
    n, method, narrow = how
    for i in range(*span):
        p = points[i]
        local = np.empty(3)
        local[0] = plane[0] + plane[1] * p[0] + plane[2] * p[1] - p[2]
        local[1], local[2] = plane[1], plane[2]
        water = Water(local, tin, field, p)
        e = minus(row_of(centres, i), vector(p))
        _path(result[i], water, e, n, method, narrow)


@device
def _path(out: FloatArray, water: Water, e: Vector, n: float, method: int, narrow: bool) -> None:
    """Trace one pair and write its row."""
    out[:] = np.nan
    out[_STEPS], out[_STATE] = 0.0, _LOST
    level, over = height_of(water, 0.0, 0.0)[0], height_of(water, e[0], e[1])[0]
    # the camera is under the water, or somewhere infinite
    if e[2] <= over or not abs(e[0]) + abs(e[1]) + abs(e[2]) < np.inf:
        return
    # the point is above the water: straight
    if not level > 0.0:
        out[:_STEPS], out[_STATE] = 0.0, _HIT
        return
    if not e[2] > 0.0:
        return
    # the height at which rays are aimed
    aim = min(level, HIGHEST_AIM * e[2])
    if method == _KOTOWSKI:
        x, y, steps, found = kotowski(water, aim, e, n)
    elif method == _AFRT:
        x, y, steps, found = afrt(water, aim, e, n)
    elif method == _MDFRT:
        x, y, steps, found = mdfrt(water, aim, e, n)
    else:
        x, y, steps, found = scattershot(water, aim, e, n)
    if not found and narrow and method != _SCATTERSHOT:
        if np.isnan(height_of(water, x, y)[0]):
            x, y = aim / e[2] * e[0], aim / e[2] * e[1]
        x, y, more, found = narrowed(water, e, x, y, NEAR * level, n)
        steps += more
    out[_STEPS] = steps
    if not found:
        return
    z, b, c = height_of(water, x, y)
    out[0], out[1], out[2], out[_SLOPE], out[_SLOPE + 1] = x, y, z, b, c
    out[_STATE] = _HIT
    mx, my = miss_through(water, e, x, y, n)
    if mx * mx + my * my <= CREASE_M * CREASE_M:
        return
    # on a crease Snell's law gives the normal: u - n v, with the unit vectors u to A and v from A
    a = x, y, z
    u = minus(a, e)
    air, wet = 1.0 / np.sqrt(dot(u, u)), n / np.sqrt(dot(a, a))
    gx, gy, gz = plus(scaled(air, u), scaled(wet, a))
    out[_SLOPE], out[_SLOPE + 1], out[_STATE] = -gx / gz, -gy / gz, _CREASE

"""From the camera forwards: a ray through any water surface, and by how much it misses the point.

The object point is the local origin. A ray is named by its aim: the place where it would cross the
level of the water above the point. It pierces the surface at A, bends there, and comes down to the
height of the point at the place (mx, my): its miss.

The surface is a plane, or the bilinear raster or the facets of `pcfix.water.surface`. Where there
is none, and where it faces away from the camera, all is NaN. Water that hides water behind it is
not looked for: the ray is taken to cross the surface once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numba import njit

from pcfix.refract.backward import plane_at
from pcfix.refract.rays import refracted

if TYPE_CHECKING:
    from pcfix.model import FloatArray
    from pcfix.water.surface import Field, Tin

Found: TypeAlias = tuple[float, float, int, bool]
"""Plan place (x, y) where a tracer ended, its number of steps, and whether it hit the point."""

CLOSE_M = 1e-9
"""A miss that is none: no finer than UTM northings allow in doubles (1e-9 m)."""

SHORT = 0.1
"""Of the depth: a step of a search that is taken though it seems to lead away, as one may from
one patch of a broken surface to the next."""

PIERCING_STEPS = 64


class Water(NamedTuple):
    """A surface as the kernels take it; see `height_of`.

    Each kind has kernels of its own: one for all, with the fields it has no use for left empty,
    compiles in a third of the time and then is four times slower on planes.

    plane : array, shape (3,), a, b, c of z = a + b x + c y about the point; used if the others
        are None.
    tin, field : the mesh or the raster.
    origin : array, shape (3,), the object point, world frame, metres.
    """

    plane: FloatArray
    tin: Tin | None
    field: Field | None
    origin: FloatArray


@njit(cache=True, error_model="numpy", nogil=True)
def height_of(water: Water, x: float, y: float) -> tuple[float, float, float]:
    """Return height over the point, dz/dx and dz/dy of the water at a plan place; NaN if none."""
    return _height_of(water.plane, water.tin, water.field, water.origin, x, y)


@njit(cache=True, error_model="numpy", nogil=True)
def _height_of(
    plane: FloatArray, tin: Tin | None, field: Field | None, origin: FloatArray, x: float, y: float
) -> tuple[float, float, float]:
    """Do it; numba drops the branch of what is None only where it is an argument of its own."""
    if tin is None and field is None:
        return plane[0] + plane[1] * x + plane[2] * y, plane[1], plane[2]
    return plane_at(tin, field, x, y, origin)


@njit(cache=True, error_model="numpy", nogil=True)
def pierce(
    water: Water, ex: float, ey: float, ez: float, dx: float, dy: float, dz: float
) -> tuple[float, float]:
    """Return the plan place where the ray from e along d pierces the surface.

    Newton's method on the tangent plane, from e + d on, inside the bracket in which the ray
    crosses the water. (`pcfix.refract.piercing` starts below the surface, at a known point; here
    that point may lie beyond the edge of the water though the ray crosses it well within.)
    """
    low, high, f = 0.0, np.inf, 1.0
    for _ in range(PIERCING_STEPS):
        x, y = ex + f * dx, ey + f * dy
        z, b, c = height_of(water, x, y)
        gap = z - (ez + f * dz)
        if not abs(gap) > 0.1 * CLOSE_M:
            break
        if gap > 0.0:
            high = f
        else:
            low = f
        f += gap / (dz - b * dx - c * dy)
        if not low < f < high:
            f = 2.0 * low if high == np.inf else 0.5 * (low + high)
    return (x, y) if abs(gap) <= CLOSE_M else (np.nan, np.nan)


@njit(cache=True, error_model="numpy", nogil=True)
def miss_through(
    water: Water, ex: float, ey: float, ez: float, x: float, y: float, n: float
) -> tuple[float, float]:
    """Return the miss of the ray that pierces the surface at the plan place x, y."""
    z, b, c = height_of(water, x, y)
    nz = 1.0 / np.sqrt(1.0 + b * b + c * c)
    nx, ny = -b * nz, -c * nz
    ux, uy, uz = ex - x, ey - y, ez - z
    facing = nx * ux + ny * uy + nz * uz
    if not facing > 0.0:
        return np.nan, np.nan
    tx, ty, tz = refracted(ux, uy, uz, ux * ux + uy * uy + uz * uz, nx, ny, nz, facing, 1.0 / n)
    if not tz < 0.0:
        return np.nan, np.nan
    return x - tx * z / tz, y - ty * z / tz


@njit(cache=True, error_model="numpy", nogil=True)
def shoot(
    water: Water, level: float, ex: float, ey: float, ez: float, x: float, y: float, n: float
) -> tuple[float, float, float, float]:
    """Return piercing place (x, y) and miss (x, y) of the ray aimed at x, y on a level."""
    ax, ay = pierce(water, ex, ey, ez, x - ex, y - ey, level - ez)
    mx, my = miss_through(water, ex, ey, ez, ax, ay, n)
    return ax, ay, mx, my


@njit(cache=True, error_model="numpy", nogil=True)
def travel(water: Water, ex: float, ey: float, ez: float, x: float, y: float, n: float) -> float:
    """Return optical length (m) of the path through a plan place; infinite where there is none."""
    z, b, c = height_of(water, x, y)
    ux, uy, uz = ex - x, ey - y, ez - z
    if not uz - b * ux - c * uy > 0.0:
        return np.inf
    air, wet = np.sqrt(ux * ux + uy * uy + uz * uz), np.sqrt(x * x + y * y + z * z)
    return float(air + n * wet)

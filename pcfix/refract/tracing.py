"""Trace light backwards, from projection centres to object points under water.

In the refractive collinearity of Mulsow's multimedia bundle the image of a point is that of its
piercing point. Four methods find it; they agree where all of them converge:

=============  ====================================================================================
kotowski       Newton's method on Snell's law at the piercing point (Kotowski 1987)
afrt           rays traced forward, their piercing point moved by a secant (Broyden) update
mdfrt          minimum distance forward ray tracing: Newton's method on the ray's distance
scattershot    grids of paths narrowed to the shortest optical length (Fermat)
=============  ====================================================================================

The first three look for a refracted ray that hits the point. On facets, and on the bilinear
patches of a raster, there may be none: through a crease that is a trough comes light that obeys
Fermat, but not the normal of any facet. There `trace` narrows the grids of `scattershot` from the
end of the method to the path of least optical length nearby.

In kernels the object point is the local origin. A ray is named by its plan place (x, y) on the
surface. It pierces the surface at A, is refracted there, and comes down to the height of the point
at the offset (mx, my). Where there is no surface, and where it faces away from the camera, all is
NaN. The ray is taken to cross the surface once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Vector, dot, minus, normal_of, plus, row_of, scaled, vector
from pcfix.model import BoolArray, FloatArray, IntArray, WaterMesh, WaterPlane, WaterRaster
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX
from pcfix.refract.rays import plane_at, refracted
from pcfix.water.surface import Field, Tin, build_field, build_tin

Surface: TypeAlias = WaterPlane | WaterRaster | WaterMesh

METHODS = ("kotowski", "afrt", "mdfrt", "scattershot")
_KOTOWSKI, _AFRT, _MDFRT, _SCATTERSHOT = range(4)
_LOST, _HIT, _CREASE = 0, 1, 2

# Columns of the result.
_SLOPE, _STEPS, _STATE, _WIDTH = 3, 5, 6, 7

CLOSE_M = 1e-9
"""An offset that counts as a hit: no finer than UTM northings allow in doubles."""
SHORT = 0.1
"""In depths: a step that is taken although it seems to lead away, as it may from one patch of a
broken surface to the next."""
SEARCH_STEPS, HALVINGS = 60, 24
"""Most steps of a search, and most halvings of a step."""
DIFFERENCE_M = 1e-6
"""Distance of the places for differences; with less, rounding exceeds what differences neglect."""
HIGHEST_START = 0.95
"""Of the straight line: the search starts below the camera even where a tilted water is higher
above the point than the camera."""
KNOTS = 10
"""To each side of the middle of the first grid of `scattershot`."""
SHOTS = 200
BLUNT_M = 1e-7
"""Half the grid below which the lengths of neighbouring paths are the same by rounding."""
NEIGHBOUR_M = 1e-4
CREASE_M = 1e-7
"""A path by which the ray misses the point by more goes through a crease."""
NEAR = 0.25
"""In depths: how far around the end of a method the shortest path is searched."""


@dataclass(frozen=True, eq=False)
class Tracing:
    """Paths of n pairs of an object point and a projection centre.

    Where light goes straight the piercing point is the object point; NaN where no path was found.
    A path through a crease is the shortest nearby, but no refracted ray; its slope is that of the
    plane that refracts light as the crease does.
    """

    piercing_xyz: FloatArray  # (n, 3), where the light leaves the water, metres, world frame
    direction: FloatArray  # (n, 3), unit vectors from the projection centre to there
    slope: FloatArray  # (n, 2), dz/dx and dz/dy of the surface there
    iterations: IntArray  # (n,), steps of the method; shots of grids
    converged: BoolArray  # (n,), whether a path was found
    on_crease: BoolArray  # (n,), whether it leaves through a crease


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
        The true object points, metres, world frame. A point above the water, or without water
        above it, is seen straight.
    surfaces : WaterPlane, WaterRaster, WaterMesh or float, or a sequence with one of them
        The water surface, or its level in metres.
    refractive_index : float, default 1.34
        Of the water against air, at least 1.
    method : {"kotowski", "afrt", "mdfrt", "scattershot"}
        How the path is found; see `pcfix.refract.tracing`.
    narrow : bool, default True
        Where the method finds no ray, search the shortest path nearby.

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
    result = np.empty((len(xyz), _WIDTH))
    how = n, METHODS.index(method), narrow
    in_tiles(_trace, len(xyz), xyz, seen_from, *_as_kernels_take(surfaces), how, result)
    to_point = xyz - seen_from
    way = to_point + result[:, :_SLOPE]
    return Tracing(
        piercing_xyz=xyz + result[:, :_SLOPE],
        direction=way / np.linalg.norm(way, axis=1)[:, None],
        slope=result[:, _SLOPE:_STEPS].copy(),
        iterations=result[:, _STEPS].astype(np.int64),
        converged=result[:, _STATE] != _LOST,
        on_crease=result[:, _STATE] == _CREASE,
    )


def _as_kernels_take(
    surfaces: Surface | float | Sequence[Surface | float],
) -> tuple[FloatArray, Tin | None, Field | None]:
    """Return plane, mesh and raster of a surface; zeros or None for the two that it is not."""
    if isinstance(surfaces, list | tuple):
        if len(surfaces) != 1:
            raise SettingError(
                "trace.surfaces",
                f"Light is traced through one surface, not {len(surfaces)}. Give the water's.",
                count=len(surfaces),
            )
        surfaces = surfaces[0]
    surface = WaterPlane(float(surfaces)) if isinstance(surfaces, int | float) else surfaces
    if isinstance(surface, WaterPlane):
        return np.array([surface.a, surface.b, surface.c]), None, None
    if isinstance(surface, WaterMesh):
        return np.zeros(3), build_tin(surface), None
    if isinstance(surface, WaterRaster):
        return np.zeros(3), None, build_field(surface)
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
    start = min(level / e[2], HIGHEST_START)
    if method == _SCATTERSHOT:
        x, y, steps, found = _scattershot(water, e, start, level, n)
    else:
        x, y, steps, found = _search(water, e, start, level, n, method)
        if not found and narrow:
            if np.isnan(height_of(water, x, y)[0]):
                x, y = start * e[0], start * e[1]
            x, y, more, found = _narrowed(water, e, x, y, NEAR * level, n)
            steps += more
    out[_STEPS] = steps
    if not found:
        return
    z, b, c = height_of(water, x, y)
    out[0], out[1], out[2], out[_SLOPE], out[_SLOPE + 1] = x, y, z, b, c
    out[_STATE] = _HIT
    mx, my = _offset(water, e, x, y, n)
    if mx * mx + my * my <= CREASE_M * CREASE_M:
        return
    # on a crease Snell's law gives the normal
    gx, gy, gz = _snell_normal(e, (x, y, z), n)
    out[_SLOPE], out[_SLOPE + 1], out[_STATE] = -gx / gz, -gy / gz, _CREASE


Found: TypeAlias = tuple[float, float, int, bool]
"""Plan place (x, y) where a tracer ended, its number of steps, and whether it hit the point."""


class Water(NamedTuple):
    """A surface for kernels, about the object point.

    Numba compiles a kernel for each kind: one for all, with empty fields, is four times slower on
    planes.

    plane : array, shape (3,), a, b, c of z = a + b x + c y; used if the others are None.
    tin, field : the mesh or the raster.
    origin : array, shape (3,), the object point, world frame, metres.
    """

    plane: FloatArray
    tin: Tin | None
    field: Field | None
    origin: FloatArray


@device
def height_of(water: Water, x: float, y: float) -> tuple[float, float, float]:
    """Return height over the point, dz/dx and dz/dy of the water at a plan place; NaN if none."""
    return _height_of(water.plane, water.tin, water.field, water.origin, x, y)


@device
def _height_of(
    plane: FloatArray, tin: Tin | None, field: Field | None, origin: FloatArray, x: float, y: float
) -> tuple[float, float, float]:
    # numba drops the branch of what is None only where that is an argument of its own
    if tin is None and field is None:
        return plane[0] + plane[1] * x + plane[2] * y, plane[1], plane[2]
    return plane_at(tin, field, x, y, origin)


@device
def _refracted_at(water: Water, e: Vector, x: float, y: float, n: float) -> tuple[Vector, Vector]:
    """Return the place of the surface at x, y, and the refracted ray from the camera through it.

    The ray, not of unit length and NaN where it does not go down, is that of Mulsow 2024 after
    Glassner 1989, which is eq 10 of Skarlatos & Agrafiotis 2018. The n_t that is printed with it,
    n_t / n_(t+1), is the inverse of that which the formula takes.
    """
    z, b, c = height_of(water, x, y)
    a = x, y, z
    normal, u = normal_of(b, c), minus(e, a)
    # light reaches only faces that look towards the camera
    facing = dot(normal, u)
    if facing > 0.0:
        t = refracted(u, dot(u, u), normal, facing, 1.0 / n)
        if t[2] < 0.0:
            return a, t
    return a, (np.nan, np.nan, np.nan)


@device
def _offset(water: Water, e: Vector, x: float, y: float, n: float) -> tuple[float, float]:
    """Return the offset of the ray that pierces the surface at the plan place x, y."""
    a, t = _refracted_at(water, e, x, y, n)
    return x - t[0] * a[2] / t[2], y - t[1] * a[2] / t[2]


@device
def _snell_normal(e: Vector, a: Vector, n: float) -> Vector:
    """Return u - n v, with the unit vectors u from the camera to A and v from A to the point."""
    u = minus(a, e)
    return plus(scaled(1.0 / np.sqrt(dot(u, u)), u), scaled(n / np.sqrt(dot(a, a)), a))


@device
def _residual(
    water: Water, e: Vector, x: float, y: float, n: float, method: int
) -> tuple[float, float]:
    r"""Return the two numbers that vanish where light pierces the surface at the plan place x, y.

    kotowski: with the unit vectors u from the camera to A and v from A to the point, Snell's law
    says that u - n v is normal to the surface, hence to its tangents (1, 0, b) and (0, 1, c):

        g = (u_x - n v_x + b (u_z - n v_z), u_y - n v_y + c (u_z - n v_z)) = 0

    g is also the gradient of the optical length by the place of A (Fermat).

    afrt: the offset of the refracted ray t at the height of the object point P.

    mdfrt: x and y of the perpendicular from the refracted ray to P,

        d = P - A - (t.(P - A) / t.t) t

    Mulsow 2024 prints P_0 for the first P, and the last term with A - P but the same sign.
    """
    if method == _KOTOWSKI:
        z, b, c = height_of(water, x, y)
        g = _snell_normal(e, (x, y, z), n)
        return g[0] + b * g[2], g[1] + c * g[2]
    if method == _AFRT:
        return _offset(water, e, x, y, n)
    a, t = _refracted_at(water, e, x, y, n)
    d = minus(scaled(dot(t, a) / dot(t, t), t), a)
    return d[0], d[1]


@device
def _search(water: Water, e: Vector, start: float, level: float, n: float, method: int) -> Found:
    """Find where the residual of a method vanishes, from the straight line on.

    `start` is the share of the straight line at which it pierces the water, whose height over the
    point is `level`. Mulsow 2024 does not say how the residual is brought to zero. Here it is
    Newton's method with differences of neighbouring places, two more rays per step. afrt
    does without: the good Broyden update

        B + (s - B y) s'B / (s' B y)

    improves the inverse B of the derivative after a step s that changes the residual by y, from
    that of water without refraction on. A step that makes the residual grow, or leaves the water,
    is halved until it is short.
    """
    x, y = start * e[0], start * e[1]
    rx, ry = _residual(water, e, x, y, n, method)
    # beyond the edge of the water: start above the point
    if np.isnan(rx):
        x, y = 0.0, 0.0
        rx, ry = _residual(water, e, x, y, n, method)
    bxx, bxy, byx, byy = 1.0 - start, 0.0, 0.0, 1.0 - start
    aside = min(DIFFERENCE_M, 0.05 * level)
    for step in range(1, SEARCH_STEPS + 1):
        if method != _AFRT:
            east_x, east_y = _residual(water, e, x + aside, y, n, method)
            north_x, north_y = _residual(water, e, x, y + aside, n, method)
            jxx, jyx, jxy, jyy = east_x - rx, east_y - ry, north_x - rx, north_y - ry
            share = aside / (jxx * jyy - jxy * jyx)
            bxx, bxy, byx, byy = share * jyy, -share * jxy, -share * jyx, share * jxx
        dx, dy = -bxx * rx - bxy * ry, -byx * rx - byy * ry
        before, size, share = rx * rx + ry * ry, np.sqrt(dx * dx + dy * dy), 1.0
        for _ in range(HALVINGS):
            new_x, new_y = _residual(water, e, x + share * dx, y + share * dy, n, method)
            is_nearer = new_x * new_x + new_y * new_y < before
            if is_nearer or (share * size < SHORT * level and not np.isnan(new_x)):
                break
            share *= 0.5
        if np.isnan(new_x):
            return x, y, step, False
        dx, dy = share * dx, share * dy
        x, y = x + dx, y + dy
        if size <= CLOSE_M:
            mx, my = _offset(water, e, x, y, n)
            return x, y, step, bool(mx * mx + my * my <= CREASE_M * CREASE_M)
        # Broyden's update; Newton's method replaces it
        along_x, along_y = dx * bxx + dy * byx, dx * bxy + dy * byy
        change_x, change_y = new_x - rx, new_y - ry
        share = 1.0 / (along_x * change_x + along_y * change_y)
        tx = share * (dx - bxx * change_x - bxy * change_y)
        ty = share * (dy - byx * change_x - byy * change_y)
        bxx, bxy = bxx + tx * along_x, bxy + tx * along_y
        byx, byy = byx + ty * along_x, byy + ty * along_y
        rx, ry = new_x, new_y
    return x, y, SEARCH_STEPS, False


@device
def _scattershot(water: Water, e: Vector, start: float, level: float, n: float) -> Found:
    """Narrow a grid of places on the surface about that of the least optical length (Fermat).

    Mulsow 2024 gives only the name ("brute force"). There is no start value, no derivative, no
    law of refraction. Where a broken surface sends light along several paths the shortest is taken,
    and a path may leave through a crease.

    On calm water the place is between the point and the straight line; the first grid covers these
    and as much as the point is deep all around.
    """
    x, y = 0.5 * start * e[0], 0.5 * start * e[1]
    half = level + max(abs(x), abs(y))
    _, x, y, _ = _best_knot(water, e, x, y, half, KNOTS, n, False)
    x, y, shots, found = _narrowed(water, e, x, y, 2.0 * half / KNOTS, n)
    return x, y, shots + 1, found


@device
def _narrowed(water: Water, e: Vector, x: float, y: float, half: float, n: float) -> Found:
    """Return the nearest place of least optical length, from a place and half a grid's size on.

    Found is a path that hits the point, or one through a crease, known to about 1e-6 m along it. A
    length changes with the square of the distance and is too blunt in the end; there the offsets of
    refracted rays are compared.
    """
    x, y, first, _ = _shrink(water, e, x, y, half, BLUNT_M, n, False)
    px, py, second, offset = _shrink(water, e, x, y, NEIGHBOUR_M, 0.1 * CLOSE_M, n, True)
    if offset <= CLOSE_M:
        return px, py, first + second, True
    # at an edge of the water the shortest path means nothing
    inside = True
    for i in (-1.0, 1.0):
        for j in (-1.0, 1.0):
            z = height_of(water, x + i * NEIGHBOUR_M, y + j * NEIGHBOUR_M)[0]
            inside = inside and not np.isnan(z)
    return x, y, first + second, inside


@device
def _shrink(
    water: Water, e: Vector, x: float, y: float, half: float, end: float, n: float,
    by_offset: bool,
) -> tuple[float, float, int, float]:  # fmt: skip
    """Halve a grid of 5 x 5 about its best knot until it is small enough.

    While the best knot is on the rim the grid moves and keeps its size.
    """
    best, shots = np.inf, 0
    while shots < SHOTS and half > end and not (by_offset and best <= CLOSE_M):
        shots += 1
        best, x, y, on_rim = _best_knot(water, e, x, y, half, 2, n, by_offset)
        if not on_rim:
            half *= 0.5
    return x, y, shots, best


@device
def _best_knot(
    water: Water, e: Vector, x: float, y: float, half: float, knots: int, n: float,
    by_offset: bool,
) -> tuple[float, float, float, bool]:  # fmt: skip
    """Return the least badness on a grid about x, y, its place, and whether that is on the rim.

    The grid has `knots` knots to each side of its middle, within `half`.
    """
    best, best_i, best_j = _badness(water, e, x, y, n, by_offset), 0, 0
    spacing = half / knots
    for i in range(-knots, knots + 1):
        for j in range(-knots, knots + 1):
            bad = _badness(water, e, x + i * spacing, y + j * spacing, n, by_offset)
            if bad < best:
                best, best_i, best_j = bad, i, j
    on_rim = max(abs(best_i), abs(best_j)) == knots
    return best, x + best_i * spacing, y + best_j * spacing, on_rim


@device
def _badness(water: Water, e: Vector, x: float, y: float, n: float, by_offset: bool) -> float:
    """Return the offset of a ray or the optical length of a path, metres; infinite without any."""
    if by_offset:
        mx, my = _offset(water, e, x, y, n)
        return np.inf if np.isnan(mx) else float(np.sqrt(mx * mx + my * my))
    z, b, c = height_of(water, x, y)
    a = x, y, z
    u = minus(e, a)
    # the surface faces away from the camera
    if not u[2] - b * u[0] - c * u[1] > 0.0:
        return np.inf
    return float(np.sqrt(dot(u, u)) + n * np.sqrt(dot(a, a)))

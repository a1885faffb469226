"""Trace light backwards, from projection centres to object points under water.

In the refractive collinearity of Mulsow's multimedia bundle the image of a point is that of its
piercing point. Four methods find it; they agree where all of them converge:

=============  ====================================================================================
kotowski       Newton's method on Snell's law at the piercing point (Kotowski 1987)
afrt           rays traced forward, their aim moved by a secant (Broyden) update
mdfrt          rays traced forward, Newton's method on their distance from the point (differences)
scattershot    grids of paths narrowed to the shortest optical length (Fermat)
=============  ====================================================================================

The first three look for a refracted ray that hits the point. On facets, and on the bilinear
patches of a raster, there may be none: through a crease that is a trough comes light that obeys
Fermat, but not the normal of any facet. There `trace` narrows the grids of `scattershot` from the
end of the method to the path of least optical length nearby.

In kernels the object point is the local origin. A ray is named by its aim: the place where it
would cross the level of the water above the point. It pierces the surface at A, is refracted there,
and comes down to the height of the point at the offset (mx, my). Where there is no surface, and
where it faces away from the camera, all is NaN. The ray is taken to cross the surface once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Vector, cross, dot, minus, normal_of, plus, row_of, scaled, vector
from pcfix.model import BoolArray, FloatArray, IntArray, WaterMesh, WaterPlane, WaterRaster
from pcfix.options.shared import DEFAULT_REFRACTIVE_INDEX
from pcfix.refract.rays import plane_at, refracted
from pcfix.water.surface import Field, Tin, build_field, build_tin, patch_at

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
HALVINGS = 24
"""Most halvings of a step."""
HIGHEST_AIM = 0.95
"""In heights of the camera over the point: rays are aimed below the camera even where a tilted
water is higher above the point than the camera."""
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
    # on a crease Snell's law gives the normal: u - n v, with the unit vectors u to A and v from A
    a = x, y, z
    u = minus(a, e)
    air, wet = 1.0 / np.sqrt(dot(u, u)), n / np.sqrt(dot(a, a))
    gx, gy, gz = plus(scaled(air, u), scaled(wet, a))
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


PIERCING_STEPS = 64


@device
def _pierce(water: Water, e: Vector, d: Vector) -> tuple[float, float]:
    """Return the plan place where the ray from e along d pierces the surface.

    Newton's method on the tangent plane, inside a bracket. Unlike `pcfix.refract.rays.pierce` it
    starts at e + d, as the point itself may lie beyond the edge of the water.
    """
    low, high, f = 0.0, np.inf, 1.0
    for _ in range(PIERCING_STEPS):
        x, y = e[0] + f * d[0], e[1] + f * d[1]
        z, b, c = height_of(water, x, y)
        # positive once the ray is below the water
        gap = z - (e[2] + f * d[2])
        if not abs(gap) > 0.1 * CLOSE_M:
            break
        if gap > 0.0:
            high = f
        else:
            low = f
        # Newton step on the tangent plane; out of the bracket, bisect or double
        f += gap / (d[2] - b * d[0] - c * d[1])
        if not low < f < high:
            f = 2.0 * low if high == np.inf else 0.5 * (low + high)
    return (x, y) if abs(gap) <= CLOSE_M else (np.nan, np.nan)


@device
def _refracted_at(water: Water, e: Vector, x: float, y: float, n: float) -> tuple[Vector, Vector]:
    """Return piercing point and refracted ray of the ray through a plan place of the surface.

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


KOTOWSKI_STEPS = 40


@device
def kotowski(water: Water, level: float, e: Vector, n: float) -> Found:
    """Return where light from the origin leaves the water towards e, (x, y, steps, found).

    With the unit vectors u from the camera to A and v from A to the point, Snell's law says that
    u - n v is normal to the surface, hence to its tangents (1, 0, b) and (0, 1, c):

        g = (u_x - n v_x + b (u_z - n v_z), u_y - n v_y + c (u_z - n v_z)) = 0

    g is also the gradient of the optical length by the place of A (Fermat); z is that of the
    surface. Mulsow 2024 does not tell how Kotowski iterates: here it is Newton's method from the
    straight line. A step that makes g grow, or leaves the water, is halved until it is short.
    """
    f = level / e[2]
    x, y = f * e[0], f * e[1]
    gx, gy, hxx, hxy, hyy = _snell_at(water, e, x, y, n)
    # beyond the edge of the water: start above the point
    if np.isnan(gx):
        x, y = 0.0, 0.0
        gx, gy, hxx, hxy, hyy = _snell_at(water, e, x, y, n)
    for step in range(1, KOTOWSKI_STEPS + 1):
        # Newton step -H^-1 g
        det = hxx * hyy - hxy * hxy
        dx, dy = (hxy * gy - hyy * gx) / det, (hxy * gx - hxx * gy) / det
        before, size, share = gx * gx + gy * gy, np.sqrt(dx * dx + dy * dy), 1.0
        for _ in range(HALVINGS):
            gx, gy, hxx, hxy, hyy = _snell_at(water, e, x + share * dx, y + share * dy, n)
            if gx * gx + gy * gy < before or (share * size < SHORT * level and not np.isnan(gx)):
                break
            share *= 0.5
        if np.isnan(gx):
            return x, y, step, False
        x, y = x + share * dx, y + share * dy
        if size <= CLOSE_M:
            return x, y, step, True
    return x, y, KOTOWSKI_STEPS, False


@device
def _snell_at(
    water: Water, e: Vector, x: float, y: float, n: float
) -> tuple[float, float, float, float, float]:
    r"""Return g at a plan place, and its derivatives by x and y: xx, xy and yy.

    The unit vectors turn with A by (I - u u') / \|A - C\| and -(I - v v') / \|A\|. A raster has the
    second derivative z_xy only; planes and facets have none.
    """
    z, b, c = height_of(water, x, y)
    twist = _twist_at(water.field, water.origin[0] + x, water.origin[1] + y)
    ux, uy, uz = minus((x, y, z), e)
    air, wet = 1.0 / np.sqrt(ux * ux + uy * uy + uz * uz), 1.0 / np.sqrt(x * x + y * y + z * z)
    ux, uy, uz, vx, vy, vz = air * ux, air * uy, air * uz, -wet * x, -wet * y, -wet * z
    along_ux, along_uy = ux + b * uz, uy + c * uz
    along_vx, along_vy = vx + b * vz, vy + c * vz
    up = uz - n * vz
    # second derivatives of the optical length on the tangent plane
    both = air + n * wet
    return (
        along_ux - n * along_vx,
        along_uy - n * along_vy,
        both * (1.0 + b * b) - air * along_ux * along_ux - n * wet * along_vx * along_vx,
        both * b * c - air * along_ux * along_uy - n * wet * along_vx * along_vy + up * twist,
        both * (1.0 + c * c) - air * along_uy * along_uy - n * wet * along_vy * along_vy,
    )


@device
def _twist_at(field: Field | None, x: float, y: float) -> float:
    """Return the second derivative z_xy of a raster's patch at a place (world frame), 1 / m."""
    if field is not None:
        twist = patch_at(field, x, y)[5]
        return -twist / (field.frame[field.which, 2] * field.frame[field.which, 3])
    return 0.0


AFRT_STEPS = 60


@device
def afrt(water: Water, level: float, e: Vector, n: float) -> Found:
    """Return where light from the origin leaves the water towards e, (x, y, steps, found).

    Mulsow 2024 gives only the name. As implemented, the straight ray to an apparent point P, at
    the height of the object point, is traced forward; P is moved by its offset the other way, and
    so on. From the second step on the good Broyden update of the inverse B,
    B + t (s'B) / (s'(s - t)), s = -B m the last step and t = -B m of the new offset, speeds it up.
    A step is at most the depth or, where that is more, what the straight line goes sideways in the
    water. One ray per step, and no derivative of the surface.
    """
    f = level / e[2]
    px, py, sx, sy = 0.0, 0.0, 0.0, 0.0
    bxx, bxy, byx, byy = 1.0, 0.0, 0.0, 1.0
    x, y = f * e[0], f * e[1]
    longest = max(level, np.sqrt(x * x + y * y))
    for step in range(1, AFRT_STEPS + 1):
        # trace the ray aimed at P
        aim = px + f * (e[0] - px), py + f * (e[1] - py), level
        ax, ay = _pierce(water, e, minus(aim, e))
        mx, my = _offset(water, e, ax, ay, n)
        if np.isnan(mx):
            return x, y, step, False
        x, y = ax, ay
        if mx * mx + my * my <= CLOSE_M * CLOSE_M:
            return x, y, step, True
        tx, ty = -bxx * mx - bxy * my, -byx * mx - byy * my
        if step > 1:
            share = 1.0 / (sx * (sx - tx) + sy * (sy - ty))
            along_x, along_y = sx * bxx + sy * byx, sx * bxy + sy * byy
            bxx, bxy = bxx + share * tx * along_x, bxy + share * tx * along_y
            byx, byy = byx + share * ty * along_x, byy + share * ty * along_y
            tx, ty = -bxx * mx - bxy * my, -byx * mx - byy * my
        size = np.sqrt(tx * tx + ty * ty)
        if not size < np.inf:
            return x, y, step, False
        # limit the step
        if size > longest:
            tx, ty = tx * longest / size, ty * longest / size
        px, py, sx, sy = px + tx, py + ty, tx, ty
    return x, y, AFRT_STEPS, False


MDFRT_STEPS = 30
NARROW_M = 1e-6
"""Least distance of the aims: below it, rounding exceeds what differences neglect."""


@device
def _distance(
    water: Water, level: float, e: Vector, x: float, y: float, n: float
) -> tuple[float, float, Vector, Vector]:
    """Return piercing place (x, y), distance d and direction t of the ray aimed at x, y.

    d leads from the refracted ray at right angles to the object point P:

        d = P - A - (t.(P - A) / t.t) t

    Mulsow 2024 prints P_0 for the first P, and the last term with A - P but the same sign.
    """
    ax, ay = _pierce(water, e, minus((x, y, level), e))
    a, t = _refracted_at(water, e, ax, ay, n)
    return ax, ay, minus(scaled(dot(t, a) / dot(t, t), t), a), t


@device
def mdfrt(water: Water, level: float, e: Vector, n: float) -> Found:
    """Return where light from the origin leaves the water towards e, (x, y, steps, found).

    Minimum distance forward ray tracing of Mulsow 2024: the aim, that of the straight line at
    first, is changed until the distance d of the refracted ray from the object point is 0. He does
    not tell how: here it is Newton's method on the two components of d across the ray, with
    differences of two neighbouring aims, three rays per step. A step that makes d grow, or leaves
    the water, is halved until it is short.
    """
    f = level / e[2]
    x, y = f * e[0], f * e[1]
    ax, ay, d, t = _distance(water, level, e, x, y, n)
    if np.isnan(d[0]):
        x, y = 0.0, 0.0
        ax, ay, d, t = _distance(water, level, e, x, y, n)
    for step in range(1, MDFRT_STEPS + 1):
        before = dot(d, d)
        if not before > CLOSE_M * CLOSE_M:
            return ax, ay, step, not np.isnan(before)
        # distance of the two neighbouring aims
        apart = min(max(0.01 * np.sqrt(before), NARROW_M), 0.05 * level)
        by_x = minus(_distance(water, level, e, x + apart, y, n)[2], d)
        by_y = minus(_distance(water, level, e, x, y + apart, n)[2], d)
        # solve for the aim across the ray (Cramer)
        det = dot(t, cross(by_x, by_y)) / apart
        dx, dy = dot(t, cross(by_y, d)) / det, dot(t, cross(d, by_x)) / det
        size, share = np.sqrt(dx * dx + dy * dy), 1.0
        if not size < np.inf:
            return ax, ay, step, False
        for _ in range(HALVINGS):
            there = _distance(water, level, e, x + share * dx, y + share * dy, n)
            after = dot(there[2], there[2])
            if after < before or (share * size < SHORT * level and not np.isnan(after)):
                break
            share *= 0.5
        if np.isnan(after):
            return ax, ay, step, False
        x, y = x + share * dx, y + share * dy
        ax, ay, d, t = there
    return ax, ay, MDFRT_STEPS, dot(d, d) <= CLOSE_M * CLOSE_M


KNOTS = 21
"""Of the first shot, each way."""
SHOTS = 200
BLUNT_M = 1e-7
"""Half the grid at which lengths no longer tell the rays apart."""
NEIGHBOUR_M = 1e-4


@device
def scattershot(water: Water, level: float, e: Vector, n: float) -> Found:
    """Return where light from the origin leaves the water towards e, (x, y, shots, found).

    Mulsow 2024 gives only the name ("brute force"). As implemented, a grid of places on the surface
    is narrowed about that of the least optical length (Fermat): no start value, no derivative, no
    law of refraction. Where a broken surface sends light along several paths the shortest is taken,
    and a path may leave through a crease. A length changes with the square of the distance and is
    too blunt in the end; there the offsets of refracted rays are compared.

    On calm water the place is between the point and the straight line; the first grid covers these
    and as much as the point is deep all around.
    """
    f = level / e[2]
    middle_x, middle_y = 0.5 * f * e[0], 0.5 * f * e[1]
    half = level + max(abs(middle_x), abs(middle_y))
    best, x, y = np.inf, middle_x, middle_y
    apart = 2.0 * half / (KNOTS - 1)
    for i in range(KNOTS):
        for j in range(KNOTS):
            knot_x, knot_y = middle_x - half + i * apart, middle_y - half + j * apart
            length = _badness(water, e, knot_x, knot_y, n, False)
            if length < best:
                best, x, y = length, knot_x, knot_y
    x, y, shots, found = _narrowed(water, e, x, y, 2.0 * apart, n)
    return x, y, shots + 1, found


@device
def _narrowed(water: Water, e: Vector, x: float, y: float, half: float, n: float) -> Found:
    """Return the nearest place of least optical length, from a place and half a grid's size on.

    Found is a path that hits the point, or one through a crease, known to about 1e-6 m along it.
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
    best, shots = _badness(water, e, x, y, n, by_offset), 0
    while shots < SHOTS and half > end and not (by_offset and best <= CLOSE_M):
        shots += 1
        best_i, best_j = 0, 0
        for i in range(-2, 3):
            for j in range(-2, 3):
                bad = _badness(water, e, x + 0.5 * half * i, y + 0.5 * half * j, n, by_offset)
                if bad < best:
                    best, best_i, best_j = bad, i, j
        x, y = x + 0.5 * half * best_i, y + 0.5 * half * best_j
        # the best knot is inside: halve the grid
        if max(abs(best_i), abs(best_j)) < 2:
            half *= 0.5
    return x, y, shots, best


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

"""Trace rays forward from the camera through any water surface.

The object point is the local origin. A ray is named by its aim: the place where it would cross the
level of the water above the point. It pierces the surface at A, bends there, and comes down to the
height of the point at the place (mx, my): its offset.

The surface is a plane, or the bilinear raster or the facets of `pcfix.water.surface`. Where there
is none, and where it faces away from the camera, all is NaN. Water that hides water behind it is
not looked for: the ray is taken to cross the surface once.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from pcfix.kernels import device
from pcfix.lens.algebra import Vector, cross, dot, minus, normal_of, scaled
from pcfix.model import FloatArray
from pcfix.refract.rays import plane_at, refracted
from pcfix.water.surface import Field, Tin, patch_at

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
def pierce(water: Water, e: Vector, d: Vector) -> tuple[float, float]:
    """Return the plan place where the ray from e along d pierces the surface.

    Newton's method on the tangent plane, from e + d on, inside the bracket in which the ray
    crosses the water. (`pcfix.refract.rays` starts below the surface, at a known point; here
    that point may lie beyond the edge of the water though the ray crosses it well within.)
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
def bent(water: Water, e: Vector, x: float, y: float, n: float) -> tuple[Vector, Vector]:
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
def miss_through(water: Water, e: Vector, x: float, y: float, n: float) -> tuple[float, float]:
    """Return the miss of the ray that pierces the surface at the plan place x, y."""
    a, t = bent(water, e, x, y, n)
    return x - t[0] * a[2] / t[2], y - t[1] * a[2] / t[2]


@device
def shoot(
    water: Water, level: float, e: Vector, x: float, y: float, n: float
) -> tuple[float, float, float, float]:
    """Return piercing place (x, y) and miss (x, y) of the ray aimed at x, y on a level."""
    ax, ay = pierce(water, e, minus((x, y, level), e))
    mx, my = miss_through(water, e, ax, ay, n)
    return ax, ay, mx, my


@device
def travel(water: Water, e: Vector, x: float, y: float, n: float) -> float:
    """Return optical length (m) of the path through a plan place; infinite where there is none."""
    z, b, c = height_of(water, x, y)
    a = x, y, z
    u = minus(e, a)
    # the surface faces away from the camera
    if not u[2] - b * u[0] - c * u[1] > 0.0:
        return np.inf
    air, wet = np.sqrt(dot(u, u)), np.sqrt(dot(a, a))
    return float(air + n * wet)


KOTOWSKI_STEPS = 40
HALVINGS = 24


@device
def kotowski(water: Water, level: float, e: Vector, n: float) -> Found:
    """Return where light from the origin leaves the water towards e, (x, y, steps, found).

    Kotowski 1987 is, after Mulsow 2024, the first universal model: the collinearity equations of
    the piercing point, of which every point is iterated. How is not told there; here it is by
    Newton's method from the straight line, with equations of our own.

    With the unit vectors u from the camera to A and v from A to the point, Snell's law says that u
    - n v stands upright on the surface, hence on its tangents (1, 0, b) and (0, 1, c):

        g = (u_x - n v_x + b (u_z - n v_z), u_y - n v_y + c (u_z - n v_z)) = 0

    g is also the gradient of the optical length by the place of A (Fermat). The third condition, A
    on the surface, is kept by taking z from it. A bilinear raster has the second derivative z_xy
    only; planes and facets have none.

    A step that makes g grow is halved until it is short; from one patch of a broken surface to the
    next g may grow on the right way. So is one beyond the edge of the water.
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

    The unit vectors turn with A by (I - u u') / \|A - C\| and -(I - v v') / \|A\|.
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

    Mulsow 2024 has the name alone; this is how it is read. The straight
    ray to an apparent point P, at the height of the object point, is traced forward through the
    water and comes out beside the object point; P is moved by as much the other way, the ray is
    traced again, and so on. It starts with P in the object point. On calm water, from a height H
    over a depth D, this alone would gain a factor of about (1 + H / D) / (1 - 1 / n) a step; from
    the second step on Broyden's secant makes use of what the last steps did. No derivative of the
    surface is needed, and one ray a step.

    After a step s = -B m the good Broyden update of the inverse B is
    B + t (s'B) / (s'(s - t)), with t = -B m of the new miss. A step is at most the depth or,
    where that is more, what the straight line goes sideways in the water.
    """
    f = level / e[2]
    px, py, sx, sy = 0.0, 0.0, 0.0, 0.0
    bxx, bxy, byx, byy = 1.0, 0.0, 0.0, 1.0
    x, y = f * e[0], f * e[1]
    longest = max(level, np.sqrt(x * x + y * y))
    for step in range(1, AFRT_STEPS + 1):
        # trace the ray aimed at P
        ax, ay, mx, my = shoot(water, level, e, px + f * (e[0] - px), py + f * (e[1] - py), n)
        if np.isnan(mx):
            return x, y, step, False
        x, y = ax, ay
        if mx * mx + my * my <= CLOSE_M * CLOSE_M:
            return x, y, step, True
        tx, ty = -bxx * mx - bxy * my, -byx * mx - byy * my
        if step > 1:
            # good Broyden update, 2 x 2
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
"""The least distance of the aims: below, rounding would outdo what is left out."""


@device
def _distance(
    water: Water, level: float, e: Vector, x: float, y: float, n: float
) -> tuple[float, float, Vector, Vector]:
    """Return piercing place (x, y), distance d and direction t of the ray aimed at x, y.

    d leads from the refracted ray at right angles to the object point P:

        d = P - A - (t.(P - A) / t.t) t

    Mulsow 2024 prints P_0 for the first P, and the last term with A - P but the same sign.
    """
    ax, ay = pierce(water, e, minus((x, y, level), e))
    a, t = bent(water, e, ax, ay, n)
    return ax, ay, minus(scaled(dot(t, a) / dot(t, t), t), a), t


@device
def mdfrt(water: Water, level: float, e: Vector, n: float) -> Found:
    """Return where light from the origin leaves the water towards e, (x, y, steps, found).

    Minimum distance forward ray tracing of Mulsow 2024: rays are traced forward, and the direction
    at the camera, that of the straight line at first, is changed until the distance d of the
    refracted ray from the object point is 0. How it is changed is not told there: here a ray and
    two beside it make d linear in the two coordinates of the aim, and of the three equations the
    two across the ray are solved. That is Newton's method with differences instead of derivatives:
    three rays a step, few steps.

    A step that makes the distance grow is halved until it is short; so is one beyond the edge of
    the water.
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

    Mulsow 2024 has the name alone ("brute force"); this is how it is read. Rays to the
    knots of a grid on the surface are followed to the object point; the grid is drawn together
    about the best one again and again. No start value, no derivative, no law of refraction even:
    the best one is that of the least optical length (Fermat). So where a broken surface sends light
    along several paths the quickest is taken, and a path may leave through a crease, which no
    refracted ray does. Near the end a length is too blunt (it changes with the square of the
    distance), so the refracted rays are looked at, and how near to the point they come.

    On calm water that is between the plan place of the point and the straight line; the first
    shot covers these and as much as the point is deep all around.
    """
    f = level / e[2]
    middle_x, middle_y = 0.5 * f * e[0], 0.5 * f * e[1]
    half = level + max(abs(middle_x), abs(middle_y))
    best, x, y = np.inf, middle_x, middle_y
    apart = 2.0 * half / (KNOTS - 1)
    for i in range(KNOTS):
        for j in range(KNOTS):
            knot_x, knot_y = middle_x - half + i * apart, middle_y - half + j * apart
            # Fermat: the shortest optical path
            length = travel(water, e, knot_x, knot_y, n)
            if length < best:
                best, x, y = length, knot_x, knot_y
    x, y, shots, found = narrowed(water, e, x, y, 2.0 * apart, n)
    return x, y, shots + 1, found


@device
def narrowed(water: Water, e: Vector, x: float, y: float, half: float, n: float) -> Found:
    """Return the nearest place of least optical length, from a place and half a grid's size on.

    Found is a path that hits the point, or one through a crease, known to about 1e-6 m along it:
    the shortest one although the rays beside it miss.
    """
    x, y, first, _ = _draw_together(water, e, x, y, half, BLUNT_M, n, False)
    px, py, second, miss = _draw_together(water, e, x, y, NEIGHBOUR_M, 0.1 * CLOSE_M, n, True)
    if miss <= CLOSE_M:
        return px, py, first + second, True
    # at an edge of the water the shortest path means nothing
    inside = True
    for i in (-1.0, 1.0):
        for j in (-1.0, 1.0):
            z = height_of(water, x + i * NEIGHBOUR_M, y + j * NEIGHBOUR_M)[0]
            inside = inside and not np.isnan(z)
    return x, y, first + second, inside


@device
def _draw_together(
    water: Water, e: Vector, x: float, y: float, half: float, end: float,
    n: float, by_miss: bool,
) -> tuple[float, float, int, float]:  # fmt: skip
    """Halve a grid of 5 x 5 about its best knot until it is small enough.

    While the best knot is on the rim the grid moves and keeps its size.
    """
    best, shots = _badness(water, e, x, y, n, by_miss), 0
    while shots < SHOTS and half > end and not (by_miss and best <= CLOSE_M):
        shots += 1
        best_i, best_j = 0, 0
        for i in range(-2, 3):
            for j in range(-2, 3):
                bad = _badness(water, e, x + 0.5 * half * i, y + 0.5 * half * j, n, by_miss)
                if bad < best:
                    best, best_i, best_j = bad, i, j
        x, y = x + 0.5 * half * best_i, y + 0.5 * half * best_j
        # the best knot is inside: halve the grid
        if max(abs(best_i), abs(best_j)) < 2:
            half *= 0.5
    return x, y, shots, best


@device
def _badness(water: Water, e: Vector, x: float, y: float, n: float, by_miss: bool) -> float:
    """Return the miss of a ray or the optical length of a path, metres; infinite without any."""
    if by_miss:
        mx, my = miss_through(water, e, x, y, n)
        return np.inf if np.isnan(mx) else float(np.sqrt(mx * mx + my * my))
    return travel(water, e, x, y, n)

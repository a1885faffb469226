"""Refraction at the port of a housing: from a point to its image, and from an image into the water.

Everything is in the camera frame, with the projection centre as the origin: metres, x right, y
down, z forward. Two questions are answered for each kind of port:

`through_port`: in which direction w does the light of a point in the water reach the projection
centre? The lens images the point where it images w. With derivatives by the point and by the
refractive index of the water, for the bundle adjustment.

`ray_through`: where does the ray of a direction in air leave the port, and in which direction?

The first solves an equation in one unknown, the second applies Snell's law at one face after the
other, so that each verifies the other.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from pcfix.kernels import device
from pcfix.lens.algebra import Vector, beyond, dot, minus, plus, scaled, unit
from pcfix.model import FloatArray
from pcfix.port.shapes import DomePort, FlatPort, Port

Ray: TypeAlias = tuple[float, float, float, float, float, float]
"""A place and a unit direction."""


@device
def bent(s: Vector, normal: Vector, r: float) -> Vector:
    """Return the unit direction behind a face: Snell's law in vector form.

    Skarlatos & Agrafiotis 2018, eq 10, with the normal along the light instead of against it:
    t = r s + (sqrt(1 - r^2 (1 - c^2)) - r c) N, c = N.s, with r the refractive index before the
    face over that behind it. NaN for total reflection.
    """
    c = dot(normal, s)
    k = np.sqrt(1.0 - r * r * (1.0 - c * c)) - r * c
    return plus(scaled(r, s), scaled(k, normal))


BY_PORT = 5
"""First column of the derivatives by the position of the port, of `through_port`."""

FLAT_STEPS = 60
FLAT_CLOSE = 1e-8
"""Relative length of the last step; as each squares the error, the next is below rounding."""


@device
def through_flat(
    normal: Vector, distance: float, thickness: float, glass: float, n: float,
    point: Vector, out: FloatArray,
) -> None:  # fmt: skip
    r"""Find the direction of a point behind a flat port, see `through_port`.

    Seen from the projection centre, with the unit normal N of the port towards the water, the light
    crosses layers of air, glass and water with the thicknesses d, T and D along N; D belongs to the
    point X. The part of X across N is s. As at the surface of a lake (`pcfix.refract.rays`) the
    direction at the projection centre is

        w = N + k s

    so that t = k \|s\| is the tangent of the incidence angle in air, and with Snell's law the
    sideways distances add up to \|s\|. With S(m) = sqrt(m^2 + (m^2 - 1) k^2 s.s):

        G(k) = k (d + T / S(g) + D / S(n)) - 1 = 0

    G rises and is concave, so that Newton's method started at k = 1 / (d + T / g + D / n), where G
    <= 0, converges to the only root from the left without a bracket. Nothing is divided by \|s\|.
    The derivatives are those of the implicit function, with grad D = N and grad s.s = 2 s.
    """
    along = dot(normal, point)
    aside = minus(point, scaled(along, normal))
    aside2 = dot(aside, aside)
    depth = along - distance - thickness
    k = _slope(distance, thickness, depth, aside2, glass, n)
    g2, n2, t2 = glass * glass, n * n, k * k * aside2
    cube_g, root_n = np.sqrt(g2 + (g2 - 1.0) * t2) ** 3, np.sqrt(n2 + (n2 - 1.0) * t2)
    cube_n = root_n * root_n * root_n
    below = 1.0 / (distance + thickness * g2 / cube_g + depth * n2 / cube_n)
    by_depth = -below * k / root_n
    by_aside = below * k * k * k * (thickness * (g2 - 1.0) / cube_g + depth * (n2 - 1.0) / cube_n)
    by_n = below * k * depth * n * (1.0 + t2) / cube_n
    for i in range(3):
        out[i, 0], out[i, 4] = normal[i] + k * aside[i], by_n * aside[i]
        for j in range(3):
            gradient = by_depth * normal[j] + by_aside * aside[j]
            across = (1.0 if i == j else 0.0) - normal[i] * normal[j]
            out[i, 1 + j] = k * across + aside[i] * gradient
        if out.shape[1] > BY_PORT:  # the farther the port, the less water: dG = k (1 - 1 / S(n))
            out[i, BY_PORT] = -below * k * (1.0 - 1.0 / root_n) * aside[i]


@device
def _slope(
    distance: float, thickness: float, depth: float, aside2: float, glass: float, n: float
) -> float:
    """Solve G for k; NaN for a point that is not in the water, or that no light reaches."""
    if not depth > 0.0:
        return np.nan
    g2, n2 = glass * glass, n * n
    a_g, a_n = (g2 - 1.0) * aside2, (n2 - 1.0) * aside2
    k = 1.0 / (distance + thickness / glass + depth / n)
    for _ in range(FLAT_STEPS):
        k2 = k * k
        root_g, root_n = np.sqrt(g2 + a_g * k2), np.sqrt(n2 + a_n * k2)
        miss = 1.0 - k * (distance + thickness / root_g + depth / root_n)
        step = miss / (distance + thickness * g2 / root_g**3 + depth * n2 / root_n**3)
        k += step
        if abs(step) <= FLAT_CLOSE * k:
            return k
    return np.nan


@device
def ray_through_flat(
    normal: Vector, distance: float, thickness: float, glass: float, n: float, direction: Vector
) -> Ray:
    """Return the ray behind a flat port, see `ray_through`."""
    s = unit(direction)
    steep = dot(normal, s)
    inside = bent(s, normal, 1.0 / glass)
    if not steep > 0.0:
        inside = (np.nan, np.nan, np.nan)
    f, h = distance / steep, thickness / dot(normal, inside)
    t = bent(inside, normal, glass / n)
    return plus(scaled(f, s), scaled(h, inside)) + t


DOME_STEPS = 100
DOME_CLOSE = 1e-9
"""Length of the last step of q relative to 1 / a; the next is below rounding."""
SERIES_UP_TO = 0.01
"""Above this the closed form of the derivative loses at most two digits."""


@device
def turn(y: float, u: float) -> tuple[float, float, float]:
    """Return asin(y sqrt(u)) / sqrt(u), a power series in u, and its derivatives by y and u."""
    z = y * y * u
    root = np.sqrt(1.0 - z)
    if z < SERIES_UP_TO:
        high = 35 / 1152 + z * (63 / 2816 + z * 231 / 13312)
        s = 1.0 + z * (1 / 6 + z * (3 / 40 + z * (5 / 112 + z * high)))
        high = 35 / 288 + z * (315 / 2816 + z * 693 / 6656)
        by_z = 1 / 6 + z * (3 / 20 + z * (15 / 112 + z * high))
    else:
        s = np.arcsin(np.sqrt(z)) / np.sqrt(z)
        by_z = 0.5 * (1.0 / root - s) / z
    return y * s, 1.0 / root, y * y * y * by_z


@device
def _miss(
    q: float, v: float, u: float, far: float, a: float, b: float, glass: float, n: float
) -> tuple[float, float, float, float, float, float, float]:
    """Return the difference of the two sides at q, and its derivatives by q, v, u, R, n and o.o.

    Those by v and u are for a constant o.o, which is v^2 + u.
    """
    cosine = np.sqrt(1.0 - q * q * u)
    cosine_q, cosine_u = -q * u / cosine, -0.5 * q * q / cosine
    length2 = a * a + v * v + u - 2.0 * a * (v * cosine + q * u)
    scale = a / np.sqrt(length2)
    lean = cosine - q * v
    p = scale * lean  # by |o across|
    half = a * p / length2
    p_q = scale * (cosine_q - v) + half * (v * cosine_q + u)
    p_u = scale * cosine_u + half * (v * cosine_u + q)
    p_v = -scale * q + half * cosine
    in_1, in_1p, in_1u = turn(p / (glass * a), u)
    in_2, in_2p, in_2u = turn(p / (glass * b), u)
    out_1, out_1p, out_1u = turn(p / (n * b), u)
    out_2, out_2p, out_2u = turn(p / (n * far), u)
    left, left_q, left_u = turn(q, u)
    total = left - (in_1 - in_2) - (out_1 - out_2)
    by_p = (in_1p / a - in_2p / b) / glass + (out_1p / b - out_2p / far) / n
    by_u = left_u - (in_1u - in_2u) - (out_1u - out_2u)
    by_far = -p * out_2p / (n * far * far)
    by_n = p * (out_1p / b - out_2p / far) / (n * n)
    by_o2 = 0.5 * by_p * p / length2
    return total, left_q - by_p * p_q, -by_p * p_v, by_u - by_p * p_u, by_far, by_n, by_o2


@device
def _place(v: float, u: float, far: float, a: float, b: float, glass: float, n: float) -> float:
    """Solve for q: Newton's method, with bisection if a step leaves the bracket."""
    # where the straight line from o to X meets the inner sphere
    run2 = (far - v) ** 2 + u
    part = v * v + u - v * far
    t = (part + np.sqrt(part * part + run2 * (a * a - v * v - u))) / run2
    low, high = 0.0, (1.0 - t) / a
    q = high
    for _ in range(DOME_STEPS):
        miss, slope = _miss(q, v, u, far, a, b, glass, n)[:2]
        if miss > 0.0:
            high = q
        else:
            low = q
        new = q - miss / slope
        if not low <= new <= high:
            new = 0.5 * (low + high)
        step, q = new - q, new
        if abs(step) * a <= DOME_CLOSE:
            break
    return q


@device
def through_dome(
    centre: Vector, a: float, thickness: float, glass: float, n: float,
    point: Vector, out: FloatArray,
) -> None:  # fmt: skip
    r"""Find the direction of a point behind a dome, see `through_port`.

    Seen from the centre of the dome, the projection centre lies at o, and the point X at the
    distance R in the unit direction e; the light between them stays in the plane of the two. It
    crosses the inner sphere, of radius a, at

        A = a (cos theta e + sin theta f),    f the unit vector across e, towards o

    and reaches the projection centre along w = A - o. In concentric shells the refractive index
    times the distance of the ray's line from the centre, p, is constant (Bouguer). So between two
    radii in a medium m the ray turns about the centre by asin(p / m r1) - asin(p / m r2), and

        theta = asin(p / g a) - asin(p / g b) + asin(p / n b) - asin(p / n R)

    with the outer radius b, the glass g and the water n. Between theta = 0, where the left side is
    smaller, and the straight line from X to the projection centre, where it is larger, the
    difference rises (for g and n of at least 1), so that there is exactly one root.

    So that a point in line with both centres is no special case, the unknown is q = sin(theta) /
    \|o across\|, with \|o across\|^2 = u and o.e = v, and both sides are divided by \|o across\|;
    asin(y sqrt(u)) / sqrt(u) is a power series in u. Then

        w = a (cos theta - q v) e + (a q - 1) o

    The derivatives are those of the implicit function, with grad R = e, grad v = (o - v e) / R and
    grad u = -2 v grad v.
    """
    b = a + thickness
    x = minus(point, centre)
    far = np.sqrt(dot(x, x))
    if not far > b:
        out[:] = np.nan
        return
    e, o = unit(x), scaled(-1.0, centre)
    v = dot(o, e)
    across = minus(o, scaled(v, e))
    u = dot(across, across)
    q = _place(v, u, far, a, b, glass, n)
    _, by_q, by_v, by_u, by_far, by_n, by_o2 = _miss(q, v, u, far, a, b, glass, n)
    cosine = np.sqrt(1.0 - q * q * u)
    lean = a * (cosine - q * v)
    q_n = -by_n / by_q
    lean_q = a * (-q * u / cosine - v)
    for i in range(3):
        out[i, 0] = lean * e[i] + (a * q - 1.0) * o[i]
        out[i, 4] = (lean_q * e[i] + a * o[i]) * q_n
    for j in range(3):
        v_j = across[j] / far
        u_j = -2.0 * v * v_j
        q_j = -(by_v * v_j + by_u * u_j + by_far * e[j]) / by_q
        lean_j = lean_q * q_j - a * q * (0.5 * q * u_j / cosine + v_j)
        for i in range(3):
            turned = (1.0 if i == j else 0.0) - e[i] * e[j]
            out[i, 1 + j] = e[i] * lean_j + lean * turned / far + a * o[i] * q_j
        if out.shape[1] <= BY_PORT:
            continue
        # if the centre moves, x and o move the other way; by o grad v = e, grad u = 2 across
        v_o, u_o = e[j], 2.0 * across[j]
        q_o = -(by_v * v_o + by_u * u_o + 2.0 * by_o2 * o[j]) / by_q
        lean_o = lean_q * q_o - a * q * (0.5 * q * u_o / cosine + v_o)
        for i in range(3):
            by_o = e[i] * lean_o + a * o[i] * q_o + (a * q - 1.0 if i == j else 0.0)
            out[i, BY_PORT + j] = -out[i, 1 + j] - by_o


@device
def ray_through_dome(
    centre: Vector, a: float, thickness: float, glass: float, n: float, direction: Vector
) -> Ray:
    """Return the ray behind a dome, see `ray_through`."""
    o, s = scaled(-1.0, centre), unit(direction)
    inner = _meet(o, s, a)
    inside = bent(s, unit(inner), 1.0 / glass)
    outer = _meet(inner, inside, a + thickness)
    t = bent(inside, unit(outer), glass / n)
    return plus(outer, centre) + t


@device
def _meet(start: Vector, s: Vector, radius: float) -> Vector:
    """Return where a ray that starts inside or on a sphere about the origin leaves it."""
    along = dot(start, s)
    f = -along + np.sqrt(along * along + max(radius * radius - dot(start, start), 0.0))
    return beyond(start, f, s)


KIND, X, Y, Z, SIZE, THICK, GLASS = range(7)
FLAT, DOME = 0.0, 1.0


def coefficients(port: Port) -> FloatArray:
    """Return a port as the flat array that the kernels take, shape (7,).

    Kind; x, y, z of the normal or of the centre; distance or radius; thickness; glass index.
    """
    match port:
        case FlatPort(distance, thickness, glass, normal):
            c = [FLAT, *normal, distance, thickness, glass]
        case DomePort(radius, thickness, glass, centre):
            c = [DOME, *centre, radius, thickness, glass]
    return np.array(c, np.float64)


@device
def through_port(port: FloatArray, n: float, x: float, y: float, z: float, out: FloatArray) -> None:
    """Find the direction in which the light of a point reaches the projection centre.

    Parameters
    ----------
    port : array, shape (7,)
        See `coefficients`.
    n : float
        Refractive index of the water relative to air, at least 1.
    x, y, z : float
        The point, in the water outside the port; camera frame, metres.
    out : array, shape (3, 5) or (3, 8)
        Column 0 gets the direction w, camera frame, of any length, columns 1 to 3 the derivatives
        of w by x, y, z, column 4 that by n. Of eight columns, 5 gets that by the distance of a flat
        port, or 5 to 7 those by the centre of a dome. NaN if the point is not outside the port, or
        no light comes from it.
    """
    where = port[X], port[Y], port[Z]
    size, thickness, glass = port[SIZE], port[THICK], port[GLASS]
    if port[KIND] == FLAT:
        through_flat(where, size, thickness, glass, n, (x, y, z), out)
    else:
        through_dome(where, size, thickness, glass, n, (x, y, z), out)


@device
def ray_through(port: FloatArray, n: float, dx: float, dy: float, dz: float) -> Ray:
    """Return where a ray from the projection centre leaves the port, and its unit direction.

    Its direction in air, (dx, dy, dz), has any length; the rest is as for `through_port`. NaN if it
    misses the port.
    """
    where = port[X], port[Y], port[Z]
    size, thickness, glass = port[SIZE], port[THICK], port[GLASS]
    if port[KIND] == FLAT:
        return ray_through_flat(where, size, thickness, glass, n, (dx, dy, dz))
    return ray_through_dome(where, size, thickness, glass, n, (dx, dy, dz))


@device
def cosine_at_port(port: FloatArray, dx: float, dy: float, dz: float) -> float:
    """Return the cosine of the incidence angle in air at the inner face; see `ray_through`."""
    where, s = (port[X], port[Y], port[Z]), unit((dx, dy, dz))
    if port[KIND] == FLAT:
        return dot(where, s)
    return dot(s, unit(_meet(scaled(-1.0, where), s, port[SIZE])))

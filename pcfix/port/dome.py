r"""A dome: two spheres about one centre, which need not be the projection centre.

Picture it from the centre of the dome. The projection centre lies at o, the point X at the
distance R in the unit direction e; light between them stays in the plane of the two. It crosses
the inner sphere, of radius a, at

    A = a (cos theta e + sin theta f),    f the unit vector across e, towards o

and comes to the projection centre along w = A - o. In shells the product of refractive index and
distance from the centre at which the ray's line passes, p, is the same in each (Bouguer). So
between two radii in a medium m the ray turns about the centre by asin(p / m r1) - asin(p / m r2),
and

    theta = asin(p / g a) - asin(p / g b) + asin(p / n b) - asin(p / n R)

with the outer radius b, the glass g and the water n. Of theta between 0, where the left side is
the smaller one, and the straight line from X to the projection centre, where it is the larger one
as glass and water turn a ray less than air does, exactly one solves it: the difference rises all
the way (for g and n of at least 1).

So that a point, centre and camera in one line are no special case, the unknown is
q = sin(theta) / \|o across\|, with \|o across\|^2 = u and o.e = v, and both sides are divided by
\|o across\|; asin(y sqrt(u)) / sqrt(u) is a power series in u. Then

    w = a (cos theta - q v) e + (a q - 1) o
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.port.faces import bent, dot, unit

if TYPE_CHECKING:
    from pcfix.model import FloatArray
    from pcfix.port.faces import Ray, Vector

STEPS = 100
CLOSE = 1e-9
"""Of a step of q, relative to 1 / a; as each step squares the error, the next would be below
rounding."""
SERIES_UP_TO = 0.01
"""Beyond, the closed form of the derivative loses two digits at most."""


@njit(cache=True, error_model="numpy", nogil=True)
def turn(y: float, u: float) -> tuple[float, float, float]:
    """Return asin(y sqrt(u)) / sqrt(u), which is a series in u, and its derivatives by y and u."""
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


@njit(cache=True, error_model="numpy", nogil=True)
def _miss(
    q: float, v: float, u: float, far: float, a: float, b: float, glass: float, n: float
) -> tuple[float, float, float, float, float, float]:
    """Return by how much the two sides differ at q, and its derivatives by q, v, u, R and n."""
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
    return total, left_q - by_p * p_q, -by_p * p_v, by_u - by_p * p_u, by_far, by_n


@njit(cache=True, error_model="numpy", nogil=True)
def _place(v: float, u: float, far: float, a: float, b: float, glass: float, n: float) -> float:
    """Solve for q: Newton's method, and halving where it would leave the bracket."""
    # where the straight line from o to X meets the inner sphere
    run2 = (far - v) ** 2 + u
    part = v * v + u - v * far
    t = (part + np.sqrt(part * part + run2 * (a * a - v * v - u))) / run2
    low, high = 0.0, (1.0 - t) / a
    q = high
    for _ in range(STEPS):
        miss, slope = _miss(q, v, u, far, a, b, glass, n)[:2]
        if miss > 0.0:
            high = q
        else:
            low = q
        new = q - miss / slope
        if not low <= new <= high:
            new = 0.5 * (low + high)
        step, q = new - q, new
        if abs(step) * a <= CLOSE:
            break
    return q


@njit(cache=True, error_model="numpy", nogil=True)
def through_dome(
    centre: Vector, a: float, thickness: float, glass: float, n: float,
    point: Vector, out: FloatArray,
) -> None:  # fmt: skip
    """Find the direction of a point behind a dome, as `pcfix.port.light.through_port`.

    Implicitly, with grad R = e, grad v = (o - v e) / R and grad u = -2 v grad v.
    """
    b = a + thickness
    x = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    far = np.sqrt(dot(x, x))
    if not far > b:
        out[:] = np.nan
        return
    e = unit(x)
    o = -centre[0], -centre[1], -centre[2]
    v = dot(o, e)
    across = o[0] - v * e[0], o[1] - v * e[1], o[2] - v * e[2]
    u = dot(across, across)
    q = _place(v, u, far, a, b, glass, n)
    _, by_q, by_v, by_u, by_far, by_n = _miss(q, v, u, far, a, b, glass, n)
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


@njit(cache=True, error_model="numpy", nogil=True)
def ray_through_dome(
    centre: Vector, a: float, thickness: float, glass: float, n: float, direction: Vector
) -> Ray:
    """Return the ray behind a dome, as `pcfix.port.light.ray_through`."""
    o = -centre[0], -centre[1], -centre[2]
    s = unit(direction)
    inner = _meet(o, s, a)
    inside = bent(s, unit(inner), 1.0 / glass)
    outer = _meet(inner, inside, a + thickness)
    t = bent(inside, unit(outer), glass / n)
    return (
        outer[0] + centre[0], outer[1] + centre[1], outer[2] + centre[2], t[0], t[1], t[2],
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _meet(start: Vector, s: Vector, radius: float) -> Vector:
    """Return where a ray that starts inside a sphere about the origin, or on it, leaves it."""
    along = dot(start, s)
    f = -along + np.sqrt(along * along + max(radius * radius - dot(start, start), 0.0))
    return start[0] + f * s[0], start[1] + f * s[1], start[2] + f * s[2]


@njit(cache=True, error_model="numpy", nogil=True)
def cosine_at_dome(centre: Vector, a: float, direction: Vector) -> float:
    """Return the cosine of the angle at which a ray from the projection centre meets a dome."""
    o = -centre[0], -centre[1], -centre[2]
    s = unit(direction)
    return dot(s, unit(_meet(o, s, a)))

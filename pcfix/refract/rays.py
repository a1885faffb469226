r"""Refract rays at the water surface, forwards and backwards.

The line from the camera C to the apparent point P meets the water surface at A and is refracted
there; the true point lies on the refracted ray that leaves A. Two or more such rays determine it.

Everything is relative to P, the local origin: e = C - P points up to the camera, and A and the
solution are small vectors, so that nothing is lost at large coordinates. Directions have the length
L = \|e\| instead of 1, which saves two square roots per ray.

The functions contain arithmetic only, without reordering of sums (``fastmath`` is off), so that
results do not depend on tiles, chunks or threads to the bit.

**Piercing a mesh or raster.** The line is intersected with the plane above the point, then with the
plane of the surface there, and so on. Water is nearly flat, so that one to three steps are enough.
Beyond the edge of the surface, and over its gaps, the last plane is continued.

**Backwards, from a true point to a camera.** The point Q lies at the depth D below a plane with the
unit normal N, and the camera C at the height H above it. From the foot of C the point is at the
sideways vector s. In air the light comes from the direction

    w = -N + k s

scaled so that its part along the normal is one: w is t = k \|s\| sideways for each metre down, t
the tangent of the angle of incidence. With Snell's law the sideways distances in air and water add
up to \|s\|:

    H t + D t / sqrt(n^2 + (n^2 - 1) t^2) = \|s\|

or, divided by \|s\|, with S = sqrt(n^2 + (n^2 - 1) k^2 s.s)

    G(k) = k (H + D / S) - 1 = 0

G rises and bends down, so that Newton's method from k = 1 / (H + D / n), where G <= 0, converges to
the only root from the left and needs no bracket. Nothing is divided by \|s\|: straight below the
camera is no special case. The light of a point above the plane goes straight, k = 1 / (H + D); the
two agree at D = 0.

On a mesh or raster the plane N.x = h is the tangent plane where the light leaves the water, found
by iteration.
"""

from typing import TypeAlias

import numpy as np

from pcfix.kernels import device
from pcfix.lens.algebra import Nine, Vector, beyond, dot, minus, normal_of, scaled, solved, vector
from pcfix.model import FloatArray
from pcfix.water.surface import Field, Tin, field_of, surface_at


@device(forceinline=True)
def refracted(e: Vector, length2: float, normal: Vector, height: float, r: float) -> Vector:
    """Return the refracted ray's direction (downward), with the length L of e.

    Snell's law in vector form, Skarlatos & Agrafiotis 2018, eq 10, multiplied by L: with the
    unit ray s = -e/L, c = -N.s = H/L, H = N.e (`height`) and r = 1 / n,

        L t = r L s + (r L c - sqrt(L^2 - r^2 (L^2 - L^2 c^2))) N
            = -r e + (r H - sqrt(L^2 - r^2 (L^2 - H^2))) N
    """
    # L t = -r e + k N
    k = r * height - np.sqrt(length2 - r * r * (length2 - height * height))
    return minus(scaled(k, normal), scaled(r, e))


@device(forceinline=True)
def line_terms(a: Vector, d: Vector, inv_length2: float) -> Nine:
    """Return what one line adds to the normal equations of the nearest point.

    The line runs through A along t = d / L. Its squared distance from Q is Q'MQ - 2 b'Q + s
    with M = I - t t', b = M A and s = A'M A (Skarlatos & Agrafiotis 2018, eq 11, for any
    number of rays). Returned are xx, xy, xz, yy and yz of t t' (its diagonal sums to 1, so that zz
    is not needed), b (metres) and s (metres squared).
    """
    # d has the length L, so that t t' = d d' / L^2
    t, along = scaled(inv_length2, d), dot(d, a)
    bx, by, bz = minus(a, scaled(along, t))
    # A'M A: squared distance of the line from the origin
    s = dot(a, a) - along * along * inv_length2
    return d[0] * t[0], d[0] * t[1], d[0] * t[2], d[1] * t[1], d[1] * t[2], bx, by, bz, s


# Least determinant of M / k. Two rays at an angle alpha have alpha^2 / 4: 1e-6 is a tenth of a
# degree, far below any usable base, and keeps rounding below 1e-9 m.
MIN_DETERMINANT = 1e-6


@device
def nearest_point(k: float, sums: Nine) -> tuple[bool, Vector, float]:
    """Solve M Q = b for the point nearest to k lines, all with equal weight.

    The `sums` are those of `line_terms`. Returns whether it is solved (else the lines are nearly
    parallel, and the rest is meaningless); Q relative to the apparent point; and its root mean
    square distance from the lines. Metres.
    """
    m00, m11 = k - sums[0], k - sums[3]
    # M = k I - sum t t', with the last diagonal element from the trace
    det, q = solved((m00, -sums[1], -sums[2], m11, -sums[4], 2.0 * k - m00 - m11), sums[5:8])
    # the sum of squared distances at the minimum
    rest = max(sums[8] - dot(sums[5:8], q), 0.0)
    return det >= MIN_DETERMINANT * k * k * k, q, np.sqrt(rest / k)


@device
def ray_distance(k: float, s: Nine, q: Vector) -> float:
    """Return the rms distance of Q from the lines of the sums, Q'MQ - 2 b'Q + s over k."""
    # t t' summed over the rays, with zz from the trace
    x, y, z = q
    along = s[0] * x * x + s[3] * y * y + (k - s[0] - s[3]) * z * z
    along += 2.0 * (s[1] * x * y + s[2] * x * z + s[4] * y * z)
    rest = k * (x * x + y * y + z * z) - along
    rest += s[8] - 2.0 * (s[5] * x + s[6] * y + s[7] * z)
    return np.sqrt(max(rest, 0.0) / k)


PIERCING_STEPS = 64
CLOSE_M = 1e-9  # along the vertical: a thousandth of any use, above the rounding of heights (1e-12)


@device
def pierce(
    c: int, tin: Tin | None, fields: Field | None, p: Vector, e: Vector, h: float, normal: Vector
) -> tuple[float, Vector]:
    """Return the fraction f of e from P to the surface, and the unit normal there.

    P (world frame) lies under the mesh, or under the raster of camera c, or under a plane where
    both are None; e leads to the projection centre. h is the distance of P from the tangent plane
    above it, and `normal` that plane's normal. The piercing point is P + f e.
    """
    low, high, f = 0.0, 1.0, h / dot(normal, e)
    if tin is None and fields is None:
        return f, normal
    for _ in range(PIERCING_STEPS):
        z, by_x, by_y = plane_at(tin, field_of(fields, c), f * e[0], f * e[1], p)
        # positive while the line is below the surface; NaN where there is none
        gap = z - f * e[2]
        if np.isnan(gap):
            break
        normal = normal_of(by_x, by_y)
        if abs(gap) <= CLOSE_M:
            break
        if gap > 0.0:
            low = f
        else:
            high = f
        # Newton's step on the tangent plane; else bisect
        f += gap / (e[2] - by_x * e[0] - by_y * e[1])
        if not low < f < high:
            f = 0.5 * (low + high)
    return f, normal


Path: TypeAlias = tuple[float, float, float, float, Vector]  # k, S, H, D and s

NEWTON_STEPS = 40
CLOSE = 1e-8  # relative step of k: each step squares the error, so that the next is below rounding


@device
def light_path(q: Vector, e: Vector, normal: Vector, h: float, n: float) -> Path:
    """Return the light path from Q to a camera through a plane.

    Q and the projection centre e are relative to the apparent point, metres; the plane is given by
    its unit normal, upward, and its height h over the apparent point along it; n is the refractive
    index. k is NaN if the camera is not above the plane and the point.
    """
    height = dot(normal, e) - h
    depth = h - dot(normal, q)
    # H + D, and the sideways vector s from the foot of C to Q
    all_down = height + depth
    s = beyond(minus(q, e), all_down, normal)
    if not (height > 0.0 and all_down > 0.0):
        return np.nan, 1.0, height, depth, s
    if depth <= 0.0:  # above the water: straight
        return 1.0 / all_down, 1.0, height, depth, s
    n2 = n * n
    # S^2 = n^2 + (n^2 - 1) k^2 s.s
    a = (n2 - 1.0) * dot(s, s)
    k, root = 1.0 / (height + depth / n), n
    for _ in range(NEWTON_STEPS):
        root = np.sqrt(n2 + a * k * k)
        rest = 1.0 - k * (height + depth / root)
        # -G / G_k, with G_k = H + D n^2 / S^3
        step = rest / (height + depth * n2 / (root * root * root))
        k += step
        if abs(step) <= CLOSE * k:
            break
    return k, root, height, depth, s


@device(inline="always")
def light_near(
    q: Vector, e: Vector, normal: Vector, h: float, n: float
) -> tuple[float, float, float, float, Vector]:
    """Return k, S, the depth of Q, n^2 (1 above the water), and s, as `light_path` for a near Q.

    The light of the apparent point has the tangent of the incidence angle as a start, from which
    Newton's method needs two steps: without a condition to end, loops over it are vectorised. The
    projection centre must be above the plane.
    """
    # H + h, and D; the sideways vector s as in `light_path`
    across, depth = dot(normal, e), h - dot(normal, q)
    height = across - h
    s = beyond(minus(q, e), height + depth, normal)
    m2 = n * n if depth > 0.0 else 1.0
    a = (m2 - 1.0) * dot(s, s)
    # tan^2 of the incidence angle of the apparent point gives the first S and k
    root = np.sqrt(m2 + (m2 - 1.0) * (dot(e, e) / (across * across) - 1.0))
    k = 1.0 / (height + depth / root)
    # two Newton steps
    root = np.sqrt(m2 + a * k * k)
    k += (1.0 - k * (height + depth / root)) / (height + depth * m2 / (root * root * root))
    root = np.sqrt(m2 + a * k * k)
    k += (1.0 - k * (height + depth / root)) / (height + depth * m2 / (root * root * root))
    return k, root, depth, m2, s


@device
def direction(path: Path, normal: Vector) -> Vector:
    """Return w = k s - N, from the camera to where the light leaves the water."""
    return minus(scaled(path[0], path[4]), normal)


COLUMNS = 12
# First columns of `light_and_gradients`.
DIRECTION, BY_POINT, BY_CENTRE, BY_LEVEL, BY_SLOPES, BY_INDEX = 0, 1, 4, 7, 8, 10


@device
def light_and_gradients(
    q: Vector, e: Vector, normal: Vector, h: float, n: float, out: FloatArray
) -> None:
    r"""Fill in the direction w of the light from Q to a camera, and its derivatives.

    `q` and `e`, the projection centre, are relative to the local origin, as is the plane N.x = h.
    `out`, shape (3, 12), has w and its derivatives by Q, the projection centre, the plane's level a
    and slopes b and c (z = a + b x + c y about the local origin) and n; the last column is zero.
    All is NaN where `light_path` finds no path.

    By the implicit function theorem any change of Q, C, plane or index moves the root k of G by

        dk = -(k dH + k / S dD - D k^3 (n^2 - 1) / (2 S^3) d(s.s) - k D n (1 + k^2 s.s) / S^3 dn)
             / G_k,    G_k = H + D n^2 / S^3

    and w by dw = -dN + k ds + s dk. For the plane, with u = N_z,

        N = u (-b, -c, 1),  h = u a:    dN / db = -u (e_x - N_x N),    dh / db = u N_x h

    and H and D change with b by -u and u times the x of the feet of C and Q on the plane; with c
    likewise by y.
    """
    k, root, height, depth, s = light_path(q, e, normal, h, n)
    if np.isnan(k):
        out[:] = np.nan
        return
    # light of a point above the plane does not depend on n
    m = n if depth > 0.0 else 1.0
    cube = root * root * root
    # 1 / G_k
    below = 1.0 / (height + depth * m * m / cube)
    along, aside = below * k / root, below * depth * k * k * k * (m * m - 1.0) / cube
    by_n = 0.0
    if depth > 0.0:
        by_n = below * k * depth * n * (1.0 + k * k * dot(s, s)) / cube
    # dk / dQ = along N + aside s and dk / dC = -(below k N + aside s)
    for i in range(3):
        out[i, DIRECTION] = k * s[i] - normal[i]
        for j in range(3):
            flat = (k if i == j else 0.0) - k * normal[i] * normal[j]
            aside_j = aside * s[j]
            out[i, BY_POINT + j] = flat + s[i] * (along * normal[j] + aside_j)
            out[i, BY_CENTRE + j] = -flat - s[i] * (below * k * normal[j] + aside_j)
    all_down, up = height + depth, normal[2]
    for j in range(2):
        dk = (
            up * below * k * (e[j] - normal[j] * height)
            - up * along * (q[j] + normal[j] * depth)
            - up * aside * all_down * s[j]
        )
        # dw = u (1 - k (H + D)) (e_j - N_j N) + k u s_j N + s dk
        rest = 1.0 - k * all_down
        for i in range(3):
            flat = (1.0 if i == j else 0.0) - normal[i] * normal[j]
            out[i, BY_SLOPES + j] = up * (rest * flat + k * s[j] * normal[i]) + s[i] * dk
    by_level = up * (below * k - along)
    for i in range(3):
        out[i, BY_LEVEL], out[i, BY_INDEX], out[i, 11] = s[i] * by_level, s[i] * by_n, 0.0


SETTLING_STEPS = 12
HALVINGS = 36  # most steps to the plane where the light leaves a mesh or raster, and on a crease


@device
def plane_at(
    tin: Tin | None, field: Field | None, x: float, y: float, origin: FloatArray | Vector
) -> tuple[float, float, float]:
    """Return height, dz/dx and dz/dy of the water at a place; NaN where there is none.

    Relative to the apparent point `origin` (world frame, lowered if the water stood higher).
    """
    z, b, c = surface_at(tin, field, origin[0] + x, origin[1] + y)
    return z - origin[2], b, c


@device
def settle(
    plane: FloatArray, tin: Tin | None, field: Field | None, origin: FloatArray,
    q: Vector, e: Vector, n: float,
) -> None:  # fmt: skip
    """Move the plane of a ray, (N, h), to where the light from Q leaves a mesh or raster.

    If the path through either side of a crease leads to the other side, the light leaves on the
    crease: the plane gets a slope between the two, where the path is shortest (Fermat) and changes
    without a jump. Beyond the edge, and over gaps, the last plane is continued.
    """
    # slopes of the plane (N, h)
    b, c = -plane[0] / plane[2], -plane[1] / plane[2]
    before = b, c
    for _ in range(SETTLING_STEPS):
        (x, y, z_plane), depth = _exit_point(plane, q, e, n)
        z, b_there, c_there = plane_at(tin, field, x, y, origin)
        # the path changes by the height, and by the slope times the depth
        change = abs(z - z_plane) + abs(depth) * (abs(b_there - b) + abs(c_there - c))
        if not change > CLOSE_M:
            return
        lay(plane, x, y, z, b_there, c_there)
        # keep both slopes: on a crease the steps alternate
        before, b, c = (b, c), b_there, c_there
    _settle_on_crease(plane, tin, field, origin, before, (b, c), q, e, n)


@device
def _settle_on_crease(
    plane: FloatArray, tin: Tin | None, field: Field | None, origin: FloatArray,
    one: tuple[float, float], other: tuple[float, float], q: Vector, e: Vector, n: float,
) -> None:  # fmt: skip
    """Bisect the share of the second slope until the light leaves on the crease itself.

    The first slope leads to the side that has the second, and vice versa; both are updated as the
    crease comes nearer.
    """
    (b1, c1), (b2, c2), low, high = one, other, 0.0, 1.0
    for _ in range(HALVINGS):
        (x, y, _), _ = _exit_point(plane, q, e, n)
        z, b, c = plane_at(tin, field, x, y, origin)
        if np.isnan(z):
            return
        # a slope between the two sides
        share = 0.5 * (low + high)
        lay(plane, x, y, z, b1 + share * (b2 - b1), c1 + share * (c2 - c1))
        (x, y, _), _ = _exit_point(plane, q, e, n)
        _, b, c = plane_at(tin, field, x, y, origin)
        # on which side does the light leave now?
        if (b - b1) ** 2 + (c - c1) ** 2 > (b - b2) ** 2 + (c - c2) ** 2:
            low, b2, c2 = share, b, c
        else:
            high, b1, c1 = share, b, c


@device
def _exit_point(plane: FloatArray, q: Vector, e: Vector, n: float) -> tuple[Vector, float]:
    """Return where light from Q leaves the water through a plane, and the depth of Q below it."""
    normal = vector(plane)
    path = light_path(q, e, normal, plane[3], n)
    return beyond(e, path[2], direction(path, normal)), path[3]


@device
def lay(plane: FloatArray, x: float, y: float, z: float, b: float, c: float) -> None:
    """Lay the plane (N, h) with the slopes b, c through a place."""
    plane[0], plane[1], plane[2] = normal_of(b, c)
    plane[3] = plane[2] * (z - b * x - c * y)

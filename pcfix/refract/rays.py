r"""One ray at the water surface, forwards and backwards.

Picture a camera C looking down at the apparent point P. The line from C to P meets the water
surface at A and there bends towards the vertical; the true point lies somewhere on the bent ray
that leaves A. Two or more such rays fix it.

Everything is relative to P, which is the local origin: e = C - P points up to the camera, and
A and the solution are small vectors, so nothing is lost at large coordinates. Directions keep
the length L = \|e\| instead of being made unit vectors; that saves two square roots a ray, and
the kernels live from that.

The functions hold arithmetic only: scalars in, scalars out, no reordering of sums
(``fastmath`` stays off), so that the bits do not depend on tiles, chunks or threads.

**Piercing a mesh or raster.** Starting from the plane above the point, meet it; take the plane of
the surface there, meet that one, and so on. Water is nearly flat, so this is over in one to three
steps.

On a mesh the planes are the facets'; on a crease between two, where it would go to and fro, the
last of `PIERCING_STEPS` stands. On a raster they are the tangent planes of the bilinear surface;
each step keeps to the bracket in which the line passes the surface, and halves it where a tangent
plane leads out of it, until the line is within `CLOSE_M` of the surface. Beyond the edge of either,
and over its gaps, the last plane goes on.

**Backwards, from a true point to a camera.** Picture a point Q below a plane with the unit normal
N, and a camera C at the height H above it. Seen from the foot of C the point lies at the sideways
vector s, at the depth D. In air the light comes from the direction

    w = -N + k s

scaled so that its part along the normal is one: w is t = k \|s\| sideways for each metre down, t
the tangent of the angle of incidence. With Snell's law the sideways distances in air and water add
up to \|s\|:

    H t + D t / sqrt(n^2 + (n^2 - 1) t^2) = \|s\|

or, divided by \|s\|, with S = sqrt(n^2 + (n^2 - 1) k^2 s.s)

    G(k) = k (H + D / S) - 1 = 0

G rises and bends down, so that Newton's method started at k = 1 / (H + D / n), where G <= 0, comes
to the only root from the left and needs no bracket. Nothing is divided by \|s\|: straight below
the camera is no special case. A point above the plane sends its light straight, k = 1 / (H + D);
the two meet at D = 0.

On a mesh or raster the plane is the tangent plane where the light leaves the water, found by
going there, taking the plane there, and so on.

The plane is N.x = h.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numba import njit

from pcfix.model import FloatArray
from pcfix.water.surface import Field, Tin, height_at, locate


@njit(cache=True, error_model="numpy", nogil=True)
def refracted(
    ex: float, ey: float, ez: float, length2: float,
    nx: float, ny: float, nz: float, height: float, r: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the refracted ray's direction (downward), with the length L of e.

    Snell's law in vector form, Skarlatos & Agrafiotis 2018, eq 10, multiplied by L: with the
    unit ray s = -e/L and c = -N.s = H/L,

        L t = r L s + (r L c - sqrt(L^2 - r^2 (L^2 - L^2 c^2))) N
            = -r e + (r H - sqrt(L^2 - r^2 (L^2 - H^2))) N

    Parameters
    ----------
    ex, ey, ez : float
        From the apparent point to the projection centre, metres.
    length2 : float
        L^2 = e.e
    nx, ny, nz : float
        Unit normal N of the surface, upward.
    height : float
        H = N.e
    r : float
        1 / n
    """
    k = r * height - np.sqrt(length2 - r * r * (length2 - height * height))
    return k * nx - r * ex, k * ny - r * ey, k * nz - r * ez


@njit(cache=True, error_model="numpy", nogil=True)
def line_terms(
    ax: float, ay: float, az: float, dx: float, dy: float, dz: float, inv_length2: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return what one line adds to the normal equations of the nearest point.

    The line runs through A along t = d / L. Its squared distance from Q is Q'MQ - 2 b'Q + s
    with M = I - t t', b = M A and s = A'M A (Skarlatos & Agrafiotis 2018, eq 11, for any
    number of rays). The diagonal of t t' sums to 1, so that zz need not be returned.

    Returns
    -------
    xx, xy, xz, yy, yz : float
        Elements of t t'.
    bx, by, bz, s : float
        b (metres) and s (metres squared).
    """
    tx, ty, tz = inv_length2 * dx, inv_length2 * dy, inv_length2 * dz
    along = dx * ax + dy * ay + dz * az
    return (
        dx * tx, dx * ty, dx * tz, dy * ty, dy * tz,
        ax - along * tx, ay - along * ty, az - along * tz,
        ax * ax + ay * ay + az * az - along * along * inv_length2,
    )  # fmt: skip


MIN_DETERMINANT = 1e-6
"""Of M / k. Two rays at an angle of alpha give alpha^2 / 4: 1e-6 is a tenth of a degree, far
below any usable base, and keeps rounding below 1e-9 m."""


@njit(cache=True, error_model="numpy", nogil=True)
def nearest_point(
    k: float, xx: float, xy: float, xz: float, yy: float, yz: float,
    bx: float, by: float, bz: float, s: float,
) -> tuple[bool, float, float, float, float, float]:  # fmt: skip
    """Solve M Q = b for the point nearest to k lines, all with equal weight.

    Returns
    -------
    solved : bool
        False when the lines are too nearly parallel; then the rest is meaningless.
    qx, qy, qz : float
        Q relative to the apparent point, metres.
    miss : float
        Root mean square distance of Q from the lines, metres.
    sigma_z : float
        Standard error of Q_z from the scatter of the lines, metres: the a-posteriori variance
        s_min / (2k - 3) times (M^-1)_zz.
    """
    m00, m11 = k - xx, k - yy
    m22 = 2.0 * k - m00 - m11
    m01, m02, m12 = -xy, -xz, -yz
    c00, c01, c02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
    c11, c12, c22 = m00 * m22 - m02 * m02, m01 * m02 - m00 * m12, m00 * m11 - m01 * m01
    det = m00 * c00 + m01 * c01 + m02 * c02
    qx = (c00 * bx + c01 * by + c02 * bz) / det
    qy = (c01 * bx + c11 * by + c12 * bz) / det
    qz = (c02 * bx + c12 * by + c22 * bz) / det
    rest = max(s - (bx * qx + by * qy + bz * qz), 0.0)
    sigma_z = np.sqrt(rest / (2.0 * k - 3.0) * c22 / det)
    return det >= MIN_DETERMINANT * k * k * k, qx, qy, qz, np.sqrt(rest / k), sigma_z


PIERCING_STEPS = 16
MAX_HALVINGS = 64
CLOSE_M = 1e-9
"""Along the vertical: a thousand times finer than any use, and no finer than a height in doubles
allows (1e-12 m at 5000 m)."""


@njit(cache=True, error_model="numpy", nogil=True)
def pierce_mesh(
    tin: Tin, px: float, py: float, pz: float, ex: float, ey: float, ez: float, facet: int
) -> tuple[float, float, float, float]:
    """Return the fraction of e from P to the surface, and the unit normal there.

    Parameters
    ----------
    tin : Tin
    px, py, pz : float
        Apparent point, world frame.
    ex, ey, ez : float
        From it to the projection centre.
    facet : int
        The facet above the point.

    Returns
    -------
    f, nx, ny, nz : float
        The piercing point is P + f e.
    """
    f, nx, ny, nz = 0.0, 0.0, 0.0, 1.0
    for _ in range(PIERCING_STEPS):
        a, b, c = tin.planes[facet, 0], tin.planes[facet, 1], tin.planes[facet, 2]
        above = a + b * (px - tin.origin_x) + c * (py - tin.origin_y) - pz
        f = above / (ez - b * ex - c * ey)
        nz = 1.0 / np.sqrt(1.0 + b * b + c * c)
        nx, ny = -b * nz, -c * nz
        following = locate(tin, px + f * ex, py + f * ey)
        if following == facet or following < 0:
            break
        facet = following
    return f, nx, ny, nz


@njit(cache=True, error_model="numpy", nogil=True)
def pierce_raster(
    field: Field, px: float, py: float, pz: float, ex: float, ey: float, ez: float,
    h: float, nx: float, ny: float, nz: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Return the fraction of e from P to the surface, and the unit normal there.

    Parameters
    ----------
    field : Field
    px, py, pz : float
        Apparent point, world frame.
    ex, ey, ez : float
        From it to the projection centre.
    h, nx, ny, nz : float
        Distance of the point from the tangent plane above it, and that plane's normal.

    Returns
    -------
    f, nx, ny, nz : float
        The piercing point is P + f e.
    """
    low, high = 0.0, 1.0
    f = h / (nx * ex + ny * ey + nz * ez)
    for _ in range(MAX_HALVINGS):
        z, b, c = height_at(field, px + f * ex, py + f * ey)
        gap = z - (pz + f * ez)
        if np.isnan(gap):
            break
        nz = 1.0 / np.sqrt(1.0 + b * b + c * c)
        nx, ny = -b * nz, -c * nz
        if abs(gap) <= CLOSE_M:
            break
        if gap > 0.0:
            low = f
        else:
            high = f
        f += gap / (ez - b * ex - c * ey)
        if not low < f < high:
            f = 0.5 * (low + high)
    return f, nx, ny, nz


Path: TypeAlias = tuple[float, float, float, float, float, float, float]
"""k, S, H, D and s."""

NEWTON_STEPS = 40
CLOSE = 1e-8
"""Of a step of k, relative; as each step squares the error, the next would be below rounding."""


@njit(cache=True, error_model="numpy", nogil=True)
def light_path(
    qx: float, qy: float, qz: float, ex: float, ey: float, ez: float,
    nx: float, ny: float, nz: float, h: float, n: float,
) -> Path:  # fmt: skip
    """Return how light goes from Q to a camera through a plane.

    Parameters
    ----------
    qx, qy, qz : float
        Q relative to the apparent point, metres.
    ex, ey, ez : float
        From the apparent point to the projection centre, metres.
    nx, ny, nz, h : float
        The plane: unit normal, upward, and height over the apparent point along it, metres.
    n : float
        Refractive index.

    Returns
    -------
    Path
        k NaN where the camera is not above the plane and the point.
    """
    height = nx * ex + ny * ey + nz * ez - h
    depth = h - (nx * qx + ny * qy + nz * qz)
    all_down = height + depth
    sx, sy, sz = qx - ex + all_down * nx, qy - ey + all_down * ny, qz - ez + all_down * nz
    if not (height > 0.0 and all_down > 0.0):
        return np.nan, 1.0, height, depth, sx, sy, sz
    if depth <= 0.0:
        return 1.0 / all_down, 1.0, height, depth, sx, sy, sz
    n2 = n * n
    a = (n2 - 1.0) * (sx * sx + sy * sy + sz * sz)
    k, root = 1.0 / (height + depth / n), n
    for _ in range(NEWTON_STEPS):
        root = np.sqrt(n2 + a * k * k)
        miss = 1.0 - k * (height + depth / root)
        step = miss / (height + depth * n2 / (root * root * root))
        k += step
        if abs(step) <= CLOSE * k:
            break
    return k, root, height, depth, sx, sy, sz


@njit(cache=True, error_model="numpy", nogil=True)
def slope_of_path(path: Path, nx: float, ny: float, nz: float, n: float) -> tuple[
    float, float, float
]:  # fmt: skip
    """Return the gradient of k by Q, on one plane.

    Of G(k, D, s.s) = 0, implicitly, with grad D = -N and grad s.s = 2 s:

        grad k = (k / S N + D k^3 (n^2 - 1) / S^3 s) / (H + D n^2 / S^3)

    and with it d w / d Q = k (I - N N') + s (grad k)'.
    """
    k, root, height, depth, sx, sy, sz = path
    n2 = n * n if depth > 0.0 else 1.0
    cube = root * root * root
    below = 1.0 / (height + depth * n2 / cube)
    along = below * k / root
    aside = below * depth * k * k * k * (n2 - 1.0) / cube
    return along * nx + aside * sx, along * ny + aside * sy, along * nz + aside * sz


SETTLING_STEPS = 12
HALVINGS = 36
"""Change of the path between two steps over a mesh or raster, as of `pcfix.refract.rays`."""


@njit(cache=True, error_model="numpy", nogil=True)
def plane_at(
    tin: Tin | None, field: Field | None, x: float, y: float, origin: FloatArray
) -> tuple[float, float, float]:
    """Return height, dz/dx and dz/dy of the water at a place; NaN where there is none.

    All three are relative to the apparent point `origin` (world frame, lowered by what the water
    stood higher), the place as well.
    """
    if field is not None:
        z, b, c = height_at(field, origin[0] + x, origin[1] + y)
        return z - origin[2], b, c
    if tin is not None:
        px, py = origin[0] + x, origin[1] + y
        facet = locate(tin, px, py)
        if facet >= 0:
            b, c = tin.planes[facet, 1], tin.planes[facet, 2]
            z = tin.planes[facet, 0] + b * (px - tin.origin_x) + c * (py - tin.origin_y)
            return z - origin[2], b, c
    return np.nan, 0.0, 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def settle(
    plane: FloatArray, tin: Tin | None, field: Field | None, origin: FloatArray,
    qx: float, qy: float, qz: float, ex: float, ey: float, ez: float, n: float,
) -> None:  # fmt: skip
    """Bring the plane of a ray, (N, h), to where the light from Q leaves a mesh or raster.

    Light that leaves through a crease, from either side of which the path leads to the other,
    gets a slope between the two: the path is shortest there (Fermat), and it goes over into the
    paths through either side without a jump. Beyond the edge, and over gaps, the last plane goes
    on.
    """
    b, c = -plane[0] / plane[2], -plane[1] / plane[2]
    b_before, c_before = b, c
    for _ in range(SETTLING_STEPS):
        x, y, z_plane, depth = _way_out(plane, qx, qy, qz, ex, ey, ez, n)
        z, b_there, c_there = plane_at(tin, field, x, y, origin)
        change = abs(z - z_plane) + abs(depth) * (abs(b_there - b) + abs(c_there - c))
        if not change > CLOSE_M:
            return
        _lay(plane, x, y, z, b_there, c_there)
        b_before, c_before, b, c = b, c, b_there, c_there
    _settle_on_crease(
        plane, tin, field, origin, b_before, c_before, b, c, qx, qy, qz, ex, ey, ez, n
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _settle_on_crease(
    plane: FloatArray, tin: Tin | None, field: Field | None, origin: FloatArray,
    b1: float, c1: float, b2: float, c2: float,
    qx: float, qy: float, qz: float, ex: float, ey: float, ez: float, n: float,
) -> None:  # fmt: skip
    """Halve the share of the second slope until the light leaves on the crease itself.

    The first slope leads to the side that has the second, and the other way round; the two are
    taken anew as the crease comes nearer.
    """
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        x, y, _, _ = _way_out(plane, qx, qy, qz, ex, ey, ez, n)
        z, b, c = plane_at(tin, field, x, y, origin)
        if np.isnan(z):
            return
        share = 0.5 * (low + high)
        _lay(plane, x, y, z, b1 + share * (b2 - b1), c1 + share * (c2 - c1))
        x, y, _, _ = _way_out(plane, qx, qy, qz, ex, ey, ez, n)
        _, b, c = plane_at(tin, field, x, y, origin)
        if (b - b1) ** 2 + (c - c1) ** 2 > (b - b2) ** 2 + (c - c2) ** 2:
            low, b2, c2 = share, b, c
        else:
            high, b1, c1 = share, b, c


@njit(cache=True, error_model="numpy", nogil=True)
def _way_out(
    plane: FloatArray, qx: float, qy: float, qz: float, ex: float, ey: float, ez: float, n: float
) -> tuple[float, float, float, float]:
    """Return where light from Q leaves the water through a plane, and the depth of Q below it."""
    nx, ny, nz = plane[0], plane[1], plane[2]
    k, _, height, depth, sx, sy, sz = light_path(qx, qy, qz, ex, ey, ez, nx, ny, nz, plane[3], n)
    return (
        ex + height * (k * sx - nx),
        ey + height * (k * sy - ny),
        ez + height * (k * sz - nz),
        depth,
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _lay(plane: FloatArray, x: float, y: float, z: float, b: float, c: float) -> None:
    """Lay the plane with the slopes b, c through a place."""
    up = 1.0 / np.sqrt(1.0 + b * b + c * c)
    plane[0], plane[1], plane[2] = -b * up, -c * up, up
    plane[3] = up * (z - b * x - c * y)

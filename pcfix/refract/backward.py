r"""The light from a true point to a camera: where it leaves the water, and in which direction.

Picture a point Q below a plane with the unit normal N, and a camera C at the height H above it.
Seen from the foot of C the point lies at the sideways vector s, at the depth D. In air the light
comes from the direction

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

As in `pcfix.refract.rays` the apparent point is the local origin, e = C - P, and the plane is
N.x = h.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numba import njit

from pcfix.water.surface import height_at, locate

if TYPE_CHECKING:
    from pcfix.model import FloatArray
    from pcfix.water.surface import Field, Tin

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


MAX_STEPS = 12
HALVINGS = 36
CLOSE_M = 1e-9
"""Change of the path between two steps over a mesh or raster, as of `pcfix.refract.piercing`."""


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
    for _ in range(MAX_STEPS):
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

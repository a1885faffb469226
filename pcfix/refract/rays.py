r"""One ray: how it bends at the water surface, and what it says about where the point is.

Picture a camera C looking down at the apparent point P. The line from C to P meets the water
surface at A and there bends towards the vertical; the true point lies somewhere on the bent ray
that leaves A. Two or more such rays fix it.

Everything is relative to P, which is the local origin: e = C - P points up to the camera, and
A and the solution are small vectors, so nothing is lost at large coordinates. Directions keep
the length L = \|e\| instead of being made unit vectors; that saves two square roots a ray, and
the kernels live from that.

The functions hold arithmetic only: scalars in, scalars out, no reordering of sums
(``fastmath`` stays off), so that the bits do not depend on tiles, chunks or threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit


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

r"""How the direction of light moves with all that it depends on: point, camera, plane and index.

As in `pcfix.refract.backward` light from a point Q reaches the projection centre C through the
plane N.x = h along

    w = -N + k s,    s = (I - N N') (Q - C)

(from the camera to the point, one metre along the normal for each metre of its length along it),
where k is the root of

    G(k) = k (H + D / S) - 1 = 0,    S = sqrt(n^2 + (n^2 - 1) k^2 s.s)

with H the height of C over the plane and D the depth of Q below it. By the implicit function
theorem any change of Q, C, plane or index moves k by

    dk = -(k dH + k / S dD - D k^3 (n^2 - 1) / (2 S^3) d(s.s) - k D n (1 + k^2 s.s) / S^3 dn) / G_k
    G_k = H + D n^2 / S^3

and w by dw = -dN + k ds + s dk. For the plane z = a + b x + c y, with u = N_z,

    N = u (-b, -c, 1),  h = u a:    dN / db = -u (e_x - N_x N),    dh / db = u N_x h

and H and D change with b by -u and u times the x of the feet of C and Q on the plane; with c
likewise by y. A point above the plane has S = 1, n = 1 and k = 1 / (H + D).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from pcfix.refract.backward import light_path

if TYPE_CHECKING:
    from pcfix.model import FloatArray

COLUMNS = 12
DIRECTION, BY_POINT, BY_CENTRE, BY_LEVEL, BY_SLOPES, BY_INDEX = 0, 1, 4, 7, 8, 10
"""First columns of what `light_and_gradients` fills in."""


@njit(cache=True, error_model="numpy", nogil=True)
def light_and_gradients(
    qx: float, qy: float, qz: float, ex: float, ey: float, ez: float,
    nx: float, ny: float, nz: float, h: float, n: float, out: FloatArray,
) -> None:  # fmt: skip
    """Fill in the direction of the light from Q to a camera, and its derivatives.

    Parameters
    ----------
    qx, qy, qz : float
        Q relative to the local origin, metres.
    ex, ey, ez : float
        The projection centre relative to the local origin, metres.
    nx, ny, nz, h : float
        The plane N.x = h: unit normal, upward, and height over the local origin along it, metres.
    n : float
        Refractive index.
    out : array of float64, shape (3, 12)
        Column 0: w, no unit, from the camera towards the water, -1 along N. 1 to 3: its
        derivatives by Q, 4 to 6: by the projection centre, 7: by the plane's level a (per metre),
        8 and 9: by its slopes b and c (z = a + b x + c y about the local origin), 10: by n.
        11 is zero. All NaN where `light_path` finds no way.
    """
    k, root, height, depth, sx, sy, sz = light_path(qx, qy, qz, ex, ey, ez, nx, ny, nz, h, n)
    if np.isnan(k):
        out[:] = np.nan
        return
    m = n if depth > 0.0 else 1.0
    cube = root * root * root
    below = 1.0 / (height + depth * m * m / cube)
    along, aside = below * k / root, below * depth * k * k * k * (m * m - 1.0) / cube
    by_n = 0.0
    if depth > 0.0:
        by_n = below * k * depth * n * (1.0 + k * k * (sx * sx + sy * sy + sz * sz)) / cube
    _by_places(out, k, below * k, along, aside, sx, sy, sz, nx, ny, nz)
    all_down = height + depth
    for axis in range(2):
        _by_slope(
            out, axis, k, 1.0 - k * all_down, nz, (sx, sy, sz), (nx, ny, nz),
            nz * below * k * ((ex, ey)[axis] - (nx, ny)[axis] * height)
            - nz * along * ((qx, qy)[axis] + (nx, ny)[axis] * depth)
            - nz * aside * all_down * (sx, sy)[axis],
        )  # fmt: skip
    by_level = nz * (below * k - along)
    for row, s in enumerate((sx, sy, sz)):
        out[row, BY_LEVEL], out[row, BY_INDEX], out[row, 11] = s * by_level, s * by_n, 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _by_places(
    out: FloatArray, k: float, up: float, along: float, aside: float,
    sx: float, sy: float, sz: float, nx: float, ny: float, nz: float,
) -> None:  # fmt: skip
    """Fill in w and its derivatives by Q and C.

    With dk / dQ = along N + aside s and dk / dC = -(up N + aside s).
    """
    normal, sideways = (nx, ny, nz), (sx, sy, sz)
    for i in range(3):
        out[i, DIRECTION] = k * sideways[i] - normal[i]
        for j in range(3):
            flat = (k if i == j else 0.0) - k * normal[i] * normal[j]
            aside_j = aside * sideways[j]
            out[i, BY_POINT + j] = flat + sideways[i] * (along * normal[j] + aside_j)
            out[i, BY_CENTRE + j] = -flat - sideways[i] * (up * normal[j] + aside_j)


@njit(cache=True, error_model="numpy", nogil=True)
def _by_slope(
    out: FloatArray, j: int, k: float, rest: float, u: float,
    s: tuple[float, float, float], normal: tuple[float, float, float], dk: float,
) -> None:  # fmt: skip
    """Fill in dw by a slope: u (1 - k (H + D)) (e_j - N_j N) + k u s_j N + s dk."""
    for i in range(3):
        flat = (1.0 if i == j else 0.0) - normal[i] * normal[j]
        out[i, BY_SLOPES + j] = u * (rest * flat + k * s[j] * normal[i]) + s[i] * dk

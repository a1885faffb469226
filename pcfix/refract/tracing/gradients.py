r"""Differentiate the direction of light by point, camera, plane and index.

As in `pcfix.refract.rays` light from a point Q reaches the projection centre C through the
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

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError
from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.lens.algebra import Vector, dot, minus, normal_of, row_of, vector
from pcfix.model import FloatArray
from pcfix.refract.rays import light_path
from pcfix.refract.tracing import Tracing

COLUMNS = 12
DIRECTION, BY_POINT, BY_CENTRE, BY_LEVEL, BY_SLOPES, BY_INDEX = 0, 1, 4, 7, 8, 10
"""First columns of what `light_and_gradients` fills in."""


@device
def light_and_gradients(
    q: Vector, e: Vector, normal: Vector, h: float, n: float, out: FloatArray
) -> None:
    """Fill in the direction of the light from Q to a camera, and its derivatives.

    Parameters
    ----------
    q : Vector
        Q relative to the local origin, metres.
    e : Vector
        The projection centre relative to the local origin, metres.
    normal, h : Vector, float
        The plane N.x = h: unit normal, upward, and height over the local origin along it, metres.
    n : float
        Refractive index.
    out : array of float64, shape (3, 12)
        Column 0: w, no unit, from the camera towards the water, -1 along N. 1 to 3: its
        derivatives by Q, 4 to 6: by the projection centre, 7: by the plane's level a (per metre),
        8 and 9: by its slopes b and c (z = a + b x + c y about the local origin), 10: by n.
        11 is zero. All NaN where `light_path` finds no way.
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


@dataclass(frozen=True, eq=False)
class Gradients:
    """Derivatives of n unit directions; [i, j] is that of component i by unknown j.

    Attributes
    ----------
    by_point, by_centre : array, shape (n, 3, 3)
        Per metre.
    by_level : array, shape (n, 3)
        By the height of the water, per metre.
    by_slopes : array, shape (n, 3, 2)
        By its tilts dz/dx and dz/dy about the pivot.
    by_index : array, shape (n, 3)
        By the refractive index.
    """

    by_point: FloatArray
    by_centre: FloatArray
    by_level: FloatArray
    by_slopes: FloatArray
    by_index: FloatArray


def gradients(
    points: npt.ArrayLike,
    centres: npt.ArrayLike,
    tracing: Tracing,
    refractive_index: float,
    *,
    pivot: tuple[float, float] = (0.0, 0.0),
) -> Gradients:
    """Differentiate the directions of a tracing.

    By the implicit function theorem at the solution (`light_and_gradients`). The surface is taken
    as its tangent plane where the light leaves the water: exact for planes and facets; on a raster
    the slope's own change from place to place (its curvature) is left out; on a crease the plane is
    the one that bends the light as the crease does.

    Parameters
    ----------
    points, centres : array, shape (n, 3) or (3,)
        As they were traced, metres, world frame.
    tracing : Tracing
        Of `pcfix.refract.tracing.trace`.
    refractive_index : float
    pivot : tuple of 2 float
        The place about which the water tilts, metres, world frame: for the b and c of a
        `WaterPlane` the origin.

    Returns
    -------
    Gradients
        NaN where no path was found. Where light goes straight, the water and the index have no
        part in it: zero.

    Raises
    ------
    SettingError
        If points and centres are not those of the tracing.
    """
    shape = tracing.direction.shape
    try:
        xyz = np.ascontiguousarray(np.broadcast_to(np.asarray(points, float), shape))
        seen_from = np.ascontiguousarray(np.broadcast_to(np.asarray(centres, float), shape))
    except ValueError:
        raise SettingError(
            "trace.shapes",
            f"Points of shape {np.shape(points)} and centres of shape {np.shape(centres)} do not"
            f" fit a tracing of {shape[0]} paths. Give those that were traced.",
            paths=shape[0],
        ) from None
    result = np.empty((len(xyz), 3, COLUMNS))
    in_tiles(
        _differentiate, len(xyz), xyz, seen_from, tracing.piercing_xyz, tracing.slope,
        float(refractive_index), result,
    )  # fmt: skip
    by_slopes = result[:, :, BY_SLOPES:BY_INDEX].copy()
    from_pivot = xyz[:, :2] - np.asarray(pivot, float)
    by_slopes += from_pivot[:, None, :] * result[:, :, BY_LEVEL, None]
    return Gradients(
        by_point=result[:, :, BY_POINT:BY_CENTRE],
        by_centre=result[:, :, BY_CENTRE:BY_LEVEL],
        by_level=result[:, :, BY_LEVEL],
        by_slopes=by_slopes,
        by_index=result[:, :, BY_INDEX],
    )


@kernel
def _differentiate(
    span: Span, points: FloatArray, centres: FloatArray, piercing: FloatArray, slope: FloatArray,
    n: float, result: FloatArray,
) -> None:  # fmt: skip
    """Fill in the columns of `light_and_gradients`, made those of the unit direction.

    In coordinates about the point. Of d = w / |w| any derivative is (I - d d') w' / |w|.
    """
    for i in range(*span):
        p, out = points[i], result[i]
        ax, ay, az = piercing[i, 0] - p[0], piercing[i, 1] - p[1], piercing[i, 2] - p[2]
        b, c = slope[i, 0], slope[i, 1]
        normal = normal_of(b, c)
        h = normal[2] * (az - b * ax - c * ay)
        if ax == 0.0 and ay == 0.0 and az == 0.0:
            h = 0.0  # straight: of a point in the plane itself
        e = minus(row_of(centres, i), vector(p))
        light_and_gradients((0.0, 0.0, 0.0), e, normal, h, n, out)
        # from w to the unit direction
        w = out[:, DIRECTION]
        size = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
        for row in range(3):
            out[row, DIRECTION] /= size
        for column in range(1, COLUMNS):
            along = 0.0
            for row in range(3):
                along += out[row, DIRECTION] * out[row, column]
            for row in range(3):
                out[row, column] = (out[row, column] - along * out[row, DIRECTION]) / size

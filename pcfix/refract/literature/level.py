r"""What the methods of the literature share: one camera's ray through level water.

Picture the vertical plane through a camera C and the apparent point P. The line of sight meets
the surface at A, at the angle a from the vertical, and goes on under water at the angle b, with
sin a = n sin b. The vertical through P is its *plumb line*. P lies on it at the apparent depth d,
where the straight line of sight crosses it; the bent ray crosses it further down, at the depth

    d tan a / tan b = d sqrt(n^2 + (n^2 - 1) tan^2 a)

as tan b = sin a / sqrt(n^2 - sin^2 a). The left side is 0/0 for a camera straight above the
point; the right side is its limit there, n d, and the same everywhere else.

These methods know level water only. Over a tilted surface or a mesh the depth is counted from the
height of the water above the apparent point, along the vertical, and the surface is taken as level
there. Each camera has its own water level where that moved; a camera whose water stood below the
apparent point saw it through air, and its ray goes straight on.

The arrays of rays are those of `pcfix.model.Views`: the rays of point i are the entries from
``start[i]`` to ``start[i + 1]`` of ``camera``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray
    from pcfix.refract.bundles import Bundle


def apparent_depth(bundle: Bundle) -> FloatArray:
    """Return how far the apparent points lie below the water above them, metres, shape (m,)."""
    return np.asarray(bundle.surface.height_m - bundle.xyz[:, 2])


def down(shift_m: FloatArray) -> FloatArray:
    """Return shifts, shape (m, 3), that go down by so many metres, shape (m,)."""
    none = np.zeros(len(shift_m))
    return np.column_stack([none, none, -shift_m])


def rays_of(
    bundle: Bundle,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray, IntArray]:
    """Return what the kernels need of a bundle.

    Returns
    -------
    xyz, depth, centres, offset, start, camera : array
        Apparent points (m, 3) and their depth (m,), projection centres (k, 3) and the offsets of
        their water levels (k,), metres; the list of rays.
    """
    return (
        np.ascontiguousarray(bundle.xyz),
        np.ascontiguousarray(apparent_depth(bundle)),
        np.ascontiguousarray(bundle.cameras.centres),
        np.ascontiguousarray(bundle.level_offset_m),
        np.asarray(bundle.views.start, np.int64),
        np.asarray(bundle.views.camera, np.int64),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def depth_ratio(tan2: float, n: float) -> float:
    """Return tan a / tan b of a ray with tan^2 a = `tan2`: what a depth grows by along it."""
    return np.sqrt(n * n + (n * n - 1.0) * tan2)


@njit(cache=True, error_model="numpy", nogil=True)
def plumb_line_crossings(
    xyz: FloatArray, depth: FloatArray, centres: FloatArray, offset: FloatArray,
    start: IntArray, camera: IntArray, n: float, by_cosine: bool, lowered: FloatArray,
    miss: FloatArray,
) -> None:  # fmt: skip
    """Find where the bent rays of each point cross its plumb line, in the mean.

    Parameters
    ----------
    xyz, depth, centres, offset, start, camera
        Of `rays_of`.
    n : float
        Refractive index.
    by_cosine : bool
        Weigh each ray with the cosine of its angle a in air, not with 1.
    lowered, miss : array, shape (m,)
        Filled in: how far below the apparent point the mean lies, and its root mean square
        distance from the bent rays, metres; 0 where a point has no ray.

    Notes
    -----
    A point h above the place where a ray crosses the plumb line is h sin b away from the ray.
    """
    for i in range(len(xyz)):
        rays = camera[start[i] : start[i + 1]]
        total, weights, squares = 0.0, 0.0, 0.0
        for c in rays:
            below, cosine2 = _crossing(xyz[i], depth[i] + offset[c], centres[c], n)
            weight = np.sqrt(cosine2) if by_cosine else 1.0
            total += weight * below
            weights += weight
        if rays.size == 0:
            continue
        lowered[i] = total / weights
        for c in rays:
            below, cosine2 = _crossing(xyz[i], depth[i] + offset[c], centres[c], n)
            squares += (lowered[i] - below) ** 2 * (1.0 - cosine2) / (n * n)
        miss[i] = np.sqrt(squares / rays.size)


@njit(cache=True, error_model="numpy", nogil=True)
def _crossing(point: FloatArray, depth: float, centre: FloatArray, n: float) -> tuple[float, float]:
    """Return how far below the apparent point a bent ray crosses its plumb line; cos^2 a."""
    ex, ey, ez = centre[0] - point[0], centre[1] - point[1], centre[2] - point[2]
    plan2 = ex * ex + ey * ey
    cosine2 = ez * ez / (plan2 + ez * ez)
    return max(depth, 0.0) * (depth_ratio(plan2 / (ez * ez), n) - 1.0), cosine2

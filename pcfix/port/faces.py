"""A ray at the face of a port, in vectors of three numbers."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numba import njit

Vector: TypeAlias = tuple[float, float, float]
Ray: TypeAlias = tuple[float, float, float, float, float, float]
"""A place and a unit direction."""


@njit(cache=True, error_model="numpy", nogil=True)
def dot(a: Vector, b: Vector) -> float:
    """Return a.b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, error_model="numpy", nogil=True)
def unit(a: Vector) -> Vector:
    """Return a vector of length 1; NaN for one without length."""
    scale = 1.0 / np.sqrt(dot(a, a)) if dot(a, a) > 0.0 else np.nan
    return scale * a[0], scale * a[1], scale * a[2]


@njit(cache=True, error_model="numpy", nogil=True)
def bent(s: Vector, normal: Vector, r: float) -> Vector:
    """Return the unit direction behind a face: Snell's law in vector form.

    Skarlatos & Agrafiotis 2018, eq 10, with the normal along the light instead of against it:
    t = r s + (sqrt(1 - r^2 (1 - c^2)) - r c) N, c = N.s. NaN where all light is reflected.

    Parameters
    ----------
    s, normal : Vector
        Unit direction of the light; unit normal of the face, to the side it goes to.
    r : float
        Refractive index before the face by that behind it.
    """
    c = dot(normal, s)
    k = np.sqrt(1.0 - r * r * (1.0 - c * c)) - r * c
    return r * s[0] + k * normal[0], r * s[1] + k * normal[1], r * s[2] + k * normal[2]

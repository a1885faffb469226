"""Vectors and matrices of three for kernels: as tuples of numbers they stay in registers.

Sums are always formed from left to right, so that equal operands give equal results.
"""

from typing import TypeAlias

import numpy as np

from pcfix.kernels import device
from pcfix.model import FloatArray

Vector: TypeAlias = tuple[float, float, float]
Symmetric: TypeAlias = tuple[float, float, float, float, float, float]  # xx, xy, xz, yy, yz, zz
# A matrix, row by row.
Nine: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]


@device
def dot(a: Vector, b: Vector) -> float:
    """Return a.b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@device
def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@device
def plus(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@device
def minus(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@device
def scaled(c: float, a: Vector) -> Vector:
    """Return c a."""
    return c * a[0], c * a[1], c * a[2]


@device
def beyond(a: Vector, f: float, b: Vector) -> Vector:
    """Return a + f b."""
    return a[0] + f * b[0], a[1] + f * b[1], a[2] + f * b[2]


@device
def unit(a: Vector) -> Vector:
    """Return a vector of length 1; NaN for one without length."""
    return scaled(1.0 / np.sqrt(dot(a, a)) if dot(a, a) > 0.0 else np.nan, a)


@device
def vector(row: FloatArray, at: int = 0) -> Vector:
    """Return three numbers of a row, from index `at`."""
    return row[at], row[at + 1], row[at + 2]


@device
def row_of(rows: FloatArray, i: int) -> Vector:
    """Return row i of an array, shape (n, 3)."""
    return rows[i, 0], rows[i, 1], rows[i, 2]


@device
def column_of(m: FloatArray, j: int) -> Vector:
    """Return column j of an array, shape (3, n)."""
    return m[0, j], m[1, j], m[2, j]


@device
def times(m: FloatArray, a: Vector) -> Vector:
    """Return m a: with the rotation of a camera, from the world to the camera frame."""
    return (
        m[0, 0] * a[0] + m[0, 1] * a[1] + m[0, 2] * a[2],
        m[1, 0] * a[0] + m[1, 1] * a[1] + m[1, 2] * a[2],
        m[2, 0] * a[0] + m[2, 1] * a[1] + m[2, 2] * a[2],
    )


@device
def transposed_times(m: FloatArray, a: Vector) -> Vector:
    """Return m' a: with the rotation of a camera, from the camera frame to the world."""
    return (
        m[0, 0] * a[0] + m[1, 0] * a[1] + m[2, 0] * a[2],
        m[0, 1] * a[0] + m[1, 1] * a[1] + m[2, 1] * a[2],
        m[0, 2] * a[0] + m[1, 2] * a[1] + m[2, 2] * a[2],
    )


@device
def normal_of(b: float, c: float) -> Vector:
    """Return the unit normal, upward, of a plane with the slopes dz/dx = b and dz/dy = c."""
    up = 1.0 / np.sqrt(1.0 + b * b + c * c)
    return -b * up, -c * up, up


NO_SQUARES: Symmetric = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # where a sum of `plus_square` begins


@device
def plus_square(m: Symmetric, a: Vector) -> Symmetric:
    """Return m + a a'."""
    x, y, z = a
    return m[0] + x * x, m[1] + x * y, m[2] + x * z, m[3] + y * y, m[4] + y * z, m[5] + z * z


@device
def cofactors(m: Symmetric) -> tuple[float, Symmetric]:
    """Return the determinant of a symmetric matrix and its cofactors: det times its inverse."""
    xx, xy, xz, yy, yz, zz = m
    c: Symmetric = (
        yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy,
        xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy,
    )  # fmt: skip
    return xx * c[0] + xy * c[1] + xz * c[2], c


@device
def product(m: Symmetric, a: Vector) -> Vector:
    """Return a symmetric matrix times a vector."""
    return (
        m[0] * a[0] + m[1] * a[1] + m[2] * a[2],
        m[1] * a[0] + m[3] * a[1] + m[4] * a[2],
        m[2] * a[0] + m[4] * a[1] + m[5] * a[2],
    )


@device
def solved(m: Symmetric, a: Vector) -> tuple[float, Vector]:
    """Return the determinant of a symmetric matrix, and its inverse times a vector."""
    det, c = cofactors(m)
    x, y, z = product(c, a)
    return det, (x / det, y / det, z / det)


@device
def inverted(m: FloatArray, least: float) -> bool:
    """Invert a matrix in place; False if its determinant over that of the diagonal is `least`."""
    a, b, c = m[0, 0], m[0, 1], m[0, 2]
    d, e, f = m[1, 0], m[1, 1], m[1, 2]
    g, h, i = m[2, 0], m[2, 1], m[2, 2]
    det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if not abs(det) > least * abs(a * e * i):
        return False
    m[0, 0], m[0, 1], m[0, 2] = (e * i - f * h) / det, (c * h - b * i) / det, (b * f - c * e) / det
    m[1, 0], m[1, 1], m[1, 2] = (f * g - d * i) / det, (a * i - c * g) / det, (c * d - a * f) / det
    m[2, 0], m[2, 1], m[2, 2] = (d * h - e * g) / det, (b * g - a * h) / det, (a * e - b * d) / det
    return True

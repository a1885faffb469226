r"""A dense cloud taken from old cameras to adjusted ones.

An apparent point P is where rays of the old cameras met. What the images showed is still true, so
P is where the same places in the images meet now: P' with

    sum J'(pi_new(P') - pi_old(P)) = 0

straight rays, as ordinary software intersects them, land and bed alike. The cloud is then what the
same software would have made with the adjusted cameras, and any method of correction goes on from
there with them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit, prange

from pcfix.lens.imaging import image_and_gradients, image_of, lens_table
from pcfix.threads import one_caller

if TYPE_CHECKING:
    from pcfix.model import BoolArray, Cameras, FloatArray, IntArray, Views

MAX_STEPS = 12
CLOSE_M = 1e-6
LEAST_CONDITION = 1e-6
"""Of the determinant of the normal matrix, against the product of its diagonal."""

_BLOCK = 256


class Carried(NamedTuple):
    """Where points went.

    Attributes
    ----------
    shift_m : array, shape (n, 3)
        Zero where the point stayed.
    moved : array of bool, shape (n,)
        Whether two cameras or more imaged the point, before and after.
    """

    shift_m: FloatArray
    moved: BoolArray


def carry(xyz: FloatArray, views: Views, old: Cameras, new: Cameras) -> Carried:
    """Intersect the image places of points again, with adjusted cameras.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Apparent points, metres, world frame.
    views : Views
        Which cameras each point is carried by; weights do not count.
    old, new : Cameras
        The same images, in the same order, with angles and lenses.

    Returns
    -------
    Carried
    """
    shift = np.zeros((len(xyz), 3))
    moved = np.zeros(len(xyz), np.bool_)
    old_row, old_lenses = lens_table(old.lenses or ())
    new_row, new_lenses = lens_table(new.lenses or ())
    with one_caller():
        _carry(
            np.ascontiguousarray(xyz), np.asarray(views.start, np.int64),
            np.asarray(views.camera, np.int64),
            np.ascontiguousarray(old.centres), np.ascontiguousarray(old.rotations, np.float64),
            old_row, old_lenses,
            np.ascontiguousarray(new.centres), np.ascontiguousarray(new.rotations, np.float64),
            new_row, new_lenses, shift, moved,
        )  # fmt: skip
    return Carried(shift, moved)


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _carry(
    xyz: FloatArray, start: IntArray, camera: IntArray,
    old_centres: FloatArray, old_rotations: FloatArray, old_row: IntArray, old_lenses: FloatArray,
    new_centres: FloatArray, new_rotations: FloatArray, new_row: IntArray, new_lenses: FloatArray,
    shift: FloatArray, moved: BoolArray,
) -> None:  # fmt: skip
    for block in prange((len(xyz) + _BLOCK - 1) // _BLOCK):
        first, last = block * _BLOCK, min((block + 1) * _BLOCK, len(xyz))
        most = 1
        for i in range(first, last):
            most = max(most, start[i + 1] - start[i])
        image, who = np.empty((most, 2)), np.empty(most, np.int64)
        for i in range(first, last):
            count = 0
            for j in range(start[i], start[i + 1]):
                c = camera[j]
                u, v = _image(
                    xyz[i, 0] - old_centres[c, 0], xyz[i, 1] - old_centres[c, 1],
                    xyz[i, 2] - old_centres[c, 2], old_rotations[c], old_lenses[old_row[c]],
                )  # fmt: skip
                if u == u and v == v:
                    image[count, 0], image[count, 1], who[count] = u, v, c
                    count += 1
            if count >= 2:
                moved[i] = _meet(
                    shift[i], xyz[i], image[:count], who[:count], new_centres, new_rotations,
                    new_row, new_lenses,
                )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _image(dx: float, dy: float, dz: float, r: FloatArray, lens: FloatArray) -> tuple[float, float]:
    return image_of(
        lens,
        r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz,
        r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz,
        r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz,
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _meet(
    shift: FloatArray, xyz: FloatArray, image: FloatArray, who: IntArray, centres: FloatArray,
    rotations: FloatArray, row: IntArray, lenses: FloatArray,
) -> bool:  # fmt: skip
    """Find the shift after which the cameras image the point nearest to the places; whether so."""
    x, y, z = 0.0, 0.0, 0.0
    for _ in range(MAX_STEPS):
        m00, m01, m02, m11, m12, m22, b0, b1, b2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(who.size):
            c, r = who[j], rotations[who[j]]
            dx = xyz[0] + x - centres[c, 0]
            dy = xyz[1] + y - centres[c, 1]
            dz = xyz[2] + z - centres[c, 2]
            u, v, g = image_and_gradients(
                lenses[row[c]],
                r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz,
                r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz,
                r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz,
            )
            for a in range(2):
                off = image[j, a] - (u if a == 0 else v)
                g0, g1, g2 = g[3 * a], g[3 * a + 1], g[3 * a + 2]
                jx = g0 * r[0, 0] + g1 * r[1, 0] + g2 * r[2, 0]
                jy = g0 * r[0, 1] + g1 * r[1, 1] + g2 * r[2, 1]
                jz = g0 * r[0, 2] + g1 * r[1, 2] + g2 * r[2, 2]
                m00, m01, m02 = m00 + jx * jx, m01 + jx * jy, m02 + jx * jz
                m11, m12, m22 = m11 + jy * jy, m12 + jy * jz, m22 + jz * jz
                b0, b1, b2 = b0 + jx * off, b1 + jy * off, b2 + jz * off
        c00, c01, c02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
        c11, c12, c22 = m00 * m22 - m02 * m02, m01 * m02 - m00 * m12, m00 * m11 - m01 * m01
        det = m00 * c00 + m01 * c01 + m02 * c02
        if not det > LEAST_CONDITION * m00 * m11 * m22:
            return False
        sx = (c00 * b0 + c01 * b1 + c02 * b2) / det
        sy = (c01 * b0 + c11 * b1 + c12 * b2) / det
        sz = (c02 * b0 + c12 * b1 + c22 * b2) / det
        x, y, z = x + sx, y + sy, z + sz
        if sx * sx + sy * sy + sz * sz <= CLOSE_M * CLOSE_M:
            shift[0], shift[1], shift[2] = x, y, z
            return True
    return False

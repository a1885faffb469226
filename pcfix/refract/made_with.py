"""The cameras that a cloud was made with, where it is corrected with adjusted ones.

A dense matcher compared images in the geometry of its own cameras, right or wrong; the light went
in that of the true ones. What both have in common is the place in the image: a direction in the
one geometry is a direction in the other, through the lens of either.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from pcfix.lens.imaging import direction_of, image_of, lens_table

if TYPE_CHECKING:
    from pcfix.model import Cameras, FloatArray, IntArray


class MadeWith(NamedTuple):
    """What made m points.

    Attributes
    ----------
    xyz : array, shape (m, 3)
        Apparent points as the software had them, metres, world frame.
    cameras : Cameras
        Those it had, in the order of the adjusted ones, with angles and lenses.
    """

    xyz: FloatArray
    cameras: Cameras

    def take(self, rows: IntArray) -> MadeWith:
        """Return what made some of the points."""
        return MadeWith(self.xyz[rows], self.cameras)


class Images(NamedTuple):
    """The k images in the cameras that made the points and in those of now, for kernels.

    Without rows where they are the same: then no light goes through a lens, and nothing is rounded.

    Attributes
    ----------
    centres : array, shape (k, 3)
        Of those that made the points, metres, world frame.
    rotations, rotations_now : array, shape (k, 3, 3)
        World to camera.
    row, row_now : array, shape (k,)
        The lens of each image in the tables.
    lenses, lenses_now : array, shape (l, ...)
        See `pcfix.lens.imaging.lens_table`.
    """

    centres: FloatArray
    rotations: FloatArray
    row: IntArray
    lenses: FloatArray
    rotations_now: FloatArray
    row_now: IntArray
    lenses_now: FloatArray


def images_of(made_with: MadeWith | None, now: Cameras) -> Images:
    """Return the images for kernels.

    Raises
    ------
    ValueError
        If there are two sets of cameras, and one has no angles or no lenses, or they are not of
        the same number.
    """
    if made_with is None or _are_equal(made_with.cameras, now):
        none, no_row = np.zeros((0, 3, 3)), np.zeros(0, np.int64)
        return Images(np.zeros((0, 3)), none, no_row, np.zeros((0, 1)), none, no_row, none[:, 0])
    made = made_with.cameras
    if made.lenses is None or now.lenses is None or len(made) != len(now):
        raise ValueError("the same images are needed twice, with angles and lenses")
    row, lenses = lens_table(made.lenses)
    row_now, lenses_now = lens_table(now.lenses)
    return Images(
        np.ascontiguousarray(made.centres, np.float64),
        np.ascontiguousarray(made.rotations, np.float64),
        row,
        lenses,
        np.ascontiguousarray(now.rotations, np.float64),
        row_now,
        lenses_now,
    )


def _are_equal(made: Cameras, now: Cameras) -> bool:
    """Whether two sets of cameras show the same everywhere."""
    return made is now or (
        np.array_equal(made.centres, now.centres)
        and made.lenses == now.lenses
        and made.rotations is not None
        and now.rotations is not None
        and np.array_equal(made.rotations, now.rotations)
    )


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def as_made(images: Images, c: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return where the matcher had what camera c sees in a direction, both in the world frame.

    NaN where there is no image; of any length.
    """
    if len(images.centres) == 0:
        return x, y, z
    return _through(
        images.rotations_now[c], images.lenses_now[images.row_now[c]],
        images.rotations[c], images.lenses[images.row[c]], x, y, z,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def as_now(images: Images, c: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return in which direction camera c sees what the matcher had in a direction."""
    return _through(
        images.rotations[c], images.lenses[images.row[c]],
        images.rotations_now[c], images.lenses_now[images.row_now[c]], x, y, z,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _through(
    r: FloatArray, lens: FloatArray, to_r: FloatArray, to_lens: FloatArray,
    x: float, y: float, z: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the direction of the same place in the image for another pose and lens."""
    u, v = image_of(
        lens,
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z,
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z,
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z,
    )
    x, y, z = direction_of(to_lens, u, v)
    return (
        to_r[0, 0] * x + to_r[1, 0] * y + to_r[2, 0] * z,
        to_r[0, 1] * x + to_r[1, 1] * y + to_r[2, 1] * z,
        to_r[0, 2] * x + to_r[1, 2] * y + to_r[2, 2] * z,
    )

"""What an adjustment works on, as flat arrays for the kernels.

All coordinates are relative to an origin of the block, so that nothing is lost at large
coordinates. The water's numbers are its plane z = a + b x + c y in these coordinates; over a mesh
or raster `a` is by how much it stands higher than given, and b and c are unused.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.lens import formulas as places

if TYPE_CHECKING:
    from pcfix.model import BoolArray, FloatArray, IntArray
    from pcfix.water.surface import Field, Tin


class State(NamedTuple):
    """What is estimated.

    centres : shape (k, 3); rotations : shape (k, 3, 3), world to camera.
    lenses : shape (l, ...), coefficients of `pcfix.lens.imaging.lens_table`.
    xyz : shape (m, 3), true points.
    water : shape (4,), a, b, c and the refractive index.
    """

    centres: FloatArray
    rotations: FloatArray
    lenses: FloatArray
    xyz: FloatArray
    water: FloatArray


class Seen(NamedTuple):
    """What was measured, gathered by point.

    start : shape (m + 1,); camera, image_xy, weight : o rows.
    weight : 1 / standard deviation of u and v; zero where the observation is left out.
    wet : shape (m,), whether the point may be under water; it is where it lies below it.
    lens_row, group : shape (k,), row of the lens table and group of lenses of each camera.
    """

    start: IntArray
    camera: IntArray
    image_xy: FloatArray
    weight: FloatArray
    wet: BoolArray
    lens_row: IntArray
    group: IntArray


class Surface(NamedTuple):
    """What bends the light besides the plane of `State.water`.

    there : whether there is water at all.
    tin, field : a mesh or raster instead of the plane.
    origin : shape (3,), the block's origin in the world frame.
    port : coefficients of a housing port, of length 0 where there is none.
    """

    there: bool
    tin: Tin | None
    field: Field | None
    origin: FloatArray
    port: FloatArray


FOCAL, CX, CY, B1, B2, P1, P2, K1 = range(8)
"""Codes of the lens parameters; k1, k2, ... follow from `K1` on."""

CODES = {"f": FOCAL, "cx": CX, "cy": CY, "b1": B1, "b2": B2, "p1": P1, "p2": P2}
CODES |= {f"k{i + 1}": K1 + i for i in range(8)}

LEVEL, TILT_X, TILT_Y, INDEX = range(4)
WATER_NAMES = ("level", "tilt_x", "tilt_y", "index")


class Columns(NamedTuple):
    """Where the unknowns that many points share stand, counted from the first of them.

    lens : shape (groups + 1,), where the parameters of each group begin.
    code : shape (lens[-1],), which parameter each one is.
    water : shape (4,), -1 where fixed.
    similarity : the first of seven, -1 where the poses move on their own.
    total : how many there are.
    """

    lens: IntArray
    code: IntArray
    water: IntArray
    similarity: int
    total: int


def places_of(code: int) -> tuple[int, ...]:
    """Return which coefficients of a lens a parameter stands in."""
    return {
        FOCAL: (places.FOCAL_X, places.FOCAL_Y),
        CX: (places.PRINCIPAL_X,),
        CY: (places.PRINCIPAL_Y,),
        B1: (places.FOCAL_X,),
        B2: (places.B2,),
        P1: (places.TANGENTIAL,),
        P2: (places.TANGENTIAL + 1,),
    }.get(code, (places.TAIL + code - K1,))


def columns_of(
    codes: list[tuple[int, ...]], water: tuple[bool, bool, bool, bool], similarity: bool
) -> Columns:
    """Return the columns of the free parameters of each group, the water's and a similarity's."""
    lens = np.concatenate([[0], np.cumsum([len(mine) for mine in codes])]).astype(np.int64)
    place = np.full(4, -1, np.int64)
    free = np.flatnonzero(water)
    place[free] = lens[-1] + np.arange(len(free))
    first = int(lens[-1]) + len(free)
    flat = np.array([code for mine in codes for code in mine], np.int64)
    return Columns(lens, flat, place, first if similarity else -1, first + 7 * similarity)

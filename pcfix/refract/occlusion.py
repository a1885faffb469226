"""Which cameras a cloud hides from its own points.

The cloud's own surface is a grid of heights. From the apparent point P the straight ray to the
projection centre climbs over the cells on its way; where it is still below the surface as it
leaves a cell, the camera did not see the point.

The rays are straight and the surface is the apparent one, although light bends at the water. That
is the same picture twice: the software that knew nothing of water put every submerged thing on
the straight ray on which an image shows it, so that what hides P lies before it on its straight
ray. It is an approximation where an apparent point was made of several images, as their straight
rays miss each other: beside nadir images, that of a ray at 45 degrees by about a tenth of the
depth. A thing and what it hides under water are off to the same side, so that the difference of
their depths counts. Above the water nothing is approximate.

Nothing but the grid is known, so all below its surface counts as solid. Within `NEAR_CELLS` of P
nothing is tested: a cell has one height, and on a cliff that is the upper edge, not P's. Only
under a roof, where all cells around P stand over it, it matters whether the ray goes through it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.kernels import Span, device, in_tiles, kernel
from pcfix.model import BoolArray, FloatArray, IntArray, Views

Heights = npt.NDArray[np.float32]

NEAR_CELLS = 2.0
"""So far from the point, in plan, its own surroundings do not hide it."""
BLOCK, LARGE_BLOCK = 8, 64
"""Cells along the side of the blocks whose highest cell is kept, to pass them at once."""
MARGIN_BLOCK = 16
ROOF_MARGINS = 2.0
"""A roof stands over the point by so many margins; else it may be a low point of an even bed."""
_ONWARD = 1e-6
"""Of a cell: past its edge, so that the next one is looked at."""


class Occluder(NamedTuple):
    """The surface of a cloud, which hides points from cameras.

    Attributes
    ----------
    height : array of float32, shape (rows, columns)
        Metres, world frame; the first row is the southern one. NaN where it is not known; there
        it hides nothing.
    left_m, bottom_m : float
        South-west corner of the grid, world frame.
    cell_m : float
        Side of a cell.
    highest_m : float
        Of all heights; minus infinity where none is known.
    margin : array of float32, shape (rows / 16, columns / 16), rounded up
        By how much a ray must pass below the surface, metres: the noise of the points in each
        block of `MARGIN_BLOCK` cells.
    block_top, large_block_top : array of float32
        The highest of each block of `BLOCK` and `LARGE_BLOCK` cells; minus infinity where none
        is known.
    """

    height: Heights
    left_m: float
    bottom_m: float
    cell_m: float
    highest_m: float
    margin: Heights
    block_top: Heights
    large_block_top: Heights


def hidden(xyz: FloatArray, centres: FloatArray, views: Views, occluder: Occluder) -> BoolArray:
    """Return for each entry of ``views.camera`` whether the cloud hides the camera from its point.

    Points, shape (n, 3), apparent, and projection centres, shape (k, 3), in metres, world frame.
    No camera is hidden that is not above its point, nor from a point beside the grid.

    Notes
    -----
    The cells on the way are found as by Amanatides & Woo 1987, "A fast voxel traversal algorithm
    for ray tracing", in blocks of three sizes. The ray's height as it leaves a cell is compared,
    so that on an even slope, which the ray climbs away from, no cell stands above it.
    """
    found = np.zeros(len(views.camera), np.bool_)
    in_tiles(
        _hidden, len(xyz), np.ascontiguousarray(xyz), np.ascontiguousarray(centres),
        views.start, views.camera, occluder, found,
    )  # fmt: skip
    return found


def visible_cameras(
    xyz: FloatArray, centres: FloatArray, views: Views, occluder: Occluder
) -> Views:
    """Return the views without the hidden cameras.

    A point that would keep fewer than two cameras keeps them all: it is in the cloud, so two saw
    it, and it is the grid that does not show how. Parameters are those of `hidden`.
    """
    stays = ~hidden(xyz, centres, views, occluder)
    owner = np.repeat(np.arange(len(xyz)), np.diff(views.start))
    left = np.bincount(owner[stays], minlength=len(xyz))
    stays |= (left < 2)[owner]
    start = np.concatenate([[0], np.cumsum(np.bincount(owner[stays], minlength=len(xyz)))])
    weight = None if views.weight is None else views.weight[stays]
    return Views(start, views.camera[stays], weight, views.kind)


@kernel
def _hidden(
    span: Span, xyz: FloatArray, centres: FloatArray, start: IntArray, camera: IntArray,
    o: Occluder, found: BoolArray,
) -> None:  # fmt: skip
    """Test every ray; distances in plan are in cells from here on."""
    for i in range(*span):
        u, v, z = (xyz[i, 0] - o.left_m) / o.cell_m, (xyz[i, 1] - o.bottom_m) / o.cell_m, xyz[i, 2]
        if not _inside(o.height, u, v):
            continue
        slack = float(o.margin[int(v) // MARGIN_BLOCK, int(u) // MARGIN_BLOCK])
        if z + slack >= o.highest_m:
            continue
        roofed = _is_roofed(o.height, int(v), int(u), z + ROOF_MARGINS * slack)
        for entry in range(start[i], start[i + 1]):
            c = camera[entry]
            du, dv = (centres[c, 0] - xyz[i, 0]) / o.cell_m, (centres[c, 1] - xyz[i, 1]) / o.cell_m
            up, run = centres[c, 2] - z, np.sqrt(du * du + dv * dv)
            if up <= 0.0:
                continue
            if run < _ONWARD:
                found[entry] = roofed
                continue
            du, dv, rise = du / run, dv / run, up / run
            first, pierces = NEAR_CELLS, False
            if roofed:
                first, pierces = _through_roof(o, u, v, z, du, dv, rise, run, slack)
            found[entry] = pierces or _meets(o, u, v, z + slack, du, dv, rise, run, first)


@device
def _inside(height: Heights, u: float, v: float) -> bool:
    return 0.0 <= u < height.shape[1] and 0.0 <= v < height.shape[0]


@device
def _is_roofed(height: Heights, row: int, column: int, z: float) -> bool:
    """Whether all cells as near as is not tested stand above z."""
    if not height[row, column] > z:
        return False
    reach = int(NEAR_CELLS)
    if not (reach <= row < height.shape[0] - reach and reach <= column < height.shape[1] - reach):
        return False
    for r in range(row - reach, row + reach + 1):
        for c in range(column - reach, column + reach + 1):
            if not height[r, c] > z:  # nor where it is not known
                return False
    return True


@device
def _to_edge(x: float, dx: float, side: int) -> float:
    """Return how far the ray goes until it leaves its block along one axis."""
    if dx == 0.0:
        return np.inf
    edge = np.floor(x / side) * side + (side if dx > 0.0 else 0)
    return (edge - x) / dx


@device
def _meets(
    o: Occluder, u: float, v: float, z: float, du: float, dv: float, rise: float, run: float,
    first: float,
) -> bool:  # fmt: skip
    """Whether the ray leaves some cell below its height, from `first` cells on."""
    t = first
    while t < run:
        x, y, low = u + t * du, v + t * dv, z + t * rise
        if low >= o.highest_m or not _inside(o.height, x, y):
            return False
        row, column = int(y), int(x)
        side = 1
        if low >= o.large_block_top[row // LARGE_BLOCK, column // LARGE_BLOCK]:
            side = LARGE_BLOCK
        elif low >= o.block_top[row // BLOCK, column // BLOCK]:
            side = BLOCK
        t = min(t + min(_to_edge(x, du, side), _to_edge(y, dv, side)), run)
        if side == 1 and z + t * rise < o.height[row, column]:
            return True
        t += _ONWARD
    return False


@device
def _through_roof(
    o: Occluder, u: float, v: float, z: float, du: float, dv: float, rise: float, run: float,
    slack: float,
) -> tuple[float, bool]:  # fmt: skip
    """Return how far the ray goes below a roof, and whether it goes through it.

    It does where the surface is left behind in a cell, or falls below the ray from one cell to
    the next by less than the margin; at the edge of the roof it falls by more.
    """
    t = 0.0
    while t < run:
        x, y, low = u + t * du, v + t * dv, z + t * rise
        if not _inside(o.height, x, y):
            break
        top = o.height[int(y), int(x)]
        if top <= low:
            return t, low - top < slack
        t = min(t + min(_to_edge(x, du, 1), _to_edge(y, dv, 1)), run)
        if top <= z + t * rise:
            return t, True
        t += _ONWARD
    return t, False

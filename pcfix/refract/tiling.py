"""Tiles of neighbouring points, and the cameras whose frames may hold one of them.

Points are worked on a tile at a time, so that few cameras need to be looked at, and the processor
works on several points at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.kernels import device, kernel
from pcfix.lens.algebra import normal_of
from pcfix.lens.frames import (
    ALL,
    NOT_DISTORTED,
    NOTHING,
    SOME,
    Frames,
    judge,
    mark,
    mark_pyramid,
    may_hold,
    pyramid,
)
from pcfix.model import FloatArray, IntArray
from pcfix.refract.batch import Batch

TILE = 128
"""Points of a tile: its sums (11 numbers a point) stay in the processor's first cache."""


class Points(NamedTuple):
    """Points and the water above them, for kernels; see `Batch`.

    `order` brings neighbours together.
    """

    order: IntArray
    xyz: FloatArray
    height: FloatArray
    slope: FloatArray


def points_of(batch: Batch) -> Points:
    """Return the points of a batch for kernels."""
    return Points(
        spatial_order(batch.xyz),
        np.ascontiguousarray(batch.xyz),
        np.ascontiguousarray(batch.surface.height_m),
        np.ascontiguousarray(batch.surface.slope),
    )


def tiles_of(batch: Batch) -> int:
    """Return how many tiles of neighbours the points of a batch fill."""
    return (len(batch) + TILE - 1) // TILE


def spatial_order(xyz: FloatArray) -> IntArray:
    """Return an order that brings neighbours together, about `TILE` points to a cell.

    Only speed depends on it: a tile of neighbours needs few cameras.
    """
    if len(xyz) <= TILE:
        return np.arange(len(xyz))
    x, y = xyz[:, 0], xyz[:, 1]
    width, height = max(np.ptp(x), 1e-6), max(np.ptp(y), 1e-6)
    cells = min(len(xyz) / TILE, 2.0**14)
    cell_m = max(np.sqrt(width * height / cells), max(width, height) / cells)
    columns, rows = int(width / cell_m) + 1, int(height / cell_m) + 1
    return _cell_order(xyz, x.min(), y.min(), 1.0 / cell_m, columns, rows)


@kernel(allocates=True)
def _cell_order(
    xyz: FloatArray, x0: float, y0: float, cells_per_m: float, columns: int, rows: int
) -> IntArray:
    """Sort by cells, row after row to and fro, with one count and one pass over the points."""
    cell = np.empty(len(xyz), np.int64)
    place = np.zeros(columns * rows + 1, np.int64)
    for i in range(len(xyz)):
        column = min(int((xyz[i, 0] - x0) * cells_per_m), columns - 1)
        row = min(int((xyz[i, 1] - y0) * cells_per_m), rows - 1)
        cell[i] = row * columns + (columns - 1 - column if row & 1 else column)
        place[cell[i] + 1] += 1
    for c in range(columns * rows):
        place[c + 1] += place[c]
    order = np.empty(len(xyz), np.int64)
    for i in range(len(xyz)):
        order[place[cell[i]]] = i
        place[cell[i]] += 1
    return order


@device(allocates=True)
def gather(tile: FloatArray, rows: IntArray, points: Points) -> tuple[FloatArray, FloatArray]:
    """Bring a tile together: runs of x, y, z, surface height and unit normal; return its box."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for j in range(rows.size):
        i = rows[j]
        for axis in range(3):
            value = points.xyz[i, axis]
            tile[axis * TILE + j] = value
            low[axis], high[axis] = min(low[axis], value), max(high[axis], value)
        x, y, z = normal_of(points.slope[i, 0], points.slope[i, 1])
        tile[3 * TILE + j] = points.height[i]
        tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j] = x, y, z
    return low, high


@device(allocates=True)
def cameras_around(
    frames: Frames, centres: FloatArray, low: FloatArray, high: FloatArray
) -> IntArray:
    """Return the cameras whose pyramids may hold a point of the box of many tiles."""
    around = np.empty(len(centres), np.int64)
    count = 0
    for c in range(len(centres)):
        if may_hold(frames.planes[c], centres[c], low, high):
            around[count] = c
            count += 1
    return around[:count]


@device(allocates=True)
def corners_of(rows: IntArray, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the corners of an upright box around some points."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in rows:
        for axis in range(3):
            value = xyz[i, axis]
            low[axis], high[axis] = min(low[axis], value), max(high[axis], value)
    return low, high


@device(allocates=True)
def near_cameras(
    around: IntArray, frames: Frames, centres: FloatArray, low: FloatArray, high: FloatArray
) -> IntArray:
    """Return those of some cameras whose frames may hold a point of the box."""
    planes, row = frames.planes, frames.row
    near = np.empty(len(around), np.int64)
    count = 0
    for c in around:
        if not may_hold(planes[c], centres[c], low, high):
            continue
        if row[c] == NOT_DISTORTED or judge(frames, c, centres[c], low, high) != NOTHING:
            near[count] = c
            count += 1
    return near[:count]


@device
def mark_camera(
    marks: FloatArray, tile: FloatArray, frames: Frames, c: int, centre: FloatArray,
    low: FloatArray, high: FloatArray,
) -> bool:  # fmt: skip
    """Mark the points of a tile that lie in the frame of camera c; return whether any may."""
    x, y, z = (
        tile[: marks.size],
        tile[TILE : TILE + marks.size],
        tile[2 * TILE : 2 * TILE + marks.size],
    )
    if frames.row[c] == NOT_DISTORTED:
        mark_pyramid(marks, x, y, z, centre, pyramid(frames.planes[c]))
        return True
    held = judge(frames, c, centre, low, high)
    if held == ALL:
        marks[:] = 1.0
    if held != SOME:
        return bool(held != NOTHING)
    return bool(mark(marks, x, y, z, centre, frames, c) > 0)


@device(allocates=True)
def marks_of_lists(
    start: IntArray, camera: IntArray, rows: IntArray, k: int
) -> tuple[IntArray, FloatArray]:
    """Return which of k cameras lists name for some points, and how often for each, in order."""
    place = np.zeros(k, np.int64)
    for i in rows:
        for at in range(start[i], start[i + 1]):
            place[camera[at]] = 1
    named = np.flatnonzero(place)
    place[named] = np.arange(named.size)
    marks = np.zeros((named.size, rows.size))
    for j in range(rows.size):
        for at in range(start[rows[j]], start[rows[j] + 1]):
            marks[place[camera[at]], j] += 1.0
    return named, marks


@device(allocates=True)
def marks_in_frame(
    around: IntArray, tile: FloatArray, frames: Frames, centres: FloatArray, low: FloatArray,
    high: FloatArray, count: int,
) -> tuple[IntArray, FloatArray]:  # fmt: skip
    """Return which of some cameras hold points of a tile in their frames, and the marks of these.

    The tile has so many points, within a box.
    """
    near = near_cameras(around, frames, centres, low, high)
    marks = np.empty((near.size, count))
    seeing = 0
    for c in near:
        if mark_camera(marks[seeing], tile, frames, c, centres[c], low, high):
            near[seeing] = c
            seeing += 1
    return near[:seeing], marks[:seeing]

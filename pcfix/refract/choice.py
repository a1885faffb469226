"""Which cameras give a ray to each point: all in whose frame it lies, or those of a list.

Points are worked on in tiles of neighbours, so that a tile needs to look at few cameras only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from pcfix.lens.frames import (
    NOT_DISTORTED,
    NOTHING,
    frames_of,
    holds,
    judge,
    may_hold,
    no_frames,
)
from pcfix.model import Views, WaterMesh, WaterRaster
from pcfix.refract.piercing import pierce_mesh, pierce_raster
from pcfix.threads import one_caller
from pcfix.water.surface import build_field, build_tin, locate

if TYPE_CHECKING:
    from pcfix.lens.frames import Frames
    from pcfix.model import Cameras, FloatArray, IntArray, WaterSurface
    from pcfix.options import Settings
    from pcfix.water.surface import Field, SurfaceAbove, Tin

TILE = 128
"""Points of a tile: its sums (11 numbers a point) stay in the processor's first cache."""


ANY_NUMBER = 2**31
"""A list may name a camera twice, so that there can be more entries than cameras."""


def chosen_views(
    xyz: FloatArray,
    surface: SurfaceAbove,
    water: WaterSurface,
    cameras: Cameras,
    settings: Settings,
    views: Views | None = None,
    level_offset_m: FloatArray | None = None,
) -> Views:
    """Return the cameras whose rays each point gets, as a list.

    Parameters
    ----------
    xyz, surface, water, cameras, settings, views, level_offset_m
        As of `pcfix.refract.intersect.intersect`.

    Returns
    -------
    Views
        In the order of the cameras, or of `views`; its weights are kept.
    """
    order = spatial_order(xyz)
    tiles = (len(xyz) + TILE - 1) // TILE
    count = np.zeros(len(xyz) + 1, np.int64)
    entries = None if views is None else (views.start, views.camera)
    common = (
        order,
        np.ascontiguousarray(xyz),
        np.ascontiguousarray(surface.height_m),
        np.ascontiguousarray(surface.slope),
        np.ascontiguousarray(cameras.centres),
        np.zeros(len(cameras)) if level_offset_m is None else level_offset_m,
        frames_of(cameras) if views is None else no_frames(len(cameras)),
        least_cosine2(settings, cameras),
        settings.max_cameras or ANY_NUMBER,
        tiles,
        build_tin(water) if isinstance(water, WaterMesh) else None,
        build_field(water) if isinstance(water, WaterRaster) else None,
        entries,
    )
    with one_caller():
        _list_cameras(*common, count, np.zeros(0, np.int64), False)
        start = np.cumsum(count)
        place = np.empty(start[-1], np.int64)
        _list_cameras(*common, start, place, True)
    if views is None:
        return Views(start, place)
    weight = None if views.weight is None else views.weight[place]
    return Views(start, np.asarray(views.camera)[place], weight, views.kind)


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _list_cameras(
    order: IntArray, xyz: FloatArray, surface: FloatArray, slope: FloatArray,
    centres: FloatArray, offset: FloatArray, frames: Frames, least_cosine2: float, most: int,
    tiles: int, tin: Tin | None, field: Field | None, views: tuple[IntArray, IntArray] | None,
    start: IntArray, place: IntArray, fill: bool,
) -> None:  # fmt: skip
    """Count the cameras of point i into ``start[i + 1]``, or fill their places from ``start[i]``.

    A place is the number of a camera, or that of an entry of the views.
    """
    for t in prange(tiles):
        rows = order[t * TILE : (t + 1) * TILE]
        tile = np.empty(7 * TILE)
        low, high = gather(tile, rows, xyz, surface, slope)
        near = near_cameras(frames, centres, low, high)
        for j in range(rows.size):
            i = rows[j]
            facet = -1 if tin is None else locate(tin, tile[j], tile[TILE + j])
            candidates, first = near, 0
            if views is not None:
                first = views[0][i]
                candidates = views[1][first : views[0][i + 1]].astype(np.int64)
            kept = choose(
                candidates, tile, j, centres, offset, frames, least_cosine2, most, tin, field, facet
            )
            if not fill:
                start[i + 1] = kept.size
            for k in range(kept.size if fill else 0):
                at = kept[k]
                place[start[i] + k] = first + at if views is not None else candidates[at]


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


@njit(cache=True, error_model="numpy", nogil=True)
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


MAX_ANGLE_WITHOUT_FRAMES_DEG = 80.0
"""Cameras without a lens have no frame to leave; nobody matches images as flat as this, and a
block in another CRS is told apart."""


def least_cosine2(settings: Settings, cameras: Cameras) -> float:
    """Return the square of the cosine of the largest incidence angle."""
    limit = settings.max_angle_deg
    if limit is None and cameras.lenses is None:
        limit = MAX_ANGLE_WITHOUT_FRAMES_DEG
    return 0.0 if limit is None else float(np.cos(np.radians(limit)) ** 2)


@njit(cache=True, error_model="numpy", nogil=True)
def gather(
    tile: FloatArray, order: IntArray, xyz: FloatArray, surface: FloatArray, slope: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Bring a tile together: runs of x, y, z, surface height and unit normal; return its box."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for j in range(order.size):
        i = order[j]
        for axis in range(3):
            value = xyz[i, axis]
            tile[axis * TILE + j] = value
            low[axis], high[axis] = min(low[axis], value), max(high[axis], value)
        b, c = slope[i, 0], slope[i, 1]
        up = 1.0 / np.sqrt(1.0 + b * b + c * c)
        tile[3 * TILE + j] = surface[i]
        tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j] = -b * up, -c * up, up
    return low, high


@njit(cache=True, error_model="numpy", nogil=True)
def _keep_steepest(chosen: IntArray, cosine2: FloatArray, k: int, most: int) -> int:
    """Bring the `most` steepest of k cameras to the front, in the order of the cameras."""
    if k <= most:
        return k
    ranked = np.argsort(-cosine2[:k], kind="mergesort")[:most]
    ranked.sort()
    for j in range(most):
        chosen[j] = chosen[ranked[j]]
    return most


@njit(cache=True, error_model="numpy", nogil=True)
def near_cameras(
    frames: Frames, centres: FloatArray, low: FloatArray, high: FloatArray
) -> IntArray:
    """Return the cameras whose frames may hold a point of the box."""
    planes, row = frames.planes, frames.row
    near = np.empty(len(centres), np.int64)
    count = 0
    for c in range(len(centres)):
        if not may_hold(planes[c], centres[c], low, high):
            continue
        if row[c] == NOT_DISTORTED or judge(frames, c, centres[c], low, high) != NOTHING:
            near[count] = c
            count += 1
    return near[:count]


@njit(cache=True, error_model="numpy", nogil=True)
def choose(
    candidates: IntArray, tile: FloatArray, j: int, centres: FloatArray, offset: FloatArray,
    frames: Frames, least_cosine2: float, most: int,
    tin: Tin | None, field: Field | None, facet: int,
) -> IntArray:  # fmt: skip
    """Return which of the candidates give a ray to a point of the tile, in their order.

    On a mesh or raster the incidence angle is that where the ray pierces it.
    """
    chosen = np.empty(candidates.size, np.int64)
    cosine2 = np.empty(candidates.size)
    some_only = least_cosine2 > 0.0 or most < candidates.size
    k = 0
    for at in range(candidates.size):
        c = candidates[at]
        px, py, pz = tile[j], tile[TILE + j], tile[2 * TILE + j]
        ex, ey, ez = centres[c, 0] - px, centres[c, 1] - py, centres[c, 2] - pz
        nx, ny, nz = tile[4 * TILE + j], tile[5 * TILE + j], tile[6 * TILE + j]
        lowered = pz - offset[c]
        h = nz * (tile[3 * TILE + j] - lowered)
        height = nx * ex + ny * ey + nz * ez
        length2 = ex * ex + ey * ey + ez * ez
        if not (height > h and holds(frames, c, ex, ey, ez)):
            continue
        if h > 0.0 and some_only and (tin is not None or field is not None):
            if tin is not None:
                _, nx, ny, nz = pierce_mesh(tin, px, py, lowered, ex, ey, ez, facet)
            if field is not None:
                _, nx, ny, nz = pierce_raster(field, px, py, lowered, ex, ey, ez, h, nx, ny, nz)
            height = max(nx * ex + ny * ey + nz * ez, 0.0)
        if height * height >= least_cosine2 * length2:
            chosen[k], cosine2[k] = at, height * height / length2
            k += 1
    return chosen[: _keep_steepest(chosen, cosine2, k, most)]

"""Heights of cells: statistics of their points, and Delaunay triangles.

A triangle is Delaunay's if no point is inside the circle through its corners. If circles wider than
a limit are ignored, only points within that limit of a cell decide on it: a part of the raster,
triangulated with such a margin, gets the same triangles as the whole. Where four points are on one
circle, as in a regular grid, there are two answers. So the triangles (not the heights) are chosen
by positions that are displaced a little, always the same way for the same point.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from scipy.spatial import Delaunay, QhullError

from pcfix.grid.lattice import Lattice, Window
from pcfix.model import FloatArray, IntArray
from pcfix.options.steps import DsmMethod
from pcfix.running import current


def grid_window(
    points: FloatArray, window: Window, lattice: Lattice, method: DsmMethod, reach: float,
    spacing: float,
) -> tuple[FloatArray, IntArray, FloatArray]:  # fmt: skip
    """Return height, number of points and spread of the cells of a part of a raster.

    Points, shape (n, 3), are all that decide on it, or more: x and y, world frame, metres, and the
    height or another quantity. `reach`, the diameter of the widest circle around a triangle of the
    TIN, and `spacing` of the points are in cells. The bands have the
    shape of the window, NaN if unknown.
    """
    shape = window.height, window.width
    column, row = (lattice.cells(points) - (window.column, window.row)).T
    inner = (column >= 0) & (column < window.width) & (row >= 0) & (row < window.height)
    code = row[inner] * window.width + column[inner]
    cells = cell_statistics(code, points[inner, 2], window.height * window.width)
    if method == "tin":
        away = np.column_stack([points[:, 0] - lattice.left_m, lattice.top_m - points[:, 1]])
        height = triangulated(away / lattice.resolution_m, points[:, 2], window, reach, spacing)
    else:
        height = cells[method]
    counts, spread = cells["points"].reshape(shape), cells["spread"].reshape(shape)
    return height.reshape(shape), counts, spread


def cell_statistics(cell: IntArray, z: FloatArray, size: int) -> dict[str, Any]:
    """Return statistics of `size` cells, from the cell and height of each point, shape (k,).

    They are points (the number), mean, median, min, max and spread, NaN without points. Heights are
    summed in ascending order, as differences from the lowest of their cell, so that the result
    does not depend on the order of the points or the vertical datum. `spread` is the population
    standard deviation of the heights: 0 in a cell with one point.
    """
    order = np.lexsort((z, cell))
    z, count = z[order], np.bincount(cell, minlength=size)
    filled = np.flatnonzero(count)
    n = count[filled]
    first = np.cumsum(n) - n
    low = z[first]
    above = z - np.repeat(low, n)
    offset = np.add.reduceat(above, first) / n
    scatter = np.sqrt(np.add.reduceat((above - np.repeat(offset, n)) ** 2, first) / n)
    median = (z[first + (n - 1) // 2] + z[first + n // 2]) / 2.0
    statistics = np.full((5, size), np.nan)
    statistics[:, filled] = low + offset, median, low, z[first + n - 1], scatter
    names = ("mean", "median", "min", "max", "spread")
    return {"points": count, **dict(zip(names, statistics, strict=True))}


_MIX = np.array([0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB], np.uint64)


def triangulated(
    position: FloatArray, z: FloatArray, window: Window, widest: float, spacing: float
) -> FloatArray:
    """Return the height (m) of the triangle above each centre of a window; NaN outside all.

    `position`, shape (n, 2), are columns and rows, in cells from the top left corner of the raster,
    of at least the points within `widest` of the window; `z`, shape (n,), their heights (m). Of
    several points at one place the mean height is used. `widest` is the diameter of the widest
    circle around a triangle and `spacing` a usual distance between points, cells.
    """
    out = np.full(window.height * window.width, np.nan)
    position, z = _one_a_place(position, z)
    moved = position + 1e-4 * spacing * _offsets(position)  # for the choice of triangles
    row, column = np.divmod(np.arange(out.size), window.width)
    centre = np.column_stack([column + window.column, row + window.row]) + 0.5
    origin = np.floor(moved.mean(axis=0)) if len(moved) else 0.0
    try:
        mesh = Delaunay(moved - origin)
    except (QhullError, ValueError):  # fewer than three points, or all on one line
        return out.reshape(window.height, window.width)
    found = mesh.find_simplex(centre - origin, tol=1e-9)  # a centre on an edge is on both sides
    corners = np.sort(mesh.simplices[found], axis=1)
    # the radius of the circle through three points is a b c / 4 area
    a, b, c = np.moveaxis(moved[corners], 1, 0)
    ab, ac, bc = (((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (a, c), (b, c)))
    circle = ab * ac * bc / (4.0 * _cross(b - a, c - a) ** 2)
    # the displaced positions choose the triangle, the true ones give the height
    inside = (found >= 0) & (circle <= (widest / 2.0) ** 2)
    corners, centre = corners[inside], centre[inside]
    a, b, c = np.moveaxis(position[corners], 1, 0)
    area = _cross(b - a, c - a)
    s, u = _cross(centre - a, c - a) / area, _cross(b - a, centre - a) / area
    i, j, k = z[corners].T
    out[inside] = i + s * (j - i) + u * (k - i)
    return out.reshape(window.height, window.width)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross product of vectors in plan, shape (n, 2)."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _one_a_place(position: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points sorted by column and row, each place once, with the mean of its heights."""
    order = np.lexsort((position[:, 1], position[:, 0]))
    position, z = position[order], z[order]
    new = np.ones(len(z), bool)
    new[1:] = (position[1:] != position[:-1]).any(axis=1)
    if new.all():
        return position, z
    return position[new], cell_statistics(np.cumsum(new) - 1, z, int(new.sum()))["mean"]


def _offsets(position: FloatArray) -> FloatArray:
    """Return pseudo-random numbers from -0.5 to 0.5 that only depend on the position.

    They are hashes of the bits of the coordinates, by D. Lea and G. Steele's SplitMix.
    """
    bits = np.ascontiguousarray(position + 0.0).view(np.uint64)
    mixed = bits[:, :1] * _MIX[0] + bits[:, 1:] + _MIX[:2] * np.arange(1, 3, dtype=np.uint64)
    for shift, factor in ((30, _MIX[1]), (27, _MIX[2])):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * factor
    mixed ^= mixed >> np.uint64(31)
    return np.asarray((mixed >> np.uint64(11)) / 2.0**53 - 0.5)


SLACK_CELLS = 1.5
"""Rims k + 1 cells apart enclose k empty ones; circles through their corners are a bit wider."""


def margin_cells(widest: float) -> int:
    """Return the number of cells around a part of a raster that decide on its holes."""
    return int(np.ceil(widest + SLACK_CELLS)) + 2


def fill_holes(height: FloatArray, window: Window, around: Window, widest: float) -> FloatArray:
    """Return the heights of a window with its narrow holes filled.

    The centres of the cells at the rims of holes are triangulated; triangles whose circle is wider
    than `widest`, in cells, are ignored. So narrow parts of wide holes, and narrow bays at the edge
    of the survey, are filled too. `around`, the shape of the heights (metres, NaN if unknown), is
    the window with `margin_cells` of margin, as far as the raster reaches.
    """
    from scipy.ndimage import binary_erosion

    margin = margin_cells(widest)
    side = max(64, 8 * margin)  # small triangulations take half the time per point
    filled = np.empty((window.height, window.width))

    def fill(part: Window) -> None:
        """Fill the holes of a part of the window."""
        about = part.grown(margin).clipped(around)
        near = height[about.within(around)]
        inner, known = near[part.within(about)], ~np.isnan(near)
        if known.any() and np.isnan(inner).any():
            inside = binary_erosion(known, np.ones((3, 3), np.bool_))  # with eight known neighbours
            row, column = np.nonzero(known & ~inside)
            position = np.column_stack([column + about.column + 0.5, row + about.row + 0.5])
            surface = triangulated(position, near[row, column], part, widest + SLACK_CELLS, 1.0)
            inner = np.where(np.isnan(inner), surface, inner)
        filled[part.within(window)] = inner

    with ThreadPoolExecutor(current().threads) as pool:
        list(pool.map(fill, window.parts(side)))
    return filled

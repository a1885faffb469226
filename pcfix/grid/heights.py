"""Compute one height for each cell from the points in and around it."""

from __future__ import annotations

from typing import Any

import numpy as np

from pcfix.grid.delaunay import triangulated
from pcfix.grid.lattice import Lattice, Window
from pcfix.model import FloatArray, IntArray
from pcfix.options.steps import DsmMethod


def grid_window(
    points: FloatArray, window: Window, lattice: Lattice, method: DsmMethod, reach: float,
    spacing: float,
) -> tuple[FloatArray, IntArray, FloatArray]:  # fmt: skip
    """Return height, number of points and spread of the cells of a part of a raster.

    Points, shape (n, 3), are all that decide on it, or more: x and y, world frame, metres, and the
    height or another quantity. `reach`, the diameter of the widest circle around a triangle of the
    TIN, and `spacing` of the points (see `pcfix.grid.lattice.spacing_m`) are in cells. The bands
    have the shape of the window, NaN if unknown.
    """
    cell, position = lattice.cells(points), lattice.positions(points)
    inner, shape = window.holds(cell), (window.height, window.width)
    code = (cell[inner, 1] - window.row) * window.width + cell[inner, 0] - window.column
    cells = cell_statistics(code, points[inner, 2], window.height * window.width)
    match method:
        case "tin":
            height = triangulated(position, points[:, 2], window, reach, spacing)
        case "idw":
            height = inverse_distance(position, cell, points[:, 2], window)
            height[cells["points"] == 0] = np.nan
        case _:
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
    whole = np.full((5, size), np.nan)
    whole[:, filled] = low + offset, median, low, z[first + n - 1], scatter
    names = ("mean", "median", "min", "max", "spread")
    return {"points": count, **dict(zip(names, whole, strict=True))}


REACH_CELLS = 2.0**0.5
"""Points up to this distance from a centre count; they lie in its cell and the eight around it."""
NEAREST_CELLS = 1e-4
"""Least distance of a point from a centre for its weight."""


def inverse_distance(
    position: FloatArray, cell: IntArray, z: FloatArray, window: Window
) -> FloatArray:
    """Return the mean of the heights around each centre, weighted with 1 / distance squared.

    Points farther than `REACH_CELLS` do not count; they cover the window with a margin of a cell.
    """
    order = np.lexsort((z, cell[:, 0], cell[:, 1]))  # sums that do not depend on their order
    position, cell, z = position[order], cell[order], z[order]
    cells = window.height * window.width
    weights, total = np.zeros(cells), np.zeros(cells)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):  # each point counts for its cell and those around it
            near = cell + np.array([right, down])
            square = ((near + 0.5 - position) ** 2).sum(axis=1)
            rows = window.holds(near) & (square <= REACH_CELLS * REACH_CELLS)
            to = (near[rows, 1] - window.row) * window.width + near[rows, 0] - window.column
            weight = 1.0 / np.maximum(square[rows], NEAREST_CELLS * NEAREST_CELLS)
            weights += np.bincount(to, weight, cells)
            total += np.bincount(to, weight * z[rows], cells)
    return np.asarray(total / np.where(weights > 0.0, weights, 1.0))

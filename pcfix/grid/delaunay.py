"""Heights from the Delaunay triangles of points: at the centres of cells, and over holes.

A triangle is Delaunay's if no point lies inside the circle through its corners. So only the
points in that circle decide on it, and if circles wider than a limit are left out, then all that
decides on a cell lies within that limit of it: a part of the raster, triangulated with such a
margin of points around it, gets the very triangles that the whole would have. Where four points lie
on one circle, as those of a regular grid do, there are two answers. So that every part of a raster
takes the same one, the choice of triangles (not the heights) is made from positions that are moved
a little, always the same way for the same point.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.spatial import Delaunay, QhullError

from pcfix.grid.lattice import Window
from pcfix.kernels import cores, device, kernel
from pcfix.model import BoolArray, FloatArray, IntArray

MOVED = 1e-4
"""Of the spacing of the points: how far one is moved for the choice of triangles."""
ON_EDGE = 1e-9  # of a barycentric coordinate: a centre on an edge belongs to both sides
_MIX = np.array([0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB], np.uint64)


def triangulated(
    position: FloatArray, z: FloatArray, window: Window, widest: float, spacing: float
) -> FloatArray:
    """Return the height of the triangle above each centre.

    Parameters
    ----------
    position : array, shape (n, 2)
        Columns and rows, in cells from the top left corner of the raster, of at least the points
        within `widest` of the window. Where several share a place, their mean height counts.
    z : array, shape (n,)
        Heights, metres.
    window : Window
    widest : float
        Diameter of the widest circle around a triangle, cells.
    spacing : float
        A usual distance between points, cells.

    Returns
    -------
    array, shape (window.height, window.width)
        Metres; NaN where no triangle is.
    """
    out = np.full((window.height, window.width), np.nan)
    position, z = _one_a_place(position, z)
    moved = position + MOVED * spacing * _offsets(position)
    triangles = _triangles(moved)
    _draw(position, moved, z, triangles, (widest / 2.0) ** 2, window.row, window.column, out)
    return out


def _one_a_place(position: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points by column, then row, each place once, with the mean of its heights."""
    order = np.lexsort((z, position[:, 1], position[:, 0]))
    position, z = position[order], z[order]
    new = np.ones(len(z), bool)
    new[1:] = (position[1:] != position[:-1]).any(axis=1)
    if new.all():
        return position, z
    first = np.flatnonzero(new)
    n = np.diff(first, append=len(z))
    mean = z[first] + np.add.reduceat(z - np.repeat(z[first], n), first) / n
    return position[first], mean


def _offsets(position: FloatArray) -> FloatArray:
    """Return numbers from -0.5 to 0.5 that look random and depend on the position alone.

    They are hashes of the bits of the coordinates, mixed as in D. Lea and G. Steele's SplitMix.
    """
    bits = np.ascontiguousarray(position + 0.0).view(np.uint64)
    mixed = bits[:, :1] * _MIX[0] + bits[:, 1:] + _MIX[:2] * np.arange(1, 3, dtype=np.uint64)
    for shift, factor in ((30, _MIX[1]), (27, _MIX[2])):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * factor
    mixed ^= mixed >> np.uint64(31)
    return np.asarray((mixed >> np.uint64(11)) / 2.0**53 - 0.5)


def _triangles(position: FloatArray) -> IntArray:
    """Return the corners of each triangle, shape (t, 3), in an order that only they decide."""
    if len(position) < 3:
        return np.empty((0, 3), np.int64)
    try:
        found = Delaunay(position - np.floor(position.mean(axis=0))).simplices
    except QhullError:  # all on one line
        return np.empty((0, 3), np.int64)
    corners = np.sort(found.astype(np.int64), axis=1)
    return corners[np.lexsort(corners.T[::-1])]


@kernel(allocates=True)
def _draw(
    position: FloatArray,
    moved: FloatArray,
    z: FloatArray,
    triangles: IntArray,
    square_limit: float,
    row_first: int,
    column_first: int,
    out: FloatArray,
) -> None:
    """Write the height of each centre; of two triangles that share it the first one counts.

    The moved positions say which triangle a centre is in, the true ones how high it lies.
    """
    height, width = out.shape
    for t in range(len(triangles)):
        i, j, k = triangles[t]
        if not _square_radius(moved[i], moved[j], moved[k]) <= square_limit:
            continue
        low, high = np.minimum(moved[i], moved[j]), np.maximum(moved[i], moved[j])
        low, high = np.minimum(low, moved[k]), np.maximum(high, moved[k])
        column_stop = min(int(np.floor(high[0] - 0.5)) - column_first + 2, width)
        row_stop = min(int(np.floor(high[1] - 0.5)) - row_first + 2, height)
        for row in range(max(int(np.floor(low[1] - 0.5)) - row_first, 0), row_stop):
            for column in range(max(int(np.floor(low[0] - 0.5)) - column_first, 0), column_stop):
                if not np.isnan(out[row, column]):
                    continue
                x, y = column_first + column + 0.5, row_first + row + 0.5
                s, u = _shares(moved[i], moved[j], moved[k], x, y)
                if s >= -ON_EDGE and u >= -ON_EDGE and s + u <= 1.0 + ON_EDGE:
                    s, u = _shares(position[i], position[j], position[k], x, y)
                    out[row, column] = z[i] + s * (z[j] - z[i]) + u * (z[k] - z[i])


@device
def _shares(a: FloatArray, b: FloatArray, c: FloatArray, x: float, y: float) -> tuple[float, float]:
    """Return the barycentric coordinates of a place that belong to the corners b and c."""
    bx, by, cx, cy = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
    px, py = x - a[0], y - a[1]
    area = bx * cy - by * cx
    return (px * cy - py * cx) / area, (bx * py - by * px) / area


@device
def _square_radius(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
    """Return the square of the radius of the circle through three points, a b c / 4 area."""
    bx, by, cx, cy = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
    ab, ac = bx * bx + by * by, cx * cx + cy * cy
    bc = (cx - bx) ** 2 + (cy - by) ** 2
    return float(ab * ac * bc / (4.0 * (bx * cy - by * cx) ** 2))


SLACK_CELLS = 1.5
"""Rims k + 1 cells apart enclose k empty ones; corners of the rims make circles a bit wider."""


def margin_cells(widest: float) -> int:
    """Return how many cells around a part of a raster decide on the holes in it."""
    return int(np.ceil(widest + SLACK_CELLS)) + 2


def fill_holes(height: FloatArray, window: Window, around: Window, widest: float) -> FloatArray:
    """Return the heights of a window with its narrow holes filled.

    The centres of the cells at the rims of holes are triangulated; triangles whose circle is
    wider than the hole may be are left out. So the narrow parts of wide holes, and narrow bays in
    the edge of the survey, are filled, too.

    Parameters
    ----------
    height : array, shape (around.height, around.width)
        Metres, NaN where nothing is known.
    window, around : Window
        `around` is the window with `margin_cells` of margin, as far as the raster reaches.
    widest : float
        Width of the widest hole to fill, cells.

    Returns
    -------
    array, shape (window.height, window.width)
    """
    margin = margin_cells(widest)
    side = max(PART_CELLS, PART_MARGINS * margin)
    filled = np.empty((window.height, window.width))

    def fill(part: Window) -> None:
        about = part.grown(margin).clipped(around)
        filled[part.within(window)] = _filled(height[about.within(around)], part, about, widest)

    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(fill, window.parts(side)))
    return filled


PART_CELLS, PART_MARGINS = 64, 8
"""Side of what is triangulated at once, cells: a few thousand points take half the time each."""


def _filled(height: FloatArray, window: Window, around: Window, widest: float) -> FloatArray:
    inner = np.array(height[window.within(around)])
    known = ~np.isnan(height)
    if known[window.within(around)].all() or not known.any():
        return inner
    row, column = np.nonzero(known & ~_surrounded(known))
    position = np.column_stack([column + around.column + 0.5, row + around.row + 0.5])
    surface = triangulated(position, height[row, column], window, widest + SLACK_CELLS, 1.0)
    empty = np.isnan(inner)
    inner[empty] = surface[empty]
    return inner


def _surrounded(known: BoolArray) -> BoolArray:
    """Return which cells have eight neighbours that are known, too."""
    padded = np.pad(known, 1)
    rows, columns = known.shape
    shifts = [(r, c) for r in range(3) for c in range(3)]
    around = [padded[r : r + rows, c : c + columns] for r, c in shifts]
    return np.asarray(np.logical_and.reduce(around))

"""The cells of a raster, squares whose edges are multiples of the resolution, and their heights.

The height of a cell is a statistic of its points, or that of the Delaunay triangle above its
centre. There a plan position is given in cells from the top left corner of the raster: columns to
the right, rows downwards, so that the centre of the first cell is (0.5, 0.5).
"""

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import SettingError
from pcfix.model import FloatArray, IntArray
from pcfix.options.steps import MIN_RESOLUTION_M, DsmMethod
from pcfix.running import current

MAX_CELLS = 1_000_000_000
EDGE_M = 1e-7  # tolerance of points on an edge: 5432000.1 / 0.1 in floating point may be too small


class Window(NamedTuple):
    """A rectangle of cells; the stops are not part of it."""

    row: int
    row_stop: int
    column: int
    column_stop: int

    @property
    def height(self) -> int:
        """Number of rows."""
        return self.row_stop - self.row

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.column_stop - self.column

    def grown(self, cells: int) -> "Window":
        """Return the window with a margin on each side, which may extend beyond the raster."""
        return Window(
            self.row - cells, self.row_stop + cells, self.column - cells, self.column_stop + cells
        )

    def parts(self, side: int) -> "Iterator[Window]":
        """Yield squares of `side` cells that cover the window, row by row."""
        for row in range(self.row, self.row_stop, side):
            for column in range(self.column, self.column_stop, side):
                yield Window(row, row + side, column, column + side).clipped(self)

    def clipped(self, other: "Window") -> "Window":
        """Return the intersection with another window."""
        return Window(
            max(self.row, other.row), min(self.row_stop, other.row_stop),
            max(self.column, other.column), min(self.column_stop, other.column_stop),
        )  # fmt: skip

    def within(self, other: "Window") -> tuple[slice, slice]:
        """Return the rows and columns of this window in an array that covers `other`."""
        return (
            slice(self.row - other.row, self.row_stop - other.row),
            slice(self.column - other.column, self.column_stop - other.column),
        )


@dataclass(frozen=True, slots=True)
class Lattice:
    """The cells of one raster."""

    resolution_m: float
    first_column: int  # cells from x = 0 eastwards to the left edge
    first_row: int  # cells from y = 0 southwards to the top edge
    width: int  # in cells, as the next
    height: int

    @property
    def left_m(self) -> float:
        """The x of the left edge, world frame, metres."""
        return self.first_column * self.resolution_m

    @property
    def top_m(self) -> float:
        """The y of the top edge, world frame, metres."""
        return -self.first_row * self.resolution_m

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Left, bottom, right, top; world frame, metres."""
        return (
            self.left_m,
            -(self.first_row + self.height) * self.resolution_m,
            (self.first_column + self.width) * self.resolution_m,
            self.top_m,
        )

    @property
    def window(self) -> Window:
        """The whole raster."""
        return Window(0, self.height, 0, self.width)

    def centres(self, window: Window) -> FloatArray:
        """Return x and y of the centres of the cells of a window, shape (n, 2), row by row."""
        row, column = np.divmod(np.arange(window.height * window.width), window.width)
        x = self.left_m + (column + window.column + 0.5) * self.resolution_m
        return np.column_stack([x, self.top_m - (row + window.row + 0.5) * self.resolution_m])

    def box(self, window: Window) -> tuple[FloatArray, FloatArray]:
        """Return the least and largest x, y and z of a window, and of a cell more on each side."""
        first = np.array([window.column - 1, -window.row_stop - 1, -np.inf])
        last = np.array([window.column_stop + 1, -window.row + 1, np.inf])
        corner = np.array([self.left_m, self.top_m, 0.0])
        return corner + first * self.resolution_m, corner + last * self.resolution_m


def cells_of(xyz: FloatArray, resolution_m: float) -> IntArray:
    """Return columns eastwards and rows southwards of points, counted from x = 0 and y = 0.

    Points have the shape (n, 2) or (n, 3), metres, world frame. A point on an edge belongs to the
    cell east or north of it.
    """
    cells = np.floor((xyz[:, :2] + EDGE_M) / resolution_m).astype(np.int64)
    cells[:, 1] = -cells[:, 1] - 1
    return cells


def lattice_over(low: FloatArray, high: FloatArray, resolution_m: float, name: str) -> Lattice:
    """Return the cells that cover a rectangle between two corners, metres.

    Raises SettingError ``option.resolution``, with the `name` of the input, if there are more than
    `MAX_CELLS`.
    """
    first, last = (np.floor((corner + EDGE_M) / resolution_m) for corner in (low, high))
    columns, rows = last - first + 1.0  # as floats, which cannot overflow
    if columns * rows > MAX_CELLS:
        finest = float(f"{1.06 * resolution_m * math.sqrt(columns * rows / MAX_CELLS):.2g}")
        sentence = (
            f"{name}: {columns:,.0f} x {rows:,.0f} cells of {resolution_m:g} m are too many. Use"
            f" {finest:g} m or more, or first remove points far from all others (pcfix clean)."
        )
        raise SettingError("option.resolution", sentence, value=resolution_m, finest=finest)
    (west, south), (east, north) = cells_of(np.array([low, high]), resolution_m).tolist()
    return Lattice(resolution_m, west, north, east - west + 1, south - north + 1)


POINTS_A_CELL = 2.0, 4.0  # range for a chosen resolution
# Figures of a resolution, the roundest first; neighbours differ by less than sqrt 2.
ROUND = (1.0, 2.0, 5.0, 2.5, 4.0, 8.0, 1.25, 1.6, 3.2, 6.4)


def round_resolution(spacing_m: float) -> float:
    """Return a round side of cells with `POINTS_A_CELL` for a spacing of points, metres."""
    least = max(spacing_m * math.sqrt(POINTS_A_CELL[0]), MIN_RESOLUTION_M)
    power = 10.0 ** math.floor(math.log10(least))
    most = least * math.sqrt(POINTS_A_CELL[1] / POINTS_A_CELL[0])
    sides = (figure * scale for figure in ROUND for scale in (power, 10.0 * power))
    return next(float(f"{side:.6g}") for side in sides if least * 0.999 <= side <= most * 1.001)


# Heights


def grid_window(
    points: FloatArray, window: Window, lattice: Lattice, method: DsmMethod, reach: float,
    spacing: float,
) -> tuple[FloatArray, IntArray, FloatArray]:  # fmt: skip
    """Return height, number of points and spread of the cells of a part of a raster.

    Points, shape (n, 3), are all that decide on it, or more: x and y, world frame, metres, and the
    height or another quantity. `reach`, the diameter of the widest circle around a triangle of the
    TIN, and `spacing` of the points are in cells. The bands have the shape of the window, NaN if
    unknown.
    """
    shape = window.height, window.width
    column, row = cells_of(points, lattice.resolution_m).T
    column -= lattice.first_column + window.column
    row -= lattice.first_row + window.row
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

    A triangle is Delaunay's if no point is inside the circle through its corners. If circles wider
    than a limit are ignored, only points within that limit of a cell decide on it: a part of the
    raster, triangulated with such a margin, gets the same triangles as the whole. Where four points
    are on one circle, as in a regular grid, there are two answers. So the triangles (not the
    heights) are chosen by positions that are displaced a little, always the same way for the same
    point.
    """
    from scipy.spatial import Delaunay, QhullError  # slow to import

    out = np.full(window.height * window.width, np.nan)
    # sorted by column and row, each place once
    order = np.lexsort((position[:, 1], position[:, 0]))
    position, z = position[order], z[order]
    new = np.ones(len(z), bool)
    new[1:] = (position[1:] != position[:-1]).any(axis=1)
    if not new.all():
        z = cell_statistics(np.cumsum(new) - 1, z, int(new.sum()))["mean"]
        position = position[new]
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


SLACK_CELLS = 1.5  # rims k + 1 cells apart enclose k empty ones; their circles are a bit wider


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

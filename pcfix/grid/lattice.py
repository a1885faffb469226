"""The cells of a raster: squares whose edges are multiples of the resolution."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcfix.errors import SettingError
from pcfix.model import FloatArray, IntArray
from pcfix.options.steps import MIN_RESOLUTION_M

MAX_CELLS = 1_000_000_000
EDGE_M = 1e-7
"""Tolerance of points on an edge: 5432000.1 / 0.1 in floating point may be too small."""


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

    def grown(self, cells: int) -> Window:
        """Return the window with a margin on each side, which may extend beyond the raster."""
        return Window(
            self.row - cells, self.row_stop + cells, self.column - cells, self.column_stop + cells
        )

    def parts(self, side: int) -> Iterator[Window]:
        """Yield squares of `side` cells that cover the window, row by row."""
        for row in range(self.row, self.row_stop, side):
            for column in range(self.column, self.column_stop, side):
                yield Window(row, row + side, column, column + side).clipped(self)

    def clipped(self, other: Window) -> Window:
        """Return the intersection with another window."""
        return Window(
            max(self.row, other.row), min(self.row_stop, other.row_stop),
            max(self.column, other.column), min(self.column_stop, other.column_stop),
        )  # fmt: skip

    def within(self, other: Window) -> tuple[slice, slice]:
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

    def cells(self, xyz: FloatArray) -> IntArray:
        """Return the column and row of points, shape (n, 2), counted from the top left corner."""
        first = np.array([self.first_column, self.first_row])
        return cells_of(xyz, self.resolution_m) - first


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

    def size(side_m: float) -> FloatArray:
        """Return columns and rows, as floats, which cannot overflow."""
        first, last = (np.floor((corner + EDGE_M) / side_m) for corner in (low, high))
        return np.asarray(last - first + 1.0)

    if size(resolution_m).prod() > MAX_CELLS:
        columns, rows = size(resolution_m)
        finest = float(f"{1.06 * resolution_m * math.sqrt(columns * rows / MAX_CELLS):.2g}")
        sentence = (
            f"{name}: {columns:,.0f} x {rows:,.0f} cells of {resolution_m:g} m are too many. Use"
            f" {finest:g} m or more, or first remove points far from all others (pcfix clean)."
        )
        raise SettingError("option.resolution", sentence, value=resolution_m, finest=finest)
    (west, south), (east, north) = cells_of(np.array([low, high]), resolution_m).tolist()
    return Lattice(resolution_m, west, north, east - west + 1, south - north + 1)


POINTS_A_CELL = 2.0, 4.0
"""Range for a chosen resolution."""
ROUND = (1.0, 2.0, 5.0, 2.5, 4.0, 8.0, 1.25, 1.6, 3.2, 6.4)
"""Figures of a resolution, the roundest first; neighbours differ by less than sqrt 2."""


def round_resolution(spacing_m: float) -> float:
    """Return a round side of cells with `POINTS_A_CELL` for a spacing of points, metres."""
    least = max(spacing_m * math.sqrt(POINTS_A_CELL[0]), MIN_RESOLUTION_M)
    power = 10.0 ** math.floor(math.log10(least))
    most = least * math.sqrt(POINTS_A_CELL[1] / POINTS_A_CELL[0])
    sides = (figure * scale for figure in ROUND for scale in (power, 10.0 * power))
    return next(float(f"{side:.6g}") for side in sides if least * 0.999 <= side <= most * 1.001)

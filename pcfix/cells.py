"""Square cells over a cloud, with values that are accumulated chunk by chunk.

The sides of cells are powers of two, in metres, and cells are numbered from the origin of the world
frame. So the cell of a point depends neither on other points nor on their order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.model import BoolArray, FloatArray, IntArray

MOST_CELLS = 2**24
"""Maximum number of cells, for the memory; a larger cloud has larger cells."""
POINTS_A_CELL = 4.0
"""Minimum mean number of points per occupied cell."""
FINEST_M = 2.0**-10

Values = npt.NDArray[Any]


class CellFrame(NamedTuple):
    """The side of square cells, and the number of the first one."""

    side_m: float
    first_row: int  # counted northwards from the origin of the world frame
    first_column: int

    def cells(self, x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
        """Return row and column of n plan positions."""
        row = np.floor(y / self.side_m).astype(np.int64) - self.first_row
        return row, np.floor(x / self.side_m).astype(np.int64) - self.first_column


class Layer(NamedTuple):
    """The type of one value, or of several, of each cell."""

    empty: Values  # the value of a cell without points, with its type
    merged: Callable[[Values, Values], Values]  # combines the values of two cells


class Cells:
    """At most `most` cells over a rectangle that grows with the points, as small as possible.

    `low` and `high`, shape (2,), are the corners of the rectangle in metres, if they are known.
    `values` has an array for each layer, shape (..., rows, columns).
    """

    def __init__(
        self, low: FloatArray, high: FloatArray, *layers: Layer, most: int = MOST_CELLS
    ) -> None:
        self._layers, self._most = layers, most
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)
        if np.isfinite([low, high]).all() and (low <= high).all():
            self._low, self._high = low, high
        self.frame = CellFrame(FINEST_M, 0, 0)
        self.values = [np.empty((*layer.empty.shape, 0, 0), layer.empty.dtype) for layer in layers]

    def cover(self, low: FloatArray, high: FloatArray) -> None:
        """Extend the cells to a rectangle; they get larger if there would be too many."""
        if self.values[0].size > 0 and (low >= self._low).all() and (high <= self._high).all():
            return
        self._low, self._high = np.minimum(self._low, low), np.maximum(self._high, high)
        while True:
            side, *first = self.frame
            (west, south), (east, north) = (
                np.floor(corner / side) for corner in (self._low, self._high)
            )
            if (north - south + 1.0) * (east - west + 1.0) <= self._most:
                break
            self.halve()
        self.frame = CellFrame(side, int(south), int(west))
        shape = int(north - south) + 1, int(east - west) + 1
        row, column = first[0] - self.frame.first_row, first[1] - self.frame.first_column
        for i, (layer, old) in enumerate(zip(self._layers, self.values, strict=True)):
            rows, columns = old.shape[-2:]
            new = np.full((*old.shape[:-2], *shape), layer.empty[..., None, None])
            new[..., row : row + rows, column : column + columns] = old
            self.values[i] = new

    def halve(self) -> None:
        """Merge four cells at a time into one with twice the side."""
        side, row, column = self.frame
        for i, (layer, values) in enumerate(zip(self._layers, self.values, strict=True)):
            for first in (column, row):
                # pad, so that the first cell of each pair has an even number
                spare = first % 2, (first % 2 + values.shape[-1]) % 2
                pad = [*[(0, 0)] * (values.ndim - 1), spare]
                values = np.pad(values, pad, constant_values=layer.empty.flat[0])
                values = layer.merged(values[..., ::2], values[..., 1::2]).swapaxes(-1, -2)
            self.values[i] = np.ascontiguousarray(values)
        self.frame = CellFrame(2.0 * side, row // 2, column // 2)

    def coarsen(self, points: int, occupied: Callable[[Values], BoolArray]) -> None:
        """Merge cells until the occupied ones have enough of these points on average.

        `occupied` returns which cells are occupied, from the values of the first layer.
        """
        while max(self.values[0].shape[-2:]) > 2:
            if points >= POINTS_A_CELL * np.count_nonzero(occupied(self.values[0])):
                break
            self.halve()

"""Square cells over a cloud, whose values are collected chunk by chunk.

The sides of cells are powers of two, in metres, and cells count from the origin of the world frame.
So the cell of a point depends neither on other points nor on their order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.model import BoolArray, FloatArray, IntArray

MOST_CELLS = 2**24
"""Limits the memory; a larger cloud has larger cells."""
POINTS_A_CELL = 4.0
"""Least mean number of points per occupied cell; cells are the smallest that have it."""
FINEST_M = 2.0**-10

Values = npt.NDArray[Any]


class CellFrame(NamedTuple):
    """The side of square cells, and which is the first."""

    side_m: float
    first_row: int  # northwards from the origin of the world frame
    first_column: int

    def cells(self, x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
        """Return row and column of n plan positions."""
        row = np.floor(y / self.side_m).astype(np.int64) - self.first_row
        return row, np.floor(x / self.side_m).astype(np.int64) - self.first_column


class Layer(NamedTuple):
    """A value of each cell, or several."""

    empty: Values  # the value of a cell without points, with its type
    merged: Callable[[Values, Values], Values]  # the values of two cells as of one


class Cells:
    """The finest cells, at most `most`, over a rectangle that grows with the points.

    `low` and `high`, shape (2,), are its corners in metres, if they are known. `values` are those
    of each layer, shape (..., rows, columns).
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
        """Make the cells cover a rectangle too; they get larger if there would be too many."""
        is_made = self.values[0].size > 0
        if is_made and (low >= self._low).all() and (high <= self._high).all():
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
        """Merge each four cells into one of twice the side."""
        side, row, column = self.frame
        for i, (layer, values) in enumerate(zip(self._layers, self.values, strict=True)):
            for first in (column, row):
                # the first cell of a pair has an even number
                spare = first % 2, (first % 2 + values.shape[-1]) % 2
                pad = [*[(0, 0)] * (values.ndim - 1), spare]
                values = np.pad(values, pad, constant_values=layer.empty.flat[0])
                values = layer.merged(values[..., ::2], values[..., 1::2]).swapaxes(-1, -2)
            self.values[i] = np.ascontiguousarray(values)
        self.frame = CellFrame(2.0 * side, row // 2, column // 2)

    def coarsen(self, points: int, occupied: Callable[[Values], BoolArray]) -> None:
        """Merge cells until those that are occupied have enough of some points on average.

        `occupied` says it of cells by the values of the first layer.
        """
        while max(self.values[0].shape[-2:]) > 2:
            if points >= POINTS_A_CELL * np.count_nonzero(occupied(self.values[0])):
                break
            self.halve()

"""Values that are accumulated chunk by chunk: sums, cells over a cloud, and results of commands."""

import operator
from collections.abc import Callable
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from pcfix.errors import plain
from pcfix.model import BoolArray, FloatArray, IntArray

LEAST = {"join": np.minimum}
MOST = {"join": np.maximum}
# Metadata of fields that are joined by the minimum, by the maximum, or by taking either value.
SAME = {"join": lambda one, other: one}


class Sums:
    """The base of dataclasses that are added field by field.

    Numbers, arrays and sums are added, and tuples are joined. None stands for a value that is not
    known yet. Fields with the metadata `LEAST`, `MOST` or `SAME` are joined in another way.
    """

    def __add__(self, other: Self) -> Self:
        """Return the statistics of all points of both."""
        joined = {}
        for one in fields(self):  # type: ignore[arg-type]
            mine, theirs = getattr(self, one.name), getattr(other, one.name)
            if mine is not None and theirs is not None:
                mine = one.metadata.get("join", operator.add)(mine, theirs)
            joined[one.name] = theirs if mine is None else mine
        return replace(self, **joined)  # type: ignore[type-var]


def nice_step(least: float) -> float:
    """Return the smallest number of the form 1, 2 or 5 times 10^k that is at least `least`."""
    if not least > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(f * power for f in (1, 2, 5, 10) if f * power >= least * (1.0 - 1e-9)))


class Figures(SimpleNamespace):
    """The results of a command by name, for its printed summary and for ``--summary``."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return dict(plain(self))


# Square cells over a cloud: their sides are powers of two, in metres, and they are numbered from
# the origin of the world frame. So the cell of a point depends neither on other points nor on
# their order.

MOST_CELLS = 2**24  # maximum number of cells, for the memory; a larger cloud has larger cells
POINTS_A_CELL = 4.0  # minimum mean number of points per occupied cell

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
        self.frame = CellFrame(2.0**-10, 0, 0)
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

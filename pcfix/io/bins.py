"""A store on disk for points on their way into a raster: one file for each square of cells."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from pcfix.grid.lattice import Window
    from pcfix.model import FloatArray, IntArray


class Bins:
    """Points sorted by place, as float64, in files of a folder that the caller makes and removes.

    Parameters
    ----------
    folder : Path
    side : int
        Cells along a square.
    corner : tuple of int
        Column and row of a corner of the squares, counted from x = 0 and y = 0.
    numbers : int
        Of each point: its coordinates, and what else belongs to it.
    """

    def __init__(self, folder: Path, side: int, corner: Iterable[int], numbers: int = 3) -> None:
        self._numbers = numbers
        self._folder, self._side = folder, side
        self._corner = np.array(list(corner), np.int64)
        self._points: dict[tuple[int, int], int] = {}

    def add(self, cell: IntArray, xyz: FloatArray) -> None:
        """Store points; those of one cell keep their order.

        Parameters
        ----------
        cell : array, shape (n, 2)
            Columns and rows, counted from x = 0 and y = 0.
        xyz : array, shape (n, numbers)
            Metres, world frame.
        """
        square = (cell - self._corner) // self._side
        order = np.lexsort((square[:, 0], square[:, 1]))
        square, xyz = square[order], xyz[order]
        first = np.flatnonzero((np.diff(square, axis=0, prepend=square[:1] - 1) != 0).any(axis=1))
        for start, stop in zip(first, [*first[1:], len(xyz)], strict=True):
            place = (int(square[start, 0]), int(square[start, 1]))
            self._points[place] = self._points.get(place, 0) + int(stop - start)
            with self._file(place).open("ab") as stream:
                stream.write(xyz[start:stop].tobytes())

    def read(self, cells: Window) -> FloatArray:
        """Return the points of all squares that touch a window, counted as `add` counts cells.

        Returns
        -------
        array, shape (n, numbers)
            Metres, world frame; points of the squares outside the window are among them.
        """
        places, numbers = self._touched(cells), self._numbers
        parts = [np.fromfile(self._file(place)).reshape(-1, numbers) for place in places]
        return np.concatenate([np.empty((0, numbers)), *parts])

    def count(self, cells: Window) -> int:
        """Return how many points `read` would return."""
        return sum(self._points[place] for place in self._touched(cells))

    @property
    def side(self) -> int:
        """Cells along a square."""
        return self._side

    def _touched(self, cells: Window) -> list[tuple[int, int]]:
        """Return the squares with points that touch a window."""
        column, row = self._corner.tolist()
        left, right = (cells.column - column) // self._side, (cells.column_stop - 1 - column)
        top, bottom = (cells.row - row) // self._side, (cells.row_stop - 1 - row)
        columns, rows = range(left, right // self._side + 1), range(top, bottom // self._side + 1)
        return [(c, r) for r in rows for c in columns if (c, r) in self._points]

    def _file(self, place: tuple[int, int]) -> Path:
        return self._folder / f"{place[0]}_{place[1]}.points"

"""Heights for cells without points, from the cells around the hole."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.grid.delaunay import triangulated

if TYPE_CHECKING:
    from pcfix.grid.lattice import Window
    from pcfix.model import BoolArray, FloatArray

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

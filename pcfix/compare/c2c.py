"""Cloud to cloud: how far each point is from the nearest point of a reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.compare.cells import build_cells, cell_of, nearest_distances, sorted_by_cell

if TYPE_CHECKING:
    from pcfix.model import FloatArray


def cloud_to_cloud(xyz: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the distance from each point to the nearest point of the reference.

    It has no sign, and is never zero where the two clouds sample a surface at different places:
    half the spacing of the reference is its floor. See `vertical` for a signed difference.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Metres, world frame.
    reference : array, shape (m, 3)
        The same frame.

    Returns
    -------
    array, shape (n,)
        Metres.
    """
    origin = np.floor(reference[0])
    places, grid = xyz - origin, build_cells(reference - origin)
    cell = cell_of(places, grid.low, grid.side_m, grid.columns, grid.rows)
    _, order = sorted_by_cell(cell, grid.columns * grid.rows)
    distance = nearest_distances(grid, places, order)
    far = np.isnan(distance)
    if far.any():
        from pcfix.compare.neighbours import Neighbours

        distance[far], _ = Neighbours(grid.points).nearest(places[far])
    return np.asarray(distance)

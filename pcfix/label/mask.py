"""Which points lie inside an area of polygons, millions at a time.

The plan is cut into square cells, each wholly inside, wholly outside, or crossed by the border.
Only for points in crossed cells the polygons themselves are asked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit, prange

if TYPE_CHECKING:
    import numpy.typing as npt

    from pcfix.model import BoolArray, FloatArray, IntArray

    States = npt.NDArray[np.uint8]

OUTSIDE, INSIDE, CROSSED = 0, 1, 2
HALVINGS = 9
"""So often the square around the area is halved: 512 by 512 cells."""
_MARGIN = 1e-6  # of a cell: what is tested is a little larger, so that rounding cannot matter


class _Cells(NamedTuple):
    """The square around the area; ``states[row, column]`` counts from its south-west corner."""

    west: float
    south: float
    cell_m: float
    states: States


class WaterMask:
    """The polygons inside which points may be submerged.

    A point on the border, of a hole too, is inside.

    Parameters
    ----------
    area : shapely Polygon or MultiPolygon
        Valid, in the cloud's CRS, metres.
    name : str
        For messages.
    low, high : array, shape (2,), optional
        South-west and north-east corner of where points will be. It makes the cells finer where
        the area reaches far beyond, and has no effect on the result.
    notes : tuple of str
        What was done on reading it, for the summary.
    """

    def __init__(
        self,
        area: Any,
        name: str = "mask",
        low: FloatArray | None = None,
        high: FloatArray | None = None,
        notes: tuple[str, ...] = (),
    ) -> None:
        self.area, self.name, self.notes = area, name, notes
        self.bounds: tuple[float, float, float, float] = area.bounds
        corner, opposite = np.array(self.bounds[:2]), np.array(self.bounds[2:])
        if low is not None and high is not None:
            west_south, east_north = np.maximum(corner, low), np.minimum(opposite, high)
            if (west_south < east_north).all():
                corner, opposite = west_south, east_north
        self._cells = _cells_over(area, corner, float((opposite - corner).max()))

    def inside(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Return which of n plan positions, metres, world frame, are inside."""
        import shapely

        states = np.empty(x.size, np.uint8)
        _look_up(self._cells, np.asarray(self.bounds), x, y, states)
        asked = np.flatnonzero(states == CROSSED)
        states[asked] = shapely.intersects_xy(self.area, x[asked], y[asked])
        return states.astype(np.bool_)


def _cells_over(area: Any, corner: FloatArray, side_m: float) -> _Cells:
    """Return the states of the cells of a square, halving only those that the border crosses."""
    import shapely

    shapely.prepare(area)
    west, south = corner.tolist()
    side_m = max(side_m, 1e-3)
    far = np.spacing(np.abs([*area.bounds, west, south]).max() + side_m)
    states = np.full((1, 1), CROSSED, np.uint8)
    for halvings in range(1, HALVINGS + 1):
        states = states.repeat(2, axis=0).repeat(2, axis=1)
        row, column = np.nonzero(states == CROSSED)
        cell = side_m / 2**halvings
        margin = _MARGIN * cell + 4.0 * far
        x, y = west + column * cell, south + row * cell
        boxes = shapely.box(x - margin, y - margin, x + cell + margin, y + cell + margin)
        states[row, column] = _states_of(area, boxes)
    return _Cells(west, south, side_m / 2**HALVINGS, states)


def _states_of(area: Any, boxes: npt.NDArray[Any]) -> States:
    import shapely

    state = np.where(shapely.covers(area, boxes), INSIDE, CROSSED).astype(np.uint8)
    rest: IntArray = np.flatnonzero(state == CROSSED)
    state[rest[~shapely.intersects(area, boxes[rest])]] = OUTSIDE
    return state


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def _look_up(
    cells: _Cells, bounds: FloatArray, x: FloatArray, y: FloatArray, states: States
) -> None:  # pragma: no cover - compiled
    """Write the state of each position; those off the cells but within the bounds are unsure."""
    rows, columns = cells.states.shape
    for i in prange(x.size):
        column = np.floor((x[i] - cells.west) / cells.cell_m)
        row = np.floor((y[i] - cells.south) / cells.cell_m)
        within = bounds[0] <= x[i] <= bounds[2] and bounds[1] <= y[i] <= bounds[3]
        if not within:
            states[i] = OUTSIDE
        elif 0 <= column < columns and 0 <= row < rows:
            states[i] = cells.states[int(row), int(column)]
        else:
            states[i] = CROSSED

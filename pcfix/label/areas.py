"""Areas in plan: the polygons of a mask, and connected water bodies.

A mask is tested for millions of points. So the plan is cut into square cells that are inside,
outside, or crossed by the border, and the polygons are only tested for points in crossed cells.
(`rasterize` of rasterio is not exact: it does not mark the cells that a border crosses.)

Connected water is found in a grid over the cloud, filled chunk by chunk. Its cells have sides of a
power of two, in metres, and count from the origin of the world frame, so that the cell of a point
does not depend on other points. All sums are of whole numbers, for the same reason.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.kernels import Span, in_tiles, kernel
from pcfix.model import BoolArray, FloatArray, IntArray

States = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.uint8]


OUTSIDE, INSIDE, CROSSED = 0, 1, 2
HALVINGS = 9
"""Subdivisions of the square around the area: 512 by 512 cells."""
_MARGIN = 1e-6  # relative margin of a tested cell, more than rounding


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
        South-west and north-east corner of the points. They make the cells finer if the area
        extends far beyond; the result is the same.
    notes : tuple of str
        Notes of the reader, for the summary.
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
        in_tiles(_look_up, x.size, self._cells, np.asarray(self.bounds), x, y, states)
        asked = np.flatnonzero(states == CROSSED)
        states[asked] = shapely.intersects_xy(self.area, x[asked], y[asked])
        return states.astype(np.bool_)


def _cells_over(area: Any, corner: FloatArray, side_m: float) -> _Cells:
    """Return the states of the cells of a square, subdividing those that the border crosses."""
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
        state = np.where(shapely.covers(area, boxes), INSIDE, CROSSED).astype(np.uint8)
        rest: IntArray = np.flatnonzero(state == CROSSED)
        state[rest[~shapely.intersects(area, boxes[rest])]] = OUTSIDE
        states[row, column] = state
    return _Cells(west, south, side_m / 2**HALVINGS, states)


@kernel
def _look_up(
    span: Span, cells: _Cells, bounds: FloatArray, x: FloatArray, y: FloatArray, states: States
) -> None:
    """Write the state of each position; off the cells but within the bounds it is `CROSSED`."""
    rows, columns = cells.states.shape
    for i in range(*span):
        column = np.floor((x[i] - cells.west) / cells.cell_m)
        row = np.floor((y[i] - cells.south) / cells.cell_m)
        within = bounds[0] <= x[i] <= bounds[2] and bounds[1] <= y[i] <= bounds[3]
        if not within:
            states[i] = OUTSIDE
        elif 0 <= column < columns and 0 <= row < rows:
            states[i] = cells.states[int(row), int(column)]
        else:
            states[i] = CROSSED


MOST_CELLS = 2**24
"""Limits the memory; a larger cloud has larger cells."""
POINTS_A_CELL = 4.0
"""Cells are the smallest with so many points per water cell, on average."""
FINEST_M = 2.0**-10
SHARE_OF_LARGEST = 0.1
"""Pools of at least this share of the area of the largest water body are kept."""
_VOTE = 1000

PRESENT, BELOW, UNDECIDED = 1, 2, 4
"""A cell has points; points below the surface; points within the dead band."""


class Lattice(NamedTuple):
    """Square cells; the first column and row count from the origin of the world frame."""

    side_m: float
    first_column: int
    first_row: int
    columns: int
    rows: int


def lattice_over(low: FloatArray, high: FloatArray) -> Lattice:
    """Return the finest lattice with at most `MOST_CELLS` over a rectangle, shapes (2,), metres."""
    side = FINEST_M
    while True:
        first, last = np.floor(low / side), np.floor(high / side)
        columns, rows = last - first + 1.0
        if columns * rows <= MOST_CELLS:
            return Lattice(side, int(first[0]), int(first[1]), int(columns), int(rows))
        side *= 2.0


class Pools(NamedTuple):
    """The connected water bodies of a grid."""

    number: npt.NDArray[np.int32]  # (rows, columns), 0 for none, else an index of the others
    area_m2: FloatArray  # of the cells with submerged points
    stays: BoolArray  # whether it counts as water


class Surroundings(NamedTuple):
    """What a grid knows about the cells of points."""

    lattice: Lattice
    is_wet: BoolArray  # (rows, columns), whether an undecided point in the cell is submerged
    pools: Pools | None
    joined: BoolArray | None  # (rows, columns), whether a kept water body is in the cell or beside

    def cells(self, x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
        """Return row and column of n plan positions that the grid was made with."""
        side = self.lattice.side_m
        column = np.floor(x / side).astype(np.int64) - self.lattice.first_column
        row = np.floor(y / side).astype(np.int64) - self.lattice.first_row
        return row, column


class Grid:
    """Points per cell, added chunk by chunk.

    It is made with the south-west and north-east corner of the cloud, metres, shape (2,). If these
    turn out to be wrong, `fits` is False, `low` and `high` are those of the points so far, and the
    points must be added again. Points within the dead band of the surface are undecided.
    """

    def __init__(self, low: FloatArray, high: FloatArray, dead_band_m: float) -> None:
        self.lattice = lattice_over(low, high)
        self.low, self.high = np.full(2, np.inf), np.full(2, -np.inf)
        self._dead_m, self._water_points = dead_band_m, 0
        shape = self.lattice.rows, self.lattice.columns
        self._flags: Flags = np.zeros(shape, np.uint8)
        self._votes: IntArray = np.zeros(shape if dead_band_m else (1, 1), np.int64)

    def add(self, x: FloatArray, y: FloatArray, height_m: FloatArray, counts: BoolArray) -> None:
        """Add n points with their heights above the water surface, NaN if unknown.

        Points that do not count cannot be submerged; they only show that there is no gap.
        """
        if not x.size:
            return
        self.low = np.minimum(self.low, [x.min(), y.min()])
        self.high = np.maximum(self.high, [x.max(), y.max()])
        self._water_points += _add(
            self.lattice, self._flags, self._votes, self._dead_m, x, y, height_m, counts
        )

    @property
    def fits(self) -> bool:
        """Whether the points so far would have the same grid."""
        own, fitting = self.lattice, lattice_over(self.low, self.high)
        across, up = fitting.first_column - own.first_column, fitting.first_row - own.first_row
        return (
            own.side_m == fitting.side_m
            and 0 <= across <= own.columns - fitting.columns
            and 0 <= up <= own.rows - fitting.rows
        )

    def surroundings(self, *, connected: bool, least_pool_m2: float | None) -> Surroundings:
        """Coarsen the grid until its cells have enough points, and find the water bodies."""
        from scipy.ndimage import convolve

        lattice, flags, votes = self.lattice, self._flags, self._votes
        while max(flags.shape) > 2:
            water_cells = np.count_nonzero(flags & (BELOW | UNDECIDED))
            if self._water_points >= POINTS_A_CELL * water_cells:
                break
            lattice, flags, votes = _halved(lattice, flags, votes)
        # the votes of a cell and its eight neighbours together
        is_wet = convolve(votes, np.ones((3, 3)), mode="constant") < 0
        if not connected:
            return Surroundings(lattice, is_wet, None, None)
        water = (flags & BELOW) > 0
        if self._dead_m:
            water |= ((flags & UNDECIDED) > 0) & is_wet
        pools = _pools(water, flags == 0, lattice.side_m**2, least_pool_m2)
        return Surroundings(lattice, is_wet, pools, _grown(pools.stays[pools.number]))


def _halved(lattice: Lattice, flags: Flags, votes: IntArray) -> tuple[Lattice, Flags, IntArray]:
    """Return the same in cells of twice the side."""
    _, column, row, columns, rows = lattice
    west, south = column % 2, row % 2  # the cells to add, for pairs that begin with an even one
    pad = (south, (south + rows) % 2), (west, (west + columns) % 2)

    def quads(cells: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        full = np.pad(cells, pad) if np.any(pad) else cells
        return [full[i::2, j::2] for i in (0, 1) for j in (0, 1)]

    if votes.size == flags.size:
        votes = np.add.reduce(quads(votes))
    flags = np.bitwise_or.reduce(quads(flags))
    rows, columns = flags.shape
    return Lattice(lattice.side_m * 2.0, column // 2, row // 2, columns, rows), flags, votes


def _grown(cells: BoolArray) -> BoolArray:
    """Return cells and those that touch them, corners included."""
    from scipy.ndimage import binary_dilation

    return np.asarray(binary_dilation(cells, np.ones((3, 3), np.bool_)))


def _pools(
    water: BoolArray, is_gap: BoolArray, cell_m2: float, least_pool_m2: float | None
) -> Pools:
    """Return water connected over sides, corners, and gaps of at most two cells."""
    from scipy.ndimage import label

    found, count = label(water | (_grown(water) & is_gap), np.ones((3, 3), np.int8))
    number = np.where(water, found, 0).astype(np.int32)
    cells = np.bincount(number[water], minlength=count + 1)
    area = cells.astype(np.float64) * cell_m2
    least = SHARE_OF_LARGEST * area.max() if least_pool_m2 is None else least_pool_m2
    stays = (area >= least) | (area == area.max())
    stays[0] = False
    return Pools(number, area, stays)


@kernel
def _add(
    lattice: Lattice,
    flags: Flags,
    votes: IntArray,
    dead_m: float,
    x: FloatArray,
    y: FloatArray,
    height_m: FloatArray,
    counts: BoolArray,
) -> int:
    """Mark the cells of points and add their votes; return how many are below or undecided."""
    water = 0
    for i in range(x.size):
        column = np.floor(x[i] / lattice.side_m) - lattice.first_column
        row = np.floor(y[i] / lattice.side_m) - lattice.first_row
        if not (0 <= column < lattice.columns and 0 <= row < lattice.rows):
            continue
        c, r, height = int(column), int(row), height_m[i]
        flags[r, c] |= PRESENT
        if not counts[i] or np.isnan(height):
            continue
        if height < -dead_m:
            flags[r, c] |= BELOW
            water += 1
        elif dead_m > 0.0 and height <= dead_m:
            flags[r, c] |= UNDECIDED
            water += 1
        if dead_m > 0.0:
            votes[r, c] += int(np.rint(_VOTE * min(max(height / dead_m, -1.0), 1.0)))
    return water

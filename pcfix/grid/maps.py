"""Small maps for the report: means per cell, accumulated over chunks; contours of rasters."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pcfix.model import BoolArray, FloatArray
from pcfix.sums import nice_step

LONG_SIDE_CELLS = 360
MOST_CELLS = 500_000
"""Maximum number of cells of a map, so that a page with six maps stays below 8 MB."""
POINTS_PER_CELL = 6.0
"""Least number of points per cell: a sparse cloud gets larger cells, with few holes."""
FEWEST_AROUND = 5
"""Known neighbours, of eight, whose mean an empty cell gets."""

Extent = tuple[float, float, float, float]
"""West, east, south and north, metres."""


@dataclass(frozen=True, eq=False)
class Maps:
    """Means of the points of each cell, shape (rows, columns); NaN without points.

    The first row is the northernmost. A single empty cell has the mean of its neighbours. Heights
    are of all points, the rest of the corrected points; the uncertainty is 1.96 times the root mean
    square of their standard errors of Z.
    """

    west_m: float  # the outer corner of the upper left cell, in the cloud's CRS
    north_m: float
    cell_m: float  # side of a cell
    height_m: FloatArray
    depth_m: FloatArray
    shift_z_m: FloatArray
    rays: FloatArray
    uncertainty_m: FloatArray

    @property
    def extent_m(self) -> Extent:
        """West, east, south and north."""
        rows, columns = self.height_m.shape
        east = self.west_m + columns * self.cell_m
        return self.west_m, east, self.north_m - rows * self.cell_m, self.north_m

    def sampled(self, values: FloatArray, extent_m: Extent) -> FloatArray:
        """Sample a raster of any resolution at the centres of the cells, NaN outside of it."""
        from scipy.ndimage import map_coordinates

        west, east, south, north = extent_m
        rows, columns = self.height_m.shape
        x = self.west_m + (np.arange(columns) + 0.5) * self.cell_m
        y = self.north_m - (np.arange(rows) + 0.5) * self.cell_m
        column = np.floor((x - west) / (east - west) * values.shape[1])
        row = np.floor((north - y) / (north - south) * values.shape[0])
        places = np.meshgrid(row, column, indexing="ij")
        return np.asarray(map_coordinates(values, places, order=0, cval=np.nan))


class MapsBuilder:
    """Sums per cell."""

    def __init__(
        self, low: FloatArray, high: FloatArray, points: int, resolution_m: float | None = None
    ) -> None:
        """Lay out cells between two corners in plan, (2,), metres, for a number of points.

        With the resolution of a raster of the same points, the cells have it or a multiple of it.
        """
        size = np.maximum(high - low, 1e-3)
        if resolution_m is None:
            sparse_m = np.sqrt(POINTS_PER_CELL * size.prod() / max(points, 1))
            self._cell_m = float(max(size.max() / LONG_SIDE_CELLS, sparse_m))
            self._low = low
            self._columns, self._rows = (max(1, round(s / self._cell_m)) for s in size)
        else:
            several = np.ceil(np.sqrt(size.prod() / MOST_CELLS) / resolution_m)
            self._cell_m = resolution_m * float(max(several, 1.0))
            first, last = (np.floor(corner / self._cell_m) for corner in (low, high))
            self._low = first * self._cell_m
            self._columns, self._rows = (last - first + 1.0).astype(np.int64).tolist()
        # of all points their number and heights; of those that moved also their number and values
        self._sums = np.zeros((7, self._rows * self._columns))

    def add(
        self, xyz: FloatArray, moved: BoolArray | None = None, values: FloatArray | None = None
    ) -> None:
        """Add n points, shape (n, 3), and for the m that `moved` some values, shape (m, 4).

        These are depth, shift in Z, number of rays and standard error of Z.
        """
        place = ((xyz[:, :2] - self._low) / self._cell_m).astype(np.int64)
        column, row = np.clip(place, 0, (self._columns - 1, self._rows - 1)).T
        cell = (self._rows - 1 - row) * self._columns + column
        added = [(cell, np.ones(len(cell))), (cell, xyz[:, 2])]
        if moved is not None and values is not None:
            depth, shift, rays, sigma = values.T
            columns = (np.ones(len(depth)), depth, shift, rays, sigma**2)
            added += [(cell[moved], column) for column in columns]
        for sums, (cells, summands) in zip(self._sums, added, strict=False):
            np.add.at(sums, cells, summands)  # one by one: the same bits for any chunks

    def maps(self) -> Maps:
        """Return the means; there is at least one point."""
        shape = self._rows, self._columns
        with np.errstate(invalid="ignore"):
            means = [self._sums[1] / self._sums[0], *(self._sums[3:] / self._sums[2])]
        heights, depth, shift, rays, variance = (_filled(one.reshape(shape)) for one in means)
        uncertainty = np.where(variance > 0.0, 1.96 * np.sqrt(variance), np.nan)
        known = np.argwhere(np.isfinite(heights))
        (top, left), (last, right) = known.min(axis=0), known.max(axis=0)
        part = np.s_[top : last + 1, left : right + 1]  # the bounds include noise
        north = float(self._low[1]) + (self._rows - top) * self._cell_m
        place = float(self._low[0]) + left * self._cell_m, float(north), self._cell_m
        return Maps(*place, heights[part], depth[part], shift[part], rays[part], uncertainty[part])


def _filled(values: FloatArray) -> FloatArray:
    """Replace single NaN cells by the mean of their neighbours."""
    from scipy.ndimage import uniform_filter

    known = np.isfinite(values)
    around = 9.0 * uniform_filter(known.astype(np.float64), 3, mode="constant")
    total = 9.0 * uniform_filter(np.where(known, values, 0.0), 3, mode="constant")
    fill = ~known & (around > FEWEST_AROUND - 0.5)
    return np.where(fill, total / np.maximum(around, 1.0), values)


def smoothed(values: FloatArray, sigma_cells: float) -> FloatArray:
    """Return a map smoothed by a Gaussian filter; NaN stays NaN."""
    from scipy.ndimage import gaussian_filter

    known = np.isfinite(values)
    weight = gaussian_filter(known.astype(np.float64), sigma_cells)
    total = gaussian_filter(np.where(known, values, 0.0), sigma_cells)
    return np.where(known, total / np.maximum(weight, 1e-9), np.nan)


MOST_LEVELS, LEAST_INTERVAL_M = 15, 1e-3
SMOOTH_CELLS = 1.0
"""Standard deviation of the filter before the lines are drawn."""
LEAST_CELLS = 12.0
"""Shorter lines are dropped."""


def depth_interval(depth_m: FloatArray, uncertainty_m: FloatArray) -> float:
    """Return the interval for a map of depths: few levels, and not finer than the uncertainty.

    It is 1, 2 or 5 times a power of ten, metres. Both arrays are NaN if unknown, of any shape.
    """
    known = uncertainty_m[np.isfinite(uncertainty_m)]
    deepest = np.max(depth_m, where=np.isfinite(depth_m), initial=0.0)
    sigma = float(np.median(known)) if known.size else 0.0
    return nice_step(max(float(deepest) / MOST_LEVELS, sigma, LEAST_INTERVAL_M))


def contours(values: FloatArray, interval: float) -> list[tuple[float, FloatArray]]:
    """Return levels and lines of the contours of cells (rows, columns), NaN if unknown.

    The levels are whole intervals; the lowest and the highest value have no contour. A line, shape
    (n, 2), has columns and rows from the centre of the first cell.
    """
    from contourpy import contour_generator

    if min(values.shape) < 2 or not np.isfinite(values).any():
        return []
    maker = contour_generator(z=np.ma.masked_invalid(smoothed(values, SMOOTH_CELLS)))
    first = math.floor(float(np.nanmin(values)) / interval) + 1
    last = math.ceil(float(np.nanmax(values)) / interval)
    return [
        (round(step * interval, 6), line)
        for step in range(first, last)
        for line in map(np.asarray, maker.lines(step * interval))
        if np.hypot(*np.diff(line, axis=0).T).sum() >= LEAST_CELLS
    ]

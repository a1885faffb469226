"""The points of a cloud on disk, sorted by place, ready to be gridded window by window."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError, PcfixWarning
from pcfix.flow.points import CHUNK_POINTS
from pcfix.grid.lattice import Occupancy, Window, cells_of, fits, lattice_over, refuse_size
from pcfix.io.files import Bins
from pcfix.io.las.source import LasSource, coordinates
from pcfix.model import BATHYMETRIC_POINT, NOISE_CLASSES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    import laspy

    from pcfix.grid.model import DsmSettings, SurfaceChoice
    from pcfix.model import BoolArray, FloatArray, IntArray

    Progress = Callable[[int, int], None]

"""ASPRS classes of low and high noise."""
BLOCK_CELLS = 1024
"""Longest side of a window; a power of two."""
BIN_POINTS = 200_000
"""So many points a square of the store has, on average."""
SIGMA_Z = "SigmaZ"
FEWEST_A_CELL = 0.9
"""Points, on average where there are any; fewer are worth a warning."""


class SortedPoints:
    """The points that a raster is made of, and the raster's lattice.

    Parameters
    ----------
    source : LasSource
    settings : DsmSettings
    folder : Path
        For the points; the caller makes and removes it.
    progress : callable
        Called with (points done, points in all) after each chunk.

    Attributes
    ----------
    near : Occupancy
        How many points there are, and how close together.
    lattice : Lattice
    has_sigma : bool
        Whether the cloud has standard errors of Z, as a correction leaves them.

    Raises
    ------
    PcfixError
        If no points are left, or the raster would be too large.
    """

    def __init__(
        self, source: LasSource, settings: DsmSettings, folder: Path, progress: Progress
    ) -> None:
        """Read the cloud, store the wanted points, and lay out the raster."""
        resolution = settings.resolution_m
        self._resolution_m = resolution
        area = _header_area_m2(source, resolution)
        corner = cells_of(_header_corner(source), resolution)[0]
        self.has_sigma = SIGMA_Z in source.header.point_format.dimension_names
        side = _side_with(BIN_POINTS, len(source) / area, resolution)
        self._bins = Bins(folder, side, corner, 4 if self.has_sigma else 3)
        self.near = Occupancy(area, len(source), resolution)
        done = 0
        for points in source.chunks(CHUNK_POINTS):
            xyz = self._numbers(points)[_wanted(points, settings.surface)]
            self.near.add(xyz)
            if len(xyz) and fits(self.near.low, self.near.high, resolution):
                self._bins.add(cells_of(xyz, resolution), xyz)
            # too large a raster is refused below, when the whole extent is known
            done += len(points)
            progress(done, len(source))
        _refuse_none(self.near.points, source.path, settings.surface)
        low, high = self.near.low, self.near.high
        refuse_size(low, high, resolution, str(source.path))
        _warn_of_fine_cells(self.near.spacing_m, resolution)
        self.lattice = lattice_over(low, high, resolution)

    def _numbers(self, points: laspy.ScaleAwarePointRecord) -> FloatArray:
        """Return coordinates, and beside them the standard error of Z where there is one."""
        xyz = coordinates(points)
        return np.column_stack([xyz, np.asarray(points[SIGMA_Z])]) if self.has_sigma else xyz

    def windows(self, limit: int) -> Iterator[Window]:
        """Yield windows that cover the raster, small enough to have about `limit` points."""
        for window in self.lattice.windows(BLOCK_CELLS):
            yield from self._halved(window, BLOCK_CELLS, limit)

    def _halved(self, window: Window, side: int, limit: int) -> Iterator[Window]:
        """Yield a window, or its quarters where it has too many points."""
        if side <= self._bins.side or self._bins.count(self._stored(window)) <= limit:
            yield window
            return
        half = side // 2
        for row in range(window.row, window.row_stop, half):
            for column in range(window.column, window.column_stop, half):
                quarter = Window(row, row + half, column, column + half).clipped(window)
                yield from self._halved(quarter, half, limit)

    def _stored(self, window: Window) -> Window:
        """Return a window of the raster as the store counts cells."""
        row, column = self.lattice.first_row, self.lattice.first_column
        return Window(
            window.row + row, window.row_stop + row, window.column + column,
            window.column_stop + column,
        )  # fmt: skip

    def points_in(self, window: Window) -> tuple[FloatArray, IntArray]:
        """Return the points of a window, and their columns and rows in the raster.

        The first are metres in the world frame, shape (n, 3), or (n, 4) with the standard error
        of Z, zero of points that were not corrected; the second have shape (n, 2).
        """
        xyz = self._bins.read(self._stored(window))
        first = [self.lattice.first_column, self.lattice.first_row]
        cell = cells_of(xyz, self._resolution_m) - first
        rows = inside(cell, window)
        return xyz[rows], cell[rows]


def inside(cell: IntArray, window: Window) -> BoolArray:
    """Return which columns and rows, shape (n, 2), are in a window."""
    column, row = cell.T
    across = (column >= window.column) & (column < window.column_stop)
    return np.asarray(across & (row >= window.row) & (row < window.row_stop))


def _wanted(points: laspy.ScaleAwarePointRecord, surface: SurfaceChoice) -> BoolArray:
    classes = np.asarray(points["classification"])
    wanted = classes == BATHYMETRIC_POINT if surface == "bed" else ~np.isin(classes, NOISE_CLASSES)
    return np.asarray(wanted & ~np.asarray(points["withheld"]).astype(bool))


def _side_with(points: int, points_per_m2: float, resolution_m: float) -> int:
    """Return the power of two, up to `BLOCK_CELLS`, of cells along a square with so many points."""
    cells = max(np.sqrt(points / points_per_m2) / resolution_m, 1.0)
    return int(min(2 ** np.floor(np.log2(cells)), BLOCK_CELLS))


def _header_area_m2(source: LasSource, resolution_m: float) -> float:
    """Return the area the header states. It only sets sizes, so it need not be right."""
    area = float(np.prod(source.header.maxs[:2] - source.header.mins[:2]))
    return max(area, resolution_m**2) if np.isfinite(area) else resolution_m**2


def _header_corner(source: LasSource) -> FloatArray:
    """Return the north-west corner that the header states, shape (1, 2), if it makes sense."""
    corner = np.array([[source.header.mins[0], source.header.maxs[1]]])
    return corner if (np.abs(corner) < 1e9).all() else np.zeros((1, 2))


def _refuse_none(points: int, source: Path, surface: SurfaceChoice) -> None:
    if points:
        return
    if surface == "bed":
        raise InputError(
            f"{source}: has no point of class {BATHYMETRIC_POINT} (bed) that is not withheld;"
            " correct the cloud first, or grid the surface all."
        )
    raise InputError(
        f"{source}: all points are noise (classes 7 and 18) or withheld; classify it again."
    )


def _warn_of_fine_cells(spacing_m: float, resolution_m: float) -> None:
    if resolution_m**2 < FEWEST_A_CELL * spacing_m**2:
        density = (resolution_m / spacing_m) ** 2
        warnings.warn(
            f"the resolution {resolution_m:g} m is finer than the points allow: they lie"
            f" {spacing_m:.2g} m apart, so there are {density:.2g} a cell on average; take a"
            " resolution of at least their distance.",
            PcfixWarning,
            stacklevel=5,
        )

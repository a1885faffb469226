"""The points that a raster is made of, sorted by their squares of the plan into files."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.flow.runner import Progress
from pcfix.grid.lattice import Occupancy, Window, cells_of, fits, lattice_over, refuse_size
from pcfix.io.files import Bins
from pcfix.io.las.source import LasSource, coordinates
from pcfix.io.tiles import Tiles, open_cloud
from pcfix.model import BATHYMETRIC_POINT, NOISE_CLASSES, BoolArray, FloatArray, IntArray
from pcfix.options.steps import MIN_RESOLUTION_M, DsmRules, SurfaceChoice

if TYPE_CHECKING:
    import laspy

BLOCK_CELLS = 1024
"""Longest side of a window; a power of two."""
BIN_POINTS = 200_000
"""So many points a square of the store has, on average."""
SIGMA_Z = "SigmaZ"
FEWEST_A_CELL = 0.9
"""Points, on average where there are any; fewer are worth a warning."""
DIMENSIONS = {"depth": "WaterDepth", "uncertainty": SIGMA_Z}
"""What is not height is made of a dimension: of one of these, or of that of its own name."""
SPARSE = 20.0
"""Cells a point, from which it is looked whether some points lie far from the others."""
BULK_SAMPLE, BEYOND_BULK = 1_000_000, 1e-3


def point_spacing_m(cloud: Path | Tiles, settings: DsmRules) -> float:
    """Return the side of the square that each point of a raster has for itself, metres."""
    with open_cloud(cloud) as source:
        area, _ = _stated_extent(source, MIN_RESOLUTION_M)
        near = Occupancy(area, len(source), MIN_RESOLUTION_M)
        for points in source.chunks():
            near.add(coordinates(points)[_wanted(points, settings.surface)])
    _refuse_none(near.points, cloud, settings.surface)
    return near.spacing_m


class SortedPoints:
    """The points that a raster is made of, in a folder of the caller, and the raster's lattice.

    Attributes
    ----------
    near : Occupancy
        How many points there are, and how close together.
    stray : int
        How many are left out, as they lie far from all others.
    lattice : Lattice

    Raises
    ------
    PcfixError
        If no points are left, or the raster would be too large.
    """

    def __init__(
        self, source: LasSource, settings: DsmRules, folder: Path, progress: Progress,
        again: Callable[[], LasSource],
    ) -> None:  # fmt: skip
        """Read the cloud, store the wanted points, and lay out the raster.

        Where its extent looks too large for its points it is opened `again`, to be looked at first.
        """
        resolution = settings.cell_m
        self._resolution_m = resolution
        area, corner = _stated_extent(source, resolution)
        self._dimension = _dimension_of(source, settings.what)
        cells = max(np.sqrt(BIN_POINTS / (len(source) / area)) / resolution, 1.0)
        side = int(min(2 ** np.floor(np.log2(cells)), BLOCK_CELLS))  # of a square with so many
        self._bins = Bins(folder, side, cells_of(corner, resolution)[0], 3)
        self.near = Occupancy(area, len(source), resolution)
        sparse = area > SPARSE * len(source) * resolution**2
        bulk = _bulk_of(again, len(source), resolution) if sparse else None
        self.stray, first = 0, None
        done = 0
        for points in source.chunks():
            xyz = coordinates(points)
            if self._dimension is not None:
                xyz[:, 2] = source.dimension(points, self._dimension)
            wanted = _wanted(points, settings.surface) & np.isfinite(xyz[:, 2])
            if self._dimension == SIGMA_Z:
                wanted &= xyz[:, 2] > 0.0  # others have none
            xyz = xyz[wanted]
            if bulk is not None:
                inside = ((xyz[:, :2] >= bulk[0]) & (xyz[:, :2] <= bulk[1])).all(axis=1)
                self.stray += int((~inside).sum())
                first = xyz[~inside][0] if first is None and not inside.all() else first
                xyz = xyz[inside]
            self.near.add(xyz)
            if len(xyz) and fits(self.near.low, self.near.high, resolution):
                self._bins.add(cells_of(xyz, resolution), xyz)
            # too large a raster is refused below, when the whole extent is known
            done += len(points)
            progress(done, len(source))
        _refuse_none(self.near.points, source.path, settings.surface)
        if first is not None:
            place = ", ".join(f"{value:,.2f}" for value in first)
            sentence = (
                f"{source.path}: {self.stray:,} points far from all others are not gridded, the"
                f" first at {place}. Remove them, or grid their part of the cloud separately."
            )
            warnings.warn(PcfixWarning("dsm.stray", sentence, points=self.stray), stacklevel=3)
        low, high, spacing_m = self.near.low, self.near.high, self.near.spacing_m
        refuse_size(low, high, resolution, str(source.path))
        if resolution**2 < FEWEST_A_CELL * spacing_m**2:
            density = (resolution / spacing_m) ** 2
            sentence = (
                f"The resolution {resolution:g} m is finer than the points allow: their spacing is"
                f" {spacing_m:.2g} m, or {density:.2g} points a cell. Use at least that spacing."
            )
            warnings.warn(PcfixWarning("dsm.fine", sentence, spacing_m=spacing_m), stacklevel=4)
        self.lattice = lattice_over(low, high, resolution)

    def windows(self, limit: int) -> Iterator[Window]:
        """Yield windows that cover the raster, small enough to have about `limit` points."""
        for window in self.lattice.windows(BLOCK_CELLS):
            yield from self._halved(window, BLOCK_CELLS, limit)

    def _halved(self, window: Window, side: int, limit: int) -> Iterator[Window]:
        """Yield a window, or its quarters where it has too many points."""
        stored = window.moved(self.lattice.first_row, self.lattice.first_column)
        if side <= self._bins.side or self._bins.count(stored) <= limit:
            yield window
            return
        half = side // 2
        for row in range(window.row, window.row_stop, half):
            for column in range(window.column, window.column_stop, half):
                quarter = Window(row, row + half, column, column + half).clipped(window)
                yield from self._halved(quarter, half, limit)

    def points_in(self, window: Window) -> tuple[FloatArray, IntArray]:
        """Return the points of a window, and their columns and rows in the raster.

        The first are metres in the world frame, shape (n, 3), with what the raster is made of in
        the place of z; the second have shape (n, 2).
        """
        row, column = self.lattice.first_row, self.lattice.first_column
        xyz = self._bins.read(window.moved(row, column))
        cell = cells_of(xyz, self._resolution_m) - [column, row]
        rows = window.holds(cell)
        return xyz[rows], cell[rows]


def _dimension_of(source: LasSource, what: str) -> str | None:
    """Return the dimension that a raster is made of, None for heights."""
    name = None if what == "height" else DIMENSIONS.get(what, what)
    known = list(source.header.point_format.dimension_names)
    if name is None or name in known:
        return name
    if what in DIMENSIONS:
        raise InputError(
            "cloud.no_dimension",
            f"{source.path}: has no dimension {name}, which --what {what} needs. Correct the cloud"
            " first, with --dimensions all.",
            path=source.path, dimension=name,
        )  # fmt: skip
    raise SettingError(
        "option.choice",
        f"{source.path}: has no dimension {what}. --what is one of height, {', '.join(DIMENSIONS)},"
        f" {', '.join(known)}.",
        option="what", value=what,
    )  # fmt: skip


def _wanted(points: laspy.ScaleAwarePointRecord, surface: SurfaceChoice) -> BoolArray:
    classes = np.asarray(points["classification"])
    wanted = classes == BATHYMETRIC_POINT if surface == "bed" else ~np.isin(classes, NOISE_CLASSES)
    return np.asarray(wanted & ~np.asarray(points["withheld"]).astype(bool))


def _stated_extent(source: LasSource, resolution_m: float) -> tuple[float, FloatArray]:
    """Return area and north-west corner, shape (1, 2), of the header; they need not be right."""
    low, high = source.header.mins[:2], source.header.maxs[:2]
    area, corner = float(np.prod(high - low)), np.array([[low[0], high[1]]])
    area = max(area, resolution_m**2) if np.isfinite(area) else resolution_m**2
    return area, corner if (np.abs(corner) < 1e9).all() else np.zeros((1, 2))


def _bulk_of(again: Callable[[], LasSource], count: int, resolution_m: float) -> FloatArray:
    """Return the south-west and north-east corner of where nearly all points lie, shape (2, 2).

    The box that all but a thousandth are in, to either side, grows by its own size; a cloud of two
    places has all in it.
    """
    step = 1 + count // BULK_SAMPLE
    with again() as cloud:
        some = [coordinates(points)[::step, :2] for points in cloud.chunks()]
    low, high = np.quantile(np.vstack(some), (BEYOND_BULK, 1.0 - BEYOND_BULK), axis=0)
    size = np.maximum(high - low, resolution_m)
    return np.array([low - size, high + size])


def _refuse_none(points: int, source: Path | Tiles, surface: SurfaceChoice) -> None:
    if points:
        return
    if surface == "bed":
        raise InputError(
            "dsm.no_bed",
            f"{source}: has no point of class {BATHYMETRIC_POINT} (bed) that is not withheld."
            " Correct the cloud first, or use --surface all.",
            path=source,
        )
    raise InputError(
        "cloud.all_withheld",
        f"{source}: all points are noise (classes 7 and 18) or withheld. Classify it again.",
        path=source,
    )

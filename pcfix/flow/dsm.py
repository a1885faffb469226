"""A LAS or LAZ cloud to a raster of heights, with bounded memory.

The points go once through, into files for squares of the plan; then the raster is made window by
window. Whatever decides on a cell is read with its window, so the raster does not depend on where
chunks, squares and windows end.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.flow.runner import FileTask, Progress, file_task
from pcfix.grid.delaunay import fill_holes, margin_cells
from pcfix.grid.heights import Gridding, grid_window
from pcfix.grid.lattice import Occupancy, Window, cells_of, fits, lattice_over, refuse_size
from pcfix.grid.model import NO_LIGHT, DsmSummary, Tally, hillshade
from pcfix.io import rasters
from pcfix.io.files import Bins, replaced_when_whole
from pcfix.io.las.source import LasSource, coordinates, metric_crs
from pcfix.io.las.writing import is_ours
from pcfix.model import BATHYMETRIC_POINT, NOISE_CLASSES, BoolArray, FloatArray, IntArray
from pcfix.options.declare import File, taken
from pcfix.options.steps import DsmOptions, DsmRules, SurfaceChoice
from pcfix.version import __version__

if TYPE_CHECKING:
    import laspy
    from rasterio.io import DatasetWriter

BLOCK_CELLS = 1024
"""Longest side of a window; a power of two."""
BIN_POINTS = 200_000
"""So many points a square of the store has, on average."""
SIGMA_Z = "SigmaZ"
FEWEST_A_CELL = 0.9
"""Points, on average where there are any; fewer are worth a warning."""
BLOCK_POINTS = 2_000_000
TIN_BLOCK_POINTS = 400_000
"""Windows are halved until they have no more points than this."""
TIN_REACH_SPACINGS = 5.0
TIN_REACH_CELLS = 3.0
"""Circles around triangles may be as wide as the larger of the two, or as --fill."""

BANDS = {"height": "metre", "count": "", "spread": "metre"}
HEIGHT, *_ = ALL_BANDS = (1, 2, 3, 4)
WITH_SIGMA = {**BANDS, "uncertainty": "metre"}
"""Of clouds that have standard errors of Z."""


def grid_dsm(
    input: File,
    output: File,
    *,
    options: DsmOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> DsmSummary:
    """Grid a cloud to a GeoTIFF of heights; what ``pcfix dsm`` runs.

    The file has three bands of float32: height (m), count (points in the cell) and spread
    (population standard deviation of their heights, m). A cell without a height holds -9999, the
    nodata value, and count 0. A cell with a height and count 0 has no points of its own: its
    height was interpolated, and its spread is nodata.

    A cloud with the dimension ``SigmaZ``, as `pcfix.correct_file` writes it, gives a fourth band,
    uncertainty: the standard uncertainty of the height (m), the root mean square of the ``SigmaZ``
    of the cell's corrected points; see `pcfix.grid.heights.cell_uncertainty`. Nodata without any.

    Parameters
    ----------
    input : path
        LAS or LAZ, in metres.
    output : path
        The name ends in ``.tif`` or ``.tiff``.
    options : DsmOptions, optional
        Or its attributes as keywords, as of ``pcfix dsm``, resolution (m) among them. The bounds
        of the raster are multiples of it; a point on an edge belongs to the cell east or north of
        it. Of the methods "idw" weights points around the centre of cells that have some with 1 /
        distance squared; "tin" takes the height at the centre from Delaunay's triangles, and fill
        is the width of the widest circle without a point that is bridged, by default five times
        the spacing of the points and at least three cells. Withheld points and noise (classes 7
        and 18) are never used. The hillshade is uint8: 1 dark to 255 bright, nodata 0.
    progress : callable, optional
        Called with (points done, points in all), reading and gridding counting half each.

    Returns
    -------
    DsmSummary

    Raises
    ------
    PcfixError
        With one sentence on what to mend; no output is left behind.

    Warns
    -----
    PcfixWarning
        If the cells are so small that most would have no point.
    """
    given = taken(DsmOptions, options, keywords, "grid_dsm")
    if given.resolution is None:
        raise SettingError("resolution is missing: give the side of a cell, metres.")
    more = [] if given.hillshade is None else [given.hillshade]
    task = file_task(input, output, given, more=more, check=rasters.check_tif, progress=progress)
    if given.cog:
        rasters.check_cog()
    run = _Run(task, given.part(DsmRules), given.cog)
    with ExitStack() as stack:
        drafts = [stack.enter_context(replaced_when_whole(Path(one))) for one in (output, *more)]
        folder = TemporaryDirectory(dir=task.target.parent, prefix=".pcfix-dsm-")
        run.write(Path(stack.enter_context(folder)), *drafts)
    result = run.summary(None if given.hillshade is None else str(Path(given.hillshade)))
    task.tell(result.as_dict())
    return result


@dataclass
class _Run:
    """One cloud on its way into a raster."""

    task: FileTask
    settings: DsmRules
    cog: bool
    tally: Tally = field(default_factory=Tally)

    def write(self, folder: Path, draft: Path, shade: Path | None = None) -> None:
        """Write the raster, and its hillshade if a path is given."""
        with LasSource(self.task.source) as source:
            self.crs, self.points = metric_crs(source), len(source)
            corrected = any(is_ours(vlr) for vlr in source.vlrs)
            self.sorted = SortedPoints(
                source, self.settings, folder, lambda done, total: self.report(0.5 * done / total)
            )
        self.near, self.lattice = self.sorted.near, self.sorted.lattice
        plain = folder / "dsm.tif" if self.cog else draft
        made = {"pcfix": __version__, "corrected": corrected, **asdict(self.settings)}
        tags = {"PCFIX": json.dumps(made)}
        bands = WITH_SIGMA if self.sorted.has_sigma else BANDS
        with rasters.new_raster(plain, self.lattice, self.crs, bands, tags=tags) as dsm:
            if self.settings.fill is None or self.settings.method == "tin":
                self.grid(dsm, dsm)
            else:
                self.grid_and_fill(dsm, folder / "unfilled.tif")
        if shade is not None:
            self.shade(plain, shade, folder)
        self.finish(plain, draft)

    def grid(self, heights: DatasetWriter, dsm: DatasetWriter) -> None:
        """Write heights to one raster, the other bands to another (or the same)."""
        done, lattice = 0, self.lattice
        how = Gridding(lattice, self.settings.method, self.reach_m, self.near.spacing_m)
        into = (heights, dsm, dsm, dsm)
        limit = TIN_BLOCK_POINTS if self.settings.method == "tin" else BLOCK_POINTS
        for window in self.sorted.windows(limit):
            points = self.sorted.points_in(window.grown(how.margin_cells))
            bands = grid_window(*points, window, how)
            for raster, band, values in zip(into, ALL_BANDS, bands, strict=True):
                if values is not None:
                    rasters.write_part(raster, values, window, band)
            self.tally.add(bands)
            done += window.height * window.width
            self.report(0.5 + 0.5 * done / (lattice.height * lattice.width))

    @property
    def reach_m(self) -> float:
        """Width of the widest circle around a triangle of the TIN."""
        spacings = TIN_REACH_SPACINGS * self.near.spacing_m
        cells = TIN_REACH_CELLS * self.settings.resolution
        return max(spacings, cells, self.settings.fill or 0.0)

    def grid_and_fill(self, dsm: DatasetWriter, unfilled: Path) -> None:
        """Write heights to a raster of their own, and from there, with holes filled, to the DSM."""
        with rasters.new_raster(unfilled, self.lattice, None, {"height": "metre"}) as heights:
            self.grid(heights, dsm)
        widest = (self.settings.fill or 0.0) / self.settings.resolution
        with rasters.open_raster(unfilled) as heights:
            for window in self.lattice.windows(BLOCK_CELLS):
                around = window.grown(margin_cells(widest)).clipped(self.lattice.window)
                height = fill_holes(rasters.read_heights(heights, around), window, around, widest)
                rasters.write_part(dsm, height, window, HEIGHT)
                self.tally.filled += int((~np.isnan(height)).sum())
        self.tally.filled -= self.tally.known
        self.tally.known += self.tally.filled

    def shade(self, dsm: Path, target: Path, folder: Path) -> None:
        """Write the hillshade of a DSM."""
        plain = folder / "hillshade.tif" if self.cog else target
        band, s = {"hillshade": ""}, self.settings
        with (
            rasters.open_raster(dsm) as heights,
            rasters.new_raster(
                plain, self.lattice, self.crs, band, dtype="uint8", nodata=NO_LIGHT
            ) as out,
        ):
            for window in self.lattice.windows(BLOCK_CELLS):
                wide = window.grown(1)
                around = wide.clipped(self.lattice.window)
                height = np.full((wide.height, wide.width), np.nan)
                height[around.within(wide)] = rasters.read_heights(heights, around)
                light = hillshade(height, s.resolution, s.azimuth, s.altitude)
                rasters.write_part(out, light, window, 1)
        self.finish(plain, target)

    def finish(self, plain: Path, target: Path) -> None:
        """Add overviews; a cloud optimised file is a copy, which brings its own."""
        if self.cog:
            rasters.copy_as_cog(plain, target)
        else:
            rasters.add_overviews(plain)

    def report(self, share: float) -> None:
        """Tell how much is done, in points."""
        if self.task.progress is not None:
            self.task.progress(round(share * self.points), self.points)

    def summary(self, hillshade: str | None) -> DsmSummary:
        """Return the numbers of the run."""
        settings, lattice, tally = self.settings, self.lattice, self.tally
        return DsmSummary(
            input=str(self.task.source),
            output=str(self.task.target),
            hillshade=hillshade,
            pcfix=__version__,
            crs=None if self.crs is None else self.crs.name,
            width=lattice.width,
            height=lattice.height,
            bounds_m=lattice.bounds_m,
            points=self.points,
            points_used=self.near.points,
            cells=tally.cells,
            filled=tally.filled,
            empty=lattice.width * lattice.height - tally.known,
            points_per_cell=self.near.points / tally.cells,
            spacing_m=self.near.spacing_m,
            hole_m=self.reach_m if settings.method == "tin" else settings.fill,
            settings=asdict(settings),
            seconds=round(self.task.seconds, 3),
            uncertainty_m=tally.uncertainty_m(),
        )


class SortedPoints:
    """The points that a raster is made of, in a folder of the caller, and the raster's lattice.

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
        self, source: LasSource, settings: DsmRules, folder: Path, progress: Progress
    ) -> None:
        """Read the cloud, store the wanted points, and lay out the raster."""
        resolution = settings.resolution
        self._resolution_m = resolution
        area, corner = _stated_extent(source, resolution)
        self.has_sigma = SIGMA_Z in source.header.point_format.dimension_names
        cells = max(np.sqrt(BIN_POINTS / (len(source) / area)) / resolution, 1.0)
        side = int(min(2 ** np.floor(np.log2(cells)), BLOCK_CELLS))  # of a square with so many
        self._bins = Bins(folder, side, cells_of(corner, resolution)[0], 4 if self.has_sigma else 3)
        self.near = Occupancy(area, len(source), resolution)
        done = 0
        for points in source.chunks():
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
        rows = window.holds(cell)
        return xyz[rows], cell[rows]


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


def _refuse_none(points: int, source: Path, surface: SurfaceChoice) -> None:
    if not points and surface == "bed":
        raise InputError(
            f"{source}: has no point of class {BATHYMETRIC_POINT} (bed) that is not withheld;"
            " correct the cloud first, or grid the surface all."
        )
    if not points:
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

"""A LAS or LAZ cloud to a raster of heights, depths or whatever it holds, with bounded memory.

The points go once through, into files for squares of the plan; then the raster is made window by
window. Whatever decides on a cell is read with its window, so the raster does not depend on where
chunks, squares and windows end.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.flow.runner import FileTask, Progress, file_task
from pcfix.grid.delaunay import fill_holes, margin_cells
from pcfix.grid.heights import Gridding, as_uncertainty, grid_window
from pcfix.grid.lattice import (
    Occupancy,
    Window,
    cells_of,
    fits,
    lattice_over,
    refuse_size,
    round_resolution,
)
from pcfix.grid.model import NO_LIGHT, DsmSummary, Tally, hillshade
from pcfix.io import rasters
from pcfix.io.crs import crs_words, parts
from pcfix.io.drafts import draft_folder, replaced_when_whole
from pcfix.io.files import Bins, check_output, write_text
from pcfix.io.las.part import part_report
from pcfix.io.las.source import LasSource, coordinates, metric_crs
from pcfix.io.las.writing import is_ours
from pcfix.io.styles import raster_style
from pcfix.io.tiles import Clouds, Tiles, inputs_of, open_cloud, single, tiles_of
from pcfix.model import BATHYMETRIC_POINT, NOISE_CLASSES, BoolArray, FloatArray, IntArray
from pcfix.options.declare import File, taken
from pcfix.options.steps import MIN_RESOLUTION_M, DsmOptions, DsmRules, SurfaceChoice
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

DIMENSIONS = {"depth": "WaterDepth", "uncertainty": SIGMA_Z}
"""What is not height is made of a dimension: of one of these, or of that of its own name."""
METRE = "metre"


def grid_dsm(
    input: Clouds,
    output: File,
    *,
    options: DsmOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> DsmSummary:
    """Grid a cloud to a GeoTIFF of heights or of another quantity; what ``pcfix dsm`` runs.

    The file has one band of float32, -9999 (nodata) where a cell has no value. Heights keep the
    vertical datum that the cloud states, if any; a file of anything else has the plan alone, as
    programs would take its values for heights.

    Depth is `WaterDepth`, and uncertainty the vertical one at 95 %, of the bed (class 40), as
    `pcfix.correct_file` leaves them; see `pcfix.grid.heights.as_uncertainty`.

    With `counts` a second file has two bands: count (points in the cell) and spread (population
    standard deviation of their values). A cell that has a value and count 0 has no points of its
    own: its value was interpolated, and its spread is nodata.

    Parameters
    ----------
    input : path, or list of paths
        LAS or LAZ, in metres; of many, as `pcfix.io.tiles.tiles_of` has them, one raster is made.
    output : path
        The name ends in ``.tif`` or ``.tiff``.
    options : DsmOptions, optional
        Or its attributes as keywords, as of ``pcfix dsm``. The bounds of the raster are multiples
        of the resolution (m); a point on an edge belongs to the cell east or north of it. Without
        one it is chosen by `pcfix.grid.lattice.round_resolution`. Of the methods "idw" weights
        points around the centre of cells that have some with 1 / distance squared; "tin" takes the
        height at the centre from Delaunay's triangles, and fill is the width of the widest circle
        without a point that is bridged, by default five times the spacing of the points and at
        least three cells. Withheld points and noise (classes 7 and 18) are never used. The
        hillshade is uint8: 1 dark to 255 bright, nodata 0.
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
    more = {name: getattr(given, name) for name in ("hillshade", "counts")}
    more = {name: Path(path) for name, path in more.items() if path is not None}
    tiles = tiles_of(input)
    task = file_task(
        single(input) if tiles is None else tiles, output, given,
        more=more.values(), check=rasters.check_tif, progress=progress,
    )  # fmt: skip
    cloud = tiles or task.source
    style = task.target.with_suffix(".qml")
    if given.style:
        check_output(style, overwrite=given.overwrite, inputs=inputs_of(cloud))
    if given.cog:
        rasters.check_cog()
    rules = given.part(DsmRules)
    if given.resolution is None:
        spacing_m = point_spacing_m(cloud, rules)
        rules = replace(rules, resolution=round_resolution(spacing_m, 0.0))
    run = _Run(task, cloud, rules, given.cog)
    with ExitStack() as stack:
        drafts = {
            name: stack.enter_context(replaced_when_whole(path))
            for name, path in {"dsm": task.target, **more}.items()
        }
        run.write(stack.enter_context(draft_folder(task.target.parent)), **drafts)
    if given.style:
        write_text(style, raster_style(task.target, rules.what), overwrite=given.overwrite)
    result = replace(
        run.summary(),
        hillshade=str(more["hillshade"]) if "hillshade" in more else None,
        counts=str(more["counts"]) if "counts" in more else None,
        resolution_is="given" if given.resolution else "chosen",
    )
    task.tell(result.as_dict())
    return result


def point_spacing_m(cloud: Path | Tiles, settings: DsmRules) -> float:
    """Return the side of the square that each point of a raster has for itself, metres."""
    with open_cloud(cloud) as source:
        area, _ = _stated_extent(source, MIN_RESOLUTION_M)
        near = Occupancy(area, len(source), MIN_RESOLUTION_M)
        for points in source.chunks():
            near.add(coordinates(points)[_wanted(points, settings.surface)])
    _refuse_none(near.points, cloud, settings.surface)
    return near.spacing_m


@dataclass
class _Run:
    """One cloud on its way into a raster."""

    task: FileTask
    cloud: Path | Tiles
    settings: DsmRules
    cog: bool
    tally: Tally = field(default_factory=Tally)

    def write(
        self, folder: Path, dsm: Path, hillshade: Path | None = None, counts: Path | None = None
    ) -> None:
        """Write the raster, and its hillshade and its counts if paths are given."""
        with open_cloud(self.cloud) as source:
            self.crs, self.points = metric_crs(source), len(source)
            self.plan = None if self.crs is None else parts(self.crs)[0]
            corrected = any(is_ours(vlr) for vlr in source.vlrs)
            self.sorted = SortedPoints(
                source, self.settings, folder, lambda done, total: self.report(0.5 * done / total)
            )
        self.near, self.lattice = self.sorted.near, self.sorted.lattice
        made = {"pcfix": __version__, "corrected": corrected, **asdict(self.settings)}
        tags, what = {"PCFIX": json.dumps(made)}, self.settings.what
        unit = METRE if what in ("height", *DIMENSIONS) else ""
        crs = self.crs if what == "height" else self.plan
        plain = folder / "dsm.tif" if self.cog else dsm
        numbers = folder / "counts.tif" if self.cog else counts
        with ExitStack() as stack:
            new = partial(rasters.new_raster, lattice=self.lattice, tags=tags)
            out, both = stack.enter_context(new(plain, crs=crs, bands={what: unit})), None
            if counts is not None and numbers is not None:
                bands = {"count": "", "spread": unit}
                both = stack.enter_context(new(numbers, crs=self.plan, bands=bands))
            if self.settings.fill is None or self.settings.method == "tin":
                self.grid(out, both)
            else:
                self.grid_and_fill(out, both, folder / "unfilled.tif")
        if hillshade is not None:
            self.shade(plain, hillshade, folder)
        self.finish(plain, dsm)
        if counts is not None and numbers is not None:
            self.finish(numbers, counts)

    def grid(self, heights: DatasetWriter, counts: DatasetWriter | None) -> None:
        """Write values to one raster, the numbers of points and their spread to another."""
        done, lattice = 0, self.lattice
        how = Gridding(lattice, self.settings.method, self.reach_m, self.near.spacing_m)
        into = ((heights, 1), (counts, 1), (counts, 2))
        limit = TIN_BLOCK_POINTS if self.settings.method == "tin" else BLOCK_POINTS
        for window in self.sorted.windows(limit):
            points = self.sorted.points_in(window.grown(how.margin_cells))
            bands = grid_window(*points, window, how)
            if self.settings.what == "uncertainty":
                bands = as_uncertainty(bands)
            for (raster, band), values in zip(into, bands, strict=True):
                if raster is not None:
                    rasters.write_part(raster, values, window, band)
            self.tally.add(bands)
            done += window.height * window.width
            self.report(0.5 + 0.5 * done / (lattice.height * lattice.width))

    @property
    def reach_m(self) -> float:
        """Width of the widest circle around a triangle of the TIN."""
        spacings = TIN_REACH_SPACINGS * self.near.spacing_m
        cells = TIN_REACH_CELLS * self.settings.cell_m
        return max(spacings, cells, self.settings.fill or 0.0)

    def grid_and_fill(
        self, dsm: DatasetWriter, counts: DatasetWriter | None, unfilled: Path
    ) -> None:
        """Write values to a raster of their own, and from there, with holes filled, to the DSM."""
        with rasters.new_raster(unfilled, self.lattice, None, {"height": METRE}) as heights:
            self.grid(heights, counts)
        widest = (self.settings.fill or 0.0) / self.settings.cell_m
        with rasters.open_raster(unfilled) as heights:
            for window in self.lattice.windows(BLOCK_CELLS):
                around = window.grown(margin_cells(widest)).clipped(self.lattice.window)
                height = fill_holes(rasters.read_heights(heights, around), window, around, widest)
                rasters.write_part(dsm, height, window, 1)
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
                plain, self.lattice, self.plan, band, dtype="uint8", nodata=NO_LIGHT
            ) as out,
        ):
            for window in self.lattice.windows(BLOCK_CELLS):
                height = rasters.read_within(heights, window.grown(1), self.lattice.window)
                light = hillshade(height, s.cell_m, s.azimuth, s.altitude)
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

    def summary(self) -> DsmSummary:
        """Return the numbers of the run."""
        settings, lattice, tally = self.settings, self.lattice, self.tally
        return DsmSummary(
            input=str(self.task.source),
            output=str(self.task.target),
            hillshade=None,
            counts=None,
            what=settings.what,
            pcfix=__version__,
            crs=None if self.crs is None else self.crs.name,
            heights=crs_words(self.crs)[1] or None,
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
            values=tally.values(),
            part=part_report(self.task.source),
        )


class SortedPoints:
    """The points that a raster is made of, in a folder of the caller, and the raster's lattice.

    Attributes
    ----------
    near : Occupancy
        How many points there are, and how close together.
    lattice : Lattice

    Raises
    ------
    PcfixError
        If no points are left, or the raster would be too large.
    """

    def __init__(
        self, source: LasSource, settings: DsmRules, folder: Path, progress: Progress
    ) -> None:
        """Read the cloud, store the wanted points, and lay out the raster."""
        resolution = settings.cell_m
        self._resolution_m = resolution
        area, corner = _stated_extent(source, resolution)
        self._dimension = _dimension_of(source, settings.what)
        cells = max(np.sqrt(BIN_POINTS / (len(source) / area)) / resolution, 1.0)
        side = int(min(2 ** np.floor(np.log2(cells)), BLOCK_CELLS))  # of a square with so many
        self._bins = Bins(folder, side, cells_of(corner, resolution)[0], 3)
        self.near = Occupancy(area, len(source), resolution)
        done = 0
        for points in source.chunks():
            xyz = coordinates(points)
            if self._dimension is not None:
                xyz[:, 2] = source.dimension(points, self._dimension)
            wanted = _wanted(points, settings.surface) & np.isfinite(xyz[:, 2])
            if self._dimension == SIGMA_Z:
                wanted &= xyz[:, 2] > 0.0  # others have none
            xyz = xyz[wanted]
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
        return window.moved(self.lattice.first_row, self.lattice.first_column)

    def points_in(self, window: Window) -> tuple[FloatArray, IntArray]:
        """Return the points of a window, and their columns and rows in the raster.

        The first are metres in the world frame, shape (n, 3), with what the raster is made of in
        the place of z; the second have shape (n, 2).
        """
        xyz = self._bins.read(self._stored(window))
        first = [self.lattice.first_column, self.lattice.first_row]
        cell = cells_of(xyz, self._resolution_m) - first
        rows = window.holds(cell)
        return xyz[rows], cell[rows]


def _dimension_of(source: LasSource, what: str) -> str | None:
    """Return the dimension that a raster is made of, None of heights; refuse what is not there."""
    name = None if what == "height" else DIMENSIONS.get(what, what)
    known = list(source.header.point_format.dimension_names)
    if name is None or name in known:
        return name
    if what in DIMENSIONS:
        raise InputError(
            f"{source.path}: has no dimension {name}, of which the {what} is made; correct the"
            " cloud first, with --dimensions all."
        )
    raise SettingError(
        f"{source.path}: has no dimension {what}; --what is one of height, {', '.join(DIMENSIONS)},"
        f" {', '.join(known)}."
    )


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


def _refuse_none(points: int, source: Path | Tiles, surface: SurfaceChoice) -> None:
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

"""Grid a LAS or LAZ cloud to a raster of heights, depths or another quantity, in bounded memory.

The points are sorted once into files for squares of the plan; then the raster is made window by
window. All points that decide on a cell are read with its window, so that the raster does not
depend on the size of chunks, squares and windows.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.flow.runner import FileTask, Progress, file_task, write_summary
from pcfix.flow.sorted_points import BLOCK_CELLS, DIMENSIONS, SortedPoints, point_spacing_m
from pcfix.grid.delaunay import fill_holes, margin_cells
from pcfix.grid.heights import Gridding, as_uncertainty, grid_window
from pcfix.grid.lattice import round_resolution
from pcfix.grid.model import NO_LIGHT, DsmSummary, Tally, hillshade
from pcfix.io import rasters
from pcfix.io.atomic import scratch_folder, temporary_output
from pcfix.io.crs import crs_words, parts
from pcfix.io.files import check_output, write_text
from pcfix.io.las.part import part_report
from pcfix.io.las.source import metric_crs
from pcfix.io.las.writing import is_ours
from pcfix.io.styles import raster_style
from pcfix.io.tiles import Clouds, Tiles, cloud_of, inputs_of, open_cloud
from pcfix.options.declare import File, taken
from pcfix.options.steps import DsmOptions, DsmRules
from pcfix.version import __version__

if TYPE_CHECKING:
    from rasterio.io import DatasetWriter

BLOCK_POINTS = 2_000_000
TIN_BLOCK_POINTS = 400_000
"""Windows are halved until they have at most so many points."""
TIN_REACH_SPACINGS = 5.0
TIN_REACH_CELLS = 3.0
"""Largest diameter of circles around triangles: the larger of the two, or --fill."""

METRE = "metre"


def grid_dsm(
    input: Clouds,
    output: File,
    *,
    options: DsmOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> DsmSummary:
    """Grid a cloud to a GeoTIFF of heights or another quantity; what ``pcfix dsm`` runs.

    The file has one band of float32, -9999 (nodata) if a cell has no value. Heights keep the
    vertical datum of the cloud; other quantities have the horizontal CRS only, as programs would
    take their values for heights. Depth is `WaterDepth`, and uncertainty the vertical one at 95 %,
    of the bed (class 40), as `pcfix.correct_file` writes them; see
    `pcfix.grid.heights.as_uncertainty`.

    With `counts` a second file has two bands: count (points in the cell) and spread (population
    standard deviation of their values). A cell with a value and count 0 was interpolated.

    Parameters
    ----------
    input : path, or list of paths
        LAS or LAZ, in metres; many, as `pcfix.io.tiles.tiles_of` has them, make one raster.
    output : path
        The name ends in ``.tif`` or ``.tiff``.
    options : DsmOptions, optional
        Or its attributes as keywords: the options of ``pcfix dsm``. The bounds of the raster are
        multiples of the resolution (m), by default that of `pcfix.grid.lattice.round_resolution`; a
        point on an edge belongs to the cell east or north of it. The method "idw" weights points
        around the centre with 1 / distance squared; "tin" uses Delaunay triangles, and fill is the
        diameter of the widest circle without a point, by default five times the spacing of the
        points and at least three cells. Withheld points and noise (classes 7 and 18) are not used.
        The hillshade is uint8: 1 dark to 255 bright, nodata 0.
    progress : callable, optional
        Called with (points done, all points); reading and gridding count half each.

    Returns
    -------
    DsmSummary

    Raises
    ------
    PcfixError
        If a file, an option or the cloud cannot be used; no output is left behind.

    Warns
    -----
    PcfixWarning
        If the cells are so small that most have no point.
    """
    given = taken(DsmOptions, options, keywords, "grid_dsm")
    more = {name: getattr(given, name) for name in ("hillshade", "counts")}
    more = {name: Path(path) for name, path in more.items() if path is not None}
    cloud = cloud_of(input)
    task = file_task(
        cloud, output, given,
        more=more.values(), check=rasters.check_tif, progress=progress,
    )  # fmt: skip
    cloud = cloud if isinstance(cloud, Tiles) else task.source
    style = task.target.with_suffix(".qml")
    if given.style:
        check_output(style, overwrite=given.overwrite, inputs=inputs_of(cloud))
    rules = given.part(DsmRules)
    if given.resolution is None:
        spacing_m = point_spacing_m(cloud, rules)
        rules = replace(rules, resolution=round_resolution(spacing_m, 0.0))
    with ExitStack() as stack:
        targets = {"dsm": task.target, **more}
        drafts = {
            name: stack.enter_context(temporary_output(path)) for name, path in targets.items()
        }
        folder = stack.enter_context(scratch_folder(task.target))
        gridding = _Gridding(task, cloud, rules, given.cog, folder)
        gridding.write(**drafts)
    if given.style:
        write_text(style, raster_style(task.target, rules.what), overwrite=given.overwrite)
    result = replace(
        gridding.summary(),
        hillshade=str(more["hillshade"]) if "hillshade" in more else None,
        counts=str(more["counts"]) if "counts" in more else None,
        resolution_is="given" if given.resolution else "chosen",
    )
    write_summary(task, result.as_dict())
    return result


class _Gridding:
    """The gridding of one cloud: its sorted points, and the rasters that are made of them."""

    def __init__(
        self, task: FileTask, cloud: Path | Tiles, settings: DsmRules, cog: bool, folder: Path
    ) -> None:
        """Sort the points into files of a temporary folder."""
        self.task, self.settings, self.cog, self.folder = task, settings, cog, folder
        self.tally = Tally()
        with open_cloud(cloud) as source:
            self.crs, self.points = metric_crs(source), len(source)
            self.corrected = any(is_ours(vlr) for vlr in source.vlrs)
            self.sorted = SortedPoints(
                source, settings, folder, lambda done, total: self.report(0.5 * done / total),
                lambda: open_cloud(cloud, places_only=True),
            )  # fmt: skip
        self.plan = None if self.crs is None else parts(self.crs)[0]
        self.near, self.lattice = self.sorted.near, self.sorted.lattice
        spacings = TIN_REACH_SPACINGS * self.near.spacing_m
        cells = TIN_REACH_CELLS * settings.cell_m
        self.reach_m = max(spacings, cells, settings.fill or 0.0)  # widest circle of the TIN

    def write(self, dsm: Path, hillshade: Path | None = None, counts: Path | None = None) -> None:
        """Write the raster, and its hillshade and its counts if paths are given."""
        what, folder = self.settings.what, self.folder
        made = {"pcfix": __version__, "corrected": self.corrected, **asdict(self.settings)}
        unit = METRE if what in ("height", *DIMENSIONS) else ""
        crs = self.crs if what == "height" else self.plan
        plain = folder / "dsm.tif" if self.cog else dsm
        numbers = folder / "counts.tif" if self.cog else counts
        new = partial(rasters.new_raster, lattice=self.lattice, tags={"PCFIX": json.dumps(made)})
        with ExitStack() as stack:
            out, both = stack.enter_context(new(plain, crs=crs, bands={what: unit})), None
            if numbers is not None and counts is not None:
                bands = {"count": "", "spread": unit}
                both = stack.enter_context(new(numbers, crs=self.plan, bands=bands))
            if self.settings.fill is None or self.settings.method == "tin":
                self.grid(out, both)
            else:
                self.grid_and_fill(out, both)
        if hillshade is not None:
            self.shade(plain, hillshade)
        self.finish(plain, dsm)
        if numbers is not None and counts is not None:
            self.finish(numbers, counts)

    def grid(self, heights: DatasetWriter, counts: DatasetWriter | None) -> None:
        """Write values to one raster, numbers of points and their spread to another."""
        done, lattice = 0, self.lattice
        how = Gridding(lattice, self.settings.method, self.reach_m, self.near.spacing_m)
        limit = TIN_BLOCK_POINTS if self.settings.method == "tin" else BLOCK_POINTS
        for window in self.sorted.windows(limit):
            points = self.sorted.points_in(window.grown(how.margin_cells))
            bands = grid_window(*points, window, how)
            if self.settings.what == "uncertainty":
                bands = as_uncertainty(bands)
            rasters.write_part(heights, bands[0], window, 1)
            if counts is not None:
                for band, values in enumerate(bands[1:], start=1):
                    rasters.write_part(counts, values, window, band)
            self.tally.add(bands)
            done += window.height * window.width
            self.report(0.5 + 0.5 * done / (lattice.height * lattice.width))

    def grid_and_fill(self, dsm: DatasetWriter, counts: DatasetWriter | None) -> None:
        """Write values to a temporary raster, and from there, with holes filled, to the DSM."""
        unfilled, tally = self.folder / "unfilled.tif", self.tally
        with rasters.new_raster(unfilled, self.lattice, None, {"height": METRE}) as heights:
            self.grid(heights, counts)
        widest = (self.settings.fill or 0.0) / self.settings.cell_m
        with rasters.open_raster(unfilled) as heights:
            for window in self.lattice.windows(BLOCK_CELLS):
                around = window.grown(margin_cells(widest)).clipped(self.lattice.window)
                height = fill_holes(rasters.read_heights(heights, around), window, around, widest)
                rasters.write_part(dsm, height, window, 1)
                tally.filled += int((~np.isnan(height)).sum())
        tally.filled -= tally.known
        tally.known += tally.filled

    def shade(self, dsm: Path, target: Path) -> None:
        """Write the hillshade of a DSM."""
        plain = self.folder / "hillshade.tif" if self.cog else target
        s, bands = self.settings, {"hillshade": ""}
        new = rasters.new_raster(
            plain, self.lattice, self.plan, bands, dtype="uint8", nodata=NO_LIGHT
        )
        with rasters.open_raster(dsm) as heights, new as out:
            for window in self.lattice.windows(BLOCK_CELLS):
                height = rasters.read_within(heights, window.grown(1), self.lattice.window)
                light = hillshade(height, s.cell_m, s.azimuth, s.altitude)
                rasters.write_part(out, light, window, 1)
        self.finish(plain, target)

    def finish(self, plain: Path, target: Path) -> None:
        """Add overviews; a cloud optimised file is a copy with its own."""
        if self.cog:
            rasters.copy_as_cog(plain, target)
        else:
            rasters.add_overviews(plain)

    def report(self, share: float) -> None:
        """Report the progress, in points."""
        if self.task.progress is not None:
            self.task.progress(round(share * self.points), self.points)

    def summary(self) -> DsmSummary:
        """Return the figures of the raster."""
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
            stray=self.sorted.stray,
        )

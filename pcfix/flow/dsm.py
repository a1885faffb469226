"""Grid a LAS or LAZ cloud to a raster of heights, depths or another quantity, in bounded memory.

The points are sorted once into files for squares of the plan; then the raster is made window by
window. All points that decide on a cell are read with its window, so that the raster does not
depend on the size of chunks, squares and windows.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.flow.runner import Progress, file_task, write_summary
from pcfix.flow.sorted_points import BLOCK_CELLS, DIMENSIONS, SortedPoints, point_spacing_m
from pcfix.grid.delaunay import fill_holes, margin_cells
from pcfix.grid.heights import Gridding, as_uncertainty, grid_window
from pcfix.grid.lattice import Lattice, round_resolution
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

    def report(share: float) -> None:
        """Report the progress, in points."""
        if progress is not None:
            progress(round(share * count), count)

    with ExitStack() as stack:
        targets = {"dsm": task.target, **more}
        drafts = {
            name: stack.enter_context(temporary_output(path)) for name, path in targets.items()
        }
        folder = stack.enter_context(scratch_folder(task.target))
        with open_cloud(cloud) as source:
            crs, count = metric_crs(source), len(source)
            corrected = any(is_ours(vlr) for vlr in source.vlrs)
            points = SortedPoints(
                source, rules, folder, lambda done, total: report(0.5 * done / total),
                lambda: open_cloud(cloud, places_only=True),
            )  # fmt: skip
        lattice, spacing_m = points.lattice, points.near.spacing_m
        fill_m, is_tin = rules.fill or 0.0, rules.method == "tin"
        # the widest circle around a triangle
        reach_m = max(TIN_REACH_SPACINGS * spacing_m, TIN_REACH_CELLS * rules.cell_m, fill_m)
        how = Gridding(lattice, rules.method, reach_m, spacing_m)
        # a cloud optimised file is a copy, with overviews of its own
        paths = {name: folder / f"{name}.tif" if given.cog else drafts[name] for name in drafts}
        plan = None if crs is None else parts(crs)[0]
        unit = METRE if rules.what in ("height", *DIMENSIONS) else ""
        made = {"pcfix": __version__, "corrected": corrected, **asdict(rules)}
        new = partial(rasters.new_raster, lattice=lattice, tags={"PCFIX": json.dumps(made)})
        with ExitStack() as files:
            of_height = crs if rules.what == "height" else plan
            dsm = files.enter_context(new(paths["dsm"], crs=of_height, bands={rules.what: unit}))
            counts = None
            if "counts" in paths:
                bands = {"count": "", "spread": unit}
                counts = files.enter_context(new(paths["counts"], crs=plan, bands=bands))
            if is_tin or rules.fill is None:
                tally = _grid(points, how, rules.what, dsm, counts, report)
            else:
                unfilled = folder / "unfilled.tif"
                with rasters.new_raster(unfilled, lattice, None, {"height": METRE}) as heights:
                    tally = _grid(points, how, rules.what, heights, counts, report)
                _fill(unfilled, dsm, lattice, fill_m / rules.cell_m, tally)
        if "hillshade" in paths:
            _shade(paths["dsm"], paths["hillshade"], lattice, plan, rules)
        for name, path in paths.items():
            if given.cog:
                rasters.copy_as_cog(path, drafts[name])
            else:
                rasters.add_overviews(path)
    if given.style:
        write_text(style, raster_style(task.target, rules.what), overwrite=given.overwrite)
    result = DsmSummary(
        input=str(task.source),
        output=str(task.target),
        hillshade=str(more["hillshade"]) if "hillshade" in more else None,
        counts=str(more["counts"]) if "counts" in more else None,
        what=rules.what,
        pcfix=__version__,
        crs=None if crs is None else crs.name,
        heights=crs_words(crs)[1] or None,
        width=lattice.width,
        height=lattice.height,
        bounds_m=lattice.bounds_m,
        points=count,
        points_used=points.near.points,
        cells=tally.cells,
        filled=tally.filled,
        empty=lattice.width * lattice.height - tally.known,
        points_per_cell=points.near.points / tally.cells,
        spacing_m=spacing_m,
        hole_m=reach_m if is_tin else rules.fill,
        settings=asdict(rules),
        seconds=round(task.seconds, 3),
        values=tally.values(),
        resolution_is="given" if given.resolution else "chosen",
        part=part_report(task.source),
        stray=points.stray,
    )
    write_summary(task, result.as_dict())
    return result


def _grid(
    points: SortedPoints, how: Gridding, what: str, heights: DatasetWriter,
    counts: DatasetWriter | None, report: Callable[[float], None],
) -> Tally:  # fmt: skip
    """Write values to one raster, numbers of points and their spread to another."""
    tally, done, lattice = Tally(), 0, points.lattice
    for window in points.windows(TIN_BLOCK_POINTS if how.method == "tin" else BLOCK_POINTS):
        bands = grid_window(*points.points_in(window.grown(how.margin_cells)), window, how)
        if what == "uncertainty":
            bands = as_uncertainty(bands)
        rasters.write_part(heights, bands[0], window, 1)
        if counts is not None:
            for band, values in enumerate(bands[1:], start=1):
                rasters.write_part(counts, values, window, band)
        tally.add(bands)
        done += window.height * window.width
        report(0.5 + 0.5 * done / (lattice.height * lattice.width))
    return tally


def _fill(
    unfilled: Path, dsm: DatasetWriter, lattice: Lattice, widest: float, tally: Tally
) -> None:
    """Write a raster with its holes filled, as wide as some cells, and count what was filled."""
    with rasters.open_raster(unfilled) as heights:
        for window in lattice.windows(BLOCK_CELLS):
            around = window.grown(margin_cells(widest)).clipped(lattice.window)
            height = fill_holes(rasters.read_heights(heights, around), window, around, widest)
            rasters.write_part(dsm, height, window, 1)
            tally.filled += int((~np.isnan(height)).sum())
    tally.filled -= tally.known
    tally.known += tally.filled


def _shade(dsm: Path, target: Path, lattice: Lattice, plan: Any, rules: DsmRules) -> None:
    """Write the hillshade of a DSM."""
    new = rasters.new_raster(
        target, lattice, plan, {"hillshade": ""}, dtype="uint8", nodata=NO_LIGHT
    )
    with rasters.open_raster(dsm) as heights, new as out:
        for window in lattice.windows(BLOCK_CELLS):
            height = rasters.read_within(heights, window.grown(1), lattice.window)
            light = hillshade(height, rules.cell_m, rules.azimuth, rules.altitude)
            rasters.write_part(out, light, window, 1)

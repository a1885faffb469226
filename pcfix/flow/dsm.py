"""Grid a LAS or LAZ cloud to a raster of heights, depths or another quantity, in bounded memory.

The points are sorted once into files for squares of the plan; then the raster is made window by
window. All points that decide on a cell are read with its window, so that the raster does not
depend on the size of chunks, squares and windows.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pcfix.errors import PcfixWarning, SettingError, bad_file
from pcfix.flow.runner import Progress, file_task, write_summary
from pcfix.grid.colours import NO_LIGHT, hillshade
from pcfix.grid.delaunay import fill_holes, margin_cells
from pcfix.grid.heights import Gridding, as_uncertainty, grid_window
from pcfix.grid.lattice import Occupancy, Window, cells_of, fits, lattice_over, round_resolution
from pcfix.io import rasters
from pcfix.io.atomic import scratch_folder, temporary_output
from pcfix.io.crs import crs_words, parts
from pcfix.io.files import Bins, check_output, write_text
from pcfix.io.las.part import part_report
from pcfix.io.las.source import LasSource, coordinates, metric_crs
from pcfix.io.las.writing import is_ours
from pcfix.io.styles import raster_style
from pcfix.io.tiles import CloudFiles, Clouds, Tiles, cloud_of, inputs_of, open_cloud
from pcfix.model import BATHYMETRIC_POINT, NOISE_CLASSES, BoolArray, FloatArray, IntArray
from pcfix.options.declare import File, taken
from pcfix.options.steps import MIN_RESOLUTION_M, DsmOptions, DsmRules, SurfaceChoice
from pcfix.version import __version__

if TYPE_CHECKING:
    import laspy
    from rasterio.io import DatasetWriter

WINDOW_POINTS = 400_000
"""Points that are gridded at once, about."""
TIN_REACH_SPACINGS = 5.0
TIN_REACH_CELLS = 3.0
"""Largest diameter of circles around triangles: the larger of the two, or --fill."""

METRE = "metre"
BLOCK_CELLS = 1024
"""Longest side of a window."""
BIN_POINTS = 200_000
"""Points in a square of the store, on average."""
SIGMA_Z = "SigmaZ"
FEWEST_A_CELL = 0.9
"""Points per cell, on average where there are any; fewer give a warning."""
DIMENSIONS = {"depth": "WaterDepth", "uncertainty": SIGMA_Z}
"""Dimensions of these quantities; any other quantity is the dimension of its name."""
SPARSE = 20.0
"""Cells per point; if there are more, some points may lie far from all others."""
BULK_SAMPLE, BEYOND_BULK = 1_000_000, 1e-3


@dataclass(frozen=True, slots=True)
class DsmSummary:
    """The numbers of a DSM; the keys of ``pcfix dsm --summary`` are these names."""

    input: str
    output: str
    hillshade: str | None
    counts: str | None
    what: str  # the quantity in the cells; see `DsmRules`
    pcfix: str  # version
    crs: str | None  # coordinate system of the cloud, and its vertical part
    heights: str | None
    width: int  # columns and rows
    height: int
    bounds_m: tuple[float, float, float, float]  # left, bottom, right, top
    points: int  # in the cloud
    points_used: int  # in the raster: of the surface asked for, neither noise nor withheld
    cells: int  # with points
    filled: int  # with a height but no points
    empty: int  # without a height
    points_per_cell: float  # mean over the cells with points
    spacing_m: float  # of the points used, within the area that they fill
    hole_m: float | None  # width of the widest hole that was bridged
    settings: dict[str, Any]
    seconds: float
    values: dict[str, float]  # least, mean and largest of the cells, before holes are filled
    resolution_is: Literal["given", "chosen"] = "given"
    part: dict[str, Any] | None = None  # points read, of how many, and by which bounds
    stray: int = 0  # points ignored because they lie far from all others

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return asdict(self)


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
    rules, files = given.part(DsmRules), cloud_of(input)
    named = {"hillshade": given.hillshade, "counts": given.counts}
    more = {name: Path(path) for name, path in named.items() if path is not None}
    task = file_task(
        files, output, given,
        more=more.values(), check=rasters.check_tif, progress=progress,
    )  # fmt: skip
    cloud: CloudFiles = files if isinstance(files, Tiles) else task.source
    style = task.target.with_suffix(".qml")
    if given.style:
        check_output(style, overwrite=given.overwrite, inputs=inputs_of(files))
    if given.resolution is None:
        rules = replace(rules, resolution=round_resolution(point_spacing_m(cloud, rules), 0.0))

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
            points = SortedPoints(cloud, source, rules, folder, report)
        lattice, spacing_m = points.lattice, points.near.spacing_m
        # the widest circle around a triangle
        reach_m = max(
            TIN_REACH_SPACINGS * spacing_m, TIN_REACH_CELLS * rules.cell_m, rules.fill or 0.0
        )
        how = Gridding(lattice, rules.method, reach_m, spacing_m)
        # a cloud optimised file is a copy, with overviews of its own
        paths = {name: folder / f"{name}.tif" if given.cog else drafts[name] for name in drafts}
        tags = {"pcfix": __version__, "corrected": corrected, **asdict(rules)}
        counted = _write_rasters(points, how, rules, paths, folder, crs, tags, report)
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
        **counted,
        points_per_cell=points.near.points / counted["cells"],
        spacing_m=spacing_m,
        hole_m=reach_m if rules.method == "tin" else rules.fill,
        settings=asdict(rules),
        seconds=round(task.seconds, 3),
        resolution_is="given" if given.resolution else "chosen",
        part=part_report(task.source),
        stray=points.stray,
    )
    write_summary(task, result.as_dict())
    return result


def _write_rasters(
    points: SortedPoints,
    how: Gridding,
    rules: DsmRules,
    paths: dict[str, Path],
    folder: Path,
    crs: Any,
    tags: dict[str, Any],
    report: Callable[[float], None],
) -> dict[str, Any]:
    """Write the raster, and hillshade and counts where they have a path; return as `_grid`."""
    lattice, is_height = points.lattice, rules.what == "height"
    plan = None if crs is None else parts(crs)[0]
    unit = METRE if is_height or rules.what in DIMENSIONS else ""
    new = partial(rasters.new_raster, lattice=lattice, tags={"PCFIX": json.dumps(tags)})
    with ExitStack() as files:
        bands = {rules.what: unit}
        dsm = files.enter_context(new(paths["dsm"], crs=crs if is_height else plan, bands=bands))
        counts = None
        if "counts" in paths:
            bands = {"count": "", "spread": unit}
            counts = files.enter_context(new(paths["counts"], crs=plan, bands=bands))
        if how.method == "tin" or rules.fill is None:
            found = _grid(points, how, rules.what, dsm, counts, report)
        else:
            unfilled, widest = folder / "unfilled.tif", rules.fill / rules.cell_m
            with rasters.new_raster(unfilled, lattice, None, {"height": METRE}) as heights:
                found = _grid(points, how, rules.what, heights, counts, report)
            empty = lattice.width * lattice.height
            with rasters.open_raster(unfilled) as heights:
                for window in lattice.window.parts(BLOCK_CELLS):
                    around = window.grown(margin_cells(widest)).clipped(lattice.window)
                    height = rasters.read_heights(heights, around)
                    height = fill_holes(height, window, around, widest)
                    rasters.write_part(dsm, height, window, 1)
                    empty -= int((~np.isnan(height)).sum())
            found |= {"filled": found["filled"] + found["empty"] - empty, "empty": empty}
    if "hillshade" in paths:
        shade = rasters.new_raster(
            paths["hillshade"], lattice, plan, {"hillshade": ""}, dtype="uint8", nodata=NO_LIGHT
        )
        with rasters.open_raster(paths["dsm"]) as heights, shade as out:
            for window in lattice.window.parts(BLOCK_CELLS):
                height = rasters.read_within(heights, window.grown(1), lattice.window)
                light = hillshade(height, rules.cell_m, rules.azimuth, rules.altitude)
                rasters.write_part(out, light, window, 1)
    return found


def _grid(
    points: SortedPoints, how: Gridding, what: str, heights: DatasetWriter,
    counts: DatasetWriter | None, report: Callable[[float], None],
) -> dict[str, Any]:  # fmt: skip
    """Write values to one raster, numbers of points and their spread to another.

    Returns the numbers of cells and the statistics of their values, by the names of `DsmSummary`.
    """
    cells, filled, count, total, low, high, done = 0, 0, 0, 0.0, np.inf, -np.inf, 0
    lattice = points.lattice
    # windows have about this number of points if points are everywhere
    side = np.sqrt(WINDOW_POINTS) * how.spacing_m / lattice.resolution_m or BLOCK_CELLS
    for window in lattice.window.parts(int(np.clip(side, 1, BLOCK_CELLS))):
        bands = grid_window(*points.points_in(window.grown(how.margin_cells)), window, how)
        if what == "uncertainty":
            bands = as_uncertainty(bands)
        rasters.write_part(heights, bands[0], window, 1)
        if counts is not None:
            for band, values in enumerate(bands[1:], start=1):
                rasters.write_part(counts, values, window, band)
        known = ~np.isnan(bands.height)
        values = bands.height[known]
        cells += int((bands.points > 0).sum())
        filled += int((known & (bands.points == 0)).sum())
        count, total = count + values.size, total + float(values.sum())
        low, high = values.min(initial=low), values.max(initial=high)
        done += window.height * window.width
        report(0.5 + 0.5 * done / (lattice.height * lattice.width))
    found = {"min": low, "mean": total / count, "max": high} if count else {}
    return {
        "cells": cells,
        "filled": filled,
        "empty": lattice.width * lattice.height - count,
        "values": {name: round(float(value), 4) for name, value in found.items()},
    }


def point_spacing_m(cloud: CloudFiles, settings: DsmRules) -> float:
    """Return the side of the square that each point of a raster has for itself, metres."""
    with open_cloud(cloud) as source:
        near = Occupancy(_stated_area(source, MIN_RESOLUTION_M), len(source), MIN_RESOLUTION_M)
        for points in source.chunks():
            near.add(coordinates(points)[_wanted(points, settings.surface)])
    _refuse_none(near.points, cloud, settings.surface)
    return near.spacing_m


class SortedPoints:
    """The points of a raster, in a file in a folder, and the raster's `lattice`.

    `near` has the number and spacing of the points; `stray` counts those that are ignored because
    they lie far from all others. Raises PcfixError if no points are left, or the raster would be
    too large.
    """

    def __init__(
        self, cloud: CloudFiles, source: LasSource, settings: DsmRules, folder: Path,
        report: Callable[[float], None],
    ) -> None:  # fmt: skip
        """Read a cloud, which is open as `source`, store the wanted points, and lay out the raster.

        If the extent is too large for the number of points, the cloud is read once before.
        """
        resolution = settings.cell_m
        self._resolution_m = resolution
        area, dimension = _stated_area(source, resolution), _dimension_of(source, settings.what)
        cells = np.sqrt(BIN_POINTS / (len(source) / area)) / resolution
        self._bins = Bins(folder, int(np.clip(cells, 1, BLOCK_CELLS)))
        self.near = Occupancy(area, len(source), resolution)
        sparse = area > SPARSE * len(source) * resolution**2
        bulk = _bulk_of(cloud, len(source), resolution) if sparse else None
        self.stray, first, done = 0, None, 0
        for points in source.chunks():
            xyz = coordinates(points)
            if dimension is not None:
                xyz[:, 2] = source.dimension(points, dimension)
            wanted = _wanted(points, settings.surface) & np.isfinite(xyz[:, 2])
            if dimension == SIGMA_Z:
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
            report(0.5 * done / len(source))
        _refuse_none(self.near.points, source.path, settings.surface)
        if first is not None:
            place = ", ".join(f"{value:,.2f}" for value in first)
            sentence = (
                f"{source.path}: {self.stray:,} points far from all others are not gridded, the"
                f" first at {place}. Remove them, or grid their part of the cloud separately."
            )
            warnings.warn(PcfixWarning("dsm.stray", sentence, points=self.stray), stacklevel=3)
        low, high, spacing_m = self.near.low, self.near.high, self.near.spacing_m
        self.lattice = lattice_over(low, high, resolution, str(source.path))
        if resolution**2 < FEWEST_A_CELL * spacing_m**2:
            density = (resolution / spacing_m) ** 2
            sentence = (
                f"The resolution {resolution:g} m is finer than the points allow: their spacing is"
                f" {spacing_m:.2g} m, or {density:.2g} points a cell. Use at least that spacing."
            )
            warnings.warn(PcfixWarning("dsm.fine", sentence, spacing_m=spacing_m), stacklevel=4)

    def points_in(self, window: Window) -> tuple[FloatArray, IntArray]:
        """Return the points of a window, and their columns and rows in the raster.

        The first are metres in the world frame, shape (n, 3), with the gridded values in the place
        of z; the second have shape (n, 2).
        """
        row, column = self.lattice.first_row, self.lattice.first_column
        xyz = self._bins.read(window.moved(row, column))
        cell = cells_of(xyz, self._resolution_m) - np.array([column, row])
        rows = window.holds(cell)
        return xyz[rows], cell[rows]


def _dimension_of(source: LasSource, what: str) -> str | None:
    """Return the dimension whose values are gridded, None for heights."""
    name = None if what == "height" else DIMENSIONS.get(what, what)
    names = list(source.header.point_format.dimension_names)
    if name is None or name in names:
        return name
    if what in DIMENSIONS:
        sentence = (
            f"has no dimension {name}, which --what {what} needs. Correct the cloud first, with"
            " --dimensions all."
        )
        raise bad_file(source.path, "cloud.no_dimension", sentence, dimension=name)
    known = ", ".join(("height", *DIMENSIONS, *names))
    sentence = f"{source.path}: has no dimension {what}. --what is one of {known}."
    raise SettingError("option.choice", sentence, option="what", value=what)


def _wanted(points: laspy.ScaleAwarePointRecord, surface: SurfaceChoice) -> BoolArray:
    classes = np.asarray(points["classification"])
    wanted = classes == BATHYMETRIC_POINT if surface == "bed" else ~np.isin(classes, NOISE_CLASSES)
    return np.asarray(wanted & ~np.asarray(points["withheld"]).astype(bool))


def _stated_area(source: LasSource, resolution_m: float) -> float:
    """Return the area of a cloud as its header states it, which need not be right, m2."""
    area = float(np.prod(source.header.maxs[:2] - source.header.mins[:2]))
    return max(area, resolution_m**2) if np.isfinite(area) else resolution_m**2


def _bulk_of(cloud: CloudFiles, count: int, resolution_m: float) -> FloatArray:
    """Return the south-west and north-east corner of where nearly all points lie, shape (2, 2).

    The box of all but a thousandth of the points on each side grows by its own size, so that a
    cloud of two places is inside it.
    """
    step = 1 + count // BULK_SAMPLE
    with open_cloud(cloud, places_only=True) as source:
        some = [coordinates(points)[::step, :2] for points in source.chunks()]
    low, high = np.quantile(np.vstack(some), (BEYOND_BULK, 1.0 - BEYOND_BULK), axis=0)
    size = np.maximum(high - low, resolution_m)
    return np.array([low - size, high + size])


def _refuse_none(points: int, source: CloudFiles, surface: SurfaceChoice) -> None:
    """Raise an error if no point is left."""
    if points == 0 and surface == "bed":
        sentence = (
            f"has no point of class {BATHYMETRIC_POINT} (bed) that is not withheld. Correct the"
            " cloud first, or use --surface all."
        )
        raise bad_file(source, "dsm.no_bed", sentence)
    if points == 0:
        sentence = "all points are noise (classes 7 and 18) or withheld. Classify it again."
        raise bad_file(source, "cloud.all_withheld", sentence)

"""Grid a LAS or LAZ cloud to a raster of heights, depths or another quantity, in bounded memory.

The points are sorted once by tiles of the plan; then the raster is made window by window. All
points that decide on a cell are read with its window, so that the raster does not depend on the
size of chunks, tiles and windows.
"""

import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.errors import bad_file
from pcfix.flow.runner import Progress, file_task, write_summary
from pcfix.grid.lattice import (
    Lattice,
    fill_holes,
    grid_window,
    lattice_over,
    margin_cells,
    round_resolution,
)
from pcfix.io import rasters
from pcfix.io.clouds import CloudFiles, Clouds, cloud_of, inputs_of, open_cloud, points_of
from pcfix.io.crs import crs_words, parts
from pcfix.io.files import all_or_none, check_output, scratch_arrays, write_text
from pcfix.io.las.source import LasSource, metric_crs
from pcfix.io.las.writing import is_ours
from pcfix.io.rasters import METRE, TO_95
from pcfix.model import BATHYMETRIC_POINT, FloatArray
from pcfix.options.declare import File, taken
from pcfix.options.steps import MIN_RESOLUTION_M, DsmOptions, DsmRules
from pcfix.points.neighbours import PointTiles, make_tiles, spacing_m
from pcfix.report.page import raster_style
from pcfix.running import bounds, empty, release
from pcfix.sums import Figures
from pcfix.version import __version__

WINDOW_POINTS = 400_000  # points that are gridded at once, about
BLOCK_CELLS = 1024  # longest side of a window
BIN_POINTS = 200_000  # points of a tile by which they are sorted, on average
DIMENSIONS = {"height": None, "depth": "WaterDepth", "uncertainty": "SigmaZ"}  # where a quantity is


def grid_dsm(
    input: Clouds,
    output: File,
    *,
    options: DsmOptions | None = None,
    progress: Progress | None = None,
    **keywords: Any,
) -> Figures:
    """Grid a cloud to a GeoTIFF of heights or another quantity; what ``pcfix dsm`` runs.

    The file is a cloud optimised GeoTIFF with one band of float32, -9999 (nodata) if a cell has no
    value. Heights keep the vertical datum of the cloud; other quantities have the horizontal CRS
    only, as programs would take their values for heights. Depth is `WaterDepth`, and uncertainty
    the vertical one at 95 %, of the bed (class 40), as `pcfix.correct_file` writes them. The
    uncertainty of a cell is not divided by the square root of the number of its points, because
    their errors are mostly common.

    With `counts` a second file has two bands: count (points in the cell) and spread (population
    standard deviation of their values). A cell with a value and count 0 was interpolated.

    Parameters
    ----------
    input : path, or list of paths
        LAS or LAZ, in metres; many, as `pcfix.io.clouds.tiles_of` has them, make one raster.
    output : path
        The name ends in ``.tif`` or ``.tiff``.
    options, progress
        See `pcfix.correct_file`. The bounds of the raster are multiples of the resolution (m), by
        default that of `pcfix.grid.lattice.round_resolution`; a point on an edge belongs to the
        cell east or north of it. The method "tin" uses Delaunay triangles, and fill is the diameter
        of the widest circle without a point, by default five times the spacing of the points and at
        least three cells. Withheld points and noise (classes 7 and 18) are not used.
    """
    given = taken(DsmOptions, options, keywords, "grid_dsm")
    rules, files = given.part(DsmRules), cloud_of(input)
    more = {} if given.counts is None else {"counts": Path(given.counts)}
    how: dict[str, Any] = {"more": more.values(), "check": rasters.check_tif}
    task = file_task(files, output, given, progress=progress, **how)
    style = task.target.with_suffix(".qml")
    if given.style:
        check_output(style, overwrite=given.overwrite, inputs=inputs_of(files))

    def report(share: float) -> None:
        if progress is not None:
            progress(round(share * count), count)

    with all_or_none(), scratch_arrays(task.target):
        with open_cloud(task.source) as source:
            crs, count = metric_crs(source), len(source)
            corrected = any(is_ours(vlr) for vlr in source.vlrs)
            used = _points_of(source, rules, report)
            cell_m = rules.resolution or round_resolution(_spacing_m(source, used))
            rules = replace(rules, resolution=cell_m)
            gap_m = _spacing_m(source, used, cell_m)
        lattice = lattice_over(*bounds(used[:, :2]), cell_m, str(task.source))
        tiles = make_tiles(used, points=BIN_POINTS)
        # diameter of the widest circle around a triangle of a TIN
        reach_m = max(5.0 * gap_m, 3.0 * cell_m, rules.fill or 0.0)
        paths = {"dsm": task.target, **more}
        tags = {"pcfix": __version__, "corrected": corrected, **asdict(rules)}
        counted = _write_rasters(tiles, lattice, reach_m, gap_m, rules, paths, crs, tags, report)
    if given.style:
        write_text(style, raster_style(task.target, rules.what), overwrite=given.overwrite)
    result = Figures(
        input=str(task.source),
        output=str(task.target),
        counts=None if given.counts is None else str(given.counts),
        what=rules.what,
        pcfix=__version__,
        crs=None if crs is None else crs.name,
        heights=crs_words(crs)[1] or None,
        width=lattice.width,
        height=lattice.height,
        bounds_m=lattice.bounds_m,  # left, bottom, right, top
        points=count,
        points_used=len(used),  # of the surface asked for, neither noise nor withheld
        **counted,
        points_per_cell=len(used) / counted["cells"],  # mean over the cells with points
        spacing_m=gap_m,  # of the points used, within the area that they fill
        hole_m=reach_m if rules.method == "tin" else rules.fill,  # widest hole that was bridged
        settings=asdict(rules),
        seconds=task.seconds,
    )
    write_summary(given, result.as_dict())
    return result


def _write_rasters(
    tiles: PointTiles,
    lattice: Lattice,
    reach_m: float,
    gap_m: float,
    rules: DsmRules,
    paths: dict[str, Path],
    crs: Any,
    tags: dict[str, Any],
    report: Callable[[float], None],
) -> dict[str, Any]:
    """Write the raster, and the counts if they have a path.

    Returns the numbers of cells and the statistics of their values, by their names in the summary.
    """
    size_m, method = lattice.resolution_m, rules.method
    reach, spacing = reach_m / size_m, gap_m / size_m
    # the number of cells around a window whose points decide on it
    beyond = int(np.ceil(reach)) + 1 if method == "tin" else 0
    plan = None if crs is None else parts(crs)[0]
    new = partial(rasters.new_raster, cells=lattice, tags={"PCFIX": json.dumps(tags)})
    # the width of holes to fill, in cells; a TIN has filled its own
    widest = 0.0 if method == "tin" else (rules.fill or 0.0) / size_m
    margin = margin_cells(widest) if widest else 0
    # windows have about this number of points if points are everywhere, and are wide for a margin
    side = np.sqrt(WINDOW_POINTS) * spacing or BLOCK_CELLS
    # numbers of cells: with points, filled, with a height; the heights before filling, their sum
    sums, low, high, done = np.zeros(5), np.inf, -np.inf, 0
    with ExitStack() as files:
        system = crs if rules.what == "height" else plan
        dsm = files.enter_context(new(paths["dsm"], crs=system, bands={rules.what: METRE}))
        if "counts" in paths:
            bands = {"count": "", "spread": METRE}
            counts = files.enter_context(new(paths["counts"], crs=plan, bands=bands))
        for window in lattice.window.parts(int(np.clip(side, 4 * margin + 1, BLOCK_CELLS))):
            around = window.grown(margin).clipped(lattice.window)
            xyz = tiles.xyz[tiles.within(*lattice.box(around.grown(beyond)))]
            release()
            enlarged, *counted = grid_window(xyz, around, lattice, method, reach, spacing)
            if rules.what == "uncertainty":  # the root mean square of the standard errors of a cell
                enlarged = TO_95 * np.hypot(enlarged, counted[1])
            height, number, spread = (band[window.within(around)] for band in (enlarged, *counted))
            values = height[~np.isnan(height)]
            if widest:
                height = fill_holes(enlarged, window, around, widest)
            rasters.write_bands(dsm, [height], window)
            if "counts" in paths:
                rasters.write_bands(counts, [number, spread], window)
            has_points, known = number > 0, ~np.isnan(height)
            counts_here = has_points.sum(), (known & ~has_points).sum(), known.sum()
            sums += [*counts_here, values.size, values.sum()]
            low, high = values.min(initial=low), values.max(initial=high)
            done += height.size
            report(0.5 + 0.5 * done / (lattice.height * lattice.width))
    cells, filled, full, count = sums[:4].astype(int).tolist()
    found = {"min": low, "mean": sums[4] / count, "max": high} if count else {}
    return {
        "cells": cells,  # with points
        "filled": filled,  # with a height but no points
        "empty": lattice.width * lattice.height - full,  # without a height
        # of the cells, before holes are filled
        "values": {name: round(float(value), 4) for name, value in found.items()},
    }


def point_spacing_m(cloud: CloudFiles, near: Path) -> float:
    """Return the side of the square that each point has for itself, metres.

    The points of a large cloud are on the disk of the path `near` meanwhile.
    """
    with scratch_arrays(near), open_cloud(cloud) as source:
        return _spacing_m(source, _points_of(source, DsmRules(), lambda done: None))


def _spacing_m(source: LasSource, xyz: FloatArray, finest_m: float = MIN_RESOLUTION_M) -> float:
    """Return the spacing of points of a cloud by squares of at least a size; see `spacing_m`."""
    # squares with six points if these fill the area, but at most 4 million of them
    share = max(6.0 / len(source), 1.0 / 4_000_000)
    # as the header states it, which need not be right
    area = float(np.prod(source.header.maxs[:2] - source.header.mins[:2]))
    side = np.sqrt(share * area) if np.isfinite(area) and area > 0.0 else 0.0
    return spacing_m(xyz, max(float(side), finest_m))


def _points_of(source: LasSource, rules: DsmRules, report: Callable[[float], None]) -> FloatArray:
    """Read the points to grid, shape (n, 3), the gridded values in the place of z."""
    dimension = DIMENSIONS[rules.what]
    if dimension not in (None, *source.header.point_format.dimension_names):
        sentence = f"has no dimension {dimension}. Correct the cloud first, with --dimensions all."
        raise bad_file(source.path, "cloud.no_dimension", sentence, dimension=dimension)
    result, count, done = empty((len(source), 3)), 0, 0
    for chunk in source.chunks():
        points = points_of(chunk, source, None)
        xyz, wanted = points.xyz, points.counts()
        if dimension is not None:
            xyz[:, 2] = source.dimension(chunk, dimension)
        if rules.surface == "bed":
            wanted &= points.classes == BATHYMETRIC_POINT
        if dimension == "SigmaZ":
            wanted &= xyz[:, 2] > 0.0  # others have none
        xyz = xyz[wanted & np.isfinite(xyz[:, 2])]
        result[count : count + len(xyz)] = xyz
        count, done = count + len(xyz), done + len(chunk)
        release()
        report(0.5 * done / len(source))
    if count == 0 and rules.surface == "bed":
        sentence = "has no bed (class 40). Correct the cloud first, or use --surface all."
        raise bad_file(source.path, "dsm.no_bed", sentence)
    if count == 0:
        sentence = "all points are noise (classes 7 and 18) or withheld. Classify it again."
        raise bad_file(source.path, "cloud.all_withheld", sentence)
    return result[:count]

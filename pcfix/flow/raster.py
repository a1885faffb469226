"""Run a correction or a labelling on a raster of heights, and write the result as rasters.

The cells with a height are the points of a cloud, which is corrected like any other. Corrected
points have moved in plan too: they are triangulated together with the land around them, and the
height of a cell under water is that of the triangle at its centre. All other cells keep their
stored values.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.blocks import release
from pcfix.errors import PcfixWarning, SettingError, bad_file
from pcfix.flow.dsm import METRE, TO_95
from pcfix.flow.runner import (
    FileTask,
    Progress,
    Work,
    file_task,
    run_command,
    stream,
    write_summary,
)
from pcfix.grid.heights import triangulated
from pcfix.grid.lattice import Window
from pcfix.io import rasters
from pcfix.io.atomic import all_or_none, scratch_folder, temporary_output
from pcfix.io.crs import parts
from pcfix.io.files import scratch_arrays
from pcfix.io.las.columns import OUTCOME, SHIFTS
from pcfix.io.las.source import RasterBand, coordinates
from pcfix.io.las.writing import own_settings
from pcfix.io.raster_cloud import WINDOW_CELLS, HeightRaster, is_raster, open_heights
from pcfix.io.tiles import Clouds, open_cloud
from pcfix.model import BoolArray, FloatArray, Outcome, WaterPlane, WaterSurface
from pcfix.options.declare import File
from pcfix.running import current, threads

OUTPUTS: dict[str, dict[str, str]] = {
    "height": {"height": METRE},
    "depth": {"depth": METRE},
    "shift": dict.fromkeys(SHIFTS, METRE),
    "uncertainty": {"uncertainty": METRE, "SigmaZ": METRE},
    "outcome": {"outcome": ""},
    "class": {"class": ""},
}
"""The bands of each output, and their units. A labelling has the last, a correction the others."""
WHOLE = ("outcome", "class")
"""Outputs of whole numbers."""
NO_CLASS = 255
"""Value of cells without a height in outputs of whole numbers."""
WIDEST_CELLS = 4.0
"""Diameter of the widest circle around a triangle: no cell is farther than half from a point."""
MOST_SHIFT_CELLS = 256.0
"""A point that moves farther in plan is not used, which limits the memory."""
SHALLOW_M = 1.0
"""Depth of the water, if nothing is below zero, up to which a raster may have depths."""
PART_CELLS = 128
"""Side of the windows that are triangulated at once."""
CELL = np.dtype(
    [
        *(("shift", "f4", 3), ("depth", "f4"), ("sigma", "f4")),
        *(("outcome", "u1"), ("class", "u1"), ("is_used", "?")),
    ]
)
"""The point of a cell; all zero if the cell has none."""
Cells = npt.NDArray[Any]


def command_for(output: File, options: Any) -> Callable[..., Any]:
    """Return what runs a command: `run_command`, or `raster_command` if the output is a raster."""
    if is_raster(output):
        return raster_command
    for name in OUTPUTS:
        if getattr(options, name, None) is not None:
            sentence = f"{name} needs rasters as input and output. Use 'pcfix dsm --what {name}'"
            sentence += " to grid a corrected cloud."
            raise SettingError("option.needs", sentence, option=name, needs="raster")
    return run_command


def raster_command(
    name: str,
    input: Clouds,
    output: File,
    options: Any,
    *,
    plan: Callable[[FileTask], Any],
    work: Work,
    finish: Callable[[Any, FileTask, Any], Any],
    reads: Iterable[Any] = (),
    progress: Progress | None = None,
) -> Any:
    """Run a command on the cells of a raster and write rasters; see `run_command`."""
    if not (isinstance(input, str | PathLike) and is_raster(input)):
        sentence = f"{output}: is a raster, and the input is not. Give a name that ends in .laz,"
        sentence += " and grid that cloud with 'pcfix dsm'."
        raise SettingError("output.suffix", sentence, path=output)
    asked = {one: getattr(options, one, None) for one in OUTPUTS}
    more = {one: Path(path) for one, path in asked.items() if path is not None}
    task = file_task(
        input, output, options,
        reads=reads, more=more.values(), check=rasters.check_tif, progress=progress,
    )  # fmt: skip
    main = "class" if name == "label" else "height"

    def report(share: float) -> None:
        if progress is not None:
            progress(round(share * task.source.points), task.source.points)

    with threads(task.jobs), scratch_folder(task.target) as folder:
        cloud = replace(
            task, target=folder / "cells.laz",
            progress=lambda done, total: report(0.5 * done / total),
        )  # fmt: skip
        planned = plan(cloud)
        _check_heights(task.source, planned.water if name == "label" else planned.found.surface)
        with all_or_none():
            result = stream(work, planned, cloud, partial(finish, planned, task))
        with all_or_none():
            targets = {main: task.target, **more}
            counts = write_cells(task.source, cloud.target, targets, report)
            if main == "height":
                result.raster = counts
            write_summary(options, result)
    return result


def _check_heights(source: RasterBand, water: WaterSurface) -> None:
    """Warn of a raster that has no height below zero, and next to no water: it may have depths."""
    if not isinstance(water, WaterPlane):
        return
    x, y, _ = (source.mins + source.maxs) / 2.0
    deepest_m = water.a + water.b * x + water.c * y - source.mins[2]
    if source.mins[2] >= 0.0 and 0.0 < deepest_m < SHALLOW_M:
        sentence = f"{source}: all values are 0 or more, and none is more than {deepest_m:.2f} m"
        sentence += " below the water. If they are depths (positive down), give heights instead."
        warnings.warn(PcfixWarning("raster.depths", sentence, path=source.path), stacklevel=3)


def write_cells(
    source: RasterBand,
    cloud: Path,
    targets: Mapping[str, Path],
    report: Callable[[float], None] = lambda share: None,
) -> dict[str, int]:
    """Write what became of the cells of a raster to cloud optimised GeoTIFFs on its grid.

    `cloud` has the points of its cells, as a correction or a labelling leaves them; points that are
    withheld have no height. `targets` are among `OUTPUTS`.
    Returns how many cells changed, and how many of them have no height any more.
    """
    target = next(iter(targets.values()))
    counts = np.zeros(2, np.int64)
    with ExitStack() as stack:
        folder = stack.enter_context(scratch_folder(target.with_name(f"{target.name}.cells")))
        new = stack.enter_context(scratch_arrays(target))
        heights = stack.enter_context(open_heights(source.path, source.band))
        whole = heights.window
        cells = new((whole.height * whole.width,), CELL)
        record, margin = _read_cells(cloud, heights, cells)
        table = cells.reshape(whole.height, whole.width)
        with ExitStack() as files:
            outs = {
                name: files.enter_context(
                    _new_output(folder / f"{name}.tif", name, heights, record)
                )
                for name in targets
            }
            for window in whole.parts(WINDOW_CELLS):
                layers, found = _layers(heights, table, window, margin)
                counts += found
                for name, out in outs.items():
                    for band, values in enumerate(layers[name], start=1):
                        rasters.write_part(out, values, window, band)
                release()
                report(0.5 + 0.5 * window.row_stop / whole.height)
        for name, path in targets.items():
            resampling = "nearest" if name in WHOLE else "average"
            with temporary_output(path) as draft:
                rasters.copy_as_cog(folder / f"{name}.tif", draft, resampling)
    return {"cells_changed": int(counts[0]), "cells_empty": int(counts[1])}


def _new_output(path: Path, name: str, heights: HeightRaster, record: str) -> Any:
    """Return the context of a new raster for one of the outputs."""
    kind, nodata = ("uint8", NO_CLASS) if name in WHOLE else ("float32", rasters.NO_HEIGHT)
    crs, tags = parts(heights.crs)[0], {"PCFIX": record}
    if name == "height":  # only heights have a vertical datum
        crs, kind = heights.crs, heights.source.dtypes[heights.band - 1]
        nodata, tags = heights.nodata, {**heights.source.tags(), **tags}
    return rasters.new_raster(
        path, heights.source, crs, OUTPUTS[name], dtype=kind, nodata=nodata, tags=tags,
        scale_offset=heights.scale_offset if name == "height" else (1.0, 0.0),
    )  # fmt: skip


def _read_cells(cloud: Path, heights: HeightRaster, cells: Cells) -> tuple[str, int]:
    """Fill an array of `CELL`, row by row, with the points of a cloud.

    Returns the record of the correction as JSON, and the number of cells around a window whose
    points decide on it.
    """
    farthest = 0.0
    with open_cloud(cloud) as source:
        record = own_settings(source.vlrs) or {}
        for points in source.chunks():
            one, xyz = np.zeros(len(points), CELL), coordinates(points)
            one["class"] = points.array["classification"]
            if record:
                shift = np.column_stack([source.dimension(points, name) for name in SHIFTS])
                xyz -= shift
                far = np.hypot(*shift[:, :2].T) / heights.cell_m
                one["shift"], one["outcome"] = shift, points.array[OUTCOME.name]
                one["depth"] = source.dimension(points, "WaterDepth")
                one["sigma"] = source.dimension(points, "SigmaZ")
                one["is_used"] = (np.asarray(points["withheld"]) == 0) & (far <= MOST_SHIFT_CELLS)
                farthest = far[one["is_used"]].max(initial=farthest)
            row, column = heights.cells_at(xyz)
            cells[row * heights.window.width + column] = one
            release()
    stated = {key: value for key, value in record.items() if key not in ("before", "sha256")}
    return json.dumps({"corrected": bool(record), **stated}), int(farthest + WIDEST_CELLS) + 2


def _changed(cell: Cells) -> BoolArray:
    """Return which cells were submerged, or have moved."""
    return np.asarray((cell["outcome"] > 0) | (cell["shift"] != 0.0).any(axis=-1))


def _layers(
    heights: HeightRaster, table: Cells, window: Window, margin: int
) -> tuple[dict[str, list[npt.NDArray[Any]]], list[int]]:
    """Return the bands of all outputs for a window, and the counts of `write_cells`."""
    cell = table[window.within(heights.window)]
    known = np.isfinite(heights.read(window))
    changed = known & _changed(cell)
    height, depth, sigma = np.full((3, *cell.shape), np.nan)
    if changed.any():
        found = _triangulated(heights, table, window, margin)
        height, share, level, sigma = np.where(changed, found, np.nan)
        share[share <= 0.0] = np.nan
        depth, sigma = level / share - height, sigma / share
        depth[~(depth > 0.0)] = np.nan
        sigma[~(sigma > 0.0)] = np.nan
    shift = np.where(changed, np.moveaxis(cell["shift"], -1, 0), np.nan)
    layers = {
        "height": [_stored(heights, window, known, changed, height)],
        "depth": [depth],
        "shift": list(shift),
        "uncertainty": [TO_95 * sigma, sigma],
        "outcome": [np.where(known, cell["outcome"], NO_CLASS)],
        "class": [np.where(known, cell["class"], NO_CLASS)],
    }
    return layers, [int(changed.sum()), int((changed & np.isnan(height)).sum())]


def _triangulated(heights: HeightRaster, table: Cells, window: Window, margin: int) -> FloatArray:
    """Return quantities of the cells of a window, shape (4, rows, columns); NaN if unknown.

    They are the height (m), the share of corrected points in the weights of the three corners, and
    the sums of water levels (m) and standard errors (m) over these, with their weights. A cell
    outside of all triangles, as at the edge of a survey, has those of its own point if that is
    still less than a cell away.
    """
    around = window.grown(margin).clipped(heights.window)
    cell = table[around.within(heights.window)]
    changed = _changed(cell)
    x, y, up = np.moveaxis(cell["shift"].astype(np.float64), -1, 0)
    to_cells = ~heights.source.transform
    right, down = to_cells.a * x + to_cells.b * y, to_cells.d * x + to_cells.e * y
    top, wet = heights.read(around) + up, (cell["outcome"] == Outcome.CORRECTED).astype(np.float64)
    values = np.stack([top, wet, wet * (top + cell["depth"]), wet * cell["sigma"]])
    values[:, changed & ~cell["is_used"]] = np.nan
    result = np.full((4, window.height, window.width), np.nan)

    def triangulate(part: Window) -> None:
        wanted = changed[part.within(around)]
        if not wanted.any():
            return
        about = part.grown(margin).clipped(around)
        near = about.within(around)
        row, column = np.nonzero(np.isfinite(values[0][near]))
        position = np.column_stack(
            [column + right[near][row, column], row + down[near][row, column]]
        )
        position += about.column + 0.5, about.row + 0.5
        some = values[:, *near][:, row, column]
        found = triangulated(position, some, part, WIDEST_CELLS, 1.0, wanted)
        result[:, *part.within(window)] = found

    with ThreadPoolExecutor(current().threads) as pool:
        list(pool.map(triangulate, window.parts(PART_CELLS)))
    own = np.where(np.hypot(right, down) <= 1.0, values, np.nan)[:, *window.within(around)]
    return np.where(np.isnan(result[0]), own, result)


def _stored(
    heights: HeightRaster, window: Window, known: BoolArray, changed: BoolArray, height: FloatArray
) -> npt.NDArray[Any]:
    """Return the values of a window as the file stores them, with the heights of changed cells."""
    scale, offset = heights.scale_offset
    values = np.where(known, heights.read_stored(window), np.array(heights.nodata))
    dtype = np.dtype(heights.source.dtypes[heights.band - 1])
    values = values.astype(dtype)
    new = (height[changed] - offset) / scale
    if dtype.kind != "f":
        new = np.rint(new)
        limits = np.iinfo(dtype)
        if ((new < limits.min) | (new > limits.max)).any():
            sentence = f"corrected heights do not fit into its type, {dtype}. Convert it to"
            sentence += " Float32 first, for example with 'gdal_translate -unscale -ot Float32'."
            raise bad_file(heights.source.name, "raster.type", sentence)
    values[changed] = np.where(np.isnan(new), heights.nodata, new).astype(dtype)
    return values

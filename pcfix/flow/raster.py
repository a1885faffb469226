"""Write what became of the cells of a raster as rasters on the same grid.

The cells with a height are the points of a cloud, which is corrected like any other. Corrected
points have moved in plan too, so that the grid of the input is slightly deformed. The height of a
cell under water is interpolated in the deformed grid. All other cells keep their stored values.
"""

import json
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import PcfixWarning, SettingError, bad_file
from pcfix.grid.lattice import Window
from pcfix.io import rasters
from pcfix.io.crs import parts
from pcfix.io.files import scratch_arrays
from pcfix.io.las.columns import OUTCOME, SHIFTS
from pcfix.io.las.source import coordinates
from pcfix.io.las.writing import own_settings
from pcfix.io.rasters import METRE, TO_95, RasterBand, RasterSource, is_raster
from pcfix.model import BoolArray, FloatArray, Outcome, WaterPlane, WaterSurface
from pcfix.running import current

# A labelling has the last, a correction the others.
OUTPUTS = ("height", "depth", "shift", "uncertainty", "outcome", "class")
# The bands of outputs that have several; the band of the others has their name.
BANDS = {"shift": SHIFTS, "uncertainty": ("uncertainty", "SigmaZ")}
NO_CODE = 255  # value of cells without a height in outcome and class, which have whole numbers
WINDOW_CELLS = 512
HOLE_CELLS, EDGE_CELLS = 1.5, 2  # reach of known cells into holes, and beyond the raster's edge
NEAR_CELLS = 0.5  # largest distance of a moved point from the centre of a cell that gets its height
MOST_SHIFT_CELLS = 256  # points that move farther in plan may be missing, which limits the memory
ITERATIONS, STEPS_A_CELL = 6, 4096.0
# The point of a cell, all zero without one: its shift (m), NaN if it has no height any more; the
# depth and standard error of corrected points (m); and its outcome, or the class by a labelling.
CELL = np.dtype([("shift", "f4", 3), ("depth", "f4"), ("sigma", "f4"), ("code", "u1")])
Cells = npt.NDArray[Any]


def raster_outputs(name: str, input: Any, output: Any, options: Any) -> dict[str, Path]:
    """Return the rasters that a command writes, as in `OUTPUTS`; none if the output is a cloud."""
    more = {one: path for one in OUTPUTS if (path := getattr(options, one, None)) is not None}
    if name not in ("correct", "label") or not is_raster(output):
        for one in more:
            sentence = f"{one} needs rasters as input and output. Grid clouds with 'pcfix dsm'."
            raise SettingError("option.needs", sentence, option=one, needs="raster")
        return {}
    if not (isinstance(input, str | PathLike) and is_raster(input)):
        sentence = f"{output}: is a raster, and the input is not. Write .laz, and use 'pcfix dsm'."
        raise SettingError("output.suffix", sentence, path=output)
    main = "height" if name == "correct" else "class"
    return {one: Path(path) for one, path in {main: output, **more}.items()}


def check_heights(source: object, water: WaterSurface) -> None:
    """Warn of a raster with nothing below zero, and next to no water: it may have depths."""
    if isinstance(source, RasterBand) and is_raster(source) and isinstance(water, WaterPlane):
        x, y, _ = (source.mins + source.maxs) / 2.0
        deepest_m = water.a + water.b * x + water.c * y - source.mins[2]
        if source.mins[2] >= 0.0 and 0.0 < deepest_m < 1.0:
            sentence = f"{source}: its values are 0 or more, and at most {deepest_m:.2f} m below"
            sentence += " the water. If they are depths (positive down), give heights instead."
            warnings.warn(PcfixWarning("raster.depths", sentence, path=source.path), stacklevel=3)


@contextmanager
def raster_writer(
    source: Any,
    header: Any,
    targets: Mapping[str, Path],
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[Callable[[Any], None]]:
    """Give a function that takes points of cells; the rasters are written when the block ends.

    The points are as the header states, after a correction or a labelling; withheld ones have no
    height. `source` is the open `RasterSource`. The `targets`, as in `OUTPUTS`, are cloud optimised
    GeoTIFFs on its grid. `progress` is called with the number of cells written, and of all.
    """
    target, whole, farthest, empty = next(iter(targets.values())), source.window, 0.0, 0
    is_corrected = SHIFTS[0] in header.point_format.dimension_names
    with scratch_arrays(target) as new:
        cells = new((whole.height, whole.width), CELL)
        release = current().release  # `append` runs in a thread that has other settings

        def append(points: Any) -> None:
            nonlocal farthest
            xyz, cell = coordinates(points), np.zeros(len(points), CELL)
            cell["code"] = points.array[OUTCOME.name if is_corrected else "classification"]
            if is_corrected:
                shift = np.column_stack([points[name] for name in SHIFTS])
                xyz -= shift
                farthest = max(farthest, np.hypot(*shift[:, :2].T).max() / source.cell_m)
                cell["shift"], cell["depth"] = shift, points["WaterDepth"]
                cell["sigma"] = points["SigmaZ"]
                cell["shift"][_has_changed(cell) & (np.asarray(points["withheld"]) == 1)] = np.nan
            column, row = rasters.place_of(~source.raster.transform, xyz[:, 0], xyz[:, 1])
            cells[np.floor(row).astype(np.int64), np.floor(column).astype(np.int64)] = cell
            release()

        yield append
        record = own_settings(header.vlrs) or {}
        record = {key: record[key] for key in record if key not in ("before", "sha256")}
        tags = {"PCFIX": json.dumps({**record, "corrected": is_corrected})}
        margin = int(min(farthest, MOST_SHIFT_CELLS)) + 2 * EDGE_CELLS
        with ExitStack() as files:
            outs = {
                name: files.enter_context(_new_raster(path, name, source, tags))
                for name, path in targets.items()
            }
            for window in whole.parts(WINDOW_CELLS):
                layers, lost = _layers(source, cells, window, margin if is_corrected else None)
                empty += lost
                for name, out in outs.items():
                    rasters.write_bands(out, layers[name], window)
                release()
                if progress is not None:
                    progress(window.row_stop * whole.width, whole.height * whole.width)
    if empty:
        sentence = f"{target}: {empty:,} cells under water have no height any more, as no corrected"
        sentence += " point is near. Fill them in a GIS if you need them."
        warnings.warn(PcfixWarning("raster.empty_cells", sentence, cells=empty), stacklevel=2)


def _new_raster(path: Path, name: str, source: RasterSource, tags: dict[str, str]) -> Any:
    """Return the context of a new raster for one of the outputs."""
    bands, unit = BANDS.get(name, (name,)), "" if name in ("outcome", "class") else METRE
    new: dict[str, Any] = {"tags": tags, "crs": parts(source.crs)[0]}  # without vertical datum
    if name == "height":
        new |= {"tags": source.raster.tags() | tags, "crs": source.crs, "nodata": source.nodata}
        new |= {"dtype": source.dtype.name, "scale_offset": (source.scale, source.offset)}
    elif not unit:
        new |= {"dtype": "uint8", "nodata": NO_CODE, "resampling": "nearest"}
    return rasters.new_raster(path, source.raster, bands=dict.fromkeys(bands, unit), **new)


def _has_changed(cell: Cells) -> BoolArray:
    """Return which cells were submerged, or have moved."""
    return np.asarray((cell["code"] > 0) | (cell["shift"] != 0.0).any(axis=-1))


def _layers(
    source: RasterSource, cells: Cells, window: Window, margin: int | None
) -> tuple[dict[str, list[Cells]], int]:
    """Return the bands of all outputs for a window, and how many cells have lost their height.

    Without a margin, that of `_moved_heights`, there are only classes. Shift, water level and
    standard error are those of the point of the cell.
    """
    cell, before = cells[window.within(source.window)], source.read(window)
    known = np.isfinite(before)
    code = np.where(known, cell["code"], NO_CODE)
    if margin is None:
        return {"class": [code]}, 0
    wet = known & _has_changed(cell)
    shift = np.where(wet, np.moveaxis(cell["shift"], -1, 0), np.nan)
    height = _moved_heights(source, cells, window, wet, margin)
    is_bed = (code == Outcome.CORRECTED) & np.isfinite(height)
    depth, sigma = before + shift[2] + cell["depth"] - height, cell["sigma"]
    depth, sigma = (np.where(is_bed & (one > 0.0), one, np.nan) for one in (depth, sigma))
    stored = source.raster.read(source.band, window=rasters.slices(window))
    stored[~known] = source.nodata
    new = (height[wet] - source.offset) / source.scale
    if source.dtype.kind != "f":
        new, limits = np.rint(new), np.iinfo(source.dtype)
        if ((new < limits.min) | (new > limits.max)).any():
            sentence = f"has the type {source.dtype}, too narrow for its new heights. Use Float32."
            raise bad_file(source.path, "raster.type", sentence)
    stored[wet] = np.where(np.isnan(new), source.nodata, new)
    layers = {"height": [stored], "depth": [depth], "shift": [*shift], "outcome": [code]}
    return layers | {"uncertainty": [TO_95 * sigma, sigma]}, int(np.isnan(new).sum())


def _moved_heights(
    source: RasterSource, cells: Cells, window: Window, wanted: BoolArray, margin: int
) -> FloatArray:
    """Return the corrected heights (m) at the centres of the wanted cells of a window, else NaN.

    A point at the place p of the input has moved to p + d(p), where d is interpolated between the
    cells. The iteration p = c - d(p) finds the point that has moved to the centre c. It converges
    if neighbours have neither changed places nor moved apart to more than twice their distance.
    Where it does not, and in holes wider than two cells, there is no height. Cells up to the margin
    around the window may be such points, or fill holes.
    """
    from scipy.ndimage import map_coordinates

    result = np.full(wanted.shape, np.nan)
    if not wanted.any():
        return result
    around = window.grown(margin).clipped(source.window)
    x, y, z = np.moveaxis(cells[around.within(source.window)]["shift"].astype(np.float64), -1, 0)
    height, to_cells = source.read(around) + z, ~source.raster.transform
    # d in rows and columns; without a height it is unknown too
    down, right = to_cells.d * x + to_cells.e * y, to_cells.a * x + to_cells.b * y
    height, down, right = (
        rasters.filled(np.pad(one, EDGE_CELLS, "edge"), HOLE_CELLS)
        for one in np.where(np.isnan(height), np.nan, [height, down, right])
    )

    def at(values: FloatArray) -> FloatArray:
        return np.asarray(map_coordinates(values, place, order=1, cval=np.nan))

    row, column = np.nonzero(wanted)
    centre = np.array([row + window.row - around.row, column + window.column - around.column])
    centre += EDGE_CELLS
    place = centre.astype(np.float64)
    for _ in range(ITERATIONS):
        # whole steps of a cell, so that no bit depends on the window
        place = np.rint((centre - [at(down), at(right)]) * STEPS_A_CELL) / STEPS_A_CELL
    off = np.hypot(*(place - centre + [at(down), at(right)]))
    result[row, column] = np.where(off <= NEAR_CELLS, at(height), np.nan)
    return result

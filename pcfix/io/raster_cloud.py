"""Read a raster of heights as a cloud: a cell with a height is a point at its centre.

The raster is read in square windows, so that its size does not matter. Where it has no height (no
data, NaN, transparent, or impossible) there is no point.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

import laspy
import numpy as np
from laspy.vlrs.vlr import VLR

from pcfix.errors import bad_file
from pcfix.grid.lattice import Window
from pcfix.io.crs import metres_up
from pcfix.io.las.source import LasSource, RasterBand, metric_crs
from pcfix.io.las.writing import NOTES, USER_ID
from pcfix.io.rasters import NO_HEIGHT, open_raster, place_of, raster_errors, read_masked, slices
from pcfix.io.tables import METRES
from pcfix.model import FloatArray

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

SUFFIXES = (".tif", ".tiff", ".vrt", ".png", ".jpg", ".jpeg")
"""Of rasters; the last three only to say that pictures have no heights."""
READ_CELLS = 256
"""Side of the windows that are read, whose points are corrected at once."""
IMPOSSIBLE_M = 9000.0
"""A larger height is a nodata value that the file does not state."""
CACHE_BYTES = 64_000_000
"""Of GDAL, whose default is 5 % of the memory of the machine."""
STEPS_A_CELL = 1000.0
"""Coordinates of points are multiples of a power of ten, at least this much finer than a cell."""
_COLOURS = ("red", "green", "blue", "palette")


def is_raster(path: object) -> bool:
    """Whether a path is that of a raster by its name."""
    return str(path).lower().endswith(SUFFIXES)


class RasterSource(LasSource):
    """An open raster as a cloud, of LAS point format 6; see `LasSource`.

    It has the open `raster` with the number of the `band` of heights, its `crs`, the `window` of
    all cells and their side `cell_m`. Stored values of `dtype` are heights (m) after multiplication
    by `scale` and addition of `offset`; a copy has `nodata` where there is no height. The points of
    `part` are counted, see `pcfix.io.tiles.band_of`; before that there are none.
    """

    def __init__(self, part: RasterBand) -> None:
        """Open; an `InputError` if its band does not contain heights in metres."""
        import rasterio
        from pyproj import CRS

        self.path = part.path
        with ExitStack() as stack:
            # GeoTIFF 1.0 states the vertical datum too, which GDAL ignores by default
            settings = rasterio.Env(GTIFF_REPORT_COMPD_CS=True, GDAL_CACHEMAX=CACHE_BYTES)
            stack.enter_context(settings)
            self.raster = raster = stack.enter_context(open_raster(part.path))
            self.band = band = _height_band(raster, part)
            self.crs = CRS(raster.crs.to_wkt())
            if metres_up(self.crs) < 0.0 or "depth" in f"{raster.descriptions[band - 1]}".lower():
                sentence = "contains depths (positive down). Give heights: water level minus depth."
                raise bad_file(part.path, "raster.depths", sentence)
            self.window = Window(0, raster.height, 0, raster.width)
            self.cell_m = float(np.sqrt(abs(raster.transform.determinant)))
            self.dtype = np.dtype(raster.dtypes[band - 1])
            self.scale, self.offset = raster.scales[band - 1], raster.offsets[band - 1]
            missing = NO_HEIGHT if self.dtype.kind == "f" else np.iinfo(self.dtype).max
            self.nodata = float(missing if raster.nodata is None else raster.nodata)
            # what a LAS file has: a header, and the record of a correction
            header = laspy.LasHeader(version="1.4", point_format=6)
            step = 10.0 ** np.floor(np.log10(self.cell_m / STEPS_A_CELL))
            header.scales = np.array([step, step, min(step, 0.0001)])
            box = np.array([[*raster.bounds[:2], 0.0], [*raster.bounds[2:], 0.0]])
            header.offsets = np.floor(box.mean(axis=0))
            header.add_crs(self.crs)
            header.generating_software = ""
            header.mins, header.maxs = (part.mins, part.maxs) if part.points else box
            header.point_count = part.points
            self.header, self.vlrs, self.evlrs = header, list(header.vlrs), []
            self.identity = bytes(68)
            record = raster.tags().get("PCFIX", "")
            if '"corrected": true' in record:
                self.vlrs.append(VLR(USER_ID, NOTES["settings"], "", record.encode()))
            metric_crs(self)
            self._stack = stack.pop_all()

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def read(self, window: Window) -> FloatArray:
        """Return the heights of a window, shape (rows, columns), metres; NaN without one."""
        with raster_errors(self.path):
            stored = read_masked(self.raster, self.band, window=slices(window))
            for number, kind in enumerate(self.raster.colorinterp, start=1):
                if kind.name == "alpha":  # which GDAL ignores beside a band of floating point
                    stored[self.raster.read(number, window=slices(window)) == 0] = np.nan
        height = stored * self.scale + self.offset
        height[~(np.abs(height) <= IMPOSSIBLE_M)] = np.nan
        return height

    def chunks(self) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Yield the points of each window with any, row by row."""
        for window in self.window.parts(READ_CELLS):
            height = self.read(window)
            row, column = np.nonzero(np.isfinite(height))
            if len(row) == 0:
                continue
            centre = column + window.column + 0.5, row + window.row + 0.5
            x, y = place_of(self.raster.transform, *centre)
            points = laspy.ScaleAwarePointRecord.zeros(len(row), header=self.header)
            xyz = np.column_stack([x, y, height[row, column]])
            steps = np.rint((xyz - self.header.offsets) / self.header.scales)
            points.array["X"], points.array["Y"], points.array["Z"] = steps.T
            points["return_number"][:] = points["number_of_returns"][:] = 1
            yield points


def _height_band(raster: DatasetReader, part: RasterBand) -> int:
    """Return the number of the band of heights; an `InputError` if there are other values."""
    path, band = part.path, part.band
    kinds = [one.name for one in raster.colorinterp]
    known = [number for number, kind in enumerate(kinds, 1) if kind != "alpha"]
    if band is not None and band not in known:
        sentence = f"has no band {band} of heights; it has {len(known)}. Give another --band."
        raise bad_file(path, "raster.band", sentence, band=band)
    asked = known if band is None else [band]
    if any(kinds[one - 1] in _COLOURS or raster.dtypes[one - 1] == "uint8" for one in asked):
        sentence = "is a picture (colours or a hillshade), not heights. Give the DSM."
        raise bad_file(path, "raster.picture", sentence)
    if len(asked) != 1:
        sentence = f"has {len(known)} bands. Give the one with the heights as --band N."
        raise bad_file(path, "raster.bands", sentence, bands=len(known))
    (band,) = asked
    if raster.crs is None or raster.transform.is_identity:
        sentence = "has no CRS, or no georeference. Assign it, for example with gdal_edit."
        raise bad_file(path, "raster.no_crs", sentence)
    unit = (raster.units[band - 1] or "").strip()
    if unit.lower() not in METRES:
        sentence = f"its heights are in '{unit}'. Convert them to metres."
        raise bad_file(path, "raster.unit", sentence, value=unit)
    return band

"""Read a raster of heights as a cloud: a cell with a height is a point at its centre.

The raster is read in square windows, so that its size does not matter. Where it has no height (no
data, NaN, transparent, or impossible) there is no point.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import laspy
import numpy as np
import numpy.typing as npt
from laspy.vlrs.vlr import VLR

from pcfix.errors import bad_file
from pcfix.grid.lattice import Window
from pcfix.io.crs import metres_up
from pcfix.io.las.source import LasSource, RasterBand, metric_crs
from pcfix.io.las.writing import NOTES, USER_ID
from pcfix.io.rasters import NO_HEIGHT, open_raster, place_of, raster_errors, read_masked, slices
from pcfix.model import FloatArray, IntArray

if TYPE_CHECKING:
    from pyproj import CRS
    from rasterio.io import DatasetReader

SUFFIXES = (".tif", ".tiff", ".vrt")
WINDOW_CELLS = 512
IMPOSSIBLE_M = 9000.0
"""A larger height is a nodata value that the file does not state."""
CACHE_BYTES = 256_000_000
"""Of GDAL, whose default is 5 % of the memory of the machine."""
STEPS_A_CELL = 1000.0
"""Coordinates of points are multiples of a power of ten, at least this much finer than a cell."""
_METRES = ("", "m", "metre", "meter", "metres", "meters")
_COLOURS = ("red", "green", "blue", "palette")


def is_raster(path: object) -> bool:
    """Whether a path is that of a raster by its name."""
    return str(path).lower().endswith(SUFFIXES)


class HeightRaster(NamedTuple):
    """One band of an open raster of heights in metres."""

    source: DatasetReader
    band: int
    crs: CRS

    @property
    def window(self) -> Window:
        """The whole raster."""
        return Window(0, self.source.height, 0, self.source.width)

    @property
    def nodata(self) -> float:
        """The value of cells without a height in a copy of the raster."""
        if self.source.nodata is not None:
            return float(self.source.nodata)
        dtype = np.dtype(self.source.dtypes[self.band - 1])
        return NO_HEIGHT if dtype.kind == "f" else float(np.iinfo(dtype).max)

    @property
    def scale_offset(self) -> tuple[float, float]:
        """Height of one step of the stored values, and of their zero, metres."""
        return self.source.scales[self.band - 1], self.source.offsets[self.band - 1]

    @property
    def cell_m(self) -> float:
        """Side of a cell, or of a square of its area."""
        return float(np.sqrt(abs(self.source.transform.determinant)))

    def read(self, window: Window) -> FloatArray:
        """Return the heights of a window, shape (rows, columns), metres; NaN without one."""
        scale, offset = self.scale_offset
        with raster_errors(Path(self.source.name)):
            stored = read_masked(self.source, self.band, window=slices(window))
            for number, kind in enumerate(self.source.colorinterp, start=1):
                if kind.name == "alpha":  # which GDAL ignores beside a band of floating point
                    stored[self.source.read(number, window=slices(window)) == 0] = np.nan
        height = stored * scale + offset
        height[~(np.abs(height) <= IMPOSSIBLE_M)] = np.nan
        return height

    def read_stored(self, window: Window) -> npt.NDArray[Any]:
        """Return the values of a window as the file has them."""
        with raster_errors(Path(self.source.name)):
            return np.asarray(self.source.read(self.band, window=slices(window)))

    def centres(self, row: IntArray, column: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return x and y of the centres of cells, metres."""
        x, y = place_of(self.source.transform, column + 0.5, row + 0.5)
        return x, y

    def cells_at(self, xyz: FloatArray) -> tuple[IntArray, IntArray]:
        """Return the rows and columns of the cells that contain points, shape (n, 3)."""
        column, row = place_of(~self.source.transform, xyz[:, 0], xyz[:, 1])
        return np.floor(row).astype(np.int64), np.floor(column).astype(np.int64)


@contextmanager
def open_heights(path: Path, band: int | None = None) -> Iterator[HeightRaster]:
    """Open a raster whose band has heights in metres; an `InputError` if it has others."""
    import rasterio
    from pyproj import CRS

    # GeoTIFF 1.0 states the vertical datum too, which GDAL ignores by default
    with rasterio.Env(GTIFF_REPORT_COMPD_CS=True, GDAL_CACHEMAX=CACHE_BYTES), ExitStack() as stack:
        source = stack.enter_context(open_raster(path))
        band = _checked_band(source, path, band)
        if source.crs is None or source.transform.is_identity:
            what = "CRS" if source.crs is None else "georeference"
            sentence = f"names no {what}. Assign it, for example with gdal_edit."
            raise bad_file(path, "raster.no_crs", sentence)
        crs = CRS(source.crs.to_wkt())
        words = f"{source.descriptions[band - 1] or ''}".lower()
        if "depth" in words or metres_up(crs) < 0.0:
            sentence = "contains depths (positive down). Give heights: the water level minus depth."
            raise bad_file(path, "raster.depths", sentence)
        unit = (source.units[band - 1] or "").strip()
        if unit.lower() not in _METRES:
            sentence = f"its heights are in '{unit}'. Convert them to metres."
            raise bad_file(path, "raster.unit", sentence, value=unit)
        yield HeightRaster(source, band, crs)


def _checked_band(source: DatasetReader, path: Path, band: int | None) -> int:
    """Return the band of the heights; refuse pictures, and several bands without a choice."""
    kinds = [one.name for one in source.colorinterp]
    known = [number for number, kind in enumerate(kinds, 1) if kind != "alpha"]
    if band is not None and band not in known:
        sentence = f"has no band {band} of heights; it has {len(known)}. Give another --band."
        raise bad_file(path, "raster.band", sentence, band=band)
    asked = known if band is None else [band]
    if any(kinds[one - 1] in _COLOURS or source.dtypes[one - 1] == "uint8" for one in asked):
        sentence = "is a picture (colours or a hillshade), not heights. Give the DSM."
        raise bad_file(path, "raster.picture", sentence)
    if len(asked) != 1:
        sentence = f"has {len(known)} bands. Give the one with the heights as --band N."
        raise bad_file(path, "raster.bands", sentence, bands=len(known))
    return asked[0]


def _record_of(source: DatasetReader) -> list[VLR]:
    """Return the record of the correction of a raster, as that of a corrected cloud."""
    with suppress(ValueError):
        record = json.loads(source.tags().get("PCFIX", "{}"))
        if record.get("corrected"):
            text = json.dumps({"water_plane": None, **record})
            return [VLR(USER_ID, NOTES["settings"], "", text.encode())]
    return []


class RasterSource(LasSource):
    """An open raster as a cloud, of LAS point format 6; see `LasSource`.

    The points of `part` are counted, see `pcfix.io.tiles.band_of`; before that there are none.
    """

    def __init__(self, part: RasterBand) -> None:
        """Open; an `InputError` if its band does not contain heights in metres."""
        self.path = part.path
        self._stack = ExitStack()
        self.heights = self._stack.enter_context(open_heights(part.path, part.band))
        raster = self.heights.source
        header = laspy.LasHeader(version="1.4", point_format=6)
        step = 10.0 ** np.floor(np.log10(self.heights.cell_m / STEPS_A_CELL))
        header.scales = np.array([step, step, min(step, 0.0001)])
        box = np.array([[*raster.bounds[:2], 0.0], [*raster.bounds[2:], 0.0]])
        header.offsets = np.floor(box.mean(axis=0))
        header.add_crs(self.heights.crs)
        header.generating_software = ""
        header.mins, header.maxs = (part.mins, part.maxs) if part.points else box
        header.point_count = part.points
        self.header, self.evlrs = header, []
        self.vlrs = [*header.vlrs, *_record_of(raster)]
        self.identity = bytes(68)
        try:
            metric_crs(self)
        except BaseException:
            self._stack.close()
            raise

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def chunks(self) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Yield the points of each window with any, row by row."""
        for window in self.heights.window.parts(WINDOW_CELLS):
            height = self.heights.read(window)
            row, column = np.nonzero(np.isfinite(height))
            if len(row) == 0:
                continue
            x, y = self.heights.centres(row + window.row, column + window.column)
            points = laspy.ScaleAwarePointRecord.zeros(len(row), header=self.header)
            xyz = np.column_stack([x, y, height[row, column]])
            steps = np.rint((xyz - self.header.offsets) / self.header.scales)
            points.array["X"], points.array["Y"], points.array["Z"] = steps.T
            points["return_number"][:] = 1
            points["number_of_returns"][:] = 1
            yield points

"""Read rasters, write GeoTIFFs window by window, and subtract one from another (DoD).

A raster of heights is also a cloud: a cell with a height is a point at its centre. It is read in
square windows, so that its size does not matter. Where it has no height (no data, NaN, transparent,
or impossible) there is no point.
"""

import errno
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import laspy
import numpy as np
import numpy.typing as npt
from laspy.vlrs.vlr import VLR

from pcfix.errors import GeometryError, bad_file
from pcfix.grid.lattice import Lattice, Window
from pcfix.io.crs import metres_up
from pcfix.io.files import (
    check_input,
    check_output,
    is_full_disk,
    refusing,
    temporary_output,
    temporary_path,
)
from pcfix.io.las.source import LasSource, metric_crs
from pcfix.io.las.writing import NOTES, USER_ID
from pcfix.io.tables import METRES
from pcfix.model import FloatArray
from pcfix.options.declare import File

if TYPE_CHECKING:
    from pyproj import CRS
    from rasterio.io import DatasetReader, DatasetWriter
    from rasterio.transform import Affine


NO_HEIGHT = -9999.0  # value of cells without a height, which every reader of GeoTIFF knows
IMPOSSIBLE_M = 9000.0  # a larger height is a nodata value that the file does not state
METRE = "metre"
TO_95 = 1.959964  # half-width of 95 % of a normal distribution, in standard deviations
TILE, BLOCK_CELLS = 256, 1024  # sides of the tiles of a file, and of the windows that are worked on
check_tif = partial(check_output, suffixes=(".tif", ".tiff"))  # checks the path of a GeoTIFF


@contextmanager
def open_raster(path: File) -> "Iterator[DatasetReader]":
    """Open a raster to read parts of it; what cannot be read is a ``raster.damaged``."""
    import rasterio

    found = check_input(path)
    with raster_errors(found), rasterio.open(found) as source:
        yield source


def raster_errors(path: Path) -> AbstractContextManager[None]:
    """Turn what GDAL raises on reading a raster into one sentence."""
    from rasterio import errors

    kinds = (errors.RasterioError, errors.RasterioIOError, UnicodeDecodeError)
    sentence = "is damaged, or is not a raster ({}). Export a GeoTIFF."
    return refusing(path, "raster.damaged", sentence, kinds)


def place_of(transform: "Affine", column: Any, row: Any) -> tuple[Any, Any]:
    """Return x and y of a column and row: numbers or arrays of them."""
    t = transform
    return t.a * column + t.b * row + t.c, t.d * column + t.e * row + t.f


def lattice_of(source: "DatasetReader") -> Lattice:
    """Return the cells of a raster that pcfix wrote."""
    size, t = source.res[0], source.transform
    first = round(t.c / size), round(-t.f / size)
    return Lattice(size, *first, source.width, source.height)


def transform_of(lattice: Lattice) -> "Affine":
    """Return the geotransform of the cells of a lattice."""
    from rasterio.transform import from_origin

    size = lattice.resolution_m
    return from_origin(lattice.left_m, lattice.top_m, size, size)


def read_masked(raster: Any, band: int = 1, **how: Any) -> FloatArray:
    """Return a band as float64, scaled as it states, NaN for no value; `how` goes to rasterio."""
    stored = raster.read(band, masked=True, **how).astype(np.float64).filled(np.nan)
    return np.asarray(stored * raster.scales[band - 1] + raster.offsets[band - 1])


def read_onto(path: Path, lattice: Lattice) -> FloatArray:
    """Return the mean of the first band in each cell of a lattice, NaN for no value and beyond."""
    from rasterio.enums import Resampling
    from rasterio.vrt import WarpedVRT

    how = {
        "transform": transform_of(lattice), "width": lattice.width, "height": lattice.height,
        "dtype": "float64", "nodata": NO_HEIGHT, "resampling": Resampling.average,
    }  # fmt: skip
    with open_raster(path) as source, WarpedVRT(source, crs=source.crs, **how) as same:
        return read_masked(same)


def filled_heights(source: "DatasetReader") -> FloatArray:
    """Return the first band with its holes interpolated."""
    height = read_masked(source)
    if np.isnan(height).all():
        raise bad_file(source.name, "raster.empty", "has no heights in its first band. Give a DSM.")
    return filled(height, float(max(height.shape)))


def filled(values: FloatArray, reach: float) -> FloatArray:
    """Return a band whose holes are interpolated, up to `reach` cells from known values."""
    from rasterio.fill import fillnodata

    known = np.isfinite(values)
    if known.all():
        return values
    return np.where(known, values, fillnodata(values.copy(), known, max_search_distance=reach))


def write_bands(target: "DatasetWriter", bands: Iterable[npt.NDArray[Any]], window: Window) -> None:
    """Write part of all bands, each of shape (rows, columns); NaN becomes the raster's nodata."""
    for number, values in enumerate(bands, start=1):
        if np.issubdtype(values.dtype, np.floating):
            values = np.where(np.isnan(values), target.nodata, values)
        target.write(values.astype(target.dtypes[number - 1]), number, window=slices(window))


def slices(window: Window) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the rows and columns of a window as rasterio takes them."""
    return (window.row, window.row_stop), (window.column, window.column_stop)


@contextmanager
def new_raster(
    target: Path,
    cells: "Lattice | DatasetReader",
    crs: "CRS | str | None",
    bands: Mapping[str, str],
    *,
    dtype: str = "float32",
    nodata: float | None = NO_HEIGHT,
    tags: Mapping[str, str] | None = None,
    scale_offset: tuple[float, float] = (1.0, 0.0),
    resampling: str = "average",
) -> "Iterator[DatasetWriter]":
    """Open a new cloud optimised GeoTIFF (COG) for `write_bands`.

    It is written as a plain GeoTIFF, which is then copied. `bands` maps the description of each
    band to its unit; those with names of colours, alpha too, are such. `dtype` and `nodata` are
    those of all bands, `tags` the metadata of the file, `resampling` is for its overviews.
    """
    import rasterio
    from rasterio.enums import ColorInterp
    from rasterio.shutil import copy

    predictor = 3 if dtype.startswith("float") else 2
    packed = {"compress": "deflate", "predictor": predictor, "bigtiff": "IF_SAFER"}
    profile = {
        "driver": "GTiff", "width": cells.width, "height": cells.height, "count": len(bands),
        "dtype": dtype, "nodata": nodata, "interleave": "band", "tiled": True,
        "blockxsize": TILE, "blockysize": TILE, **packed,
        "crs": None if crs is None else rasterio.CRS.from_user_input(crs),
        "transform": transform_of(cells) if isinstance(cells, Lattice) else cells.transform,
    }  # fmt: skip
    near = target.with_name(f"{target.name}.plain.tif")
    with temporary_output(target) as temporary, temporary_path(near) as plain:
        with _written(plain), rasterio.open(plain, "w", **profile) as out:
            for number, (name, unit) in enumerate(bands.items(), start=1):
                out.set_band_description(number, name)
                out.set_band_unit(number, unit)
            known = ColorInterp.__members__
            if bands.keys() & known.keys():
                out.colorinterp = [known.get(name, ColorInterp.undefined) for name in bands]
            out.update_tags(**(tags or {}))
            if scale_offset != (1.0, 0.0):
                out.scales, out.offsets = ([one] * len(bands) for one in scale_offset)
            yield out
        with _written(temporary):
            copy(
                plain, temporary, driver="COG", blocksize=TILE, overview_resampling=resampling,
                statistics="YES", **packed,
            )  # fmt: skip


@contextmanager
def _written(path: Path) -> Iterator[None]:
    """Read the raster that the block wrote, because GDAL may not say that the disk was full.

    An OSError if it is not complete.
    """
    import rasterio
    from rasterio import errors
    from rasterio._err import CPLE_BaseError

    try:
        yield
        with rasterio.open(path) as raster:
            levels = [{"overview_level": level} for level in range(len(raster.overviews(1)))]
        for level in ({}, *levels):
            with rasterio.open(path, **level) as raster:
                for _, window in raster.block_windows(1):
                    raster.read(window=window)
    except (errors.RasterioError, errors.RasterioIOError, CPLE_BaseError) as error:
        if is_full_disk(path.parent, error):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
        raise OSError(str(error)) from error


def write_dod(dsm: Path, reference: Path, output: Path) -> None:
    """Write the first band of one raster minus that of another, metres; replace an older file.

    The output is a GeoTIFF of one band, float32, with the cells and the CRS of `dsm`; -9999 where
    either has no height. If the cells of the reference differ, it is resampled (bilinear).
    """
    from rasterio.enums import Resampling
    from rasterio.vrt import WarpedVRT

    target = check_tif(output, overwrite=True, inputs=[dsm, reference])
    known = 0
    with open_raster(dsm) as one, open_raster(reference) as source:
        crs = source.crs or one.crs
        same = WarpedVRT(
            source, src_crs=crs, crs=one.crs or crs, transform=one.transform, width=one.width,
            height=one.height, resampling=Resampling.bilinear, dtype="float64", nodata=NO_HEIGHT,
        )  # fmt: skip
        with same, new_raster(target, one, one.crs, {"difference": METRE}) as sink:
            for window in Window(0, one.height, 0, one.width).parts(BLOCK_CELLS):
                part = slices(window)
                difference = read_masked(one, window=part) - read_masked(same, window=part)
                known += int(np.isfinite(difference).sum())
                write_bands(sink, [difference], window)
            if known == 0:
                sentence = f"{dsm} and {reference} have no cell in common. Check their CRS."
                raise GeometryError("raster.no_overlap", sentence, dsm=dsm, reference=reference)


def preview(path: Path, cells: int = 360_000) -> "tuple[FloatArray, Affine]":
    """Return a raster of at most `cells`, NaN for no data, and its geotransform."""
    from rasterio.transform import from_bounds

    with open_raster(path) as source:
        scale = max(1.0, math.sqrt(source.height * source.width / cells))
        rows, columns = (max(1, int(size / scale)) for size in source.shape)
        values = read_masked(source, out_shape=(rows, columns))
        return values, from_bounds(*source.bounds, columns, rows)


def outlines(path: Path, cells: int) -> list[Any]:
    """Return the polygons around the known cells of a `preview`; gaps of a cell are closed."""
    import shapely
    from rasterio.features import shapes
    from scipy.ndimage import binary_closing

    values, transform = preview(path, cells)
    known = np.pad(np.isfinite(values), 2)
    known = binary_closing(known, np.ones((3, 3), bool))[2:-2, 2:-2]
    found = shapes(known.astype(np.uint8), mask=known, transform=transform)
    return [shapely.geometry.shape(polygon) for polygon, _ in found]


def values_at(path: Path, xy: FloatArray) -> FloatArray:
    """Return the cells of the first band at places (n, 2); NaN for no value."""
    with open_raster(path) as source:
        cells = source.sample(xy, 1, masked=True)
        stored = np.ravel([cell.astype(np.float64).filled(np.nan) for cell in cells])
        return np.asarray(stored * source.scales[0] + source.offsets[0])


def is_raster(path: object) -> bool:
    """Whether a path is that of a raster by its name; pictures count, to say what they lack."""
    return str(path).lower().endswith((".tif", ".tiff", ".vrt", ".png", ".jpg", ".jpeg"))


@dataclass(frozen=True)
class RasterBand:
    """A band of a raster that is read as a cloud; `pcfix.io.clouds.band_of` counts its points."""

    path: Path
    band: int | None = None
    points: int = 0
    # the lowest and highest coordinates, shape (3,), metres
    mins: FloatArray = field(default_factory=lambda: np.zeros(3))
    maxs: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __str__(self) -> str:
        return str(self.path)

    __fspath__ = __str__


class RasterSource(LasSource):
    """An open raster as a cloud, of LAS point format 6; see `LasSource`.

    It has the open `raster` with the number of the `band` of heights, its `crs`, the `window` of
    all cells and their side `cell_m`. Stored values of `dtype` are heights (m) after multiplication
    by `scale` and addition of `offset`; a copy has `nodata` where there is no height. The points of
    `part` are counted, see `band_of`; before that there are none.
    """

    def __init__(self, part: RasterBand) -> None:
        """Open; an `InputError` if its band does not contain heights in metres."""
        import rasterio
        from pyproj import CRS

        self.path = part.path
        with ExitStack() as stack:
            # GeoTIFF 1.0 states the vertical datum too, which GDAL ignores by default; its default
            # cache is 5 % of the memory of the machine
            settings = rasterio.Env(GTIFF_REPORT_COMPD_CS=True, GDAL_CACHEMAX=64_000_000)
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
            # coordinates are multiples of a power of ten, at least 1000 times finer than a cell
            step = 10.0 ** np.floor(np.log10(self.cell_m / 1000.0))
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
            height = read_masked(self.raster, self.band, window=slices(window))
            for number, kind in enumerate(self.raster.colorinterp, start=1):
                if kind.name == "alpha":  # GDAL ignores it next to a band of floating point
                    height[self.raster.read(number, window=slices(window)) == 0] = np.nan
        height[~(np.abs(height) <= IMPOSSIBLE_M)] = np.nan
        return height

    def chunks(self) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Yield the points of each window with any, row by row."""
        for window in self.window.parts(TILE):  # its points are corrected at once
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


def _height_band(raster: "DatasetReader", part: RasterBand) -> int:
    """Return the number of the band of heights; an `InputError` if there are other values."""
    path, band = part.path, part.band
    kinds = [one.name for one in raster.colorinterp]
    known = [number for number, kind in enumerate(kinds, 1) if kind != "alpha"]
    if band is not None and band not in known:
        sentence = f"has no band {band} of heights; it has {len(known)}. Give another --band."
        raise bad_file(path, "raster.band", sentence, band=band)
    asked = known if band is None else [band]
    colours = "red", "green", "blue", "palette"
    if any(kinds[one - 1] in colours or raster.dtypes[one - 1] == "uint8" for one in asked):
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

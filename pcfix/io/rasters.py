"""Read rasters, write GeoTIFFs window by window, and subtract one from another (DoD)."""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError, bad_file
from pcfix.grid.lattice import Lattice, Window
from pcfix.io.files import (
    check_input,
    check_output,
    is_full_disk,
    refusing,
    temporary_output,
    temporary_path,
)
from pcfix.model import FloatArray
from pcfix.options.declare import File

if TYPE_CHECKING:
    from pyproj import CRS
    from rasterio.io import DatasetReader, DatasetWriter
    from rasterio.transform import Affine


NO_HEIGHT = -9999.0
"""Value of cells without a height; every program that reads GeoTIFF knows this one."""
IMPOSSIBLE_M = 9000.0
"""A larger height is a nodata value that the file does not state."""
METRE = "metre"
TO_95 = 1.959964
"""Half-width of 95 % of a normal distribution, in standard deviations."""
TILE, BLOCK_CELLS = 256, 1024
"""Sides of the tiles of a file, and of the windows that are worked on."""
check_tif = partial(check_output, suffixes=(".tif", ".tiff"))
"""Return the path of a GeoTIFF that may be written."""


@contextmanager
def open_raster(path: File) -> Iterator[DatasetReader]:
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


def place_of(transform: Affine, column: Any, row: Any) -> tuple[Any, Any]:
    """Return x and y of a column and row: numbers or arrays of them."""
    t = transform
    return t.a * column + t.b * row + t.c, t.d * column + t.e * row + t.f


def lattice_of(source: DatasetReader) -> Lattice:
    """Return the cells of a raster that pcfix wrote."""
    size, t = source.res[0], source.transform
    first = round(t.c / size), round(-t.f / size)
    return Lattice(size, *first, source.width, source.height)


def transform_of(lattice: Lattice) -> Affine:
    """Return the geotransform of the cells of a lattice."""
    from rasterio.transform import from_origin

    size = lattice.resolution_m
    return from_origin(lattice.left_m, lattice.top_m, size, size)


def read_masked(raster: Any, band: int = 1, **how: Any) -> FloatArray:
    """Return a band as float64, NaN for no value; `how` goes to rasterio."""
    return np.asarray(raster.read(band, masked=True, **how).astype(np.float64).filled(np.nan))


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


def filled_heights(source: DatasetReader) -> FloatArray:
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


def write_bands(target: DatasetWriter, bands: Iterable[npt.NDArray[Any]], window: Window) -> None:
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
    cells: Lattice | DatasetReader,
    crs: CRS | str | None,
    bands: Mapping[str, str],
    *,
    dtype: str = "float32",
    nodata: float | None = NO_HEIGHT,
    tags: Mapping[str, str] | None = None,
    scale_offset: tuple[float, float] = (1.0, 0.0),
    resampling: str = "average",
) -> Iterator[DatasetWriter]:
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


PREVIEW_CELLS = 360_000


def preview(path: Path, cells: int = PREVIEW_CELLS) -> tuple[FloatArray, Affine]:
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
        return np.ravel([cell.astype(np.float64).filled(np.nan) for cell in cells])

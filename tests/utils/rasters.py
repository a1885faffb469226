"""A raster in memory, for tests."""

from typing import Any, NamedTuple

import numpy as np
import rasterio

from pcfix.io.rasters import open_raster


class Raster(NamedTuple):
    """The array (bands, rows, columns) as stored, the first row at the top, and its place."""

    array: np.ndarray
    transform: Any
    crs: Any
    nodata: float | None


def read_raster(path: Any) -> Raster:
    with open_raster(path) as source:
        return Raster(source.read(), source.transform, source.crs, source.nodata)


def write_raster(path: Any, height: np.ndarray, left: float, top: float, cell: float, **more: Any):
    """Write heights, shape (rows, columns); `more` goes to rasterio."""
    rows, columns = height.shape
    how = {"driver": "GTiff", "width": columns, "height": rows, "count": 1, "dtype": "float64"}
    transform = rasterio.Affine(cell, 0.0, left, 0.0, -cell, top)
    with rasterio.open(path, "w", **how, transform=transform, **more) as target:
        target.write(height, 1)


# Whether GDAL writes statistics into cloud-optimised rasters.
HAS_STATISTICS = tuple(map(int, rasterio.__gdal_version__.split(".")[:2])) >= (3, 8)

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


HAS_STATISTICS = tuple(map(int, rasterio.__gdal_version__.split(".")[:2])) >= (3, 8)
"""Whether GDAL writes statistics into cloud-optimised rasters."""

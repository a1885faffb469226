"""Open results as xarray, GeoPandas and pandas objects; these libraries are loaded on first use."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcfix.io.files import check_input
from pcfix.libraries import optional_library

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from pandas import DataFrame
    from xarray import DataArray

    from pcfix.io.vectors import Layer


def load_for_analysis(name: str) -> Any:
    """Import a library of the extra ``analysis``."""
    return optional_library(name, "analysis", "This")


def open_array(path: Path) -> DataArray:
    """Open a raster of one band, NaN where it has no data; values are read when they are used."""
    found = check_input(path)
    array = load_for_analysis("rioxarray").open_rasterio(found, masked=True)
    return array.squeeze("band", drop=True).rename(found.stem)


def frame_of_layer(path: Path, layer: str) -> GeoDataFrame:
    """Read a layer of a GeoPackage."""
    return load_for_analysis("geopandas").read_file(check_input(path), layer=layer)


def frame_of(layer: Layer, crs: Any) -> GeoDataFrame:
    """Return a layer that has not been written yet."""
    frame = load_for_analysis("geopandas").GeoDataFrame
    return frame(layer.values, geometry=list(layer.geometries), crs=crs)


def table_of_csv(path: Path) -> DataFrame:
    """Read a table."""
    return load_for_analysis("pandas").read_csv(check_input(path))

"""Results as xarray, GeoPandas and pandas have them; these are loaded when first asked for."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcfix.errors import SettingError
from pcfix.io.files import check_input

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from pandas import DataFrame
    from xarray import DataArray

    from pcfix.io.geopackage import Layer


def load_for_analysis(name: str) -> Any:
    """Import a library; where it is not installed, a `SettingError` names the extra."""
    try:
        return import_module(name)
    except ImportError as error:
        raise SettingError(
            f"This needs {name}, which is not installed; run: pip install 'pcfix[analysis]'."
        ) from error


def open_array(path: Path) -> DataArray:
    """Open a raster of one band, NaN where it has no data; values are read when they are used."""
    found = check_input(path)
    array = load_for_analysis("rioxarray").open_rasterio(found, masked=True)
    return array.squeeze("band", drop=True).rename(found.stem)


def frame_of_layer(path: Path, layer: str) -> GeoDataFrame:
    """Return a layer of a GeoPackage."""
    return load_for_analysis("geopandas").read_file(check_input(path), layer=layer)


def frame_of(layer: Layer, crs: Any) -> GeoDataFrame:
    """Return a layer that has not been written."""
    frame = load_for_analysis("geopandas").GeoDataFrame
    return frame(layer.values, geometry=list(layer.geometries), crs=crs)


def table_of_csv(path: Path) -> DataFrame:
    """Return a table."""
    return load_for_analysis("pandas").read_csv(check_input(path))

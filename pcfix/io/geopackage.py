"""Layers of points, lines and polygons, with their styles, written as one GeoPackage."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import shapely

from pcfix.errors import SettingError
from pcfix.io.atomic import cannot_write, temporary_output
from pcfix.io.crs import parse_crs
from pcfix.io.files import check_output
from pcfix.io.vectors import load_pyogrio
from pcfix.options.declare import File

if TYPE_CHECKING:
    from pyproj import CRS

OLDER = {"VERSION": "1.2"}
"""Of GeoPackage: GDAL before 3.7 warns of newer ones."""
STYLES = "layer_styles"
"""The table in which QGIS looks for styles, and keeps its own."""


class Layer(NamedTuple):
    """Geometries of one kind (LineString, Point Z ...), by name a value of each, and a style (QML).

    A layer may be empty.
    """

    name: str
    kind: str
    geometries: Sequence[Any]
    values: dict[str, Any]
    style: str = ""


def check_layers(path: Path) -> None:
    """Refuse what `write_layers` cannot write."""
    if path.suffix.lower() != ".gpkg":
        sentence = f"{path}: lines are written as GeoPackage. Give a name in .gpkg."
        raise SettingError("output.suffix", sentence, path=path)
    load_pyogrio()


def write_layers(
    path: File, layers: Sequence[Layer], crs: CRS | str | None, *, overwrite: bool
) -> None:
    """Write layers in a CRS as one GeoPackage."""
    target = check_output(path, overwrite=overwrite)
    wkt = None if crs is None else parse_crs(crs, "the cloud").to_wkt()
    with temporary_output(target) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a cloud may have no CRS
        try:
            for number, one in enumerate(layers):
                geometry = shapely.to_wkb(np.array([*one.geometries, None], object)[:-1])
                load_pyogrio().raw.write(
                    temporary, geometry, [np.asarray(v) for v in one.values.values()],
                    list(one.values), layer=one.name, crs=wkt, driver="GPKG",
                    geometry_type=one.kind, append=number > 0,
                    **({} if number else {"dataset_options": OLDER}),
                )  # fmt: skip
            _write_styles(temporary, [one for one in layers if one.style])
        except RuntimeError as error:
            raise cannot_write(target, error, temporary) from error


def _write_styles(path: Path, layers: Sequence[Layer]) -> None:
    """Add the table of styles, as QGIS writes it."""
    columns: dict[str, Any] = {
        "f_table_catalog": "", "f_table_schema": "", "f_geometry_column": "geom",
        "f_table_name": [one.name for one in layers], "styleName": [one.name for one in layers],
        "styleQML": [one.style for one in layers], "styleSLD": "", "description": "pcfix",
        "owner": "",
    }  # fmt: skip
    fields = {name: np.full(len(layers), value, object) for name, value in columns.items()}
    fields["useAsDefault"] = np.ones(len(layers), bool)
    fields["update_time"] = np.full(len(layers), "2020-01-01", "datetime64[ms]")
    if layers:
        load_pyogrio().raw.write(
            path, None, [*fields.values()], [*fields], layer=STYLES, driver="GPKG", append=True,
            crs=None, geometry_type=None,
        )  # fmt: skip

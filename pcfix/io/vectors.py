"""Points, lines and polygons from vector files and from tables."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError, SettingError
from pcfix.io.crs import parse_crs
from pcfix.io.files import check_input
from pcfix.io.placement import way_to_cloud
from pcfix.io.vector_texts import TEXT_SUFFIXES, read_text

if TYPE_CHECKING:
    import os
    from collections.abc import Callable
    from types import ModuleType

    import numpy.typing as npt
    from pyproj import CRS

    from pcfix.model import FloatArray

GDAL_SUFFIXES = (".gpkg", ".shp", ".geojson", ".json")
KINDS = "GeoPackage (.gpkg), Shapefile (.shp), GeoJSON (.geojson, .json), WKT (.wkt) or CSV (.csv)"
LAYER_MARK = "|"
WGS84, WGS84_3D = "EPSG:4326", "EPSG:4979"
LONGEST_EDGE_M = 500.0
"""Edges are cut so before they go into another CRS: one of 500 m is straight in both to 5 mm."""
_METRES_PER_DEGREE = 111_000.0


@dataclass(frozen=True, eq=False)
class Vectors:
    """The geometries of one layer.

    Attributes
    ----------
    geometries : array of shapely geometries, shape (n,)
        None missing or empty; x is east or longitude.
    crs : str or None
        What pyproj understands; None where the file names none.
    name : str
        The file and its layer, for messages.
    notes : tuple of str
        What was done on reading, for the summary.
    """

    geometries: npt.NDArray[Any]
    crs: str | None
    name: str
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.geometries)

    @cached_property
    def coordinates(self) -> FloatArray:
        """All vertices, shape (n, 3); z is NaN where a geometry has none."""
        shapely = load("shapely")
        return np.asarray(shapely.get_coordinates(self.geometries, include_z=True), np.float64)

    @property
    def kinds(self) -> str:
        """The types of geometry that are there, for messages."""
        return ", ".join(sorted({geometry.geom_type for geometry in self.geometries}))


def is_vector_file(path: str | os.PathLike[str]) -> bool:
    """Whether the name of a file, with or without a layer, is one that `read_vectors` reads."""
    suffix = Path(_split_layer(path)[0]).suffix.lower()
    return suffix in (*GDAL_SUFFIXES, *TEXT_SUFFIXES)


def read_vectors(
    path: str | os.PathLike[str], *, layer: str | None = None, crs: str | None = None
) -> Vectors:
    """Read one layer of a vector file.

    Parameters
    ----------
    path : path
        ``.gpkg``, ``.shp``, ``.geojson``, ``.json``; ``.wkt`` with one geometry a line; ``.csv``
        or ``.txt`` with the columns x, y and perhaps z, or easting, northing, height, or
        longitude, latitude, height, or wkt. A layer may follow: ``river.gpkg|layername=shore``.
    layer : str, optional
        Its name. Default: the only one.
    crs : str, optional
        What the file's CRS is, over what it says itself. ``local``: the cloud's, whatever it says.

    Returns
    -------
    Vectors
        In the CRS of the file.

    Raises
    ------
    InputError
        If the file is missing, damaged, empty or of another kind, has several layers and none
        was named, or its numbers are not degrees where they should be.
    SettingError
        If the extra ``vector`` is not installed.
    """
    file, named = _split_layer(path)
    source = check_input(file)
    suffix = source.suffix.lower()
    if suffix in TEXT_SUFFIXES:
        shapely = load("shapely")
        geometries, found = read_text(source, shapely)
        name = str(source)
    elif suffix in GDAL_SUFFIXES:
        geometries, found, name = _read_gdal(source, layer or named)
    else:
        raise InputError(f"{source}: is not a vector file that pcfix reads; give {KINDS}.")
    vectors = Vectors(geometries, crs or found, name)
    return _checked(_without_gaps(vectors))


def load(module: str) -> ModuleType:
    """Import shapely or pyogrio.

    Raises
    ------
    SettingError
        If it is not installed; the message names the extra.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise SettingError(
            f"Vector files need {module}, which is not installed; run: pip install 'pcfix[vector]'."
        ) from error


def in_cloud_crs(vectors: Vectors, cloud_crs: str | CRS | None, *, heights: bool) -> Vectors:
    """Return geometries in the cloud's CRS.

    Parameters
    ----------
    vectors : Vectors
    cloud_crs : str, CRS or None
        Projected, in metres; None where the cloud names none.
    heights : bool
        Whether z counts; without it z is left as it is.

    Raises
    ------
    InputError
        If the two CRS or their heights cannot be brought together, or a vertex has no place there.
    """
    at = vectors.coordinates
    heights = heights and bool(np.isfinite(at[:, 2]).any())
    forward, notes = way_to_cloud(
        vectors.crs, cloud_crs, np.nan_to_num(at), vectors.name, heights=heights
    )
    vectors = replace(vectors, notes=(*vectors.notes, *notes))
    if forward is None:
        return vectors
    geometries = vectors.geometries
    if not heights:
        geometries = load("shapely").segmentize(geometries, _longest_edge(vectors.crs))
    moved = replace(vectors, geometries=_moved(geometries, forward))
    if not np.isfinite(moved.coordinates[:, :2]).all():
        raise InputError(
            f"{vectors.name}: some of it has no place in the cloud's CRS; check the file's CRS."
        )
    return moved


def _moved(geometries: npt.NDArray[Any], forward: Callable[[FloatArray], FloatArray]) -> Any:
    """Return geometries with all vertices moved; those without heights stay so."""
    shapely = load("shapely")

    def move(xyz: FloatArray) -> FloatArray:
        there = forward(np.nan_to_num(xyz))
        there[np.isnan(xyz[:, 2]), 2] = np.nan
        return there

    moved = shapely.transform(geometries, move, include_z=True)
    return np.where(shapely.has_z(geometries), moved, shapely.force_2d(moved))


def _longest_edge(crs: str | None) -> float:
    """Return `LONGEST_EDGE_M` in the unit of a CRS; its feet and degrees need no more digits."""
    degrees = crs is not None and parse_crs(crs, "the file").is_geographic
    return LONGEST_EDGE_M / (_METRES_PER_DEGREE if degrees else 1.0)


def _split_layer(path: str | os.PathLike[str]) -> tuple[str, str | None]:
    """Return the file and the layer of ``file|layername=layer``, as QGIS writes it."""
    file, _, layer = str(path).partition(LAYER_MARK)
    return file, layer.removeprefix("layername=") or None


def _read_gdal(path: Path, layer: str | None) -> tuple[npt.NDArray[Any], str | None, str]:
    """Return geometries (None where one is missing), CRS and name."""
    shapely, pyogrio = load("shapely"), load("pyogrio")
    try:
        layer = _layer(path, pyogrio.list_layers(path), layer)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # M values, which are not needed, are left out
            meta, _, wkb, _ = load("pyogrio.raw").read(path, layer=layer, columns=[])
        geometries = shapely.from_wkb(wkb)
    except (RuntimeError, ValueError, shapely.errors.ShapelyError) as error:
        first = str(error).split(";")[0].strip().rstrip(".")
        raise InputError(f"{path}: cannot be read ({first}); export it again.") from error
    name = str(path) if layer == path.stem else f"{path}, layer {layer}"
    crs = meta["crs"]
    if path.suffix.lower() in (".geojson", ".json") and crs == WGS84:
        crs = WGS84_3D if shapely.has_z(geometries).any() else WGS84
    return geometries, crs, name


def _layer(path: Path, layers: npt.NDArray[Any], wanted: str | None) -> str:
    """Return the layer that is wanted, or the only one with geometries."""
    names = [str(name) for name, kind in layers if kind is not None]
    listed = ", ".join(names)
    if not names:
        raise InputError(f"{path}: holds no layer with points, lines or polygons.")
    if wanted is None and len(names) > 1:
        raise InputError(
            f"{path}: has {len(names)} layers ({listed}); name one, as in"
            f" {path.name}{LAYER_MARK}layername={names[0]}."
        )
    if wanted is not None and wanted not in names:
        raise InputError(f"{path}: has no layer {wanted} with geometries; it has {listed}.")
    return wanted or names[0]


def _without_gaps(vectors: Vectors) -> Vectors:
    """Return the geometries that are there and finite, and say how many were not."""
    shapely = load("shapely")
    gone = shapely.is_missing(vectors.geometries) | shapely.is_empty(vectors.geometries)
    xy, at = shapely.get_coordinates(vectors.geometries, return_index=True)
    gone[at[~np.isfinite(xy).all(axis=1)]] = True
    if gone.all():
        raise InputError(f"{vectors.name}: holds no geometry with coordinates.")
    note = f"{vectors.name}: {int(gone.sum())} features without coordinates are left out."
    notes = (*vectors.notes, note) if gone.any() else vectors.notes
    return replace(vectors, geometries=vectors.geometries[~gone], notes=notes)


def _checked(vectors: Vectors) -> Vectors:
    """Refuse a CRS that is unknown, and degrees that are none.

    Raises
    ------
    InputError
    """
    if vectors.crs is None or vectors.crs.strip().lower() == "local":
        return vectors
    crs = parse_crs(vectors.crs, vectors.name)
    if not crs.is_geographic or crs.axis_info[0].unit_name != "degree":
        return vectors
    x, y = vectors.coordinates[:, 0], vectors.coordinates[:, 1]
    wrong = (np.abs(x) > 360.0) | (np.abs(y) > 90.0)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise InputError(
            f"{vectors.name}: {x[i]:.10g}, {y[i]:.10g} is no longitude and latitude, but its CRS"
            f" is {crs.name} (as it is for every GeoJSON that names none); say which CRS it is in."
        )
    return vectors

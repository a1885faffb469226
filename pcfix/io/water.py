"""The water surface, from one word that says what it is."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError, SettingError
from pcfix.io.files import check_input
from pcfix.io.meshes import check_mesh, read_mesh
from pcfix.io.water_rasters import read_water_raster
from pcfix.model import WaterDimension, WaterMesh, WaterPlane

if TYPE_CHECKING:
    import os

    from pyproj import CRS

    from pcfix.model import WaterSurface

KINDS = (
    "a level such as 0.37, plane:a,b,c, dim:NAME, a mesh file (.obj, .ply), or a raster of heights"
    " (.tif or another that GDAL reads)"
)

_NO_RASTERS = (".csv", ".txt", ".json", ".geojson", ".gpkg", ".shp", ".wkt", ".las", ".laz")
"""GDAL would try some of these as rasters all the same."""


def read_water(
    spec: float | str | os.PathLike[str],
    cloud_crs: str | CRS | None = None,
    bounds: tuple[float, float, float, float] | None = None,
) -> WaterSurface:
    """Return the water surface that a word describes.

    Parameters
    ----------
    spec : float, str or path
        ``0.37``
            a level, metres, in the cloud's own heights;
        ``plane:a,b,c``
            the plane z = a + b x + c y in the cloud's own coordinates;
        ``dim:NAME``
            a dimension of the cloud that holds the height of the surface above each point;
            NaN where it is not known;
        ``surface.obj``, ``surface.ply``
            a triangulated surface in the cloud's own coordinates;
        ``surface.tif``
            or another raster that GDAL reads: one band of heights, in any CRS.
    cloud_crs : str or CRS, optional
        Projected, metres; rasters are brought to it. Default: that of the raster.
    bounds : tuple of 4 float, optional
        West, south, east and north end of the cloud: of a large raster only what lies about it
        is read.

    Returns
    -------
    WaterSurface

    Raises
    ------
    SettingError
        If the word is none of these, or its numbers are not finite.
    InputError
        If the mesh or raster is missing or damaged, or cannot be brought to the cloud's CRS.

    Examples
    --------
    >>> import pcfix
    >>> pcfix.read_water("0.37")
    WaterPlane(a=0.37, b=0.0, c=0.0)
    """
    if isinstance(spec, (int, float)):
        return WaterPlane(*_finite([float(spec)], str(spec)))
    text = str(spec).strip()
    kind, colon, rest = text.partition(":")
    if colon and kind.lower() == "plane":
        parts = rest.split(",")
        if len(parts) != 3:
            raise SettingError(f"water '{text}': plane: needs three numbers a,b,c.")
        return WaterPlane(*_finite(parts, text))
    if colon and kind.lower() == "dim":
        if not rest:
            raise SettingError(f"water '{text}': name the dimension, as in dim:w_surf.")
        return WaterDimension(rest)
    if Path(text).suffix.lower() in (".obj", ".ply"):
        return _mesh(check_input(text))
    try:
        return WaterPlane(*_finite([text], text))
    except SettingError:
        if not (Path(text).is_file() or _is_named_like_a_file(text)):
            raise
        check_input(text)
    if Path(text).suffix.lower() in _NO_RASTERS:
        raise InputError(f"{text}: is not a water surface that pcfix reads; give {KINDS}.")
    return read_water_raster(text, cloud_crs, bounds)


def _is_named_like_a_file(text: str) -> bool:
    """Whether a word ends as file names do, with a suffix that no number has."""
    return Path(text).suffix[1:2].isalpha()


def _finite(values: list[str] | list[float], text: str) -> list[float]:
    try:
        numbers = [float(value) for value in values]
    except ValueError:
        raise SettingError(f"water '{text}' is not understood; give {KINDS}.") from None
    if not all(math.isfinite(number) for number in numbers):
        raise SettingError(f"water '{text}': the numbers must be finite.")
    return numbers


def _mesh(path: Path) -> WaterMesh:
    vertices, triangles = read_mesh(path)
    if len(triangles) == 0:
        raise InputError(f"{path}: holds no triangles; export the water surface as a mesh.")
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: a vertex is not finite; export the mesh again.")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise InputError(f"{path}: a face names a vertex that is not there; export it again.")
    mesh = WaterMesh(vertices, triangles, path.name)
    check_mesh(mesh, path)
    return mesh

"""The water surface, from one word that says what it is; triangle meshes.

These are read here, and not by open3d: it hands OBJ coordinates on as 32-bit floats, half a metre
apart at a northing of five million, and a damaged PLY ends the process.
"""

from __future__ import annotations

import math
import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import GeometryError, InputError, PcfixWarning, SettingError
from pcfix.io.files import check_input
from pcfix.io.ply import Records
from pcfix.io.water_rasters import read_water_raster
from pcfix.model import FloatArray, IntArray, WaterDimension, WaterMesh, WaterPlane, WaterSurface
from pcfix.options.declare import File

if TYPE_CHECKING:
    from pyproj import CRS


KINDS = (
    "a level such as 0.37, plane:a,b,c, dim:NAME, a mesh file (.obj, .ply), or a raster of heights"
    " (.tif or another that GDAL reads)"
)

_NO_RASTERS = (".csv", ".txt", ".json", ".geojson", ".gpkg", ".shp", ".wkt", ".las", ".laz")
"""GDAL would try some of these as rasters all the same."""


MOST_OVERLAP = 0.01
"""Of the plan area: what folds at the rim of a triangulated shore come to."""
LEAST_FACET_M2 = 1e-6
_CORNERS = "vertex_indices", "vertex_index"
_MOST_VERTICES = 2**31


def read_water(
    spec: float | File,
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
        if not (os.path.lexists(text) or Path(text).suffix[1:2].isalpha()):
            raise  # no number ends as file names do
        check_input(text)
    if Path(text).suffix.lower() in _NO_RASTERS:
        raise InputError(f"{text}: is not a water surface that pcfix reads; give {KINDS}.")
    return read_water_raster(text, cloud_crs, bounds)


def _finite(values: list[str] | list[float], text: str) -> list[float]:
    try:
        numbers = [float(value) for value in values]
    except ValueError:
        raise SettingError(f"water '{text}' is not understood; give {KINDS}.") from None
    if not all(math.isfinite(number) for number in numbers):
        raise SettingError(f"water '{text}': the numbers must be finite.")
    return numbers


def _mesh(path: Path) -> WaterMesh:
    read = _read_obj if path.suffix.lower() == ".obj" else _read_ply
    vertices, triangles = read(path)
    if len(triangles) == 0:
        raise InputError(f"{path}: holds no triangles; export the water surface as a mesh.")
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: a vertex is not finite; export the mesh again.")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise InputError(f"{path}: a face names a vertex that is not there; export it again.")
    mesh = WaterMesh(vertices, triangles, path.name)
    check_mesh(mesh, path)
    return mesh


def check_mesh(mesh: WaterMesh, path: Path) -> None:
    """Refuse a mesh that is no height field, and warn of facets that do not count.

    Which way a facet faces does not matter, nor do holes, edges of three facets, or facets that
    overlap at one height: all are well defined as heights. Vertical facets have none.
    """
    from pcfix.water.surface import build_tin, in_two_sheets

    try:
        tin = build_tin(mesh)
    except GeometryError as error:
        raise InputError(f"{path}: {error}") from None
    double, area_m2 = in_two_sheets(tin)
    share = float(area_m2[double].sum() / area_m2.sum())
    if share > MOST_OVERLAP:
        raise InputError(
            f"{path}: {100.0 * share:.0f} % of the mesh lies above or below another part of it;"
            " the water has one height at a place, so export its surface alone, not a closed body"
            " or several surfaces."
        )
    if double.any():
        _note(
            f"{path}: facets overlap others at another height ({int(double.sum()):,} of"
            f" {len(mesh.triangles):,}); there the water may be either."
        )
    edges = np.diff(mesh.vertices[mesh.triangles], axis=1)
    size_m2 = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2.0
    upright = int((size_m2 > LEAST_FACET_M2).sum()) - int((area_m2 > LEAST_FACET_M2).sum())
    if upright > 0:
        _note(f"{path}: vertical facets have no height and are left out ({upright:,}).")


def _note(sentence: str) -> None:
    warnings.warn(sentence, PcfixWarning, stacklevel=4)


def _read_obj(path: Path) -> tuple[FloatArray, IntArray]:
    """Return vertices, shape (v, 3), and triangles, shape (t, 3); polygons as fans of these."""
    vertices: list[list[float]] = []
    triangles: list[list[int]] = []
    for number, line in enumerate(path.read_text("latin-1").splitlines(), start=1):
        key, *fields = line.split() or [""]
        try:
            if key == "v":
                x, y, z = fields[:3]
                vertices.append([float(x), float(y), float(z)])
            elif key == "f":
                corners = [_obj_index(field, len(vertices)) for field in fields]
                triangles += [[corners[0], *corners[i : i + 2]] for i in range(1, len(corners) - 1)]
        except ValueError as error:
            raise InputError(f"{path}: line {number} is not an OBJ line ({error}).") from error
    return np.array(vertices).reshape(-1, 3), np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _obj_index(field: str, count: int) -> int:
    """Return the row of a corner such as ``7``, ``7/1/3`` or, counted from the end, ``-1``."""
    index = int(field.split("/")[0])
    if abs(index) > _MOST_VERTICES:
        raise ValueError(f"there is no vertex {index}")
    return index - 1 if index > 0 else count + index


def _read_ply(path: Path) -> tuple[FloatArray, IntArray]:
    """Return vertices and triangles as `_read_obj` does; see there."""
    vertices, faces = Records(path), Records(path, "face")
    named = [n for n in _CORNERS if faces.header.item(n, is_list=True)]
    if not named or None in (vertices.header.item(axis, is_list=False) for axis in "xyz"):
        raise InputError(
            f"{path}: the vertices need x, y and z, and the faces a list {_CORNERS[0]}; export it"
            " again as a mesh."
        )
    start, corners = faces.lists(named[0])
    with np.errstate(invalid="ignore"):
        corner = corners.astype(np.int64)
    if (corner != corners).any():
        raise InputError(f"{path}: a face names a vertex by no whole number; export it again.")
    count = np.maximum(np.diff(start) - 2, 0)
    first = np.repeat(start[:-1], count)
    other = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
    return vertices.numbers(*"xyz"), corner[np.column_stack([first, other, other + 1])]

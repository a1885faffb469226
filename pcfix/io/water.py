"""Read the water surface: a level, a plane, a dimension, a triangle mesh or a raster.

Meshes are read here, not by open3d: it returns OBJ coordinates as 32-bit floats, half a metre
apart at a northing of five million, and a damaged PLY ends the process.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import GeometryError, SettingError, bad_file
from pcfix.io.files import check_input
from pcfix.io.ply import Records
from pcfix.io.tables import number
from pcfix.io.water_rasters import read_water_raster
from pcfix.model import FloatArray, IntArray, WaterDimension, WaterMesh, WaterPlane, WaterSurface
from pcfix.options.declare import File

if TYPE_CHECKING:
    from pyproj import CRS

KINDS = (
    "a level such as 0.37, plane:a,b,c, dim:NAME, a mesh (.obj, .ply) or a raster of heights (.tif)"
)
_NOT_RASTERS = (".csv", ".txt", ".json", ".geojson", ".gpkg", ".shp", ".wkt", ".las", ".laz")
"""GDAL would try some of these as rasters all the same."""
MOST_OVERLAP = 0.01
"""Of the plan area; the triangulation of a shoreline may fold at its rim by less."""
_CORNERS = "vertex_indices", "vertex_index"
_MOST_VERTICES = 2**31


def read_water(
    spec: float | File,
    cloud_crs: str | CRS | None = None,
    bounds: tuple[float, float, float, float] | None = None,
) -> WaterSurface:
    """Read the water surface.

    Parameters
    ----------
    spec : float, str or path
        ``0.37``
            a level, metres, in the cloud's own heights;
        ``plane:a,b,c``
            the plane z = a + b x + c y in the cloud's own coordinates;
        ``dim:NAME``
            a dimension of the cloud with the height of the surface above each point; NaN if it
            is not known;
        ``surface.obj``, ``surface.ply``
            a triangulated surface in the cloud's own coordinates;
        ``surface.tif``
            or another raster that GDAL reads: one band of heights, in any CRS.
    cloud_crs : str or CRS, optional
        Projected, metres; rasters are brought to it. Default: that of the raster.
    bounds : tuple of 4 float, optional
        West, south, east and north end of the cloud: only this part of a raster is read.

    Examples
    --------
    >>> import pcfix
    >>> pcfix.read_water("0.37")
    WaterPlane(a=0.37, b=0.0, c=0.0)
    """
    text = str(spec).strip()
    kind, _, rest = text.partition(":")
    if kind.lower() == "dim" and rest:
        return WaterDimension(rest)
    is_plane, suffix = kind.lower() == "plane", Path(text).suffix.lower()
    numbers = [number(part) for part in (rest.split(",") if is_plane else [text])]
    if len(numbers) == (3 if is_plane else 1) and np.isfinite(numbers).all():
        return WaterPlane(*numbers)
    if is_plane or not (os.path.lexists(text) or suffix[1:2].isalpha()):
        sentence = f"water '{text}' is not understood. Give {KINDS}."
        raise SettingError("water.spec", sentence, value=text)
    found = check_input(text)
    if suffix in (".obj", ".ply"):
        return _mesh(found)
    if suffix in _NOT_RASTERS:
        raise bad_file(text, "water.format", f"is not a water surface. Give {KINDS}.")
    return read_water_raster(text, cloud_crs, bounds)


def _mesh(path: Path) -> WaterMesh:
    """Read a mesh that is a height field."""
    from pcfix.water.surface import build_tin, in_two_sheets

    read = _read_obj if path.suffix.lower() == ".obj" else _read_ply
    vertices, triangles = read(path)
    if len(triangles) == 0:
        raise bad_file(path, "water.mesh_empty", "has no triangles. Export a mesh.")
    missing = (triangles < 0) | (triangles >= len(vertices))
    if missing.any() or not np.isfinite(vertices).all():
        sentence = "a vertex is missing or not finite. Export it again."
        raise bad_file(path, "water.mesh_damaged", sentence)
    mesh = WaterMesh(vertices, triangles, path.name)
    try:
        tin = build_tin(mesh)
    except GeometryError as error:
        raise bad_file(path, "water.mesh_flat", str(error)) from None
    # holes, edges of three facets and facets that overlap at one height do not matter
    double, area_m2 = in_two_sheets(tin)
    share = float(area_m2[double].sum() / area_m2.sum())
    if share > MOST_OVERLAP:
        sentence = f"{100.0 * share:.0f} % of the mesh lies above another part. Export one surface."
        raise bad_file(path, "water.mesh_overlap", sentence, share=share)
    return mesh


def _read_obj(path: Path) -> tuple[FloatArray, IntArray]:
    """Return vertices, shape (v, 3), and triangles, shape (t, 3); a polygon is a fan of these."""
    vertices: list[list[float]] = []
    triangles: list[list[int]] = []
    for at, line in enumerate(path.read_text("latin-1").splitlines(), start=1):
        key, *fields = line.split() or [""]
        try:
            if key == "v":
                x, y, z = fields[:3]
                vertices.append([float(x), float(y), float(z)])
            elif key == "f":
                # a corner such as 7, 7/1/3 or, counted from the end, -1
                rows = [int(field.split("/")[0]) for field in fields]
                if max(map(abs, rows), default=0) > _MOST_VERTICES:
                    raise ValueError(f"there is no vertex {max(rows, key=abs)}")
                corners = [row - 1 if row > 0 else len(vertices) + row for row in rows]
                triangles += [[corners[0], *corners[i : i + 2]] for i in range(1, len(corners) - 1)]
        except ValueError as error:
            sentence = f"line {at} is not an OBJ line ({error})."
            raise bad_file(path, "water.mesh_damaged", sentence, line=at) from error
    return np.array(vertices).reshape(-1, 3), np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _read_ply(path: Path) -> tuple[FloatArray, IntArray]:
    """Return vertices and triangles as `_read_obj` does."""
    vertices, faces = Records(path), Records(path, "face")
    named = [n for n in _CORNERS if faces.header.item(n, is_list=True)]
    if not named or None in (vertices.header.item(axis, is_list=False) for axis in "xyz"):
        sentence = f"needs vertices with x, y, z and faces with {_CORNERS[0]}. Export a mesh."
        raise bad_file(path, "water.mesh_damaged", sentence)
    start, corners = faces.lists(named[0])
    with np.errstate(invalid="ignore"):
        corner = corners.astype(np.int64)
    if (corner != corners).any():
        sentence = "a face names a vertex by a number that is not whole. Export it again."
        raise bad_file(path, "water.mesh_damaged", sentence)
    count = np.maximum(np.diff(start) - 2, 0)
    first = np.repeat(start[:-1], count)
    other = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
    return vertices.numbers(*"xyz"), corner[np.column_stack([first, other, other + 1])]

"""Read the water surface: a level, a plane, a dimension, a mesh or a raster; write rasters.

Meshes are read here, not by open3d: it returns OBJ coordinates as 32-bit floats, half a metre
apart at a northing of five million, and a damaged PLY ends the process.

A north-up raster in the cloud's own CRS is used cell by cell. Any other is resampled to a grid in
the cloud's CRS, with the interpolation of `pcfix.water.surface`, so that a gap stays a gap; GDAL
would fill half a cell of it. Positions are transformed as those of cameras are, which refuses what
PROJ can only guess.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely
from rasterio.windows import Window

from pcfix.errors import GeometryError, PcfixWarning, SettingError, bad_file
from pcfix.io import crs as systems
from pcfix.io.crs import Points
from pcfix.io.files import check_input
from pcfix.io.labels import match_labels
from pcfix.io.ply import Records, read_header
from pcfix.io.rasters import Bounds, open_raster, place_of, read_masked
from pcfix.io.tables import number
from pcfix.model import (
    FloatArray,
    IntArray,
    WaterDimension,
    WaterMesh,
    WaterPlane,
    WaterRaster,
    WaterSurface,
)
from pcfix.options.declare import File

if TYPE_CHECKING:
    from pyproj import CRS
    from rasterio.io import DatasetReader
    from rasterio.transform import Affine

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
    spec: float | File, cloud_crs: str | CRS | None = None, bounds: Bounds | None = None
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
        sentence = f"{100.0 * share:.0f} % of the mesh is above another part. Export one surface."
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
    vertices, faces = (Records(path, read_header(path, one)) for one in ("vertex", "face"))
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


MARGIN_M = 100.0
"""Beyond the cloud: piercing points are at most about so far from their points."""
IMPOSSIBLE_M = 9000.0
"""No water surface is so far from zero; a height beyond it is a nodata value that is not stated."""
_UNITS_M = {
    "": None, "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0,
    "cm": 0.01, "mm": 0.001, "ft": 0.3048, "foot": 0.3048, "feet": 0.3048,
    "us-ft": 1200.0 / 3937.0, "ftus": 1200.0 / 3937.0, "us survey foot": 1200.0 / 3937.0,
}  # fmt: skip
MOST_CELLS = 50_000_000
ROUGH_DEG = 3.0
"""A slope by noise alone that moves a point by more than one percent of its depth."""
_EDGE_POINTS = 33
_AT_ONCE = 1_000_000


def read_water_raster(
    path: File, cloud_crs: str | CRS | None = None, bounds: Bounds | None = None
) -> WaterRaster:
    """Read the heights of the water, in the cloud's CRS and metres; warn of what is assumed.

    Parameters
    ----------
    path : path
        A raster of any format that GDAL reads.
    cloud_crs : str, CRS or None
        Projected, in metres. If the raster or the cloud names no CRS, that of the other is
        assumed.
    bounds : tuple of 4 float, optional
        West, south, east and north end of the cloud, metres: only this part, and `MARGIN_M`
        around it, is read. Default, and if one is not finite: the whole raster.
    """
    if bounds is not None:
        west, south, east, north = bounds
        wider = west - MARGIN_M, south - MARGIN_M, east + MARGIN_M, north + MARGIN_M
        bounds = wider if np.isfinite(bounds).all() else None
    name = str(path)
    with open_raster(path) as source:
        if source.count != 1:
            sentence = f"has {source.count} bands. Write the height of the water as one band."
            raise bad_file(name, "water.raster_bands", sentence, value=source.count)
        t, size = source.transform, np.array([source.width, source.height])
        if t.is_identity or not np.isfinite(t).all() or not abs(t.determinant) > 0.0:
            sentence = "has no valid geotransform. Export it as GeoTIFF, or with a world file."
            raise bad_file(name, "water.raster_place", sentence)
        crs = None if source.crs is None else systems.parse_crs(source.crs.to_wkt(), name)
        share = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (0.5, 0.5)])
        at = np.column_stack([*place_of(t, *(share * size).T), np.zeros(5)])
        to_cloud, notes = systems.way_to_cloud(crs, cloud_crs, at, name, heights=True)
        from_cloud: Points = np.asarray  # in plan
        if to_cloud is not None and crs is not None and cloud_crs is not None:
            cloud = systems.parse_crs(cloud_crs, "the cloud")
            about = to_cloud(at) if bounds is None else _edge(bounds)
            from_cloud, _ = systems.transformation(cloud, crs, about, name, heights=False)
        first, last = np.zeros(2, np.int64), size
        near = at if bounds is None else from_cloud(_edge(bounds))
        if bounds is not None and np.isfinite(near).all():
            cell = np.column_stack(place_of(~t, *near[:, :2].T))
            first, last = np.clip([cell.min(axis=0) - 2, cell.max(axis=0) + 3], 0, size).astype(int)
        if (last - first).min() < 2:
            sentence = "has fewer than two rows and columns near the cloud. Check its CRS."
            raise bad_file(name, "water.raster_far", sentence)
        _check_size(float((last - first).prod()), name)
        window = Window(*first.tolist(), *(last - first).tolist())
        heights, more = _heights(source, window, crs, name)
        t = source.window_transform(window)
    # noise of the cells, against their neighbours: waves are smooth over a few cells
    around = (heights[:-2, 1:-1] + heights[2:, 1:-1] + heights[1:-1, :-2] + heights[1:-1, 2:]) / 4
    noise = np.abs(heights[1:-1, 1:-1] - around)
    noise_m = 1.48 * float(np.nanmedian(noise)) if np.isfinite(noise).any() else 0.0
    slope_deg = math.degrees(math.atan(noise_m / math.sqrt(abs(t.determinant))))
    if slope_deg > ROUGH_DEG:
        sentence = f"{name}: the water surface is rough ({noise_m:.2f} m, slopes of {slope_deg:.0f}"
        sentence += " degrees). Smooth it, or fit a level to it."
        more.append(PcfixWarning("water.rough", sentence, noise_m=noise_m))
    for note in (*notes, *more):
        warnings.warn(note, stacklevel=3)
    left, top, cell_m = float(t.c), float(t.f), (float(t.a), float(-t.e))
    is_grid = to_cloud is None and t.b == t.d == 0.0 < min(cell_m)  # north-up, in the cloud's CRS
    if not is_grid and np.isfinite(heights).any():
        if to_cloud is not None and crs is not None:
            heights /= systems.metres_up(crs)
        ways = to_cloud or np.asarray, from_cloud
        heights, left, top, cell_m = _resampled(heights, t, *ways, bounds, name)
    if not np.isfinite(heights).any():
        sentence = "has no height near the cloud. Check its CRS and its nodata value."
        raise bad_file(name, "water.raster_empty", sentence)
    return WaterRaster(heights, left, top, cell_m, name.replace("\\", "/").rpartition("/")[2])


def _edge(bounds: Bounds) -> FloatArray:
    """Return points along bounds, z = 0."""
    west, south, east, north = bounds
    longest = max(east - west, north - south, 1.0) / _EDGE_POINTS
    xy = shapely.get_coordinates(shapely.segmentize(shapely.box(*bounds), longest))
    return np.column_stack([xy, np.zeros(len(xy))])


def _check_size(cells: float, name: str) -> None:
    if not 0.0 < cells <= MOST_CELLS:  # more than memory should hold
        sentence = f"has {cells:,.0f} cells, {MOST_CELLS:,} at most. Resample it to coarser cells."
        raise bad_file(name, "water.raster_size", sentence, cells=cells)


def _heights(
    source: DatasetReader, window: Window, crs: CRS | None, name: str
) -> tuple[FloatArray, list[PcfixWarning]]:
    """Read part of a raster, metres, NaN for no height; also return notes on what is assumed."""
    # one unit of the heights is that of the band, else that of the CRS
    unit, notes = (source.units[0] or "").strip(), list[PcfixWarning]()
    if unit.lower() not in _UNITS_M:
        sentence = f"its heights are in '{unit}'. Convert them to metres, or correct the unit."
        raise bad_file(name, "water.raster_unit", sentence, value=unit)
    unit_m = _UNITS_M[unit.lower()]
    if unit_m is None and crs is not None and not systems.is_local(crs):
        unit_m = systems.metres_up(crs)
        if unit_m != 1.0 and systems.parts(crs)[1] is None:
            sentence = f"{name}: has no unit of heights; that of its CRS is assumed"
            sentence += f" ({unit_m:.4f} m)."
            notes.append(PcfixWarning("water.raster_unit", sentence, unit_m=unit_m))
    stored = read_masked(source, window=window)
    heights = (stored * source.scales[0] + source.offsets[0]) * (unit_m or 1.0)
    if source.nodata is None:
        heights[np.abs(heights) > IMPOSSIBLE_M] = np.nan
    heights[np.isinf(heights)] = np.nan
    unknown = int(np.isnan(heights).sum())
    if source.nodata is None and unknown:
        sentence = f"{name}: has no nodata value. {unknown:,} impossible heights are ignored."
        notes.insert(0, PcfixWarning("water.raster_nodata", sentence, count=unknown))
    return heights, notes


def _resampled(
    given: FloatArray, transform: Affine, to_cloud: Points, from_cloud: Points,
    bounds: Bounds | None, name: str,
) -> tuple[FloatArray, float, float, tuple[float, float]]:  # fmt: skip
    """Resample heights to square cells in the cloud's CRS, as small as the raster's smallest.

    The heights have the unit of `to_cloud`; `from_cloud` transforms the plan only; `bounds` are in
    the cloud's CRS. Return heights in metres, left, top and size of the cells.
    """
    from scipy.ndimage import map_coordinates  # slow to import

    # where the raster is, from points all over it, and the sides of its middle cell
    high, wide = given.shape
    share = np.linspace(0.0, 1.0, _EDGE_POINTS)
    c, r = (grid.ravel() for grid in np.meshgrid(share * wide, share * high))
    amid = wide / 2.0 + np.array([0.0, 1.0, 0.0]), high / 2.0 + np.array([0.0, 0.0, 1.0])
    x, y = place_of(transform, np.append(c, amid[0]), np.append(r, amid[1]))
    placed = to_cloud(np.column_stack([x, y, np.full(len(x), np.nanmean(given))]))
    if not np.isfinite(placed).all():
        sentence = "extends beyond the area of use of the cloud's CRS. Clip it."
        raise bad_file(name, "water.raster_place", sentence)
    cell = float(np.hypot(*(placed[-2:] - placed[-3])[:, :2].T).min())
    (west, south, _), (east, north, _) = placed.min(axis=0), placed.max(axis=0)
    if bounds is not None:
        west, south = max(west, bounds[0]), max(south, bounds[1])
        east, north = min(east, bounds[2]), min(north, bounds[3])
    left, top = float(np.floor(west / cell) * cell), float(np.ceil(north / cell) * cell)
    sides = np.maximum(np.ceil([(east - left) / cell, (top - south) / cell]), 2.0)
    _check_size(float(sides.prod()), name)
    columns, rows = sides.astype(np.int64).tolist()
    heights = np.empty((rows, columns))
    x, at_once = left + (np.arange(columns) + 0.5) * cell, max(1, _AT_ONCE // columns)
    for first in range(0, rows, at_once):
        strip = heights[first : first + at_once]
        y, zero = top - (first + np.arange(len(strip)) + 0.5) * cell, np.zeros(strip.size)
        places = from_cloud(np.column_stack([np.tile(x, len(y)), np.repeat(y, columns), zero]))
        column, row = place_of(~transform, places[:, 0], places[:, 1])
        # bilinear between the centres of cells; unknown beside an unknown cell
        height = map_coordinates(given, [row - 0.5, column - 0.5], order=1, cval=np.nan)
        known = np.isfinite(height)
        height[known] = to_cloud(np.column_stack([places[known, :2], height[known]]))[:, 2]
        height[~np.isfinite(height)] = np.nan
        strip[:] = height.reshape(strip.shape)
    return heights, left, top, (cell, cell)


def rasters_of_images(
    folder: File, names: Sequence[str]
) -> tuple[dict[int, Path], tuple[str, ...]]:
    """Find the rasters of the water that have the names of images, by the rows of these.

    The notes are on images without one.
    """
    files = sorted(Path(folder).glob("*.tif"))
    row, unclear = match_labels(names, [one.stem for one in files])
    if unclear:
        sentence = f"its raster for {unclear[0]} matches several images. Give images unique names."
        raise bad_file(folder, "water.image_ambiguous", sentence, image=unclear[0])
    found = {image: files[at] for image, at in enumerate(row.tolist()) if at >= 0}
    if not found:
        sentence = f"has no raster named after an image, such as {Path(names[0]).stem}.tif."
        raise bad_file(folder, "water.no_image_rasters", sentence)
    lost = len(names) - len(found)
    return found, (f"{lost} images have no water raster in {folder}.",) * (lost > 0)


def write_water_raster(path: Path, water: WaterRaster, crs: str | None) -> None:
    """Write a water surface as a GeoTIFF of one band, float64, which `read_water_raster` reads."""
    import rasterio
    from rasterio.transform import from_origin

    rows, columns = water.height_m.shape
    parsed = None if crs is None else systems.parse_crs(crs, "cameras")
    is_tied = parsed is not None and not systems.is_local(parsed)
    profile = {
        "driver": "GTiff", "width": columns, "height": rows, "count": 1, "dtype": "float64",
        "nodata": np.nan, "compress": "deflate", "predictor": 3,
        "crs": rasterio.CRS.from_wkt(parsed.to_wkt()) if parsed and is_tied else None,
        "transform": from_origin(water.left_m, water.top_m, *water.cell_m),
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as target:
        target.write(water.height_m, 1)

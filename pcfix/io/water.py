"""Read the water surface: a level, a plane, a dimension, a mesh or a raster, and tide tables.

Meshes are read here, not by open3d: it returns OBJ coordinates as 32-bit floats, half a metre
apart at a northing of five million, and a damaged PLY ends the process.

A raster is north-up, in the cloud's own CRS, and used cell by cell.
"""

import math
import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import GeometryError, SettingError, bad_file, warn
from pcfix.io import crs as systems
from pcfix.io.files import check_input
from pcfix.io.photographs import Times, parse_times
from pcfix.io.ply import positions, read_columns, read_header
from pcfix.io.rasters import IMPOSSIBLE_M, open_raster, place_of, read_masked
from pcfix.io.tables import METRES, match_labels, number, read_table
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


KINDS = (
    "a level such as 0.37, plane:a,b,c, dim:NAME, a mesh (.obj, .ply) or a raster of heights (.tif)"
)
_CORNERS = "vertex_indices", "vertex_index"


def read_water(spec: float | File, cloud_crs: "str | CRS | None" = None) -> WaterSurface:
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
            or another raster that GDAL reads: one band of heights, in the cloud's CRS.
    cloud_crs : str or CRS, optional
        Projected, metres. Default: that of the raster.

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
    # GDAL would try some of these as rasters all the same
    if suffix in (".csv", ".txt", ".json", ".geojson", ".gpkg", ".shp", ".las", ".laz"):
        raise bad_file(text, "water.format", f"is not a water surface. Give {KINDS}.")
    return read_water_raster(text, cloud_crs)


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
    except GeometryError as error:  # no facet has an area in plan
        raise bad_file(path, "water.mesh_flat", str(error)) from None
    # holes, edges of three facets and facets that overlap at one height do not matter
    double, area_m2 = in_two_sheets(tin)
    share = float(area_m2[double].sum() / area_m2.sum())
    if share > 0.01:  # the triangulation of a shoreline may fold at its rim by less
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
                if max(map(abs, rows), default=0) > 2**31:
                    raise ValueError(f"there is no vertex {max(rows, key=abs)}")
                corners = [row - 1 if row > 0 else len(vertices) + row for row in rows]
                triangles += [[corners[0], *corners[i : i + 2]] for i in range(1, len(corners) - 1)]
        except ValueError as error:
            sentence = f"line {at} is not an OBJ line ({error})."
            raise bad_file(path, "water.mesh_damaged", sentence, line=at) from error
    return np.array(vertices).reshape(-1, 3), np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _read_ply(path: Path) -> tuple[FloatArray, IntArray]:
    """Return vertices and triangles as `_read_obj` does."""
    vertex, face = (read_header(path, one) for one in ("vertex", "face"))
    corners = next((name for name in _CORNERS if face.has(name, lists=True)), "")
    if not corners or not vertex.has(*"xyz"):
        sentence = f"needs vertices with x, y, z and faces with {_CORNERS[0]}. Export a mesh."
        raise bad_file(path, "water.mesh_damaged", sentence)
    start, corner = read_columns(path, face, corners)[corners]
    count = np.maximum(np.diff(start) - 2, 0)
    first = np.repeat(start[:-1], count)
    other = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
    rows = np.column_stack([first, other, other + 1])
    return positions(path, vertex), corner.astype(np.int64)[rows]


MOST_CELLS = 10_000_000  # cells that are read, for the memory


def read_water_raster(path: File, cloud_crs: "str | CRS | None" = None) -> WaterRaster:
    """Read heights of the water, metres, from any raster that GDAL reads; warn of what is assumed.

    It is north-up in the cloud's CRS, which is projected, in metres. If either names no CRS, that
    of the other is assumed.
    """
    name = str(path)
    with open_raster(path) as source:
        if source.count != 1:
            sentence = f"has {source.count} bands. Write the height of the water as one band."
            raise bad_file(name, "water.raster_bands", sentence, value=source.count)
        t, size = source.transform, (source.width, source.height)
        if t.is_identity or not np.isfinite(t).all():
            sentence = "has no valid geotransform. Export it as GeoTIFF, or with a world file."
            raise bad_file(name, "water.raster_place", sentence)
        if min(size) < 2 or size[0] * size[1] > MOST_CELLS:
            sentence = f"has {size[0]:,} x {size[1]:,} cells, {MOST_CELLS:,} at most. Cut it to the"
            sentence += " cloud, or make the cells larger."
            raise bad_file(name, "water.raster_size", sentence, cells=size[0] * size[1])
        crs = None if source.crs is None else systems.parse_crs(source.crs.to_wkt(), name)
        heights = _heights(source, crs, name)
        middle = np.array([[*place_of(t, size[0] / 2, size[1] / 2), 0.0]])
        to_cloud = systems.to_cloud_crs(crs, cloud_crs, middle, name, heights=True)
        if to_cloud is not systems.unchanged or not (t.b == t.d == 0.0 and t.a > 0.0 > t.e):
            sentence = "is turned, or in another CRS than the cloud. Reproject it with 'gdalwarp"
            raise bad_file(name, "water.raster_place", f"{sentence} -t_srs CRS_OF_THE_CLOUD'.")
    if not np.isfinite(heights).any():
        raise bad_file(name, "water.raster_empty", "has no height. Check its nodata value.")
    # noise of the cells, against their neighbours: waves are smooth over a few cells
    around = (heights[:-2, 1:-1] + heights[2:, 1:-1] + heights[1:-1, :-2] + heights[1:-1, 2:]) / 4
    noise = np.abs(heights[1:-1, 1:-1] - around)
    noise_m = 1.48 * float(np.nanmedian(noise)) if np.isfinite(noise).any() else 0.0
    slope_deg = math.degrees(math.atan(noise_m / math.sqrt(abs(t.determinant))))
    if slope_deg > 3.0:  # by noise alone, a point moves by more than one percent of its depth
        sentence = f"the water surface is rough ({noise_m:.2f} m, slopes of {slope_deg:.0f}"
        sentence += " degrees). Smooth it, or fit a level to it."
        warn(name, "water.rough", sentence, noise_m=noise_m)
    short = name.replace("\\", "/").rpartition("/")[2]
    return WaterRaster(heights, float(t.c), float(t.f), (float(t.a), float(-t.e)), short)


def _heights(source: "DatasetReader", crs: "CRS | None", name: str) -> FloatArray:
    """Read a raster, metres, NaN for no height; warn of impossible ones."""
    unit = (source.units[0] or "").strip()
    # the unit of heights is that of the band, else that of the CRS
    own_m = 1.0 if unit or crs is None or systems.is_local(crs) else systems.metres_up(crs)
    if unit.lower() not in METRES or own_m != 1.0:
        stated = unit or f"the unit of {'' if crs is None else crs.name}"
        sentence = f"its heights are in {stated}. Convert them to metres."
        raise bad_file(name, "water.raster_unit", sentence, value=unit)
    heights = read_masked(source)
    if source.nodata is None:
        heights[~(np.abs(heights) <= IMPOSSIBLE_M)] = np.nan
        unknown = int(np.isnan(heights).sum())
        if unknown:
            sentence = f"has no nodata value. {unknown:,} impossible heights are ignored."
            warn(name, "water.raster_nodata", sentence, count=unknown)
    heights[np.isinf(heights)] = np.nan
    return heights


def rasters_of_images(folder: File, names: Sequence[str]) -> dict[int, Path]:
    """Find the rasters of the water that have the names of images, by the rows of these."""
    files = sorted(Path(folder).glob("*.tif"))
    row, unclear = match_labels(names, [one.stem for one in files])
    if unclear:
        sentence = f"its raster for {unclear[0]} matches several images. Give images unique names."
        raise bad_file(folder, "water.image_ambiguous", sentence, image=unclear[0])
    found = {image: files[at] for image, at in enumerate(row.tolist()) if at >= 0}
    if not found:
        sentence = f"has no raster named after an image, such as {Path(names[0]).stem}.tif."
        raise bad_file(folder, "water.no_image_rasters", sentence)
    if lost := len(names) - len(found):
        warn(folder, "water.images_missing", f"{lost} images have no water raster in it.")
    return found


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


def read_tide(path: File) -> tuple[Times, FloatArray]:
    """Read a table of increasing ``time`` (ISO 8601) and ``level_m``, above any datum."""
    source = check_input(path)
    table = read_table(source, ("time", "level_m"))
    level = table.of(("level_m",))[:, 0]
    times = parse_times(source, [f"line {line}" for line in table.line], table.column("time"))
    late = np.flatnonzero(np.diff(times.time_s) <= 0.0)
    if late.size:
        line = table.line[late[0] + 1]
        sentence = f"line {line}: the time is not later than the one before. Sort the rows by time."
        raise bad_file(source, "tide.order", sentence, line=line)
    if len(level) < 2:
        raise bad_file(source, "tide.one_row", "has one row. Give at least two.")
    return times, level


def level_offsets(
    tide: Times, level_m: FloatArray, times: Times, labels: Sequence[str]
) -> FloatArray:
    """Return how much higher than on average the water was at each of k images, metres.

    The level is linear between the rows of the table. The average over the images is the level that
    the user gives.
    """
    clock = tide.time_s
    if tide.zoned != times.zoned:
        without = times if tide.zoned else tide
        sentence = "its times have no zone, those of the other file have. Add +02:00, or Z for UTC."
        raise bad_file(without.name, "time.zone", sentence)
    outside = np.flatnonzero((times.time_s < clock[0]) | (times.time_s > clock[-1]))
    if outside.size:
        image, at = labels[outside[0]], float(times.time_s[outside[0]])
        taken = datetime.fromtimestamp(at, UTC).strftime("%Y-%m-%d %H:%M:%S")
        sentence = f"does not cover image {image}, taken at {taken} ({outside.size} of"
        sentence += f" {len(labels)} images are outside). Add rows, or check the zones."
        values = {"image": image, "count": int(outside.size)}
        raise bad_file(tide.name, "tide.not_covered", sentence, **values)
    level = np.interp(times.time_s, clock, level_m)
    row = np.clip(np.searchsorted(clock, times.time_s) - 1, 0, len(clock) - 2)
    hours = float(np.diff(clock)[row].max()) / 3600.0
    # Half a tide lasts 6.2 h; with an amplitude A of 2 m the chord over one hour is up to
    # A (2 pi 1 h / 12.4 h)^2 / 8 = 6 cm off, that over two hours 26 cm
    if hours > 1.0:
        sentence = f"its rows are up to {hours:.1f} h apart; give one each hour."
        warn(tide.name, "tide.sparse", sentence, hours=hours)
    return np.asarray(level - level.mean())

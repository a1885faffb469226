"""Read shorelines and water masks from vector files and tables; write layers as a GeoPackage."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import shapely

from pcfix.errors import bad_file, optional_library, warn
from pcfix.io import tables
from pcfix.io.crs import parse_crs, plan_unit, to_cloud_crs, unchanged
from pcfix.io.files import cannot_write, check_input, check_output, temporary_output
from pcfix.model import FloatArray
from pcfix.options.declare import File

if TYPE_CHECKING:
    from pyproj import CRS

Geometries = npt.NDArray[Any]
load_pyogrio = partial(optional_library, "pyogrio", "vector", "Read and write vector files")

TABLES = (".csv", ".txt")
GDAL_SUFFIXES = (".gpkg", ".shp", ".geojson", ".json", ".kml", ".gpx")
KINDS = "GeoPackage (.gpkg), Shapefile (.shp), GeoJSON, KML, GPX or a table of points (.csv)"
LAYER_MARK = "|"
WGS84 = "EPSG:4326"
SPACING_M = 1.0  # along lines without heights, which get these from the cloud
SHORE_RADIUS_M = 1.0  # about shoreline points without a height, which get it from the cloud


@dataclass(frozen=True, eq=False)
class Vectors:
    """The n shapely geometries of one layer, none missing or empty; x is east or longitude.

    `crs` is a text that pyproj understands, None if the file names none; `name` is that of the file
    and its layer.
    """

    geometries: Geometries
    crs: str | None
    name: str

    @cached_property
    def coordinates(self) -> FloatArray:
        """All vertices, shape (n, 3); z is NaN where a geometry has none."""
        return np.asarray(shapely.get_coordinates(self.geometries, include_z=True), np.float64)


def is_vector_file(path: File) -> bool:
    """Whether the name of a file, with or without a layer, is one that `read_vectors` reads."""
    file = str(path).partition(LAYER_MARK)[0]
    return Path(file).suffix.lower() in (*GDAL_SUFFIXES, *TABLES)


def read_vectors(path: File, *, crs: str | None = None) -> Vectors:
    """Read one layer of a vector file, in its own CRS; `crs` replaces the one that it states.

    The file is a GeoPackage, Shapefile, GeoJSON, KML, GPX or a table (``.csv``, ``.txt``) with the
    columns x, y and perhaps z, or easting, northing, height, or longitude, latitude, height. If it
    has several layers, one follows its path, as QGIS writes it: ``river.gpkg|layername=shore``. The
    CRS ``local`` is the cloud's.
    """
    file, _, layer = str(path).partition(LAYER_MARK)
    source = check_input(file)
    suffix, name = source.suffix.lower(), str(source)
    if suffix in TABLES:
        geometries, found = _read_points(source)
    elif suffix in GDAL_SUFFIXES:
        geometries, found, name = _read_gdal(source, layer.removeprefix("layername="))
    else:
        raise bad_file(source, "vector.format", f"is not a vector file. Give {KINDS}.")
    gone = shapely.is_missing(geometries) | shapely.is_empty(geometries)
    xy, at = shapely.get_coordinates(geometries, return_index=True)
    gone[at[~np.isfinite(xy).all(axis=1)]] = True
    if gone.all():
        raise bad_file(name, "vector.empty", "holds no geometry with coordinates.")
    vectors = Vectors(geometries[~gone], crs or found, name)  # without empty features
    stated = None if vectors.crs is None else parse_crs(vectors.crs, name)
    beyond = (np.abs(vectors.coordinates[:, :2]) > [360.0, 90.0]).any(axis=1)
    if beyond.any() and stated and stated.is_geographic and plan_unit(stated)[0] == "degree":
        x, y = vectors.coordinates[int(np.argmax(beyond)), :2]
        sentence = f"{x:.10g}, {y:.10g} is not in degrees, as {stated.name} is. Give its CRS."
        raise bad_file(name, "vector.not_degrees", sentence, crs=stated.name)
    return vectors


def in_cloud_crs(vectors: Vectors, cloud_crs: "str | CRS | None", *, heights: bool) -> Vectors:
    """Transform geometries to the cloud's CRS; see `to_cloud_crs`. Without `heights` z stays."""
    at = vectors.coordinates
    heights = heights and bool(np.isfinite(at[:, 2]).any())
    at = np.nan_to_num(at)
    forward = to_cloud_crs(vectors.crs, cloud_crs, at, vectors.name, heights=heights)
    if forward is unchanged:
        return vectors
    geometries = vectors.geometries

    def move(xyz: FloatArray) -> FloatArray:
        there = forward(np.nan_to_num(xyz))
        there[np.isnan(xyz[:, 2]), 2] = np.nan
        return there

    there = shapely.transform(geometries, move, include_z=True)
    there = np.where(shapely.has_z(geometries), there, shapely.force_2d(there))
    moved = replace(vectors, geometries=there)
    if not np.isfinite(moved.coordinates[:, :2]).all():
        sentence = "part of it cannot be transformed to the cloud's CRS. Check the file's CRS."
        raise bad_file(vectors.name, "vector.outside_crs", sentence)
    return moved


def _read_gdal(path: Path, layer: str) -> tuple[Geometries, str | None, str]:
    """Return geometries (None for a missing one), CRS and name."""
    pyogrio, suffix = load_pyogrio(), path.suffix.lower()
    try:
        names = [str(name) for name, kind in pyogrio.list_layers(path) if kind is not None]
        if suffix == ".gpx":  # it always has the layers of waypoints, routes and tracks
            count = partial(pyogrio.read_info, path, force_feature_count=True)
            names = [one for one in names if count(layer=one)["features"]]
        layer = layer or (names[0] if len(names) == 1 else "")
        if layer in names:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # M values, which are not needed, are lost
                meta, _, wkb, _ = pyogrio.raw.read(path, layer=layer, columns=[])
            geometries = shapely.from_wkb(wkb)
    # pyogrio raises a NameError where a CRS is not text
    except (RuntimeError, ValueError, NameError, shapely.errors.ShapelyError) as error:
        first = str(error).split(";")[0].strip().rstrip(".")
        raise bad_file(path, "vector.damaged", f"cannot be read ({first}).") from error
    if layer not in names:
        sentence = f"has the layers {', '.join(names)}. Name one: {path.name}|layername=NAME."
        raise bad_file(path, "vector.layer", sentence, layer=layer or None, layers=names)
    name = str(path) if layer == path.stem else f"{path}, layer {layer}"
    crs = meta["crs"]
    if suffix in (".geojson", ".json") and crs == WGS84 and shapely.has_z(geometries).any():
        crs = "EPSG:4979"  # with heights above the ellipsoid
    return geometries, crs, name


def _read_points(path: Path) -> tuple[Geometries, str | None]:
    """Return the points of a table, and the CRS that it names; without a height a point is flat.

    A comment ``# crs: EPSG:25830`` above the header names it; for longitude and latitude it is
    WGS 84.
    """
    kinds = ("x", "y"), ("longitude", "latitude")
    names = tables.POINT_SPELLINGS  # of a shoreline, a level is its height
    names = names | {"z": (*names["z"], "level")}
    table = tables.read_table(path, *kinds, spellings=names)
    in_map = table.has("x", "y")
    axes = kinds[0 if in_map else 1]
    # degrees of x and y are those of the CRS
    table = replace(table, unit=["" if u in tables.DEGREES else u for u in table.unit])
    xyz = np.column_stack([table.of(axes), table.where_there(("z",))])
    points = np.asarray(shapely.points(xyz))
    geometries = np.where(np.isfinite(xyz[:, 2]), points, shapely.force_2d(points))
    return geometries, table.crs or (None if in_map else WGS84)


class Shoreline(NamedTuple):
    """Points on the edge of the water, shape (n, 3): metres, the cloud's CRS, z NaN if unknown.

    `counts`, shape (n,), is how many independent observations each point is worth: one that was
    measured or digitised 1, those between the vertices of a digitised line less.
    """

    xyz: FloatArray
    name: str
    counts: FloatArray


def read_shoreline(
    path: File, cloud_crs: "str | CRS | None" = None, *, crs: str | None = None
) -> Shoreline:
    """Read shoreline points, from points, lines and rings of polygons, holes included.

    A line with heights gives its vertices, which were measured; points between them were not, and
    would make the fit look better than it is. A line without heights gives a point at least every
    `SPACING_M`, as each gets a height from the cloud. For the arguments see `read_vectors` and
    `in_cloud_crs`.

    A digitised line is off at each vertex by some amount, and between two vertices by an
    interpolation of their errors. Straight interpolation between independent errors has two thirds
    of their variance, so a line of v vertices is worth 2 v / 3 points that scatter like those on
    it, however many points it is divided into. Nor are points worth more if they are so dense that
    neighbours get their heights from the same part of the cloud.
    """
    vectors = in_cloud_crs(read_vectors(path, crs=crs), cloud_crs, heights=True)
    parts = _single_parts(vectors.geometries)
    kind, kinds = shapely.get_type_id(parts), shapely.GeometryType
    points = parts[kind == kinds.POINT]
    lines = parts[(kind == kinds.LINESTRING) | (kind == kinds.LINEARRING)]
    lines = np.concatenate([lines, shapely.get_rings(parts[kind == kinds.POLYGON])])
    measured, drawn = lines[shapely.has_z(lines)], lines[~shapely.has_z(lines)]
    count = float(shapely.length(drawn).sum()) / SPACING_M
    if count > 1_000_000:
        sentence = f"would give {count:.3g} points. Check its CRS and unit, or thin it out."
        raise bad_file(vectors.name, "water.shoreline_too_long", sentence, count=count)
    found = [_vertices(np.concatenate([points, measured]))]
    counts = [np.ones(len(found[0]))]
    for line in drawn:
        found.append(_vertices(np.array([shapely.segmentize(line, SPACING_M)])))
        total, vertices = len(found[-1]), float(len(line.coords) - line.is_closed)
        independent = max(line.length / (2.0 * SHORE_RADIUS_M), 1.0)
        worth = 2.0 / 3.0 * vertices if vertices < total else vertices
        counts.append(np.full(total, min(1.0, min(worth, independent) / total)))
    xyz = np.vstack(found)
    known = xyz[np.isfinite(xyz[:, 2]), 2]
    if len(known) >= 3 and not known.any():  # a flat drawing
        xyz[:, 2] = np.nan
        sentence = f"all {len(known)} heights are exactly 0; they are ignored."
        warn(vectors.name, "water.zero_heights", sentence, count=len(known))
    return Shoreline(xyz, vectors.name, np.concatenate(counts))


def _single_parts(geometries: Geometries) -> Geometries:
    """Return the parts of multi-part geometries and collections, however deep."""
    while (shapely.get_type_id(geometries) > shapely.GeometryType.POLYGON).any():
        geometries = shapely.get_parts(geometries)
    return geometries


def _vertices(geometries: Geometries) -> FloatArray:
    """Return vertices (n, 3), without the last of a closed line, which repeats the first."""
    xyz, at = shapely.get_coordinates(geometries, include_z=True, return_index=True)
    last = np.flatnonzero(np.diff(at, append=-1) != 0)
    again = last[shapely.is_closed(geometries)[at[last]]] if len(last) else last
    return np.asarray(np.delete(xyz, again, axis=0), np.float64)


def read_water_polygons(path: File, cloud_crs: "str | CRS | None" = None) -> Vectors:
    """Read the polygons inside which points may be submerged, as one valid geometry.

    Its holes are dry.
    """
    vectors = in_cloud_crs(read_vectors(path), cloud_crs, heights=False)
    parts = shapely.force_2d(_single_parts(vectors.geometries))
    polygons = parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON]
    crossed = ~shapely.is_valid(polygons)
    if crossed.any():
        repaired = shapely.make_valid(polygons[crossed], method="structure", keep_collapsed=False)
        polygons[crossed] = repaired
        count, area_m2 = len(repaired), float(shapely.area(repaired).sum())
        sentence = f"{count} of {len(polygons)} polygons crossed themselves. Repaired, they cover"
        sentence += f" {area_m2:.1f} m2."
        warn(vectors.name, "mask.repaired", sentence, count=count, area_m2=area_m2)
    area = shapely.union_all(polygons)
    if not area.area > 0.0:
        kinds = sorted({geometry.geom_type for geometry in vectors.geometries})
        sentence = f"holds no polygon with an area ({', '.join(kinds)}). A mask needs polygons."
        raise bad_file(vectors.name, "mask.no_area", sentence, kinds=kinds)
    return replace(vectors, geometries=np.array([area]))


class Layer(NamedTuple):
    """Geometries of one kind (LineString, Point Z ...), by name a value of each, and a style (QML).

    A layer may be empty.
    """

    name: str
    kind: str
    geometries: Sequence[Any]
    values: dict[str, Any]
    style: str = ""


def write_layers(
    path: File, layers: Sequence[Layer], crs: "CRS | str | None", *, overwrite: bool
) -> None:
    """Write layers in a CRS as one GeoPackage, with their styles as QGIS stores them."""
    write, target = load_pyogrio().raw.write, check_output(path, overwrite=overwrite)
    wkt = None if crs is None else parse_crs(crs, "the cloud").to_wkt()
    styled = [one for one in layers if one.style]
    names, styles = [one.name for one in styled], [one.style for one in styled]
    texts = {
        "f_table_catalog": "", "f_table_schema": "", "f_geometry_column": "geom",
        "f_table_name": names, "styleName": names, "styleQML": styles, "styleSLD": "",
        "description": "pcfix", "owner": "",
    }  # fmt: skip
    columns = {name: np.full(len(styled), value, object) for name, value in texts.items()}
    columns["useAsDefault"] = np.ones(len(styled), bool)
    columns["update_time"] = np.full(len(styled), "2020-01-01", "datetime64[ms]")
    with temporary_output(target) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a cloud may have no CRS
        try:
            for number, one in enumerate(layers):
                # with None, which is removed again, the array is one of objects, even if empty
                geometry = shapely.to_wkb(np.array([*one.geometries, None], object)[:-1])
                write(
                    temporary, geometry, [np.asarray(v) for v in one.values.values()],
                    list(one.values), layer=one.name, crs=wkt, driver="GPKG",
                    geometry_type=one.kind, append=number > 0,
                )  # fmt: skip
            if styled:
                # the table in which QGIS looks for styles, and keeps its own
                write(
                    temporary, None, [*columns.values()], [*columns], layer="layer_styles",
                    driver="GPKG", append=True, crs=None, geometry_type=None,
                )  # fmt: skip
        except RuntimeError as error:
            raise cannot_write(target, error, temporary) from error

"""Points, lines and polygons from vector files and tables: shorelines, and where water is."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import shapely

from pcfix.errors import InputError, SettingError
from pcfix.io.crs import parse_crs
from pcfix.io.files import check_input
from pcfix.io.tables import Table, read_lines, split_header, table_below
from pcfix.io.transformations import LOCAL, way_to_cloud
from pcfix.libraries import installing
from pcfix.model import FloatArray
from pcfix.options.declare import File

if TYPE_CHECKING:
    from pyproj import CRS


TEXT_SUFFIXES = (".wkt", ".csv", ".txt")
COLUMNS = {
    "x": ("x", "easting", "east", "e", "x_m", "easting_m"),
    "y": ("y", "northing", "north", "n", "y_m", "northing_m"),
    "longitude": ("longitude", "lon", "long", "lng"),
    "latitude": ("latitude", "lat"),
    "z": (
        *("z", "height", "h", "altitude", "alt", "elevation", "elev", "level"),
        *("z_m", "height_m", "altitude_m", "elevation_m", "level_m"),
    ),
    "wkt": ("wkt", "geometry", "geom", "wkt_geom"),
}
"""What a column is, and its names; the first that is there counts."""
_UNIT = re.compile(r"\s*[\[(]\s*(m|metres?|meters?|deg|degrees?|°)\s*[\])]$")
_WKT = re.compile(
    r"\s*(SRID\s*=\s*\d+\s*;)?\s*((MULTI)?(POINT|LINESTRING|POLYGON)|LINEARRING|GEOMETRYCOLLECTION)"
    r"\s*(ZM|Z|M)?\s*(\(|EMPTY)",
    re.IGNORECASE,
)
_NO_HEIGHT = ("", "nan", "na", "null", "none")
_SRID = re.compile(r"\s*SRID\s*=\s*(\d+)\s*;", re.IGNORECASE)
_CRS = re.compile(r"#\s*crs\s*[:=]\s*(.+)$", re.IGNORECASE)

GDAL_SUFFIXES = (".gpkg", ".shp", ".geojson", ".json")
KINDS = "GeoPackage (.gpkg), Shapefile (.shp), GeoJSON (.geojson, .json), WKT (.wkt) or CSV (.csv)"
LAYER_MARK = "|"
WGS84, WGS84_3D = "EPSG:4326", "EPSG:4979"
LONGEST_EDGE_M = 500.0
"""Edges are cut so before they go into another CRS: one of 500 m is straight in both to 5 mm."""
_METRES_PER_DEGREE = 111_000.0


SPACING_M = 1.0
"""Along lines without heights, which take them from the cloud."""
SHORE_RADIUS_M = 1.0
"""About shoreline points without a height, which they take from the cloud."""
MOST_POINTS = 1_000_000
FEW = 3


@dataclass(frozen=True, eq=False)
class Vectors:
    """The n shapely geometries of one layer, none missing or empty; x is east or longitude.

    `crs` is what pyproj understands, None where the file names none; `name` is that of the file and
    its layer; `notes` say what was done on reading.
    """

    geometries: npt.NDArray[Any]
    crs: str | None
    name: str
    notes: tuple[str, ...] = ()

    @cached_property
    def coordinates(self) -> FloatArray:
        """All vertices, shape (n, 3); z is NaN where a geometry has none."""
        return np.asarray(shapely.get_coordinates(self.geometries, include_z=True), np.float64)


def is_vector_file(path: File) -> bool:
    """Whether the name of a file, with or without a layer, is one that `read_vectors` reads."""
    return Path(_split_layer(path)[0]).suffix.lower() in (*GDAL_SUFFIXES, *TEXT_SUFFIXES)


def read_vectors(path: File, *, crs: str | None = None) -> Vectors:
    """Read one layer of a vector file, in its own CRS.

    Parameters
    ----------
    path : path
        ``.gpkg``, ``.shp``, ``.geojson``, ``.json``; ``.wkt`` with one geometry a line; ``.csv``
        or ``.txt`` with the columns x, y and perhaps z, or easting, northing, height, or
        longitude, latitude, height, or wkt. A layer may follow, if there are several:
        ``river.gpkg|layername=shore``.
    crs : str, optional
        What the file's CRS is, over what it says itself. ``local``: the cloud's, whatever it says.

    Raises
    ------
    InputError
        If the file is missing, damaged, empty or of another kind, has several layers and none
        was named, or its numbers are not degrees where they should be.
    SettingError
        If the extra ``vector`` is not installed.
    """
    file, layer = _split_layer(path)
    source = check_input(file)
    suffix = source.suffix.lower()
    if suffix in TEXT_SUFFIXES:
        geometries, found = _read_text(source)
        name = str(source)
    elif suffix in GDAL_SUFFIXES:
        geometries, found, name = _read_gdal(source, layer)
    else:
        raise InputError(f"{source}: is not a vector file that pcfix reads; give {KINDS}.")
    vectors = _without_gaps(Vectors(geometries, crs or found, name))
    _check_degrees(vectors)
    return vectors


def in_cloud_crs(vectors: Vectors, cloud_crs: str | CRS | None, *, heights: bool) -> Vectors:
    """Return geometries in the cloud's CRS; see `way_to_cloud`. Without `heights` z stays.

    An `InputError` if the two CRS or their heights cannot be brought together, or a vertex has no
    place there.
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
        degrees = vectors.crs is not None and parse_crs(vectors.crs, "the file").is_geographic
        longest = LONGEST_EDGE_M / (_METRES_PER_DEGREE if degrees else 1.0)
        geometries = shapely.segmentize(geometries, longest)
    moved = replace(vectors, geometries=_moved(geometries, forward))
    if not np.isfinite(moved.coordinates[:, :2]).all():
        raise InputError(
            f"{vectors.name}: some of it has no place in the cloud's CRS; check the file's CRS."
        )
    return moved


def _moved(geometries: npt.NDArray[Any], forward: Callable[[FloatArray], FloatArray]) -> Any:
    """Return geometries with all vertices moved; those without heights stay so."""

    def move(xyz: FloatArray) -> FloatArray:
        there = forward(np.nan_to_num(xyz))
        there[np.isnan(xyz[:, 2]), 2] = np.nan
        return there

    moved = shapely.transform(geometries, move, include_z=True)
    return np.where(shapely.has_z(geometries), moved, shapely.force_2d(moved))


def _split_layer(path: File) -> tuple[str, str | None]:
    """Return the file and the layer of ``file|layername=layer``, as QGIS writes it."""
    file, _, layer = str(path).partition(LAYER_MARK)
    return file, layer.removeprefix("layername=") or None


def load_pyogrio() -> Any:
    """Return the library of vector files."""
    try:
        import pyogrio
    except ImportError as error:
        raise SettingError(
            f"Vector files need pyogrio, which is not installed; run: {installing('vector')}"
        ) from error
    return pyogrio


def _read_gdal(path: Path, layer: str | None) -> tuple[npt.NDArray[Any], str | None, str]:
    """Return geometries (None where one is missing), CRS and name."""
    pyogrio = load_pyogrio()
    try:
        layer = _layer(path, pyogrio.list_layers(path), layer)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # M values, which are not needed, are left out
            meta, _, wkb, _ = pyogrio.raw.read(path, layer=layer, columns=[])
        geometries = shapely.from_wkb(wkb)
    except (RuntimeError, ValueError, shapely.errors.ShapelyError) as error:
        first = str(error).split(";")[0].strip().rstrip(".")
        raise InputError(f"{path}: cannot be read ({first}); export it again.") from error
    name = str(path) if layer == path.stem else f"{path}, layer {layer}"
    crs = meta["crs"]
    if path.suffix.lower() in (".geojson", ".json") and crs == WGS84:
        crs = WGS84_3D if shapely.has_z(geometries).any() else WGS84
    return geometries, crs, name


def _read_text(path: Path) -> tuple[npt.NDArray[Any], str | None]:
    """Return the geometries of a text file, and the CRS that it names.

    A comment ``# crs: EPSG:25830`` above the rest names it, or ``SRID=25830;`` before a WKT;
    longitude and latitude are taken to be of WGS 84. An `InputError` if it is neither WKT nor a
    table of points, or damaged.
    """
    lines = read_lines(path)
    stated = [found.group(1).strip() for line in lines[:20] if (found := _CRS.match(line.strip()))]
    kept = [
        (i, line)
        for i, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not kept:
        raise InputError(f"{path}: is empty.")
    if _WKT.match(kept[0][1]):
        geometries, srid = _from_wkt(path, kept)
    else:
        geometries, srid = _from_table(path, lines, kept[0][0] - 1)
    return geometries, stated[0] if stated else srid


def _from_wkt(path: Path, lines: list[tuple[int, str]]) -> tuple[npt.NDArray[Any], str | None]:
    """Return the geometry of each numbered line, and the CRS that they name."""
    geometries = np.empty(len(lines), dtype=object)
    srids: set[str | None] = set()
    for row, (line, text) in enumerate(lines):
        named = _SRID.match(text)
        srids.add(f"EPSG:{named.group(1)}" if named else None)
        try:
            geometries[row] = shapely.from_wkt(_SRID.sub("", text).strip())
        except (shapely.errors.ShapelyError, ValueError) as error:
            raise InputError(
                f"{path}: line {line} is not WKT ({str(error).split(':', 1)[-1].strip()}); write"
                " one whole geometry a line."
            ) from error
    if len(srids) > 1:
        raise InputError(f"{path}: the lines name different SRIDs; write one CRS a file.")
    return geometries, srids.pop()


def _from_table(path: Path, lines: list[str], at: int) -> tuple[npt.NDArray[Any], str | None]:
    """Return the points, or the geometries, of a table whose header is ``lines[at]``."""
    names, delimiter = split_header(lines[at])
    header = [_UNIT.sub("", name) for name in names]
    table = table_below(path, lines, header, delimiter, at=at, comments=True)
    if (wkt := _column(header, "wkt")) is not None:
        numbered = list(zip(table.line, table.column(wkt), strict=True))
        return _from_wkt(path, numbered)
    for x, y, crs in (("x", "y", None), ("longitude", "latitude", "EPSG:4326")):
        plan = _column(header, x), _column(header, y)
        if plan[0] is not None and plan[1] is not None:
            return _points(table, plan[0], plan[1]), crs
    raise InputError(
        f"{path}: line {at + 1} must name the columns x and y (or easting and northing, longitude"
        f" and latitude), with z or height where there is one; it has: {', '.join(names)}."
    )


def _column(header: list[str], role: str) -> str | None:
    return next((name for name in COLUMNS[role] if name in header), None)


def _points(table: Table, x: str, y: str) -> npt.NDArray[Any]:
    """Return the points of a table; where the height of one is empty it has none."""
    plan = np.column_stack([table.numbers(x), table.numbers(y)])
    name = _column(table.header, "z")
    if name is None:
        return np.asarray(shapely.points(plan))
    z = np.array(table.numbers(name, _NO_HEIGHT))
    points = np.asarray(shapely.points(np.column_stack([plan, z])))
    return np.where(np.isfinite(z), points, shapely.force_2d(points))


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
    gone = shapely.is_missing(vectors.geometries) | shapely.is_empty(vectors.geometries)
    xy, at = shapely.get_coordinates(vectors.geometries, return_index=True)
    gone[at[~np.isfinite(xy).all(axis=1)]] = True
    if gone.all():
        raise InputError(f"{vectors.name}: holds no geometry with coordinates.")
    note = f"{vectors.name}: {int(gone.sum())} features without coordinates are left out."
    notes = (*vectors.notes, note) if gone.any() else vectors.notes
    return replace(vectors, geometries=vectors.geometries[~gone], notes=notes)


def _check_degrees(vectors: Vectors) -> None:
    """Refuse a CRS that is unknown, and degrees that are none."""
    if vectors.crs is None or vectors.crs.strip().lower() == LOCAL:
        return
    crs = parse_crs(vectors.crs, vectors.name)
    if not crs.is_geographic or crs.axis_info[0].unit_name != "degree":
        return
    x, y = vectors.coordinates[:, 0], vectors.coordinates[:, 1]
    wrong = (np.abs(x) > 360.0) | (np.abs(y) > 90.0)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise InputError(
            f"{vectors.name}: {x[i]:.10g}, {y[i]:.10g} is no longitude and latitude, but its CRS"
            f" is {crs.name} (as it is for every GeoJSON that names none); say which CRS it is in."
        )


class Shoreline(NamedTuple):
    """Points on the edge of the water, shape (n, 3): metres, the cloud's CRS, z NaN where unknown.

    `name` is the file's, for messages; `notes` are for the summary. `counts`, shape (n,), is how
    many independent observations each point is worth: one that was measured or drawn 1, those
    between the vertices of a drawn line less; see `_worth`.
    """

    xyz: FloatArray
    name: str
    notes: tuple[str, ...]
    counts: FloatArray


class WaterPolygons(NamedTuple):
    """A valid shapely (Multi)Polygon in the cloud's CRS where there is water; its holes are dry."""

    area: Any
    name: str
    notes: tuple[str, ...] = ()


def read_shoreline(
    path: File, cloud_crs: str | CRS | None = None, *, crs: str | None = None
) -> Shoreline:
    """Read shoreline points, from points, lines and rings of polygons, holes included.

    A line with heights gives its vertices, as these were measured; what lies between them was
    not, and would make the fit look better than it is. A line without heights gives a point at
    least every `SPACING_M`, as each takes a height of its own from the cloud, and says what these
    are worth. For the arguments
    and errors see `read_vectors` and `in_cloud_crs`.
    """
    vectors = in_cloud_crs(read_vectors(path, crs=crs), cloud_crs, heights=True)
    lines, points = _lines_and_points(vectors.geometries)
    level = shapely.has_z(lines)
    count = float(shapely.length(lines[~level]).sum()) / SPACING_M
    if count > MOST_POINTS:
        raise InputError(
            f"{vectors.name}: would give {count:.3g} points; check its CRS and unit, or thin it"
            " out."
        )
    drawn = lines[~level]
    dense = [shapely.segmentize(line, SPACING_M) for line in drawn]
    parts = [points, lines[level], *([one] for one in dense)]
    vertices = [_vertices(np.array(part, object)) for part in parts]
    xyz = np.vstack(vertices)
    counts = [np.ones(len(one)) for one in vertices[:2]]
    counts += [_worth(line, len(one)) for line, one in zip(drawn, vertices[2:], strict=True)]
    worth = np.concatenate(counts)
    known = xyz[np.isfinite(xyz[:, 2]), 2]
    if len(known) < FEW or known.any():
        return Shoreline(xyz, vectors.name, vectors.notes, worth)
    xyz[:, 2] = np.nan  # all exactly zero, as of a flat drawing
    note = (
        f"{vectors.name}: all {len(known)} heights are exactly 0; taken as points without heights."
    )
    return Shoreline(xyz, vectors.name, (*vectors.notes, note), worth)


def _worth(line: Any, points: int) -> FloatArray:
    """Return how many independent observations each of the points along a drawn line is worth.

    Whoever draws a line is off at each vertex by some amount, and between two by what lies between
    these: straight interpolation between independent errors has two thirds of their variance, so a
    line of v vertices says as much as 2 v / 3 points that scatter like those on it, however many
    are put on it. Nor do points say more where the vertices are so dense that neighbours take
    their heights from the same part of the cloud.
    """
    vertices = len(line.coords) - line.is_closed
    apart = max(line.length / (2.0 * SHORE_RADIUS_M), 1.0)
    drawn = 2.0 / 3.0 * vertices if vertices < points else float(vertices)
    return np.full(points, min(1.0, min(drawn, apart) / points))


def _lines_and_points(geometries: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the lines and rings, and the points, that geometries consist of."""
    parts = _simple(geometries)
    kind = shapely.get_type_id(parts)
    kinds = shapely.GeometryType
    rings = shapely.get_rings(parts[kind == kinds.POLYGON])
    lines = parts[(kind == kinds.LINESTRING) | (kind == kinds.LINEARRING)]
    return np.concatenate([lines, rings]), parts[kind == kinds.POINT]


def _simple(geometries: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the parts of multi-part geometries and collections, however deep."""
    while (shapely.get_type_id(geometries) > shapely.GeometryType.POLYGON).any():
        geometries = shapely.get_parts(geometries)
    return geometries


def _vertices(geometries: npt.NDArray[Any]) -> FloatArray:
    """Return vertices (n, 3); of a closed line the last is the first and does not count twice."""
    xyz, at = shapely.get_coordinates(geometries, include_z=True, return_index=True)
    last = np.flatnonzero(np.diff(at, append=-1) != 0)
    again = last[shapely.is_closed(geometries)[at[last]]] if len(last) else last
    return np.asarray(np.delete(xyz, again, axis=0), np.float64)


def read_water_polygons(path: File, cloud_crs: str | CRS | None = None) -> WaterPolygons:
    """Read the polygons inside which points may be submerged, as one area.

    An `InputError` if there is no polygon with an area, or they cannot be read or brought to the
    cloud's CRS.
    """
    vectors = in_cloud_crs(read_vectors(path), cloud_crs, heights=False)
    parts = shapely.force_2d(_simple(vectors.geometries))
    is_polygon = shapely.get_type_id(parts) == shapely.GeometryType.POLYGON
    if not is_polygon.any():
        kinds = ", ".join(sorted({geometry.geom_type for geometry in vectors.geometries}))
        raise InputError(
            f"{vectors.name}: holds no polygon ({kinds}); a mask needs polygons of water."
        )
    polygons, notes = _valid(parts[is_polygon], vectors.name)
    if not is_polygon.all():
        other = int((~is_polygon).sum())
        notes += (f"{vectors.name}: {other} points or lines beside the polygons are left out.",)
    area = shapely.union_all(polygons)
    if not area.area > 0.0:
        raise InputError(f"{vectors.name}: the polygons have no area.")
    return WaterPolygons(area, vectors.name, (*vectors.notes, *notes))


def _valid(polygons: npt.NDArray[Any], name: str) -> tuple[npt.NDArray[Any], tuple[str, ...]]:
    """Return polygons with those repaired that cross themselves: holes stay holes."""
    crossed = ~shapely.is_valid(polygons)
    if not crossed.any():
        return polygons, ()
    first = int(np.argmax(crossed))
    reason = shapely.is_valid_reason(polygons[first])
    mended = polygons.copy()
    mended[crossed] = shapely.make_valid(
        polygons[crossed], method="structure", keep_collapsed=False
    )
    area_m2 = float(shapely.area(mended[crossed]).sum())
    return mended, (
        f"{name}: {int(crossed.sum())} of {len(polygons)} polygons cross or touch themselves"
        f" ({reason}) and were repaired; they now cover {area_m2:.1f} m2.",
    )

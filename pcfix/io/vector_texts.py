"""Geometries from text files: WKT with one a line, and tables of points."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError
from pcfix.io.tables import number, read_lines, split_header, table_below

if TYPE_CHECKING:
    from pathlib import Path
    from types import ModuleType

    import numpy.typing as npt

    from pcfix.io.tables import Table
    from pcfix.model import FloatArray

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
_SRID = re.compile(r"\s*SRID\s*=\s*(\d+)\s*;", re.IGNORECASE)
_CRS = re.compile(r"#\s*crs\s*[:=]\s*(.+)$", re.IGNORECASE)


def read_text(path: Path, shapely: ModuleType) -> tuple[npt.NDArray[Any], str | None]:
    """Return the geometries of a text file, and the CRS that it names.

    A comment ``# crs: EPSG:25830`` above the rest names it, or ``SRID=25830;`` before a WKT;
    longitude and latitude are taken to be of WGS 84.

    Raises
    ------
    InputError
        If it is neither WKT nor a table of points, or damaged.
    """
    lines = read_lines(path)
    said = [found.group(1).strip() for line in lines[:20] if (found := _CRS.match(line.strip()))]
    kept = [(i, line) for i, line in enumerate(lines) if _counts(line)]
    if not kept:
        raise InputError(f"{path}: is empty.")
    at, first = kept[0]
    if _WKT.match(first):
        numbered = [(i + 1, line) for i, line in kept]
        geometries, srid = _from_wkt(path, numbered, shapely)
    else:
        geometries, srid = _from_table(path, lines, at, shapely)
    return geometries, said[0] if said else srid


def _counts(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _from_wkt(
    path: Path, lines: list[tuple[int, str]], shapely: ModuleType
) -> tuple[npt.NDArray[Any], str | None]:
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


def _from_table(
    path: Path, lines: list[str], at: int, shapely: ModuleType
) -> tuple[npt.NDArray[Any], str | None]:
    """Return the points, or the geometries, of a table whose header is ``lines[at]``."""
    names, delimiter = split_header(lines[at])
    header = [_UNIT.sub("", name) for name in names]
    table = table_below(path, lines, header, delimiter, at=at, comments=True)
    if (wkt := _column(header, "wkt")) is not None:
        numbered = list(zip(table.line, table.column(wkt), strict=True))
        return _from_wkt(path, numbered, shapely)
    for x, y, crs in (("x", "y", None), ("longitude", "latitude", "EPSG:4326")):
        plan = _column(header, x), _column(header, y)
        if plan[0] is not None and plan[1] is not None:
            return _points(table, plan[0], plan[1], shapely), crs
    raise InputError(
        f"{path}: line {at + 1} must name the columns x and y (or easting and northing, longitude"
        f" and latitude), with z or height where there is one; it has: {', '.join(names)}."
    )


def _column(header: list[str], role: str) -> str | None:
    return next((name for name in COLUMNS[role] if name in header), None)


def _points(table: Table, x: str, y: str, shapely: ModuleType) -> npt.NDArray[Any]:
    """Return the points of a table; where the height of one is empty it has none."""
    plan = np.column_stack([table.numbers(x), table.numbers(y)])
    name = _column(table.header, "z")
    if name is None:
        return np.asarray(shapely.points(plan))
    z = _numbers_or_none(table, name)
    points = np.asarray(shapely.points(np.column_stack([plan, z])))
    return np.where(np.isfinite(z), points, shapely.force_2d(points))


def _numbers_or_none(table: Table, name: str) -> FloatArray:
    """Return a column as numbers, NaN for empty fields and NaN; other text is refused."""
    texts = table.column(name)
    values = np.array([number(text) for text in texts])
    for row in np.flatnonzero(~np.isfinite(values)):
        if texts[row].lower() not in ("", "nan", "na", "null", "none"):
            raise InputError(
                f"{table.path}: line {table.line[row]}, column {name}: '{texts[row]}' is not a"
                " finite number."
            )
    return values

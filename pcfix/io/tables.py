"""Text files: tables with a header line, geometries as WKT or points, check depths."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError
from pcfix.io.files import AnyPath, check_input
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
_NO_HEIGHT = ("", "nan", "na", "null", "none")
_SRID = re.compile(r"\s*SRID\s*=\s*(\d+)\s*;", re.IGNORECASE)
_CRS = re.compile(r"#\s*crs\s*[:=]\s*(.+)$", re.IGNORECASE)

DEPTH_SPELLINGS = {
    "x": ("x", "easting", "east"),
    "y": ("y", "northing", "north"),
    "depth": ("depth", "true_depth", "water_depth", "measured_depth"),
    "z": ("z", "height", "elevation", "elev", "altitude"),
}
_DEPTH_UNIT = re.compile(r"^(.*?)[ _]*[\[(]([^\])]*)[\])]$|^(.*)_(m|cm|mm|ft)$")
_METRES = ("", "m", "metre", "metres", "meter", "meters")


class Table(NamedTuple):
    """A header and its rows, all text; `line` is each row's line number in the file."""

    path: Path
    header: list[str]
    rows: list[list[str]]
    line: list[int]

    def column(self, name: str) -> list[str]:
        """Return one column as text."""
        return [row[self.header.index(name)] for row in self.rows]

    def numbers(self, name: str, unknown: Container[str] = ()) -> list[float]:
        """Return one column as finite numbers, NaN where its text, in lower case, is `unknown`.

        An `InputError` if another field is not a finite number; the message names its row and
        column.
        """
        texts = self.column(name)
        values = [number(text) for text in texts]
        for line, text, value in zip(self.line, texts, values, strict=True):
            if not math.isfinite(value) and text.lower() not in unknown:
                raise InputError(
                    f"{self.path}: line {line}, column {name}: '{text}' is not a finite number."
                )
        return values


def number(text: str) -> float:
    """Return the number in a text, NaN where there is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def split_header(line: str) -> tuple[list[str], str]:
    """Return the names of a header line, lower case, and the delimiter between them."""
    delimiter = delimiter_of(line)
    names = line.split(None if delimiter == " " else delimiter)
    return [name.strip().strip("\"'").lower() for name in names], delimiter


def delimiter_of(line: str) -> str:
    """Return the tab, semicolon or comma between the fields of a line; without any, the space."""
    delimiter = max(",;\t", key=line.count)
    return delimiter if delimiter in line else " "


def read_lines(path: Path) -> list[str]:
    """Read a text file, with or without a byte order mark."""
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")  # only names can be affected
    return text.splitlines()


def read_table(path: Path, required: Sequence[str]) -> Table:
    """Read a table; comma, semicolon, tab or space, with or without a byte order mark.

    An `InputError` if a required column is missing; see `table_below`.
    """
    lines = read_lines(path)
    header, delimiter = split_header(lines[0] if lines else "")
    missing = [name for name in required if name not in header]
    if missing:
        raise InputError(
            f"{path}: line 1 must name the columns {', '.join(required)};"
            f" {', '.join(missing)} missing (it has: {', '.join(header)})."
        )
    return table_below(path, lines, header, delimiter)


def table_below(
    path: Path,
    lines: list[str],
    header: list[str],
    delimiter: str,
    *,
    at: int = 0,
    comments: bool = False,
) -> Table:
    """Return the rows below the header, which is ``lines[at]``.

    Empty lines do not count and, with `comments`, nor do those that begin with #. An `InputError`
    if a row has another number of fields than the header, or there are no rows.
    """
    rows, numbers = [], []
    below = ["" if comments and line.startswith("#") else line for line in lines[at + 1 :]]
    for number_, fields in _split(path, below, delimiter, at + 2):
        if not any(field.strip() for field in fields):
            continue
        if len(fields) != len(header):
            raise InputError(
                f"{path}: line {number_} has {len(fields)} fields, the header {len(header)};"
                " a column is shifted or missing."
            )
        rows.append([field.strip() for field in fields])
        numbers.append(number_)
    if not rows:
        raise InputError(f"{path}: has a header but no rows.")
    return Table(path, header, rows, numbers)


def _split(
    path: Path, lines: list[str], delimiter: str, first: int
) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the fields of each row; `first` is the number of the first."""
    spaced = delimiter == " "
    if spaced:
        lines = [" ".join(line.split("\t")).strip() for line in lines]
    quote = "'" if spaced and any(line.startswith("'") for line in lines[:1]) else '"'
    reader = csv.reader(lines, delimiter=delimiter, quotechar=quote, skipinitialspace=spaced)
    try:
        yield from enumerate(reader, start=first)
    except csv.Error as error:
        raise InputError(
            f"{path}: line {first + reader.line_num - 1} is not CSV ({error})."
        ) from error


def read_text(path: Path) -> tuple[npt.NDArray[Any], str | None]:
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
    import shapely

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
    import shapely

    plan = np.column_stack([table.numbers(x), table.numbers(y)])
    name = _column(table.header, "z")
    if name is None:
        return np.asarray(shapely.points(plan))
    z = np.array(table.numbers(name, _NO_HEIGHT))
    points = np.asarray(shapely.points(np.column_stack([plan, z])))
    return np.where(np.isfinite(z), points, shapely.force_2d(points))


@dataclass(frozen=True, eq=False)
class CheckDepths:
    """Places with a known depth, or a known height of the bed; p of them."""

    name: str  # of the file, for messages
    xy: FloatArray  # (p, 2), metres, the cloud's CRS
    value_m: FloatArray  # (p,), depth below the water, positive down; or world Z, `are_heights`
    are_heights: bool
    line: list[int]  # of each place in the file

    def __len__(self) -> int:
        return len(self.line)

    def where(self, row: int) -> str:
        """Return file, line and place, for messages."""
        return f"{self.name}: line {self.line[row]} ({self.xy[row, 0]:.2f}, {self.xy[row, 1]:.2f})"


def read_check_depths(path: AnyPath) -> CheckDepths:
    """Read check depths from a table with a header line.

    An `InputError` if there is no such file, a column is missing, not in metres or there twice, a
    field is not a finite number, or a depth is negative.

    Parameters
    ----------
    path : path
        Columns in any order, separated by comma, semicolon, tab or space: ``x`` and ``y`` (or
        easting and northing) in the cloud's CRS, and ``depth``, metres below the water surface
        that the correction is given, positive down, or ``z``, the height of the bed in the
        cloud's heights. Where both are there the depth counts. Other columns are passed over,
        a standard error too: all check depths count alike.
    """
    source = check_input(path)
    table = read_table(source, ())
    columns = {role: _depth_column(table, role) for role in DEPTH_SPELLINGS}
    what = "z" if columns["depth"] is None else "depth"
    missing = [role for role in ("x", "y", what) if columns[role] is None]
    if missing:
        raise InputError(
            f"{source}: line 1 must name the columns x, y and depth (or z);"
            f" {', '.join('depth or z' if m == 'z' else m for m in missing)} missing (it has:"
            f" {', '.join(table.header)})."
        )
    values = []
    for name, unit in filter(None, (columns[role] for role in ("x", "y", what))):
        if unit not in _METRES:
            raise InputError(f"{source}: column {name} is in '{unit}'; give metres.")
        values.append(np.array(table.numbers(name), np.float64))
    found = CheckDepths(
        str(source), np.column_stack(values[:2]), values[2], what == "z", table.line
    )
    negative = np.flatnonzero(found.value_m < 0.0)
    if len(negative) and not found.are_heights:
        first = int(negative[0])
        raise InputError(
            f"{found.where(first)}: the depth {found.value_m[first]:g} is negative, as are"
            f" {len(negative)} of {len(found)}; depths count positive down, and heights of the bed"
            " belong in a column z."
        )
    return found


def _split_unit(name: str) -> tuple[str, str]:
    """Return the name of a column and its unit: depth_m, Depth (m), x [m]."""
    match = _DEPTH_UNIT.match(name)
    if not match:
        return name.replace(" ", "_"), ""
    name, unit = (match[1], match[2]) if match[3] is None else (match[3], match[4])
    return name.strip().replace(" ", "_"), unit.strip()


def _depth_column(table: Table, role: str) -> tuple[str, str] | None:
    """Return a column's name in the header and its unit; easting beside x is refused."""
    split = [(name, *_split_unit(name)) for name in table.header]
    there = [(name, unit) for name, bare, unit in split if bare in DEPTH_SPELLINGS[role]]
    if len(there) > 1:
        twice = ", ".join(name for name, _ in there)
        raise InputError(
            f"{table.path}: line 1: the columns {twice} may all be {role}; take out all but one."
        )
    return there[0] if there else None

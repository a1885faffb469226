"""Read tables, that is text files with a header line, and match the names of images in them."""

import codecs
import csv
import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

import numpy as np

from pcfix.errors import InputError, bad_file
from pcfix.io.files import check_input
from pcfix.model import FloatArray, IntArray
from pcfix.options.declare import File

METRES = dict.fromkeys(("", "m", "metre", "metres", "meter", "meters"), 1.0)
DEGREES = dict.fromkeys(("", "deg", "degree", "degrees", "°"), 1.0)
# Units by their names: sizes in metres and degrees.
ANGLES = {
    **DEGREES,
    **dict.fromkeys(("gon", "gons", "grad", "grads"), 0.9),
    **dict.fromkeys(("rad", "radian", "radians"), 180.0 / math.pi),
}
PIXELS = dict.fromkeys(("", "px", "pixel", "pixels", "pix"), 1.0)
# What numbers are in, by the role of their column; those of others have any unit.
UNITS = {
    **dict.fromkeys(("x", "y", "z", "depth", "sigma_x", "sigma_y", "sigma_z"), ("metres", METRES)),
    **dict.fromkeys(("longitude", "latitude", "yaw", "pitch", "roll"), ("degrees", ANGLES)),
    **dict.fromkeys(("omega", "phi", "kappa"), ("degrees", ANGLES)),
    **dict.fromkeys(("u", "v"), ("pixels", PIXELS)),
}
Spellings: TypeAlias = Mapping[str, Sequence[str]]  # what columns are called, by their roles
EXIF = ("gpslongitude", "gpslatitude", "gpsaltitude")


@dataclass(frozen=True)
class Table:
    """The columns of a table and its rows, all text.

    The `header` has the names of the columns, lower case, without units, and `line` each row's line
    number. `place` leads from the role of a column to its number; `unit` is that of each column, if
    any is stated, `crs` what a comment states, and the header is a comment where `after_hash`.
    """

    path: Path
    header: list[str]
    rows: list[list[str]]
    line: list[int]
    place: Mapping[str, int]
    unit: Sequence[str] = ()
    after_hash: bool = False
    crs: str | None = None

    @cached_property
    def labels(self) -> list[str]:
        """The names of the images, none empty."""
        labels = self.column("label")
        if "" in labels:
            line = self.line[labels.index("")]
            sentence = f"line {line}: the image has no name. Give it one."
            raise bad_file(self.path, "table.no_label", sentence, line=line)
        if self.name("label") == "sourcefile":
            return [re.split(r"[\\/]", label)[-1] for label in labels]
        return labels

    def take(self, rows: IntArray) -> "Table":
        """Return the table with some of its rows."""
        chosen, lines = [self.rows[i] for i in rows], [self.line[i] for i in rows]
        return replace(self, rows=chosen, line=lines)

    def has(self, *roles: str) -> bool:
        """Whether all these are there."""
        return all(role in self.place for role in roles)

    def name(self, role: str) -> str:
        """Return what the file calls it."""
        return self.header[self.place[role]]

    def column(self, role: str) -> list[str]:
        """Return one column as text."""
        return [row[self.place[role]] for row in self.rows]

    def of(self, roles: Iterable[str]) -> FloatArray:
        """Return columns of finite numbers, metres and degrees, shape (k, number of roles)."""
        return np.column_stack([self._numbers(role, needed=True) for role in roles])

    def where_there(self, roles: Iterable[str]) -> FloatArray:
        """Return the same with NaN for empty fields and for columns that are not there."""
        return np.column_stack([self._numbers(role, needed=False) for role in roles])

    def error(self, row: int, code: str, sentence: str, **values: Any) -> InputError:
        """Return an error that names file, line and image."""
        where = f"line {self.line[row]}"
        where += f" (image {self.labels[row]})" if self.has("label") else ""
        return bad_file(self.path, code, f"{where}: {sentence}", **values)

    def _numbers(self, role: str, *, needed: bool) -> FloatArray:
        if role not in self.place:
            return np.full(len(self.rows), np.nan)
        name, texts = self.name(role), self.column(role)
        values = np.array([(exif_number if name in EXIF else number)(text) for text in texts])
        # no coordinate, in whatever unit, and no time is as large; its square is still a number
        for i in np.flatnonzero(~(np.abs(values) < 1e15)):
            if needed or texts[i].lower() not in ("", "nan", "na", "null", "none"):
                why = "too large" if math.isfinite(values[i]) else "not a finite number"
                sentence = f"column {name}: '{texts[i]}' is {why}. Correct it."
                where = {"line": self.line[i], "column": name, "value": texts[i]}
                raise self.error(int(i), "table.number", sentence, **where)
        unit = self.unit[self.place[role]] if self.unit else ""
        wanted, known = UNITS.get(role, ("", {unit: 1.0}))
        if unit not in known:
            sentence = f"column {name} is in '{unit}'. Give {wanted}."
            raise bad_file(self.path, "table.unit", sentence, column=name, value=unit)
        return values * known[unit]


CRS_COMMENT = re.compile(r"^\s*#\s*(?:coordinatesystem|crs)\s*[:=]\s*(.+)$", re.IGNORECASE)


def number(text: str) -> float:
    """Return the number in a text, NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _with_point(text: str) -> str:
    """Return a number with a decimal point in place of a comma, and any other text as it is."""
    return re.sub(r"^([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)$", r"\1.\2", text)


def exif_number(text: str) -> float:
    """Return the number in what exiftool writes: 24 deg 40' 48.5" S, 86.5 m Below Sea Level."""
    parts = [number(part) for part in re.findall(r"[\d.]+", text)]
    if "deg" not in text and "Sea Level" not in text:
        return number(text)
    if not 1 <= len(parts) <= 3:
        return np.nan
    value = math.fsum(part / 60.0**i for i, part in enumerate(parts))
    return -value if text.endswith(("S", "W")) or "Below" in text else value


def read_lines(path: Path) -> list[str]:
    """Read a text file."""
    return decoded(path.read_bytes()).splitlines()


def decoded(data: bytes) -> str:
    """Return a text of UTF-16, if it has a byte order mark, or else of UTF-8 or Latin-1."""
    if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        # only names can be affected
        return data.removeprefix(codecs.BOM_UTF8).decode("latin-1")


def find_header(
    lines: Sequence[str], spellings: Spellings
) -> tuple[int, list[str], list[str], bool]:
    """Return the line from 0 that names the columns, their names and units, and if it is a comment.

    It is the last comment above the rows that names two columns, or the first line that is no
    comment. The names are lower case, without units; there are none in a text without lines.
    """
    plain = {spelling for names in spellings.values() for spelling in names}
    found = 0, list[str](), list[str](), False
    for i, line in enumerate(lines):
        is_comment = line.lstrip("\"' ").startswith("#")
        text = line.strip().lstrip("#").strip() if is_comment else line.strip()
        if text and not CRS_COMMENT.match(line):
            fields = text.split(_delimiter(text))
            names, units = zip(*(_split_unit(one, plain) for one in fields), strict=True)
            if len(places(names, spellings)) >= 2 or not (is_comment or found[1]):
                found = i, [*names], [*units], is_comment
            if not is_comment:
                break
    return found


def _delimiter(line: str) -> str | None:
    """Return the semicolon, tab or comma between the fields of a line, else None: spaces."""
    most = ";" if ";" in line else max(",\t", key=line.count)  # decimals may have commas
    return most if most in line else None


def _split_unit(text: str, plain: set[str]) -> tuple[str, str]:
    """Return the name of a column and its unit: depth_m, Depth (m), x [m]; `plain` are names.

    The name of X/Longitude is longitude.
    """
    name, unit = text.strip("# \t\"'").lower(), ""
    if name not in plain and len(name) < 80:  # long names take the expression long
        match = re.match(r"^(.*?)[ _]*[\[(]([^\])]*)[\])]$|^(.*)_(m|cm|mm|ft|deg|gon|rad)$", name)
        name, unit = (match[1] or match[3], match[2] or match[4]) if match else (name, "")
        name, unit = (name or "").strip().replace(" ", "_"), (unit or "").strip()
    axis, _, kind = name.partition("/")
    return kind if axis in ("x", "y", "z") and kind in plain else name, unit


def places(header: Sequence[str], spellings: Spellings) -> dict[str, int]:
    """Return the number of the column of each role: the first of its spellings that is there."""
    found = {role: [name for name in names if name in header] for role, names in spellings.items()}
    return {role: header.index(names[0]) for role, names in found.items() if names}


def check_columns(
    path: Path, header: Sequence[str], required: Sequence[str], missing: Sequence[str]
) -> None:
    """Refuse a table that lacks columns."""
    if missing:
        sentence = f"the columns {', '.join(required)} are needed; {', '.join(missing)} missing"
        sentence += f" (it has: {', '.join(header)})."
        raise bad_file(path, "table.column_missing", sentence, missing=list(missing))


def read_table(path: Path, *needed: Sequence[str], spellings: Spellings | None = None) -> Table:
    """Read a table with the needed columns, of which several sets may be given: one suffices.

    Without `spellings` the columns are called by their roles. The header may be a comment (#).
    Empty lines and comments below it are skipped.
    """
    spellings = spellings or {role: (role,) for role in needed[0]}
    lines = read_lines(path)
    at, header, units, is_comment = find_header(lines, spellings)
    place = places(header, spellings)
    if header and not np.isnan([number(_with_point(name)) for name in header[:4]]).any():
        sentence = "line 1 has numbers only. Add a line above it that names the columns, such as"
        sentence += f" {', '.join(spellings[role][0] for role in needed[0])}."
        raise bad_file(path, "table.no_header", sentence)
    if not any({*some} <= place.keys() for some in needed):
        most = max(needed, key=lambda some: len(place.keys() & {*some}))
        missing = [spellings[role][0] for role in most if role not in place]
        check_columns(path, header, [spellings[role][0] for role in most], missing)
    below = ["" if line.startswith("#") else line for line in lines[at + 1 :]]
    first = next(filter(str.strip, below), "") if is_comment else lines[at]
    delimiter = _delimiter(first.strip())
    if delimiter is None:
        below = [" ".join(line.split("\t")).strip() for line in below]
    quote = "'" if delimiter is None and any(line.startswith("'") for line in below[:1]) else '"'
    reader = csv.reader(
        below, delimiter=delimiter or " ", quotechar=quote, skipinitialspace=delimiter is None
    )
    rows, numbers = [], []
    try:
        for line, fields in enumerate(reader, start=at + 2):
            if not any(field.strip() for field in fields):
                continue
            if len(fields) != len(header):
                sentence = f"line {line} has {len(fields)} fields, the header has {len(header)}."
                raise bad_file(path, "table.shifted", sentence, line=line)
            fields = [field.strip() for field in fields]
            rows.append(fields if delimiter == "," else [_with_point(one) for one in fields])
            numbers.append(line)
    except csv.Error as error:
        sentence = f"line {at + 1 + reader.line_num} is not CSV ({error})."
        raise bad_file(path, "table.not_csv", sentence) from error
    if not rows:
        raise bad_file(path, "table.empty", "has a header but no rows.")
    stated = filter(None, map(CRS_COMMENT.match, lines[:at]))
    system = next((found[1].strip() for found in stated), None)
    return Table(path, header, rows, numbers, place, units, is_comment, system)


def match_labels(
    names: Sequence[str], labels: Sequence[str], *, one_to_one: bool = True
) -> tuple[IntArray, tuple[str, ...]]:
    """Find each name among labels: the complete name, else without its folder or its extension.

    Return the row of each in the labels, -1 where there is none or it could be several; and the
    names that could be several labels or, with `one_to_one`, share one with another name.
    """
    keys: tuple[Callable[[str], str], ...] = str, _file_name, _stem
    row = np.full(len(names), -1, np.int64)
    unclear: set[int] = set()
    for key in keys:
        here, there = _rows_by(key, names), _rows_by(key, labels)
        for word, rows in here.items():
            found = there.get(word, [])
            left = [i for i in rows if row[i] < 0]
            if len(found) == 1 and (len(rows) == 1 or not one_to_one):
                row[left] = found[0]
            elif found:
                unclear.update(rows)
    return row, tuple(names[i] for i in sorted(unclear) if row[i] < 0)


def unnamed(names: Iterable[str], labels: Iterable[str]) -> tuple[str, ...]:
    """Return the names, each once, that match none of the labels."""
    stems = {_stem(label) for label in labels}
    return tuple(name for name in dict.fromkeys(names) if _stem(name) not in stems)


def _rows_by(key: Callable[[str], str], names: Sequence[str]) -> dict[str, list[int]]:
    rows = defaultdict(list)
    for i, name in enumerate(names):
        rows[key(name)].append(i)
    return rows


def _file_name(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).name


def _stem(name: str) -> str:
    return PurePosixPath(_file_name(name)).stem.lower()


# Names of the columns of points; the first that the header has is used.
POINT_SPELLINGS = {
    "x": ("x", "easting", "east"),
    "y": ("y", "northing", "north"),
    "z": ("z", "height", "elevation", "elev", "altitude", "h", "alt"),
    "longitude": ("longitude", "lon", "long"),
    "latitude": ("latitude", "lat"),
    "depth": ("depth", "true_depth", "water_depth", "measured_depth"),
}


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


def read_check_depths(path: File) -> CheckDepths:
    """Read check depths from a table with a header line.

    Its columns are ``x`` and ``y`` (or easting and northing) in the cloud's CRS, and ``depth``,
    metres below the water surface that the correction is given, positive down, or ``z``, the height
    of the bed in the cloud's heights. If both are there, the depth is used. Other columns are
    ignored, a standard error too: all check depths have the same weight.
    """
    source = check_input(path)
    table = read_table(source, ("x", "y", "depth"), ("x", "y", "z"), spellings=POINT_SPELLINGS)
    what = "depth" if table.has("depth") else "z"
    values = table.of(("x", "y", what))
    found = CheckDepths(str(source), values[:, :2], values[:, 2], what == "z", table.line)
    negative = np.flatnonzero(found.value_m < 0.0)
    if len(negative) and not found.are_heights:
        line, count = found.line[negative[0]], len(negative)
        sentence = f"{count} depths are negative (line {line}). Give them positive down, or as z."
        raise bad_file(source, "check_depths.negative", sentence, line=line, count=count)
    return found

"""Read tables, that is text files with a header line, and the check depths in one."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.errors import bad_file
from pcfix.io.files import check_input
from pcfix.model import FloatArray
from pcfix.options.declare import File

TOO_LARGE = 1e15
"""No coordinate, in whatever unit, and no time is as large; its square is still a number."""


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
        """Return one column as finite numbers, NaN where its text, in lower case, is `unknown`."""
        texts = self.column(name)
        values = [number(text) for text in texts]
        for line, text, value in zip(self.line, texts, values, strict=True):
            if not abs(value) < TOO_LARGE and text.lower() not in unknown:
                why = "too large" if math.isfinite(value) else "not a finite number"
                sentence = f"line {line}, column {name}: '{text}' is {why}."
                where = {"line": line, "column": name, "value": text}
                raise bad_file(self.path, "table.number", sentence, **where)
        return values


def number(text: str) -> float:
    """Return the number in a text, NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def split_header(line: str) -> tuple[list[str], str]:
    """Return the names of a header line, lower case, and the delimiter between them.

    It is the tab, semicolon or comma between the fields, else the space.
    """
    delimiter = max(",;\t", key=line.count)
    delimiter = delimiter if delimiter in line else " "
    names = line.split(None if delimiter == " " else delimiter)
    return [name.strip().strip("\"'").lower() for name in names], delimiter


def read_lines(path: Path) -> list[str]:
    """Read a text file, with or without a byte order mark."""
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")  # only names can be affected
    return text.splitlines()


def read_table(path: Path, required: Sequence[str]) -> Table:
    """Read a table; comma, semicolon, tab or space, with or without a byte order mark."""
    lines = read_lines(path)
    header, delimiter = split_header(lines[0] if lines else "")
    check_columns(path, header, required, [name for name in required if name not in header])
    return table_below(path, lines, header, delimiter)


_LONGEST_NAME = 80
METRES = dict.fromkeys(("", "m", "metre", "metres", "meter", "meters"), 1.0)
DEGREES = dict.fromkeys(("", "deg", "degree", "degrees", "°"), 1.0)
ANGLES = {
    **DEGREES,
    **dict.fromkeys(("gon", "gons", "grad", "grads"), 0.9),
    **dict.fromkeys(("rad", "radian", "radians"), 180.0 / math.pi),
}
"""Units by their names, in metres and degrees."""


def split_unit(name: str, endings: str = "m|cm|mm|ft|deg") -> tuple[str, str]:
    """Return the name of a column and its unit: depth_m, Depth (m), x [m]."""
    if len(name) >= _LONGEST_NAME:  # the expression takes long on a long name
        return name, ""
    match = re.match(rf"^(.*?)[ _]*[\[(]([^\])]*)[\])]$|^(.*)_({endings})$", name)
    bare, unit = (match[1] or match[3], match[2] or match[4]) if match else (name, "")
    return (bare or "").strip().replace(" ", "_"), (unit or "").strip()


def columns_of(
    path: Path, header: Sequence[str], spellings: Sequence[str], units: Container[str]
) -> list[str]:
    """Return the columns with one of some names, as in depth_m, Depth (m), x [m], in their order.

    A unit other than these `units` is refused.
    """
    found = []
    for name in header:
        bare, unit = split_unit(name)
        if bare in spellings:
            found.append((spellings.index(bare), name))
            if unit not in units:
                sentence = f"column {name} is in '{unit}'. Give metres."
                raise bad_file(path, "table.unit", sentence, column=name, value=unit)
    return [name for _, name in sorted(found)]


def places(header: Sequence[str], spellings: Mapping[str, Sequence[str]]) -> dict[str, int]:
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

    Empty lines are skipped and, with `comments`, also those that begin with #.
    """
    spaced = delimiter == " "
    below = ["" if comments and line.startswith("#") else line for line in lines[at + 1 :]]
    if spaced:
        below = [" ".join(line.split("\t")).strip() for line in below]
    quote = "'" if spaced and any(line.startswith("'") for line in below[:1]) else '"'
    reader = csv.reader(below, delimiter=delimiter, quotechar=quote, skipinitialspace=spaced)
    rows, numbers = [], []
    try:
        for line, fields in enumerate(reader, start=at + 2):
            if not any(field.strip() for field in fields):
                continue
            if len(fields) != len(header):
                sentence = f"line {line} has {len(fields)} fields, the header has {len(header)}."
                raise bad_file(path, "table.shifted", sentence, line=line)
            rows.append([field.strip() for field in fields])
            numbers.append(line)
    except csv.Error as error:
        sentence = f"line {at + 1 + reader.line_num} is not CSV ({error})."
        raise bad_file(path, "table.not_csv", sentence) from error
    if not rows:
        raise bad_file(path, "table.empty", "has a header but no rows.")
    return Table(path, header, rows, numbers)


DEPTH_SPELLINGS = {
    "x": ("x", "easting", "east"),
    "y": ("y", "northing", "north"),
    "depth": ("depth", "true_depth", "water_depth", "measured_depth"),
    "z": ("z", "height", "elevation", "elev", "altitude"),
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

    Parameters
    ----------
    path : path
        Columns in any order, separated by comma, semicolon, tab or space: ``x`` and ``y`` (or
        easting and northing) in the cloud's CRS, and ``depth``, metres below the water surface
        that the correction is given, positive down, or ``z``, the height of the bed in the
        cloud's heights. If both are there, the depth is used. Other columns are ignored, a
        standard error too: all check depths have the same weight.
    """
    source = check_input(path)
    table = read_table(source, ())
    column: dict[str, str] = {}
    for role in ("x", "y", "depth", "z"):
        if role == "z" and "depth" in column:  # then heights are not looked at
            break
        there = columns_of(source, table.header, DEPTH_SPELLINGS[role], METRES)
        if len(there) > 1:
            sentence = f"the columns {', '.join(there)} may all be {role}. Remove all but one."
            raise bad_file(source, "table.column_twice", sentence, columns=there)
        if there:
            column[role] = there[0]
    what = "depth" if "depth" in column else "z"
    missing = ["depth or z" if r == "z" else r for r in ("x", "y", what) if r not in column]
    check_columns(source, table.header, ("x", "y", "depth or z"), missing)
    values = [np.array(table.numbers(column[role])) for role in ("x", "y", what)]
    found = CheckDepths(
        str(source), np.column_stack(values[:2]), values[2], what == "z", table.line
    )
    negative = np.flatnonzero(found.value_m < 0.0)
    if len(negative) and not found.are_heights:
        line, count = found.line[negative[0]], len(negative)
        sentence = f"{count} depths are negative (line {line}). Give them positive down, or as z."
        raise bad_file(source, "check_depths.negative", sentence, line=line, count=count)
    return found

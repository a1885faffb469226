"""Tables as text files with a header line, and the check depths in one."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.files import check_input
from pcfix.model import FloatArray
from pcfix.options.declare import File

DEPTH_SPELLINGS = {
    "x": ("x", "easting", "east"),
    "y": ("y", "northing", "north"),
    "depth": ("depth", "true_depth", "water_depth", "measured_depth"),
    "z": ("z", "height", "elevation", "elev", "altitude"),
}
_DEPTH_UNIT = re.compile(r"^(.*?)[ _]*[\[(]([^\])]*)[\])]$|^(.*)_(m|cm|mm|ft)$")
_LONGEST_NAME = 80
TOO_LARGE = 1e15
"""No coordinate, in whatever unit, and no time is as large; its square is still a number."""
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
            if not abs(value) < TOO_LARGE and text.lower() not in unknown:
                why = "too large" if math.isfinite(value) else "not a finite number"
                raise InputError(f"{self.path}: line {line}, column {name}: '{text}' is {why}.")
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
    match = _DEPTH_UNIT.match(name) if len(name) < _LONGEST_NAME else None  # it may take long
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

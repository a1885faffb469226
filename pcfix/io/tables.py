"""Small tables of text with a header line: names and numbers, and errors that say where."""

from __future__ import annotations

import csv
import math
from typing import TYPE_CHECKING, NamedTuple

from pcfix.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path


class Table(NamedTuple):
    """A header and its rows, all text; `line` is each row's line number in the file."""

    path: Path
    header: list[str]
    rows: list[list[str]]
    line: list[int]

    def column(self, name: str) -> list[str]:
        """Return one column as text."""
        return [row[self.header.index(name)] for row in self.rows]

    def numbers(self, name: str) -> list[float]:
        """Return one column as finite numbers.

        Raises
        ------
        InputError
            If a field is not a finite number; the message names its row and column.
        """
        values = []
        for line, text in zip(self.line, self.column(name), strict=True):
            value = number(text)
            if not math.isfinite(value):
                raise InputError(
                    f"{self.path}: line {line}, column {name}: '{text}' is not a finite number."
                )
            values.append(value)
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

    Raises
    ------
    InputError
        If a required column is missing, a row has another number of fields than the header, or
        there are no rows.
    """
    lines = read_lines(path)
    header, delimiter = split_header(lines[0] if lines else "")
    require(path, 1, header, required)
    return table_below(path, lines, header, delimiter)


def require(path: Path, line: int, header: Sequence[str], required: Sequence[str]) -> None:
    """Refuse a header that lacks a column."""
    missing = [name for name in required if name not in header]
    if missing:
        raise InputError(
            f"{path}: line {line} must name the columns {', '.join(required)};"
            f" {', '.join(missing)} missing (it has: {', '.join(header)})."
        )


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

    Empty lines do not count and, with `comments`, nor do those that begin with #.

    Raises
    ------
    InputError
        If a row has another number of fields than the header, or there are no rows.
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

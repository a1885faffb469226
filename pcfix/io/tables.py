"""Small CSV tables with a header line: names and numbers, and errors that name row and column."""

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
            try:
                value = float(text)
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                raise InputError(
                    f"{self.path}: line {line}, column {name}: '{text}' is not a finite number."
                )
            values.append(value)
        return values


def split_header(line: str) -> tuple[list[str], str]:
    """Return the names of a header line, lower case, and the delimiter between them."""
    delimiter = max(",;\t", key=line.count)
    return [name.strip().strip('"').lower() for name in line.split(delimiter)], delimiter


def read_table(path: Path, required: Sequence[str]) -> Table:
    """Read a CSV table; comma, semicolon or tab, with or without a byte order mark.

    Raises
    ------
    InputError
        If a required column is missing, a row has another number of fields than the header, or
        there are no rows.
    """
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")  # only names can be affected
    lines = text.splitlines()
    header, delimiter = split_header(lines[0] if lines else "")
    missing = [name for name in required if name not in header]
    if missing:
        raise InputError(
            f"{path}: line 1 must name the columns {', '.join(required)};"
            f" {', '.join(missing)} missing (it has: {', '.join(header)})."
        )
    rows, numbers = [], []
    for number, fields in enumerate(_split(path, lines, delimiter), start=1):
        if number == 1 or not any(field.strip() for field in fields):
            continue
        if len(fields) != len(header):
            raise InputError(
                f"{path}: line {number} has {len(fields)} fields, the header {len(header)};"
                " a column is shifted or missing."
            )
        rows.append([field.strip() for field in fields])
        numbers.append(number)
    if not rows:
        raise InputError(f"{path}: has a header but no rows.")
    return Table(path, header, rows, numbers)


def _split(path: Path, lines: list[str], delimiter: str) -> Iterator[list[str]]:
    reader = csv.reader(lines, delimiter=delimiter)
    try:
        yield from reader
    except csv.Error as error:
        raise InputError(f"{path}: line {reader.line_num} is not CSV ({error}).") from error

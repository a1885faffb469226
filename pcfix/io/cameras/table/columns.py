"""The columns of a table of cameras by what they are, as numbers in metres and degrees."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.table.headers import (
    CRS_COMMENT,
    EXIF,
    POSE,
    headers,
    is_header,
    known,
    refuse_two_of_a_kind,
    require_position,
)
from pcfix.io.tables import delimiter_of, number, read_lines, split_header, table_below

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from pcfix.io.tables import Table
    from pcfix.model import FloatArray, IntArray

DEGREES = {"": 1.0, "deg": 1.0, "degree": 1.0, "degrees": 1.0, "°": 1.0} | dict.fromkeys(
    ("gon", "gons", "grad", "grads"), 0.9
)
DEGREES |= dict.fromkeys(("rad", "radian", "radians"), 180.0 / np.pi)
METRES = {"": 1.0, "m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0}


@dataclass(frozen=True)
class Columns:
    """A table whose columns are known.

    Attributes
    ----------
    table : Table
        Its header has the names of the file, lower case, without their units.
    place : dict
        From what a column is, a key of `SPELLINGS`, to its number.
    unit : list of str
        Of each column, as the header has it.
    after_hash : bool
        Whether the header is a comment.
    crs : str or None
        What a comment says.
    """

    table: Table
    place: dict[str, int]
    unit: list[str]
    after_hash: bool
    crs: str | None

    @property
    def path(self) -> Path:
        """The file."""
        return self.table.path

    @cached_property
    def labels(self) -> list[str]:
        """The names of the images, none empty."""
        labels = [row[self.place["label"]] for row in self.table.rows]
        if "" in labels:
            line = self.table.line[labels.index("")]
            raise InputError(f"{self.path}: line {line}: the image has no name.")
        if self.name("label") == "sourcefile":
            return [re.split(r"[\\/]", label)[-1] for label in labels]
        return labels

    def take(self, rows: IntArray) -> Columns:
        """Return the columns with some of their rows."""
        lines = [self.table.line[i] for i in rows]
        table = self.table._replace(rows=[self.table.rows[i] for i in rows], line=lines)
        return replace(self, table=table)

    def has(self, *roles: str) -> bool:
        """Whether all these are there."""
        return all(role in self.place for role in roles)

    def name(self, role: str) -> str:
        """Return what the file calls it."""
        return self.table.header[self.place[role]]

    def of(self, roles: Iterable[str]) -> FloatArray:
        """Return columns of finite numbers, metres and degrees, shape (k, number of roles)."""
        return np.column_stack([self._numbers(role, needed=True) for role in roles])

    def where_there(self, roles: Iterable[str]) -> FloatArray:
        """Return the same with NaN for empty fields and for columns that are not there."""
        return np.column_stack([self._numbers(role, needed=False) for role in roles])

    def where(self, row: int) -> str:
        """Return file, line and image, for messages."""
        return f"{self.path}: line {self.table.line[row]} (image {self.labels[row]})"

    def _numbers(self, role: str, *, needed: bool) -> FloatArray:
        if role not in self.place:
            return np.full(len(self.table.rows), np.nan)
        texts = [row[self.place[role]] for row in self.table.rows]
        values = np.array([number(text) for text in texts])
        if self.name(role) in EXIF:
            values = np.array([exif_number(text) for text in texts])
        for i in np.flatnonzero(~np.isfinite(values)):
            if needed or texts[i]:
                raise InputError(
                    f"{self.where(int(i))}, column {self.name(role)}: '{texts[i]}' is not a"
                    " finite number."
                )
        return values * self._factor(role)

    def _factor(self, role: str) -> float:
        """Return what the unit of a column is in metres or degrees."""
        base, unit = role.removesuffix("_est"), self.unit[self.place[role]]
        if base in ("x", "y", "z", "sigma_x", "sigma_y", "sigma_z"):
            known, wanted = METRES, "metres"
        elif base in POSE:
            known, wanted = DEGREES, "degrees"
        else:
            return 1.0
        if unit not in known:
            raise InputError(
                f"{self.path}: column {self.name(role)} is in '{unit}'; give {wanted}."
            )
        return known[unit]


def read_columns(path: Path) -> Columns:
    """Read a table with a header line, which may be a comment.

    Raises
    ------
    InputError
        If there is no header, two columns are the same thing, or a row has another length.
    """
    lines = read_lines(path)
    found = [header for header in headers(lines) if is_header(header.names)]
    if not found:
        raise InputError(
            f"{path}: line 1 must name the columns; put a header above the rows, for example"
            " label,x,y,z,omega,phi,kappa."
        )
    at, names, unit, comment = found[-1]
    refuse_two_of_a_kind(path, at + 1, names)
    require_position(path, at + 1, names)
    comments = comment or any(line.startswith("#") for line in lines[:at])
    below = next((line for line in lines[at + 1 :] if line.strip() and line[0] != "#"), "")
    delimiter = delimiter_of(below.strip()) if comment else split_header(lines[at].strip())[1]
    table = table_below(path, lines, names, delimiter, at=at, comments=comments)
    crs = next(
        (match[1].strip() for line in lines[:at] if (match := CRS_COMMENT.match(line))), None
    )
    return Columns(table, known(names), unit, comment, crs)


def exif_number(text: str) -> float:
    """Return the number in what exiftool writes: 24 deg 40' 48.5" S, 86.5 m Below Sea Level."""
    parts = [number(part) for part in re.findall(r"[\d.]+", text)]
    if "deg" not in text and "Sea Level" not in text:
        return number(text)
    if not 1 <= len(parts) <= 3:
        return np.nan
    value = math.fsum(part / 60.0**i for i, part in enumerate(parts))
    return -value if text.endswith(("S", "W")) or "Below" in text else value

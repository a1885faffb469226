"""The columns of a table of cameras by what they are, however its header names them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import InputError, bad_file
from pcfix.io.tables import Table, number, places, read_lines, split_header, split_unit, table_below
from pcfix.model import FloatArray, IntArray

SPELLINGS: dict[str, tuple[str, ...]] = {
    "label": (
        *("label", "name", "image", "imagename", "image_name", "filename", "file_name", "file"),
        *("photoid", "photo_id", "photo", "photoname", "photo_name", "picture", "sourcefile"),
    ),
    "x": ("x", "easting", "east", "projectedx"),
    "y": ("y", "northing", "north", "projectedy"),
    "z": (
        *("z", "altitude", "height", "alt", "elevation", "projectedz", "gpsaltitude"),
        *("ellipsoidal_height", "ellipsoid_height", "ellipsoidalheight", "ellipsoidheight"),
    ),
    "longitude": ("longitude", "lon", "long", "lng", "gpslongitude"),
    "latitude": ("latitude", "lat", "gpslatitude"),
    "yaw": ("yaw", "heading", "gimbalyawdegree"),
    "pitch": ("pitch", "gimbalpitchdegree"),
    "roll": ("roll", "gimbalrolldegree"),
    "longitude_ref": ("gpslongituderef",),
    "latitude_ref": ("gpslatituderef",),
    "sigma_x": ("sigma_x", "accuracy_x", "accuracy_x/y", "accuracy_x/y/z", "accuracy_horz", "hacc"),
    "sigma_y": ("sigma_y", "accuracy_y", "accuracy_x/y", "accuracy_x/y/z", "accuracy_horz", "hacc"),
    "sigma_z": ("sigma_z", "accuracy_z", "accuracy_x/y/z", "accuracy_vert", "vacc"),
}
"""What a column is, and its names; where several are there, the first counts."""
POSE = ("x", "y", "z", "longitude", "latitude", "yaw", "pitch", "roll", "omega", "phi", "kappa")
_OWN_NAMES = (
    *("omega", "phi", "kappa", "qw", "qx", "qy", "qz", "enable", "tx", "ty", "tz"),
    *(f"r{i}{j}" for i in "123" for j in "123"),
    *("f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2"),
    *(f"{role}_est" for role in POSE),
)
SPELLINGS |= {name: (name,) for name in _OWN_NAMES}
POSITION = {"label", "x", "y", "z", "longitude", "latitude", "tx", "ty", "tz"}
POSITION |= {"x_est", "y_est", "z_est"}
EXIF = ("gpslongitude", "gpslatitude", "gpsaltitude")
MANY = ("label", *(f"sigma_{axis}" for axis in "xyz"))  # the first spelling counts

CRS_COMMENT = re.compile(r"^#\s*(?:coordinatesystem|crs)\s*[:=]\s*(.+)$", re.IGNORECASE)
_FARTHEST_HEADER = 20


class Header(NamedTuple):
    """A line that may be a header: its number from 0, names, their units, whether a comment."""

    at: int
    names: list[str]
    units: list[str]
    comment: bool


def headers(lines: Sequence[str]) -> Iterator[Header]:
    """Yield the lines that may be a header."""
    for i, line in enumerate(lines[:_FARTHEST_HEADER]):
        comment = line.lstrip("\"' ").startswith("#")
        text = line.strip().lstrip("#").strip() if comment else line.strip()
        if not text or CRS_COMMENT.match(line):
            continue
        found = [_split_unit(name) for name in split_header(text)[0]]
        yield Header(i, [name for name, _ in found], [unit for _, unit in found], comment)
        if not comment:
            return


def axes(place: Iterable[str], suffix: str = "") -> tuple[str, str, str] | None:
    """Return the three columns of a position: x, y, z or longitude, latitude, z."""
    for first, second in (("x", "y"), ("longitude", "latitude")):
        three = (first + suffix, second + suffix, "z" + suffix)
        if {*three} <= {*place}:
            return three
    return None


def is_header(names: Sequence[str]) -> bool:
    """Whether at least two of the names that every table of cameras has are among these."""
    return len(POSITION & places(names, SPELLINGS).keys()) >= 2


def _split_unit(name: str) -> tuple[str, str]:
    """Return the name of a column and its unit: omega[deg], accuracy_x_(m).

    Of X/Longitude it is the name that says more.
    """
    plain = name.lstrip("# \"'").lower()
    name, unit = (plain, "") if plain in _PLAIN else split_unit(plain, "m|deg|gon|rad")
    axis, slash, kind = name.partition("/")
    more = slash and axis in ("x", "y", "z") and kind in _PLAIN
    return kind if more else name, unit


_PLAIN = {spelling for spellings in SPELLINGS.values() for spelling in spellings}


def column_missing(path: Path, missing: Sequence[str], header: Sequence[str]) -> InputError:
    """Return the error for a table that lacks columns."""
    sentence = f"the header lacks {', '.join(missing)}; it has {', '.join(header)}."
    return bad_file(path, "table.column_missing", sentence, columns=list(missing))


DEGREES = {
    **dict.fromkeys(("", "deg", "degree", "degrees", "°"), 1.0),
    **dict.fromkeys(("gon", "gons", "grad", "grads"), 0.9),
    **dict.fromkeys(("rad", "radian", "radians"), 180.0 / np.pi),
}
METRES = dict.fromkeys(("", "m", "metre", "metres", "meter", "meters"), 1.0)
LENGTHS = ("x", "y", "z", "sigma_x", "sigma_y", "sigma_z")


@dataclass(frozen=True)
class Columns:
    """A table whose columns are known; its header has their names, lower case, without units.

    `place` leads from what a column is, a key of `SPELLINGS`, to its number; `unit` is that of each
    column as the header has it; the header is a comment where `after_hash`; `crs` is what a comment
    says.
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
        labels = self.table.column(self.name("label"))
        if "" in labels:
            line = self.table.line[labels.index("")]
            sentence = f"line {line}: the image has no name. Give it one."
            raise bad_file(self.path, "table.no_label", sentence, line=line)
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

    def error(self, row: int, code: str, sentence: str, **values: Any) -> InputError:
        """Return an error that names file, line and image."""
        return InputError(code, f"{self.where(row)}: {sentence}", path=self.path, **values)

    def _numbers(self, role: str, *, needed: bool) -> FloatArray:
        if role not in self.place:
            return np.full(len(self.table.rows), np.nan)
        texts = [row[self.place[role]] for row in self.table.rows]
        read = exif_number if self.name(role) in EXIF else number
        values = np.array([read(text) for text in texts])
        for i in np.flatnonzero(~np.isfinite(values)):
            if needed or texts[i]:
                name, line = self.name(role), self.table.line[i]
                sentence = f"column {name}: '{texts[i]}' is not a finite number. Correct it."
                raise self.error(int(i), "table.number", sentence, line=line, value=texts[i])
        base, unit = role.removesuffix("_est"), self.unit[self.place[role]]
        if base not in (*LENGTHS, *POSE):
            return values
        known, wanted = (METRES, "metres") if base in LENGTHS else (DEGREES, "degrees")
        if unit not in known:
            sentence = f"column {self.name(role)} is in '{unit}'. Give {wanted}."
            raise bad_file(self.path, "table.unit", sentence, value=unit)
        return values * known[unit]


def read_columns(path: Path) -> Columns:
    """Read a table with a header line, which may be a comment."""
    lines = read_lines(path)
    found = [header for header in headers(lines) if is_header(header.names)]
    if not found:
        sentence = "no line names the columns, for example label,x,y,z,omega,phi,kappa."
        raise bad_file(path, "table.no_header", sentence)
    at, names, unit, comment = found[-1]
    place = places(names, SPELLINGS)
    for role, spellings in SPELLINGS.items():  # a column with the role's own name counts
        alike = [name for name in names if name in spellings]
        if len(alike) > 1 and role not in MANY and (role not in alike or alike.count(role) > 1):
            sentence = f"the columns {', '.join(alike)} may all be {role}. Take out all but one."
            raise bad_file(path, "table.columns_alike", sentence, columns=alike)
    if {"tx", "ty", "tz"} <= place.keys() and axes(place) is None:
        sentence = "tx, ty, tz may be translations. Give the projection centres as x, y, z."
        raise bad_file(path, "table.translations", sentence)
    if "label" not in place or not (axes(place) or axes(place, "_est")):
        position = ("longitude", "latitude", "z") if "longitude" in place else ("x", "y", "z")
        lacking = [role for role in ("label", *position) if role not in place]
        raise column_missing(path, lacking, names)
    comments = comment or any(line.startswith("#") for line in lines[:at])
    below = next((line for line in lines[at + 1 :] if line.strip() and line[0] != "#"), "")
    delimiter = split_header((below if comment else lines[at]).strip())[1]
    table = table_below(path, lines, names, delimiter, at=at, comments=comments)
    crs = next(
        (match[1].strip() for line in lines[:at] if (match := CRS_COMMENT.match(line))), None
    )
    return Columns(table, place, unit, comment, crs)


def exif_number(text: str) -> float:
    """Return the number in what exiftool writes: 24 deg 40' 48.5" S, 86.5 m Below Sea Level."""
    parts = [number(part) for part in re.findall(r"[\d.]+", text)]
    if "deg" not in text and "Sea Level" not in text:
        return number(text)
    if not 1 <= len(parts) <= 3:
        return np.nan
    value = math.fsum(part / 60.0**i for i, part in enumerate(parts))
    return -value if text.endswith(("S", "W")) or "Below" in text else value

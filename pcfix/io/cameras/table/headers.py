"""The header of a table of cameras, which names its columns in many ways."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

from pcfix.errors import InputError
from pcfix.io.tables import split_header

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

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
    **{name: (name,) for name in ("omega", "phi", "kappa", "qw", "qx", "qy", "qz", "enable")},
    "longitude_ref": ("gpslongituderef",),
    "latitude_ref": ("gpslatituderef",),
    **{name: (name,) for name in ("tx", "ty", "tz", "alpha", "nu")},
    **{f"r{i}{j}": (f"r{i}{j}",) for i in "123" for j in "123"},
    **{name: (name,) for name in ("f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")},
    "sigma_x": ("sigma_x", "accuracy_x", "accuracy_x/y", "accuracy_x/y/z", "accuracy_horz", "hacc"),
    "sigma_y": ("sigma_y", "accuracy_y", "accuracy_x/y", "accuracy_x/y/z", "accuracy_horz", "hacc"),
    "sigma_z": ("sigma_z", "accuracy_z", "accuracy_x/y/z", "accuracy_vert", "vacc"),
}
"""What a column is, and its names; where several are there, the first counts."""
POSE = ("x", "y", "z", "longitude", "latitude", "yaw", "pitch", "roll", "omega", "phi", "kappa")
SPELLINGS |= {f"{role}_est": (f"{role}_est",) for role in POSE}
POSITION = {"label", "x", "y", "z", "longitude", "latitude", "tx", "ty", "tz"}
POSITION |= {"x_est", "y_est", "z_est"}
EXIF = ("gpslongitude", "gpslatitude", "gpsaltitude")
MANY = ("label", *(f"sigma_{axis}" for axis in "xyz"))  # the first spelling counts

_UNIT = re.compile(r"^(.*?)[ _]*[\[(]([^\])]*)[\])]$|^(.*)_(m|deg|gon|rad)$")
CRS_COMMENT = re.compile(r"^#\s*(?:coordinatesystem|crs)\s*[:=]\s*(.+)$", re.IGNORECASE)
_FARTHEST_HEADER = 20


class Header(NamedTuple):
    """A line that may be a header: its number from 0, names, their units, whether a comment."""

    at: int
    names: list[str]
    units: list[str]
    comment: bool


def known(names: Sequence[str]) -> dict[str, int]:
    """Return what each column is, from its names without units."""
    place = {}
    for role, spellings in SPELLINGS.items():
        for spelling in spellings:
            if spelling in names:
                place[role] = names.index(spelling)
                break
    return place


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
    return len(POSITION & known(names).keys()) >= 2


def _split_unit(name: str) -> tuple[str, str]:
    """Return the name of a column and its unit: omega[deg], accuracy_x_(m), X/Easting."""
    name = name.lstrip("# \"'").lower()
    match = None if name in _PLAIN else _UNIT.match(name)
    if match:
        name, unit = (match[1], match[2]) if match[3] is None else (match[3], match[4])
    else:
        unit = ""
    return _one_of_alternatives(name.strip().replace(" ", "_")), unit.strip()


def _one_of_alternatives(name: str) -> str:
    """Return what X/Longitude is: the name that says more."""
    axis, slash, kind = name.partition("/")
    return kind if slash and axis in ("x", "y", "z") and kind in _PLAIN else name


_PLAIN = {spelling for spellings in SPELLINGS.values() for spelling in spellings}


def refuse_two_of_a_kind(path: Path, line: int, names: list[str]) -> None:
    """Refuse easting beside east; a column that is called by the role's own name counts."""
    for role, spellings in SPELLINGS.items():
        there = [name for name in names if name in spellings]
        if len(there) > 1 and role not in MANY and (role not in there or there.count(role) > 1):
            raise InputError(
                f"{path}: line {line}: the columns {', '.join(there)} may all be {role}; take"
                " out all but one."
            )


def require_position(path: Path, line: int, names: list[str]) -> None:
    """Refuse a header without the name of the image or its position."""
    place = known(names)
    if "label" in place and (axes(place) or axes(place, "_est")):
        return
    if {"tx", "ty", "tz"} <= place.keys() and axes(place) is None:
        raise InputError(
            f"{path}: line {line} has tx, ty, tz, which may be a translation or a projection"
            " centre; give the projection centres as x, y, z."
        )
    needed = ("label", "longitude", "latitude", "z") if "longitude" in place else ("label", *"xyz")
    missing = [role for role in needed if role not in place]
    raise InputError(
        f"{path}: line {line} must name the columns {', '.join(needed)}; {', '.join(missing)}"
        f" missing (it has: {', '.join(names)})."
    )

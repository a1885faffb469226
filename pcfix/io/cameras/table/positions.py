"""Where the images of a table are, adjusted or by GNSS, and in which CRS."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.table.columns import Columns, read_columns
from pcfix.io.cameras.table.headers import EXIF, axes
from pcfix.io.files import check_input
from pcfix.io.tables import Table, number, read_lines
from pcfix.model import GnssPositions

if TYPE_CHECKING:
    import os
    from pathlib import Path

    from pcfix.model import FloatArray

WGS84, WGS84_ELLIPSOIDAL = "EPSG:4326", "EPSG:4979"
GEO = ("label", "x", "y", "z", "yaw", "pitch", "roll", "accuracy_horz", "accuracy_vert")
"""Fields of ODM's geo.txt, the last six optional; more may follow."""
_GEO_CRS = re.compile(r"(EPSG:\d+|\+proj=.+|WGS84 UTM (\d\d?)\s*([NS]))\s*", re.IGNORECASE)


def read_gnss(path: str | os.PathLike[str]) -> tuple[tuple[str, ...], GnssPositions]:
    """Read where the GNSS said that images were taken.

    Parameters
    ----------
    path : path
        A table with the columns label, x, y, z or label, longitude, latitude, altitude and,
        where known, sigma_x, sigma_y, sigma_z in metres: a reference table of Metashape (its
        source values), a list by exiftool, or ODM's geo.txt.

    Returns
    -------
    labels : tuple of str, length k
    positions : GnssPositions
        k rows, NaN where an image has no position.

    Raises
    ------
    InputError
        If it is not such a table, or has no position at all.
    """
    columns = open_table(check_input(path))
    positions = gnss_positions(columns)
    if positions is None or np.isnan(positions.xyz).any(axis=1).all():
        raise InputError(
            f"{columns.path}: has no GNSS positions; give a table with the columns label, x, y, z"
            " or label, longitude, latitude, altitude."
        )
    return tuple(columns.labels), positions


def open_table(path: Path) -> Columns:
    """Read a table with a header, or ODM's geo.txt, which has none."""
    lines = read_lines(path)
    return _read_geo(path, lines) if is_geo(lines) else read_columns(path)


def gnss_positions(columns: Columns) -> GnssPositions | None:
    """Return the positions by GNSS, or None where only adjusted ones are there."""
    if axes(columns.place) is None:
        return None
    xyz = centres(columns)
    if columns.has("enable"):
        off = [text == "0" for text in columns.table.column(columns.name("enable"))]
        xyz[off] = np.nan
    sigma = columns.where_there(("sigma_x", "sigma_y", "sigma_z"))
    return GnssPositions(xyz, sigma, crs(columns)[0])


def centres(columns: Columns, suffix: str = "", *, needed: bool = False) -> FloatArray:
    """Return positions, shape (k, 3), NaN for rows without when they are not `needed`."""
    three = axes(columns.place, suffix)
    if three is None:
        return np.full((len(columns.labels), 3), np.nan)
    xyz = columns.of(three) if needed else columns.where_there(three)
    for i, side in enumerate(("longitude", "latitude")):
        if columns.has(f"{side}_ref"):
            texts = columns.table.column(columns.name(f"{side}_ref"))
            beyond = [text[:1].upper() in ("S", "W") for text in texts]
            xyz[beyond, i] = -np.abs(xyz[beyond, i])
    if three[0].startswith("longitude") or _is_geographic(crs(columns)[0]):
        _refuse_impossible_degrees(columns, xyz)
    xyz[np.isnan(xyz).any(axis=1)] = np.nan
    return xyz


def crs(columns: Columns) -> tuple[str | None, tuple[str, ...]]:
    """Return the CRS that a table says or shows, and what to tell about it.

    Longitude and latitude without more are those of WGS 84. Heights then are ellipsoidal only
    if the header calls them so; else the CRS has no heights.
    """
    if columns.crs is None:
        if axes(columns.place) != ("longitude", "latitude", "z"):
            return None, ()
        ellipsoidal = columns.name("z").startswith("ellipsoid")
        return WGS84_ELLIPSOIDAL if ellipsoidal else WGS84, ()
    if columns.crs.startswith("LOCAL_CS"):
        return "local", ()
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        CRS(columns.crs)
    except CRSError:
        note = (
            f"{columns.path}: its coordinate system '{columns.crs[:60]}' is not understood; the"
            " cloud's is assumed."
        )
        return None, (note,)
    return columns.crs, ()


def are_by_gnss(columns: Columns) -> bool:
    """Whether the table shows that its positions are measured, not adjusted."""
    exif = any(name in EXIF for name in columns.table.header)
    return exif or (columns.has("sigma_x") and axes(columns.place, "_est") is None)


def is_geo(lines: list[str]) -> bool:
    """Whether these lines are a CRS and then images, not control points."""
    if not lines or not _GEO_CRS.fullmatch(lines[0]):
        return False
    first = next((line.split() for line in lines[1:] if line.strip()), [])
    return len(first) >= 3 and np.isnan(number(first[0]))


def _read_geo(path: Path, lines: list[str]) -> Columns:
    rows, numbers = [], []
    for i, line in enumerate(lines[1:], start=2):
        fields = line.split()
        if fields and len(fields) < 3:
            raise InputError(f"{path}: line {i} has {len(fields)} fields; give image, x, y, z.")
        if fields:
            rows.append([*fields, *[""] * len(GEO)][: len(GEO)])
            numbers.append(i)
    place = {name: GEO.index(name) for name in ("label", "x", "y", "z")}
    place |= {"sigma_x": 7, "sigma_y": 7, "sigma_z": 8}  # its angles may be 0 for unknown
    table = Table(path, list(GEO), rows, numbers)
    return Columns(table, place, [""] * len(GEO), after_hash=False, crs=_geo_crs(lines[0]))


def _geo_crs(line: str) -> str:
    found = _GEO_CRS.fullmatch(line)
    if found is None or found[2] is None:
        return line.strip()
    return f"EPSG:32{'6' if found[3].upper() == 'N' else '7'}{int(found[2]):02d}"


def _is_geographic(name: str | None) -> bool:
    if name is None or name == "local":
        return False
    from pyproj import CRS

    return bool(CRS(name).is_geographic)


def _refuse_impossible_degrees(columns: Columns, xyz: FloatArray) -> None:
    for i, (longitude, latitude) in enumerate(xyz[:, :2]):
        if abs(latitude) > 90.0 or abs(longitude) > 360.0:
            raise InputError(
                f"{columns.where(i)}: longitude {longitude:g}, latitude {latitude:g} is no place on"
                " earth; are the columns swapped, or metres?"
            )

"""The projected CRS of an OpenDroneMap project."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.model import FloatArray

WHOLE_M = 2e-3
"""Newer ODM puts the origin at whole metres; reference_lla is rounded a little."""

_UTM = re.compile(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)


def named_crs(path: Path) -> str:
    """Return the CRS in the first line of a file: a PROJ string, EPSG:n or WGS84 UTM 16N.

    Raises
    ------
    InputError
        If it names none.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    text = path.read_bytes()[:4096].decode("utf-8-sig", errors="replace").strip()
    line = text.splitlines()[0].strip() if text else ""
    utm = _UTM.match(line)
    crs = _utm_code(int(utm[1]), utm[2].upper() == "N") if utm else line
    try:
        CRS.from_user_input(crs)
    except CRSError as error:
        raise InputError(f"{path}: '{line[:80]}' names no CRS; put its EPSG code there.") from error
    return crs


def whole_metres(lat: float, lon: float, crs: str | None) -> tuple[str, float, float] | None:
    """Return CRS, easting and northing where a reference is at whole metres of both.

    The CRS is the one named, or else UTM, the zone of the reference or one beside it.
    """
    for candidate in [crs] if crs else _zones(lat, lon):
        east, north = _projected(candidate, lon, lat)
        if np.hypot(east - np.round(east), north - np.round(north)) < WHOLE_M:
            return candidate, float(np.round(east)), float(np.round(north))
    return None


def crs_of_place(
    lon: float, lat: float, east: float, north: float, candidates: list[str] | None = None
) -> str | None:
    """Return the CRS (by default a UTM zone) in which a place has these coordinates, to a metre."""
    for candidate in candidates or _zones(lat, lon):
        if np.hypot(*(_projected(candidate, lon, lat) - np.array([east, north]))) < 1.0:
            return candidate
    return None


def from_topocentric(
    xyz: FloatArray, reference: tuple[float, float, float], crs: str
) -> FloatArray:
    """Return topocentric points in a projected CRS, heights on the ellipsoid, shape (n, 3)."""
    from pyproj import Transformer

    lat, lon, height = reference
    local = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={lat!r} +lon_0={lon!r}"
        f" +h_0={height!r} +step +inv +proj=cart +ellps=WGS84"
    )
    geographic = np.column_stack(local.transform(xyz[:, 0], xyz[:, 1], xyz[:, 2]))
    return np.column_stack([_projected(crs, *geographic[:, :2].T).T, geographic[:, 2]])


def _zones(lat: float, lon: float) -> list[str]:
    zone = int((lon + 180.0) // 6.0) if np.isfinite(lon) else 0
    return [_utm_code((zone + step) % 60 + 1, lat >= 0.0) for step in (0, -1, 1)]


def _utm_code(zone: int, north: bool) -> str:
    return f"EPSG:{(32600 if north else 32700) + zone}"


def _projected(crs: str, lon: float | FloatArray, lat: float | FloatArray) -> FloatArray:
    from pyproj import Transformer

    return np.array(Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat))

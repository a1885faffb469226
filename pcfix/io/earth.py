"""Frames that are not maps: axes through the centre of the earth, and axes at a place on it."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.crs import shortened

if TYPE_CHECKING:
    from typing import Any

    from pyproj import CRS

    from pcfix.model import FloatArray

GEOCENTRIC_WGS84, GEOGRAPHIC_WGS84 = "EPSG:4978", "EPSG:4979"


def geographic_3d(crs: CRS) -> CRS:
    """Return longitude, latitude and ellipsoidal height on the datum of a geocentric CRS."""
    from pyproj import CRS

    found = CRS.from_json_dict(_geographic(crs.to_json_dict()))
    code = found.to_epsg(min_confidence=100)
    return found if code is None else CRS.from_epsg(code)


def _geographic(geocentric: dict[str, Any]) -> dict[str, Any]:
    """Return PROJJSON with the axes of a geographic CRS instead of a geocentric one's."""
    if "source_crs" in geocentric:
        return {**geocentric, "source_crs": _geographic(geocentric["source_crs"])}
    kept = {k: v for k, v in geocentric.items() if k in ("$schema", "name")}
    kept |= {k: v for k, v in geocentric.items() if k in ("datum", "datum_ensemble")}
    axes = (
        ("Geodetic latitude", "Lat", "north", "degree"),
        ("Geodetic longitude", "Lon", "east", "degree"),
        ("Ellipsoidal height", "h", "up", "metre"),
    )
    words = ("name", "abbreviation", "direction", "unit")
    system = {"subtype": "ellipsoidal", "axis": [dict(zip(words, a, strict=True)) for a in axes]}
    return {**kept, "type": "GeographicCRS", "coordinate_system": system}


def is_topocentric(text: str) -> bool:
    """Whether a text names axes east, north, up at a place."""
    return text.strip().upper().startswith("ENU:")


@dataclass(frozen=True, slots=True)
class Topocentric:
    """Axes east, north, up at a place on the ellipsoid of WGS 84; degrees and metres."""

    latitude_deg: float
    longitude_deg: float
    height_m: float

    @classmethod
    def from_text(cls, text: str, name: str) -> Topocentric:
        """Read ``ENU:latitude,longitude,height``; the height may be left out and is then 0.

        Raises
        ------
        InputError
            If these are not two or three numbers, or no place on the earth.
        """
        try:
            numbers = [float(word) for word in text.partition(":")[2].split(",")]
        except ValueError:
            numbers = []
        if len(numbers) == 2:
            numbers.append(0.0)
        if len(numbers) != 3 or not all(isfinite(number) for number in numbers):
            raise InputError(
                f"{name}: '{shortened(text)}' is not ENU:latitude,longitude,height in degrees and"
                " metres."
            )
        if abs(numbers[0]) > 90.0 or abs(numbers[1]) > 360.0:
            raise InputError(
                f"{name}: the origin {shortened(text)} is not on the earth; give latitude, then"
                " longitude, in degrees."
            )
        return cls(*numbers)

    def to_geocentric(self, enu: FloatArray) -> FloatArray:
        """Return geocentric coordinates (EPSG:4978) of points (n, 3), metres."""
        from pyproj import Transformer

        to_geocentric = Transformer.from_crs(GEOGRAPHIC_WGS84, GEOCENTRIC_WGS84, always_xy=True)
        place = self.longitude_deg, self.latitude_deg, self.height_m
        return np.asarray(to_geocentric.transform(*place)) + enu @ self._axes()

    def _axes(self) -> FloatArray:
        """Return the directions east, north and up, one a row, in geocentric axes."""
        lon, lat = np.radians([self.longitude_deg, self.latitude_deg])
        up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
        north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
        return np.array([[-np.sin(lon), np.cos(lon), 0.0], north, up])

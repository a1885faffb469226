"""Coordinate reference systems: parse them, and find their parts, units and kind of heights.

Frames that are not maps are here too: axes through the centre of the earth, and axes at a place.

Coordinates are always in the order x (east, longitude), y (north, latitude), z, whatever order of
axes a CRS states.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, Literal

import numpy as np

from pcfix.errors import bad_file
from pcfix.model import FloatArray

if TYPE_CHECKING:
    from pyproj import CRS, Transformer


Heights = Literal["ellipsoidal", "gravity", "unstated"]

METRES = ("metre", "meter")


def parse_crs(given: str | CRS, name: str) -> CRS:
    """Return the CRS of a text: an EPSG code, WKT of any flavour, PROJ string or name.

    `name` is the file or option that gave it, for messages.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    if isinstance(given, CRS):
        return CRS(given)
    text = re.sub(r"^(\w+)::", r"\1:", given.strip())
    try:
        crs = CRS.from_user_input(int(text) if text.isdecimal() else text)
        parts(crs)  # PROJ writes and reads it again, which may fail
    except (CRSError, ValueError, OverflowError) as error:
        shown = shortened(text)
        sentence = f"PROJ does not know the CRS '{shown}'. Give a code such as EPSG:25830+5782."
        raise bad_file(name, "crs.unknown", sentence, value=shown) from error
    if crs.is_vertical and not crs.is_compound and len(crs.axis_info) == 1:
        sentence = f"{crs.name} is a vertical CRS. Add the horizontal one, as EPSG:25830+5782."
        raise bad_file(name, "crs.vertical_only", sentence, crs=crs.name)
    return crs


def is_local(crs: CRS) -> bool:
    """Whether a CRS is not tied to the earth (engineering CRS, LOCAL_CS)."""
    return crs.is_engineering or any(part.is_engineering for part in crs.sub_crs_list)


def parts(crs: CRS) -> tuple[CRS, CRS | None]:
    """Return the horizontal CRS, two axes, and the vertical CRS or None."""
    if crs.is_compound:
        plan, vertical = crs.sub_crs_list[:2]
        return plan, (vertical.source_crs or vertical) if vertical.is_bound else vertical
    if crs.is_bound and crs.source_crs is not None and crs.source_crs.is_compound:
        return parts(crs.source_crs)
    return (crs if crs.is_geocentric else crs.to_2d()), None


def heights_of(crs: CRS) -> Heights:
    """Return whether z is above the ellipsoid, above a vertical datum, or not stated."""
    if parts(crs)[1] is not None:
        return "gravity"
    return "ellipsoidal" if len(crs.axis_info) == 3 else "unstated"


def crs_words(crs: CRS | None) -> tuple[str, str]:
    """Return the horizontal CRS, with its code, and the vertical datum; empty if not stated."""
    if crs is None:
        return "", ""
    plan, vertical = parts(crs)
    code = (plan.to_json_dict() or {}).get("id")
    name = f"{plan.name} ({code['authority']}:{code['code']})" if code else plan.name
    if vertical is not None:
        return name, vertical.name
    return name, "above the ellipsoid" if heights_of(crs) == "ellipsoidal" else ""


def is_same(one: CRS, other: CRS) -> bool:
    """Whether two CRS are the same, whatever their order of axes and their shift to WGS 84."""
    one, other = unbound(one), unbound(other)
    if one.equals(other, ignore_axis_order=True):
        return True
    code = one.to_epsg()
    return code is not None and code == other.to_epsg()


def is_same_vertical_datum(one: CRS, other: CRS) -> bool:
    """Whether two vertical CRS have the same datum, in whatever unit."""
    datums = [crs if crs.datum is None else crs.datum for crs in (one, other)]
    names = ["".join(c for c in datum.name.lower() if c.isalnum()) for datum in datums]
    return is_same(one, other) or (names[0] == names[1] and names[0] not in ("", "unknown"))


def unbound(crs: CRS) -> CRS:
    """Return a CRS without its shift to WGS 84 (TOWGS84)."""
    return crs.source_crs if crs.is_bound and crs.source_crs is not None else crs


def plan_unit(crs: CRS) -> tuple[str, float]:
    """Return name and size of the unit of x and y: metres, or radians of a geographic CRS."""
    axis = crs.axis_info[0]
    return axis.unit_name, axis.unit_conversion_factor


def metres_up(crs: CRS) -> float:
    """Return how many metres up one unit of z is; unstated heights are in the unit of the plan.

    A frame of cameras has one scale, so a projected CRS in feet without a vertical part has its
    heights in feet too. Degrees go with metres.
    """
    vertical = parts(crs)[1]
    if vertical is not None:
        axis = vertical.axis_info[0]
        return axis.unit_conversion_factor * (-1.0 if axis.direction.lower() == "down" else 1.0)
    if len(crs.axis_info) == 3:
        return crs.axis_info[2].unit_conversion_factor
    return 1.0 if crs.is_geographic else plan_unit(crs)[1]


def check_projected_metres(crs: CRS, name: str) -> None:
    """Refuse a cloud that is not in a projected CRS in metres, heights included."""
    units = {axis.unit_name for axis in crs.axis_info}
    if not crs.is_projected or not units.issubset(METRES):
        code = "crs.unit" if crs.is_projected else "crs.not_projected"
        unit = " and ".join(sorted(units))
        sentence = f"{crs.name} is in {unit}. Reproject the cloud to a map in metres, such as UTM."
        raise bad_file(name, code, sentence, crs=crs.name, unit=unit)


def with_heights(plan: CRS, vertical: CRS) -> CRS:
    """Return a horizontal CRS with the datum of a vertical one, heights in metres."""
    from pyproj import CRS
    from pyproj.crs import CompoundCRS, VerticalCRS

    if vertical.axis_info[0].unit_name not in METRES and vertical.datum is not None:
        vertical = VerticalCRS(f"{vertical.datum.name} height", vertical.datum)
    return CRS(CompoundCRS(f"{plan.name} + {vertical.name}", [plan, vertical]))


def crs_text(crs: CRS) -> str:
    """Return the shortest text that names a CRS exactly: its codes, else WKT."""
    whole = _code(crs)
    if whole is not None:
        return ":".join(whole)
    codes = [_code(part) for part in crs.sub_crs_list]
    known = [code[1] for code in codes if code is not None and code[0] == "EPSG"]
    if crs.is_compound and len(known) == len(codes):
        return "EPSG:" + "+".join(known)
    return crs.to_wkt()


def _code(crs: CRS) -> tuple[str, str] | None:
    """Return authority and code that a CRS states; a search for one that fits takes long."""
    given = crs.to_json_dict().get("id")
    return None if given is None else (str(given["authority"]), str(given["code"]))


def typed(crs: CRS) -> str:
    """Return the code of a CRS, or that of an equal one, for messages."""
    found = _code(crs) or crs.to_authority(min_confidence=70)
    return ":".join(found) if found else f"'{crs.name}'"


def shortened(text: str) -> str:
    """Return a text on one line that fits into a message."""
    text = " ".join(text.split())
    return text if len(text) <= 60 else f"{text[:57]}..."


GEOCENTRIC_WGS84, GEOGRAPHIC_WGS84 = "EPSG:4978", "EPSG:4979"


def geographic_3d(crs: CRS) -> CRS:
    """Return longitude, latitude and ellipsoidal height on the datum of a geocentric CRS."""
    from pyproj import CRS
    from pyproj.crs import BoundCRS, GeographicCRS
    from pyproj.crs.coordinate_system import Ellipsoidal3DCS
    from pyproj.crs.enums import Ellipsoidal3DCSAxis

    if crs.is_bound and crs.source_crs is not None:
        bound = BoundCRS(geographic_3d(crs.source_crs), crs.target_crs, crs.coordinate_operation)
        return CRS(bound)  # to_2d of pyproj's own subclasses fails
    axes = Ellipsoidal3DCS(Ellipsoidal3DCSAxis.LATITUDE_LONGITUDE_HEIGHT)
    found = GeographicCRS(crs.name, crs.datum, axes)
    code = found.to_epsg(min_confidence=100)
    return CRS(found) if code is None else CRS.from_epsg(code)


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
        """Read ``ENU:latitude,longitude,height``; without a height it is 0."""
        try:
            latitude, longitude, *height = map(float, text.partition(":")[2].split(","))
            numbers = latitude, longitude, *(height or [0.0])
            if len(numbers) != 3 or not all(map(isfinite, numbers)):
                raise ValueError
            if abs(latitude) > 90.0 or abs(longitude) > 360.0:
                raise ValueError
        except ValueError:
            sentence = f"'{shortened(text)}' is not ENU:latitude,longitude,height in degrees."
            raise bad_file(name, "crs.origin", sentence, value=text) from None
        return cls(*numbers)

    def to_geocentric(self, enu: FloatArray) -> FloatArray:
        """Return geocentric coordinates (EPSG:4978) of points (n, 3), metres."""
        x, y, z = enu.T
        return np.column_stack(self._axes().transform(x, y, z, direction="INVERSE"))

    def from_degrees(self, degrees: FloatArray) -> FloatArray:
        """Return the coordinates here of longitudes, latitudes and heights, shape (n, 3)."""
        from pyproj import Transformer

        to_geocentric = Transformer.from_crs(GEOGRAPHIC_WGS84, GEOCENTRIC_WGS84, always_xy=True)
        return np.column_stack(self._axes().transform(*to_geocentric.transform(*degrees.T)))

    def _axes(self) -> Transformer:
        """Return the transformer from geocentric coordinates to the axes here."""
        from pyproj import Transformer

        at = f"+lat_0={self.latitude_deg!r} +lon_0={self.longitude_deg!r} +h_0={self.height_m!r}"
        return Transformer.from_pipeline(f"+proj=topocentric +ellps=WGS84 {at}")

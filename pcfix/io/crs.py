"""Coordinate reference systems: parse, compare and transform; their parts, units and heights.

Frames that are not maps are here too: axes through the centre of the earth, and axes at a place.

Coordinates are always in the order x (east, longitude), y (north, latitude), z, whatever order of
axes a CRS states.

PROJ uses a ballpark transformation if the grid of a better one is not installed: heights then stay
unchanged, some 50 m off, and horizontal datums are treated as one. Here that is an error which
names the grid, or a note. Heights are shifted only if both sides state their datum.
"""

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, Literal

import numpy as np

from pcfix.errors import InputError, PcfixWarning, bad_file, warn
from pcfix.model import FloatArray

if TYPE_CHECKING:
    from pyproj import CRS

METRES = ("metre", "meter")


def parse_crs(given: "str | CRS", name: str) -> "CRS":
    """Return the CRS of a text: an EPSG code, WKT of any flavour, PROJ string or name.

    ``local``, and axes east, north, up at a place, are not tied to the earth; see `is_local`. The
    `name` is that of the file or option that gave the text, for messages.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    if isinstance(given, CRS):
        return CRS(given)
    text = re.sub(r"^(\w+)::", r"\1:", given.strip())
    if text.lower() == LOCAL or is_topocentric(text):
        text = 'LOCAL_CS["local axes",LOCAL_DATUM["local",0],UNIT["metre",1]]'
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


def is_local(crs: "CRS") -> bool:
    """Whether a CRS is not tied to the earth (engineering CRS, LOCAL_CS)."""
    return crs.is_engineering or any(part.is_engineering for part in crs.sub_crs_list)


def parts(crs: "CRS") -> "tuple[CRS, CRS | None]":
    """Return the horizontal CRS, two axes, and the vertical CRS or None."""
    if crs.is_compound:
        plan, vertical = crs.sub_crs_list[:2]
        return plan, (vertical.source_crs or vertical) if vertical.is_bound else vertical
    if crs.is_bound and crs.source_crs is not None and crs.source_crs.is_compound:
        return parts(crs.source_crs)
    return (crs if crs.is_geocentric else crs.to_2d()), None


def heights_of(crs: "CRS") -> Literal["ellipsoidal", "gravity", "unstated"]:
    """Return whether z is above the ellipsoid, above a vertical datum, or not stated."""
    if parts(crs)[1] is not None:
        return "gravity"
    return "ellipsoidal" if len(crs.axis_info) == 3 else "unstated"


def crs_words(crs: "CRS | None") -> tuple[str, str]:
    """Return the horizontal CRS, with its code, and the vertical datum; empty if not stated."""
    if crs is None:
        return "", ""
    plan, vertical = parts(crs)
    code = _code(plan)
    name = f"{plan.name} ({':'.join(code)})" if code else plan.name
    if vertical is not None:
        return name, vertical.name
    return name, "above the ellipsoid" if heights_of(crs) == "ellipsoidal" else ""


def is_same(one: "CRS", other: "CRS") -> bool:
    """Whether two CRS are the same, whatever their order of axes and their shift to WGS 84."""
    one, other = unbound(one), unbound(other)
    if one.equals(other, ignore_axis_order=True):
        return True
    code = one.to_epsg()
    return code is not None and code == other.to_epsg()


def unbound(crs: "CRS") -> "CRS":
    """Return a CRS without its shift to WGS 84 (TOWGS84)."""
    return crs.source_crs if crs.is_bound and crs.source_crs is not None else crs


def plan_unit(crs: "CRS") -> tuple[str, float]:
    """Return name and size of the unit of x and y: metres, or radians of a geographic CRS."""
    axis = crs.axis_info[0]
    return axis.unit_name, axis.unit_conversion_factor


def metres_up(crs: "CRS") -> float:
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


def check_projected_metres(crs: "CRS", name: str) -> None:
    """Refuse a cloud that is not in a projected CRS in metres, heights included."""
    units = {axis.unit_name for axis in crs.axis_info}
    if not crs.is_projected or not units.issubset(METRES):
        code = "crs.unit" if crs.is_projected else "crs.not_projected"
        unit = " and ".join(sorted(units))
        sentence = f"{crs.name} is in {unit}. Reproject the cloud to a map in metres, such as UTM."
        raise bad_file(name, code, sentence, crs=crs.name, unit=unit)


def with_heights(plan: "CRS", vertical: "CRS") -> "CRS":
    """Return a horizontal CRS with the datum of a vertical one, heights in metres."""
    from pyproj import CRS
    from pyproj.crs import CompoundCRS, VerticalCRS

    if vertical.axis_info[0].unit_name not in METRES and vertical.datum is not None:
        vertical = VerticalCRS(f"{vertical.datum.name} height", vertical.datum)
    return CRS(CompoundCRS(f"{plan.name} + {vertical.name}", [plan, vertical]))


def crs_text(crs: "CRS") -> str:
    """Return the shortest text that names a CRS exactly: its codes, else WKT."""
    own = _code(crs)
    if own is not None:
        return ":".join(own)
    codes = [_code(part) for part in crs.sub_crs_list]
    known = [code[1] for code in codes if code is not None and code[0] == "EPSG"]
    if crs.is_compound and len(known) == len(codes):
        return "EPSG:" + "+".join(known)
    return crs.to_wkt()


def _code(crs: "CRS") -> tuple[str, str] | None:
    """Return authority and code that a CRS states; a search for one that fits takes long."""
    given = crs.to_json_dict().get("id")
    return None if given is None else (str(given["authority"]), str(given["code"]))


def shortened(text: str) -> str:
    """Return a text on one line that fits into a message."""
    text = " ".join(text.split())
    return text if len(text) <= 60 else f"{text[:57]}..."


LOCAL = "local"


def geographic_3d(crs: "CRS") -> "CRS":
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
    def from_text(cls, text: str, name: str) -> "Topocentric":
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

    def to_degrees(self, enu: FloatArray) -> FloatArray:
        """Return longitudes, latitudes and ellipsoidal heights (EPSG:4979) of points (n, 3)."""
        from pyproj import Transformer

        at = f"+lat_0={self.latitude_deg!r} +lon_0={self.longitude_deg!r} +h_0={self.height_m!r}"
        geocentric = "+step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84"
        step = Transformer.from_pipeline(
            f"+proj=pipeline {geocentric} +step +proj=topocentric +ellps=WGS84 {at}"
        )
        x, y, z = enu.T
        return np.column_stack(step.transform(x, y, z, direction="INVERSE"))


Move = Callable[[FloatArray], FloatArray]  # takes points, shape (n, 3), from one CRS to another


def unchanged(xyz: FloatArray) -> FloatArray:
    """Return points as they are: the transformation between CRS with the same numbers."""
    return xyz


class HeightsError(InputError):
    """Heights of two systems that cannot be transformed into each other."""


def transformation(
    source: "CRS", target: "CRS", at: FloatArray, name: str, *, heights: bool, instead: str = ""
) -> tuple[Move, tuple[PcfixWarning, ...]]:
    """Return PROJ's best transformation that is not a ballpark where that matters, and notes.

    It is `unchanged` if points have the same numbers in both CRS. With `heights` it transforms
    these too; else it is one in plan, and heights only change their unit, and neither CRS may be
    geocentric. It takes points (n, 3), x east or longitude first; numbers that it returns are not
    finite where there is no such place. It is needed at places (n, 3) of `source`. A
    `HeightsError`, with the remedy `instead`, if heights cannot be transformed.
    """
    from pyproj import Transformer
    from pyproj.exceptions import ProjError
    from pyproj.transformer import AreaOfInterest, TransformerGroup

    factor = metres_up(source) / metres_up(target)
    if not heights:
        source, target = parts(source)[0], parts(target)[0]
        if is_same(source, target):
            return unchanged if factor == 1.0 else lambda xyz: xyz * [1.0, 1.0, factor], ()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a missing grid is named in the error or note
            to_degrees = Transformer.from_crs(parts(source)[0], "EPSG:4326", always_xy=True)
            corners = *at[:, :2].min(axis=0), *at[:, :2].max(axis=0)
            degrees = np.array(to_degrees.transform_bounds(*corners))
            degrees += [-0.01, -0.01, 0.01, 0.01]  # a margin west, south, east and north
            area = AreaOfInterest(*degrees) if np.isfinite(degrees).all() else None
            group = TransformerGroup(source, target, always_xy=True, area_of_interest=area)
    except (ProjError, IndexError) as error:  # the latter if PROJ finds no operation at all
        sentence = f"PROJ cannot transform {source.name} to {target.name}. Give another CRS."
        raise bad_file(name, "crs.no_transformation", sentence) from error

    def is_usable(description: str) -> bool:
        return not (heights and "ballpark vertical" in description.lower())

    real = [one for one in group.transformers if is_usable(one.description)]
    # of the better operations, the one that lacks the fewest grids
    lacking = [
        [grid.short_name for grid in one.grids if not grid.available]
        for one in group.unavailable_operations
        if is_usable(one.name)
    ]
    grids: list[str] = min(filter(None, lacking), key=len, default=[])
    names = f"from {source.name} to {target.name}"
    commands = " && ".join(f"pyproj sync --file {grid}" for grid in grids)
    why = f"Install the grid with '{commands}', or set PROJ_NETWORK=ON"
    why = why if grids else "PROJ knows no transformation between them"
    if not real:
        remedy = f"; {instead}." if instead else "."
        sentence = f"{name}: heights cannot be transformed {names}. {why}{remedy}"
        raise HeightsError("crs.heights", sentence, grids=grids)
    step = next((one for one in real if np.isfinite(one.transform(*at.T)).all()), real[0])
    notes: tuple[PcfixWarning, ...] = ()
    if "ballpark geographic" in step.description.lower():
        if grids:
            sentence = f"cannot be transformed {names}. {why}."
            raise bad_file(name, "crs.grid_missing", sentence, grids=grids)
        sentence = f"{name}: PROJ knows no transformation {names}; their datums are treated as one."
        notes = (PcfixWarning("crs.datum", sentence),)
    elif step.accuracy > 1.0:
        sentence = f"{name}: positions {names} are accurate to about {step.accuracy:g} m."
        sentence += f" {why}." if grids else ""
        notes = (PcfixWarning("crs.accuracy", sentence, accuracy_m=step.accuracy, grids=grids),)

    def forward(xyz: FloatArray) -> FloatArray:
        if heights:
            return np.column_stack(step.transform(*xyz.T))
        return np.column_stack([*step.transform(xyz[:, 0], xyz[:, 1]), factor * xyz[:, 2]])

    return forward, notes


def heights_agree(source: "CRS", target: "CRS") -> bool:
    """Whether heights need no change: one datum, or one side does not state which."""
    kinds = heights_of(source), heights_of(target)
    if "unstated" in kinds:
        return True
    (plan, vertical), (other_plan, other) = parts(source), parts(target)
    if vertical is not None and other is not None:  # one datum may be in different units
        datums = [crs if crs.datum is None else crs.datum for crs in (vertical, other)]
        one, two = ("".join(c for c in d.name.lower() if c.isalnum()) for d in datums)
        return is_same(vertical, other) or (one == two and one not in ("", "unknown"))
    return kinds[0] == kinds[1] and is_same(plan, other_plan)


def assumed_heights(source: "CRS", target: "CRS") -> str:
    """Return in words what is assumed if one of two CRS names no vertical datum, else nothing."""
    kinds = heights_of(source), heights_of(target)
    if kinds[0] == "unstated" != kinds[1]:
        return f"names no vertical datum; that of the cloud is assumed ({target.name})."
    if kinds == ("ellipsoidal", "unstated"):
        return f"the cloud's CRS ({target.name}) names no vertical datum; ellipsoidal is assumed."
    return ""


def to_cloud_crs(
    crs: "str | CRS | None",
    cloud_crs: "str | CRS | None",
    at: FloatArray,
    name: str,
    *,
    heights: bool,
) -> Move:
    """Return the transformation from a file's CRS to the cloud's, and warn of guesses.

    It is `unchanged` if the numbers do not change. A CRS that is None is not stated; that of the
    file is ``local`` to use its numbers as they are. The cloud's is projected, in metres. With
    `heights` z matters.
    """
    cloud = None if cloud_crs is None else parse_crs(cloud_crs, "the cloud")
    if isinstance(crs, str) and crs.strip().lower() == LOCAL:
        return unchanged
    source = None if crs is None else parse_crs(crs, name)
    if all(one is None or is_local(one) for one in (source, cloud)):
        return unchanged
    known = cloud or source
    if source is None or cloud is None:
        unit, size = ("", 1.0) if source is None else plan_unit(source)
        if source is not None and (size != 1.0 or not source.is_projected):
            sentence = f"is in {unit} ({source.name}), the cloud names no CRS. Set the cloud's CRS."
            raise bad_file(name, "crs.cloud_missing", sentence, unit=unit)
        who = "the file" if source is None else "the cloud"
        warn(name, "crs.assumed", f"{who} names no CRS; {known.name if known else ''} is assumed.")
        return unchanged
    if is_local(cloud) or is_local(source):
        sentence = f"is in {source.name}, the cloud in {cloud.name}, of which one is local. Use one"
        raise bad_file(name, "crs.local", f"{sentence} CRS, or give that of the file as 'local'.")
    check_projected_metres(cloud, "the cloud")
    if not (source.is_projected or source.is_geographic):
        sentence = f"{source.name} is neither a map projection nor in degrees."
        raise bad_file(name, "crs.not_projected", sentence, crs=source.name)
    if heights and (sentence := assumed_heights(source, cloud)):
        warn(name, "crs.heights_assumed", sentence)
    heights = heights and not heights_agree(source, cloud)
    plan = shortened(crs_text(parts(source)[0]))
    instead = f"or, if the heights agree with the cloud's, give the file's CRS as {plan}"
    forward, notes = transformation(source, cloud, at, name, heights=heights, instead=instead)
    for note in notes:
        warnings.warn(note, stacklevel=3)
    return forward

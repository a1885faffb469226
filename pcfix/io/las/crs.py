"""The coordinate system that a cloud states."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcfix.errors import InputError
from pcfix.io.las.source import las_errors

if TYPE_CHECKING:
    from pyproj import CRS

    from pcfix.io.las.source import LasSource

_METRES = ("metre", "meter")


def metric_crs(source: LasSource) -> CRS | None:
    """Return the coordinate system of a cloud in metres, or None if it states none.

    Raises
    ------
    InputError
        If its plan coordinates are in degrees, feet or another unit.
    """
    from pyproj.exceptions import CRSError

    try:
        with las_errors(source.path):
            crs: CRS | None = source.header.parse_crs()
    except CRSError as error:
        raise InputError(
            f"{source.path}: its coordinate system cannot be read ({error}); set it again."
        ) from error
    if crs is None:
        return None
    units = {axis.unit_name for axis in crs.axis_info[:2]}
    if not units.issubset(_METRES):
        raise InputError(
            f"{source.path}: its coordinate system {crs.name} is in {' and '.join(sorted(units))};"
            " reproject the cloud to one in metres first."
        )
    return crs

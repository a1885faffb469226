"""Adjusted projection centres against the positions of the GNSS."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.frames import frame_of
from pcfix.io.cameras.georeference import georeference
from pcfix.io.cameras.heights import is_tied
from pcfix.io.crs import (
    METRES,
    crs_text,
    heights_of,
    is_topocentric,
    parse_crs,
    parts,
    unbound,
    with_heights,
)
from pcfix.io.transformations import HeightsError
from pcfix.model import Cameras, FloatArray, GnssPositions

if TYPE_CHECKING:
    from pyproj import CRS


@dataclass(frozen=True, eq=False)
class GnssDifferences:
    """Adjusted centres minus positions of the GNSS.

    Attributes
    ----------
    enu_m : array, shape (k, 3)
        East, north, up in metres, in the axes of the cameras' map where they are in one; NaN
        where a camera has no position, or where the two cannot be compared.
    reason : str
        Why some or all of it cannot be compared; empty where all of it is.
    """

    enu_m: FloatArray
    reason: str = ""


def adjusted_minus_gnss(cameras: Cameras, name: str = "cameras") -> GnssDifferences:
    """Return how far the adjusted centres are from where the GNSS said that they were.

    Parameters
    ----------
    cameras : Cameras
        As read or in the cloud's CRS.
    name : str
        Of their file, for messages.

    Returns
    -------
    GnssDifferences
        Without `up` where the heights of the two belong to systems that cannot be compared.
    """
    gnss, nothing = cameras.gnss, np.full((len(cameras), 3), np.nan)
    if gnss is None:
        return GnssDifferences(nothing, f"{name}: has no positions of the GNSS.")
    if gnss.crs is None or gnss.crs == cameras.crs:
        return _of_one_frame(cameras, gnss, name)
    if not is_tied(cameras.crs, name) or not is_tied(gnss.crs, name):
        return GnssDifferences(
            nothing,
            f"{name}: positions of the GNSS and adjusted centres are not both tied to the earth,"
            " so they cannot be compared.",
        )
    reason = _heights_unknown(cameras.crs or "", gnss.crs, name)
    try:
        if not reason:
            return GnssDifferences(_differences(cameras, gnss, name))
    except HeightsError as error:
        reason = str(error).partition("; or, if")[0] + "; only plan is compared."
    flat = replace(gnss, crs=_in_plan(gnss.crs, name))
    found = _differences(replace(cameras, crs=_in_plan(cameras.crs or "", name)), flat, name)
    return GnssDifferences(found * [1.0, 1.0, np.nan], reason)


def _of_one_frame(cameras: Cameras, gnss: GnssPositions, name: str) -> GnssDifferences:
    """Return the differences where both are in one frame, or the GNSS's is taken to be that."""
    difference = cameras.centres - gnss.xyz
    if not is_tied(cameras.crs, name) or is_topocentric(cameras.crs or ""):
        return GnssDifferences(difference)
    frame = frame_of(cameras.crs or "", name)
    if frame.direct:
        return GnssDifferences(difference / frame.per_metre(cameras.centres))
    return GnssDifferences(_differences(cameras, replace(gnss, crs=cameras.crs), name))


def _heights_unknown(cameras_crs: str, gnss_crs: str, name: str) -> str:
    """Return why heights cannot be compared where just one side counts from a vertical datum."""
    adjusted, gnss = (heights_of(frame_of(crs, name).crs) for crs in (cameras_crs, gnss_crs))
    if "gravity" in (adjusted, gnss) and "unstated" in (adjusted, gnss):
        return (
            f"{name}: the CRS of the {'cameras' if adjusted == 'unstated' else 'GNSS'} does not"
            " say what its heights are, the other does; only plan is compared."
        )
    return ""


def _in_plan(crs: str, name: str) -> str:
    """Return a CRS without its vertical part; ellipsoidal heights may stay, no grid needs them."""
    if is_topocentric(crs):
        return crs
    parsed = parse_crs(crs, name)
    return crs if parsed.is_geocentric else crs_text(parts(parsed)[0])


def _differences(cameras: Cameras, gnss: GnssPositions, name: str) -> FloatArray:
    there = np.isfinite(gnss.xyz).all(axis=1)
    rows = np.flatnonzero(there)
    found = np.full((len(cameras), 3), np.nan)
    if len(rows) == 0:
        return found
    labels = tuple(cameras.labels[i] for i in rows)
    common = _common(cameras, name)
    adjusted = Cameras(labels, cameras.centres[rows], crs=cameras.crs)
    measured = Cameras(labels, gnss.xyz[rows], crs=gnss.crs)
    one, other = (
        georeference(part, common, name=name).points(part.centres) for part in (adjusted, measured)
    )
    found[rows] = one - other
    return found


def _common(cameras: Cameras, name: str) -> CRS:
    """Return the map of the cameras, or a map in metres about the block where they are in none."""
    from pyproj import CRS, Transformer
    from pyproj.crs import ProjectedCRS
    from pyproj.crs.coordinate_operation import TransverseMercatorConversion

    frame = frame_of(cameras.crs or "", name)
    units = {axis.unit_name for axis in frame.crs.axis_info}
    if frame.crs.is_projected and units.issubset(METRES):
        return frame.crs
    base = parts(unbound(frame.crs))[0].geodetic_crs
    if base is None:
        raise InputError(f"{name}: {frame.crs.name} has no datum.")
    to_degrees = Transformer.from_crs(parts(frame.crs)[0], "EPSG:4326", always_xy=True)
    middle = np.median(frame.enter(cameras.centres), axis=0)
    longitude, latitude = to_degrees.transform(middle[0], middle[1])
    base = unbound(base).to_2d()
    plan = CRS(ProjectedCRS(TransverseMercatorConversion(latitude, longitude), geodetic_crs=base))
    vertical = parts(frame.crs)[1]
    if vertical is not None:
        return with_heights(plan, vertical)
    return plan.to_3d() if heights_of(frame.crs) == "ellipsoidal" else plan

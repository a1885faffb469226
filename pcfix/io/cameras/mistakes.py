"""What is likely wrong where cameras do not lie over their cloud."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from pcfix.io.crs import parse_crs, parts, unbound
from pcfix.model import FloatArray

if TYPE_CHECKING:
    from pyproj import CRS


FOOT_M = 0.3048
MARGIN_M = 100.0
"""With half the cloud's sides: how far outside the cloud a block may stand."""
UNDULATION_M = (15.0, 110.0)
"""Of the geoid, where it is worth a word."""
LOCAL_M, MAP_M = 2e4, 1e5
"""Coordinates below the first are likely local, beyond the second those of a map."""
ABSURD_HEIGHTS = 3.0
"""Cameras stand at most so many times the cloud's width above it."""
_SAMPLE = 200


def likely_mistake(
    centres: FloatArray, low: FloatArray, high: FloatArray, cloud_crs: str | CRS | None
) -> str | None:
    """Return what is likely wrong where a block does not fit its cloud.

    Parameters
    ----------
    centres : array, shape (k, 3)
        Projection centres, taken to be in the cloud's CRS.
    low, high : array, shape (3,)
        Corners of the cloud, metres.
    cloud_crs : str, CRS or None

    Returns
    -------
    str or None
        One sentence; None where the block stands over the cloud.
    """
    centres = np.asarray(centres, np.float64)[:: max(1, len(centres) // _SAMPLE)]
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    if _is_over(centres, low, high):
        return _wrong_height(centres[:, 2], low, high)
    for words, moved in _readings(centres, cloud_crs):
        if _is_over(moved, low, high):
            return f"The cameras would lie over the cloud {words}."
    return _far(centres, low, high)


def _is_over(centres: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    """Whether the middle of a block is over the cloud, or not far beside it."""
    middle, margin = np.median(centres[:, :2], axis=0), 0.5 * (high - low)[:2] + MARGIN_M
    return bool(np.all((middle >= low[:2] - margin) & (middle <= high[:2] + margin)))


def _readings(centres: FloatArray, crs: str | CRS | None) -> Iterator[tuple[str, FloatArray]]:
    """Yield other ways to read the numbers, the simplest first."""
    swapped = centres[:, [1, 0, 2]]
    yield "with x and y exchanged: their axes are likely swapped", swapped
    yield "multiplied by 0.3048: they are likely in feet, it in metres", centres * FOOT_M
    yield "divided by 0.3048: they are likely in metres, it in feet", centres / FOOT_M
    if crs is None:
        return
    plan = parts(parse_crs(crs, "the cloud"))[0]
    if plan.is_projected:
        for words, degrees in _places(centres, plan):
            yield f"read as {words}", _on_map(degrees, plan)


def _places(centres: FloatArray, plan: CRS) -> Iterator[tuple[str, FloatArray]]:
    """Yield longitude and latitude (degrees) of centres read in other CRS, to the metre or so."""
    from pyproj import Proj, Transformer

    say = "; say so with --cameras-crs"
    yield f"longitude and latitude in degrees{say} EPSG:4326", centres[:, :2]
    yield "degrees, latitude before longitude; exchange the columns", centres[:, [1, 0]]
    to_degrees = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    geocentric = np.column_stack(to_degrees.transform(*centres.T))
    yield f"geocentric coordinates{say} EPSG:4978", geocentric[:, :2]
    mercator = Proj("+proj=webmerc +datum=WGS84")(centres[:, 0], centres[:, 1], inverse=True)
    yield f"web Mercator{say} EPSG:3857", np.column_stack(mercator)
    for zone, side in _zones_around(plan):
        south = " +south" if side == "S" else ""
        there = Proj(f"+proj=utm +zone={zone}{south} +ellps=GRS80")
        words = f"UTM zone {zone}{side} (the cloud is in {plan.utm_zone}){say}"
        yield words, np.column_stack(there(centres[:, 0], centres[:, 1], inverse=True))


def _zones_around(plan: CRS) -> Iterator[tuple[int, str]]:
    """Yield the zones within two of the cloud's and the other hemisphere's, not its own."""
    if plan.utm_zone is None:
        return
    zone, hemisphere = int(plan.utm_zone[:-1]), plan.utm_zone[-1]
    for step in (0, -1, 1, -2, 2):
        for side in "NS":
            other = (zone + step - 1) % 60 + 1
            if (other, side) != (zone, hemisphere):
                yield other, side


def _on_map(degrees: FloatArray, plan: CRS) -> FloatArray:
    """Return places (n, 2) on a map, as if there were one datum; infinite where there is none."""
    from pyproj import Proj
    from pyproj.exceptions import ProjError

    there = (np.abs(degrees) <= [360.0, 90.0]).all(axis=1)
    found = np.full_like(degrees, np.inf)
    try:
        to_map = Proj(unbound(plan))
    except ProjError:  # a CRS that is no single map, as all zones of UTM in one
        return found
    found[there] = np.column_stack(to_map(degrees[there, 0], degrees[there, 1]))
    return found


def _wrong_height(z: FloatArray, low: FloatArray, high: FloatArray) -> str | None:
    """Return what is likely wrong where cameras lie over the cloud, but not above it."""
    middle = float(np.median(z))
    below, above = float(low[2]) - middle, middle - float(high[2])
    limit = ABSURD_HEIGHTS * max(float((high - low)[:2].max()), MARGIN_M)
    if below <= 0.0 and above <= limit:
        return None
    off = below if below > 0.0 else above - limit
    what = f"{above:.0f} m above the cloud, which is {limit / ABSURD_HEIGHTS:.0f} m wide"
    if below > 0.0:
        what = f"{below:.0f} m below the lowest point of the cloud"
    feet = ("feet", middle * FOOT_M), ("metres, the cloud's in feet", middle / FOOT_M)
    for words, moved in feet if off > UNDULATION_M[1] else ():
        if high[2] < moved < high[2] + limit:
            return f"The cameras are {what}: their heights are likely in {words}."
    if off <= UNDULATION_M[1]:
        return (
            f"The cameras are {what}: heights of one are likely above the ellipsoid and of the"
            " other above the geoid. See the vertical CRS of both."
        )
    return f"The cameras are {what}: their heights have another origin; see --cameras-offset."


def _far(centres: FloatArray, low: FloatArray, high: FloatArray) -> str:
    """Return what is likely wrong where no other reading of the numbers fits."""
    middle, span = np.median(centres[:, :2], axis=0), np.ptp(centres[:, :2], axis=0).max()
    centre, size = (low + high)[:2] / 2.0, max((high - low)[:2].max(), 1e-9)
    cameras, cloud = np.abs(middle).max(), np.abs(centre).max()
    inside = (np.abs(centres[:, :2]) <= 360.0).all() and np.abs(low[:2]).max() > LOCAL_M
    if inside and span < 1e-3 * size and np.abs(np.median(centres[:, :2])) > 10.0 * span:
        return (
            "The cameras look like degrees, the cloud is in metres; give --cameras-crs EPSG:4326,"
            " and a cloud that names its CRS."
        )
    if cameras < LOCAL_M and cloud > MAP_M:
        return (
            "The cameras are near the origin, in local or shifted coordinates, but the cloud is in"
            " those of a map; export the cameras in the CRS of the cloud, or give the shift with"
            " --cameras-offset."
        )
    if cloud < LOCAL_M and cameras > MAP_M:
        return (
            "The cloud is near the origin, in local or shifted coordinates, but the cameras are in"
            " those of a map; export the cloud in the CRS of the cameras."
        )
    x, y = centre - middle
    apart = np.hypot(x, y)
    far = f"{apart / 1000.0:,.1f} km" if apart >= 1e4 else f"{apart:.0f} m"
    if 0.2 < span / size < 5.0:
        return (
            f"The cameras are {far} from the cloud in plan and the block is about as large: a"
            f" constant offset of about {x:.0f}, {y:.0f} m, or another site; see --cameras-offset."
        )
    return f"The cameras are {far} from the cloud in plan; check the CRS of both."

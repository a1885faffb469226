"""The frames in which camera files state positions and rotations, and the size of a metre there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.crs import (
    GEOCENTRIC_WGS84,
    GEOGRAPHIC_WGS84,
    Topocentric,
    geographic_3d,
    is_topocentric,
    metres_up,
    parse_crs,
    plan_unit,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pyproj import CRS

    from pcfix.model import FloatArray

EARTH_RADII_M = (6.2e6, 7.0e6)
"""Cameras are at no other distance from the centre of the earth."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame that is tied to the earth.

    Attributes
    ----------
    crs : CRS
        In which `enter` gives its points: not geocentric.
    enter : callable
        From points (n, 3) of the frame to points of `crs`.
    direct : bool
        The frame is `crs` itself.
    topocentric : bool
        Axes east, north, up at a place.
    """

    crs: CRS
    enter: Callable[[FloatArray], FloatArray]
    direct: bool = False
    topocentric: bool = False

    def per_metre(self, xyz: FloatArray) -> FloatArray:
        """Return how much each number changes per metre along its axis, at points (n, 3)."""
        if not self.direct:
            return np.ones_like(xyz)
        size = plan_unit(self.crs)[1]
        up = np.full(len(xyz), 1.0 / abs(metres_up(self.crs)))
        if self.crs.is_projected:
            return np.column_stack([np.full((len(xyz), 2), 1.0 / size), up])
        along_parallel, along_meridian = _radii_m(self.crs, xyz[:, 1] * size, xyz[:, 2] / up)
        return np.column_stack([1.0 / (along_parallel * size), 1.0 / (along_meridian * size), up])

    def check(self, xyz: FloatArray, labels: Sequence[str], name: str) -> None:
        """Refuse numbers that are no place on the earth.

        Raises
        ------
        InputError
            If degrees are out of range, or geocentric positions not near the surface.
        """
        if self.topocentric or self.crs.is_projected:
            return
        if self.direct:
            turn = 2.0 * np.pi / plan_unit(self.crs)[1] * (1.0 + 1e-9)
            wrong = (np.abs(xyz[:, :2]) > [turn, turn / 4.0]).any(axis=1)
        else:
            radius = np.linalg.norm(xyz, axis=1)
            wrong = ~((radius > EARTH_RADII_M[0]) & (radius < EARTH_RADII_M[1]))
        if wrong.any():
            i = int(np.argmax(wrong))
            kind = "longitude and latitude" if self.direct else "geocentric coordinates"
            raise InputError(
                f"{name}: image {labels[i]}: {', '.join(f'{number:.10g}' for number in xyz[i])}"
                f" are not {kind} ({self.crs.name}); say what they are with --cameras-crs."
            )


def _radii_m(crs: CRS, latitude: FloatArray, height_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the radii of parallel and meridian (m) at latitudes in radians."""
    ellipsoid = crs.ellipsoid
    a = ellipsoid.semi_major_metre if ellipsoid is not None else 6378137.0
    b = ellipsoid.semi_minor_metre if ellipsoid is not None else a
    e2 = 1.0 - (b / a) ** 2
    w = np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
    parallel = (a / w + height_m) * np.maximum(np.cos(latitude), 1e-9)
    return parallel, a * (1.0 - e2) / w**3 + height_m


def frame_of(text: str, name: str) -> Frame:
    """Return the frame that a text names: a CRS, or ``ENU:latitude,longitude,height``.

    Raises
    ------
    InputError
        If it is neither.
    """
    if is_topocentric(text):
        place = Topocentric.from_text(text, name)
        crs = parse_crs(GEOGRAPHIC_WGS84, name)
        enter = _from_geocentric(parse_crs(GEOCENTRIC_WGS84, name), crs)
        return Frame(crs, lambda enu: enter(place.to_geocentric(enu)), topocentric=True)
    crs = parse_crs(text, name)
    if crs.is_geocentric:
        geographic = geographic_3d(crs)
        return Frame(geographic, _from_geocentric(crs, geographic))
    if not (crs.is_projected or crs.is_geographic):
        raise InputError(f"{name}: {crs.name} is not a CRS in which cameras can stand.")
    return Frame(crs, lambda xyz: xyz, direct=True)


def _from_geocentric(geocentric: CRS, geographic: CRS) -> Callable[[FloatArray], FloatArray]:
    """Return the conversion of geocentric points to longitude, latitude, height on one datum."""
    from pyproj import Transformer

    step = Transformer.from_crs(geocentric, geographic, always_xy=True)
    return lambda xyz: np.column_stack(step.transform(*xyz.T))

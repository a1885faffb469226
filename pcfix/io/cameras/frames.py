"""The frames in which camera files state positions, and what file and user say of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import InputError, PcfixWarning
from pcfix.io.crs import (
    GEOCENTRIC_WGS84,
    GEOGRAPHIC_WGS84,
    Topocentric,
    geographic_3d,
    heights_of,
    is_local,
    is_topocentric,
    metres_up,
    parse_crs,
    parts,
    plan_unit,
    typed,
    with_heights,
)
from pcfix.io.transformations import heights_agree
from pcfix.model import Cameras, FloatArray

if TYPE_CHECKING:
    from pyproj import CRS


EARTH_RADII_M = (6.2e6, 7.0e6)
"""Cameras are at no other distance from the centre of the earth."""


class Frame(NamedTuple):
    """A frame that is tied to the earth.

    `enter` takes points (n, 3) of it to `crs`, which is not geocentric, and is the frame itself
    where it is `direct`. A `topocentric` one has axes east, north, up at a place.
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
        """Raise InputError for numbers that are no place on the earth."""
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
            numbers = ", ".join(f"{number:.10g}" for number in xyz[i])
            raise InputError(
                "cameras.degrees" if self.direct else "cameras.geocentric",
                f"{name}: image {labels[i]}: {numbers} are not {kind} ({self.crs.name}). Give the"
                " CRS of the cameras with --cameras-crs.",
                path=name,
                image=labels[i],
                crs=self.crs.name,
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
    """Return the frame that a text names: a CRS, or ``ENU:latitude,longitude,height``."""
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
        raise InputError(
            "cameras.crs",
            f"{name}: {crs.name} is not a CRS for cameras. Give another with --cameras-crs.",
            path=name,
            crs=crs.name,
        )
    return Frame(crs, lambda xyz: xyz, direct=True)


def _from_geocentric(geocentric: CRS, geographic: CRS) -> Callable[[FloatArray], FloatArray]:
    """Return the conversion of geocentric points to longitude, latitude, height on one datum."""
    from pyproj import Transformer

    step = Transformer.from_crs(geocentric, geographic, always_xy=True)
    return lambda xyz: np.column_stack(step.transform(*xyz.T))


LOCAL = "local"


class Statement(NamedTuple):
    """The frame of cameras by their file and by ``--cameras-crs``.

    `crs` is as in `Cameras`, `project` that in which the software delivers its clouds. It is
    `chosen` if the user gave it, and `trusted` if heights of an unknown system are the cloud's.
    """

    crs: str | None
    project: CRS | None
    chosen: bool = False
    trusted: bool = False


def statement(cameras: Cameras, cameras_crs: str | None, name: str) -> Statement:
    """Combine the CRS of the file with the user's ``--cameras-crs``, which has priority."""
    project = _on_earth(cameras.project_crs, name)
    given = (cameras_crs or "").strip()
    if not given:
        return Statement(cameras.crs, project)
    crs = _on_earth(given, "--cameras-crs")
    if crs is None:
        return Statement(given, None, chosen=True, trusted=True)
    if crs.is_geocentric:
        return Statement(given, project, chosen=True)
    trusted = heights_of(crs) == "unstated"
    own = _on_earth(cameras.crs, name)
    if own is not None and own.is_geocentric:
        return Statement(cameras.crs, crs, chosen=True, trusted=trusted)
    return Statement(given, None, chosen=True, trusted=trusted)


def is_tied(crs: str | None, name: str) -> bool:
    """Whether a frame has its place on the earth."""
    return crs is not None and (is_topocentric(crs) or _on_earth(crs, name) is not None)


def _on_earth(crs: str | None, name: str) -> CRS | None:
    """Return a CRS that is tied to the earth; None for axes at a place and local frames."""
    if crs is None or crs.strip().lower() == LOCAL or is_topocentric(crs):
        return None
    parsed = parse_crs(crs, name)
    return None if is_local(parsed) else parsed


def completed(cloud: CRS, frame: Frame, stated: Statement) -> CRS:
    """Return the cloud's CRS, with the heights that its software uses where it states none."""
    if heights_of(cloud) != "unstated":
        return cloud
    vertical = parts(frame.crs if stated.project is None else stated.project)[1]
    return cloud if vertical is None else with_heights(cloud, vertical)


def agree(frame: Frame, target: CRS, stated: Statement) -> bool:
    """Whether heights go over as they are: the user says so, or the CRSs do."""
    return (stated.trusted and not frame.direct) or heights_agree(frame.crs, target)


def height_notes(
    frame: Frame, target: CRS, stated: Statement, name: str
) -> tuple[PcfixWarning, ...]:
    """Return a note on what is assumed about heights, if anything."""
    own, cloud = heights_of(frame.crs), heights_of(target)
    unit, size = plan_unit(frame.crs)
    axes = [e.semi_major_metre for e in (frame.crs.ellipsoid, target.ellipsoid) if e is not None]
    other_datum = bool(axes) and max(axes) - min(axes) > 1.0
    is_guess = other_datum or (stated.project is None and not frame.topocentric)
    if own == "unstated" and frame.crs.is_projected and size != 1.0:
        what = f"heights are taken to be in {unit}, as x and y are"
    elif stated.trusted:
        return ()
    elif own == "unstated" and cloud != "unstated":
        what = f"does not say what its heights are; taken to be the cloud's ({target.name})"
    elif own == "ellipsoidal" and cloud == "unstated" and is_guess:
        what = (
            f"the cloud's CRS ({target.name}) does not say what its heights are; taken to be"
            f" ellipsoidal, of {frame.crs.name}"
        )
    else:
        return ()
    return (PcfixWarning("cameras.heights_assumed", f"{name}: {what}.", path=name),)


def without_grid(frame: Frame, target: CRS) -> str:
    """Return what a user can do who has no grid to compare heights with."""
    agree = "or, if the heights of cameras and cloud are known to agree, give --cameras-crs"
    if frame.topocentric:
        return f"{agree} ENU:latitude,longitude,height with the height in the cloud's system"
    plan = parts(frame.crs if frame.direct else target)[0]
    return f"{agree} {typed(plan)}, the horizontal CRS alone"

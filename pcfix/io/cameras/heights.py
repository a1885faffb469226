"""What file and user say of the frame of cameras, and what becomes of its heights.

Heights are shifted only where both sides say what theirs are, and then with a grid or not at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pcfix.io.crs import (
    crs_text,
    heights_of,
    is_local,
    is_topocentric,
    parse_crs,
    parts,
    plan_unit,
    shortened,
    with_heights,
)
from pcfix.io.transformations import heights_agree

if TYPE_CHECKING:
    from pyproj import CRS

    from pcfix.io.cameras.frames import Frame
    from pcfix.model import Cameras

LOCAL = "local"


@dataclass(frozen=True, eq=False)
class Statement:
    """What file and user say of the frame of cameras.

    Attributes
    ----------
    crs : str or None
        As in `Cameras`.
    project : CRS or None
        In which the software delivers its clouds.
    chosen : bool
        The user says so.
    trusted : bool
        The user says so, and heights that are not stated are the cloud's.
    """

    crs: str | None
    project: CRS | None
    chosen: bool = False
    trusted: bool = False


def statement(cameras: Cameras, cameras_crs: str | None, name: str) -> Statement:
    """Return what holds of what the file says and the user's ``--cameras-crs``.

    Raises
    ------
    InputError
        If a CRS is not one that PROJ knows.
    """
    clouds = cameras.project_crs
    if clouds is None or is_topocentric(clouds) or not is_tied(clouds, name):
        project = None
    else:
        project = parse_crs(clouds, name)
    given = (cameras_crs or "").strip()
    if not given:
        return Statement(cameras.crs, project)
    if is_topocentric(given) or not is_tied(given, "--cameras-crs"):
        return Statement(given, None, chosen=True, trusted=True)
    crs = parse_crs(given, "--cameras-crs")
    trusted = heights_of(crs) == "unstated"
    if crs.is_geocentric:
        return Statement(given, project, chosen=True)
    if _is_geocentric(cameras.crs, name):
        return Statement(cameras.crs, crs, chosen=True, trusted=trusted)
    return Statement(given, None, chosen=True, trusted=trusted)


def is_tied(crs: str | None, name: str) -> bool:
    """Whether a frame has its place on the earth."""
    if crs is None or crs.strip().lower() == LOCAL:
        return False
    return is_topocentric(crs) or not is_local(parse_crs(crs, name))


def _is_geocentric(crs: str | None, name: str) -> bool:
    if crs is None or is_topocentric(crs) or not is_tied(crs, name):
        return False
    return parse_crs(crs, name).is_geocentric


def completed(cloud: CRS, frame: Frame, said: Statement) -> CRS:
    """Return the cloud's CRS, with the heights that its software uses where it states none."""
    if heights_of(cloud) != "unstated":
        return cloud
    vertical = parts(frame.crs if said.project is None else said.project)[1]
    return cloud if vertical is None else with_heights(cloud, vertical)


def agree(frame: Frame, target: CRS, said: Statement) -> bool:
    """Whether heights go over as they are: the user says so, or the CRSs do."""
    return (said.trusted and not frame.direct) or heights_agree(frame.crs, target)


def height_notes(frame: Frame, target: CRS, said: Statement, name: str) -> tuple[str, ...]:
    """Return what is guessed about heights."""
    mine, cloud = heights_of(frame.crs), heights_of(target)
    unit, size = plan_unit(frame.crs)
    if mine == "unstated" and frame.crs.is_projected and size != 1.0:
        return (f"{name}: heights are taken to be in {unit}, as x and y are.",)
    if said.trusted:
        return ()
    if mine == "unstated" and cloud != "unstated":
        return (
            f"{name}: does not say what its heights are; taken to be the cloud's ({target.name}).",
        )
    if mine == "ellipsoidal" and cloud == "unstated" and _is_guess(frame, target, said):
        return (
            f"{name}: the cloud's CRS ({target.name}) does not say what its heights are; taken to"
            f" be ellipsoidal, of {frame.crs.name}.",
        )
    return ()


def _is_guess(frame: Frame, target: CRS, said: Statement) -> bool:
    """Whether the software may mean other heights than the ellipsoidal ones of the frame."""
    axes = [e.semi_major_metre for e in (frame.crs.ellipsoid, target.ellipsoid) if e is not None]
    if axes and max(axes) - min(axes) > 1.0:
        return True
    return said.project is None and not frame.topocentric


def without_grid(frame: Frame, target: CRS) -> str:
    """Return what a user can do who has no grid to compare heights with."""
    agree = "or, if the heights of cameras and cloud are known to agree, give --cameras-crs"
    if frame.topocentric:
        return f"{agree} ENU:latitude,longitude,height with the height in the cloud's system"
    plan = shortened(crs_text(parts(frame.crs if frame.direct else target)[0]))
    return f"{agree} {plan}, the horizontal CRS alone"

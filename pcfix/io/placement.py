"""From the CRS of a file of points or shapes into the cloud's.

Heights are shifted only where both sides say what theirs are, as with cameras.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from pcfix.errors import InputError
from pcfix.io.crs import (
    check_projected_metres,
    crs_text,
    heights_of,
    is_local,
    is_same,
    is_same_vertical_datum,
    metres_up,
    parse_crs,
    parts,
    plan_unit,
    shortened,
)
from pcfix.io.transformations import (
    HeightsError,
    Transformation,
    transformation_in_plan,
    transformation_in_space,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from pyproj import CRS

    from pcfix.model import FloatArray

LOCAL = "local"


class Way(NamedTuple):
    """The way from one CRS into another.

    forward : from points (n, 3) to points (n, 3), not finite where one has no place there; None
    where the numbers stay as they are.
    notes : what a user should know of it.
    """

    forward: Callable[[FloatArray], FloatArray] | None
    notes: tuple[str, ...] = ()


def way_to_cloud(
    crs: str | None, cloud_crs: str | CRS | None, at: FloatArray, name: str, *, heights: bool
) -> Way:
    """Return the way from a file's CRS into the cloud's.

    Parameters
    ----------
    crs : str or None
        The file's; None where it names none, ``local`` to take its numbers as they are.
    cloud_crs : str, CRS or None
        Projected, in metres; None where the cloud names none.
    at : array, shape (n, 3)
        Where it is needed, in the file's CRS, x east or longitude first.
    name : str
        The file, for messages.
    heights : bool
        Whether z counts. Where it does not, it is not looked at.

    Returns
    -------
    Way

    Raises
    ------
    InputError
        If the two cannot be brought together.
    HeightsError
        If their heights cannot, as where a vertical grid is not installed.
    """
    cloud = None if cloud_crs is None else parse_crs(cloud_crs, "the cloud")
    if crs is None:
        tied = cloud is not None and not is_local(cloud)
        return Way(None, (_names_none(name, cloud),) if cloud is not None and tied else ())
    if crs.strip().lower() == LOCAL:
        return Way(None)
    source = parse_crs(crs, name)
    if cloud is None:
        return _without_cloud_crs(source, name)
    if is_local(cloud) and is_local(source):
        return Way(None)
    _check_kinds(source, cloud, name)
    return _between(source, cloud, at, name, heights=heights)


def _names_none(name: str, cloud: CRS) -> str:
    return f"{name}: names no CRS; taken to be in the cloud's ({cloud.name})."


def _without_cloud_crs(source: CRS, name: str) -> Way:
    """Return what to do where the cloud names no CRS: numbers in metres are taken as they are."""
    if is_local(source):
        return Way(None)
    if not source.is_projected or plan_unit(source)[1] != 1.0:
        unit = f"the unit {plan_unit(source)[0]}" if source.is_projected else "degrees"
        raise InputError(
            f"{name}: is in {unit} ({source.name}) and the cloud names no CRS; set the cloud's CRS."
        )
    return Way(None, (f"{name}: the cloud names no CRS; taken to be in {source.name} too.",))


def _check_kinds(source: CRS, cloud: CRS, name: str) -> None:
    """Refuse two frames of which one alone is tied to the earth, and geocentric coordinates."""
    if is_local(cloud) or is_local(source):
        where = (source.name, "the cloud") if is_local(cloud) else (cloud.name, name)
        raise InputError(
            f"{name}: {where[1]} is in a local frame, the other in {where[0]}; export both in one"
            " CRS, or give the file's CRS as 'local' to take its numbers as they are."
        )
    check_projected_metres(cloud, "the cloud")
    if not (source.is_projected or source.is_geographic):
        raise InputError(f"{name}: {source.name} is neither a map projection nor in degrees.")


def _between(source: CRS, cloud: CRS, at: FloatArray, name: str, *, heights: bool) -> Way:
    """Return the transformation between two CRS that are tied to the earth."""
    if heights and not _heights_agree(source, cloud):
        step = _in_space(source, cloud, at, name)
        return Way(step.forward, step.notes)
    notes = _height_notes(source, cloud, name) if heights else ()
    if _is_same_numbers(source, cloud, heights=heights):
        return Way(None, notes)
    step = transformation_in_plan(source, cloud, at, name)
    return Way(step.forward, (*step.notes, *notes))


def _is_same_numbers(source: CRS, cloud: CRS, *, heights: bool) -> bool:
    same = is_same(parts(source)[0], parts(cloud)[0])
    return same and not (heights and metres_up(source) != metres_up(cloud))


def _heights_agree(source: CRS, cloud: CRS) -> bool:
    """Whether heights go over as they are: one datum, or one side does not say which."""
    kinds = heights_of(source), heights_of(cloud)
    if "unstated" in kinds:
        return True
    verticals = parts(source)[1], parts(cloud)[1]
    if verticals[0] is not None and verticals[1] is not None:
        return is_same_vertical_datum(verticals[0], verticals[1])
    return kinds[0] == kinds[1] and is_same(parts(source)[0], parts(cloud)[0])


def _height_notes(source: CRS, cloud: CRS, name: str) -> tuple[str, ...]:
    """Return what is taken for granted about heights."""
    mine, theirs = heights_of(source), heights_of(cloud)
    if mine == "unstated" and theirs != "unstated":
        return (
            f"{name}: does not say what its heights are; taken to be the cloud's ({cloud.name}).",
        )
    if mine == "ellipsoidal" and theirs == "unstated":
        return (
            f"{name}: has ellipsoidal heights ({source.name}), and the cloud's CRS ({cloud.name})"
            " does not say what its own are; taken to be the same.",
        )
    return ()


def _in_space(source: CRS, cloud: CRS, at: FloatArray, name: str) -> Transformation:
    """Return the transformation of plan and heights, or refuse with the way out."""
    try:
        return transformation_in_space(source, cloud, at, name)
    except HeightsError as error:
        plan = shortened(crs_text(parts(source)[0]))
        raise HeightsError(
            f"{error}; or, if the heights of the file are known to agree with the cloud's, give"
            f" the file's CRS as {plan}, the horizontal CRS alone."
        ) from None

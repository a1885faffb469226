"""Transformations between CRS that say what they cannot do.

PROJ takes a ballpark transformation where the grid of a better one is not installed: heights then
stay as they are, some 50 m off, and horizontal datums count as one. Here that is an error which
names the grid, or a note. Heights are shifted only where both sides say what theirs are.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.crs import (
    check_projected_metres,
    heights_of,
    is_local,
    is_same,
    is_same_vertical_datum,
    metres_up,
    parse_crs,
    parts,
    plan_unit,
    typed,
)
from pcfix.model import FloatArray

if TYPE_CHECKING:
    from pyproj import CRS, Transformer
    from pyproj.transformer import AreaOfInterest, TransformerGroup

Points = Callable[[FloatArray], FloatArray]
Way = tuple[Points | None, tuple[str, ...]]

SILENT_ACCURACY_M = 1.0
"""A transformation that is worse than this gets a note."""
_AREA_MARGIN_DEG = 0.01


class HeightsError(InputError):
    """Heights of two systems that cannot be brought together."""


class Transformation(NamedTuple):
    """From one CRS to another.

    forward : from points (n, 3) to points (n, 3), x east or longitude first; not finite where a
    point has no place in the other CRS.
    notes : what a user should know of it.
    """

    forward: Points
    notes: tuple[str, ...] = ()


def transformation(
    source: CRS, target: CRS, at: FloatArray, name: str, *, heights: bool, instead: str
) -> Transformation:
    """Return the transformation in plan, or of `heights` too: refused with the way out `instead`.

    See `transformation_in_plan`.
    """
    if not heights:
        return transformation_in_plan(source, target, at, name)
    try:
        return transformation_in_space(source, target, at, name)
    except HeightsError as error:
        raise HeightsError(f"{error}; {instead}.") from None


def heights_agree(source: CRS, target: CRS) -> bool:
    """Whether heights go over as they are: one datum, or one side does not say which."""
    kinds = heights_of(source), heights_of(target)
    if "unstated" in kinds:
        return True
    (plan, vertical), (other_plan, other) = parts(source), parts(target)
    if vertical is not None and other is not None:
        return is_same_vertical_datum(vertical, other)
    return kinds[0] == kinds[1] and is_same(plan, other_plan)


def is_same_numbers(source: CRS, target: CRS, *, heights: bool = True) -> bool:
    """Whether points have the same numbers in both, given that the heights agree."""
    same = is_same(parts(source)[0], parts(target)[0])
    return same and not (heights and metres_up(source) != metres_up(target))


def transformation_in_plan(source: CRS, target: CRS, at: FloatArray, name: str) -> Transformation:
    """Return the horizontal transformation; heights change their unit and nothing else.

    It is needed `at` places of `source`, shape (n, 3); neither CRS is geocentric. An `InputError`
    if the datums differ by a grid that is not installed and PROJ has nothing else.
    """
    factor = metres_up(source) / metres_up(target)
    plans = parts(source)[0], parts(target)[0]
    if is_same(*plans):
        return Transformation(lambda xyz: xyz * [1.0, 1.0, factor])
    step, notes = _operation(*plans, at, name)

    def forward(xyz: FloatArray) -> FloatArray:
        return np.column_stack([*step.transform(xyz[:, 0], xyz[:, 1]), factor * xyz[:, 2]])

    return Transformation(forward, notes)


def transformation_in_space(source: CRS, target: CRS, at: FloatArray, name: str) -> Transformation:
    """Return the transformation of plan and heights; see `transformation_in_plan`.

    A `HeightsError` if the heights cannot be brought over, as where a grid is not installed.
    """
    step, notes = _operation(source, target, at, name, heights=True)
    return Transformation(lambda xyz: np.column_stack(step.transform(*xyz.T)), notes)


def _operation(
    source: CRS, target: CRS, at: FloatArray, name: str, *, heights: bool = False
) -> tuple[Transformer, tuple[str, ...]]:
    """Return PROJ's best transformation that is not a ballpark where that matters, and notes."""
    group = _group(source, target, at, name)
    real = [t for t in group.transformers if not (heights and _guesses_heights(t.description))]
    if not real:
        raise HeightsError(_heights_refused(source, target, group, name))
    best = next((t for t in real if np.isfinite(t.transform(*at.T)).all()), real[0])
    grids, accuracy_m = _missing(group, heights=heights)
    if "ballpark geographic" in best.description.lower():
        if grids:
            raise InputError(
                f"{name}: {source.name} can be brought to {target.name} only with"
                f" {_grids(grids)}: {_install(grids)}."
            )
        return best, (
            f"{name}: PROJ knows no transformation from {source.name} to {target.name}; their"
            " datums are taken as one.",
        )
    if best.accuracy <= SILENT_ACCURACY_M:
        return best, ()
    better = bool(grids) and 0.0 <= accuracy_m < best.accuracy
    return best, (
        f"{name}: from {source.name} to {target.name} positions are good to about"
        f" {best.accuracy:g} m"
        + (f"; {accuracy_m:g} m with {_grids(grids)} ({_install(grids)})." if better else "."),
    )


def _group(source: CRS, target: CRS, at: FloatArray, name: str) -> TransformerGroup:
    from pyproj.exceptions import ProjError
    from pyproj.transformer import TransformerGroup

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a missing grid is named below, in one sentence
            area = _area(parts(source)[0], at)
            return TransformerGroup(source, target, always_xy=True, area_of_interest=area)
    except (ProjError, IndexError) as error:  # the latter where PROJ finds no way at all
        raise InputError(
            f"{name}: PROJ cannot bring {source.name} to {target.name}; give another CRS for"
            " one of them."
        ) from error


def _area(plan: CRS, at: FloatArray) -> AreaOfInterest | None:
    """Return the area of points; None where they are too far out or cross the antimeridian."""
    from pyproj import Transformer
    from pyproj.transformer import AreaOfInterest

    to_degrees = Transformer.from_crs(plan, "EPSG:4326", always_xy=True)
    longitude, latitude = to_degrees.transform(at[:, 0], at[:, 1])
    if not (np.isfinite(longitude).all() and np.isfinite(latitude).all()):
        return None
    (west, south), (east, north) = ((f(longitude), f(latitude)) for f in (np.min, np.max))
    if east - west > 180.0:
        return None
    margin = _AREA_MARGIN_DEG
    return AreaOfInterest(west - margin, south - margin, east + margin, north + margin)


def _guesses_heights(operation: str) -> bool:
    return "ballpark vertical" in operation.lower()


def _missing(group: TransformerGroup, *, heights: bool) -> tuple[tuple[str, ...], float]:
    """Return the grids not installed of the transformation that lacks fewest, and its accuracy."""
    found = [
        (tuple(g.short_name for g in operation.grids if not g.available), operation.accuracy)
        for operation in group.unavailable_operations
        if not (heights and _guesses_heights(operation.name))
    ]
    return min((f for f in found if f[0]), key=lambda f: len(f[0]), default=((), -1.0))


def _heights_refused(source: CRS, target: CRS, group: TransformerGroup, name: str) -> str:
    between = f"{name}: {_height_words(source)} cannot be brought to {_height_words(target)}"
    grids, _ = _missing(group, heights=True)
    if not grids:
        return f"{between}: PROJ knows no transformation between them"
    return f"{between} without {_grids(grids)}: {_install(grids)}"


def _height_words(crs: CRS) -> str:
    vertical = parts(crs)[1]
    if vertical is not None:
        return vertical.name
    kind = "ellipsoidal heights" if heights_of(crs) == "ellipsoidal" else "heights"
    return f"{kind} ({crs.name})"


def _grids(grids: Sequence[str]) -> str:
    return f"the grid{'s' if len(grids) > 1 else ''} {', '.join(grids)}"


def _install(grids: Sequence[str]) -> str:
    them = "them" if len(grids) > 1 else "it"
    return (
        f"install {them} with '{' && '.join(f'pyproj sync --file {grid}' for grid in grids)}'"
        f" or PROJ's projsync, or let PROJ fetch {them} with PROJ_NETWORK=ON"
    )


LOCAL = "local"


def way_to_cloud(
    crs: str | None, cloud_crs: str | CRS | None, at: FloatArray, name: str, *, heights: bool
) -> Way:
    """Return the way from a file's CRS into the cloud's, None where numbers stay, and notes.

    An `InputError` if the two cannot be brought together; a `HeightsError` if only their heights
    cannot.

    Parameters
    ----------
    crs : str or None
        The file's; None where it names none, ``local`` to take its numbers as they are.
    cloud_crs : str, CRS or None
        Projected, in metres; None where the cloud names none.
    at, name
        Where it is needed, see `transformation_in_plan`; the file, for messages.
    heights : bool
        Whether z counts. Where it does not, it is not looked at.
    """
    cloud = None if cloud_crs is None else parse_crs(cloud_crs, "the cloud")
    if crs is None:
        tied = cloud is not None and not is_local(cloud)
        note = "" if cloud is None else f"; taken to be in the cloud's ({cloud.name})."
        return None, (f"{name}: names no CRS{note}",) if tied else ()
    if crs.strip().lower() == LOCAL:
        return None, ()
    source = parse_crs(crs, name)
    if cloud is None:
        return None, _without_cloud_crs(source, name)
    if is_local(cloud) and is_local(source):
        return None, ()
    _check_kinds(source, cloud, name)
    agree = not heights or heights_agree(source, cloud)
    notes = _height_notes(source, cloud, name) if heights and agree else ()
    if agree and is_same_numbers(source, cloud, heights=heights):
        return None, notes
    instead = agree or (  # a search for the code of a CRS takes long
        "or, if the heights of the file are known to agree with the cloud's, give the file's CRS as"
        f" {typed(parts(source)[0])}, the horizontal CRS alone"
    )
    step = transformation(source, cloud, at, name, heights=not agree, instead=str(instead))
    return step.forward, (*step.notes, *notes)


def _without_cloud_crs(source: CRS, name: str) -> tuple[str, ...]:
    """Return notes where the cloud names no CRS: numbers in metres are taken as they are."""
    if is_local(source):
        return ()
    if not source.is_projected or plan_unit(source)[1] != 1.0:
        unit = f"the unit {plan_unit(source)[0]}" if source.is_projected else "degrees"
        raise InputError(
            f"{name}: is in {unit} ({source.name}) and no cloud names a CRS; set the cloud's CRS."
        )
    return (f"{name}: no cloud names a CRS; taken to be in {source.name} too.",)


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


def _height_notes(source: CRS, cloud: CRS, name: str) -> tuple[str, ...]:
    """Return what is taken for granted about heights."""
    own, of_cloud = heights_of(source), heights_of(cloud)
    if own == "unstated" and of_cloud != "unstated":
        return (
            f"{name}: does not say what its heights are; taken to be the cloud's ({cloud.name}).",
        )
    if own == "ellipsoidal" and of_cloud == "unstated":
        return (
            f"{name}: has ellipsoidal heights ({source.name}), and the cloud's CRS ({cloud.name})"
            " does not say what its own are; taken to be the same.",
        )
    return ()

"""Transform coordinates between CRS, and refuse or note what PROJ cannot do.

PROJ uses a ballpark transformation if the grid of a better one is not installed: heights then stay
unchanged, some 50 m off, and horizontal datums are treated as one. Here that is an error which
names the grid, or a note. Heights are shifted only if both sides state their datum.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import InputError, PcfixWarning, bad_file
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
    from pyproj.transformer import AreaOfInterest

Points = Callable[[FloatArray], FloatArray]
Notes = tuple[PcfixWarning, ...]

SILENT_ACCURACY_M = 1.0
"""A transformation that is worse than this gets a note."""
_AREA_MARGIN_DEG = 0.01
LOCAL = "local"


class HeightsError(InputError):
    """Heights of two systems that cannot be transformed into each other."""


class Transformation(NamedTuple):
    """Takes points (n, 3), x east or longitude first; not finite where there is no such place."""

    forward: Points
    notes: Notes = ()


def transformation(
    source: CRS, target: CRS, at: FloatArray, name: str, *, heights: bool, instead: str = ""
) -> Transformation:
    """Return the transformation of `heights` too, or in plan, where only their unit changes.

    It is needed at places (n, 3) of `source`. In plan neither CRS may be geocentric. If heights
    cannot be transformed it is a `HeightsError` with the remedy `instead`.
    """
    if heights:
        step, notes = _operation(source, target, at, name, heights=True, instead=instead)
        return Transformation(lambda xyz: np.column_stack(step.transform(*xyz.T)), notes)
    factor = metres_up(source) / metres_up(target)
    plans = parts(source)[0], parts(target)[0]
    if is_same(*plans):
        return Transformation(lambda xyz: xyz * [1.0, 1.0, factor])
    step, notes = _operation(*plans, at, name, heights=False)

    def forward(xyz: FloatArray) -> FloatArray:
        return np.column_stack([*step.transform(xyz[:, 0], xyz[:, 1]), factor * xyz[:, 2]])

    return Transformation(forward, notes)


def _operation(
    source: CRS, target: CRS, at: FloatArray, name: str, *, heights: bool, instead: str = ""
) -> tuple[Transformer, Notes]:
    """Return PROJ's best transformation that is not a ballpark where that matters, and notes."""
    from pyproj.exceptions import ProjError
    from pyproj.transformer import TransformerGroup

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a missing grid is named in the error or note
            area = _area(parts(source)[0], at)
            group = TransformerGroup(source, target, always_xy=True, area_of_interest=area)
    except (ProjError, IndexError) as error:  # the latter if PROJ finds no operation at all
        sentence = f"PROJ cannot transform {source.name} to {target.name}. Give another CRS."
        raise bad_file(name, "crs.no_transformation", sentence) from error

    def is_usable(description: str) -> bool:
        return not (heights and "ballpark vertical" in description.lower())

    real = [one for one in group.transformers if is_usable(one.description)]
    # of the better operations, the one that lacks the fewest grids
    lacking = [
        ([grid.short_name for grid in one.grids if not grid.available], one.accuracy)
        for one in group.unavailable_operations
        if is_usable(one.name)
    ]
    grids, accuracy_m = min(
        (one for one in lacking if one[0]), key=lambda one: len(one[0]), default=([], -1.0)
    )
    commands = " && ".join(f"pyproj sync --file {grid}" for grid in grids)
    without = f" without the grid {', '.join(grids)}" if grids else ""
    install = f"Install it with '{commands}', or set PROJ_NETWORK=ON"
    if not real:
        one, other = _height_words(source), _height_words(target)
        why = install if grids else "PROJ knows no transformation between them"
        remedy = f"; {instead}." if instead else "."
        sentence = f"{name}: {one} cannot be transformed to {other}{without}. {why}{remedy}"
        raise HeightsError("crs.heights", sentence, grids=grids)
    best = next((one for one in real if np.isfinite(one.transform(*at.T)).all()), real[0])
    names = f"from {source.name} to {target.name}"
    if "ballpark geographic" in best.description.lower():
        if grids:
            sentence = f"cannot be transformed {names}{without}. {install}."
            raise bad_file(name, "crs.grid_missing", sentence, grids=grids)
        sentence = f"{name}: PROJ knows no transformation {names}; their datums are treated as one."
        return best, (PcfixWarning("crs.datum", sentence),)
    if best.accuracy <= SILENT_ACCURACY_M:
        return best, ()
    better = ""
    if grids and 0.0 <= accuracy_m < best.accuracy:
        better = f", but to {accuracy_m:g} m with the grid {', '.join(grids)}. {install}"
    sentence = f"{name}: positions {names} are accurate to about {best.accuracy:g} m{better}."
    values = {"accuracy_m": best.accuracy, "grids": grids}
    return best, (PcfixWarning("crs.accuracy", sentence, **values),)


def heights_agree(source: CRS, target: CRS) -> bool:
    """Whether heights need no change: one datum, or one side does not state which."""
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


def _area(plan: CRS, at: FloatArray) -> AreaOfInterest | None:
    """Return the area of points; None if they are too far out or cross the antimeridian."""
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


def _height_words(crs: CRS) -> str:
    vertical = parts(crs)[1]
    if vertical is not None:
        return vertical.name
    kind = "ellipsoidal heights" if heights_of(crs) == "ellipsoidal" else "heights"
    return f"{kind} ({crs.name})"


def way_to_cloud(
    crs: str | None, cloud_crs: str | CRS | None, at: FloatArray, name: str, *, heights: bool
) -> tuple[Points | None, Notes]:
    """Return the transformation from a file's CRS to the cloud's, None for none, and notes.

    A CRS that is None is not stated; that of the file is ``local`` to use its numbers unchanged.
    The cloud's is projected, in metres. `heights` says whether z matters.
    """
    cloud = None if cloud_crs is None else parse_crs(cloud_crs, "the cloud")
    if crs is None:
        if cloud is None or is_local(cloud):
            return None, ()
        sentence = f"{name}: names no CRS; that of the cloud is assumed ({cloud.name})."
        return None, (PcfixWarning("crs.assumed", sentence),)
    if crs.strip().lower() == LOCAL:
        return None, ()
    source = parse_crs(crs, name)
    if cloud is None and is_local(source):
        return None, ()
    if cloud is None:
        unit = plan_unit(source)[0] if source.is_projected else "degrees"
        if not source.is_projected or plan_unit(source)[1] != 1.0:
            sentence = f"is in {unit} ({source.name}), the cloud names no CRS. Set the cloud's CRS."
            raise bad_file(name, "crs.cloud_missing", sentence, unit=unit)
        sentence = f"{name}: no cloud names a CRS; that of the file is assumed ({source.name})."
        return None, (PcfixWarning("crs.assumed", sentence),)
    if is_local(cloud) or is_local(source):
        if is_local(cloud) and is_local(source):
            return None, ()
        sentence = f"is in {source.name}, the cloud in {cloud.name}, of which one is local. Use one"
        raise bad_file(name, "crs.local", f"{sentence} CRS, or give that of the file as 'local'.")
    check_projected_metres(cloud, "the cloud")
    if not (source.is_projected or source.is_geographic):
        sentence = f"{source.name} is neither a map projection nor in degrees."
        raise bad_file(name, "crs.not_projected", sentence, crs=source.name)
    agree = not heights or heights_agree(source, cloud)
    kinds, missing = (heights_of(source), heights_of(cloud)), ""
    notes: Notes = ()
    if kinds[0] == "unstated" != kinds[1]:
        missing = "the file"
    elif kinds == ("ellipsoidal", "unstated"):
        missing = f"the cloud's CRS ({cloud.name})"
    if heights and agree and missing:
        sentence = f"{name}: {missing} names no vertical datum; that of the other is assumed."
        notes = (PcfixWarning("crs.heights_assumed", sentence),)
    if agree and is_same_numbers(source, cloud, heights=heights):
        return None, notes
    # a search for the code of a CRS takes long
    plan = "" if agree else typed(parts(source)[0])
    instead = f"or, if the heights agree with the cloud's, give the file's CRS as {plan}"
    step = transformation(source, cloud, at, name, heights=not agree, instead=instead)
    return step.forward, (*step.notes, *notes)

"""Transformations between CRS that say what they cannot do.

PROJ takes a ballpark transformation where the grid of a better one is not installed: heights then
stay as they are, some 50 m off, and horizontal datums count as one. Here that is an error which
names the grid, or a note.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.crs import heights_of, is_same, metres_up, parts

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pyproj import CRS, Transformer
    from pyproj.transformer import AreaOfInterest, TransformerGroup

    from pcfix.model import FloatArray

    Points = Callable[[FloatArray], FloatArray]

SILENT_ACCURACY_M = 1.0
"""A transformation that is worse than this gets a note."""
_AREA_MARGIN_DEG = 0.01


class HeightsError(InputError):
    """Heights of two systems that cannot be brought together."""


@dataclass(frozen=True, eq=False)
class Transformation:
    """From one CRS to another.

    Attributes
    ----------
    forward : callable
        From points (n, 3) to points (n, 3), x east or longitude first; not finite where a point
        has no place in the other CRS.
    notes : tuple of str
        What a user should know of it.
    """

    forward: Points
    notes: tuple[str, ...] = ()


def transformation_in_plan(source: CRS, target: CRS, at: FloatArray, name: str) -> Transformation:
    """Return the horizontal transformation; heights change their unit and nothing else.

    Parameters
    ----------
    source, target : CRS
        Not geocentric.
    at : array, shape (n, 3)
        Where it is needed, in `source`.
    name : str
        What is transformed, for messages.

    Raises
    ------
    InputError
        If the datums differ by a grid that is not installed and PROJ has nothing else.
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

    Raises
    ------
    HeightsError
        If the heights cannot be brought over, as where a grid is not installed.
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

"""Which points of a cloud are compared with which of a reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pcfix.blocks import FEW_ROWS, blocks, bounds, empty, kept, mapped
from pcfix.clean.neighbours import nearest_of
from pcfix.compare.nearest import mean_spacing_m
from pcfix.errors import GeometryError, InputError, SettingError
from pcfix.model import BoolArray, FloatArray, IntArray, WaterSurface
from pcfix.options.steps import CompareRules

GAP_SPACINGS, MIN_GAP_M = 5.0, 1.0
"""How far outside the other cloud a point still counts, unless the user says so."""


@dataclass(frozen=True, eq=False)
class SurveyCloud:
    """The n points of a cloud that count; world frame, metres."""

    name: str  # for messages
    xyz: FloatArray  # (n, 3)
    crs: Any  # pyproj.CRS or None
    left_out: int  # points withheld, or of a class that does not count
    shift_m: FloatArray | None  # (n, 3), true minus apparent, of a cloud that pcfix corrected
    bathymetric: BoolArray  # (n,), class 40
    water_m: FloatArray  # (n,), height of the water above each point; NaN where not known
    water: WaterSurface | None = None  # itself, where it is known away from the points too

    def __len__(self) -> int:
        return len(self.xyz)

    @cached_property
    def apparent(self) -> FloatArray | None:
        """Where the points were before the correction, shape (n, 3), metres."""
        return None if self.shift_m is None else mapped(np.subtract, self.xyz, self.shift_m)

    def take(self, rows: BoolArray) -> SurveyCloud:
        """Return the cloud with these rows alone; itself where these are all."""
        if rows.all():
            return self
        return replace(
            self,
            xyz=kept(rows, self.xyz),
            shift_m=None if self.shift_m is None else kept(rows, self.shift_m),
            bathymetric=kept(rows, self.bathymetric),
            water_m=kept(rows, self.water_m),
        )


@dataclass(frozen=True, eq=False)
class Reference:
    """Heights that are taken as true: m points in the world frame."""

    name: str  # for messages
    xyz: FloatArray  # (m, 3), metres
    crs: Any  # pyproj.CRS or None
    left_out: int = 0  # points withheld, of noise, or of water; cells without data
    sparse: bool = False  # whether these are single check points, not a sampled surface
    raster: bool = False  # whether these are the centres of cells

    @property
    def kind(self) -> str:
        """Of the `SIGMA_REFERENCE_M`."""
        return "table of check points" if self.sparse else "raster" if self.raster else "cloud"


@dataclass(frozen=True, eq=False)
class Match:
    """A cloud and a reference, of each the points that are compared."""

    whole: SurveyCloud  # all points that are neither withheld nor noise
    cloud: SurveyCloud  # the n points of it to compare
    wet: BoolArray  # (n,), which of these are under water
    dry: BoolArray  # which of the whole cloud are above the water
    reference: Reference
    places: FloatArray  # (p, 3), points of the reference that the cloud reaches, metres
    asked: SurveyCloud  # of the cloud, the points that may be the nearest to one of these
    outside: int  # points that were not chosen, as the next; check points where that is what counts
    not_submerged: int
    settings: CompareRules

    @cached_property
    def water_points(self) -> FloatArray:
        """The water surface above the points that know it, shape (w, 3), metres."""
        known = mapped(np.isfinite, self.whole.water_m)
        if not known.any():
            return np.empty((0, 3))
        xyz, water_m = kept(known, self.whole.xyz), kept(known, self.whole.water_m)
        return mapped(lambda p, w: np.column_stack([p[:, :2], w]), xyz, water_m)

    def water_at(self, xy: FloatArray) -> FloatArray | None:
        """Return the height of the water at places (n, 2); None where unknown.

        It is the surface's own, or that above the nearest point that knows it.
        """
        if self.whole.water is not None:
            from pcfix.water.surface import surface_above  # with its compiler, not quick to load

            water = self.whole.water
            return mapped(
                lambda p: surface_above(water, np.column_stack([p, p[:, 0]])).height_m, xy
            )
        if len(self.water_points) == 0:
            return None
        height = empty((len(xy),))
        for rows, _, _, near in nearest_of(xy, self.water_points, 1, 2):
            height[rows] = near[:, 0, 2]
        return height


def match(whole: SurveyCloud, target: Reference, settings: CompareRules, *, given: bool) -> Match:
    """Choose the points to compare.

    Where the user has `given` the water surface it counts, else what the cloud says, its classes
    too. A `PcfixError` if nothing is under water where that was asked for, or the two do not
    overlap, or C2C is wanted in a direction that the reference does not have.
    """
    _check_direction(target, settings)
    wet = mapped(lambda xyz, water: xyz[:, 2] < water, whole.xyz, whole.water_m)
    if not given:
        wet |= whole.bathymetric
    chosen = wet if settings.submerged else np.ones(len(whole), np.bool_)
    if not chosen.any():
        raise InputError(
            f"{whole.name}: no point is of class 40 or below the water; give the surface with"
            " --water, or compare without --submerged."
        )
    not_submerged = int(len(whole) - chosen.sum())
    places, near = target.xyz, chosen
    if target.sparse or settings.from_reference:
        gap = _gap(whole.xyz, settings)
        places = kept(near_in_plan(places, kept(chosen, whole.xyz), gap), places)
    if target.sparse:
        outside = len(target.xyz) - len(places)
    else:
        gap = _gap(target.xyz, settings)
        near = chosen & near_in_plan(whole.xyz, target.xyz, gap)
        outside = int(chosen.sum() - near.sum())
    if not (near.any() and len(places)):
        raise GeometryError(
            f"{whole.name} and {target.name} do not overlap in plan: the points to compare lie in"
            f" {_bounds(kept(chosen, whole.xyz))}, the reference in {_bounds(target.xyz)}; check"
            " the CRS of both."
        )
    cloud = whole.take(near)
    asked = whole.take(chosen) if settings.from_reference and not target.sparse else cloud
    found = Match(
        whole, cloud, kept(near, wet), ~wet, target, places, asked, outside, not_submerged, settings
    )  # fmt: skip
    by_place = target.sparse or settings.from_reference
    return _only_wet_places(found) if by_place and settings.submerged else found


def _check_direction(target: Reference, settings: CompareRules) -> None:
    """Refuse C2C that a reference is not made for."""
    if target.raster and settings.from_reference:
        raise SettingError(
            f"{target.name}: is a raster, whose cells are no measured points, and --direction"
            f" {settings.direction} starts at those of the reference; give the reference as points"
            " (.las, .laz), or leave --direction out."
        )
    if target.sparse and settings.direction not in (None, "from-reference"):
        raise SettingError(
            f"{target.name}: holds check points, too far apart to be the nearest ones of a cloud;"
            f" give --direction from-reference instead of {settings.direction}, or leave it out."
        )


def _only_wet_places(found: Match) -> Match:
    """Leave out points of the reference above the water, where the water is known."""
    surface = found.water_at(found.places[:, :2])
    if surface is None:
        return found
    wet = mapped(lambda xyz, water: xyz[:, 2] < water, found.places, surface)
    if not wet.any():
        raise GeometryError(
            f"{found.reference.name}: no check point is under water; compare without --submerged."
            if found.reference.sparse
            else f"{found.reference.name}: no point near the cloud is under water; compare without"
            " --submerged."
        )
    dry = int((~wet).sum()) if found.reference.sparse else 0
    return replace(found, places=kept(wet, found.places), not_submerged=found.not_submerged + dry)


def _gap(xyz: FloatArray, settings: CompareRules) -> float:
    return settings.max_gap or max(GAP_SPACINGS * mean_spacing_m(xyz), MIN_GAP_M)


def _bounds(xyz: FloatArray) -> str:
    (x0, y0), (x1, y1) = bounds(xyz[:, :2])
    return f"x {x0:.1f} to {x1:.1f}, y {y0:.1f} to {y1:.1f}"


MAX_TABLE = 50_000_000
"""Squares up to which each has a place of its own in memory."""


def near_in_plan(xy: FloatArray, other_xy: FloatArray, limit_m: float) -> BoolArray:
    """Return which points have a point of the other cloud about them in plan.

    The plan is cut into squares of side `limit_m`; a point, (n, 2) or (n, 3) in metres, counts when
    its own square or one of the eight around it holds a point of the other cloud, (m, 2 or 3). So
    all within the limit count, and none beyond 2.83 times the limit.
    """
    low, high = bounds(other_xy[:, :2])
    columns, rows = (int(n / limit_m) + 6 for n in high - low)
    low = low - 2.0 * limit_m
    high = low + np.array([columns, rows]) * limit_m
    steps = np.array([-1, 0, 1])
    around = (steps[:, np.newaxis] * columns + steps).ravel()
    parts = (other_xy[some] for some in blocks(len(other_xy), FEW_ROWS))
    codes = (_codes(part, low, limit_m, columns) for part in parts)
    table = np.zeros(columns * rows if columns * rows <= MAX_TABLE else 0, np.bool_)
    for some in codes if len(table) else ():
        table[some] = True
    held = np.flatnonzero(table) if len(table) else np.unique(np.hstack([*map(np.unique, codes)]))
    near = (held[:, np.newaxis] + around).ravel()
    table[near if len(table) else []] = True
    found = empty((len(xy),), np.bool_)
    for block in blocks(len(xy), FEW_ROWS):
        x, y = xy[block, 0], xy[block, 1]
        inside = (x >= low[0]) & (x < high[0]) & (y >= low[1]) & (y < high[1])
        asked = _codes(kept(inside, xy[block]), low, limit_m, columns)
        inside[inside] = table[asked] if len(table) else np.isin(asked, near)
        found[block] = inside
    return found


def _codes(xy: FloatArray, low: FloatArray, side_m: float, columns: int) -> IntArray:
    column = ((xy[:, 0] - low[0]) / side_m).astype(np.int64)
    row = ((xy[:, 1] - low[1]) / side_m).astype(np.int64)
    return np.asarray(row * columns + column)

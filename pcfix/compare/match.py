"""Which points of a cloud are compared with which of a reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pcfix.compare.nearest import Neighbours, mean_spacing_m
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
        return None if self.shift_m is None else self.xyz - self.shift_m

    def take(self, rows: BoolArray) -> SurveyCloud:
        """Return the cloud with these rows alone."""
        return replace(
            self,
            xyz=self.xyz[rows],
            shift_m=None if self.shift_m is None else self.shift_m[rows],
            bathymetric=self.bathymetric[rows],
            water_m=self.water_m[rows],
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
    dry_xy: FloatArray  # (d, 2), where the whole cloud is above the water, metres
    reference: Reference
    places: FloatArray  # (p, 3), points of the reference that the cloud reaches, metres
    asked: SurveyCloud  # of the cloud, the points that may be the nearest to one of these
    outside: int  # points that were not chosen, as the next; check points where that is what counts
    not_submerged: int
    settings: CompareRules

    @cached_property
    def water_points(self) -> FloatArray:
        """The water surface above the points that know it, shape (w, 3), metres."""
        known = np.isfinite(self.whole.water_m)
        return np.column_stack([self.whole.xyz[known, :2], self.whole.water_m[known]])

    def water_at(self, xy: FloatArray) -> FloatArray | None:
        """Return the height of the water at places (n, 2); None where unknown.

        It is the surface's own, or that above the nearest point that knows it.
        """
        if self.whole.water is not None:
            from pcfix.water.surface import surface_above  # with its compiler, not quick to load

            return surface_above(self.whole.water, np.column_stack([xy, xy[:, 0]])).height_m
        if len(self.water_points) == 0:
            return None
        _, row = Neighbours(self.water_points[:, :2]).nearest(xy)
        return np.asarray(self.water_points[row, 2])


def match(whole: SurveyCloud, target: Reference, settings: CompareRules, *, given: bool) -> Match:
    """Choose the points to compare.

    Where the user has `given` the water surface it counts, else what the cloud says, its classes
    too. A `PcfixError` if nothing is under water where that was asked for, or the two do not
    overlap, or C2C is wanted in a direction that the reference does not have.
    """
    _check_direction(target, settings)
    below = whole.xyz[:, 2] < whole.water_m
    wet = below if given else whole.bathymetric | below
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
        places = places[near_in_plan(places[:, :2], whole.xyz[chosen, :2], gap)]
    if target.sparse:
        outside = len(target.xyz) - len(places)
    else:
        gap = _gap(target.xyz, settings)
        near = chosen & near_in_plan(whole.xyz[:, :2], target.xyz[:, :2], gap)
        outside = int(chosen.sum() - near.sum())
    if not (near.any() and len(places)):
        raise GeometryError(
            f"{whole.name} and {target.name} do not overlap in plan: the points to compare lie in"
            f" {_bounds(whole.xyz[chosen])}, the reference in {_bounds(target.xyz)}; check the"
            " CRS of both."
        )
    cloud = whole.take(near)
    asked = whole.take(chosen) if settings.from_reference and not target.sparse else cloud
    found = Match(
        whole, cloud, wet[near], whole.xyz[~wet, :2], target, places, asked, outside,
        not_submerged, settings,
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
    wet = found.places[:, 2] < surface
    if not wet.any():
        raise GeometryError(
            f"{found.reference.name}: no check point is under water; compare without --submerged."
            if found.reference.sparse
            else f"{found.reference.name}: no point near the cloud is under water; compare without"
            " --submerged."
        )
    dry = int((~wet).sum()) if found.reference.sparse else 0
    return replace(found, places=found.places[wet], not_submerged=found.not_submerged + dry)


def _gap(xyz: FloatArray, settings: CompareRules) -> float:
    return settings.max_gap or max(GAP_SPACINGS * mean_spacing_m(xyz[:, :2]), MIN_GAP_M)


def _bounds(xyz: FloatArray) -> str:
    (x0, y0), (x1, y1) = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    return f"x {x0:.1f} to {x1:.1f}, y {y0:.1f} to {y1:.1f}"


MAX_TABLE = 50_000_000
"""Squares up to which each has a place of its own in memory."""


def near_in_plan(xy: FloatArray, other_xy: FloatArray, limit_m: float) -> BoolArray:
    """Return which points have a point of the other cloud about them in plan.

    The plan is cut into squares of side `limit_m`; a point, (n, 2) in metres, counts when its own
    square or one of the eight around it holds a point of the other cloud, (m, 2). So all within the
    limit count, and none beyond 2.83 times the limit.
    """
    low = np.array([other_xy[:, 0].min(), other_xy[:, 1].min()]) - 2.0 * limit_m
    columns = int(np.ptp(other_xy[:, 0]) / limit_m) + 6
    rows = int(np.ptp(other_xy[:, 1]) / limit_m) + 6
    near = np.zeros(len(xy), np.bool_)
    high = low + np.array([columns, rows]) * limit_m
    x, y = xy[:, 0], xy[:, 1]
    inside = np.flatnonzero((x >= low[0]) & (x < high[0]) & (y >= low[1]) & (y < high[1]))
    steps = np.array([-1, 0, 1])
    around = (steps[:, np.newaxis] * columns + steps).ravel()
    asked, held = (_codes(p, low, limit_m, columns) for p in (xy[inside], other_xy))
    if columns * rows > MAX_TABLE:
        near[inside] = np.isin(asked, (np.unique(held)[:, np.newaxis] + around).ravel())
        return near
    table = np.zeros(columns * rows, np.bool_)
    table[held] = True
    table[(np.flatnonzero(table)[:, np.newaxis] + around).ravel()] = True
    near[inside] = table[asked]
    return near


def _codes(xy: FloatArray, low: FloatArray, side_m: float, columns: int) -> IntArray:
    column = ((xy[:, 0] - low[0]) / side_m).astype(np.int64)
    row = ((xy[:, 1] - low[1]) / side_m).astype(np.int64)
    return np.asarray(row * columns + column)

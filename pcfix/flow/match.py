"""Which points of a cloud are compared with which of a reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pcfix.compare.neighbours import Neighbours, mean_spacing_m
from pcfix.compare.overlap import near_in_plan
from pcfix.errors import GeometryError, InputError
from pcfix.flow.comparison import CompareSettings  # noqa: TC001 - dataclass fields
from pcfix.io.clouds import Reference, SurveyCloud, check_same_crs, read_cloud, read_reference
from pcfix.io.files import check_input
from pcfix.model import BoolArray, FloatArray, WaterSurface  # noqa: TC001 - dataclass fields

if TYPE_CHECKING:
    from os import PathLike

    AnyPath = str | PathLike[str]

GAP_SPACINGS, MIN_GAP_M = 5.0, 1.0
"""How far outside the other cloud a point still counts, unless the user says so."""


@dataclass(frozen=True, eq=False)
class Match:
    """A cloud and a reference, of each the points that are compared.

    Attributes
    ----------
    whole : SurveyCloud
        All points that are neither withheld nor noise.
    cloud : SurveyCloud
        Those of them to compare; n points.
    wet : array of bool, shape (n,)
        Which of these are under water.
    dry_xy : array, shape (d, 2)
        Where the whole cloud is above the water, metres.
    reference : Reference
    places : array, shape (p, 3)
        Points of the reference that the cloud reaches, metres.
    outside, not_submerged : int
        Points that were not chosen.
    settings : CompareSettings
    """

    whole: SurveyCloud
    cloud: SurveyCloud
    wet: BoolArray
    dry_xy: FloatArray
    reference: Reference
    places: FloatArray
    outside: int
    not_submerged: int
    settings: CompareSettings

    @cached_property
    def apparent(self) -> FloatArray | None:
        """Where the points were before the correction, shape (n, 3), metres."""
        return None if self.cloud.shift_m is None else self.cloud.xyz - self.cloud.shift_m

    @cached_property
    def water_points(self) -> FloatArray:
        """The water surface above the points that know it, shape (w, 3), metres."""
        known = np.isfinite(self.whole.water_m)
        return np.column_stack([self.whole.xyz[known, :2], self.whole.water_m[known]])

    def water_at(self, xy: FloatArray) -> FloatArray | None:
        """Return the height of the water surface at places (n, 2); None where unknown."""
        return _water_at(xy, self.whole.water, self.water_points)


def _water_at(
    xy: FloatArray, water: WaterSurface | None, water_points: FloatArray
) -> FloatArray | None:
    """Return the surface's own height, or that above the nearest point that knows it."""
    if water is not None:
        from pcfix.water.surface import surface_above  # with its compiler, not quick to load

        return surface_above(water, np.column_stack([xy, xy[:, 0]])).height_m
    if len(water_points) == 0:
        return None
    _, row = Neighbours(water_points[:, :2]).nearest(xy)
    return np.asarray(water_points[row, 2])


def match(
    cloud: AnyPath,
    reference: AnyPath,
    water: WaterSurface | float | AnyPath | None,
    settings: CompareSettings,
) -> Match:
    """Read both files and choose the points to compare.

    Parameters
    ----------
    cloud, reference, water
        See `pcfix.flow.compare.compare_clouds`.
    settings : CompareSettings

    Raises
    ------
    PcfixError
        If a file is damaged, the CRS differ, nothing is under water where that was asked for, or
        the two do not overlap.
    """
    given = None
    if water is not None:
        from pcfix.flow.surfaces import WaterWords, find_surface, view_of  # not quick to load

        given = find_surface(WaterWords(water), view_of(check_input(cloud))).surface
    target, whole = read_reference(reference), read_cloud(cloud, given)
    check_same_crs(whole.name, whole.crs, target.name, target.crs)
    wet = _submerged(whole, given=given is not None)
    chosen = _wanted(whole, wet, settings)
    not_submerged = int(len(whole) - chosen.sum())
    if target.sparse:
        held = near_in_plan(target.xyz[:, :2], whole.xyz[chosen, :2], _gap(whole.xyz, settings))
        near, places = chosen, target.xyz[held]
        outside = int((~held).sum())
    else:
        near = chosen & near_in_plan(
            whole.xyz[:, :2], target.xyz[:, :2], _gap(target.xyz, settings)
        )
        places, outside = target.xyz, int(chosen.sum() - near.sum())
    if not (near.any() and len(places)):
        raise GeometryError(
            f"{whole.name} and {target.name} do not overlap in plan: the points to compare lie in"
            f" {_bounds(whole.xyz[chosen])}, the reference in {_bounds(target.xyz)}; check the"
            " CRS of both."
        )
    found = Match(
        whole, whole.take(near), wet[near], whole.xyz[~wet, :2], target, places, outside,
        not_submerged, settings,
    )  # fmt: skip
    return _only_wet_places(found) if target.sparse and settings.submerged else found


def _submerged(cloud: SurveyCloud, *, given: bool) -> BoolArray:
    """Return which points are under water, by the given surface or else by what the cloud says."""
    below = cloud.xyz[:, 2] < cloud.water_m
    return np.asarray(below if given else cloud.bathymetric | below)


def _wanted(cloud: SurveyCloud, wet: BoolArray, settings: CompareSettings) -> BoolArray:
    """Return which points the user wants compared."""
    if not settings.submerged:
        return np.ones(len(cloud), np.bool_)
    if not wet.any():
        raise InputError(
            f"{cloud.name}: no point is of class 40 or below the water; give the surface with"
            " --water, or compare without --submerged."
        )
    return wet


def _only_wet_places(found: Match) -> Match:
    """Leave out check points above the water, where the water is known."""
    surface = found.water_at(found.places[:, :2])
    if surface is None:
        return found
    wet = found.places[:, 2] < surface
    if not wet.any():
        raise GeometryError(
            f"{found.reference.name}: no check point is under water; compare without --submerged."
        )
    return replace(
        found,
        places=found.places[wet],
        not_submerged=found.not_submerged + int((~wet).sum()),
    )


def _gap(xyz: FloatArray, settings: CompareSettings) -> float:
    return settings.max_gap_m or max(GAP_SPACINGS * mean_spacing_m(xyz[:, :2]), MIN_GAP_M)


def _bounds(xyz: FloatArray) -> str:
    (x0, y0), (x1, y1) = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    return f"x {x0:.1f} to {x1:.1f}, y {y0:.1f} to {y1:.1f}"

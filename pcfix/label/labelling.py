"""Which points are submerged, and which class they get: one rule for every door.

A point is submerged if it lies below the water surface, is inside the mask where there is one,
does not come with a class to respect, and, where that is asked for, belongs to water that is
joined. Within the dead band its surroundings decide instead of its own height: each point inside
the mask, and of no class to respect, has a vote, its height above the surface divided by the dead
band and cut to -1 ... 1; a point within the dead band is submerged if the votes of its cell and
the eight cells around it are negative together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError
from pcfix.label.areas import Grid, Lattice, Pools, Surroundings, WaterMask
from pcfix.model import (
    BATHYMETRIC_POINT,
    UNCLASSIFIED,
    WATER_SURFACE,
    BoolArray,
    FloatArray,
    IntArray,
)
from pcfix.options.correct import LabelRules
from pcfix.water.surface import SurfaceAbove, is_submerged

Classes = npt.NDArray[np.uint8]


"""ASPRS classes (LAS 1.4 R15, table 17, and its topo-bathy lidar domain profile)."""


class Part(NamedTuple):
    """Some points of a cloud: shape (n, 3), metres; the water above them; shape (n,)."""

    xyz: FloatArray
    surface: SurfaceAbove
    classes: Classes


class Labels(NamedTuple):
    """What n points become: their classes, and which of them got 40 and 41 just now."""

    classes: Classes
    submerged: BoolArray
    at_surface: BoolArray


class Labelling:
    """The settings, mask and surroundings of a labelling, and what it left out so far (`left_out`).

    Parameters
    ----------
    settings : LabelRules
    mask : WaterMask or None
    """

    def __init__(self, settings: LabelRules, mask: WaterMask | None = None) -> None:
        self.settings, self.mask = settings, mask
        self._around: Surroundings | None = None
        self.restart()

    def restart(self) -> None:
        """Forget the points so far, but not their surroundings."""
        self.left_out = LeftOut(self.settings, self.mask, self._around)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was done to the mask on reading it."""
        return () if self.mask is None else self.mask.notes

    @property
    def is_plain(self) -> bool:
        """Whether all that counts for being submerged is to lie below the surface."""
        s = self.settings
        return self.mask is None and not (s.respect_classes or s.connected or s.dead_band)

    @property
    def looks_around(self) -> bool:
        """Whether `look_around` must see the whole cloud first."""
        return self.settings.connected or self.settings.dead_band > 0.0

    def look_around(
        self, parts: Callable[[], Iterable[Part]], low: FloatArray, high: FloatArray
    ) -> None:
        """Learn the surroundings of all points.

        Parameters
        ----------
        parts : callable
            Returns the whole cloud, part by part; called again if the corners were wrong.
        low, high : array, shape (2,)
            South-west and north-east corner of the cloud, as far as they are known.
        """
        settings = self.settings
        if not (np.isfinite([low, high]).all() and (low <= high).all()):
            low = high = np.zeros(2)
        while True:
            grid = Grid(low, high, settings.dead_band)
            for part in parts():
                x, y, z = np.ascontiguousarray(part.xyz.T)
                height = z - part.surface.height_m
                grid.add(x, y, height, self._counting(x, y, height, part.classes))
            if grid.fits:
                break
            low, high = grid.low, grid.high
        self._around = grid.surroundings(
            connected=settings.connected, least_pool_m2=settings.least_pool
        )
        self.restart()

    def _counting(
        self, x: FloatArray, y: FloatArray, height: FloatArray, classes: Classes
    ) -> BoolArray:
        """Return which points count; high ones do not matter without a dead band."""
        counts = np.ones(len(x), np.bool_) if self.settings.dead_band else height < 0.0
        if self.settings.respect_classes:
            counts &= ~np.isin(classes, self.settings.respect_classes)
        if self.mask is not None:
            rows = np.flatnonzero(counts)
            counts[rows] = self.mask.inside(x[rows], y[rows])
        return counts

    def submerged(self, xyz: FloatArray, surface: SurfaceAbove, classes: Classes) -> BoolArray:
        """Return which of n points are submerged, and count those that are not although below.

        Parameters
        ----------
        xyz : array, shape (n, 3)
            Metres, world frame.
        surface : SurfaceAbove
        classes : array, shape (n,)
            That they come with.
        """
        below = is_submerged(xyz[:, 2], surface)
        if self.is_plain:
            return below
        height = xyz[:, 2] - surface.height_m
        wet = below | self._within(height, self.settings.dead_band)
        rows = np.flatnonzero(wet)
        wet[rows] = self._decided(xyz[rows], height[rows], classes[rows])
        return wet

    def labels(self, part: Part) -> Labels:
        """Return what points become; the classes of all that is not submerged stay."""
        wet = self.submerged(*part)
        new = part.classes.copy()
        if self.settings.reset:
            old = sets_class(part.classes) & ~np.isin(part.classes, self.settings.respect_classes)
            new[old] = UNCLASSIFIED
        at_surface = np.zeros(len(wet), np.bool_)
        if self.settings.band > 0.0:
            at_surface[self._at_surface(*part)] = True
        wet &= ~at_surface
        new[wet], new[at_surface] = BATHYMETRIC_POINT, WATER_SURFACE
        return Labels(new, wet, at_surface)

    def _at_surface(self, xyz: FloatArray, surface: SurfaceAbove, classes: Classes) -> IntArray:
        """Return the rows of points in the band.

        With `connected` they need water that stays in their cell or beside it.
        """
        near = self._within(xyz[:, 2] - surface.height_m, self.settings.band)
        near &= ~np.isin(classes, self.settings.respect_classes)
        rows = np.flatnonzero(near)
        x, y = np.ascontiguousarray(xyz[rows, :2].T)
        keep = np.ones(len(rows), np.bool_) if self.mask is None else self.mask.inside(x, y)
        if self._around is not None and self._around.joined is not None:
            keep &= self._around.joined[self._around.cells(x, y)]
        return rows[keep]

    def _within(self, height: FloatArray, reach_m: float) -> BoolArray:
        return np.asarray(np.abs(height) <= reach_m) if reach_m else np.zeros(len(height), np.bool_)

    def _decided(self, xyz: FloatArray, height: FloatArray, classes: Classes) -> BoolArray:
        """Return which points that are below or within the dead band are submerged."""
        x, y, _ = np.ascontiguousarray(xyz.T)
        below = height < 0.0
        inside = np.ones(len(x), np.bool_) if self.mask is None else self.mask.inside(x, y)
        respected = np.isin(classes, self.settings.respect_classes)
        self.left_out.add(x[below], y[below], inside[below], respected[below])
        wet = inside & ~respected
        if self._around is not None:
            wet = self._decided_around(self._around, x, y, height, wet)
        return wet

    def _decided_around(
        self, around: Surroundings, x: FloatArray, y: FloatArray, height: FloatArray, wet: BoolArray
    ) -> BoolArray:
        """Return what the surroundings leave of the submerged points."""
        row, column = around.cells(x, y)
        unsure = self._within(height, self.settings.dead_band)
        if unsure.any():
            wet = wet & (~unsure | around.is_wet[row, column])
        if around.pools is not None:
            number = around.pools.number[row, column]
            stays = around.pools.stays[number]
            self.left_out.add_separate(number[wet & ~stays])
            wet = wet & stays
        return wet

    def check(self, name: str) -> None:
        """See `LeftOut.check`."""
        self.left_out.check(name)

    def report(self) -> dict[str, Any] | None:
        """Return what was left out, in plain values; None if there was no rule to leave out."""
        return None if self.is_plain else self.left_out.as_dict()


def sets_class(classes: Classes) -> BoolArray:
    """Return which classes are among those that a labelling sets."""
    return np.asarray((classes == BATHYMETRIC_POINT) | (classes == WATER_SURFACE))


class LeftOut:
    """Counts of points below the surface, and of those among them that a rule left out.

    Parameters
    ----------
    settings : LabelRules
    mask : WaterMask or None
    around : Surroundings or None
        Where there are pools, they are counted one by one.
    """

    def __init__(
        self, settings: LabelRules, mask: WaterMask | None, around: Surroundings | None
    ) -> None:
        self._settings, self._mask, self._around = settings, mask, around
        self.below = self.outside_mask = self.respected = 0
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)
        pools = None if around is None else around.pools
        self._in_pool = np.zeros(0 if pools is None else len(pools.stays), np.int64)

    def add(self, x: FloatArray, y: FloatArray, inside: BoolArray, respected: BoolArray) -> None:
        """Add n points below the surface: whether inside the mask, and of a class to respect."""
        self.below += len(x)
        self.outside_mask += int((~inside).sum())
        self.respected += int((inside & respected).sum())
        if len(x):
            self._low = np.minimum(self._low, [x.min(), y.min()])
            self._high = np.maximum(self._high, [x.max(), y.max()])

    def add_separate(self, number: npt.NDArray[np.int32]) -> None:
        """Add points that were left out, by the numbers of their pools."""
        self._in_pool += np.bincount(number, minlength=len(self._in_pool))

    def check(self, name: str) -> None:
        """Refuse a mask, or classes to respect, that leave none of the points below the surface.

        Raises
        ------
        GeometryError
            With where mask and points lie, or with the classes.
        """
        if self.respected and self.below == self.outside_mask + self.respected:
            respected = ", ".join(map(str, self._settings.respect_classes))
            raise GeometryError(
                f"{name}: all {self.respected:,} points below the water come with the classes to"
                f" respect ({respected}); respect fewer."
            )
        if self._mask is None or self.outside_mask < max(self.below, 1):
            return
        west, south, east, north = self._mask.bounds
        raise GeometryError(
            f"{self._mask.name}: the mask holds none of the {self.below:,} points of {name} that"
            f" are below the water: its polygons lie at {_extent(west, east, south, north)}, these"
            f" points at {_extent(self._low[0], self._high[0], self._low[1], self._high[1])}; check"
            " the CRS of both, and that the polygons are of water."
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the rules and what they left out, in plain values."""
        return {
            "settings": asdict(self._settings),
            "water_mask": None if self._mask is None else self._mask.name,
            "below": self.below,
            "outside_mask": self.outside_mask,
            "respected": self.respected,
            "cell_m": None if self._around is None else self._around.lattice.side_m,
            "separate": self._separate(),
        }

    def _separate(self) -> dict[str, Any] | None:
        """Return how many points were left out in pools that are apart, and the largest of them."""
        if self._around is None or self._around.pools is None:
            return None
        pools = self._around.pools
        area = np.where(self._in_pool > 0, pools.area_m2, 0.0)
        count, points = int((area > 0.0).sum()), int(self._in_pool.sum())
        largest = self._told(int(np.argmax(area)), self._around.lattice, pools) if count else None
        return {"pools": count, "points": points, "largest": largest}

    def _told(self, pool: int, lattice: Lattice, pools: Pools) -> dict[str, float]:
        """Return the area of a pool, its points, and a place that surely is in it."""
        cells = np.argwhere(pools.number == pool)
        row, column = cells[len(cells) // 2]
        return {
            "area_m2": round(float(pools.area_m2[pool]), 2),
            "points": int(self._in_pool[pool]),
            "x": float((lattice.first_column + column + 0.5) * lattice.side_m),
            "y": float((lattice.first_row + row + 0.5) * lattice.side_m),
        }


def _extent(west: float, east: float, south: float, north: float) -> str:
    return f"x {west:.1f} to {east:.1f}, y {south:.1f} to {north:.1f}"


@dataclass(frozen=True)
class LabelSummary:
    """What a labelling did, in numbers; `as_dict` is what ``--summary`` writes.

    Attributes
    ----------
    points, submerged, water_surface : int
        In all; of class 40 now because they are submerged; of class 41 because in the band.
    stale : int
        Points that came as class 40 or 41 and are neither: class 1 with `reset`, else as they
        came.
    water_unknown : int
        Points without a known height of the water.
    labelling : dict or None
        What was left out, by the rules beyond the surface.
    """

    input: str
    output: str
    pcfix: str
    points: int
    submerged: int
    water_surface: int
    stale: int
    water_unknown: int
    water: str
    settings: dict[str, Any]
    labelling: dict[str, Any] | None
    seconds: float
    warnings: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return vars(self).copy()

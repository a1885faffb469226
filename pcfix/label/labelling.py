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
from pcfix.label.areas import Grid, Surroundings, WaterMask
from pcfix.model import (
    BATHYMETRIC_POINT,
    UNCLASSIFIED,
    WATER_SURFACE,
    BoolArray,
    FloatArray,
    IntArray,
)
from pcfix.options.correct import LabelRules
from pcfix.sums import Sums
from pcfix.water.surface import SurfaceAbove, is_submerged

Classes = npt.NDArray[np.uint8]


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


class Labelling(Sums):
    """The rules of a labelling, the surroundings of its points, and what it left out so far."""

    added = ("_below", "_outside_mask", "_respected", "_in_pool")
    least, most = ("_low",), ("_high",)

    def __init__(self, settings: LabelRules, mask: WaterMask | None = None) -> None:
        self.settings, self.mask = settings, mask
        self._around: Surroundings | None = None
        self.restart()

    def restart(self) -> None:
        """Forget the points so far, but not their surroundings."""
        self._below = self._outside_mask = self._respected = 0
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)
        pools = None if self._around is None else self._around.pools
        self._in_pool = np.zeros(0 if pools is None else len(pools.stays), np.int64)

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

        `parts` returns the whole cloud, part by part, and is called again if its south-west and
        north-east corner, `low` and `high`, were wrong.
        """
        settings = self.settings
        if not (np.isfinite([low, high]).all() and (low <= high).all()):
            low = high = np.zeros(2)
        while True:
            grid = Grid(low, high, settings.dead_band)
            for part in parts():
                x, y, z = np.ascontiguousarray(part.xyz.T)
                height = z - part.surface.height_m
                # high points have no vote without a dead band
                counts = np.ones(len(x), np.bool_) if settings.dead_band else height < 0.0
                counts &= ~self._is_respected(part.classes)
                rows = np.flatnonzero(counts)
                counts[rows] = self._is_inside(x[rows], y[rows])
                grid.add(x, y, height, counts)
            if grid.fits:
                break
            low, high = grid.low, grid.high
        self._around = grid.surroundings(
            connected=settings.connected, least_pool_m2=settings.least_pool
        )
        self.restart()

    def submerged(self, xyz: FloatArray, surface: SurfaceAbove, classes: Classes) -> BoolArray:
        """Return which of n points are submerged, and count those that are not although below.

        `classes`, shape (n,), are those that they come with.
        """
        below = is_submerged(xyz[:, 2], surface)
        if self.is_plain:
            return below
        height = xyz[:, 2] - surface.height_m
        wet = below | _within(height, self.settings.dead_band)
        rows = np.flatnonzero(wet)
        wet[rows] = self._decided(xyz[rows], height[rows], classes[rows])
        return wet

    def labels(self, part: Part) -> Labels:
        """Return what points become; the classes of all that is not submerged stay."""
        wet = self.submerged(*part)
        new = part.classes.copy()
        if self.settings.reset:
            new[sets_class(part.classes) & ~self._is_respected(part.classes)] = UNCLASSIFIED
        at_surface = np.zeros(len(wet), np.bool_)
        if self.settings.band > 0.0:
            at_surface[self._at_surface(*part)] = True
        wet &= ~at_surface
        new[wet], new[at_surface] = BATHYMETRIC_POINT, WATER_SURFACE
        return Labels(new, wet, at_surface)

    def _is_respected(self, classes: Classes) -> BoolArray:
        return np.isin(classes, self.settings.respect_classes)

    def _is_inside(self, x: FloatArray, y: FloatArray) -> BoolArray:
        return np.ones(len(x), np.bool_) if self.mask is None else self.mask.inside(x, y)

    def _at_surface(self, xyz: FloatArray, surface: SurfaceAbove, classes: Classes) -> IntArray:
        """Return the rows of points in the band.

        With `connected` they need water that stays in their cell or beside it.
        """
        near = _within(xyz[:, 2] - surface.height_m, self.settings.band)
        rows = np.flatnonzero(near & ~self._is_respected(classes))
        x, y = np.ascontiguousarray(xyz[rows, :2].T)
        keep = self._is_inside(x, y)
        if self._around is not None and self._around.joined is not None:
            keep &= self._around.joined[self._around.cells(x, y)]
        return rows[keep]

    def _decided(self, xyz: FloatArray, height: FloatArray, classes: Classes) -> BoolArray:
        """Return which points that are below or within the dead band are submerged."""
        x, y, _ = np.ascontiguousarray(xyz.T)
        below, inside, respected = height < 0.0, self._is_inside(x, y), self._is_respected(classes)
        self._below += int(below.sum())
        self._outside_mask += int((below & ~inside).sum())
        self._respected += int((below & inside & respected).sum())
        self._low = np.minimum(self._low, xyz[below, :2].min(axis=0, initial=np.inf))
        self._high = np.maximum(self._high, xyz[below, :2].max(axis=0, initial=-np.inf))
        wet = inside & ~respected
        if self._around is None:
            return wet
        row, column = self._around.cells(x, y)
        unsure = _within(height, self.settings.dead_band)
        if unsure.any():
            wet = wet & (~unsure | self._around.is_wet[row, column])
        if self._around.pools is not None:
            number = self._around.pools.number[row, column]
            stays = self._around.pools.stays[number]
            self._in_pool += np.bincount(number[wet & ~stays], minlength=len(self._in_pool))
            wet = wet & stays
        return wet

    def check(self, name: str, submerged: int | None = None) -> None:
        """Refuse a mask, classes to respect or a dead band that leave none of the points below.

        Raises
        ------
        GeometryError
            With where mask and points lie, or with the classes; of a dead band if the number of
            points that became `submerged` is told.
        """
        left = self._below - self._outside_mask - self._respected
        if submerged == 0 and left and self.settings.dead_band:
            raise GeometryError(
                f"{name}: {left:,} points lie below the water, but within the dead band of"
                f" {self.settings.dead_band:g} m, and most around them lie above it; give a"
                " narrower --dead-band."
            )
        if self._respected and self._below == self._outside_mask + self._respected:
            respected = ", ".join(map(str, self.settings.respect_classes))
            raise GeometryError(
                f"{name}: all {self._respected:,} points below the water come with the classes to"
                f" respect ({respected}); respect fewer."
            )
        if self.mask is None or self._outside_mask < max(self._below, 1):
            return
        west, south, east, north = self.mask.bounds
        raise GeometryError(
            f"{self.mask.name}: the mask holds none of the {self._below:,} points of {name} that"
            f" are below the water: its polygons lie at {_extent(west, east, south, north)}, these"
            f" points at {_extent(self._low[0], self._high[0], self._low[1], self._high[1])}; check"
            " the CRS of both, and that the polygons are of water."
        )

    def report(self) -> dict[str, Any] | None:
        """Return the rules and what they left out, in plain values; None if there was no rule."""
        if self.is_plain:
            return None
        return {
            "settings": asdict(self.settings),
            "water_mask": None if self.mask is None else self.mask.name,
            "below": self._below,
            "outside_mask": self._outside_mask,
            "respected": self._respected,
            "cell_m": None if self._around is None else self._around.lattice.side_m,
            "separate": self._separate(),
        }

    def _separate(self) -> dict[str, Any] | None:
        """Return how many points were left out in pools that are apart, and the largest of them."""
        if self._around is None or self._around.pools is None:
            return None
        lattice, pools = self._around.lattice, self._around.pools
        area, largest = np.where(self._in_pool > 0, pools.area_m2, 0.0), None
        if area.any():
            pool = int(np.argmax(area))
            cells = np.argwhere(pools.number == pool)
            row, column = cells[len(cells) // 2]  # a place that surely is in it
            largest = {
                "area_m2": round(float(pools.area_m2[pool]), 2),
                "points": int(self._in_pool[pool]),
                "x": float((lattice.first_column + column + 0.5) * lattice.side_m),
                "y": float((lattice.first_row + row + 0.5) * lattice.side_m),
            }
        count, points = int((area > 0.0).sum()), int(self._in_pool.sum())
        return {"pools": count, "points": points, "largest": largest}


def _within(height: FloatArray, reach_m: float) -> BoolArray:
    return np.asarray(np.abs(height) <= reach_m) if reach_m else np.zeros(len(height), np.bool_)


def sets_class(classes: Classes) -> BoolArray:
    """Return which classes are among those that a labelling sets."""
    return np.asarray((classes == BATHYMETRIC_POINT) | (classes == WATER_SURFACE))


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
    part : dict or None
        How many points were read, of how many, and by which bounds; None where all were.
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
    part: dict[str, Any] | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return vars(self).copy()

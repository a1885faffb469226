"""Decide which points are submerged, and set their classes.

A point is submerged if it lies below the water surface, inside the mask if there is one, is not of
a respected class, and, if that is asked for, belongs to the connected water. Within the dead band
its surroundings decide instead of its own height: each point inside the mask and of no respected
class votes with its height above the surface, divided by the dead band and clipped to -1 ... 1. A
point within the dead band is submerged if the votes of its cell and the eight around it sum to a
negative number.

Connected water is found in cells over the cloud, filled chunk by chunk. All sums are of whole
numbers, so that they do not depend on the order of the points.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.cells import CellFrame, Cells, Layer
from pcfix.errors import GeometryError
from pcfix.model import (
    BATHYMETRIC_POINT,
    UNCLASSIFIED,
    WATER_SURFACE,
    BoolArray,
    FloatArray,
    IntArray,
)
from pcfix.options.correct import LabelRules
from pcfix.sums import LEAST, Sums
from pcfix.water.surface import SurfaceAbove, is_submerged

Classes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class WaterMask:
    """The polygons inside which points may be submerged.

    A point on the border, of a hole too, is inside.
    """

    area: Any  # shapely Polygon or MultiPolygon, valid, in the cloud's CRS, metres
    name: str = "mask"  # for messages
    notes: tuple[str, ...] = ()  # of the reader, for the summary

    def inside(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Return which of n plan positions, metres, world frame, are inside."""
        import shapely

        shapely.prepare(self.area)  # does nothing the second time
        return np.asarray(shapely.intersects_xy(self.area, x, y))


SHARE_OF_LARGEST = 0.1
"""Pools of at least this share of the area of the largest water body count as water."""
_VOTE = 1000
_AROUND = np.ones((3, 3), np.bool_)

PRESENT, BELOW, UNDECIDED = 1, 2, 4
"""A cell has points; points below the surface; points within the dead band."""


class Surroundings(NamedTuple):
    """What a grid knows about the cells of points; the rest is None without connected water."""

    frame: CellFrame
    is_wet: BoolArray  # (rows, columns), whether an undecided point in the cell is submerged
    pool: npt.NDArray[np.int32] | None = None  # (rows, columns), 0 for none, else an index below
    stays: BoolArray | None = None  # whether a pool counts as water
    joined: BoolArray | None = None  # (rows, columns), a pool of water is in or next to the cell


class Part(NamedTuple):
    """Some points of a cloud."""

    xyz: FloatArray  # (n, 3), metres
    surface: SurfaceAbove  # the water above them
    classes: Classes  # (n,)


@dataclass(frozen=True)
class LabelCounts(Sums):
    """Counts of points by their new classes, and of those that the rules exclude."""

    points: int = 0
    submerged: int = 0  # of class 40 now because they are submerged
    water_surface: int = 0  # of class 41 now because they are in the band
    stale: int = 0  # class 40 or 41 in the input and neither now; set to 1 with `reset`
    water_unknown: int = 0  # without a known height of the water
    # depth of the point that is nearest to the water surface, negative above it, metres
    least_m: float = field(default=np.inf, metadata=LEAST)
    # points below the water, and how many of them are excluded
    below: int = 0
    outside_mask: int = 0
    respected: int = 0
    in_pool: IntArray | None = None  # points of each separate pool

    def of_classes(self) -> dict[str, int]:
        """Return the counts by new classes, by their names in a summary."""
        names = ("submerged", "water_surface", "stale", "water_unknown", "points")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class Labelling:
    """The rules of a labelling, and the surroundings of its points."""

    settings: LabelRules
    mask: WaterMask | None = None
    around: Surroundings | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on reading the mask."""
        return () if self.mask is None else self.mask.notes

    @property
    def is_plain(self) -> bool:
        """Whether a point is submerged exactly if it lies below the surface."""
        s = self.settings
        return self.mask is None and not (s.respect_classes or s.connected or s.dead_band)

    def scanned(self, parts: Iterable[Part], low: FloatArray, high: FloatArray) -> Labelling:
        """Return the rules with the surroundings of all points, if they need them.

        `parts` are the whole cloud in chunks, and `low` and `high` its corners, if they are known.
        Points are collected in cells, which are coarsened until they have enough points. Water is
        connected over sides, corners, and gaps of at most two cells.
        """
        from scipy.ndimage import binary_dilation, convolve, label

        rules, dead_m = self.settings, self.settings.dead_band
        if not (rules.connected or dead_m):
            return self
        none = Layer(np.zeros((), np.uint8), np.bitwise_or), Layer(np.zeros((), np.int64), np.add)
        cells, water_points = Cells(low, high, *none), 0
        for part in parts:
            if not len(part.xyz):
                continue
            x, y, z = np.ascontiguousarray(part.xyz.T)
            height = z - part.surface.height_m
            # points that may be submerged or vote; the others only show that there is no gap
            counts = ~(np.isnan(height) | self._is_respected(part.classes))
            if not dead_m:
                counts &= height < 0.0
            rows = np.flatnonzero(counts)
            counts[rows] = self._is_inside(x[rows], y[rows])
            cells.cover(np.array([x.min(), y.min()]), np.array([x.max(), y.max()]))
            row, column = cells.frame.cells(x, y)
            flags, votes = cells.values
            cell = row * flags.shape[1] + column
            below = counts & (height < -dead_m)
            unsure = counts & ~below & _within(height, dead_m)
            water_points += int(np.count_nonzero(below | unsure))
            bits = PRESENT + BELOW * below + UNDECIDED * unsure
            np.bitwise_or.at(flags.reshape(-1), cell, bits.astype(np.uint8))
            if dead_m:
                vote = np.rint(_VOTE * np.clip(height[counts] / dead_m, -1.0, 1.0))
                np.add.at(votes.reshape(-1), cell[counts], vote.astype(np.int64))
        if not cells.values[0].size:  # no points
            cells.cover(np.zeros(2), np.zeros(2))
        cells.coarsen(water_points, lambda flags: (flags & (BELOW | UNDECIDED)) > 0)
        frame, (flags, votes) = cells.frame, cells.values
        # the votes of a cell and its eight neighbours together
        is_wet = convolve(votes, np.ones((3, 3)), mode="constant") < 0
        if not rules.connected:
            return replace(self, around=Surroundings(frame, is_wet))
        water = (flags & BELOW) > 0
        if dead_m:
            water |= ((flags & UNDECIDED) > 0) & is_wet
        found, count = label(water | (binary_dilation(water, _AROUND) & (flags == 0)), _AROUND)
        pool = np.where(water, found, 0).astype(np.int32)
        area = frame.side_m**2 * np.bincount(pool[water], minlength=count + 1).astype(np.float64)
        least = SHARE_OF_LARGEST * area.max() if rules.least_pool is None else rules.least_pool
        stays = (area >= least) | (area == area.max())
        stays[0] = False
        joined = binary_dilation(stays[pool], _AROUND)
        return replace(self, around=Surroundings(frame, is_wet, pool, stays, joined))

    def submerged(
        self, xyz: FloatArray, surface: SurfaceAbove, classes: Classes
    ) -> tuple[BoolArray, LabelCounts]:
        """Return which of n points are submerged, and the counts of those that are excluded."""
        below = is_submerged(xyz[:, 2], surface)
        if self.is_plain:
            return below, LabelCounts()
        height, dead_m = xyz[:, 2] - surface.height_m, self.settings.dead_band
        rows = np.flatnonzero(below | _within(height, dead_m))
        x, y = np.ascontiguousarray(xyz[rows, :2].T)
        height, in_pool = height[rows], None
        below, inside = height < 0.0, self._is_inside(x, y)
        respected = self._is_respected(classes[rows])
        wet = inside & ~respected
        if self.around is not None:
            cells = self.around.frame.cells(x, y)
            wet &= ~_within(height, dead_m) | self.around.is_wet[cells]
            if self.around.pool is not None and self.around.stays is not None:
                pool, stays = self.around.pool[cells], self.around.stays
                in_pool = np.bincount(pool[wet & ~stays[pool]], minlength=len(stays))
                wet &= stays[pool]
        submerged = np.zeros(len(xyz), np.bool_)
        submerged[rows] = wet
        return submerged, LabelCounts(
            below=int(below.sum()),
            outside_mask=int((below & ~inside).sum()),
            respected=int((below & inside & respected).sum()),
            in_pool=in_pool,
        )

    def labels(self, part: Part) -> tuple[Classes, LabelCounts]:
        """Return the new classes of points, and their counts; those of land do not change."""
        wet, counts = self.submerged(*part)
        new, respected = part.classes.copy(), self._is_respected(part.classes)
        before = np.isin(part.classes, (BATHYMETRIC_POINT, WATER_SURFACE))
        if self.settings.reset:
            new[before & ~respected] = UNCLASSIFIED
        at_surface = np.zeros(len(wet), np.bool_)
        if self.settings.surface_band > 0.0:
            near = _within(part.xyz[:, 2] - part.surface.height_m, self.settings.surface_band)
            rows = np.flatnonzero(near & ~respected)
            x, y = np.ascontiguousarray(part.xyz[rows, :2].T)
            keep = self._is_inside(x, y)
            if self.around is not None and self.around.joined is not None:
                keep &= self.around.joined[self.around.frame.cells(x, y)]
            at_surface[rows[keep]] = True
        wet &= ~at_surface
        new[wet], new[at_surface] = BATHYMETRIC_POINT, WATER_SURFACE
        return new, replace(
            counts,
            points=len(wet),
            submerged=int(wet.sum()),
            water_surface=int(at_surface.sum()),
            stale=int((before & ~(wet | at_surface)).sum()),
            water_unknown=int(np.isnan(part.surface.height_m).sum()),
            least_m=float(np.fmin.reduce(part.surface.height_m - part.xyz[:, 2], initial=np.inf)),
        )

    def _is_respected(self, classes: Classes) -> BoolArray:
        return np.isin(classes, self.settings.respect_classes)

    def _is_inside(self, x: FloatArray, y: FloatArray) -> BoolArray:
        return np.ones(len(x), np.bool_) if self.mask is None else self.mask.inside(x, y)

    def check(self, name: str, counts: LabelCounts, submerged: int | None = None) -> None:
        """Check that mask, respected classes and dead band leave points below the water."""
        left = counts.below - counts.outside_mask - counts.respected
        dead_m, classes = self.settings.dead_band, self.settings.respect_classes
        if submerged == 0 and left and dead_m:
            raise GeometryError(
                "option.dead_band",
                f"{name}: all {left:,} points below the water are within the dead band of"
                f" {dead_m:g} m, and most points near them are above it. Give a narrower"
                " --dead-band.",
                path=name, points=left, value=dead_m,
            )  # fmt: skip
        if counts.respected and not left:
            raise GeometryError(
                "option.respect_classes",
                f"{name}: all {counts.respected:,} points below the water are of the classes to"
                f" respect ({', '.join(map(str, classes))}). Respect fewer classes.",
                path=name, points=counts.respected,
            )  # fmt: skip
        if self.mask is not None and counts.outside_mask >= max(counts.below, 1):
            west, south, east, north = bounds = self.mask.area.bounds
            raise GeometryError(
                "mask.no_points",
                f"{self.mask.name} (x {west:.1f} to {east:.1f}, y {south:.1f} to {north:.1f})"
                f" contains none of the {counts.below:,} points of {name} below the water. Check"
                " the CRS of both, and that the polygons are of water.",
                path=self.mask.name, points=counts.below, bounds=bounds,
            )  # fmt: skip

    def report(self, counts: LabelCounts) -> dict[str, Any] | None:
        """Return rules and counts of excluded points as plain values; None without rules."""
        if self.is_plain:
            return None
        around, separate = self.around, None
        if around is not None and around.pool is not None:  # pools that are excluded
            in_pool = np.zeros(1, np.int64) if counts.in_pool is None else counts.in_pool
            separate = {"pools": int((in_pool > 0).sum()), "points": int(in_pool.sum())}
        return {
            "settings": asdict(self.settings),
            "water_mask": None if self.mask is None else self.mask.name,
            "below": counts.below,
            "outside_mask": counts.outside_mask,
            "respected": counts.respected,
            "cell_m": None if around is None else around.frame.side_m,
            "separate": separate,
        }


def _within(height: FloatArray, reach_m: float) -> BoolArray:
    return np.asarray(np.abs(height) <= reach_m) if reach_m else np.zeros(len(height), np.bool_)

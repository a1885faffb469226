"""Decide which points are submerged, and set their classes.

A point is submerged if it is below the water surface, inside the mask if there is one, not of a
respected class, and, if that is asked for, in the connected water. Connected water is found in
cells over the whole cloud, filled chunk by chunk.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError
from pcfix.model import BATHYMETRIC_POINT, BoolArray, FloatArray
from pcfix.options.shared import LandRules
from pcfix.sums import LEAST, CellFrame, Cells, Layer, Sums
from pcfix.water.surface import SurfaceAbove, is_submerged

Classes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class WaterMask:
    """The polygons inside which points may be submerged.

    A point on the border, of a hole too, is inside.
    """

    area: Any  # shapely Polygon or MultiPolygon, valid, in the cloud's CRS, metres
    name: str = "mask"  # for messages

    def inside(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Return which of n plan positions, metres, world frame, are inside."""
        import shapely

        shapely.prepare(self.area)  # does nothing the second time
        return np.asarray(shapely.intersects_xy(self.area, x, y))


SHARE_OF_LARGEST = 0.1  # pools with this share of the area of the largest water count as water
_AROUND = np.ones((3, 3), np.bool_)

PRESENT, BELOW = 1, 2  # a cell has points; points below the surface


class Pools(NamedTuple):
    """The water bodies of a cloud in cells; 0 stands for none."""

    frame: CellFrame
    number: npt.NDArray[np.int32]  # (rows, columns), the water body of each cell
    stays: BoolArray  # (bodies + 1,), whether a body counts as water


class Part(NamedTuple):
    """Some points of a cloud."""

    xyz: FloatArray  # (n, 3), metres
    surface: SurfaceAbove  # the water above them
    classes: Classes  # (n,)


@dataclass(frozen=True)
class LabelCounts(Sums):
    """Counts of points by their new classes, and of those that the rules exclude."""

    points: int = 0
    submerged: int = 0  # they have class 40 now
    stale: int = 0  # class 40 in the input, although they are not submerged
    water_unknown: int = 0  # without a known height of the water
    # depth of the point that is nearest to the water surface, negative above it, metres
    least_m: float = field(default=np.inf, metadata=LEAST)
    # points below the water, and how many of them are excluded
    below: int = 0
    outside_mask: int = 0
    respected: int = 0
    in_pools: int = 0  # in separate pools

    def of_classes(self) -> dict[str, int]:
        """Return the counts by new classes, by their names in a summary."""
        names = ("submerged", "stale", "water_unknown", "points")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class Labelling:
    """The rules of a labelling, and the water bodies if only connected water counts."""

    settings: LandRules
    mask: WaterMask | None = None
    pools: Pools | None = None

    @property
    def is_plain(self) -> bool:
        """Whether a point is submerged exactly if it is below the surface."""
        return self.mask is None and not (self.settings.respect_classes or self.settings.connected)

    def scanned(self, parts: Iterable[Part], low: FloatArray, high: FloatArray) -> "Labelling":
        """Return the rules with the water bodies, if they need them.

        `parts` are the whole cloud in chunks, and `low` and `high` its corners, if they are known.
        Points are collected in cells, which are coarsened until they have enough points. Water is
        connected over sides, corners, and gaps of at most two cells.
        """
        if not self.settings.connected:
            return self
        from scipy.ndimage import binary_dilation, label  # slow to import

        cells = Cells(low, high, Layer(np.zeros((), np.uint8), np.bitwise_or))
        water_points = 0
        for part in parts:
            if not len(part.xyz):
                continue
            x, y, z = np.ascontiguousarray(part.xyz.T)
            # points that may be submerged; the others only show that there is no gap
            below = (z < part.surface.height_m) & ~self._is_respected(part.classes)
            below[below] = self._is_inside(x[below], y[below])
            water_points += int(np.count_nonzero(below))
            cells.cover(np.array([x.min(), y.min()]), np.array([x.max(), y.max()]))
            row, column = cells.frame.cells(x, y)
            (flags,) = cells.values
            bits = (PRESENT + BELOW * below).astype(np.uint8)
            np.bitwise_or.at(flags.reshape(-1), row * flags.shape[1] + column, bits)
        if not cells.values[0].size:  # no points
            cells.cover(np.zeros(2), np.zeros(2))
        cells.coarsen(water_points, lambda flags: (flags & BELOW) > 0)
        frame, flags = cells.frame, cells.values[0]
        water = (flags & BELOW) > 0
        found, count = label(water | (binary_dilation(water, _AROUND) & (flags == 0)), _AROUND)
        number = np.where(water, found, 0).astype(np.int32)
        area = frame.side_m**2 * np.bincount(number[water], minlength=count + 1)
        least = self.settings.least_pool
        stays = area >= (SHARE_OF_LARGEST * area.max() if least is None else least)
        stays |= area == area.max()
        stays[0] = False
        return replace(self, pools=Pools(frame, number, stays))

    def submerged(
        self, xyz: FloatArray, surface: SurfaceAbove, classes: Classes
    ) -> tuple[BoolArray, LabelCounts]:
        """Return which of n points are submerged, and the counts of those that are excluded."""
        submerged = is_submerged(xyz[:, 2], surface)
        if self.is_plain:
            return submerged, LabelCounts()
        rows = np.flatnonzero(submerged)
        x, y = np.ascontiguousarray(xyz[rows, :2].T)
        inside, respected = self._is_inside(x, y), self._is_respected(classes[rows])
        wet, in_pools = inside & ~respected, 0
        if self.pools is not None:
            stays = self.pools.stays[self.pools.number[self.pools.frame.cells(x, y)]]
            in_pools = int((wet & ~stays).sum())
            wet &= stays
        submerged[rows] = wet
        return submerged, LabelCounts(
            below=len(rows),
            outside_mask=int((~inside).sum()),
            respected=int((inside & respected).sum()),
            in_pools=in_pools,
        )

    def labels(self, part: Part) -> tuple[Classes, LabelCounts]:
        """Return the new classes of points, and their counts; those of land do not change."""
        wet, counts = self.submerged(*part)
        depth_m = part.surface.height_m - part.xyz[:, 2]
        return np.where(wet, np.uint8(BATHYMETRIC_POINT), part.classes), replace(
            counts,
            points=len(wet),
            submerged=int(wet.sum()),
            stale=int(((part.classes == BATHYMETRIC_POINT) & ~wet).sum()),
            water_unknown=int(np.isnan(depth_m).sum()),
            least_m=float(np.fmin.reduce(depth_m, initial=np.inf)),
        )

    def _is_respected(self, classes: Classes) -> BoolArray:
        return np.isin(classes, self.settings.respect_classes)

    def _is_inside(self, x: FloatArray, y: FloatArray) -> BoolArray:
        return np.ones(len(x), np.bool_) if self.mask is None else self.mask.inside(x, y)

    def check(self, name: str, counts: LabelCounts) -> None:
        """Check that mask and respected classes leave points below the water."""
        if counts.respected and counts.respected + counts.outside_mask == counts.below:
            classes = ", ".join(map(str, self.settings.respect_classes))
            raise GeometryError(
                "option.respect_classes",
                f"{name}: all {counts.respected:,} points below the water are in the classes to"
                f" respect ({classes}). Respect fewer classes.",
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
        separate = None  # pools, and their points
        if self.pools is not None:
            excluded = int(np.count_nonzero(~self.pools.stays[1:]))
            separate = {"pools": excluded, "points": counts.in_pools}
        return {
            "settings": asdict(self.settings),
            "water_mask": None if self.mask is None else self.mask.name,
            "below": counts.below,
            "outside_mask": counts.outside_mask,
            "respected": counts.respected,
            "separate": separate,
        }

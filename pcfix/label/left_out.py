"""What a labelling left as land although it lies below the water: counted, placed, told."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import GeometryError

if TYPE_CHECKING:
    import numpy.typing as npt

    from pcfix.label.connected import Lattice, Pools, Surroundings
    from pcfix.label.mask import WaterMask
    from pcfix.model import BoolArray, FloatArray
    from pcfix.options import LabelSettings


class LeftOut:
    """Counts of points below the surface, and of those among them that a rule left out.

    Parameters
    ----------
    settings : LabelSettings
    mask : WaterMask or None
    around : Surroundings or None
        Where there are pools, they are counted one by one.
    """

    def __init__(
        self, settings: LabelSettings, mask: WaterMask | None, around: Surroundings | None
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
            listed = ", ".join(map(str, self._settings.respect_classes))
            raise GeometryError(
                f"{name}: all {self.respected:,} points below the water come with the classes to"
                f" respect ({listed}); respect fewer."
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

"""Whether a water surface can be one, and whether it lies where the cloud is."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import GeometryError, PcfixWarning
from pcfix.flow.points import check_submerged
from pcfix.model import WaterDimension, WaterMesh, WaterPlane, WaterRaster

if TYPE_CHECKING:
    from pcfix.model import Correction, FloatArray, WaterSurface

MOST_TILT = 0.05
"""Rise per metre of a whole surface. Rapids reach 2 %; a weir is steeper, but only in part."""
DEEPEST_M = 100.0
"""No photograph shows a bed as deep as this."""
FOOT_M = 0.3048
CLEARLY_OFF_M = 10.0
_ENOUGH_HEIGHTS = 200_000


def check_tilt(water: WaterSurface) -> None:
    """Refuse a surface that as a whole is steeper than water is.

    Raises
    ------
    GeometryError
        With the tilt of the plane that fits it best.
    """
    tilt = overall_tilt(water)
    if tilt > MOST_TILT:
        raise GeometryError(
            f"The water surface ({water}) is tilted by {100.0 * tilt:.1f} %; {100 * MOST_TILT:g} %"
            " is the most that pcfix takes for water: check the units and the order of the"
            " numbers, and that the surface holds nothing but water."
        )


def overall_tilt(water: WaterSurface) -> float:
    """Return the rise per metre of a surface, or of the plane that fits it best."""
    match water:
        case WaterPlane(_, b, c):
            return float(np.hypot(b, c))
        case WaterDimension():
            return 0.0
        case WaterMesh():
            return _tilt_of(water.vertices[np.unique(water.triangles)])
        case WaterRaster():
            row, column = np.nonzero(np.isfinite(water.height_m))
            some = slice(None, None, len(row) // _ENOUGH_HEIGHTS + 1)
            row, column = row[some], column[some]
            width, height = water.cell_m
            return _tilt_of(
                np.column_stack([column * width, -row * height, water.height_m[row, column]])
            )


def _tilt_of(xyz: FloatArray) -> float:
    """Return the tilt of the plane with the least squares along z; of a line, along it."""
    local = xyz - xyz.mean(axis=0)
    slope = np.linalg.lstsq(local[:, :2], local[:, 2], rcond=1e-6)[0]
    return float(np.hypot(*slope))


class WaterMeeting:
    """How cloud and water lie to each other, added up chunk by chunk."""

    def __init__(self, water: WaterSurface) -> None:
        self._water = water
        self._highest_m = _highest(water)
        self._points = self._submerged = self._uncovered = self._uncovered_low = 0
        self._low_m, self._high_m = np.inf, -np.inf
        self._least_depth_m = self._lowest_water_m = np.inf
        self.notes: list[str] = []

    def add(self, apparent: FloatArray, correction: Correction) -> None:
        """Add one chunk: the apparent points, shape (n, 3), and their correction."""
        z, unknown = apparent[:, 2], ~correction.water_known
        self._points += len(z)
        self._low_m = min(self._low_m, float(z.min(initial=np.inf)))
        self._high_m = max(self._high_m, float(z.max(initial=-np.inf)))
        self._lowest_water_m = min(self._lowest_water_m, correction.lowest_water_m)
        depth = correction.depth_m[correction.submerged]
        self._submerged += len(depth)
        self._least_depth_m = min(self._least_depth_m, float(depth.min(initial=np.inf)))
        self._uncovered += int(unknown.sum())
        self._uncovered_low += int((z[unknown] < self._highest_m).sum())

    def check_submerged(self, name: str) -> None:
        """Refuse water that lies below the cloud.

        Raises
        ------
        GeometryError
            If no point lies below it.
        """
        check_submerged(self._submerged, name, self._water, self._heights())

    def check_reach(self, name: str) -> None:
        """Refuse water far above the cloud, and warn of points that it does not cover.

        Raises
        ------
        GeometryError
            If all points lie deeper than `DEEPEST_M`.
        """
        if self._submerged == self._points and self._least_depth_m > DEEPEST_M:
            raise GeometryError(
                f"{name}: all points lie more than {DEEPEST_M:g} m below the water"
                f" ({self._water}), the highest {self._least_depth_m:.0f} m{self._heights()}; check"
                " the water's height, and that it has the cloud's vertical datum."
            )
        if self._uncovered_low:
            self.notes = [
                f"{name}: the water surface ({self._water}) does not cover"
                f" {100.0 * self._uncovered / self._points:.1f} % of the points; of these"
                f" {self._uncovered_low:,} lie lower than its highest place and may be under water,"
                " but are not touched."
            ]
            warnings.warn(self.notes[0], PcfixWarning, stacklevel=2)

    def _heights(self) -> str:
        """Return between which heights the cloud lies, and whether one of the two is in feet."""
        low, high, level = self._low_m, self._high_m, self._lowest_water_m
        if not np.isfinite([low, high]).all():
            return ""
        text = f"; the cloud's heights are {low:.2f} to {high:.2f} m"
        if low - CLEARLY_OFF_M <= level <= high + CLEARLY_OFF_M or not np.isfinite(level):
            return text
        for factor, whose in ((FOOT_M, "the water is"), (1.0 / FOOT_M, "the cloud's heights are")):
            if low <= level * factor <= high:
                return f"{text}, and the water would lie among them if {whose} in feet"
        return text


def _highest(water: WaterSurface) -> float:
    """Return the highest known place of a surface that may leave points uncovered."""
    match water:
        case WaterMesh(vertices):
            return float(vertices[:, 2].max())
        case WaterRaster(height_m):
            return float(np.nanmax(height_m))
        case _:
            return -np.inf

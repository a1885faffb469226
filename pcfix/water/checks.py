"""Check points and cameras against the water surface."""

import math
import warnings
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError, PcfixWarning, SettingError
from pcfix.model import (
    Cameras,
    Correction,
    FloatArray,
    WaterDimension,
    WaterMesh,
    WaterPlane,
    WaterRaster,
    WaterSurface,
)
from pcfix.sums import LEAST, MOST, Sums
from pcfix.water.surface import surface_above

MOST_TILT = 0.05  # largest rise per metre; rapids reach 2 %, a weir is steeper but only a part
# In clear water photographs show a bed down to the first depth; the second was never reported. A
# smaller share of deep points may be mismatches.
DOUBTFUL_M, TOO_DEEP_M, DEEP_SHARE = 30.0, 60.0, 0.05
_ENOUGH_HEIGHTS = 200_000


def checked_points(xyz: npt.ArrayLike) -> FloatArray:
    """Return finite points, C-contiguous, shape (n, 3).

    Raises SettingError ``option.shape`` or ``cloud.not_finite``.
    """
    points = np.ascontiguousarray(xyz, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SettingError(
            "option.shape", f"xyz has the shape {points.shape}. It must be (n, 3).",
            option="xyz", shape=points.shape,
        )  # fmt: skip
    finite = np.isfinite(points)
    if not finite.all():
        row = int(np.argmin(finite.all(axis=1)))
        raise SettingError(
            "cloud.not_finite",
            f"xyz row {row} is not finite: {points[row].tolist()}. Remove the point.",
            row=row,
        )
    return points


def as_surface(
    water: WaterSurface | float | npt.ArrayLike, n: int
) -> tuple[WaterSurface, FloatArray | None]:
    """Return the water surface, and its heights above n points if it is given by them.

    Raises SettingError ``water.number`` or ``option.shape``.
    """
    if isinstance(water, WaterSurface):
        return water, None
    heights = np.asarray(water, dtype=np.float64)
    if heights.ndim == 0:
        level = float(heights)
        if not math.isfinite(level):
            raise SettingError("water.number", f"water '{level}' is not finite.", value=level)
        return WaterPlane(level), None
    if heights.shape != (n,):
        sentence = f"water has the shape {heights.shape}. It must be {(n,)}, one row per point."
        raise SettingError("option.shape", sentence, option="water", shape=heights.shape)
    return WaterDimension("given heights"), heights


def check_above_water(
    cameras: Cameras, water: WaterSurface, level_offset_m: FloatArray | None = None
) -> None:
    """Raise GeometryError ``cameras.under_water`` if a camera is below the water.

    `level_offset_m`, shape (k,), is the height of the water at each image above the surface.
    """
    if isinstance(water, WaterDimension):
        return  # known with the points only; see `correct_file`
    height = surface_above(water, cameras.centres).height_m
    # beyond its border the lowest place of the water, so that no camera is refused wrongly
    level = np.where(np.isnan(height), _heights_of(water).min(initial=np.inf), height)
    offset = 0.0 if level_offset_m is None else level_offset_m
    refuse_under_water(cameras, level + offset, str(water))


def refuse_under_water(cameras: Cameras, level: FloatArray | float, water: str) -> None:
    """Raise GeometryError for cameras below a level, metres: one for all, or shape (k,)."""
    below = np.flatnonzero(cameras.centres[:, 2] <= level)
    if below.size:
        first = cameras.labels[below[0]]
        raise GeometryError(
            "cameras.under_water",
            f"{below.size} of {len(cameras)} cameras are below the water ({water}); the first,"
            f" {first}, is at {cameras.centres[below[0], 2]:.2f} m. Check the vertical datum, the"
            " order of the columns and the water level.",
            cameras=int(below.size), first=first,
        )  # fmt: skip


def check_submerged(count: int, name: str, water: WaterSurface, heights: str = "") -> None:
    """Raise GeometryError ``water.below_cloud`` if no point is below the water.

    `heights` describes those of the cloud.
    """
    if count == 0:
        raise GeometryError(
            "water.below_cloud",
            f"{name}: no point is below the water ({water}){heights}. Check the water level and"
            " its vertical datum.",
            path=name,
        )


def check_tilt(water: WaterSurface) -> None:
    """Raise GeometryError ``water.tilt`` if a surface is steeper than `MOST_TILT` as a whole."""
    match water:
        case WaterPlane(_, b, c):
            xyz = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, b], [0.0, 1.0, c]])
        case WaterDimension():
            return
        case WaterMesh():
            xyz = water.vertices[np.unique(water.triangles)]
        case WaterRaster():
            row, column = np.nonzero(np.isfinite(water.height_m))
            step = len(row) // _ENOUGH_HEIGHTS + 1
            row, column = row[::step], column[::step]
            width, height = water.cell_m
            xyz = np.column_stack([column * width, -row * height, water.height_m[row, column]])
    # the plane of least squares; rcond: places on one line have a slope along it only
    local = xyz - xyz.mean(axis=0)
    slope = np.linalg.lstsq(local[:, :2], local[:, 2], rcond=1e-6)[0]
    tilt = float(np.hypot(*slope))
    if tilt > MOST_TILT:
        raise GeometryError(
            "water.tilt",
            f"The water surface ({water}) is tilted by {100.0 * tilt:.1f} %, more than"
            f" {100 * MOST_TILT:g} %. Check its units, the order of the numbers, and that it"
            " contains only water.",
            tilt=tilt,
        )


@dataclass(frozen=True)
class WaterMeeting(Sums):
    """Depths and coverage of a cloud below a water surface: numbers of points, and extremes."""

    points: int
    submerged: int
    uncovered: int  # without water above or below them
    uncovered_low: int  # of these, lower than the highest place of the water
    doubtful: int  # deeper than `DOUBTFUL_M`
    too_deep: int  # deeper than `TOO_DEEP_M`
    low_m: float = field(metadata=LEAST)  # of the cloud's heights
    high_m: float = field(metadata=MOST)
    most_depth_m: float = field(metadata=MOST)

    @classmethod
    def of(
        cls, apparent: FloatArray, correction: Correction, water: WaterSurface
    ) -> "WaterMeeting":
        """Return the figures of the apparent points of a chunk, shape (n, 3)."""
        z, unknown = apparent[:, 2], ~correction.water_known
        depth = correction.depth_m[correction.submerged]
        return cls(
            points=len(z),
            submerged=len(depth),
            uncovered=int(unknown.sum()),
            uncovered_low=int((z[unknown] < _heights_of(water).max(initial=-np.inf)).sum()),
            doubtful=int((depth > DOUBTFUL_M).sum()),
            too_deep=int((depth > TOO_DEEP_M).sum()),
            low_m=float(z.min(initial=np.inf)),
            high_m=float(z.max(initial=-np.inf)),
            most_depth_m=float(depth.max(initial=0.0)),
        )

    def check_reach(self, name: str, water: WaterSurface, *, deep: bool = False) -> list[str]:
        """Check for water far above the cloud; warn of points that it does not cover.

        `deep` allows depths of more than `TOO_DEEP_M`. Returns the warnings as sentences.
        """
        found, few = list[PcfixWarning](), DEEP_SHARE * self.submerged
        is_refused = self.too_deep > few and not deep
        points = self.too_deep if is_refused else self.doubtful
        limit_m = TOO_DEEP_M if is_refused else DOUBTFUL_M
        if points > few:
            land = "" if self.submerged < self.points else "; no point is left as land"
            words = (
                f"{name}: {points:,} of {self.submerged:,} submerged points are deeper than"
                f" {limit_m:g} m, the deepest {self.most_depth_m:.0f} m below the water"
                f" ({water}){land}{self.heights()}. Check the height of the water and its vertical"
                " datum"
            )
            if is_refused:
                words += ", or use --deep if the depths are right."
                depth = {"points": points, "depth_m": self.most_depth_m}
                raise GeometryError("water.too_deep", words, path=name, **depth)
            found.append(PcfixWarning("water.deep", f"{words}.", points=points))
        if self.uncovered_low:
            words = (
                f"{name}: the water surface ({water}) does not cover"
                f" {100.0 * self.uncovered / self.points:.1f} % of the points;"
                f" {self.uncovered_low:,} of them are lower than its highest place and may be under"
                " water. They are not corrected."
            )
            found.append(PcfixWarning("water.not_covered", words, points=self.uncovered_low))
        for one in found:
            warnings.warn(one, stacklevel=2)
        return [str(one) for one in found]

    def heights(self) -> str:
        """Return the range of the cloud's heights as text; empty without points."""
        if not self.points:
            return ""
        return f"; the heights of the cloud are {self.low_m:.2f} to {self.high_m:.2f} m"


def _heights_of(water: WaterSurface) -> FloatArray:
    """Return the heights of a surface that may not cover all points; none of the others."""
    match water:
        case WaterMesh(vertices):
            return vertices[:, 2]
        case WaterRaster(height_m):
            return height_m[np.isfinite(height_m)]
        case _:
            return np.zeros(0)

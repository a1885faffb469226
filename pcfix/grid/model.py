"""Summary, counts and hillshade of a DSM."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from pcfix.model import FloatArray
from pcfix.sums import LEAST, MOST, Sums

if TYPE_CHECKING:
    from pcfix.grid.heights import Gridded


@dataclass(frozen=True, slots=True)
class DsmSummary:
    """The numbers of a DSM; the keys of ``pcfix dsm --summary`` are these names."""

    input: str
    output: str
    hillshade: str | None
    counts: str | None
    what: str  # the quantity in the cells; see `DsmRules`
    pcfix: str  # version
    crs: str | None  # coordinate system of the cloud, and its vertical part
    heights: str | None
    width: int  # columns and rows
    height: int
    bounds_m: tuple[float, float, float, float]  # left, bottom, right, top
    points: int  # in the cloud
    points_used: int  # in the raster: of the surface asked for, neither noise nor withheld
    cells: int  # with points
    filled: int  # with a height but no points
    empty: int  # without a height
    points_per_cell: float  # mean over the cells with points
    spacing_m: float  # of the points used, within the area that they fill
    hole_m: float | None  # width of the widest hole that was bridged
    settings: dict[str, Any]
    seconds: float
    values: dict[str, float]  # least, mean and largest of the cells, before holes are filled
    resolution_is: Literal["given", "chosen"] = "given"
    part: dict[str, Any] | None = None  # points read, of how many, and by which bounds
    stray: int = 0  # points ignored because they lie far from all others

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class CellTally(Sums):
    """Counts and values of the cells of a DSM, added up over windows."""

    cells: int = 0  # with points
    filled: int = 0  # with a value but no points
    known: int = 0  # with a value
    total: float = 0.0
    low: float = field(default=np.inf, metadata=LEAST)
    high: float = field(default=-np.inf, metadata=MOST)

    @classmethod
    def of(cls, bands: Gridded) -> CellTally:
        """Return those of a part of the raster."""
        known = ~np.isnan(bands.height)
        values = bands.height[known]
        return cls(
            cells=int((bands.points > 0).sum()),
            filled=int((known & (bands.points == 0)).sum()),
            known=values.size,
            total=float(values.sum()),
            low=float(values.min(initial=np.inf)),
            high=float(values.max(initial=-np.inf)),
        )

    def values(self) -> dict[str, float]:
        """Return least, mean and largest; nothing if no cell has a value."""
        if not self.known:
            return {}
        values = {"min": self.low, "mean": self.total / self.known, "max": self.high}
        return {name: round(float(value), 4) for name, value in values.items()}


NO_LIGHT = 0
"""Value of cells without a height."""


def hillshade(
    height: FloatArray, resolution_m: float, azimuth_deg: float, altitude_deg: float
) -> npt.NDArray[np.uint8]:
    """Return the brightness of each cell, 1 (dark) to 255; `NO_LIGHT` without a height.

    The slope of a cell comes from its eight neighbours, the four nearest counting twice (B. K. P.
    Horn, Hill shading and the reflectance map, 1981); the light is the cosine of the angle between
    the normal and the direction of the sun, given by its azimuth clockwise from north and its
    altitude above the horizon. A neighbour without a height gets the cell's own.

    Heights have the shape (rows + 2, columns + 2), metres, NaN if unknown, with a margin of one
    cell; the first row is the northernmost. The result has the shape (rows, columns).
    """
    rows, columns = height.shape[0] - 2, height.shape[1] - 2
    own = height[1:-1, 1:-1]

    def near(down: int, right: int) -> FloatArray:
        there = height[1 + down : 1 + down + rows, 1 + right : 1 + right + columns]
        return np.where(np.isnan(there), own, there)

    east = near(-1, 1) + 2.0 * near(0, 1) + near(1, 1)
    west = near(-1, -1) + 2.0 * near(0, -1) + near(1, -1)
    north = near(-1, -1) + 2.0 * near(-1, 0) + near(-1, 1)
    south = near(1, -1) + 2.0 * near(1, 0) + near(1, 1)
    slope_x, slope_y = (east - west) / (8.0 * resolution_m), (north - south) / (8.0 * resolution_m)
    azimuth, altitude = np.radians(azimuth_deg), np.radians(altitude_deg)
    sun_x, sun_y = np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude)
    cosine = (np.sin(altitude) - sun_x * slope_x - sun_y * slope_y) / np.sqrt(
        1.0 + slope_x**2 + slope_y**2
    )
    light = np.rint(1.0 + 254.0 * np.clip(cosine, 0.0, 1.0))
    return np.where(np.isnan(own), NO_LIGHT, light).astype(np.uint8)

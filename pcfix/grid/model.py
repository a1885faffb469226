"""What is asked of a DSM, and what it came to."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from pcfix.model import FloatArray

if TYPE_CHECKING:
    from pcfix.grid.heights import Gridded


@dataclass(frozen=True, slots=True)
class DsmSummary:
    """What a DSM came to; the keys of ``pcfix dsm --summary`` are these names.

    Attributes
    ----------
    input, output : str
    hillshade, counts : str or None
    what : str
        The cells hold; see `DsmRules`.
    pcfix : str
        Version.
    crs, heights : str or None
        Names of the coordinate system, and of its vertical part, that the cloud states.
    width, height : int
        Columns and rows.
    bounds_m : tuple of float
        Left, bottom, right, top.
    points, points_used : int
        In the cloud, and in the raster: of the surface asked for, neither noise nor withheld.
    cells : int
        With points.
    filled : int
        With a height but no points.
    empty : int
        Without a height.
    points_per_cell : float
        Mean, over the cells with points.
    spacing_m : float
        Of the points used: the side of the square each has for itself, where there are any.
    hole_m : float or None
        Width of the widest hole that was bridged.
    settings : dict
    seconds : float
    values : dict
        Least, mean and largest of the cells, before holes are filled.
    resolution_is : {"given", "chosen"}
    part : dict or None
        How many points were read, of how many, and by which bounds; None where all were.
    stray : int
        Points that are left out, as they lie far from all others.
    """

    input: str
    output: str
    hillshade: str | None
    counts: str | None
    what: str
    pcfix: str
    crs: str | None
    heights: str | None
    width: int
    height: int
    bounds_m: tuple[float, float, float, float]
    points: int
    points_used: int
    cells: int
    filled: int
    empty: int
    points_per_cell: float
    spacing_m: float
    hole_m: float | None
    settings: dict[str, Any]
    seconds: float
    values: dict[str, float]
    resolution_is: Literal["given", "chosen"] = "given"
    part: dict[str, Any] | None = None
    stray: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return asdict(self)


@dataclass
class Tally:
    """Cells of a DSM so far, and what their values come to."""

    cells: int = 0
    filled: int = 0
    known: int = 0
    total: float = 0.0
    low: float = math.inf
    high: float = -math.inf
    gridded: int = 0

    def add(self, bands: Gridded) -> None:
        """Add a part of the raster."""
        known = ~np.isnan(bands.height)
        self.cells += int((bands.points > 0).sum())
        self.filled += int((known & (bands.points == 0)).sum())
        self.known += int(known.sum())
        values = bands.height[known]
        self.gridded += values.size
        self.total += float(values.sum())
        self.low = min(self.low, float(values.min(initial=math.inf)))
        self.high = max(self.high, float(values.max(initial=-math.inf)))

    def values(self) -> dict[str, float]:
        """Return least, mean and largest; nothing where no cell has a value."""
        if not self.gridded:
            return {}
        mean = self.total / self.gridded
        return {"min": round(self.low, 4), "mean": round(mean, 4), "max": round(self.high, 4)}


NO_LIGHT = 0
"""Value of cells without a height."""


def hillshade(
    height: FloatArray, resolution_m: float, azimuth_deg: float, altitude_deg: float
) -> npt.NDArray[np.uint8]:
    """Return how brightly each cell is lit.

    The slope of a cell comes from its eight neighbours, those beside it counting twice (B. K. P.
    Horn, Hill shading and the reflectance map, 1981); the light is the cosine of the angle between
    the normal and the direction to the sun. Where a neighbour has no height, the cell's own
    stands in.

    Parameters
    ----------
    height : array, shape (rows + 2, columns + 2)
        Metres, with a margin of one cell; the first row is the northernmost. NaN: not known.
    resolution_m : float
    azimuth_deg, altitude_deg : float
        Where the sun stands: clockwise from north, and above the horizon.

    Returns
    -------
    array of uint8, shape (rows, columns)
        1 (dark) to 255 (bright); `NO_LIGHT` without a height.
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

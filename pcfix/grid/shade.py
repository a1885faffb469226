"""A relief lit by a sun."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    from pcfix.model import FloatArray

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

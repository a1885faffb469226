"""Cameras against what was recorded in flight: positions of the GNSS, heights above take-off."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcfix.errors import InputError, PcfixWarning
from pcfix.io.altitudes import read_altitudes
from pcfix.io.cameras.georeference import adjusted_minus_gnss
from pcfix.model import Cameras
from pcfix.options.declare import File

MOST_APART_M = 15.0
"""In plan, from positions of the GNSS, in the median; without corrections these are 5 m off."""
TAKE_OFF_M, MOST_SHARE = (-15.0, 25.0), 0.1
"""How high above the water drones take off, and the share of their height that barometers err."""


class Result(NamedTuple):
    """The result of one test: what fits, what does not, or what could not be tested."""

    fit: str = ""
    doubt: PcfixWarning | None = None
    unchecked: str = ""


def positions(cameras: Cameras, name: str) -> Result:
    """Compare the places of cameras with those that their GNSS recorded."""
    if cameras.gnss is None:
        return Result()
    try:
        found = adjusted_minus_gnss(cameras, name).enu_m[:, :2]
    except InputError:
        return Result()
    apart = np.hypot(*found[np.isfinite(found).all(axis=1)].T)
    if not len(apart):
        return Result()
    middle = float(np.median(apart))
    if middle <= MOST_APART_M:
        return Result(f"positions {middle:.1f} m in plan from their GNSS")
    sentence = (
        f"The cameras are {middle:.4g} m in plan from their GNSS positions (median of"
        f" {len(apart)}). Check their CRS and offset."
    )
    return Result(doubt=PcfixWarning("cameras.gnss", sentence, off_m=middle))


def flying_heights(cameras: Cameras, file: File, water_m: float | None) -> Result:
    """Compare the heights of cameras above the water with those recorded above take-off."""
    recorded = read_altitudes(file, cameras.labels)
    rows = np.flatnonzero(np.isfinite(recorded))
    if not len(rows) or water_m is None:
        return Result()
    above = float(np.median(cameras.centres[rows, 2])) - water_m
    flown = float(np.median(recorded[rows]))
    off, (low, high) = above - flown, TAKE_OFF_M
    least = MOST_SHARE * abs(flown)
    where = f"{abs(off):.0f} m {'above' if off > 0.0 else 'below'} the water"
    if low - least <= off <= high + least:
        return Result(f"heights as recorded in flight, from a take-off {where}")
    sentence = (
        f"The cameras are {above:.0f} m above the water, and recorded {flown:.0f} m above their"
        f" take-off (median of {len(rows)}), which would be {where}. Unless it was, check the"
        " vertical datum and the unit of cameras and water."
    )
    values = {"above_water_m": above, "above_take_off_m": flown}
    return Result(doubt=PcfixWarning("cameras.flying_height", sentence, **values))

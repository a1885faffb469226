"""Colour ramps of maps: one for each quantity, in pictures, pages and GIS styles.

All are ramps of matplotlib that keep their order for colour-blind readers and in print: shallow
water is light, and positive differences are red.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pcfix.grid.model import NO_LIGHT
from pcfix.model import FloatArray

DEPTH = "YlGnBu"
HEIGHT = "cividis"
UNCERTAINTY = "OrRd"
RAYS = "Purples"
DIFFERENCE = "RdBu_r"


def stops_of(ramp: str, steps: int = 9) -> list[tuple[float, tuple[int, ...]]]:
    """Return positions along a ramp, 0 to 1, and their colours (red, green, blue; 0 to 255)."""
    from matplotlib import colormaps

    shares = [step / (steps - 1) for step in range(steps)]
    colours = colormaps[ramp](shares)[:, :3]
    return [
        (share, tuple(round(255 * part) for part in colour))
        for share, colour in zip(shares, colours.tolist(), strict=True)
    ]


LAND = (214, 205, 188)
DARKEST = 0.35
"""Share of the colour without light."""


def relief_colours(
    light: npt.NDArray[np.uint8], depth_m: FloatArray, deepest_m: float, *, flat: float
) -> npt.NDArray[np.uint8]:
    """Return red, green, blue and alpha, shape (4, rows, columns), of a shaded bed and its land.

    `light`, shape (rows, columns), is that of `pcfix.grid.model.hillshade`; level ground has the
    share `flat` of it and keeps its colour. Depths are NaN on land; `deepest_m` has the last colour
    of the ramp.
    """
    stops = stops_of(DEPTH, 33)
    at = np.array([share for share, _ in stops]) * deepest_m
    lit = DARKEST + (1.0 - DARKEST) * (light - 1.0) / 254.0 / flat
    colours = [
        np.where(np.isnan(depth_m), land, np.interp(np.nan_to_num(depth_m), at, ramp))
        for land, ramp in zip(LAND, np.array([colour for _, colour in stops]).T, strict=True)
    ]
    alpha = np.where(light == NO_LIGHT, 0, 255)
    bands = [np.clip(np.rint(band * lit), 0, 255) for band in colours]
    return np.where(alpha > 0, [*bands, alpha], 0).astype(np.uint8)

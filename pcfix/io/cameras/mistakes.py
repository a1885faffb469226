"""Find out what is wrong if cameras are not over their cloud."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from pcfix.io.crs import parse_crs, parts
from pcfix.model import FloatArray

if TYPE_CHECKING:
    from pyproj import CRS


FOOT_M = 0.3048
MARGIN_M = 100.0
"""Distance from the cloud, beyond half of its sides, at which a block can still belong to it."""
ABSURD_HEIGHTS = 3.0
"""Largest height of cameras above the cloud, in widths of the cloud."""
_SAMPLE = 200


def likely_mistake(
    centres: FloatArray, low: FloatArray, high: FloatArray, cloud_crs: str | CRS | None
) -> str | None:
    """Return what is likely wrong if a block does not match its cloud; None if it does.

    Parameters
    ----------
    centres : array, shape (k, 3)
        Projection centres, assumed to be in the cloud's CRS.
    low, high : array, shape (3,)
        Corners of the cloud, metres.
    cloud_crs : str, CRS or None
    """
    centres = centres[:: max(1, len(centres) // _SAMPLE)]
    width, margin = max((high - low)[:2].max(), MARGIN_M), 0.5 * (high - low)[:2] + MARGIN_M
    middle = np.median(centres, axis=0)

    def is_over(moved: FloatArray) -> bool:
        """Whether the middle of a block is over the cloud, or not far from it."""
        x, y = np.median(moved[:, :2], axis=0)
        return bool((([x, y] >= low[:2] - margin) & ([x, y] <= high[:2] + margin)).all())

    if is_over(centres):
        if low[2] <= middle[2] <= high[2] + ABSURD_HEIGHTS * width:
            return None
        what = f"{middle[2] - high[2]:.0f} m above the cloud, which is {width:.0f} m wide"
        if middle[2] < low[2]:
            what = f"{low[2] - middle[2]:.0f} m below the lowest point of the cloud"
        why = "check the unit and the vertical datum of both, or see --cameras-offset"
        return f"The cameras are {what}: {why}."
    for words, moved in _readings(centres, cloud_crs):
        if is_over(moved):
            return f"The cameras would be over the cloud {words}."
    x, y = (low + high)[:2] / 2.0 - middle[:2]
    away = float(np.hypot(x, y))
    far = f"{away / 1000.0:,.1f} km" if away >= 1e4 else f"{away:.0f} m"
    advice = f"check the CRS of both, or give an offset of {x:.0f}, {y:.0f} m by --cameras-offset"
    return f"The cameras are {far} from the cloud in plan; {advice}."


def _readings(centres: FloatArray, crs: str | CRS | None) -> Iterator[tuple[str, FloatArray]]:
    """Yield other meanings of the numbers, the simplest first; to the metre or so."""
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    yield "with x and y exchanged: their axes are likely swapped", centres[:, [1, 0, 2]]
    yield "multiplied by 0.3048: they are likely in feet, it in metres", centres * FOOT_M
    yield "divided by 0.3048: they are likely in metres, it in feet", centres / FOOT_M
    plan = None if crs is None else parts(parse_crs(crs, "the cloud"))[0]
    if plan is None or not plan.is_projected:
        return
    own = plan.utm_zone
    codes = [("longitude and latitude in degrees", 4326), ("web Mercator", 3857)]
    for zone in [(int(own[:-1]) + step - 1) % 60 + 1 for step in (0, -1, 1)] if own else []:
        codes += [(f"UTM zone {zone}N", 32600 + zone), (f"UTM zone {zone}S", 32700 + zone)]
    for words, code in codes:
        with suppress(ProjError):  # of a CRS that is not a single map, such as EPSG:32600
            to_cloud = Transformer.from_crs(code, plan, always_xy=True)
            moved = np.column_stack(to_cloud.transform(centres[:, 0], centres[:, 1]))
            yield f"read as {words}; set it with --cameras-crs EPSG:{code}", moved

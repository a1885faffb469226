"""How far apart neighbouring points of a cloud are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pcfix.model import FloatArray

_ENOUGH = 20_000


def spacing_m(xyz: FloatArray) -> float | None:
    """Return the median distance of a point from its nearest neighbour, metres.

    From a box about the point in the middle of the file that holds some ten thousand points; None
    for fewer than two points.
    """
    from scipy.spatial import cKDTree

    if len(xyz) < 2:
        return None
    centre = xyz[len(xyz) // 2]
    away = np.maximum(np.abs(xyz[:, 0] - centre[0]), np.abs(xyz[:, 1] - centre[1]))
    near = min(_ENOUGH, len(xyz) - 1)
    box = xyz[away <= np.partition(away, near)[near]]
    distance = np.asarray(cKDTree(box).query(box[:_ENOUGH], k=2)[0])
    return float(np.median(distance[:, 1]))

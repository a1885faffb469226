"""The methods of correction, each under its name, all through one seam.

``snell`` with every camera in frame has a kernel of its own that chooses cameras as it goes; the
others get the chosen cameras of some points at a time.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.refract.bundles import Bundle
from pcfix.refract.choice import chosen_views, spatial_order
from pcfix.refract.intersect import intersect
from pcfix.refract.learned import Learned
from pcfix.refract.result import Intersection

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pcfix.label.surface import SurfaceAbove
    from pcfix.model import Cameras, FloatArray, IntArray, Views, WaterSurface
    from pcfix.settings import Settings

POINTS_AT_ONCE = 100_000
"""Bounds the memory of the lists of cameras: some 50 MB at 40 rays a point."""

_HOMES = {
    "snell": "pcfix.refract.intersect",
    "consistent": "pcfix.refract.consistent",
    "shan": "pcfix.refract.literature.shan",
    "butler": "pcfix.refract.literature.butler",
    "murase": "pcfix.refract.literature.murase",
    "dietrich": "pcfix.refract.literature.dietrich",
    "factor": "pcfix.refract.literature.factor",
    "regression": "pcfix.refract.regression",
}
"""Where each method is: a function of its own name that takes a `Bundle`."""


def correct(
    xyz: FloatArray,
    surface: SurfaceAbove,
    water: WaterSurface,
    cameras: Cameras,
    settings: Settings,
    views: Views | None = None,
    level_offset_m: FloatArray | None = None,
    learned: Learned | None = None,
) -> Intersection:
    """Correct submerged points by the method that the settings name.

    Parameters
    ----------
    xyz, surface, water, cameras, settings, views, level_offset_m
        As of `pcfix.refract.intersect.intersect`.
    learned : Learned, optional

    Returns
    -------
    Intersection
        One row per input point, in the same order.
    """
    learned = learned or Learned()
    if settings.method == "snell" and learned.occluder is None:
        return intersect(xyz, surface, water, cameras, settings, views, level_offset_m)
    method = getattr(import_module(_HOMES[settings.method]), settings.method)
    offset = np.zeros(len(cameras)) if level_offset_m is None else level_offset_m
    order = spatial_order(xyz)
    parts = []
    for rows in _batches(order):
        above = type(surface)(surface.height_m[rows], surface.slope[rows])
        mine = None if views is None else views.take(rows)
        chosen = chosen_views(xyz[rows], above, water, cameras, settings, mine, offset)
        bundle = Bundle(xyz[rows], above, water, cameras, chosen, settings, offset, learned)
        parts.append(method(bundle))
    return _joined(parts, order, len(cameras))


def _batches(order: IntArray) -> Iterator[IntArray]:
    for first in range(0, max(len(order), 1), POINTS_AT_ONCE):
        yield order[first : first + POINTS_AT_ONCE]


def _joined(parts: list[Intersection], order: IntArray, k: int) -> Intersection:
    """Return the results of batches as one, back in the order of the points."""

    def back(name: str) -> Any:
        values = np.concatenate([getattr(part, name) for part in parts])
        full = np.empty_like(values)
        full[order] = values
        return full

    per_point = ("shift_m", "outcome", "ray_count", "ray_miss_m", "sigma_z_m", "incidence_deg")
    used = np.any([part.camera_used for part in parts], axis=0) if k else np.zeros(0, np.bool_)
    tested = sum(part.pairs_tested for part in parts)
    return Intersection(
        **{name: back(name) for name in per_point}, camera_used=used, pairs_tested=tested
    )

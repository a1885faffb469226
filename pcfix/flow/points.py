"""The calculation over some points: label, refract, and spread the result over all rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from pcfix.model import BoolArray, Correction, FloatArray, IntArray
from pcfix.refract.batch import Batch, Intersection
from pcfix.refract.methods import correct, shift_of_land
from pcfix.water.surface import SurfaceAbove, is_submerged

Label: TypeAlias = Callable[[FloatArray, SurfaceAbove], BoolArray]


def correct_checked(
    batch: Batch,
    label: Label | None = None,
    level_sigma_m: Callable[[FloatArray], FloatArray | None] | None = None,
) -> Correction:
    """Label, refract, and spread the result over all rows: what every door runs.

    Parameters
    ----------
    batch : Batch
        Of n points, land too.
    label : callable, optional
        Says which are submerged. Default: those below the surface.
    level_sigma_m : callable, optional
        Returns the standard deviation of the water's height at places, shape (m, 2).
    """
    xyz, surface = batch.xyz, batch.surface
    submerged = is_submerged(xyz[:, 2], surface) if label is None else label(xyz, surface)
    rows = np.flatnonzero(submerged)
    wet = batch.take(rows)
    if level_sigma_m is not None:
        wet = replace(wet, level_sigma_m=level_sigma_m(wet.xyz[:, :2]))
    above, found = wet.surface, correct(wet)
    shift_x, shift_y, shift_z = found.shift_m.T
    rise = above.slope[:, 0] * shift_x + above.slope[:, 1] * shift_y
    depth = np.zeros(len(xyz))
    depth[rows] = above.height_m + rise - (xyz[rows, 2] + shift_z)
    values = spread_over(found, rows, len(xyz))
    values["shift_m"] = values["shift_m"] + _land_shift(batch, submerged)
    known = np.isfinite(surface.height_m)
    return Correction(
        apparent_xyz=xyz,
        depth_m=depth,
        water_known=known,
        lowest_water_m=float(surface.height_m[known].min()) if known.any() else np.inf,
        camera_used=found.camera_used,
        **values,
    )


_PER_POINT = (
    "shift_m", "outcome", "ray_count", "ray_miss_m", "incidence_deg", "sigma_z_m", "covariance_m2",
)  # fmt: skip


def spread_over(found: Intersection, rows: IntArray, n: int) -> dict[str, Any]:
    """Return the values of corrected rows as those of n points, zero elsewhere."""
    full: dict[str, Any] = dict.fromkeys(_PER_POINT)
    for name in _PER_POINT:
        values = getattr(found, name)
        if values is not None:
            full[name] = np.zeros((n, *values.shape[1:]), values.dtype)
            full[name][rows] = values
    return full


def _land_shift(batch: Batch, submerged: BoolArray) -> FloatArray | float:
    """Return the shift of points made with other cameras, shape (n, 3), zero where submerged."""
    if batch.made_with is None:
        return 0.0
    shift = np.zeros((len(batch), 3))
    rows = np.flatnonzero(~submerged)
    shift[rows] = shift_of_land(batch.take(rows))
    return shift

"""Light through level water, by the simulation's tracer."""

from __future__ import annotations

import numpy as np

from pcfix.model import FloatArray
from pcfix.simulate.tracing import piercing_points_of_planes


def piercing_points(
    points: FloatArray, centres: FloatArray, water_level_m: float, refractive_index: float
) -> FloatArray:
    """Return where the light from each point to its camera passes a level surface, (m, 3)."""
    anchor, normal = np.array([0.0, 0.0, water_level_m]), np.array([0.0, 0.0, 1.0])
    shape = points.shape
    return piercing_points_of_planes(
        points, centres, np.broadcast_to(anchor, shape), np.broadcast_to(normal, shape),
        refractive_index,
    )  # fmt: skip

"""What the errors of adjusted poses come to in the heights of a bed, place by place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pcfix.model import FloatArray

POINTS_A_CELL, FEWEST = 12, 4


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Standard errors of Z by the poses, on a grid in plan."""

    low: FloatArray  # (2,), south-west corner, metres
    cell_m: float
    sigma_m: FloatArray  # (columns, rows), in the middle of the cells
    middle_m: float  # root mean square over the bed

    def at(self, xy: FloatArray) -> FloatArray:
        """Return the standard errors at places, shape (n, 2)."""
        from scipy.ndimage import map_coordinates

        place = (xy - self.low) / self.cell_m - 0.5
        return np.asarray(map_coordinates(self.sigma_m, place.T, order=1, mode="nearest"))


def pose_errors_of(xy: FloatArray, variance_m2: FloatArray) -> PoseErrors:
    """Return the errors over a bed from variances at n places of it, shapes (n, 2) and (n,).

    A cell has the median of its points: a few of them jump, as a camera comes into their reach or
    leaves it. One of too few points has that of the nearest which has enough.
    """
    from scipy.ndimage import distance_transform_edt
    from scipy.stats import binned_statistic_2d

    low = xy.min(axis=0)
    size = np.maximum(np.ptp(xy, axis=0), 1e-3)
    cell_m = float(np.sqrt(size.prod() * POINTS_A_CELL / len(xy)))
    shape = np.ceil(size / cell_m).astype(int)
    place = np.minimum(((xy - low) / cell_m).astype(int), shape - 1)
    bins: Any = [np.arange(count + 1) for count in shape]
    x, y = place.T
    variance = binned_statistic_2d(x, y, variance_m2, "median", bins).statistic
    count = binned_statistic_2d(x, y, variance_m2, "count", bins).statistic
    variance[count < min(FEWEST, count.max())] = np.nan
    nearest = distance_transform_edt(
        np.isnan(variance), return_distances=False, return_indices=True
    )
    variance = variance[tuple(nearest)]
    middle_m = float(np.sqrt(np.average(variance[place[:, 0], place[:, 1]])))
    return PoseErrors(low, cell_m, np.sqrt(variance), middle_m)

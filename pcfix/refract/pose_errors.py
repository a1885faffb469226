"""What the errors of adjusted poses come to in the heights of a bed, place by place."""

from __future__ import annotations

from dataclasses import dataclass

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

    low = xy.min(axis=0)
    size = np.maximum(np.ptp(xy, axis=0), 1e-3)
    cell_m = float(np.sqrt(size.prod() * POINTS_A_CELL / len(xy)))
    shape = np.ceil(size / cell_m).astype(int)
    place = np.minimum(((xy - low) / cell_m).astype(int), shape - 1)
    cell = place[:, 0] * shape[1] + place[:, 1]
    order = np.argsort(cell, kind="stable")
    cells, first, counts = np.unique(cell[order], return_index=True, return_counts=True)
    medians = np.array([np.median(part) for part in np.split(variance_m2[order], first[1:])])
    enough = counts >= min(FEWEST, counts.max())
    variance = np.full(shape.prod(), np.nan)
    variance[cells[enough]] = medians[enough]
    variance = variance.reshape(shape)
    nearest = distance_transform_edt(
        np.isnan(variance), return_distances=False, return_indices=True
    )
    variance = variance[tuple(nearest)]
    middle_m = float(np.sqrt(np.average(variance[place[:, 0], place[:, 1]])))
    return PoseErrors(low, cell_m, np.sqrt(variance), middle_m)

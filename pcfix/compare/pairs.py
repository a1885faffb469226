"""Measured heights and reference heights, place by place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcfix.compare.vertical import heights_at
from pcfix.model import BoolArray, FloatArray  # noqa: TC001 - dataclass fields


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Two heights at each of n places.

    Attributes
    ----------
    xy : array, shape (n, 2)
        Metres, world frame.
    measured_m, reference_m : array, shape (n,)
        World Z of the cloud and of the reference there.
    by_nearest : array of bool, shape (n,)
        Where one of the two is the height of a single nearest point; see `heights_at`.
    """

    xy: FloatArray
    measured_m: FloatArray
    reference_m: FloatArray
    by_nearest: BoolArray

    @property
    def error_m(self) -> FloatArray:
        """Measured minus reference, shape (n,): positive where the cloud is too high."""
        return np.asarray(self.measured_m - self.reference_m)

    @property
    def reference_xyz(self) -> FloatArray:
        """Reference points at the places, shape (n, 3)."""
        return np.column_stack([self.xy, self.reference_m])


def pairs_at_cloud(xyz: FloatArray, reference: FloatArray, neighbours: int) -> Pairs:
    """Return a pair at each point of the cloud (n, 3): its Z, and the reference's plane there."""
    plane = heights_at(xyz[:, :2], reference, neighbours)
    return Pairs(xyz[:, :2], xyz[:, 2], plane.height_m, plane.by_nearest)


def pairs_at_reference(xyz: FloatArray, reference: FloatArray, neighbours: int) -> Pairs:
    """Return a pair at each check point (m, 3): the cloud's plane there, and the check's Z."""
    plane = heights_at(reference[:, :2], xyz, neighbours)
    return Pairs(reference[:, :2], plane.height_m, reference[:, 2], plane.by_nearest)

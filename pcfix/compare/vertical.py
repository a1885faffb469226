"""The height of a sampled surface at any place in plan: a plane through the nearest points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from pcfix.blocks import empty, mapped
from pcfix.clean.neighbours import nearest_of
from pcfix.model import BoolArray, FloatArray

Heights: TypeAlias = tuple[FloatArray, BoolArray]
"""World Z of a surface at n places, (n,), and where it is that of the nearest point."""
MIN_SHAPE = 1e-3
"""Points are on a line if the determinant of their covariance over its squared trace is less."""
MAX_REACH = 3.0
"""Largest distance of a place from the neighbours' centre, in their standard deviations."""


def heights_at(xy: FloatArray, surface: FloatArray, neighbours: int) -> Heights:
    """Return the height of a surface at places in plan, and where it is that of one point.

    At each place, (n, 2) or (n, 3), a plane is fitted by least squares in Z to the `neighbours`
    points of the surface, (m, 3), that are nearest in plan, and evaluated; metres, world frame. If
    these points lie on a line, or the place far outside them, the height of the nearest is used.
    """
    height, by_nearest = empty((len(xy),)), empty((len(xy),), np.bool_)
    for rows, here, near in nearest_of(xy, surface, neighbours):
        near[:, :, :2] -= here[:, np.newaxis, :2]
        height[rows], by_nearest[rows] = _plane_at_origin(near)
    return height, by_nearest


def _plane_at_origin(near: FloatArray) -> Heights:
    """Return the height at u = v = 0 of planes through points (n, k, 3) of u, v, z."""
    middle = near.mean(axis=1)
    u, v, z = np.moveaxis(near - middle[:, np.newaxis], 2, 0)
    uu, uv, vv = (u * u).mean(axis=1), (u * v).mean(axis=1), (v * v).mean(axis=1)
    uz, vz = (u * z).mean(axis=1), (v * z).mean(axis=1)
    determinant, trace = uu * vv - uv * uv, uu + vv
    flat = determinant > MIN_SHAPE * trace * trace
    safe = np.where(flat, determinant, 1.0)
    # normal equations of z = a + slope_u u + slope_v v about the mean
    slope_u, slope_v = (vv * uz - uv * vz) / safe, (uu * vz - uv * uz) / safe
    mu, mv = middle[:, 0], middle[:, 1]
    # squared distance of the origin from the mean, in standard deviations that way (Mahalanobis)
    reach = (vv * mu * mu - 2.0 * uv * mu * mv + uu * mv * mv) / safe
    fitted = flat & (reach <= MAX_REACH**2)
    plane = middle[:, 2] - slope_u * mu - slope_v * mv
    return np.where(fitted, plane, near[:, 0, 2]), ~fitted


@dataclass(frozen=True, eq=False)
class Pairs:
    """Two heights at each of n places, world Z."""

    xy: FloatArray  # (n, 2), metres, world frame
    measured_m: FloatArray  # (n,), of the cloud
    reference_m: FloatArray  # (n,)
    by_nearest: BoolArray  # (n,), one of the two heights is that of a single point

    @cached_property
    def error_m(self) -> FloatArray:
        """Measured minus reference, shape (n,): positive where the cloud is too high."""
        return mapped(np.subtract, self.measured_m, self.reference_m)

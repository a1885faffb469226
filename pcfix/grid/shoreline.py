"""The shoreline of a cloud, with its standard error.

Points near the water's height are averaged in cells, by their height above the water; the line is
the zero contour. An error in height moves the line by the error over the slope of the bed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.model import FloatArray
from pcfix.sums import Sums

MOST_POINTS = 2_000_000
"""Maximum number of points in memory, evenly spread."""
POINTS_PER_CELL = 4.0
MAX_CELLS = 25_000_000
SMOOTH_CELLS = 1.0
"""Standard deviation of the filter over the cells; it averages about 50 points."""
FLATTEST = 0.01
"""Least slope for the standard error: on flat ground the line may be anywhere."""


@dataclass(frozen=True, eq=False)
class Shoreline:
    """A line and its accuracy."""

    xy: FloatArray  # (n, 2), world frame, metres; closed for an island or a pool
    level_m: float  # mean height of the water along it
    sigma_m: float  # standard error in plan across the line, root mean square along it
    length_m: float  # in plan


@dataclass(frozen=True)
class NearWater(Sums):
    """Points of a cloud near the height of the water; those of two parts of it are added with +."""

    parts: tuple[FloatArray, ...] = ()  # (n, 5) each: x, y, z, height above the water, sigma
    every: int = 1  # one point in this number is used

    @classmethod
    def of(cls, xyz: FloatArray, above_m: FloatArray, sigma_z_m: FloatArray) -> NearWater:
        """Return those of n points, shape (n, 3), world frame, metres.

        `above_m` is the height above the water surface, NaN if unknown, and `sigma_z_m` the
        standard error of the heights, zero if unknown; both have the shape (n,).
        """
        rows = np.flatnonzero(np.abs(above_m) <= 2.0)  # metres
        return cls((np.column_stack([xyz, above_m, sigma_z_m])[rows],))

    def __add__(self, other: NearWater) -> NearWater:
        """Return the points of both; every second is dropped while there are too many."""
        every = max(self.every, other.every)
        parts = [part[:: every // one.every] for one in (self, other) for part in one.parts]
        while sum(map(len, parts)) > MOST_POINTS:
            parts, every = [part[::2] for part in parts], 2 * every
        return NearWater(tuple(parts), every)

    def lines(self, sigma_level_m: Callable[[FloatArray], FloatArray]) -> list[Shoreline]:
        """Return the lines, the longest first; several if there are islands or pools.

        `sigma_level_m` returns the standard error of the water's height at places, shape (m, 2).
        """
        from contourpy import contour_generator

        points = np.concatenate([np.empty((0, 5)), *self.parts])
        if not len(points) or not points[:, 3].min() < 0.0 < points[:, 3].max():
            return []
        field = _field_of(points, _cell_m(points[:, :2]))
        wanted_m = math.sqrt(2.0 / 7.0 * field.blur_m * field.cell_m)
        if wanted_m > field.cell_m:  # so that the line's own scatter is half a cell
            field = _field_of(points, wanted_m)
        maker = contour_generator(z=np.ma.masked_invalid(field.above_m))
        found = []
        for line in maker.lines(0.0):
            xy = field.low + np.asarray(line) * field.cell_m
            # the standard error of the heights over the slope, rms along the line
            slope = np.maximum(np.nan_to_num(_at(field, field.slope, xy)), FLATTEST)
            height_m = np.hypot(sigma_level_m(xy), _at(field, field.sigma_z_m, xy))
            step = np.hypot(*np.diff(xy, axis=0).T)
            weight = np.append(step, 0.0) + np.append(0.0, step)
            sigma = math.sqrt(float(np.average((height_m / slope) ** 2, weights=weight)))
            level = float(np.nanmean(_at(field, field.water_m, xy)))
            found.append(Shoreline(xy, level, sigma, float(step.sum())))
        least_m = 12.0 * field.cell_m  # shorter lines are noise
        long = [one for one in found if one.length_m >= max(least_m, 4.0 * one.sigma_m)]
        return sorted(long, key=lambda one: -one.length_m)


def _cell_m(xy: FloatArray) -> float:
    """Return the side of cells with `POINTS_PER_CELL` points within the area they fill."""
    extent = np.maximum(np.ptp(xy, axis=0), 1e-3)
    side = math.sqrt(float(extent.prod()) * POINTS_PER_CELL / len(xy))
    for _ in range(2):  # a strip along a shore fills little of its box
        cells = np.unique(((xy - xy.min(axis=0)) / side).astype(np.int64), axis=0)
        side *= math.sqrt(len(cells) * POINTS_PER_CELL / len(xy))
    return max(side, math.sqrt(float(extent.prod()) / MAX_CELLS))


class _Field(NamedTuple):
    """Smoothed cells, each (rows, columns); NaN if unknown."""

    low: FloatArray  # (2,), the centre of the first cell
    cell_m: float
    above_m: FloatArray
    water_m: FloatArray
    sigma_z_m: FloatArray  # of a point
    slope: FloatArray
    blur_m: float  # median shift of the line by the scatter of one point's height


def _field_of(points: FloatArray, cell_m: float) -> _Field:
    """Average points (n, 5), x, y, z, height above the water and standard error, in cells."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    low = points[:, :2].min(axis=0) - 2.0 * cell_m
    column, row = ((points[:, :2] - low) / cell_m).astype(np.int64).T
    shape = int(row.max()) + 3, int(column.max()) + 3
    number = row * shape[1] + column

    def summed(values: npt.ArrayLike) -> FloatArray:
        total = np.bincount(number, np.broadcast_to(values, len(number)), shape[0] * shape[1])
        return np.asarray(gaussian_filter(total.reshape(shape), SMOOTH_CELLS))

    z, above, sigma = points[:, 2:].T
    counts = summed(1.0)
    held = np.bincount(number, minlength=counts.size).reshape(shape) > 0
    # where enough of the filter's weight is on cells with points: gaps of two cells are bridged
    known = gaussian_filter(held.astype(np.float64), SMOOTH_CELLS) >= 0.4
    with np.errstate(invalid="ignore", divide="ignore"):
        height = np.where(known, summed(above) / counts, np.nan)
        water = summed(z - above) / counts
        errors = summed(sigma) / summed(sigma > 0.0)
    slope = np.hypot(*np.gradient(height, cell_m))
    steep = np.isfinite(slope)
    if steep.any():  # at the edge of the cloud, that of the nearest cell inside
        nearest = distance_transform_edt(~steep, return_distances=False, return_indices=True)
        slope = slope[tuple(nearest)]
    field = _Field(low + cell_m / 2.0, cell_m, height, water, errors, slope, 0.0)
    off = above - _at(field, height, points[:, :2])
    scatter = 1.4826 * float(np.nanmedian(np.abs(off - np.nanmedian(off))))
    near = np.abs(height) < np.nanmedian(np.abs(above))
    flat = float(np.nanmedian(slope[near])) if np.isfinite(slope[near]).any() else FLATTEST
    return field._replace(
        sigma_z_m=np.where(np.isfinite(errors), errors, scatter),
        blur_m=scatter / max(flat, FLATTEST),
    )


def _at(field: _Field, values: FloatArray, xy: FloatArray) -> FloatArray:
    """Return a field at places (n, 2), bilinear."""
    from scipy.ndimage import map_coordinates

    place = ((xy - field.low) / field.cell_m)[:, ::-1].T
    return np.asarray(map_coordinates(values, place, order=1, mode="nearest"))

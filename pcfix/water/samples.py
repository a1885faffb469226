"""A cloud in which the water is sought: its ground in cells, and what floats.

What floats is well above the ground around it and lies at one height, thinly: waves, foam and
glints that images agree on by chance give points on the surface itself. Leaves and wires are above
the ground too, but at all heights.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from pcfix.model import BoolArray, FloatArray, IntArray

MOST_CELLS = 100_000
POINTS_PER_CELL = 4.0
NEIGHBOURS = 8
_TRIES = 4


class Samples(NamedTuple):
    """One row a cell that holds points; m of them.

    xyz : shape (m, 3), mean x and y, median z, metres from `origin`.
    smooth_m : shape (m,), the height at x, y of a plane through the cells around, without its own.
    rough_m : shape (m,), rms distance of the cells around from that plane.
    colour : shape (m, 3), mean of the natural logarithms of red, green and blue; or None.
    intensity : shape (m,), mean logarithm; or None.
    cell_m : side of a cell.
    origin : shape (3,), world.
    of_point : shape (n,), the row of each point's cell.
    """

    xyz: FloatArray
    smooth_m: FloatArray
    rough_m: FloatArray
    colour: FloatArray | None
    intensity: FloatArray | None
    cell_m: float
    origin: FloatArray
    of_point: IntArray


def sample_cloud(
    xyz: FloatArray, rgb: npt.ArrayLike | None = None, intensity: npt.ArrayLike | None = None
) -> Samples:
    """Thin a cloud to cells.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Metres, world frame.
    rgb : array, shape (n, 3), optional
        In any unit from zero up.
    intensity : array, shape (n,), optional
    """
    origin = xyz.min(axis=0)
    local = xyz - origin
    cell_m = _cell_m(local)
    of_point, count = _cells(local, cell_m)
    mean = [np.bincount(of_point, local[:, i]) / count for i in (0, 1)]
    ground = np.column_stack([*mean, _medians(of_point, count, local[:, 2])])
    smooth, rough = _planes_around(ground)
    colour = None if rgb is None else _log_means(np.asarray(rgb), of_point, count)
    bright = None if intensity is None else np.asarray(intensity).reshape(-1, 1)
    light = None if bright is None else _log_means(bright, of_point, count)[:, 0]
    return Samples(ground, smooth, rough, colour, light, cell_m, origin, of_point)


def _cell_m(local: FloatArray) -> float:
    """Return a side that leaves about `POINTS_PER_CELL` in a cell, and `MOST_CELLS` at most."""
    wanted = min(len(local) / POINTS_PER_CELL, MOST_CELLS)
    side = float(np.sqrt(max(np.prod(np.ptp(local[:, :2], axis=0)), 1e-6) / wanted))
    for _ in range(_TRIES):  # the box of a cloud is seldom full
        held = len(np.unique(_keys(local, side)))
        side *= np.sqrt(held / wanted)
    return side


def _keys(local: FloatArray, side_m: float) -> IntArray:
    cell: IntArray = (local[:, :2] / side_m).astype(np.int64)
    return np.asarray(cell[:, 1] * (cell[:, 0].max() + 1) + cell[:, 0])


def _cells(local: FloatArray, cell_m: float) -> tuple[IntArray, IntArray]:
    _, of_point, count = np.unique(_keys(local, cell_m), return_inverse=True, return_counts=True)
    return of_point.reshape(-1), count


def _medians(group: IntArray, count: IntArray, values: FloatArray) -> FloatArray:
    """Return the median of each group."""
    ordered = values[np.lexsort((values, group))]
    first = np.cumsum(count) - count
    return (ordered[first + (count - 1) // 2] + ordered[first + count // 2]) / 2.0


def _log_means(values: npt.NDArray[np.generic], group: IntArray, count: IntArray) -> FloatArray:
    """Return mean logarithms a group; a small part of white keeps black finite."""
    light = values.astype(np.float64)
    logs = np.log(light + 0.004 * max(float(np.percentile(light, 99.0)), 1e-9))
    return np.column_stack([np.bincount(group, column) / count for column in logs.T])


def _planes_around(ground: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return height at each place, and rms residual, of the plane through the places around."""
    k = min(NEIGHBOURS, len(ground) - 1)
    _, near = cKDTree(ground[:, :2]).query(ground[:, :2], k=k + 1)
    around = ground[np.asarray(near)[:, 1:]] - ground[:, None]
    design = np.concatenate([np.ones((*around.shape[:2], 1)), around[..., :2]], axis=2)
    normal = np.einsum("mki,mkj->mij", design, design)
    scale = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    right = np.einsum("mki,mk->mi", design, around[..., 2])
    plane = np.linalg.solve(normal + 1e-9 * scale * np.eye(3), right[..., None])[..., 0]
    residual = around[..., 2] - np.einsum("mki,mi->mk", design, plane)
    spare = max(k - 3, 1)
    return ground[:, 2] + plane[:, 0], np.sqrt((residual**2).sum(axis=1) / spare)


LEAST_ABOVE_M, TIMES_NOISE = 0.25, 10.0
"""Less, and the tail of the noise follows the ground and piles up where that is flat."""
HALF_LAYER_M, HALF_AROUND_M = 0.05, 0.6
MOST_GAIN = 100.0
"""Many points are not independent: what they gain tends to this."""
TILE_CELLS = 12.0


class Floating(NamedTuple):
    """Points above the ground; p of them.

    xyz : shape (p, 3), metres from the origin of the samples.
    tile : shape (p,), number of the square that each is in.
    """

    xyz: FloatArray
    tile: IntArray


def points_above(samples: Samples, xyz: FloatArray, among: BoolArray | None = None) -> Floating:
    """Return the points of the cloud, shape (n, 3), that are well above the ground.

    `among`, shape (n,): which points to look at.
    """
    above_m = (xyz[:, 2] - samples.origin[2]) - samples.smooth_m[samples.of_point]
    least = np.maximum(LEAST_ABOVE_M, TIMES_NOISE * samples.rough_m)
    chosen = above_m > least[samples.of_point]
    local = xyz[chosen if among is None else chosen & among] - samples.origin
    column, row = (local[:, :2] / (TILE_CELLS * samples.cell_m)).astype(np.int64).T
    return Floating(local, row * (column.max(initial=0) + 1) + column)


def layer_gain(
    floating: Floating, heights_m: FloatArray, tilt: FloatArray, times: FloatArray | None = None
) -> FloatArray:
    """Return how much likelier the counts are with a layer at each height than without.

    Logarithm of the ratio of Poisson likelihoods; what is expected comes from above and below.
    Points of one tile at one height count once. `times`: how often to count each point.

    Parameters
    ----------
    floating : Floating
    heights_m : array, shape (h,)
        Evenly spaced, above the tilted plane through the origin of the samples.
    tilt : array, shape (2,)

    Returns
    -------
    array, shape (h,)
    """
    step = heights_m[1] - heights_m[0]
    height = floating.xyz[:, 2] - floating.xyz[:, :2] @ tilt
    column = np.rint((height - heights_m[0]) / step).astype(np.int64)
    inside = (column >= 0) & (column < len(heights_m))
    once = _first_of_each(floating.tile, column) & inside
    counts = np.bincount(
        column[once], None if times is None else times[once], minlength=len(heights_m)
    )
    sums = np.concatenate([[0.0], np.cumsum(counts)])
    layer, in_layer = _within(sums, round(HALF_LAYER_M / step))
    wide, in_wide = _within(sums, round(HALF_AROUND_M / step))
    around = np.maximum(in_wide - in_layer, 1)
    expected = np.maximum(wide - layer, 1.0) * in_layer / around
    ratio = np.maximum(layer / expected, 1.0)
    gain = layer * np.log(ratio) - expected * (ratio - 1.0)
    return np.asarray(-MOST_GAIN * np.expm1(-gain / MOST_GAIN))


def _within(sums: FloatArray, reach: int) -> tuple[FloatArray, IntArray]:
    """Return the counts within so many bins of each, and how many bins that is."""
    middle = np.arange(len(sums) - 1)
    low, high = np.maximum(middle - reach, 0), np.minimum(middle + reach + 1, len(sums) - 1)
    return sums[high] - sums[low], high - low


def _first_of_each(tile: IntArray, column: IntArray) -> BoolArray:
    key = tile * (np.ptp(column) + 1 if len(column) else 1) + column - column.min(initial=0)
    first = np.zeros(len(tile), bool)
    first[np.unique(key, return_index=True)[1]] = True
    return first

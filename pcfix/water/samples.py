"""A cloud in which the water is sought: its ground in cells, and what floats.

What floats is well above the ground around it and lies at one height, thinly: waves, foam and
glints that images agree on by chance give points on the surface itself. Leaves and wires are above
the ground too, but at all heights.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.model import FloatArray, IntArray

MOST_CELLS = 100_000
POINTS_PER_CELL = 4.0
NEIGHBOURS = 8
_TRIES = 4
LEAST_ABOVE_M, TIMES_NOISE = 0.25, 10.0
"""Less, and the tail of the noise follows the ground and piles up where that is flat."""
HALF_LAYER_M, HALF_AROUND_M = 0.05, 0.6
MOST_GAIN = 100.0
"""Many points are not independent: what they gain tends to this."""
TILE_CELLS = 12.0


class Samples(NamedTuple):
    """One row a cell that holds points; m of them.

    xyz : shape (m, 3), mean x and y, median z, metres from `origin`.
    smooth_m : shape (m,), the height at x, y of a plane through the cells around, without its own.
    rough_m : shape (m,), rms distance of the cells around from that plane.
    colour : shape (m, 3), mean of the natural logarithms of red, green and blue; (0, 3) where
        the cloud has none.
    cell_m : side of a cell.
    origin : shape (3,), world.
    floating : shape (p, 3), points of the cloud that are well above the ground, from `origin`.
    tile : shape (p,), number of the square that each of these is in.
    """

    xyz: FloatArray
    smooth_m: FloatArray
    rough_m: FloatArray
    colour: FloatArray
    cell_m: float
    origin: FloatArray
    floating: FloatArray
    tile: IntArray


def sample_cloud(
    xyz: FloatArray, rgb: npt.NDArray[Any] | None, returns: npt.NDArray[Any] | None
) -> Samples:
    """Thin a cloud, shape (n, 3), metres, world frame, to cells, and look for what floats.

    Colours, shape (n, 3), are in any unit from zero up; all equal counts as none. `returns`, shape
    (n,), are those of each pulse: where some have several, only these are looked at above the
    ground.
    """
    origin = xyz.min(axis=0)
    local = xyz - origin
    cell_m = _cell_m(local)
    cell = square_tiles(local, cell_m)
    _, of_point, count = np.unique(cell, return_inverse=True, return_counts=True)
    of_point = of_point.reshape(-1)
    mean = [np.bincount(of_point, local[:, i]) / count for i in (0, 1)]
    ground = np.column_stack([*mean, _medians(of_point, count, local[:, 2])])
    smooth, rough = _planes_around(ground)
    colour = np.empty((0, 3))
    if rgb is not None and (rgb != rgb[:1]).any():
        colour = _log_means(rgb, of_point, count)
    least = np.maximum(LEAST_ABOVE_M, TIMES_NOISE * rough)
    above = local[:, 2] - smooth[of_point] > least[of_point]
    if returns is not None and 0.01 <= (returns > 1).mean() <= 0.99:
        above &= returns > 1
    floating = local[above]
    tile = square_tiles(floating, TILE_CELLS * cell_m)
    return Samples(ground, smooth, rough, colour, cell_m, origin, floating, tile)


def _cell_m(local: FloatArray) -> float:
    """Return a side that leaves about `POINTS_PER_CELL` in a cell, and `MOST_CELLS` at most."""
    wanted = min(len(local) / POINTS_PER_CELL, MOST_CELLS)
    side = float(np.sqrt(max(np.prod(np.ptp(local[:, :2], axis=0)), 1e-6) / wanted))
    for _ in range(_TRIES):  # the box of a cloud is seldom full
        held = len(np.unique(square_tiles(local, side)))
        side *= np.sqrt(held / wanted)
    return side


def square_tiles(local: FloatArray, side_m: float) -> IntArray:
    """Return the number of the square that each place, x and y from zero up, lies in."""
    column, row = (local[:, :2] / side_m).astype(np.int64).T
    return np.asarray(row * (column.max(initial=0) + 1) + column)


def _medians(group: IntArray, count: IntArray, values: FloatArray) -> FloatArray:
    """Return the median of each group."""
    ordered = values[np.lexsort((values, group))]
    first = np.cumsum(count) - count
    return (ordered[first + (count - 1) // 2] + ordered[first + count // 2]) / 2.0


def _log_means(values: npt.NDArray[Any], group: IntArray, count: IntArray) -> FloatArray:
    """Return mean logarithms a group; a small part of white keeps black finite."""
    light = values.astype(np.float64)
    logs = np.log(light + 0.004 * max(float(np.percentile(light, 99.0)), 1e-9))
    return np.column_stack([np.bincount(group, column) / count for column in logs.T])


def _planes_around(ground: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return height at each place, and rms residual, of the plane through the places around."""
    from scipy.spatial import cKDTree  # not quick to load

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


def layer_gain(
    samples: Samples, heights_m: FloatArray, tilt: FloatArray, times: FloatArray | None = None
) -> FloatArray:
    """Return how much likelier the counts are with a layer at each height than without.

    Logarithm of the ratio of Poisson likelihoods; what is expected comes from above and below.
    Points of one tile at one height count once. Heights, shape (h,), are evenly spaced above the
    tilted plane through the origin of the samples. `times`: how often to count each point.
    """
    step = heights_m[1] - heights_m[0]
    height = samples.floating[:, 2] - samples.floating[:, :2] @ tilt
    column = np.rint((height - heights_m[0]) / step).astype(np.int64)
    inside = (column >= 0) & (column < len(heights_m))
    key = samples.tile * (np.ptp(column) + 1 if len(column) else 1) + column
    once = np.zeros(len(column), bool)
    once[np.unique(key - column.min(initial=0), return_index=True)[1]] = True
    once &= inside
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

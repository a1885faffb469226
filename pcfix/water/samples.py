"""Samples of a cloud for the search of water: its ground in cells, and floating points.

Floating points are well above the ground around them and lie in a thin layer at one height: waves,
foam and glints that images match by chance. Leaves and wires are above the ground too, but at all
heights.
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
"""Below this, the tail of the noise follows the ground and accumulates where that is flat."""
HALF_LAYER_M, HALF_AROUND_M = 0.05, 0.6
MOST_GAIN = 100.0
"""Limit of the gain of many points, which are not independent."""
TILE_CELLS = 12.0


class Samples(NamedTuple):
    """One row per cell that holds points; m of them."""

    xyz: FloatArray  # (m, 3), mean x and y, median z, metres from `origin`
    smooth_m: FloatArray  # (m,), height at x, y of a plane through the cells around it
    rough_m: FloatArray  # (m,), rms distance of the cells around from that plane
    colour: FloatArray  # (m, 3), mean natural logarithms of red, green, blue; (0, 3) for none
    cell_m: float  # side of a cell
    origin: FloatArray  # (3,), world frame
    floating: FloatArray  # (p, 3), points well above the ground, from `origin`
    tile: IntArray  # (p,), number of the square of each of these


def sample_cloud(
    xyz: FloatArray, rgb: npt.NDArray[Any] | None, returns: npt.NDArray[Any] | None
) -> Samples:
    """Thin a cloud, shape (n, 3), metres, world frame, to cells, and find floating points.

    Colours, shape (n, 3), are in any unit from zero up; equal ones count as none. `returns`, shape
    (n,), are those of each pulse: if some have several, only these may float.
    """
    origin = xyz.min(axis=0)
    local = xyz - origin
    cell_m = _cell_m(local)
    cell = square_tiles(local, cell_m)
    _, of_point, count = np.unique(cell, return_inverse=True, return_counts=True)
    of_point = of_point.reshape(-1)
    mean = [np.bincount(of_point, local[:, i]) / count for i in (0, 1)]
    ordered = local[np.lexsort((local[:, 2], of_point)), 2]
    first = np.cumsum(count) - count
    median = (ordered[first + (count - 1) // 2] + ordered[first + count // 2]) / 2.0
    ground = np.column_stack([*mean, median])
    smooth, rough = _planes_around(ground)
    colour = np.empty((0, 3))
    if rgb is not None and (rgb != rgb[:1]).any():
        light = rgb.astype(np.float64)
        white = max(float(np.percentile(light, 99.0)), 1e-9)
        logs = np.log(light + 0.004 * white)  # a small part of white keeps black finite
        colour = np.column_stack([np.bincount(of_point, column) / count for column in logs.T])
    least = np.maximum(LEAST_ABOVE_M, TIMES_NOISE * rough)
    above = local[:, 2] - smooth[of_point] > least[of_point]
    if returns is not None and 0.01 <= (returns > 1).mean() <= 0.99:
        above &= returns > 1
    floating = local[above]
    tile = square_tiles(floating, TILE_CELLS * cell_m)
    return Samples(ground, smooth, rough, colour, cell_m, origin, floating, tile)


def _cell_m(local: FloatArray) -> float:
    """Return the side of cells of about `POINTS_PER_CELL`, at most `MOST_CELLS` of them."""
    wanted = min(len(local) / POINTS_PER_CELL, MOST_CELLS)
    side = float(np.sqrt(max(np.prod(np.ptp(local[:, :2], axis=0)), 1e-6) / wanted))
    for _ in range(_TRIES):  # clouds seldom fill their bounding box
        held = len(np.unique(square_tiles(local, side)))
        side *= np.sqrt(held / wanted)
    return side


def square_tiles(local: FloatArray, side_m: float) -> IntArray:
    """Return the number of the square of each place, x and y from zero up."""
    column, row = (local[:, :2] / side_m).astype(np.int64).T
    return np.asarray(row * (column.max(initial=0) + 1) + column)


def _planes_around(ground: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return height at each place, and rms residual, of the plane through its neighbours."""
    from scipy.spatial import cKDTree  # slow to import

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
    """Return the log ratio of Poisson likelihoods with and without a layer at each height.

    The expected counts come from above and below. Points of one tile at one height count once.
    Heights, shape (h,), are evenly spaced above the tilted plane through the origin of the samples.
    Each point counts as often as in `times`.
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
    """Return the counts within `reach` bins of each bin, and the number of these bins."""
    middle = np.arange(len(sums) - 1)
    low, high = np.maximum(middle - reach, 0), np.minimum(middle + reach + 1, len(sums) - 1)
    return sums[high] - sums[low], high - low

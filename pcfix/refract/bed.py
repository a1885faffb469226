"""Estimate the bed of the surroundings: the height that most points of a place can have come from.

A fused point has a likely bed b for each group of depth maps that may have made it, all equally
probable (`pcfix.refract.fusion`). In a cell of a grid the bed is the height z with the largest

    sum over its points of  log(OUTLIER + sum_b exp(-((b - z) / width)^2 / 2))

It serves only to choose among the likely beds of a point; no point is put onto it.
"""

from __future__ import annotations

import numpy as np

from pcfix.kernels import Span, in_tiles, kernel
from pcfix.model import FloatArray, IntArray
from pcfix.refract.batch import Batch
from pcfix.refract.depth_maps import likely_beds
from pcfix.refract.fusion import Bed
from pcfix.refract.methods import batches, with_rays
from pcfix.refract.patches import gsd_m
from pcfix.refract.tiling import spatial_order

BED_POINTS = 100_000
"""Every second point of a larger sample is enough for the bed, which most of its time goes into."""
POINTS_A_CELL, MOST_CELLS = 12.0, 4_000_000
WIDTH_GSD = 2.0
"""Standard deviation of the likely beds of one place: relief within a cell, and noise."""
OUTLIER = 0.01
"""Likelihood of a point none of whose likely beds is near, relative to one that has one there."""
BINS, DEVIATIONS = 2.0, 3
"""Bins for a standard deviation of the likely beds, and how many deviations count to both sides."""
FAR_OFF_M, REACH = 0.4, 2
"""A cell that is farther than this from the median of its neighbours, up to `REACH` cells to each
side, gets that median."""


def bed_around(batch: Batch) -> Bed | None:
    """Return the most likely bed of a sample of fused points; None if no image sees a point."""
    # of single maps each point shows the bed less clearly: all of them are needed
    many = len(batch) > BED_POINTS and batch.survey.settings.matcher == "depth-maps"
    batch = batch.take(np.arange(0, len(batch), 2 if many else 1))
    order = spatial_order(batch.xyz)
    likely = [likely_beds(with_rays(batch.take(rows))).height_m for rows in batches(order)]
    table = np.full((len(batch), max(part.shape[1] for part in likely)), np.nan)
    for rows, part in zip(batches(order), likely, strict=True):
        table[rows, : part.shape[1]] = part
    return _bed_of(batch.xyz[:, :2], table, gsd_m(batch)) if np.isfinite(table).any() else None


def _bed_of(xy: FloatArray, likely_m: FloatArray, gsd_m: float) -> Bed:
    """Return the bed of m places with the heights of h likely beds, shape (m, h)."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    cell = _cell_m(xy, low, high)
    columns, rows = (int(n) + 1 for n in (high - low) / cell)
    at = np.floor((xy - low) / cell).astype(np.int64)
    key = at[:, 1] * columns + at[:, 0]
    order = np.argsort(key, kind="stable")
    filled, counts = np.unique(key, return_counts=True)
    start = np.concatenate([[0], np.cumsum(counts)])
    found, height = np.empty(len(filled)), np.full(rows * columns, np.nan)
    in_tiles(_most_likely, len(found), order, start, likely_m, WIDTH_GSD * gsd_m, found)
    height[filled] = found
    grid = _without_outliers(height.reshape(rows, columns))
    return Bed(grid, float(low[0]), float(low[1]), cell)


def _cell_m(xy: FloatArray, low: FloatArray, high: FloatArray) -> float:
    """Return the side of cells that hold `POINTS_A_CELL` points on average where there are any."""
    area = np.prod(np.maximum(high - low, 1.0))
    least = float(np.sqrt(area / MOST_CELLS))
    side = max(float(np.sqrt(area * POINTS_A_CELL / len(xy))), least)
    for _ in range(3):
        at = np.floor((xy - low) / side).astype(np.int64)
        filled = len(np.unique(at[:, 1] * (at[:, 0].max() + 1) + at[:, 0]))
        side = max(side * float(np.sqrt(POINTS_A_CELL * filled / len(xy))), least)
    return side


def _without_outliers(height: FloatArray) -> FloatArray:
    """Replace a cell far from the median of its surroundings by that median.

    Where only one group of images sees the bed, several heights are equally likely.
    """
    row, column = np.nonzero(np.isfinite(height))
    padded, smooth = np.pad(height, REACH, constant_values=np.nan), height.copy()
    down, right = np.mgrid[: 2 * REACH + 1, : 2 * REACH + 1].reshape(2, -1)
    middle = np.nanmedian(padded[row[:, None] + down, column[:, None] + right], axis=1)
    far = np.abs(height[row, column] - middle) > FAR_OFF_M
    smooth[row[far], column[far]] = middle[far]
    return smooth


@kernel(allocates=True)
def _most_likely(
    span: Span, order: IntArray, start: IntArray, likely: FloatArray, width_m: float,
    found: FloatArray,
) -> None:  # fmt: skip
    """Find the most likely height of the bed in each cell, on a histogram; NaN without any."""
    reach = int(DEVIATIONS * BINS)
    for c in range(*span):
        rows = order[start[c] : start[c + 1]]
        # the range of likely beds in the cell; comparisons with NaN are false
        low, high = np.inf, -np.inf
        for i in rows:
            for b in likely[i]:
                low, high = b if b < low else low, b if b > high else high
        found[c] = np.nan
        if not high >= low:
            continue
        step = max(width_m / BINS, (high - low) / 2000.0)
        total = np.zeros(int((high - low) / step) + 2)
        own = np.empty(total.size)
        for i in rows:
            own[:] = OUTLIER
            for b in likely[i]:
                at = (b - low) / step
                if at == at:
                    for k in range(max(0, int(at) - reach), min(own.size, int(at) + reach + 2)):
                        off = (k - at) / BINS
                        own[k] += np.exp(-0.5 * off * off)
            total += np.log(own)
        found[c] = low + np.argmax(total) * step

"""A broken line against the unbroken one, tile by tile, for every height where it may break.

What is looked for: y = (smooth within each tile) + trend * height + amplitude * f(depth), where
f(d) = D (1 - exp(-d / D)) below the height in question and 0 above it; trend and amplitude are the
same in all tiles. Where the amplitude is free, the trend must be the weaker of the two: what fades
under water is steady on land. Each tile gives its sums of squares and products once; to add tiles,
at their own heights under a tilted surface, or to draw them anew, costs little then.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

if TYPE_CHECKING:
    from pcfix.model import FloatArray, IntArray

LEAST_SIDE = 8.0
"""Cells (weights added) that a tile must have above a height, and below, to say anything."""
_TINY = 1e-12
_STEADY_M = 0.3


class Break(NamedTuple):
    """The break that is looked for.

    scale_m : D, infinite for a straight line below.
    window_m : observations weigh less towards this far above and below.
    sign : +1 or -1, what the amplitude must be.
    amplitude : where physics gives it; else it is free.
    most : a free amplitude larger than this is not likely, one twice as large is something else.
    """

    scale_m: float
    window_m: float
    sign: float
    amplitude: float | None = None
    most: float = np.inf


class Moments(NamedTuple):
    """Sums of t tiles at h heights.

    sums : shape (t, h, 6), of yy, yx, yf, xx, xf, ff after the smooth part is taken out of the
        y, x (height) and f; each tile in units of its own residual variance.
    number : shape (t, h), how many observations that is.
    xy : shape (t, 2), the middle of each tile.
    heights_m : shape (h,), evenly spaced.
    what : Break
    """

    sums: FloatArray
    number: FloatArray
    xy: FloatArray
    heights_m: FloatArray
    what: Break

    def shifted(self, tilt: FloatArray) -> Moments:
        """Return the sums at the heights `heights_m` + tilt . xy of each tile."""
        step = self.heights_m[1] - self.heights_m[0]
        offset = np.rint(self.xy @ tilt / step).astype(np.int64)
        column = np.arange(len(self.heights_m)) + offset[:, None]
        inside = (column >= 0) & (column < len(self.heights_m))
        rows = np.arange(len(self.sums))[:, None]
        column = np.clip(column, 0, len(self.heights_m) - 1)
        sums = self.sums[rows, column] * inside[..., None]
        return self._replace(sums=sums, number=self.number[rows, column] * inside)


class Gain(NamedTuple):
    """What the break explains, h heights.

    gain : shape (h,), logarithm of the ratio of likelihoods with and without it, scaled down to
        what the differences between tiles allow.
    amplitude, sigma : shape (h,), and its standard error from those differences.
    """

    gain: FloatArray
    amplitude: FloatArray
    sigma: FloatArray


def gain_of(moments: Moments, times: FloatArray | None = None) -> Gain:
    """Add up the tiles, each as many times as `times` says."""
    sums = moments.sums if times is None else moments.sums * times[:, None, None]
    count = moments.number if times is None else moments.number * times[:, None]
    yy, yx, yf, xx, xf, ff = np.moveaxis(sums.sum(axis=0), -1, 0)
    slope, share = yx / (xx + _TINY), xf / (xx + _TINY)
    sse = np.maximum(yy - slope * yx, 0.0) + _TINY
    cross, own = yf - share * yx, np.maximum(ff - share * xf, _TINY)
    amplitude = cross / own
    what = moments.what
    if what.amplitude is None:
        steady = np.clip(2.0 - 2.0 * np.abs(slope / (amplitude + _TINY) - share), 0.0, 1.0)
        likely = np.clip(2.0 - np.abs(amplitude) / what.most, 0.0, 1.0)
        saved = np.maximum(what.sign * cross, 0.0) ** 2 / own * steady * likely
    else:
        saved = 2.0 * what.amplitude * cross - what.amplitude**2 * own
    left = np.maximum(sse - saved, 1e-3 * sse)
    n = count.sum(axis=0)
    variance = np.maximum(sse - cross**2 / own, 1e-3 * sse) / np.maximum(n, 1.0)
    trend = slope - amplitude * share
    scores = (
        sums[..., 2] - trend * sums[..., 4] - amplitude * sums[..., 5]
        - share * (sums[..., 1] - trend * sums[..., 3] - amplitude * sums[..., 4])
    )  # fmt: skip
    scatter = (scores**2 if times is None else scores**2 / np.maximum(times, 1.0)[:, None]).sum(0)
    held = np.maximum(variance * own, scatter)
    sigma = np.sqrt(held) / own
    temper = variance * own / (held + _TINY)
    width = max(1, round(_STEADY_M / (moments.heights_m[1] - moments.heights_m[0])))
    gain = 0.5 * n * np.log(sse / left) * uniform_filter1d(temper, width)
    return Gain(np.where(own > 1e3 * _TINY, gain, 0.0), amplitude, sigma)


def tile_moments(
    smooth: FloatArray, y: FloatArray, at_m: FloatArray, heights_m: FloatArray, what: Break,
    *, with_trend: bool,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return the sums of one tile, shapes (h, 6) and (h,).

    Parameters
    ----------
    smooth : array, shape (n, p)
        Columns of the smooth part.
    y, at_m : array, shape (n,)
        The observations and the heights that they belong to.
    heights_m : array, shape (h,)
    what : Break
    with_trend : bool
        Whether y may change with height in the same way above and below.
    """
    depth = heights_m[:, None] - at_m
    weight = np.maximum(1.0 - (depth / what.window_m) ** 2, 0.0) ** 2
    total = weight.sum(axis=1)
    below = (weight * (depth > 0.0)).sum(axis=1)
    enough = np.minimum(below, total - below) >= LEAST_SIDE
    sums, count = np.zeros((len(heights_m), 6)), np.zeros(len(heights_m))
    if enough.any():
        x = (at_m - at_m.mean()) * float(with_trend)
        sums[enough] = _sums(smooth, y, x, depth[enough], weight[enough], what.scale_m)
        squares = (weight[enough] ** 2).sum(axis=1)
        count[enough] = np.maximum(total[enough] ** 2 / squares - smooth.shape[1], 1.0)
    return sums, count


def _sums(
    smooth: FloatArray, y: FloatArray, x: FloatArray, depth: FloatArray, weight: FloatArray,
    scale_m: float,
) -> FloatArray:  # fmt: skip
    below = np.maximum(depth, 0.0)
    f = below if np.isinf(scale_m) else -scale_m * np.expm1(-below / scale_m)
    p = smooth.shape[1]
    fixed = np.column_stack([smooth, y, x])
    products = (fixed[:, :, None] * fixed[:, None, :]).reshape(len(y), -1)
    whole = np.zeros((len(depth), p + 3, p + 3))
    whole[:, :-1, :-1] = (weight @ products).reshape(-1, p + 2, p + 2)
    whole[:, -1, :-1] = whole[:, :-1, -1] = (weight * f) @ fixed
    whole[:, -1, -1] = (weight * f * f).sum(axis=1)
    normal, right = whole[:, :p, :p], whole[:, :p, p:]
    ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(p)
    rest = whole[:, p:, p:] - np.swapaxes(right, 1, 2) @ np.linalg.solve(normal + ridge, right)
    return np.asarray(rest[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])


def square_tiles(xy: FloatArray, side_m: float, least: int) -> list[IntArray]:
    """Return the rows of each square tile that holds at least so many; `xy` from zero up."""
    column, row = (xy / side_m).astype(np.int64).T
    _, tile = np.unique(row * (column.max() + 1) + column, return_inverse=True)
    tile = tile.reshape(-1)
    order = np.argsort(tile, kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(tile))[:-1])
    return [part for part in parts if len(part) >= least]


def gather(
    parts: list[tuple[FloatArray, FloatArray]], xy: list[FloatArray], heights_m: FloatArray,
    what: Break,
) -> Moments | None:  # fmt: skip
    """Put tiles together, each in units of its residual variance; None where none says anything."""
    said = [i for i, (_, count) in enumerate(parts) if count.any()]
    if not said:
        return None
    sums = np.array([parts[i][0] for i in said])
    count = np.array([parts[i][1] for i in said])
    variance = sums[..., 0].sum(axis=1) / count.sum(axis=1)
    least = 0.3 * float(np.median(variance)) + _TINY
    sums /= np.maximum(variance, least)[:, None, None]
    return Moments(sums, count, np.array([xy[i] for i in said]), heights_m, what)

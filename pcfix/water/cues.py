"""The cues whose change with height gives the water away: slope, colour, brightness, noise.

Slope: refraction lifts the bed towards the surface, so its slopes below the waterline are about
1/1.34 of the true ones (less under slanting rays), and a beach has a break there of known size.
Colour: water swallows red light first (where it is brown with peat, blue), so that the ratio to
green is steady on land and falls with the depth from the waterline on: logarithms of light fall
straight with depth (Lyzenga 1978, Applied Optics 17: 379-383). Brightness and noise change as well,
but wet sand is dark above the water too, and noise grows with depth: they only bear witness.

Looked for is a broken line against the unbroken one, tile by tile, for every height where it may
break: y = (smooth within each tile) + trend * height + amplitude * f(depth), where f(d) = D (1 -
exp(-d / D)) below the height in question and 0 above it; trend and amplitude are the same in all
tiles. Where the amplitude is free, the trend must be the weaker of the two: what fades under water
is steady on land. Each tile gives its sums of squares and products once; to add tiles, at their own
heights under a tilted surface, or to draw them anew, costs little then.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pcfix.model import FloatArray, IntArray
from pcfix.water.samples import Samples, square_tiles

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
    gain = 0.5 * n * np.log(sse / left) * running_mean(temper, width)
    return Gain(np.where(own > 1e3 * _TINY, gain, 0.0), amplitude, sigma)


def running_mean(values: FloatArray, width: int) -> FloatArray:
    """Return means over so many neighbours, shape (n,), mirrored at the ends.

    To the bit what scipy's ``uniform_filter1d`` has, which is not quick to load.
    """
    before = width // 2
    around = np.pad(values, (before, width - 1 - before), mode="symmetric")
    first = np.cumsum(around[:width])[-1:]
    return np.asarray(np.cumsum(np.r_[first, around[width:] - around[:-width]]) / width)


def tile_moments(
    smooth: FloatArray, y: FloatArray, at_m: FloatArray, heights_m: FloatArray, what: Break,
    *, with_trend: bool,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return the sums of one tile, shapes (h, 6) and (h,); zero at heights that it does not reach.

    The observations y, shape (n,), belong to the heights `at_m`; `smooth`, shape (n, p), has the
    columns of the smooth part. With a trend y may change with height in the same way above and
    below.
    """
    reached = np.arange(*np.searchsorted(heights_m, [at_m.min(), at_m.max()]))
    depth = heights_m[reached, None] - at_m
    weight = np.maximum(1.0 - (depth / what.window_m) ** 2, 0.0) ** 2
    total = weight.sum(axis=1)
    below = (weight * (depth > 0.0)).sum(axis=1)
    enough = np.minimum(below, total - below) >= LEAST_SIDE
    sums, count = np.zeros((len(heights_m), 6)), np.zeros(len(heights_m))
    if enough.any():
        x = (at_m - at_m.mean()) * float(with_trend)
        rows, weight = reached[enough], weight[enough]
        sums[rows] = _sums(smooth, y, x, depth[enough], weight, what.scale_m)
        squares = (weight**2).sum(axis=1)
        count[rows] = np.maximum(total[enough] ** 2 / squares - smooth.shape[1], 1.0)
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


def gather(
    parts: list[tuple[FloatArray, FloatArray]], xy: list[FloatArray], heights_m: FloatArray,
    what: Break,
) -> Moments | None:  # fmt: skip
    """Put tiles together, each in units of its residual variance; None where none says anything."""
    telling = [i for i, (_, count) in enumerate(parts) if count.any()]
    if not telling:
        return None
    sums, count = (np.array([parts[i][k] for i in telling]) for k in (0, 1))
    variance = sums[..., 0].sum(axis=1) / count.sum(axis=1)
    least = 0.3 * float(np.median(variance)) + _TINY
    sums /= np.maximum(variance, least)[:, None, None]
    return Moments(sums, count, np.array([xy[i] for i in telling]), heights_m, what)


LIFT = 0.36
"""n - 1 and a little, as rays slant: how much flatter the bed looks than it is."""
MOST_FADING = 1.2
"""Per metre. Clear water gives about 0.3, twice the difference in attenuation over the gamma of
images; what changes faster than any but the darkest water is ground: plants, or a wet edge."""
SLOPE_TILE_CELLS, LIGHT_TILE_CELLS = 12.0, 24.0
_LEAST_CELLS, _LEAST_RELIEF_M = 40, 0.1
_ROUGHNESS_FLOOR_M = 1e-3


class Cue(NamedTuple):
    """A thing to look at.

    places : whether it fixes the level, or only bears witness.
    values : what is looked at, shape (m,); None for the ground itself.
    """

    name: str
    meaning: str
    what: Break
    tile_cells: float
    places: bool
    values: Callable[[Samples], FloatArray] | None


SLOPE = Cue(
    "slope", "the ground looks flatter below",
    Break(math.inf, 0.6, 1.0, LIFT), SLOPE_TILE_CELLS, places=True, values=None,
)  # fmt: skip
RED = Cue(
    "red/green", "red fades against green below",
    Break(0.7, 0.8, -1.0, most=MOST_FADING), LIGHT_TILE_CELLS, places=True,
    values=lambda samples: samples.colour[:, 0] - samples.colour[:, 1],
)  # fmt: skip
BLUE = RED._replace(
    name="blue/green", meaning="blue fades against green below",
    values=lambda samples: samples.colour[:, 2] - samples.colour[:, 1],
)  # fmt: skip
BRIGHT = Cue(
    "brightness", "the ground is darker below",
    Break(0.3, 0.8, -1.0), LIGHT_TILE_CELLS, places=False,
    values=lambda samples: samples.colour.mean(axis=1),
)  # fmt: skip
NOISE = Cue(
    "noise", "heights are noisier below",
    Break(0.7, 0.8, 1.0), LIGHT_TILE_CELLS, places=False,
    values=lambda samples: np.log(samples.rough_m + _ROUGHNESS_FLOOR_M),
)  # fmt: skip


def cues_of(samples: Samples) -> tuple[Cue, ...]:
    """Return the cues that these samples can give."""
    return (SLOPE, RED, BLUE, BRIGHT, NOISE) if len(samples.colour) else (SLOPE, NOISE)


def cue_moments(
    samples: Samples, cue: Cue, heights_m: FloatArray, tilt: FloatArray
) -> Moments | None:
    """Return the sums of a cue over the tiles.

    Heights, shape (h,), are evenly spaced above the plane of that tilt through the samples' origin.
    """
    xy, fall = samples.xyz[:, :2], samples.xyz[:, :2] @ tilt
    values = None if cue.values is None else cue.values(samples)
    parts, middles = [], []
    for rows in _rows_of_tiles(xy, cue.tile_cells * samples.cell_m):
        if values is not None:
            smooth, y = np.ones((len(rows), 1)), values[rows]
            at = samples.smooth_m[rows] - fall[rows]
        else:
            smooth, y = _quadratic(xy[rows]), samples.xyz[rows, 2] - fall[rows]
            if y.min() > heights_m[-1] or y.max() < heights_m[0]:
                continue
            # the ground breaks where it passes the height when smooth, not by each height itself:
            # noise would be on both sides of the equation and hide the break
            at = smooth @ np.linalg.lstsq(smooth, y, rcond=None)[0]
            if np.ptp(at) < _LEAST_RELIEF_M:
                continue
        trend = values is not None
        parts.append(tile_moments(smooth, y, at, heights_m, cue.what, with_trend=trend))
        middles.append(xy[rows].mean(axis=0))
    return gather(parts, middles, heights_m, cue.what)


def _rows_of_tiles(xy: FloatArray, side_m: float) -> list[IntArray]:
    """Return the rows of each square tile that holds enough cells; `xy` from zero up."""
    _, tile = np.unique(square_tiles(xy, side_m), return_inverse=True)
    tile = tile.reshape(-1)
    order = np.argsort(tile, kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(tile))[:-1])
    return [part for part in parts if len(part) >= _LEAST_CELLS]


def _quadratic(xy: FloatArray) -> FloatArray:
    x, y = ((xy - xy.mean(axis=0)) / max(float(np.ptp(xy)), 1e-9)).T
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])

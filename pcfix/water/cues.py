"""Cues whose change with height shows the water: slope, colour, brightness, noise.

Slope: refraction lifts the bed towards the surface, so that its slopes below the waterline are
about 1/1.34 of the true ones (less under oblique rays), and a beach has a break of known size.
Colour: water absorbs red light first (brown water with peat, blue), so that the ratio to green is
constant on land and falls with depth: logarithms of light fall linearly with depth (Lyzenga 1978,
Applied Optics 17: 379-383). Brightness and noise change too, but wet sand is dark above the water,
and noise grows with depth: they only support the others.

A broken line is tested against an unbroken one, tile by tile, for every height of the break: y =
(smooth within each tile) + trend * height + amplitude * f(depth), where f(d) = D (1 - exp(-d / D))
below that height and 0 above it; trend and amplitude are common to all tiles. A free amplitude must
exceed the trend: what fades under water is constant on land. Each tile has its sums of squares and
products, so that adding tiles, at their own heights under a tilted surface, or resampling them is
cheap.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pcfix.model import FloatArray, IntArray
from pcfix.water.samples import Samples, square_tiles

LEAST_SIDE = 8.0
"""Least sum of weights of the cells of a tile above a height, and below."""
_TINY = 1e-12
_STEADY_M = 0.3


class Break(NamedTuple):
    """The break that is tested."""

    scale_m: float  # D, infinite for a straight line below
    window_m: float  # observations weigh less towards this distance above and below
    sign: float  # +1 or -1, of the amplitude
    amplitude: float | None = None  # given by physics, or free
    most: float = np.inf  # a larger free amplitude is unlikely, twice as much impossible


class Moments(NamedTuple):
    """Sums of t tiles at h heights."""

    # (t, h, 6): yy, yx, yf, xx, xf, ff without the smooth part of y, x (height) and f; each tile
    # in units of its own residual variance
    sums: FloatArray
    number: FloatArray  # (t, h), observations
    xy: FloatArray  # (t, 2), centre of each tile
    heights_m: FloatArray  # (h,), evenly spaced
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
    """The gain of a break at h heights."""

    gain: FloatArray  # (h,), log likelihood ratio, reduced by the differences between tiles
    amplitude: FloatArray  # (h,)
    sigma: FloatArray  # (h,), its standard error from those differences


def gain_of(moments: Moments, times: FloatArray | None = None) -> Gain:
    """Add the tiles, each `times` times, and return the gain of the break."""
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
    """Return means over `width` neighbours, shape (n,), mirrored at the ends."""
    before = width // 2
    around = np.pad(values, (before, width - 1 - before), mode="symmetric")
    return np.asarray(np.convolve(around, np.full(width, 1.0 / width), mode="valid"))


def tile_moments(
    smooth: FloatArray, y: FloatArray, at_m: FloatArray, heights_m: FloatArray, what: Break,
    *, with_trend: bool,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return the sums of one tile, shapes (h, 6) and (h,); zero at heights outside it.

    The observations y, shape (n,), have the heights `at_m`; `smooth`, shape (n, p), has the columns
    of the smooth part. With a trend, y may change with height in the same way above and below.
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
    """Join tiles, each in units of its residual variance; None without any information."""
    telling = [i for i, (_, count) in enumerate(parts) if count.any()]
    if not telling:
        return None
    sums, count = (np.array([parts[i][k] for i in telling]) for k in (0, 1))
    variance = sums[..., 0].sum(axis=1) / count.sum(axis=1)
    least = 0.3 * float(np.median(variance)) + _TINY
    sums /= np.maximum(variance, least)[:, None, None]
    return Moments(sums, count, np.array([xy[i] for i in telling]), heights_m, what)


LIFT = 0.36
"""n - 1 and a little more for oblique rays: the apparent reduction of slopes."""
MOST_FADING = 1.2
"""Per metre. Clear water has about 0.3, twice the difference in attenuation over the gamma of
images; faster changes, except in the darkest water, are of the ground: plants, or a wet edge."""
SLOPE_TILE_CELLS, LIGHT_TILE_CELLS = 12.0, 24.0
_LEAST_CELLS, _LEAST_RELIEF_M = 40, 0.1
_ROUGHNESS_FLOOR_M = 1e-3


class Cue(NamedTuple):
    """A cue."""

    name: str
    meaning: str
    what: Break
    tile_cells: float
    places: bool  # whether it determines the level, or only supports others
    values: Callable[[Samples], FloatArray] | None  # (m,); None for the ground itself


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
    """Return the cues of these samples."""
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
            place = xy[rows] - xy[rows].mean(axis=0)
            u, v = (place / max(float(np.ptp(xy[rows])), 1e-9)).T
            smooth = np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])
            y = samples.xyz[rows, 2] - fall[rows]
            if y.min() > heights_m[-1] or y.max() < heights_m[0]:
                continue
            # the smooth ground passes the height of the break: with the heights themselves, noise
            # would be on both sides of the equation and hide the break
            at = smooth @ np.linalg.lstsq(smooth, y, rcond=None)[0]
            if np.ptp(at) < _LEAST_RELIEF_M:
                continue
        trend = values is not None
        parts.append(tile_moments(smooth, y, at, heights_m, cue.what, with_trend=trend))
        middles.append(xy[rows].mean(axis=0))
    return gather(parts, middles, heights_m, cue.what)


def _rows_of_tiles(xy: FloatArray, side_m: float) -> list[IntArray]:
    """Return the rows of each square tile with enough cells; `xy` from zero up."""
    _, tile = np.unique(square_tiles(xy, side_m), return_inverse=True)
    tile = tile.reshape(-1)
    order = np.argsort(tile, kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(tile))[:-1])
    return [part for part in parts if len(part) >= _LEAST_CELLS]

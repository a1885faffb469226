"""Cues whose change with height shows the water: slope and colour.

Slope: refraction lifts the bed towards the surface, so that its slopes below the waterline are
about 1/1.34 of the true ones (less under oblique rays), and a beach has a break of known size.
Colour: water absorbs red light first (brown water with peat, blue), so that the ratio to green is
constant on land and falls with depth: logarithms of light fall linearly with depth (Lyzenga 1978,
Applied Optics 17: 379-383).

A broken line is tested against an unbroken one, tile by tile, for every height of the break: y =
(smooth within each tile) + trend * height + amplitude * f(depth), where f(d) = D (1 - exp(-d / D))
below that height and 0 above it; trend and amplitude are common to all tiles. A free amplitude must
exceed the trend: what fades under water is constant on land. Each tile has its sums of squares and
products, so that adding tiles, at their own heights under a tilted surface, or resampling them is
cheap.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.model import FloatArray, IntArray

LEAST_SIDE = 8.0  # least sum of weights of the cells of a tile above a height, and below
_TINY = 1e-12
_STEADY_M = 0.3


LIFT = 0.36  # n - 1 and a little more for oblique rays: the apparent reduction of slopes
MOST_FADING = 1.2
"""Per metre. Clear water has about 0.3, twice the difference in attenuation over the gamma of
images; faster changes, except in the darkest water, are of the ground: plants, or a wet edge. They
count less, and not at all from twice as much."""


class Cue(NamedTuple):
    """A property of the ground, and its break at the waterline."""

    name: str
    meaning: str
    colour: int | None  # column of the colours, whose ratio to green it is; None for the slope
    tile_cells: float  # side of a tile
    window_m: float  # observations weigh less towards this distance above and below
    scale_m: float = math.inf  # D; infinite for a straight line below
    amplitude: float | None = None  # given by physics, or negative and free


SLOPE = Cue("slope", "the ground looks flatter below", None, 12.0, 0.6, amplitude=LIFT)
RED = Cue("red/green", "red fades against green below", 0, 24.0, 0.8, scale_m=0.7)
BLUE = RED._replace(name="blue/green", meaning="blue fades against green below", colour=2)


class Moments(NamedTuple):
    """Sums of t tiles at h heights."""

    # (t, h, 6): yy, yx, yf, xx, xf, ff without the smooth part of y, x (height) and f; each tile
    # in units of its own residual variance
    sums: FloatArray
    number: FloatArray  # (t, h), observations
    xy: FloatArray  # (t, 2), centre of each tile
    heights_m: FloatArray  # (h,), evenly spaced
    cue: Cue

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
    times = np.ones(len(moments.sums)) if times is None else times
    sums, count = moments.sums * times[:, None, None], moments.number * times[:, None]
    yy, yx, yf, xx, xf, ff = np.moveaxis(sums.sum(axis=0), -1, 0)
    slope, share = yx / (xx + _TINY), xf / (xx + _TINY)
    sse = np.maximum(yy - slope * yx, 0.0) + _TINY
    cross, own = yf - share * yx, np.maximum(ff - share * xf, _TINY)
    amplitude = cross / own
    cue = moments.cue
    if cue.amplitude is None:
        steady = np.clip(2.0 - 2.0 * np.abs(slope / (amplitude + _TINY) - share), 0.0, 1.0)
        likely = np.clip(2.0 - np.abs(amplitude) / MOST_FADING, 0.0, 1.0)
        saved = np.minimum(cross, 0.0) ** 2 / own * steady * likely
    else:
        saved = 2.0 * cue.amplitude * cross - cue.amplitude**2 * own
    left = np.maximum(sse - saved, 1e-3 * sse)
    n = count.sum(axis=0)
    variance = np.maximum(sse - cross**2 / own, 1e-3 * sse) / np.maximum(n, 1.0)
    trend = slope - amplitude * share
    scores = (
        sums[..., 2] - trend * sums[..., 4] - amplitude * sums[..., 5]
        - share * (sums[..., 1] - trend * sums[..., 3] - amplitude * sums[..., 4])
    )  # fmt: skip
    scatter = (scores**2 / np.maximum(times, 1.0)[:, None]).sum(axis=0)
    held = np.maximum(variance * own, scatter)
    sigma = np.sqrt(held) / own
    temper = variance * own / (held + _TINY)
    width = max(1, round(_STEADY_M / (moments.heights_m[1] - moments.heights_m[0])))
    around = np.pad(temper, (width // 2, (width - 1) // 2), "symmetric")
    steady = np.convolve(around, np.full(width, 1.0 / width), "valid")
    gain = 0.5 * n * np.log(sse / left) * steady
    return Gain(np.where(own > 1e3 * _TINY, gain, 0.0), amplitude, sigma)


def tile_moments(
    smooth: FloatArray, y: FloatArray, at_m: FloatArray, heights_m: FloatArray, cue: Cue
) -> tuple[FloatArray, FloatArray]:
    """Return the sums of one tile, shapes (h, 6) and (h,); zero at heights outside it.

    The observations y, shape (n,), have the heights `at_m`; `smooth`, shape (n, p), has the columns
    of the smooth part. A colour may also change with height in the same way above and below.
    """
    reached = np.arange(*np.searchsorted(heights_m, [at_m.min(), at_m.max()]))
    depth = heights_m[reached, None] - at_m
    weight = np.maximum(1.0 - (depth / cue.window_m) ** 2, 0.0) ** 2
    total = weight.sum(axis=1)
    below = (weight * (depth > 0.0)).sum(axis=1)
    enough = np.minimum(below, total - below) >= LEAST_SIDE
    sums, count = np.zeros((len(heights_m), 6)), np.zeros(len(heights_m))
    if not enough.any():
        return sums, count
    rows, weight, p = reached[enough], weight[enough], smooth.shape[1]
    below = np.maximum(depth[enough], 0.0)
    f = below if np.isinf(cue.scale_m) else -cue.scale_m * np.expm1(-below / cue.scale_m)
    x = (at_m - at_m.mean()) * float(cue.colour is not None)
    # the products of all columns, f last, at each height
    fixed = np.column_stack([smooth, y, x])
    products = (fixed[:, :, None] * fixed[:, None, :]).reshape(len(y), -1)
    normal = np.zeros((len(rows), p + 3, p + 3))
    normal[:, :-1, :-1] = (weight @ products).reshape(-1, p + 2, p + 2)
    normal[:, -1, :-1] = normal[:, :-1, -1] = (weight * f) @ fixed
    normal[:, -1, -1] = (weight * f * f).sum(axis=1)
    # without the smooth part: its normal equations are eliminated
    inner, right = normal[:, :p, :p], normal[:, :p, p:]
    ridge = 1e-9 * np.trace(inner, axis1=1, axis2=2)[:, None, None] * np.eye(p)
    rest = normal[:, p:, p:] - np.swapaxes(right, 1, 2) @ np.linalg.solve(inner + ridge, right)
    sums[rows] = rest[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    count[rows] = np.maximum(total[enough] ** 2 / (weight**2).sum(axis=1) - p, 1.0)
    return sums, count


_LEAST_CELLS, _LEAST_RELIEF_M = 40, 0.1


def cue_moments(
    samples: Samples, cue: Cue, heights_m: FloatArray, tilt: FloatArray
) -> Moments | None:
    """Return the sums of a cue over the tiles that show anything; None without any.

    Heights, shape (h,), are evenly spaced above the plane of that tilt through the samples' origin.
    """
    xy, fall = samples.xyz[:, :2], samples.xyz[:, :2] @ tilt
    tile = square_tiles(xy, cue.tile_cells * samples.cell_m)
    order = np.argsort(tile, kind="stable")
    found = []
    for rows in np.split(order, np.flatnonzero(np.diff(tile[order])) + 1):
        if len(rows) < _LEAST_CELLS:
            continue
        if cue.colour is not None:
            smooth = np.ones((len(rows), 1))
            y = samples.colour[rows, cue.colour] - samples.colour[rows, 1]
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
        tile_sums, tile_count = tile_moments(smooth, y, at, heights_m, cue)
        if tile_count.any():
            found.append((tile_sums, tile_count, xy[rows].mean(axis=0)))
    if not found:
        return None
    sums, count, middle = map(np.array, zip(*found, strict=True))
    variance = sums[..., 0].sum(axis=1) / count.sum(axis=1)
    sums /= np.maximum(variance, 0.3 * np.median(variance) + _TINY)[:, None, None]
    return Moments(sums, count, middle, heights_m, cue)


MOST_CELLS = 100_000
POINTS_PER_CELL = 4.0
NEIGHBOURS = 8
_TRIES = 4


class Samples(NamedTuple):
    """One row per cell that holds points; m of them."""

    xyz: FloatArray  # (m, 3), mean x and y, median z, metres from `origin`
    smooth_m: FloatArray  # (m,), height at x, y of a plane through the cells around it
    colour: FloatArray  # (m, 3), mean natural logarithms of red, green, blue; (0, 3) for none
    cell_m: float  # side of a cell
    origin: FloatArray  # (3,), world frame


def sample_cloud(xyz: FloatArray, rgb: npt.NDArray[Any] | None) -> Samples:
    """Thin a cloud, shape (n, 3), metres, world frame, to cells.

    Colours, shape (n, 3), are in any unit from zero up; equal ones count as none.
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
    colour = np.empty((0, 3))
    if rgb is not None and (rgb != rgb[:1]).any():
        light = rgb.astype(np.float64)
        white = max(float(np.percentile(light, 99.0)), 1e-9)
        logs = np.log(light + 0.004 * white)  # a small part of white keeps black finite
        colour = np.column_stack([np.bincount(of_point, column) / count for column in logs.T])
    return Samples(ground, _smoothed(ground), colour, cell_m, origin)


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


def _smoothed(ground: FloatArray) -> FloatArray:
    """Return the height, at each place, of the plane through its neighbours."""
    from scipy.spatial import cKDTree  # slow to import

    k = min(NEIGHBOURS, len(ground) - 1)
    _, near = cKDTree(ground[:, :2]).query(ground[:, :2], k=k + 1)
    around = ground[np.asarray(near)[:, 1:]] - ground[:, None]
    design = np.concatenate([np.ones((*around.shape[:2], 1)), around[..., :2]], axis=2)
    normal = np.einsum("mki,mkj->mij", design, design)
    scale = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    right = np.einsum("mki,mk->mi", design, around[..., 2])
    plane = np.linalg.solve(normal + 1e-9 * scale * np.eye(3), right[..., None])[..., 0]
    return np.asarray(ground[:, 2] + plane[:, 0])

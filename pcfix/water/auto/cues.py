"""The cues whose change with height gives the water away: slope, colour, brightness, noise.

Slope: refraction lifts the bed towards the surface, so its slopes below the waterline are about
1/1.34 of the true ones (less under slanting rays), and a beach has a break there of known size.
Colour: water swallows red light first (where it is brown with peat, blue), so that the ratio to
green is steady on land and falls with the depth from the waterline on: logarithms of light fall
straight with depth (Lyzenga 1978, Applied Optics 17: 379-383). Brightness and noise change as
well, but wet sand is dark above the water too, and noise grows with depth: they only bear witness.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.water.auto.moments import Break, Moments, gather, square_tiles, tile_moments

if TYPE_CHECKING:
    from collections.abc import Callable

    from pcfix.model import FloatArray, IntArray
    from pcfix.water.auto.samples import Samples

LIFT = 0.36
"""n - 1 and a little, as rays slant: how much flatter the bed looks than it is."""
MOST_FADING = 1.2
"""Per metre. Clear water gives about 0.3, twice the difference in attenuation over the gamma of
images; what changes faster than any but the darkest water is ground: plants, or a wet edge."""
SLOPE_TILE_CELLS, LIGHT_TILE_CELLS = 12.0, 24.0
_LEAST_CELLS, _LEAST_RELIEF_M = 40, 0.1
_ROUGHNESS_FLOOR_M = 1e-3


class Cue(NamedTuple):
    """A thing to look at. `places` says whether it fixes the level, or only bears witness."""

    name: str
    words: str
    what: Break
    tile_cells: float
    places: bool


SLOPE = Cue(
    "slope", "the ground looks flatter below",
    Break(math.inf, 0.6, 1.0, LIFT), SLOPE_TILE_CELLS, places=True,
)  # fmt: skip
RED = Cue(
    "red/green", "red fades against green below",
    Break(0.7, 0.8, -1.0, most=MOST_FADING), LIGHT_TILE_CELLS, places=True,
)  # fmt: skip
BLUE = RED._replace(name="blue/green", words="blue fades against green below")
BRIGHT = Cue(
    "brightness", "the ground is darker below",
    Break(0.3, 0.8, -1.0), LIGHT_TILE_CELLS, places=False,
)  # fmt: skip
NOISE = Cue(
    "noise", "heights are noisier below",
    Break(0.7, 0.8, 1.0), LIGHT_TILE_CELLS, places=False,
)  # fmt: skip


def cues_of(samples: Samples) -> tuple[Cue, ...]:
    """Return the cues that these samples can give."""
    light: tuple[Cue, ...] = () if samples.colour is None else (RED, BLUE, BRIGHT)
    if samples.colour is None and samples.intensity is not None:
        light = (BRIGHT,)
    return (SLOPE, *light, NOISE)


def cue_moments(
    samples: Samples, cue: Cue, heights_m: FloatArray, tilt: FloatArray
) -> Moments | None:
    """Return the sums of a cue over the tiles, heights measured from a tilted surface.

    Parameters
    ----------
    samples : Samples
    cue : Cue
    heights_m : array, shape (h,)
        Evenly spaced, from the origin of the samples.
    tilt : array, shape (2,)
        dz/dx and dz/dy, through that origin.
    """
    fall = samples.xyz[:, :2] @ tilt
    of_tile = _slope_tile if cue.name == SLOPE.name else _light_tile(samples, cue)
    parts, middles = [], []
    tiles = square_tiles(samples.xyz[:, :2], cue.tile_cells * samples.cell_m, _LEAST_CELLS)
    for rows in tiles:
        parts.append(of_tile(samples, rows, fall[rows], heights_m, cue.what))
        middles.append(samples.xyz[rows, :2].mean(axis=0))
    return gather(parts, middles, heights_m, cue.what)


def _slope_tile(
    samples: Samples, rows: IntArray, fall: FloatArray, heights_m: FloatArray, what: Break
) -> tuple[FloatArray, FloatArray]:
    """Break the smooth (quadratic) ground where it passes the height.

    Where that is comes from the smooth ground and not from each height itself: noise would be on
    both sides of the equation and hide the break.
    """
    z = samples.xyz[rows, 2] - fall
    if z.min() > heights_m[-1] or z.max() < heights_m[0]:
        return np.zeros((len(heights_m), 6)), np.zeros(len(heights_m))
    smooth = _quadratic(samples.xyz[rows, :2])
    ground = smooth @ np.linalg.lstsq(smooth, z, rcond=None)[0]
    if np.ptp(ground) < _LEAST_RELIEF_M:
        return np.zeros((len(heights_m), 6)), np.zeros(len(heights_m))
    return _near(smooth, z, ground, heights_m, what, with_trend=False)


def _light_tile(samples: Samples, cue: Cue) -> Callable[..., tuple[FloatArray, FloatArray]]:
    y = _values(samples, cue)

    def of_tile(
        samples: Samples, rows: IntArray, fall: FloatArray, heights_m: FloatArray, what: Break
    ) -> tuple[FloatArray, FloatArray]:
        at = samples.smooth_m[rows] - fall
        return _near(np.ones((len(rows), 1)), y[rows], at, heights_m, what, with_trend=True)

    return of_tile


def _near(
    smooth: FloatArray, y: FloatArray, at_m: FloatArray, heights_m: FloatArray, what: Break,
    *, with_trend: bool,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return the sums of a tile, reckoned only for heights that it reaches."""
    first, last = np.searchsorted(heights_m, [at_m.min(), at_m.max()])
    sums, count = np.zeros((len(heights_m), 6)), np.zeros(len(heights_m))
    if last > first:
        reached = slice(first, last)
        sums[reached], count[reached] = tile_moments(
            smooth, y, at_m, heights_m[reached], what, with_trend=with_trend
        )
    return sums, count


def _values(samples: Samples, cue: Cue) -> FloatArray:
    """Return what a cue looks at, shape (m,)."""
    if cue.name == NOISE.name:
        return np.log(samples.rough_m + _ROUGHNESS_FLOOR_M)
    if samples.colour is None:
        if samples.intensity is None:
            raise ValueError("the samples have no light")
        return samples.intensity
    red, green, blue = samples.colour.T
    if cue.name == RED.name:
        return np.asarray(red - green)
    return np.asarray(blue - green if cue.name == BLUE.name else samples.colour.mean(axis=1))


def _quadratic(xy: FloatArray) -> FloatArray:
    x, y = ((xy - xy.mean(axis=0)) / max(float(np.ptp(xy)), 1e-9)).T
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])

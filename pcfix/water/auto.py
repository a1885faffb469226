"""Find the water level in the cloud itself: the one that the cues agree on best.

Slope: refraction lifts the bed towards the surface, so that its slopes below the waterline are
about 1/1.34 of the true ones (less under oblique rays), and a beach has a break of known size.
Colour: water absorbs red light first, so that its ratio to green is constant on land and falls with
depth: logarithms of light fall linearly with depth (Lyzenga 1978, Applied Optics 17: 379-383).

A broken line is tested against an unbroken one, tile by tile, for every height of the break: y =
(smooth within each tile) + trend * height + amplitude * f(depth), where f(d) = D (1 - exp(-d / D))
below that height and 0 above it; trend and amplitude are common to all tiles. A free amplitude must
exceed the trend: what fades under water is constant on land. Each tile has its sums of squares and
products, so that adding or resampling tiles is cheap.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError
from pcfix.model import FloatArray, IntArray, WaterPlane
from pcfix.water.surface import FoundSurface

LEAST_POINTS = 2_000
LEAST_RELIEF_M = 0.3
INSTEAD = "Give the water surface: a level, shoreline points, plane:a,b,c or a mesh."


@dataclass(frozen=True, eq=False, kw_only=True)
class WaterProposal(FoundSurface):
    """A water level found in a cloud."""

    # Standard error of its height, by resampling tiles of the cloud. It does not include errors
    # that all of the shore shares, such as a bank that stops at the water.
    sigma_level_m: float
    level_m: float
    confidence: float  # 0 to 1, by how much the evidence exceeds what is refused
    evidence: dict[str, float]  # figures by name
    reasons: tuple[str, ...]  # the same in sentences

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """Return the standard error (m) of the height at places (m, 2), the same for all."""
        return np.full(len(xy), self.sigma_level_m)

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        return {
            "model": "auto",
            "level_m": self.level_m,
            "sigma_level_m": self.sigma_level_m,
            "confidence": self.confidence,
            "evidence": self.evidence,
            "notes": list(self.reasons),
        }


def find_water(xyz: FloatArray, rgb: npt.NDArray[Any] | None = None) -> WaterProposal:
    """Find the water level of a cloud.

    It is the height below which the ground gets flatter, as refraction lifts the bed, or colour
    fades with depth. Square tiles are summed separately, and resampling them gives the standard
    error. The apparent points, shape (n, 3), are without noise; colours, shape (n, 3), are in any
    unit from zero up, and equal ones count as none.
    """
    if len(xyz) < LEAST_POINTS:
        raise GeometryError(
            "cloud.too_few_points",
            f"{len(xyz)} points are too few to find the water, {LEAST_POINTS} are needed."
            f" {INSTEAD}",
            points=len(xyz), least=LEAST_POINTS,
        )  # fmt: skip
    return _judged(_scanned(sample_cloud(xyz, rgb)))


DIFFERENT_M, DIFFERENT_SIGMAS = 0.5, 3.0  # a level that differs by more than both is another one
# Evidence of colours only, or confidence of slope and colours together, that contradicts a given
# level. They are higher than for `find_water`, to avoid false alarms.
LEAST_AGAINST, SURE_AGAINST = 100.0, 0.8


def find_elsewhere(
    xyz: FloatArray, water_m: FloatArray, rgb: npt.NDArray[Any] | None
) -> WaterProposal | None:
    """Return water that a cloud shows at another height than the given water surface.

    `water_m`, shape (n,), is the height of the given surface above each point. The heights found
    are above it; None if the cloud shows the water there, or nothing. The full search of
    `find_water` runs only if another height gains most.
    """
    samples = sample_cloud(np.column_stack([xyz[:, :2], xyz[:, 2] - water_m]), rgb)
    try:
        coarse = _scanned(samples)
        gain, heights = _gains(coarse), coarse.heights_m + samples.origin[2]
        here = gain[np.abs(heights) <= DIFFERENT_M].max(initial=0.0)
        least, most_rival = NEEDED["slope", "red/green"]  # no other cues need less
        if gain.max() < least or here > most_rival * gain.max():
            return None
        found = _judged(coarse)
    except GeometryError:  # flat ground, or too little evidence
        return None
    differs = abs(found.level_m) > max(DIFFERENT_M, DIFFERENT_SIGMAS * found.sigma_level_m)
    sure = found.evidence["total gain"] >= LEAST_AGAINST or (
        found.confidence >= SURE_AGAINST and f"{SLOPE.name} amplitude" in found.evidence
    )
    return found if differs and sure else None


COARSE_M, FINE_M, MOST_HEIGHTS = 0.04, 0.01, 800
# Half of the heights in fine steps, and the largest difference of two heights of one waterline.
FINE_REACH_M, SAME_PLACE_M = 0.6, 0.3
DRAWS = 120
LEAST_SIGMA_M = 0.015  # least standard error of a waterline: waves, thickness of the cloud


class Scan(NamedTuple):
    """The sums of all cues of a cloud."""

    cues: "list[Moments]"  # of the slope and of the colour, if they show anything
    samples: "Samples"
    heights_m: FloatArray  # (h,), above the origin of the samples


def _scanned(samples: "Samples") -> Scan:
    """Return the sums of the cues at all heights; GeometryError ``cloud.flat`` without relief."""
    low, high = np.percentile(samples.smooth_m, [0.5, 99.5])
    if high - low < LEAST_RELIEF_M:
        raise GeometryError(
            "cloud.flat",
            f"The ground has {high - low:.2f} m of relief, {LEAST_RELIEF_M:g} m are needed to find"
            f" the water. {INSTEAD}",
            relief_m=float(high - low), least=LEAST_RELIEF_M,
        )  # fmt: skip
    count = int(np.clip((high - low) / COARSE_M, 8, MOST_HEIGHTS))
    return _scan_at(samples, np.linspace(low, high, count))


def _scan_at(samples: "Samples", heights_m: FloatArray) -> Scan:
    """Sum all cues at the given heights."""
    cues = (SLOPE, RED) if len(samples.redness) else (SLOPE,)
    found = (cue_moments(samples, cue, heights_m) for cue in cues)
    return Scan([sums for sums in found if sums is not None], samples, heights_m)


def _gains(scan: Scan, rng: np.random.Generator | None = None) -> FloatArray:
    """Return the total gain of the cues at each height, shape (h,).

    With `rng`, tiles are resampled with replacement (bootstrap).
    """
    total = np.zeros(len(scan.heights_m))
    for sums in scan.cues:
        count, times = len(sums.sums), None
        if rng is not None:
            times = np.bincount(rng.integers(0, count, count), minlength=count).astype(float)
        total += np.maximum(gain_of(sums, times)[0], 0.0)
    return total


LEAST_EACH = 3.0  # least gain of a cue that counts
# Least total gain, and largest share of it that another height may have, by the cues that count.
# Physics gives the size of the change of slope; colours may change with height on land too, so that
# they need more evidence where they are the only cue.
NEEDED = {
    ("slope", "red/green"): (12.0, 0.75),
    ("slope",): (25.0, 0.5),
    ("red/green",): (40.0, 0.5),
    (): (25.0, 0.5),
}
LIFTS = 0.15, 0.75  # range of the change of slope by refraction, about 0.36, on rough ground


def _judged(coarse: Scan) -> WaterProposal:
    """Return the best level; GeometryError ``water.not_found`` if its evidence is not enough."""
    near, origin_m = coarse, float(coarse.samples.origin[2])
    reach = np.arange(-FINE_REACH_M, FINE_REACH_M + FINE_M / 2.0, FINE_M)
    for _ in range(2):  # about the best of the coarse steps, then about that of the fine ones
        best_m = float(near.heights_m[int(np.argmax(_gains(near)))])
        near = _scan_at(near.samples, best_m + reach)
    middle = len(reach) // 2
    found_m = float(near.heights_m[middle])
    total, evidence, sentences, strong = 0.0, dict[str, float](), list[str](), list[str]()
    for sums in near.cues:
        cue = sums.cue
        gain, size, sigma = (float(figure[middle]) for figure in gain_of(sums))
        evidence[f"{cue.name} gain"] = gain
        total += max(gain, 0.0)
        if gain >= LEAST_EACH:
            strong.append(cue.name)
            evidence[f"{cue.name} amplitude"], evidence[f"{cue.name} sigma"] = size, sigma
            text = cue.meaning.format(1.0 + size if cue is SLOPE else -size)
            sentences.append(f"{text} (standard error {sigma:.3f})")
    # the rival: the best height elsewhere
    elsewhere = np.abs(coarse.heights_m - found_m) > SAME_PLACE_M
    rivals = np.where(elsewhere, _gains(coarse), 0.0)
    row = int(np.argmax(rivals))
    rival, rival_m = float(rivals[row]), float(coarse.heights_m[row]) + origin_m
    evidence |= {"rival gain": rival, "rival height": rival_m, "total gain": total}
    least, most_rival = NEEDED[tuple(strong)]
    # without colours that agree, a bank that is steeper above the water looks the same
    lift = evidence["slope amplitude"] if strong == ["slope"] else LIFT
    for reason, is_refused, why in (
        ("bank", not LIFTS[0] <= lift <= LIFTS[1],
         f"slopes change there by a factor of {1.0 + lift:.2f}, refraction gives about 1.36"),
        ("weak", total < least, f"its evidence is {total:.0f}, and {least:.0f} is needed"),
        ("contradictory", rival > most_rival * total,
         f"its evidence is {total:.0f}, and {rival_m:.2f} m has {rival:.0f}, nearly as much"),
    ):  # fmt: skip
        if is_refused:
            raise GeometryError(
                "water.not_found",
                f"No water surface was found. The best candidate is {found_m + origin_m:.2f} m, but"
                f" {why}. {INSTEAD}",
                reason=reason, evidence=evidence,
            )  # fmt: skip
    # the standard error of the level by bootstrap
    heights, rng = near.heights_m - found_m, np.random.default_rng(0)
    same = np.abs(heights) <= SAME_PLACE_M
    draws = [_gains(near, rng)[same] for _ in range(DRAWS)]
    levels = np.array([heights[same][int(np.argmax(draw))] for draw in draws])
    return WaterProposal(
        surface=WaterPlane(found_m + origin_m),
        sigma_level_m=math.hypot(float(np.sqrt(np.mean(levels**2))), LEAST_SIGMA_M),
        level_m=found_m + origin_m,
        confidence=float(min(1.0 - rival / total, 1.0 - math.exp(-total / (2.0 * least)))),
        evidence=evidence,
        reasons=tuple(sentences),
    )


LIFT = 0.36  # n - 1 and a little more for oblique rays: the apparent reduction of slopes


class Cue(NamedTuple):
    """A property of the ground, and its break at the waterline."""

    name: str
    meaning: str  # a sentence about the size of the break
    tile_cells: float  # side of a tile
    window_m: float  # observations weigh less towards this distance above and below
    scale_m: float = math.inf  # D; infinite for a straight line below
    amplitude: float | None = None  # given by physics; that of a colour is free, and negative


SLOPE = Cue(
    "slope",
    "the ground is flatter below the surface: true slopes are {:.2f} times the apparent ones",
    tile_cells=12.0, window_m=0.6, amplitude=LIFT,
)  # fmt: skip
RED = Cue(
    "red/green",
    "red fades faster than green below the surface: the logarithm of their ratio falls by {:.3f}"
    " per metre",
    tile_cells=24.0, window_m=0.8, scale_m=0.7,
)  # fmt: skip


class Moments(NamedTuple):
    """Sums of t tiles at h heights."""

    # (t, h, 6): yy, yx, yf, xx, xf, ff without the smooth part of y, x (height) and f; each tile
    # in units of its own residual variance
    sums: FloatArray
    number: FloatArray  # (t, h), observations
    heights_m: FloatArray  # (h,), evenly spaced
    cue: Cue


# Per metre. Clear water has about 0.3, twice the difference in attenuation over the gamma of
# images; faster changes, except in the darkest water, are of the ground: plants, or a wet edge.
# They count less, and not at all from twice as much.
MOST_FADING = 1.2
_TINY, _STEADY_M = 1e-12, 0.3


def gain_of(
    moments: Moments, times: FloatArray | None = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Add the tiles, each `times` times, and return what a break gains at h heights.

    The gain, shape (h,), is a log likelihood ratio, reduced by the differences between tiles. Its
    amplitude follows, shape (h,), and the standard error of that from these differences.
    """
    times = np.ones(len(moments.sums)) if times is None else times
    sums, cue = moments.sums * times[:, None, None], moments.cue
    yy, yx, yf, xx, xf, ff = np.moveaxis(sums.sum(axis=0), -1, 0)
    # regression of y, then of f, on the height x; what is left of both gives the amplitude
    slope, share = yx / (xx + _TINY), xf / (xx + _TINY)
    sse = np.maximum(yy - slope * yx, 0.0) + _TINY
    cross, own = yf - share * yx, np.maximum(ff - share * xf, _TINY)
    amplitude = cross / own
    trend = slope - amplitude * share
    # by how much the break reduces the sum of squares
    if cue.amplitude is None:
        # less for a trend on land that is like the fading, and for a fading that is none of water
        steady = np.clip(2.0 - 2.0 * np.abs(slope / (amplitude + _TINY) - share), 0.0, 1.0)
        likely = np.clip(2.0 - np.abs(amplitude) / MOST_FADING, 0.0, 1.0)
        saved = np.minimum(cross, 0.0) ** 2 / own * steady * likely
    else:
        saved = 2.0 * cue.amplitude * cross - cue.amplitude**2 * own
    n = (moments.number * times[:, None]).sum(axis=0)
    gain = 0.5 * n * np.log(sse / np.maximum(sse - saved, 1e-3 * sse))
    # variance of `cross`, expected from the residuals, and found in the scores of the tiles (the
    # derivatives of their sums of squares by the amplitude), which is larger if the tiles disagree
    expected = np.maximum(sse - cross**2 / own, 1e-3 * sse) / np.maximum(n, 1.0) * own
    scores = (
        sums[..., 2] - trend * sums[..., 4] - amplitude * sums[..., 5]
        - share * (sums[..., 1] - trend * sums[..., 3] - amplitude * sums[..., 4])
    )  # fmt: skip
    scatter = (scores**2 / np.maximum(times, 1.0)[:, None]).sum(axis=0)
    found = np.maximum(expected, scatter)
    # the gain shrinks by their ratio, as a mean over neighbouring heights: that of one is noisy
    temper = expected / (found + _TINY)
    width = max(1, round(_STEADY_M / (moments.heights_m[1] - moments.heights_m[0])))
    around = np.pad(temper, (width // 2, (width - 1) // 2), "symmetric")
    gain *= np.convolve(around, np.full(width, 1.0 / width), "valid")
    return np.where(own > 1e3 * _TINY, gain, 0.0), amplitude, np.sqrt(found) / own


LEAST_TILE_CELLS = 40
LEAST_SIDE = 8.0  # least sum of weights of the cells of a tile above a height, and below


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
    x = (at_m - at_m.mean()) * float(cue.amplitude is None)
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
    # as many observations of equal weight, less the unknowns of the smooth part
    count[rows] = np.maximum(total[enough] ** 2 / (weight**2).sum(axis=1) - p, 1.0)
    return sums, count


def cue_moments(samples: "Samples", cue: Cue, heights_m: FloatArray) -> Moments | None:
    """Return the sums of a cue over the tiles that show anything; None without any.

    Heights, shape (h,), are evenly spaced above the samples' origin.
    """
    xy = samples.xyz[:, :2]
    tile = square_tiles(xy, cue.tile_cells * samples.cell_m)
    order = np.argsort(tile, kind="stable")
    found = []
    for rows in np.split(order, np.flatnonzero(np.diff(tile[order])) + 1):
        if len(rows) < LEAST_TILE_CELLS:
            continue
        if cue.amplitude is None:
            smooth, y, at = np.ones((len(rows), 1)), samples.redness[rows], samples.smooth_m[rows]
        else:
            place = xy[rows] - xy[rows].mean(axis=0)
            u, v = (place / max(float(np.ptp(xy[rows])), 1e-9)).T
            smooth = np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])
            y = samples.xyz[rows, 2]
            if y.min() > heights_m[-1] or y.max() < heights_m[0]:
                continue
            # the smooth ground passes the height of the break: with the heights themselves, noise
            # would be on both sides of the equation and hide the break
            at = smooth @ np.linalg.lstsq(smooth, y, rcond=None)[0]
        tile_sums, tile_count = tile_moments(smooth, y, at, heights_m, cue)
        if tile_count.any():
            found.append((tile_sums, tile_count))
    if not found:
        return None
    sums, count = map(np.array, zip(*found, strict=True))
    # units of the residual variance of each tile; that of a very smooth one is not believed
    variance = sums[..., 0].sum(axis=1) / count.sum(axis=1)
    sums /= np.maximum(variance, 0.3 * np.median(variance) + _TINY)[:, None, None]
    return Moments(sums, count, heights_m, cue)


MOST_CELLS, POINTS_PER_CELL = 100_000, 4.0
NEIGHBOURS = 8
_TRIES = 4


class Samples(NamedTuple):
    """One row per cell that holds points; m of them."""

    xyz: FloatArray  # (m, 3), mean x and y, median z, metres from `origin`
    smooth_m: FloatArray  # (m,), height at x, y of a plane through the cells around it
    redness: FloatArray  # (m,), mean natural logarithm of red by green; empty without colours
    cell_m: float  # side of a cell
    origin: FloatArray  # (3,), world frame


def sample_cloud(xyz: FloatArray, rgb: npt.NDArray[Any] | None) -> Samples:
    """Thin a cloud, shape (n, 3), metres, world frame, to cells.

    Colours, shape (n, 3), are in any unit from zero up; equal ones count as none.
    """
    from scipy.spatial import cKDTree  # slow to import

    origin = xyz.min(axis=0)
    local = xyz - origin
    # cells of about `POINTS_PER_CELL`, at most `MOST_CELLS`; clouds seldom fill their bounding box
    wanted = min(len(local) / POINTS_PER_CELL, MOST_CELLS)
    cell_m = float(np.sqrt(max(np.prod(np.ptp(local[:, :2], axis=0)), 1e-6) / wanted))
    for _ in range(_TRIES):
        cell_m *= np.sqrt(len(np.unique(square_tiles(local, cell_m))) / wanted)
    tiles = square_tiles(local, cell_m)
    _, of_point, count = np.unique(tiles, return_inverse=True, return_counts=True)
    x, y = (np.bincount(of_point, local[:, i]) / count for i in (0, 1))
    # the median of each cell; scipy.ndimage would take longer to import than this takes
    z, first = local[np.lexsort((local[:, 2], of_point)), 2], np.cumsum(count) - count
    median = 0.5 * (z[first + (count - 1) // 2] + z[first + count // 2])
    ground = np.column_stack([x, y, median])
    redness = np.zeros(0)
    if rgb is not None and (rgb != rgb[:1]).any():
        light = rgb.astype(np.float64)
        white = max(float(np.percentile(light, 99.0)), 1e-9)
        logs = np.log(light + 0.004 * white)  # a small part of white keeps black finite
        red, green = (np.bincount(of_point, logs[:, i]) / count for i in (0, 1))
        redness = red - green
    # the plane through the neighbours of each cell, by the normal equations: three unknowns, and
    # half the time
    near = cKDTree(ground[:, :2]).query(ground[:, :2], k=min(NEIGHBOURS + 1, len(ground)))[1]
    around = ground[np.asarray(near)[:, 1:]] - ground[:, None]
    design = np.concatenate([np.ones((*around.shape[:2], 1)), around[..., :2]], axis=2)
    normal, right = (np.swapaxes(design, 1, 2) @ one for one in (design, around[..., 2:]))
    plane = np.linalg.pinv(normal, hermitian=True) @ right
    return Samples(ground, median + plane[:, 0, 0], redness, cell_m, origin)


def square_tiles(local: FloatArray, side_m: float) -> IntArray:
    """Return the number of the square of each place, x and y from zero up."""
    column, row = (local[:, :2] / side_m).astype(np.int64).T
    return np.asarray(row * (column.max(initial=0) + 1) + column)

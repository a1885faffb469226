"""The water surface from the cloud alone: `find_water`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError, SettingError
from pcfix.model import NOISE_CLASSES, FloatArray, WaterPlane
from pcfix.water import search
from pcfix.water.cues import SLOPE, gain_of
from pcfix.water.fit import fit_water
from pcfix.water.samples import Samples, layer_gain, sample_cloud
from pcfix.water.search import INSTEAD, LAYER, Looked, Peak, judge
from pcfix.water.tilted import Tilted, find_tilt

LEAST_POINTS = 2_000
LEAST_RELIEF_M = 0.3
LEAST_SIGMA_M = 0.015
"""No waterline is sharper: waves, and the thickness of the cloud."""
TILT_SIGMAS, TILT_GAIN = 3.0, 6.0
LEAST_CLASSIFIED = 30
WATER_CLASSES = (9, 41)
"""ASPRS: water, and water surface of the topo-bathy profile."""
MOST_SHORELINE = 2_000


def find_water(
    xyz: npt.ArrayLike,
    *,
    rgb: npt.ArrayLike | None = None,
    number_of_returns: npt.ArrayLike | None = None,
    classes: npt.ArrayLike | None = None,
) -> WaterProposal:
    """Find the water surface from what a cloud shows of it.

    Looked for are a height at which the ground gets flatter, as refraction lifts the bed; from
    which on colour fades with depth; and where points float in a thin layer. Square tiles are
    summed up on their own, and tiles drawn anew give the standard error. Points that are
    classified as water decide alone.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Apparent points, metres, world frame.
    rgb : array, shape (n, 3), optional
        In any unit from zero up. All equal counts as none.
    number_of_returns : array, shape (n,), optional
        Where pulses have several, points that float are sought among these.
    classes : array, shape (n,), optional
        ASPRS classes: 9 and 41 are the water surface, 7 and 18 noise that is left out.

    Returns
    -------
    WaterProposal

    Raises
    ------
    SettingError
        If the arrays do not belong together.
    GeometryError
        If the evidence is poor: no land, no water, weak or contradictory cues.
    """
    points = np.asarray(xyz, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SettingError(f"xyz must have the shape (n, 3), not {points.shape}.")
    colours = _column("rgb", rgb, (len(points), 3))
    returns = _column("number_of_returns", number_of_returns, (len(points),))
    labels = _column("classes", classes, (len(points),))
    kept = np.isfinite(points).all(axis=1)
    if labels is not None:
        kept &= ~np.isin(labels, NOISE_CLASSES)
    points = points[kept]
    if len(points) < LEAST_POINTS:
        raise GeometryError(
            f"No water surface was looked for: {len(points)} points are too few,"
            f" {LEAST_POINTS} are needed; {INSTEAD}."
        )
    samples = sample_cloud(
        points, *(None if column is None else column[kept] for column in (colours, returns))
    )
    if labels is not None:
        water = np.isin(labels[kept], WATER_CLASSES)
        if water.sum() >= LEAST_CLASSIFIED:
            return _from_classes(points[water], samples)
    return _from_cues(samples)


APART_M, APART_SIGMAS = 0.5, 3.0
"""By how much a level must miss the shoreline of a cloud to be worth a word."""
LEAST_AGAINST, SURE_AGAINST = 100.0, 0.8
"""Evidence of colours alone, and confidence of slope and colours together, that stands against a
level that was given: more than is asked of a level where there is none, as none may be wrong."""


def find_elsewhere(
    xyz: FloatArray, water_m: FloatArray, rgb: npt.NDArray[Any] | None
) -> tuple[WaterProposal | None, Tilted | None]:
    """Return the water that a cloud shows elsewhere than that which was given, if any.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Apparent points, metres, world frame.
    water_m : array, shape (n,)
        Height of the given water surface above each.
    rgb : array, shape (n, 3), or None

    Returns
    -------
    level : WaterProposal or None
        With heights above the given surface; None where the cloud shows it there, or nothing.
        Only where another height gains most is it looked at as closely as `find_water` does.
    tilted : Tilted or None
    """
    samples = sample_cloud(np.column_stack([xyz[:, :2], xyz[:, 2] - water_m]), rgb, None)
    heights = search.all_heights(samples)
    if np.ptp(heights) < LEAST_RELIEF_M:
        return None, None
    whole = search.look(samples, heights, search.NO_TILT)
    return _elsewhere(samples, whole), find_tilt(whole)


def _elsewhere(samples: Samples, whole: Looked) -> WaterProposal | None:
    """Return the water at another height than zero, if it is sure."""
    heights = whole.heights_m
    gain = search.gains(whole, search.NO_TILT)
    here = gain[np.abs(heights + samples.origin[2]) <= APART_M].max(initial=0.0)
    best = int(np.argmax(gain))
    slope = next((gain_of(sums) for cue, sums in whole.cues if cue == SLOPE), None)
    lifted = slope is not None and (
        slope.gain[best] >= search.LEAST_EACH
        and search.LIFTS[0] <= slope.amplitude[best] <= search.LIFTS[1]
    )
    few = gain[best] < (search.LEAST_AGREED if lifted else LEAST_AGAINST)
    if few or here > search.MOST_RIVAL_AGREED * gain[best]:
        return None
    try:
        found = _from_cues(samples)
    except GeometryError:
        return None
    apart = abs(found.level_m) > max(APART_M, APART_SIGMAS * found.sigma_level_m)
    alone = found.evidence["total gain"] >= LEAST_AGAINST
    sure = alone or (
        found.confidence >= SURE_AGAINST and f"{SLOPE.name} amplitude" in found.evidence
    )
    return found if apart and sure else None


def _column(
    name: str, values: npt.ArrayLike | None, shape: tuple[int, ...]
) -> npt.NDArray[Any] | None:
    if values is None:
        return None
    column = np.asarray(values)
    if column.shape != shape:
        raise SettingError(f"{name} must have the shape {shape}, not {column.shape}.")
    return column


def _from_cues(samples: Samples) -> WaterProposal:
    heights = search.all_heights(samples)
    if np.ptp(heights) < LEAST_RELIEF_M:
        raise GeometryError(
            f"No water surface was looked for: the ground has {np.ptp(heights):.2f} m of relief,"
            f" {LEAST_RELIEF_M:g} m are needed to tell land from bed; {INSTEAD}."
        )
    whole = search.look(samples, heights, search.NO_TILT)
    peak, near, sigma_m, tilt_along, sigma_tilt = _choose(samples, whole)
    confidence, evidence, reasons = judge(samples, peak, near, whole, sigma_m)
    if not peak.tilt.any() and not math.isnan(sigma_tilt):
        tilt, sigma = 100.0 * abs(tilt_along), 100.0 * sigma_tilt
        reasons += (
            f"a tilt of {tilt:.2f} ± {sigma:.2f} % along the shore is possible, not certain",
        )
    shore = samples.xyz[search.near_surface(samples, peak)]
    if len(shore) == 0:
        raise GeometryError(f"No water surface was found: nowhere does ground pass it; {INSTEAD}.")
    shore = shore[:: math.ceil(len(shore) / MOST_SHORELINE)]
    centre = shore[:, :2].mean(axis=0)
    level = peak.level_m + float(centre @ peak.tilt) + float(samples.origin[2])
    x, y = centre + samples.origin[:2]
    gain = {cue.name: gain_of(sums.shifted(peak.tilt)).gain for cue, sums in whole.cues}
    gain[LAYER] = layer_gain(samples, whole.heights_m, peak.tilt)
    b, c = peak.tilt.tolist()
    return WaterProposal(
        surface=WaterPlane(level - (b * float(x) + c * float(y)), b, c),
        sigma_level_m=sigma_m,
        centre_xy=np.array([x, y]),
        level_m=level,
        tilt=peak.tilt,
        sigma_tilt=sigma_tilt,
        confidence=confidence,
        evidence=evidence | {"tilt along shore": tilt_along, "sigma tilt": sigma_tilt},
        reasons=reasons,
        shoreline=shore + samples.origin,
        curve_height_m=whole.heights_m + float(samples.origin[2] + centre @ peak.tilt),
        curves=gain,
        ground=samples.xyz + samples.origin,
    )


def _choose(samples: Samples, whole: Looked) -> tuple[Peak, Looked, float, float, float]:
    """Return the level, or the plane where the tilt is significant and earns its keep.

    With it come what was seen near it, the standard error of the level, and the tilt along the
    shore with its standard error, NaN where it was not looked for.
    """
    start = search.best(whole, search.NO_TILT[None])
    level, near = search.refine(samples, start, None)
    axis, step = search.axis_of(samples, level), search.tilt_step(samples)
    steps = math.ceil(search.LARGEST_TILT / step)
    tilted = search.best(whole, search.tilts_along(axis, step, steps))
    along, sigma_tilt = 0.0, math.nan
    if tilted.score > start.score:
        plane, near_plane = search.refine(samples, tilted, axis)
        along = float(plane.tilt @ axis)
        if plane.score > level.score + TILT_GAIN and abs(along) <= search.LARGEST_TILT:
            levels, tilts = search.drawn(near_plane, axis, step)
            sigma_tilt = math.hypot(1.4826 * float(np.median(np.abs(tilts))), step / 6.0)
            if abs(along) > TILT_SIGMAS * sigma_tilt:
                return plane, near_plane, _sigma(levels), along, sigma_tilt
    levels, _ = search.drawn(near, None, step)
    return level, near, _sigma(levels), along, sigma_tilt


def _sigma(levels_m: FloatArray) -> float:
    return math.hypot(float(np.sqrt(np.mean(levels_m**2))), LEAST_SIGMA_M)


@dataclass(frozen=True, eq=False)
class WaterProposal:
    """A water surface that a cloud suggests.

    Attributes
    ----------
    surface : WaterPlane
    sigma_level_m : float
        Standard error of its height at `centre_xy`, from drawing tiles of the cloud anew. It knows
        nothing of what deceives all of the shore alike, such as a bank that stops at the water.
    centre_xy : array, shape (2,)
        The middle of the shoreline, metres, world frame.
    level_m : float
        The height of the surface there.
    tilt : array, shape (2,)
        dz/dx and dz/dy.
    sigma_tilt : float
        Standard error of the tilt along the shore, dz per metre; NaN where it was not looked for.
    confidence : float
        0 to 1: how far the evidence is above what is refused.
    evidence : dict of str to float
        The figures, by name.
    reasons : tuple of str
        The same in sentences.
    shoreline : array, shape (m, 3)
        Places where the ground passes the surface, metres, world frame.
    curve_height_m : array, shape (h,)
        World heights; of a tilted surface, those above `centre_xy`.
    curves : dict of array, shape (h,)
        What each cue, by its name, gains from water at each height: the logarithm of a ratio of
        likelihoods, under the tilt that was chosen.
    ground : array, shape (c, 3)
        The cloud thinned to cells, metres, world frame.
    """

    surface: WaterPlane
    sigma_level_m: float
    centre_xy: FloatArray
    level_m: float
    tilt: FloatArray
    sigma_tilt: float
    confidence: float
    evidence: dict[str, float]
    reasons: tuple[str, ...]
    shoreline: FloatArray
    curve_height_m: FloatArray
    curves: dict[str, FloatArray]
    ground: FloatArray

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        return {
            "model": "auto",
            "level_m": self.level_m,
            "sigma_level_m": self.sigma_level_m,
            "at_xy": self.centre_xy.tolist(),
            "tilt_percent": 100.0 * float(np.hypot(*self.tilt)),
            "confidence": self.confidence,
            "evidence": self.evidence,
            "notes": list(self.reasons),
        }


def _from_classes(water: FloatArray, samples: Samples) -> WaterProposal:
    """Return what fits the points of the water classes, shape (w, 3), world frame."""
    thinned = water[:: math.ceil(len(water) / MOST_SHORELINE)]
    fit = fit_water(thinned)
    share = float(fit.accepted.mean())
    counts, edges = np.histogram(thinned[:, 2], 60)
    return WaterProposal(
        surface=fit.surface,
        sigma_level_m=fit.sigma_level_m,
        centre_xy=fit.centre_xy,
        level_m=fit.level_m,
        tilt=fit.tilt,
        sigma_tilt=fit.sigma_tilt_percent / 100.0,
        confidence=share,
        evidence={
            "classified points": float(len(water)),
            "sigma of a point": fit.sigma_m,
            "share accepted": share,
        },
        reasons=(
            f"{len(water):,} points are classified as water and scatter by {fit.sigma_m:.3f} m",
            *fit.notes,
        ),
        shoreline=thinned[fit.accepted],
        curve_height_m=(edges[1:] + edges[:-1]) / 2.0,
        curves={"classified points": counts + 0.0},
        ground=samples.xyz + samples.origin,
    )

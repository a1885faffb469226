"""The water surface from the cloud alone: `find_water`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError, SettingError
from pcfix.model import NOISE_CLASSES, FloatArray, IntArray, WaterPlane
from pcfix.water import search
from pcfix.water.cues import gain_of
from pcfix.water.fit import fit_water
from pcfix.water.samples import Floating, Samples, layer_gain, points_above, sample_cloud
from pcfix.water.search import INSTEAD, LAYER, Looked, Peak, judge

_Column: TypeAlias = "npt.NDArray[Any] | None"

LEAST_POINTS = 2_000
LEAST_RELIEF_M = 0.3
LEAST_SIGMA_M = 0.015
"""No waterline is sharper: waves, and the thickness of the cloud."""
TILT_SIGMAS, TILT_GAIN = 3.0, 6.0
LEAST_CLASSIFIED = 30
MOST_SHORELINE = 2_000


def find_water(
    xyz: npt.ArrayLike,
    *,
    rgb: npt.ArrayLike | None = None,
    intensity: npt.ArrayLike | None = None,
    number_of_returns: npt.ArrayLike | None = None,
    classes: npt.ArrayLike | None = None,
    centres: npt.ArrayLike | None = None,
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
    intensity : array, shape (n,), optional
        Looked at where there is no colour.
    number_of_returns : array, shape (n,), optional
        Where pulses have several, points that float are sought among these.
    classes : array, shape (n,), optional
        ASPRS classes: 9 and 41 are the water surface, 7 and 18 noise that is left out.
    centres : array, shape (k, 3), optional
        Projection centres; points above the lowest are left out.

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
    points = _coordinates(xyz)
    colour = _column("rgb", rgb, len(points), 3)
    bright = _column("intensity", intensity, len(points), 1)
    returns = _column("number_of_returns", number_of_returns, len(points), 1)
    labels = _column("classes", classes, len(points), 1)
    kept = _kept(points, labels, centres)
    if len(kept) < LEAST_POINTS:
        raise GeometryError(
            f"No water surface was looked for: {len(kept)} points are too few,"
            f" {LEAST_POINTS} are needed; {INSTEAD}."
        )
    points = points[kept]
    samples = sample_cloud(points, _varied(colour, kept), _varied(bright, kept))
    if labels is not None:
        water = np.isin(labels[kept, 0], WATER_CLASSES)
        if water.sum() >= LEAST_CLASSIFIED:
            return from_classes(points[water], samples)
    return _from_cues(samples, _floating(samples, points, _of(returns, kept)))


class _Choice(NamedTuple):
    """A surface, what was seen near it, and how well it is known."""

    peak: Peak
    near: Looked
    sigma_m: float
    tilt_along: float
    sigma_tilt: float


def _from_cues(samples: Samples, floating: Floating) -> WaterProposal:
    heights = search.all_heights(samples)
    if np.ptp(heights) < LEAST_RELIEF_M:
        raise GeometryError(
            f"No water surface was looked for: the ground has {np.ptp(heights):.2f} m of relief,"
            f" {LEAST_RELIEF_M:g} m are needed to tell land from bed; {INSTEAD}."
        )
    whole = search.look(samples, floating, heights, search.NO_TILT)
    choice = _choose(samples, floating, whole)
    verdict = judge(samples, choice.peak, choice.near, whole, choice.sigma_m)
    shore = samples.xyz[search.near_surface(samples, choice.peak)]
    if len(shore) == 0:
        raise GeometryError(f"No water surface was found: nowhere does ground pass it; {INSTEAD}.")
    shore = shore[:: math.ceil(len(shore) / MOST_SHORELINE)]
    centre = shore[:, :2].mean(axis=0)
    level = choice.peak.level_m + float(centre @ choice.peak.tilt)
    world = centre + samples.origin[:2], level + float(samples.origin[2])
    tilted = {"tilt along shore": choice.tilt_along, "sigma tilt": choice.sigma_tilt}
    return WaterProposal(
        surface=plane_through(*world, choice.peak.tilt),
        sigma_level_m=choice.sigma_m,
        centre_xy=world[0],
        level_m=world[1],
        tilt=choice.peak.tilt,
        sigma_tilt=choice.sigma_tilt,
        confidence=verdict.confidence,
        evidence=verdict.evidence | tilted,
        reasons=(*verdict.reasons, *_doubt(choice)),
        shoreline=shore + samples.origin,
        curves=_curves(samples, whole, choice.peak, centre),
        ground=samples.xyz + samples.origin,
    )


def _choose(samples: Samples, floating: Floating, whole: Looked) -> _Choice:
    """Return the level, or the plane where the tilt is significant and earns its keep."""
    start = search.best(whole, search.NO_TILT[None])
    level, near = search.refine(samples, floating, start, None)
    axis, step = search.axis_of(samples, level), search.tilt_step(samples)
    steps = math.ceil(search.LARGEST_TILT / step)
    tilted = search.best(whole, search.tilts_along(axis, step, steps))
    along, sigma_tilt = 0.0, math.nan
    if tilted.score > start.score:
        plane, near_plane = search.refine(samples, floating, tilted, axis)
        along = float(plane.tilt @ axis)
        if plane.score > level.score + TILT_GAIN and abs(along) <= search.LARGEST_TILT:
            levels, tilts = search.drawn(near_plane, axis, step)
            sigma_tilt = math.hypot(1.4826 * float(np.median(np.abs(tilts))), step / 6.0)
            if abs(along) > TILT_SIGMAS * sigma_tilt:
                return _Choice(plane, near_plane, _sigma(levels), along, sigma_tilt)
    levels, _ = search.drawn(near, None, step)
    return _Choice(level, near, _sigma(levels), along, sigma_tilt)


def _sigma(levels_m: FloatArray) -> float:
    return math.hypot(float(np.sqrt(np.mean(levels_m**2))), LEAST_SIGMA_M)


def _doubt(choice: _Choice) -> tuple[str, ...]:
    """Return a sentence about a tilt that may be there, but was not taken."""
    if choice.peak.tilt.any() or math.isnan(choice.sigma_tilt):
        return ()
    tilt, sigma = 100.0 * abs(choice.tilt_along), 100.0 * choice.sigma_tilt
    return (f"a tilt of {tilt:.2f} ± {sigma:.2f} % along the shore is possible, not certain",)


def _curves(samples: Samples, whole: Looked, peak: Peak, centre: FloatArray) -> EvidenceCurves:
    """Return what every cue gains over all heights, under the tilt that was chosen."""
    gain = {cue.name: gain_of(sums.shifted(peak.tilt)).gain for cue, sums in whole.cues}
    gain[LAYER] = layer_gain(whole.floating, whole.heights_m, peak.tilt)
    raised = float(samples.origin[2] + centre @ peak.tilt)
    return EvidenceCurves(whole.heights_m + raised, gain)


def plane_through(centre_xy: FloatArray, level_m: float, tilt: FloatArray) -> WaterPlane:
    """Return the plane of that height and tilt at a place."""
    b, c = float(tilt[0]), float(tilt[1])
    return WaterPlane(level_m - (b * float(centre_xy[0]) + c * float(centre_xy[1])), b, c)


def _floating(samples: Samples, points: FloatArray, returns: _Column) -> Floating:
    """Return the points above the ground; those of several returns where there are such."""
    several = None if returns is None else np.asarray(returns[:, 0] > 1)
    if several is None or not 0.01 <= several.mean() <= 0.99:
        return points_above(samples, points)
    return points_above(samples, points, several)


def _coordinates(xyz: npt.ArrayLike) -> FloatArray:
    points = np.asarray(xyz, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SettingError(f"xyz must have the shape (n, 3), not {points.shape}.")
    return points


def _column(name: str, values: npt.ArrayLike | None, n: int, width: int) -> _Column:
    """Return values as n rows, or None."""
    if values is None:
        return None
    column = np.asarray(values)
    if column.shape not in ((n, width), (n,) if width == 1 else (n, width)):
        shape = f"({n},)" if width == 1 else f"({n}, {width})"
        raise SettingError(f"{name} must have the shape {shape}, not {column.shape}.")
    return column.reshape(n, width)


def _kept(points: FloatArray, classes: _Column, centres: npt.ArrayLike | None) -> IntArray:
    """Return the rows that are finite, not noise, and below the cameras."""
    kept = np.isfinite(points).all(axis=1)
    if classes is not None:
        kept &= ~np.isin(classes[:, 0], NOISE_CLASSES)
    if centres is not None:
        kept &= points[:, 2] < np.asarray(centres, np.float64)[:, 2].min()
    return np.flatnonzero(kept)


def _of(values: _Column, kept: IntArray) -> _Column:
    return None if values is None else values[kept]


def _varied(values: _Column, kept: IntArray) -> _Column:
    """Return the values of the points that are kept, None where all are the same."""
    chosen = _of(values, kept)
    return chosen if chosen is not None and (chosen != chosen[:1]).any() else None


@dataclass(frozen=True, eq=False)
class EvidenceCurves:
    """What each cue gains (logarithm of a ratio of likelihoods) from water at each height.

    Attributes
    ----------
    height_m : array, shape (h,)
        World heights; of a tilted surface, those above `WaterProposal.centre_xy`.
    gain : dict of array, shape (h,)
        By the name of the cue.
    """

    height_m: FloatArray
    gain: dict[str, FloatArray]


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
    curves : EvidenceCurves
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
    curves: EvidenceCurves
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


WATER_CLASSES = (9, 41)
"""ASPRS: water, and water surface of the topo-bathy profile."""
MOST_POINTS = 2_000


def from_classes(water: FloatArray, samples: Samples) -> WaterProposal:
    """Fit the points of the water classes.

    Parameters
    ----------
    water : array, shape (w, 3)
        Metres, world frame.
    samples : Samples
        Of the whole cloud.

    Raises
    ------
    GeometryError
        If they do not make a level or a plane.
    """
    thinned = water[:: math.ceil(len(water) / MOST_POINTS)]
    fit = fit_water(thinned)
    accepted = thinned[fit.accepted]
    figures = {
        "classified points": float(len(water)),
        "sigma of a point": fit.sigma_m,
        "share accepted": float(fit.accepted.mean()),
    }
    counts, edges = np.histogram(thinned[:, 2], 60)
    reasons = (
        f"{len(water):,} points are classified as water and scatter by {fit.sigma_m:.3f} m",
        *fit.notes,
    )
    return WaterProposal(
        surface=fit.surface,
        sigma_level_m=fit.sigma_level_m,
        centre_xy=fit.centre_xy,
        level_m=fit.level_m,
        tilt=fit.tilt,
        sigma_tilt=fit.sigma_tilt_percent / 100.0,
        confidence=float(fit.accepted.mean()),
        evidence=figures,
        reasons=reasons,
        shoreline=accepted,
        curves=EvidenceCurves((edges[1:] + edges[:-1]) / 2.0, {"classified points": counts + 0.0}),
        ground=samples.xyz + samples.origin,
    )

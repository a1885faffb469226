"""Find the water surface in the cloud itself."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import GeometryError
from pcfix.model import FloatArray, WaterPlane
from pcfix.water import search
from pcfix.water.cues import SLOPE, Samples, gain_of, layer_gain, sample_cloud
from pcfix.water.search import INSTEAD, LAYER, Peak, Scan, Tilted, find_tilt, judge

LEAST_POINTS = 2_000
LEAST_RELIEF_M = 0.3
LEAST_SIGMA_M = 0.015
"""Least standard error of a waterline, from waves and the thickness of the cloud."""
TILT_SIGMAS, TILT_GAIN = 3.0, 6.0
MOST_SHORELINE = 2_000


def find_water(
    xyz: FloatArray, rgb: npt.NDArray[Any] | None = None, returns: npt.NDArray[Any] | None = None
) -> WaterProposal:
    """Find the water surface of a cloud.

    It is the height below which the ground gets flatter, as refraction lifts the bed, or colour
    fades with depth, or at which points float in a thin layer. Square tiles are summed separately,
    and resampling them gives the standard error.

    Parameters
    ----------
    xyz : array, shape (n, 3)
        Apparent points without noise, metres, world frame.
    rgb : array, shape (n, 3), optional
        In any unit from zero up. Equal colours count as none.
    returns : array, shape (n,), optional
        Number of returns. If pulses have several, only points of these may float.
    """
    known = np.isfinite(xyz).all(axis=1)
    if known.sum() < LEAST_POINTS:
        raise GeometryError(
            "cloud.too_few_points",
            f"{known.sum()} points are too few to find the water, {LEAST_POINTS} are needed."
            f" {INSTEAD}",
            points=int(known.sum()), least=LEAST_POINTS,
        )  # fmt: skip
    columns = (None if column is None else column[known] for column in (rgb, returns))
    return _from_cues(_scanned(sample_cloud(xyz[known], *columns)))


DIFFERENT_M, DIFFERENT_SIGMAS = 0.5, 3.0
"""A level is only reported as another one if it differs by more than both."""
LEAST_AGAINST, SURE_AGAINST = 100.0, 0.8
"""Evidence of colours only, or confidence of slope and colours together, that contradicts a given
level. They are higher than for `find_water`, to avoid false alarms."""


def find_elsewhere(
    xyz: FloatArray, water_m: FloatArray, rgb: npt.NDArray[Any] | None
) -> tuple[WaterProposal | None, Tilted | None]:
    """Return water that a cloud shows elsewhere than the given water surface.

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
        With heights above the given surface; None if the cloud shows it there, or nothing. The full
        search of `find_water` runs only if another height gains most.
    tilted : Tilted or None
    """
    samples = sample_cloud(np.column_stack([xyz[:, :2], xyz[:, 2] - water_m]), rgb, None)
    try:
        coarse = _scanned(samples)
    except GeometryError:  # flat ground shows nothing
        return None, None
    tilted, gain = find_tilt(coarse), search.gains(coarse, search.NO_TILT)
    here = gain[np.abs(coarse.heights_m + samples.origin[2]) <= DIFFERENT_M].max(initial=0.0)
    if gain.max() < search.LEAST_AGREED or here > search.MOST_RIVAL_AGREED * gain.max():
        return None, tilted
    try:
        found = _from_cues(coarse)
    except GeometryError:
        return None, tilted
    differs = abs(found.level_m) > max(DIFFERENT_M, DIFFERENT_SIGMAS * found.sigma_level_m)
    sure = found.evidence["total gain"] >= LEAST_AGAINST or (
        found.confidence >= SURE_AGAINST and f"{SLOPE.name} amplitude" in found.evidence
    )
    return found if differs and sure else None, tilted


def _scanned(samples: Samples) -> Scan:
    """Return the sums of the cues at all heights; GeometryError ``cloud.flat`` without relief."""
    low, high = np.percentile(samples.smooth_m, [0.5, 99.5])
    if high - low < LEAST_RELIEF_M:
        raise GeometryError(
            "cloud.flat",
            f"The ground has {high - low:.2f} m of relief, {LEAST_RELIEF_M:g} m are needed to find"
            f" the water. {INSTEAD}",
            relief_m=float(high - low), least=LEAST_RELIEF_M,
        )  # fmt: skip
    count = int(np.clip((high - low) / search.COARSE_M, 8, search.MOST_HEIGHTS))
    return search.scan_at(samples, np.linspace(low, high, count), search.NO_TILT)


def _from_cues(coarse: Scan) -> WaterProposal:
    samples = coarse.samples
    peak, near, sigma_m, sigma_tilt = _choose(samples, coarse)
    confidence, evidence, reasons = judge(peak, near, coarse, sigma_m)
    shore = samples.xyz[search.near_surface(samples, peak)]
    if len(shore) == 0:
        text = f"No water surface was found: no ground crosses the best candidate. {INSTEAD}"
        raise GeometryError("water.not_found", text, reason="no_shoreline")
    shore = shore[:: math.ceil(len(shore) / MOST_SHORELINE)]
    centre = shore[:, :2].mean(axis=0)
    level = peak.level_m + float(centre @ peak.tilt) + float(samples.origin[2])
    x, y = centre + samples.origin[:2]
    gain = {sums.cue.name: gain_of(sums.shifted(peak.tilt)).gain for sums in coarse.cues}
    gain[LAYER] = layer_gain(samples, coarse.heights_m, peak.tilt)
    b, c = peak.tilt.tolist()
    return WaterProposal(
        surface=WaterPlane(level - (b * float(x) + c * float(y)), b, c),
        sigma_level_m=sigma_m,
        centre_xy=np.array([x, y]),
        level_m=level,
        tilt=peak.tilt,
        sigma_tilt=sigma_tilt,
        confidence=confidence,
        evidence=evidence,
        reasons=reasons,
        shoreline=shore + samples.origin,
        curve_height_m=coarse.heights_m + float(samples.origin[2] + centre @ peak.tilt),
        curves=gain,
        ground=samples.xyz + samples.origin,
    )


def _choose(samples: Samples, coarse: Scan) -> tuple[Peak, Scan, float, float]:
    """Return the level, or the plane if its tilt is significant and gains enough.

    Then follow the sums near it, and the standard errors of its level, and of its tilt along the
    shore, NaN for a level.
    """
    start = search.best(coarse, search.NO_TILT[None])
    level, near = search.refine(samples, start, None)
    axis, step = search.axis_of(samples, level), search.tilt_step(samples)
    steps = math.ceil(search.LARGEST_TILT / step)
    tilted = search.best(coarse, search.tilts_along(axis, step, steps))
    if tilted.score > start.score:
        plane, near_plane = search.refine(samples, tilted, axis)
        along = abs(float(plane.tilt @ axis))
        if plane.score > level.score + TILT_GAIN and along <= search.LARGEST_TILT:
            levels, tilts = search.drawn(near_plane, axis, step)
            # the median absolute deviation, and the rounding to steps of tilt
            sigma_tilt = math.hypot(1.4826 * float(np.median(np.abs(tilts))), step / 6.0)
            if along > TILT_SIGMAS * sigma_tilt:
                return plane, near_plane, _sigma(levels), sigma_tilt
    return level, near, _sigma(search.drawn(near, None, step)[0]), math.nan


def _sigma(levels_m: FloatArray) -> float:
    return math.hypot(float(np.sqrt(np.mean(levels_m**2))), LEAST_SIGMA_M)


@dataclass(frozen=True, eq=False)
class WaterProposal:
    """A water surface found in a cloud."""

    surface: WaterPlane
    sigma_level_m: float
    """Standard error of its height at `centre_xy`, by resampling tiles of the cloud. It does not
    include errors that all of the shore shares, such as a bank that stops at the water."""
    centre_xy: FloatArray  # (2,), centre of the shoreline, metres, world frame
    level_m: float  # height of the surface there
    tilt: FloatArray  # (2,), dz/dx and dz/dy
    sigma_tilt: float  # standard error of the tilt along the shore; NaN if it was not searched
    confidence: float  # 0 to 1, by how much the evidence exceeds what is refused
    evidence: dict[str, float]  # figures by name
    reasons: tuple[str, ...]  # the same in sentences
    shoreline: FloatArray  # (m, 3), where the ground crosses the surface, metres, world frame
    curve_height_m: FloatArray  # (h,), world heights; of a tilted surface, above `centre_xy`
    curves: dict[str, FloatArray]  # (h,), gain (log likelihood ratio) of each cue at each height
    ground: FloatArray  # (c, 3), the cloud thinned to cells, metres, world frame

    def sigma_at(self, xy: FloatArray) -> FloatArray:
        """Return the standard error (m) of the height at places (m, 2), the same for all."""
        return np.full(len(xy), self.sigma_level_m)

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

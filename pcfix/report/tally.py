"""Add up a run chunk by chunk, in bounded memory."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.model import Outcome
from pcfix.report.tvu import UncertaintyTally

if TYPE_CHECKING:
    from pcfix.model import BoolArray, Correction, FloatArray

_BIN_M = 0.001
_REACH_M = 100.0  # shifts beyond it share the last bin, which only percentiles would notice

REASONS = {
    Outcome.NO_CAMERA: "no camera has it in its frame, or in its list of views",
    Outcome.ONE_CAMERA: "one usable ray only",
    Outcome.PARALLEL_RAYS: "rays nearly parallel",
}


class Tally:
    """Counts, extremes, and histograms of shift and standard error in Z, over all chunks so far."""

    def __init__(self, cameras: int) -> None:
        self.points = 0
        self.water_unknown = 0
        self.rays = 0
        self.outcomes = np.zeros(len(Outcome), dtype=np.int64)
        self.camera_used: BoolArray = np.zeros(cameras, dtype=np.bool_)
        self.depth_low_m, self.depth_high_m, self._depth_sum_m = np.inf, -np.inf, 0.0
        self._shift_sum_m = 0.0
        self._shift_bins = np.zeros(2 * round(_REACH_M / _BIN_M) + 1, dtype=np.int64)
        self.low: FloatArray = np.full(3, np.inf)
        self.high: FloatArray = np.full(3, -np.inf)
        self.lowest_water_m = np.inf
        self._uncertainty = UncertaintyTally()

    def add(self, apparent: FloatArray, correction: Correction) -> None:
        """Add one chunk: the apparent points, shape (n, 3), and their correction."""
        self.points += len(apparent)
        self.water_unknown += int((~correction.water_known).sum())
        self.rays += int(correction.ray_count.sum())
        self.outcomes += np.bincount(correction.outcome, minlength=len(Outcome))
        self.camera_used |= correction.camera_used
        submerged = apparent[correction.submerged]
        if len(submerged):
            # axis by axis: numpy is slow along the short one
            self.low = np.minimum(self.low, [values.min() for values in submerged.T])
            self.high = np.maximum(self.high, [values.max() for values in submerged.T])
        self.lowest_water_m = min(self.lowest_water_m, correction.lowest_water_m)
        moved = correction.corrected
        if moved.any():
            depth, shift = correction.depth_m[moved], correction.shift_m[moved, 2]
            self.depth_low_m = min(self.depth_low_m, float(depth.min()))
            self.depth_high_m = max(self.depth_high_m, float(depth.max()))
            self._depth_sum_m += float(depth.sum())
            self._shift_sum_m += float(shift.sum())
            bins = np.rint((np.clip(shift, -_REACH_M, _REACH_M) + _REACH_M) / _BIN_M)
            self._shift_bins += np.bincount(bins.astype(int), minlength=len(self._shift_bins))
            self._uncertainty.add(correction.sigma_z_m[moved], depth)

    @property
    def submerged(self) -> int:
        """Points below the surface so far."""
        neither = self.outcomes[Outcome.LAND] + self.outcomes[Outcome.NOT_CARRIED]
        return int(self.outcomes.sum() - neither)

    @property
    def corrected(self) -> int:
        """Points moved so far."""
        return int(self.outcomes[Outcome.CORRECTED])

    def uncorrected(self) -> dict[str, int]:
        """Return how many submerged points were not moved, by reason."""
        return {text: int(self.outcomes[reason]) for reason, text in REASONS.items()}

    def depth_m(self) -> dict[str, float]:
        """Return the range and mean of the corrected depth."""
        if not self.corrected:
            return {}
        mean = self._depth_sum_m / self.corrected
        return _rounded(min=self.depth_low_m, mean=mean, max=self.depth_high_m)

    def shift_z_m(self) -> dict[str, float]:
        """Return mean and 5 and 95 % points of the shift in Z; percentiles to a millimetre."""
        if not self.corrected:
            return {}
        cumulative = np.cumsum(self._shift_bins)
        p5, p95 = (
            np.searchsorted(cumulative, share * self.corrected) * _BIN_M - _REACH_M
            for share in (0.05, 0.95)
        )
        return _rounded(mean=self._shift_sum_m / self.corrected, p5=p5, p95=p95)

    def uncertainty(self) -> dict[str, Any] | None:
        """Return standard error of Z, TVU and orders; see `UncertaintyTally.as_dict`."""
        return self._uncertainty.as_dict()


def _rounded(**values: float) -> dict[str, float]:
    return {name: round(float(value), 4) for name, value in values.items()}

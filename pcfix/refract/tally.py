"""Add up the results of a correction chunk by chunk, and compare uncertainties with IHO S-44.

Vertical uncertainty is the TVU at 95 % of hydrographic surveys, IHO S-44, edition 6.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from pcfix.model import BoolArray, Correction, FloatArray, IntArray, Outcome
from pcfix.sums import LEAST, MOST, SAME, Sums

COVERAGE_95 = 1.96  # standard errors of a Gaussian that hold 95 %, in one dimension as in S-44
REASONS = {
    Outcome.NO_CAMERA: "outside the frames of all cameras, or without a camera in the view list",
    Outcome.ONE_CAMERA: "only one usable ray",
    Outcome.FLAT_RAYS: "fewer than two rays within the maximum incidence angle (--max-angle)",
    Outcome.PARALLEL_RAYS: "rays are nearly parallel",
}
_BIN_M = 0.001


class Order(NamedTuple):
    """An order of survey and the two parameters of its largest TVU."""

    name: str
    a_m: float
    b: float


# IHO S-44, edition 6, table 1, strictest first; 1a and 1b differ in what must be found, not here.
ORDERS = (
    Order("Exclusive", 0.15, 0.0075),
    Order("Special", 0.25, 0.0075),
    Order("1a/1b", 0.5, 0.013),
    Order("2", 1.0, 0.023),
)


def largest_tvu_m(order: Order, depth_m: FloatArray) -> FloatArray:
    """Return the largest total vertical uncertainty (95 %) that an order allows at depths d.

    IHO S-44, edition 6, section 3.2: sqrt(a^2 + (b d)^2).
    """
    return np.asarray(np.sqrt(order.a_m**2 + (order.b * depth_m) ** 2))


def within_orders(tvu_m: FloatArray, depth_m: FloatArray) -> IntArray:
    """Return how many vertical uncertainties at 95 % each of the `ORDERS` allows at their depth."""
    return np.array([(tvu_m <= largest_tvu_m(order, depth_m)).sum() for order in ORDERS], np.int64)


def share_of_orders(within: IntArray, count: int) -> dict[str, float]:
    """Return these as a share, 0 to 1, by the name of the order."""
    return {o.name: round(int(n) / count, 6) for o, n in zip(ORDERS, within, strict=True)}


@dataclass(frozen=True)
class _Figures(Sums):
    """Mean, extremes, and percentiles to a millimetre, of values.

    Values beyond the limits share the last bins, which only percentiles would notice.
    """

    low_m: float = field(metadata=SAME)
    bins: IntArray
    count: int
    sum_m: float
    least_m: float = field(metadata=LEAST)
    most_m: float = field(metadata=MOST)

    @classmethod
    def of(cls, values_m: FloatArray, low_m: float = 0.0, high_m: float = 0.0) -> "_Figures":
        """Return the figures of some values; between equal limits there are no percentiles."""
        places = np.rint((np.clip(values_m, low_m, high_m) - low_m) / _BIN_M).astype(np.int64)
        bins = np.bincount(places, minlength=round((high_m - low_m) / _BIN_M) + 1)
        least, most = values_m.min(initial=np.inf), values_m.max(initial=-np.inf)
        return cls(low_m, bins, len(values_m), float(values_m.sum()), float(least), float(most))

    def by_name(self, *names: str, times: float = 1.0) -> dict[str, float]:
        """Return figures by name, min, mean, max, or such as p95; empty without values."""
        if not self.count:
            return {}
        found = {"min": self.least_m, "mean": self.sum_m / self.count, "max": self.most_m}
        for name in {*names} - {*found}:
            rank = float(name[1:]) / 100.0 * self.count
            found[name] = np.searchsorted(np.cumsum(self.bins), rank) * _BIN_M + self.low_m
        return {name: round(float(times * found[name]), 4) for name in names}


@dataclass(frozen=True)
class Tally(Sums):
    """Counts, extremes, and histograms of the shift and the standard error of Z."""

    outcomes: IntArray
    camera_used: BoolArray = field(metadata=MOST)
    low: FloatArray = field(metadata=LEAST)  # lowest corner of the submerged points, shape (3,)
    high: FloatArray = field(metadata=MOST)
    shift: _Figures
    depth: _Figures
    sigma: _Figures
    within: IntArray  # corrected points within the TVU of each order
    points: int = 0
    water_unknown: int = 0
    rays: int = 0
    lowest_water_m: float = field(default=np.inf, metadata=LEAST)
    incidence_deg: float = field(default=0.0, metadata=MOST)

    @classmethod
    def of(cls, correction: Correction) -> "Tally":
        """Return the tally of a chunk."""
        apparent, moved = correction.apparent_xyz, correction.corrected
        # axis by axis: numpy is slow along the short one
        submerged, depth = apparent[correction.submerged].T, correction.depth_m[moved]
        sigma = correction.sigma_z_m[moved]
        return cls(
            outcomes=np.bincount(correction.outcome, minlength=len(Outcome)),
            camera_used=correction.camera_used,
            low=np.array([values.min(initial=np.inf) for values in submerged]),
            high=np.array([values.max(initial=-np.inf) for values in submerged]),
            shift=_Figures.of(correction.shift_m[moved, 2], -100.0, 100.0),
            depth=_Figures.of(depth),
            sigma=_Figures.of(sigma, 0.0, 10.0),
            within=within_orders(COVERAGE_95 * sigma, depth),
            points=len(apparent),
            water_unknown=int((~correction.water_known).sum()),
            rays=int(correction.ray_count.sum()),
            lowest_water_m=correction.lowest_water_m,
            incidence_deg=float(correction.incidence_deg.max(initial=0.0, where=moved)),
        )

    @property
    def submerged(self) -> int:
        """Number of points below the water surface."""
        neither = self.outcomes[Outcome.LAND] + self.outcomes[Outcome.NOT_TRANSFERRED]
        return int(self.outcomes.sum() - neither)

    @property
    def corrected(self) -> int:
        """Number of corrected points."""
        return int(self.outcomes[Outcome.CORRECTED])

    def uncorrected(self) -> dict[str, int]:
        """Return the number of submerged points that were not corrected, by reason."""
        return {text: int(self.outcomes[reason]) for reason, text in REASONS.items()}

    def as_dict(self) -> dict[str, Any]:
        """Return the counts and figures by the names of `pcfix.report.text.Summary`."""
        return {
            "points": self.points,
            "submerged": self.submerged,
            "corrected": self.corrected,
            "uncorrected": self.uncorrected(),
            "water_unknown": self.water_unknown,
            "depth_m": self.depth.by_name("min", "mean", "max"),
            "shift_z_m": self.shift.by_name("mean", "p5", "p95"),
            "rays": self.rays,
            "incidence_deg": round(self.incidence_deg, 2),
        }

    def uncertainty(self, detected: dict[str, Any] | None = None) -> dict[str, Any] | None:
        """Return standard errors of Z, TVU and orders; None where no point has a standard error.

        `sigma_z_m` holds mean, percentiles (to a millimetre) and largest; `tvu_95_m` is 1.96 times
        these; `s44` the share of the points, 0 to 1, within the TVU of each order. `of_cloud` is
        the contribution of the cloud, if `detected`, the detected reconstruction type, has an
        estimate of it.
        """
        if not self.sigma.most_m > 0.0:
            return None
        names = "mean", "p5", "p50", "p95", "max"
        found: dict[str, Any] = {
            "sigma_z_m": self.sigma.by_name(*names),
            "tvu_95_m": self.sigma.by_name(*names, times=COVERAGE_95),
            "s44": share_of_orders(self.within, self.sigma.count),
        }
        if detected is not None and "scatter_m" in detected:
            found["of_cloud"] = {name: detected[name] for name in ("scatter_m", "per_depth")}
        return found

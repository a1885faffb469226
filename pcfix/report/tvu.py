"""Vertical uncertainty in the terms of hydrographic surveys: TVU at 95 %, orders of IHO S-44."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.options import LEVEL_M

if TYPE_CHECKING:
    from pcfix.model import FloatArray

COVERAGE_95 = 1.96
"""Standard errors of a Gaussian quantity within which 95 % lie, as S-44 takes it in one dimension.
"""


class Order(NamedTuple):
    """An order of survey and the two parameters of its largest TVU."""

    name: str
    a_m: float
    b: float


ORDERS = (
    Order("Exclusive", 0.15, 0.0075),
    Order("Special", 0.25, 0.0075),
    Order("1a/1b", 0.5, 0.013),
    Order("2", 1.0, 0.023),
)
"""IHO S-44, edition 6, table 1, strictest first; 1a and 1b differ in what must be found, not here.
"""


def largest_tvu_m(order: Order, depth_m: FloatArray) -> FloatArray:
    """Return the largest total vertical uncertainty at 95 % that an order allows.

    IHO S-44, edition 6, section 3.2: sqrt(a^2 + (b d)^2).

    Parameters
    ----------
    order : Order
    depth_m : array
        Depths d, positive down.
    """
    return np.asarray(np.hypot(order.a_m, order.b * depth_m))


_BIN_M = 0.001
_REACH_M = 10.0  # standard errors beyond it share the last bin, which only percentiles would notice
PERCENTILES = (5, 50, 95)


class UncertaintyTally:
    """Adds up standard errors of Z chunk by chunk, in bounded memory."""

    def __init__(self) -> None:
        self.points = 0
        self._sum_m = 0.0
        self._most_m = 0.0
        self._bins = np.zeros(round(_REACH_M / _BIN_M) + 1, dtype=np.int64)
        self._within = np.zeros(len(ORDERS), dtype=np.int64)

    def add(self, sigma_z_m: FloatArray, depth_m: FloatArray) -> None:
        """Add corrected points: standard errors of Z and depths, metres, shape (m,)."""
        if not len(sigma_z_m):
            return
        self.points += len(sigma_z_m)
        self._sum_m += float(sigma_z_m.sum())
        self._most_m = max(self._most_m, float(sigma_z_m.max()))
        bins = np.rint(np.minimum(sigma_z_m, _REACH_M) / _BIN_M).astype(np.int64)
        self._bins += np.bincount(bins, minlength=len(self._bins))
        tvu_m = COVERAGE_95 * sigma_z_m
        for i, order in enumerate(ORDERS):
            self._within[i] += int((tvu_m <= largest_tvu_m(order, depth_m)).sum())

    def as_dict(self) -> dict[str, Any] | None:
        """Return the figures as plain values; None where no point has a standard error.

        `sigma_z_m` holds mean, percentiles (to a millimetre) and largest; `tvu_95_m` is 1.96 times
        these; `s44` the share of the points, 0 to 1, within the TVU of each order.
        """
        if self._most_m == 0.0:
            return None
        cumulative = np.cumsum(self._bins)
        sigma = {"mean": self._sum_m / self.points}
        for percent in PERCENTILES:
            place = int(np.searchsorted(cumulative, percent / 100.0 * self.points))
            sigma[f"p{percent}"] = place * _BIN_M
        sigma["max"] = self._most_m
        return {
            "sigma_z_m": {name: round(value, 4) for name, value in sigma.items()},
            "tvu_95_m": {name: round(COVERAGE_95 * value, 4) for name, value in sigma.items()},
            "s44": {
                order.name: round(int(within) / self.points, 6)
                for order, within in zip(ORDERS, self._within, strict=True)
            },
        }


def strictest_order(uncertainty: dict[str, Any]) -> str | None:
    """Return the strictest order whose TVU 95 % of the points keep, if any."""
    for order in ORDERS:
        if uncertainty["s44"][order.name] >= 0.95:
            return order.name
    return None


def budget_words(errors: dict[str, Any], level_from_fit: float | None = None) -> str:
    """Return the standard deviations that were assumed, as ``image 0.5 px, level 0.020 m``.

    Parameters
    ----------
    errors : dict
        `pcfix.options.ErrorBudget` as plain values.
    level_from_fit : float, optional
        Standard error of the level that a fit gave, where the user stated none.
    """
    level = errors["level_m"]
    source = ""
    if level is None:
        level, source = LEVEL_M, " (assumed)"
        if level_from_fit is not None and np.isfinite(level_from_fit):
            level, source = level_from_fit, " (fitted)"
    words = [f"image {errors['image_px']:g} px", f"level {level:.3f} m{source}"]
    words.append(f"index {errors['index']:g}")
    more = (
        ("tilt", "tilt_deg", "deg"),
        ("waves", "waves_deg", "deg"),
        ("camera positions", "centre_m", "m"),
        ("attitude", "attitude_deg", "deg"),
    )
    words += [f"{name} {errors[key]:g} {unit}" for name, key, unit in more if errors[key] > 0.0]
    return ", ".join(words)


def tvu_sentence(uncertainty: dict[str, Any]) -> str:
    """Return which order of S-44 the standard errors would allow, in words."""
    order = strictest_order(uncertainty)
    if order is None:
        within = uncertainty["s44"][ORDERS[-1].name]
        return f"fewer than 95 % of the points keep any order of IHO S-44 ({within:.0%} order 2)"
    within = uncertainty["s44"][order]
    number = "order" if order[0].isdigit() else ""
    name = f"{number} {order}".strip() + ("" if number else " Order")
    return f"{100.0 * within:.4g} % of the points are within the TVU of IHO S-44 {name}"

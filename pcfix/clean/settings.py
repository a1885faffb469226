"""What the user may choose of the cleaning, why a point is noise, and the numbers of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from enum import IntFlag
from typing import Any

from pcfix.errors import SettingError

LEAST_NEIGHBOURS, MOST_NEIGHBOURS = 6, 500


class Reason(IntFlag):
    """Why a point is noise; one point may have several reasons, one bit each."""

    STATISTICAL = 1
    RADIUS = 2
    FEW_RAYS = 4
    RAY_MISS = 8
    INCIDENCE = 16
    BELOW_BED = 32
    FLOATING = 64


@dataclass(frozen=True, slots=True)
class CleanSettings:
    """Thresholds of the tests; None leaves a test out.

    Attributes
    ----------
    neighbours : int
        Of the statistical test: the nearest points in space, the point itself among them.
    deviations : float or None
        A point is a statistical outlier if the mean distance to its neighbours exceeds the
        mean of all points by more than so many standard deviations of all points. In a cloud
        of even spacing these are its edges and corners.
    radius_m : float or None
        A point is a radius outlier if fewer than `radius_neighbours` others lie nearer than
        this. It depends on the spacing of the points, so that it has no default.
    radius_neighbours : int
        See `radius_m`.
    min_rays : int or None
        A corrected point from fewer rays is weak.
    max_ray_miss_m : float or None
        A corrected point whose rays pass it at a larger root mean square distance is weak.
    max_incidence_deg : float or None
        A corrected point with a ray of a larger incidence angle in air is weak.
    bed_neighbours : int
        Of the two tests against the bed: the submerged points nearest in plan, the point
        itself among them, and all that are as far as the last of them.
    fences : float
        In interquartile ranges of the neighbours' heights, the width of the band about the
        middle half of them in which a point belongs to the bed.
    below_m : float or None
        A submerged point is below the bed if it is lower than the lower quartile of its
        neighbours by more than `fences` interquartile ranges and by more than this.
    floating_m : float or None
        A submerged point floats in the water if it is higher than the upper quartile of its
        neighbours by more than `fences` interquartile ranges and by more than this.

    Notes
    -----
    The fences are those of Tukey (Exploratory Data Analysis, 1977): three ranges are 4.7
    standard deviations of a normal distribution. Up to a quarter of the neighbours may be noise
    on one side. On a slope, at a wall or on a rock that holds a quarter of the neighbours the
    range is as large as the terrain is high, so that nothing is taken for noise there.
    """

    neighbours: int = 20
    deviations: float | None = 4.0
    radius_m: float | None = None
    radius_neighbours: int = 3
    min_rays: int | None = 3
    max_ray_miss_m: float | None = 0.5
    max_incidence_deg: float | None = 75.0
    bed_neighbours: int = 32
    fences: float = 3.0
    below_m: float | None = 0.3
    floating_m: float | None = 0.5

    def __post_init__(self) -> None:
        """Check every value against its rule."""
        for name, low, high, remedy in _RULES:
            _check(name, getattr(self, name), low, high, remedy)
        if not any(
            (self.statistical, self.radius_m is not None, self.weak, self.below_or_floating)
        ):
            raise SettingError("No test is left to run: leave at least one of them on.")

    @property
    def statistical(self) -> bool:
        """Whether the statistical test runs."""
        return self.deviations is not None

    @property
    def weak(self) -> bool:
        """Whether any test of the intersections runs."""
        limits = (self.min_rays, self.max_ray_miss_m, self.max_incidence_deg)
        return any(limit is not None for limit in limits)

    @property
    def below_or_floating(self) -> bool:
        """Whether any test against the bed runs."""
        return self.below_m is not None or self.floating_m is not None

    @property
    def nearest(self) -> int:
        """How many neighbours in space are needed, the point itself among them; 0 for none."""
        statistical = self.neighbours if self.statistical else 0
        return max(statistical, 0 if self.radius_m is None else self.radius_neighbours + 1)


_RULES: tuple[tuple[str, float, float, str], ...] = (
    ("neighbours", LEAST_NEIGHBOURS, MOST_NEIGHBOURS, "20 is usual"),
    ("deviations", 0.0, math.inf, "4 finds gross outliers, 2 also the edges of sparse parts"),
    ("radius_m", 0.0, math.inf, "ten times the spacing of the points is usual"),
    ("radius_neighbours", 1, MOST_NEIGHBOURS, "3 is usual"),
    ("min_rays", 2, math.inf, "an intersection needs two rays, and a third to check it"),
    ("max_ray_miss_m", 0.0, math.inf, "a few times the ground sampling distance or more"),
    ("max_incidence_deg", 0.0, 90.0, "degrees from the normal of the water surface"),
    ("bed_neighbours", LEAST_NEIGHBOURS, MOST_NEIGHBOURS, "32 is usual"),
    ("fences", 0.0, math.inf, "3 is usual"),
    ("below_m", 0.0, math.inf, "metres, more than the noise of the bed"),
    ("floating_m", 0.0, math.inf, "metres, more than the height of plants and stones"),
)


def _check(name: str, value: float | None, low: float, high: float, remedy: str) -> None:
    """Refuse a value outside low to high; a low of zero is itself not allowed."""
    kind = {field.name: str(field.type) for field in fields(CleanSettings)}[name]
    if value is None and "None" in kind:
        return
    number = math.nan if isinstance(value, str) or value is None else float(value)
    whole = not kind.startswith("int") or number == math.floor(number)
    above = number > low if low == 0.0 else number >= low
    if not (math.isfinite(number) and whole and above and number <= high):
        least = "above 0" if low == 0.0 else f"at least {low:g}"
        most = f" and at most {high:g}" if math.isfinite(high) else ""
        rule = f"{'a whole number ' if kind.startswith('int') else ''}{least}{most}"
        option = name.removesuffix("_m").removesuffix("_deg").replace("_", "-")
        raise SettingError(f"{option} {value} must be {rule}: {remedy}.")


@dataclass(frozen=True)
class CleanSummary:
    """What a cleaning did, in numbers; `as_dict` is what ``--summary`` writes.

    Attributes
    ----------
    input, output, pcfix : str
        The files and the version.
    points : int
        Points read.
    set_aside : int
        Points that came withheld or as noise (class 7 or 18): neither tested nor a neighbour.
    submerged : int
        Points that were tested against the bed.
    noise : int
        Points flagged.
    reasons : dict
        Points for each `Reason`; a point may count under several.
    dropped : int
        Points left out of the output.
    neighbour_distance_m : dict
        Of the statistical test: mean, sd and limit of the mean distances to the neighbours.
    not_run : list of str
        Tests that were asked for and could not be run, and why.
    water : str or None
    settings : dict
    seconds : float
    """

    input: str
    output: str
    pcfix: str
    points: int
    set_aside: int
    submerged: int
    noise: int
    reasons: dict[str, int]
    dropped: int
    neighbour_distance_m: dict[str, float]
    not_run: list[str]
    water: str | None
    settings: dict[str, Any]
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return dict(vars(self))

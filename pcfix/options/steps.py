"""The options of what follows a correction: clean, dsm and compare."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, get_args

from pcfix.errors import SettingError
from pcfix.options.declare import (
    File,
    OptionSet,
    Rule,
    at_least,
    must_be,
    not_negative,
    option,
    positive,
    rule,
)
from pcfix.options.shared import OverwriteOption, Panel, PartOptions, SummaryOption, TileOptions

LEAST_NEIGHBOURS, MOST_NEIGHBOURS = 6, 500
MAX_HOLE_CELLS = 1000
MIN_RESOLUTION_M = 1e-4
LEAST_PLANE_POINTS, PLANE_POINTS = 6, 8
"""Reference points of each plane of a comparison, unless told otherwise."""

DsmMethod = Literal["mean", "median", "min", "max", "idw", "tin"]
SurfaceChoice = Literal["all", "bed"]
Direction = Literal["to-reference", "from-reference", "both"]

METRES = positive("{option} {value:g} is not positive; give metres.")


@dataclass(frozen=True, kw_only=True)
class CleanRules(OptionSet):
    """Thresholds of the tests; None leaves a test out.

    The fences are those of Tukey (Exploratory Data Analysis, 1977): three ranges are 4.7 standard
    deviations of a normal distribution. Up to a quarter of the neighbours may be noise on one
    side. On a slope, at a wall or on a rock that holds a quarter of the neighbours the range is
    as large as the terrain is high, so that nothing is taken for noise there. The mean distance
    to the neighbours finds, in a cloud of even spacing, also its edges and corners.
    """

    panel = Panel.TESTS
    old_units = True

    statistical: bool = option(True, "Test the mean distance to the nearest points in space.")
    neighbours: int = option(
        20,
        "Nearest points of the statistical test, the point itself among them.",
        rule=must_be(LEAST_NEIGHBOURS, MOST_NEIGHBOURS, "20 is usual", whole=True),
    )
    deviations: float | None = option(
        4.0,
        "Noise if the mean distance to the neighbours exceeds that of all points by so many"
        " standard deviations.",
        rule=must_be(0.0, math.inf, "4 finds gross outliers, 2 also the edges of sparse parts"),
    )
    radius: float | None = option(
        None,
        "Noise if fewer than --radius-neighbours others are nearer.",
        unit="m",
        rule=must_be(0.0, math.inf, "ten times the spacing of the points is usual"),
        default_is="no such test",
    )
    radius_neighbours: int = option(
        3, "See --radius.", rule=must_be(1, MOST_NEIGHBOURS, "3 is usual", whole=True)
    )
    weak: bool = option(True, "Test rays, ray miss and incidence of corrected points.")
    min_rays: int | None = option(
        3,
        "Noise if corrected from fewer rays.",
        rule=must_be(
            2, math.inf, "an intersection needs two rays, and a third to check it", whole=True
        ),
    )
    max_ray_miss: float | None = option(
        0.5,
        "Noise if the rays miss by more (RayMiss).",
        unit="m",
        rule=must_be(0.0, math.inf, "a few times the ground sampling distance or more"),
    )
    max_incidence: float | None = option(
        75.0,
        "Noise if a ray had a larger incidence angle.",
        unit="deg",
        rule=must_be(0.0, 90.0, "degrees from the normal of the water surface"),
    )
    bed_neighbours: int = option(
        32,
        "Nearest submerged points in plan that show where the bed is.",
        rule=must_be(LEAST_NEIGHBOURS, MOST_NEIGHBOURS, "32 is usual", whole=True),
    )
    fences: float = option(
        3.0,
        "Noise if beyond the middle half of their heights by so many times its range, and by more"
        " than --below or --floating.",
        rule=must_be(0.0, math.inf, "3 is usual"),
    )
    below: float | None = option(
        0.3,
        "Least height under the bed of noise.",
        unit="m",
        rule=must_be(0.0, math.inf, "metres, more than the noise of the bed"),
    )
    floating: float | None = option(
        0.5,
        "Least height over the bed of noise.",
        unit="m",
        rule=must_be(0.0, math.inf, "metres, more than the height of plants and stones"),
    )

    def check(self) -> None:
        """Leave out what is not asked for; something must be left."""
        super().check()
        if not self.statistical:
            object.__setattr__(self, "deviations", None)
        if not self.weak:
            for name in ("min_rays", "max_ray_miss", "max_incidence"):
                object.__setattr__(self, name, None)
        limits = (self.min_rays, self.max_ray_miss, self.max_incidence)
        object.__setattr__(self, "statistical", self.deviations is not None)
        object.__setattr__(self, "weak", any(limit is not None for limit in limits))
        if not (self.statistical or self.radius is not None or self.weak or self.below_or_floating):
            raise SettingError("No test is left to run: leave at least one of them on.")

    @property
    def below_or_floating(self) -> bool:
        """Whether any test against the bed runs."""
        return self.below is not None or self.floating is not None

    @property
    def nearest(self) -> int:
        """How many neighbours in space are needed, the point itself among them; 0 for none."""
        statistical = self.neighbours if self.statistical else 0
        return max(statistical, 0 if self.radius is None else self.radius_neighbours + 1)


@dataclass(frozen=True, kw_only=True)
class CleanOptions(TileOptions, SummaryOption, CleanRules):
    """The options of ``pcfix clean``."""

    panel = Panel.OUTPUT

    water: Any = option(
        None,
        "As of 'pcfix correct': what lies below it is tested against the bed.",
        default_is="the points that pcfix corrected",
        metavar="SPEC",
    )
    drop: bool = option(False, "Leave noise out; else class 7 and the withheld flag.")


_RESOLUTION = rule(
    lambda value: math.isfinite(value) and value >= MIN_RESOLUTION_M,
    "The resolution is {value:g} m; it must be a positive number of metres, at least"
    f" {MIN_RESOLUTION_M:g}.",
)


def _one_of(kind: Any) -> Rule:
    known = get_args(kind)
    sentence = f"The {{option}} is {{value!r}}; it must be one of {', '.join(known)}."
    return rule(lambda value: value in known, sentence)


@dataclass(frozen=True, kw_only=True)
class DsmRules(OptionSet):
    """How a cloud becomes a raster."""

    panel = Panel.RASTER
    old_units = True

    resolution: float | None = option(
        None, "Side of a cell.", unit="m", rule=_RESOLUTION, default_is="2 to 4 points a cell"
    )
    what: str = option(
        "height",
        "What a cell holds: height; depth of the bed below the water; uncertainty, the vertical"
        " one of the bed at 95 %; or the values of a dimension, by its name.",
        metavar="height|depth|uncertainty|DIMENSION",
    )
    method: DsmMethod = option("mean", "How a cell gets its value.", rule=_one_of(DsmMethod))
    surface: SurfaceChoice = option(
        "all",
        "Land and bed without noise, or only the bed (class 40).",
        rule=_one_of(SurfaceChoice),
    )
    fill: float | None = option(
        None,
        "Fill holes up to so many metres wide; they get count 0.",
        unit="m",
        rule=positive("The width of holes to fill is {value:g} m; it must be positive."),
    )
    azimuth: float = option(
        315.0,
        "Sun of the hillshade, clockwise from north.",
        unit="deg",
        rule=rule(math.isfinite, "The azimuth is {value:g}; it must be in degrees."),
    )
    altitude: float = option(
        45.0,
        "Sun of the hillshade, above the horizon.",
        unit="deg",
        rule=rule(
            lambda value: 0.0 < value <= 90.0,
            "The altitude of the sun is {value:g} degrees; it must be above 0 and at most 90.",
        ),
    )

    @property
    def cell_m(self) -> float:
        """The resolution, once there is one."""
        if self.resolution is None:
            raise SettingError("resolution is missing: give the side of a cell, metres.")
        return self.resolution

    def check(self) -> None:
        """Check what options say together."""
        super().check()
        if self.what == "uncertainty" and (self.method != "mean" or self.fill is not None):
            raise SettingError(
                "The uncertainty of a cell is the root mean square of its points'; leave --method"
                " and --fill out."
            )
        if self.what in ("depth", "uncertainty"):
            object.__setattr__(self, "surface", "bed")
        most = MAX_HOLE_CELLS * (self.resolution or math.inf)
        if self.fill is not None and self.fill > most:
            raise SettingError(
                f"Holes up to {self.fill:g} m are more than {MAX_HOLE_CELLS:,} cells of"
                f" {self.resolution:g} m wide; fill up to {most:g} m, or take a coarser resolution."
            )


@dataclass(frozen=True, kw_only=True)
class DsmOptions(PartOptions, OverwriteOption, SummaryOption, DsmRules):
    """The options of ``pcfix dsm``."""

    panel = Panel.OUTPUT

    hillshade: File | None = option(None, "Write a hillshade there (.tif).")
    counts: File | None = option(
        None, "Write the number of points and their spread in each cell there (.tif)."
    )
    style: bool = option(False, "Write a style for QGIS beside it (.qml).")
    cog: bool = option(False, "Write cloud optimised GeoTIFF.")


LAYERS = ("water", "apparent", "corrected", "reference")
"""Lines of a cross-section; a further cloud goes by another name."""
_NAME = re.compile(r"[\w .+-]*\w[\w .+-]*")


SIGMA_REFERENCE_M = {"cloud": 0.03, "raster": 0.03, "table of check points": 0.02}
"""Assumed noise of a height by kind of reference: LiDAR over hard ground, RTK or levelling."""


@dataclass(frozen=True, kw_only=True)
class DistanceOptions(OptionSet):
    """What a comparison, or that of a run, measures besides the vertical error.

    `share` and `also` are told by texts, and hold pairs: of bounds in metres, and of a name and a
    path; `also` may be a dict too.
    """

    panel = Panel.FIGURES

    m3c2: bool = option(False, "Compare by M3C2 too, with py4dgeo: the extra m3c2.")
    direction: Direction | None = option(
        None,
        "Of C2C: from each point of the cloud to the nearest of the reference, from each of the"
        " reference to the nearest of the cloud, or both.",
        default_is="to-reference; from each check point",
    )
    classes: int | None = option(
        None,
        "Of the C2C histograms.",
        rule=must_be(2, 100_000, "the square root of the number of points is usual", whole=True),
        default_is="square root of the number of distances",
    )
    share: tuple[Any, ...] = option(
        (),
        "Say which share of the C2C distances is from LOW up to HIGH metres; may be repeated.",
        metavar="LOW,HIGH",
    )
    also: tuple[Any, ...] = option(
        (),
        "A further cloud, in the C2C table and the cross-sections; may be repeated.",
        metavar="NAME=CLOUD",
    )
    sigma_reference: float | None = option(
        None,
        "Noise of a height of the reference, a standard deviation: it is taken out of what is said"
        " of the cloud's own errors.",
        unit="m",
        rule=not_negative("give a standard deviation in metres; 0 takes nothing out"),
        default_is=", ".join(f"{sigma:g} of a {kind}" for kind, sigma in SIGMA_REFERENCE_M.items()),
    )

    def check(self) -> None:
        """Take texts apart."""
        super().check()
        object.__setattr__(self, "share", tuple(map(_band, _several(self.share))))
        object.__setattr__(self, "also", tuple(_named_clouds(self.also)))

    @property
    def from_reference(self) -> bool:
        """Whether C2C is wanted from each point of the reference."""
        return self.direction in ("from-reference", "both")


def _several(value: Any) -> tuple[Any, ...]:
    """Return the one text that a stage of PDAL may give as one of several."""
    return (value,) if isinstance(value, str) else tuple(value)


def _band(given: Any) -> tuple[float, float]:
    """Return the bounds of a share."""
    low = high = math.nan
    with suppress(ValueError, TypeError):
        low, high = (float(v) for v in (given.split(",") if isinstance(given, str) else given))
    if not 0.0 <= low < high < math.inf:
        text = given if isinstance(given, str) else ",".join(map(str, given))
        raise SettingError(
            f"share '{text}' must be two distances LOW,HIGH in metres, not negative and the lower"
            " one first, as 0.6,1.0."
        )
    return low, high


def _named_clouds(given: Any) -> Iterator[tuple[str, str]]:
    """Yield name and path of each further cloud."""
    known = set(LAYERS)
    for one in given.items() if isinstance(given, Mapping) else _several(given):
        name, mark, path = one.partition("=") if isinstance(one, str) else (one[0], "=", one[1])
        text = f"{name}{mark}{path}"
        if not (_NAME.fullmatch(name) and os.fspath(path)):
            raise SettingError(
                f"also '{text}' must be NAME=CLOUD, a name of letters, digits, spaces and . + - _,"
                " and a LAS or LAZ file, as iteration1=iteration1.laz."
            )
        if name in known:
            taken = "a line of each cross-section" if name in LAYERS else "another cloud"
            raise SettingError(f"also '{text}': {name} is the name of {taken}; give another one.")
        known.add(name)
        yield name, os.fspath(path)


_BIN_WIDTH = positive("bin width {value:g} is not positive; give metres, such as 1.")


@dataclass(frozen=True, kw_only=True)
class CompareRules(DistanceOptions):
    """What is measured of two clouds."""

    panel = Panel.FIGURES
    old_units = True

    submerged: bool = option(False, "Only points of class 40, or below --water.")
    c2c_only: bool = option(False, "Distances to the nearest point, nothing signed.")
    neighbours: int = option(
        PLANE_POINTS,
        "Reference points of each fitted plane.",
        rule=at_least(
            LEAST_PLANE_POINTS, "a plane through so few points follows their noise; 8 is usual"
        ),
    )
    bin_width: float = option(1.0, "Of the table by depth.", unit="m", rule=_BIN_WIDTH)
    shore_bin_width: float = option(
        10.0, "Of the table by distance from shore.", unit="m", rule=_BIN_WIDTH
    )
    max_gap: float | None = option(
        None,
        "How far outside the reference a point counts.",
        unit="m",
        rule=METRES,
        default_is="5 point spacings, at least 1",
    )
    sections: int = option(
        0,
        "So many automatic cross-sections, down the slope.",
        rule=rule(lambda value: not value < 0, "{option} {value} is negative; give how many."),
    )
    corridor: float = option(1.0, "Half-width of a cross-section.", unit="m", rule=METRES)

    @property
    def vertical(self) -> bool:
        """Whether signed differences are wanted, and all that rests on them."""
        return not self.c2c_only


@dataclass(frozen=True, kw_only=True)
class ReferenceOption(OptionSet):
    """What a cloud is compared with."""

    panel = Panel.OUTPUT

    reference: File | None = option(
        None, "LiDAR cloud, CSV check points or GeoTIFF to compare with."
    )


@dataclass(frozen=True, kw_only=True)
class CompareOptions(OverwriteOption, SummaryOption, CompareRules):
    """The options of ``pcfix compare``."""

    panel = Panel.OUTPUT

    out_dir: File | None = option(None, "Folder for compare.json, depth tables and sections (CSV).")
    water: Any = option(
        None, "As of 'pcfix correct'.", default_is="what the cloud says", metavar="SPEC"
    )
    section: tuple[Any, ...] = option(
        (),
        "A cross-section x1,y1,x2,y2; may be repeated.",
        metavar="X,Y,X,Y",
        old=("section_lines",),
    )
    plot: File | None = option(None, "PNG of the C2C histograms, each with its Gauss curve.")


@dataclass(frozen=True, kw_only=True)
class StageCompareOptions(ReferenceOption, CompareOptions):
    """The options of the stage ``compare`` of PDAL, whose cloud is in no file."""

"""The options of a correction and of a labelling."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pcfix.errors import SettingError
from pcfix.options.declare import (
    File,
    OptionSet,
    at_least,
    not_negative,
    option,
    options_of,
    within,
)
from pcfix.options.shared import (
    IndexOptions,
    InputOptions,
    LandRules,
    NeededOptions,
    Panel,
    PartOptions,
    ShorelineOption,
    SubmergedOptions,
    SummaryOption,
    TileOptions,
    WaterOptions,
    WaterPerImageOption,
)

Uncorrected = Literal["withhold", "keep", "drop"]
Unsure = Literal["keep", "withhold"]
Dimensions = Literal["all", "minimal", "none"]
Method = Literal[
    "auto", "snell", "consistent", "shan", "butler", "murase", "dietrich", "factor", "regression"
]
CameraSet = Literal["auto", "mvs", "all"]
Occlusion = Literal["auto", "on", "off"]
MatcherKind = Literal["depth-maps", "pairs"]

WITHOUT_CAMERAS = ("factor", "regression")
"""Methods that look at the apparent depth alone."""
_ABOUT_CAMERAS = (
    "sensor", "angles", "cameras_crs", "cameras_offset", "views", "views_are", "adjusted_from",
    "tide", "image_times", "camera_set", "matcher", "max_angle", "max_cameras", "occlusion",
    "unsure",
)  # fmt: skip

LEVEL_M = 0.02
"""Standard deviation of a water level that nothing else is known of."""

_SIGMA = not_negative("give a standard deviation")


def _factor(name: str, text: str) -> float | str:
    try:
        return "auto" if text == "auto" else float(text)
    except ValueError:
        raise SettingError(f"{name} '{text}' is neither true by apparent depth nor auto.") from None


def _angle_limit(name: str, text: str) -> float | str | None:
    if text in ("auto", "none"):
        return text if text == "auto" else None
    try:
        return float(text)
    except ValueError:
        raise SettingError(f"{name} '{text}' is neither degrees nor none or auto.") from None


@dataclass(frozen=True, kw_only=True)
class MethodOptions(IndexOptions):
    """Which rays count, and how the true point follows from the apparent one."""

    panel = Panel.METHOD
    old_units = True

    method: Method = option(
        "auto",
        "How the true point follows from the apparent one; auto: consistent, as the cloud itself"
        " tells that it was made, or snell where the cameras have no lenses or angles.",
    )
    camera_set: CameraSet = option(
        "auto",
        "Without --views: every camera whose frame holds the point, or a model of dense matching;"
        " auto: the model with --method consistent, else all.",
    )
    matcher: MatcherKind = option(
        "depth-maps",
        "What that model makes a point of: fused depth maps (OpenMVS, COLMAP), or the median of"
        " stereo pairs (MicMac, SURE).",
    )
    max_angle: float | str | None = option(
        "auto",
        "Use rays up to this incidence angle in air, from the surface normal, or none: all; auto:"
        " with a method that weighs all rays alike, as the cloud tells which rays made it.",
        unit="deg",
        rule=within(0.0, 90.0, "give degrees from the surface normal", above=True),
        parse=_angle_limit,
        metavar="DEG",
        default_is="auto; 80 without angles",
    )
    max_cameras: int | None = option(
        None,
        "Use so many rays a point at most, the steepest.",
        rule=at_least(1, "give one ray or more"),
        default_is="no limit",
    )
    occlusion: Occlusion = option(
        "auto",
        "Leave out cameras to which the cloud itself hides the point; auto: where there are"
        " obliques.",
    )
    exact: bool = option(
        False,
        "Solve every point by itself; else --method consistent has that within 0.05 ground pixels,"
        " but where a choice of images is all but open, from polynomials where these are enough.",
    )
    depth_factor: float | str | None = option(
        None,
        "With --method factor: true by apparent depth; auto: as stereo pairs with the flying"
        " height, focal length and base of the cameras have it on average.",
        rule=within(1.0, 3.0, "give true by apparent depth"),
        parse=_factor,
        metavar="N",
        default_is="the refractive index",
    )
    least_r2: float = option(
        0.5, "With --method regression: a fit with a lower r2 is refused.", rule=within(0, 1, "")
    )
    index_from: str = ""
    """Which water the index is of, where it was not given as a number; not an option."""

    def check(self) -> None:
        """Check what options say together."""
        super().check()
        if self.depth_factor is not None and self.method != "factor":
            raise SettingError("depth-factor is of no use without --method factor; give both.")
        if self.max_cameras == 1 and self.method not in ("butler", "dietrich"):
            raise SettingError(
                "max-cameras 1 is less than 2: an intersection needs two rays; one is enough for"
                " --method butler and dietrich alone."
            )

    @property
    def needs_cameras(self) -> bool:
        """Whether the correction looks at cameras."""
        return self.method not in WITHOUT_CAMERAS or self.depth_factor == "auto"

    def check_no_cameras(self) -> None:
        """Refuse what cannot be done, or says nothing, where there are no cameras.

        Raises
        ------
        SettingError
            With the first option that is about cameras.
        """
        if self.depth_factor == "auto":
            raise SettingError(
                "cameras are missing: depth-factor auto goes by their height, focal length and"
                " base; give them, or a number."
            )
        if self.needs_cameras:
            raise SettingError(
                f"cameras are missing: method {self.method} goes along their rays; give the poses"
                f" of the images, or a method that needs none: {' or '.join(WITHOUT_CAMERAS)}."
            )
        for one in options_of(type(self)):
            if one.name in _ABOUT_CAMERAS and getattr(self, one.name) not in (one.default, "off"):
                raise SettingError(
                    f"{one.flag[2:]} is about cameras, and there are none: leave it out, or give"
                    " cameras too."
                )

    @property
    def limit_deg(self) -> float | None:
        """The largest incidence angle; None where there is none, or it is still open."""
        return None if self.max_angle in (None, "auto") else float(self.max_angle)

    @property
    def models_matcher(self) -> bool:
        """Whether a model of dense matching stands in for a list of views."""
        automatic = self.camera_set == "auto" and self.method in ("auto", "consistent")
        return automatic or self.camera_set == "mvs"


@dataclass(frozen=True, kw_only=True)
class BudgetOptions(OptionSet):
    """Standard deviations of what goes into a correction; see `pcfix.refract.uncertainty`."""

    panel = Panel.BUDGET

    sigma_image: float = option(
        0.5, "Standard deviation of an image coordinate.", unit="px", rule=_SIGMA
    )
    sigma_level: float | None = option(
        None,
        "Of the water level.",
        unit="m",
        rule=_SIGMA,
        default_is=f"what its fit says, else {LEVEL_M:g}",
    )
    sigma_tilt: float = option(
        0.0, "Of the slope of the water surface, about each axis.", unit="deg", rule=_SIGMA
    )
    sigma_index: float = option(0.002, "Of the refractive index.", rule=_SIGMA)
    sigma_waves: float = option(
        0.0, "Of the slope of the waves, from ray to ray.", unit="deg", rule=_SIGMA
    )
    sigma_centre: float = option(0.0, "Of a projection centre, each axis.", unit="m", rule=_SIGMA)
    sigma_attitude: float = option(
        0.0, "Of the attitude of an image, about each axis.", unit="deg", rule=_SIGMA
    )


@dataclass(frozen=True, kw_only=True)
class UnsureOption(OptionSet):
    """What becomes of points that were corrected by flat rays alone."""

    panel = Panel.OUTPUT

    unsure: Unsure = option(
        "keep",
        "Corrected points that only flat obliques see, every ray beyond 35 degrees, where no list"
        " says which images made them: as others, or flagged withheld.",
    )


@dataclass(frozen=True, kw_only=True)
class RefractionOptions(BudgetOptions, MethodOptions, UnsureOption):
    """What the correction of points goes by."""

    panel = Panel.WATER

    deep: bool = option(
        False, "Accept depths of more than 60 m, which else are taken for a wrong water level."
    )


@dataclass(frozen=True, kw_only=True)
class PointsOptions(RefractionOptions, WaterPerImageOption):
    """The options of `pcfix.correct_points`."""


@dataclass(frozen=True, kw_only=True)
class ResultOptions(OptionSet):
    """What is written of a correction."""

    panel = Panel.OUTPUT

    uncorrected: Uncorrected = option(
        "withhold", "Submerged points with fewer than two usable rays: flagged, kept or left out."
    )
    dimensions: Dimensions = option("all", "Extra dimensions; 'pcfix restore' needs all.")


@dataclass(frozen=True, kw_only=True)
class ScienceOptions(RefractionOptions, ResultOptions):
    """What the values of a corrected file depend on, beside its inputs; the file records it."""


@dataclass(frozen=True, kw_only=True)
class CorrectOptions(
    PartOptions,
    ShorelineOption,
    TileOptions,
    SummaryOption,
    ScienceOptions,
    WaterPerImageOption,
    SubmergedOptions,
    InputOptions,
):
    """The options of ``pcfix correct``; in Python they are `pcfix.Options`."""

    panel = Panel.OUTPUT

    save_regression: File | None = option(
        None, "Write the line fitted to --check-depths there, as JSON."
    )

    def check(self) -> None:
        """Check what options say together."""
        super().check()
        if self.save_regression is not None and self.check_depths is None:
            raise SettingError(
                "save-regression is of no use without check-depths; give both, or neither."
            )


@dataclass(frozen=True, kw_only=True)
class LabelRules(LandRules):
    """Which points count as submerged, beyond lying below the surface; see `pcfix.label`."""

    panel = Panel.WATER
    old_units = True

    band: float = option(
        0.0,
        "Points at most so far from the surface, above or below, become class 41.",
        unit="m",
        rule=not_negative("give metres from the water surface, or 0 for none"),
        default_is="no class 41",
    )
    dead_band: float = option(
        0.0,
        "Points at most so far from the surface take the label of their surroundings.",
        unit="m",
        rule=not_negative("give metres from the water surface, or 0 for none"),
        default_is="none",
    )
    reset: bool = option(False, "Points that come as class 40 or 41 and are neither become 1.")

    def check(self) -> None:
        """Check what options say together."""
        super().check()
        if 0.0 < self.dead_band <= self.band:
            raise SettingError(
                f"dead-band {self.dead_band:g} does not reach beyond band {self.band:g}, in"
                " which all points are class 41: give a wider dead band, or 0 for none."
            )


@dataclass(frozen=True, kw_only=True)
class StageLabelOptions(LabelRules, SubmergedOptions, WaterOptions, NeededOptions):
    """The options of the stage ``label`` of PDAL, which writes no files."""


@dataclass(frozen=True, kw_only=True)
class LabelOptions(PartOptions, TileOptions, SummaryOption, StageLabelOptions):
    """The options of ``pcfix label``."""


Options = CorrectOptions
"""The name of the front door."""

"""The options of a correction and of a labelling."""

from __future__ import annotations

from typing import Literal

from pcfix.errors import SettingError
from pcfix.options.declare import File, OptionSet, number_or, option, options_of
from pcfix.options.shared import (
    IndexOptions,
    InputOptions,
    LandRules,
    MaskOption,
    NeededOptions,
    Panel,
    PartOptions,
    ShorelineOption,
    SummaryOption,
    TileOptions,
    WaterPerImageOption,
)

Unsure = Literal["keep", "withhold"]
Dimensions = Literal["all", "minimal", "none"]
Method = Literal[
    "auto", "snell", "consistent", "shan", "butler", "murase", "dietrich", "factor", "regression"
]

Software = Literal[
    "colmap", "metashape", "micmac", "odm", "openmvs", "opensfm", "realitycapture", "sure", "other"
]

WITHOUT_CAMERAS = ("factor", "regression")
"""Methods that use the apparent depth only."""

LEVEL_M = 0.02
"""Assumed standard deviation of a water level."""


class MethodOptions(IndexOptions, panel=Panel.METHOD):
    """The rays that are used, and how the true point follows from the apparent one."""

    method: Method = option("auto", basic=True)
    """Correction method. auto: consistent if the cameras have angles and lenses, else snell."""
    camera_set: Literal["auto", "mvs", "all"] = option("auto", with_cameras=True)
    """Cameras used when there is no view list: every visible camera (all), or those that a dense
    matcher would use (mvs); auto: mvs with --method consistent, else all."""
    matcher: Literal["depth-maps", "single-map", "nearest-map", "pairs"] = option(
        "depth-maps", with_cameras=True
    )
    """Dense matcher of --camera-set mvs. depth-maps: fused (OpenMVS, COLMAP); single-map: one image
    at each place (SURE); nearest-map: the image nearest in plan; pairs: median of stereo pairs
    (MicMac)."""
    software: Software | None = option(None, with_cameras=True)
    """Software that reconstructed the cloud: its usual reconstruction types are more likely, if the
    cloud does not show clearly which it is. [default: as named in the header of the cloud]"""
    max_angle: float | str | None = option(
        "auto",
        with_cameras=True,
        basic=True,
        above=0,
        most=90,
        parse=number_or("auto", "none"),
        metavar="DEG",
    )
    """Maximum incidence angle of a ray, from the surface normal; none for no limit. auto: no limit,
    but 35 for snell and the formulas if the cloud was clearly reconstructed without rays at larger
    angles. [deg] [default: auto; must be given for poses without a lens]"""
    max_cameras: int | None = option(None, with_cameras=True, least=1)
    """Maximum number of rays per point; those closest to nadir are used. [default: no limit]"""
    occlusion: Literal["auto", "on", "off"] = option("auto", with_cameras=True)
    """Skip cameras from which the cloud occludes the point; auto: if there are oblique images."""
    exact: bool = option(False)
    """No effect: every point is solved exactly. The option remains for older scripts."""
    depth_factor: float | str | None = option(
        None, least=1, most=3, needs="method factor", parse=number_or("auto"), metavar="N"
    )
    """Ratio of true to apparent depth; auto: from the height, focal length and base of the cameras.
    [default: the refractive index]"""
    least_r2: float = option(0.5, least=0, most=1)
    """Minimum r2 of the fit of --method regression."""
    index_from: str = ""
    """Which water the index is of, if it was not given as a number; not an option."""

    def check(self) -> None:
        """Check that one ray is enough for the method."""
        if self.max_cameras == 1 and self.method not in ("butler", "dietrich"):
            raise SettingError(
                "option.range",
                "max-cameras 1 is not enough: an intersection needs two rays. Only --method butler"
                " and dietrich can use one.",
                option="max_cameras",
                value=1,
            )

    @property
    def needs_cameras(self) -> bool:
        """Whether the correction uses cameras."""
        return self.method not in WITHOUT_CAMERAS or self.depth_factor == "auto"

    def check_no_cameras(self) -> None:
        """Refuse what cannot be done, or has no effect, without cameras."""
        if self.needs_cameras:
            factor = self.method in WITHOUT_CAMERAS
            wanted = "depth-factor auto" if factor else f"method {self.method}"
            other = "a number" if factor else f"a method without: {' or '.join(WITHOUT_CAMERAS)}"
            raise SettingError(
                "cameras.missing",
                f"cameras are missing: {wanted} needs them. Give them, or {other}.",
            )
        for one in options_of(type(self)):
            if one.with_cameras and getattr(self, one.name) not in (one.default, "off"):
                raise SettingError(
                    "option.needs",
                    f"{one.flag[2:]} has no effect without cameras. Give both, or neither.",
                    option=one.name,
                    needs="cameras",
                )

    @property
    def limit_deg(self) -> float | None:
        """The maximum incidence angle; None for no limit, or if it is not known yet."""
        return None if self.max_angle in (None, "auto") else float(self.max_angle)

    @property
    def models_matcher(self) -> bool:
        """Whether a model of dense matching replaces a view list."""
        automatic = self.camera_set == "auto" and self.method in ("auto", "consistent")
        return automatic or self.camera_set == "mvs"

    @property
    def chooses_maps(self) -> bool:
        """Whether the images that made a point are chosen among several by the bed around it."""
        return self.method == "consistent" and self.matcher in ("depth-maps", "single-map")


class BudgetOptions(OptionSet, panel=Panel.BUDGET):
    """Standard deviations of the inputs of a correction; see `pcfix.refract.uncertainty`."""

    sigma_image: float = option(0.5, least=0)
    """Standard deviation of an image coordinate. [px]"""
    sigma_level: float | None = option(None, least=0)
    """Standard deviation of the water level. [m] [default: that of its fit, else 0.02]"""
    sigma_tilt: float = option(0.0, least=0)
    """Standard deviation of the tilt of the water surface, about each axis. [deg]"""
    sigma_index: float = option(0.002, least=0)
    """Standard deviation of the refractive index."""
    sigma_waves: float = option(0.0, least=0)
    """Standard deviation of the slope of waves, independent for each ray. [deg]"""
    sigma_centre: float = option(0.0, least=0)
    """Standard deviation of a projection centre, along each axis. [m]"""
    sigma_attitude: float = option(0.0, least=0)
    """Standard deviation of the attitude, about each axis. [deg]"""


class RefractionOptions(BudgetOptions, MethodOptions, panel=Panel.OUTPUT):
    """Everything that the correction of points depends on."""

    unsure: Unsure = option("keep", with_cameras=True)
    """Corrected points whose rays all have incidence angles above 35 deg, without a view list: keep
    them as they are, or flag them as withheld."""
    deep: bool = option(False, panel=Panel.WATER)
    """Accept depths of more than 60 m, which usually mean a wrong water level."""


class PointsOptions(RefractionOptions, WaterPerImageOption):
    """The options of `pcfix.correct_points`."""


class ScienceOptions(RefractionOptions, panel=Panel.OUTPUT):
    """Everything that a corrected file depends on, besides its inputs; the file records it."""

    uncorrected: Literal["withhold", "keep", "drop"] = option("withhold", basic=True)
    """Submerged points with fewer than two usable rays: flag, keep or drop them."""
    dimensions: Dimensions = option("all")
    """Extra dimensions to write; 'pcfix restore' needs all."""


class CorrectOptions(
    PartOptions, ShorelineOption, TileOptions, SummaryOption, ScienceOptions, WaterPerImageOption,
    MaskOption, LandRules, InputOptions, panel=Panel.OUTPUT,
):  # fmt: skip
    """The options of ``pcfix correct``; in Python they are `pcfix.Options`."""

    save_regression: File | None = option(None, writes=True, needs="check_depths")
    """JSON file for the line fitted to --check-depths."""


class LabelRules(LandRules, panel=Panel.WATER):
    """Which points count as submerged, besides those below the surface; see `pcfix.label`."""

    band: float = option(0.0, least=0)
    """Points up to this distance from the surface, above or below, become class 41. [m] [default:
    no class 41]"""
    dead_band: float = option(0.0, least=0)
    """Points up to this distance from the surface get the label of their surroundings. [m]
    [default: none]"""
    reset: bool = option(False)
    """Set points of class 40 or 41 to class 1 if they are no longer in either class."""

    def check(self) -> None:
        """Check that the dead band is wider."""
        if 0.0 < self.dead_band <= self.band:
            raise SettingError(
                "option.range",
                f"dead-band {self.dead_band:g} must be more than band {self.band:g}, where all"
                " points are class 41. Give a wider one, or 0 for none.",
                option="dead_band",
                value=self.dead_band,
                above=self.band,
            )


class StageLabelOptions(LabelRules, MaskOption, NeededOptions):
    """The options of the stage ``label`` of PDAL, which writes no files."""


class LabelOptions(PartOptions, TileOptions, SummaryOption, StageLabelOptions):
    """The options of ``pcfix label``."""


Options = CorrectOptions
"""The name of the front door."""

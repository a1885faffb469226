"""The options of what goes before a correction, and of a whole run: cameras, water, adjust, run."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, Literal

from pcfix.errors import PcfixWarning, SettingError
from pcfix.options.correct import RefractionOptions
from pcfix.options.declare import File, OptionSet, one_or_more, option, options_of, positive
from pcfix.options.shared import (
    CameraFileOptions,
    IndexOptions,
    NeededOptions,
    OverwriteOption,
    Panel,
    PortOptions,
    ShorelineOption,
    SubmergedOptions,
    SummaryOption,
    SurveyOptions,
    TileOptions,
    ViewOptions,
    WaterOptions,
)
from pcfix.options.steps import METRES, DistanceOptions, ReferenceOption

Poses = Literal["free", "fixed", "similarity"]
Datum = Literal["observed", "free"]
Ties = Literal["auto", "measured", "cloud"]
AdjustWhen = Literal["auto", "yes", "no"]
WATER_UNKNOWNS = ("level", "tilt", "index", "shape", "distance", "centre")


@dataclass(frozen=True, kw_only=True)
class SurveyedOptions(OptionSet):
    """What surveys say of the images."""

    panel = Panel.CAMERAS

    gcps: Any = option(
        None,
        "Control and check points with their marks: CSV name,x,y,z,image,u,v[,role,under_water],"
        " ODM's gcp_list.txt, or Metashape's markers.",
        metavar="PATH",
    )
    gnss: File | None = option(
        None,
        "GNSS positions of the images: CSV image,x,y,z[,sx,sy,sz], a geotag list, or a camera file"
        " that has them.",
        default_is="what the cameras have",
    )
    lens: File | None = option(
        None, "Calibrated lens, held fixed: as --sensor, or a Metashape calibration."
    )


@dataclass(frozen=True, kw_only=True)
class CamerasCheckOptions(
    OverwriteOption, SummaryOption, SurveyedOptions, CameraFileOptions, IndexOptions
):
    """The options of ``pcfix cameras``."""

    panel = Panel.CAMERAS

    cloud: File | None = option(None, "LAS or LAZ cloud that they shall fit.")
    water: Any = option(
        None,
        "As of 'pcfix correct': for heights and GSD, and, with a cloud, whether the poses have"
        " absorbed the refraction.",
        metavar="SPEC",
    )
    reference: File | None = option(
        None, "Survey of land or bed: LiDAR (.las, .laz), grid (.tif) or CSV x,y,z."
    )
    plot: File | None = option(None, "PNG of the block in plan and from the side.")


@dataclass(frozen=True, kw_only=True)
class WaterCheckOptions(ShorelineOption, OverwriteOption, SummaryOption, WaterOptions):
    """The options of ``pcfix water``."""

    panel = Panel.OUTPUT

    cloud: File | None = option(None, "LAS or LAZ cloud under it.")
    plot: File | None = option(None, "PNG of points and residuals, or of evidence.")

    def check(self) -> None:
        """Check what options say together."""
        super().check()
        if self.shoreline is not None and self.cloud is None:
            raise SettingError(
                f"shoreline {self.shoreline}: is where a cloud meets the water; give --cloud too."
            )


@dataclass(frozen=True, kw_only=True)
class RunOptions(
    ReferenceOption,
    ShorelineOption,
    TileOptions,
    DistanceOptions,
    SurveyedOptions,
    RefractionOptions,
    SubmergedOptions,
    SurveyOptions,
):
    """The options of ``pcfix run``: everything that its results depend on is in ``run.json``."""

    panel = Panel.OUTPUT
    old_units = True

    resolution: float | None = option(
        None,
        "Of the rasters.",
        unit="m",
        rule=METRES,
        default_is="2 to 4 points a cell, or the GSD",
    )
    project: str | None = option(
        None, "Its name, the title of the report.", default_is="the name of the cloud"
    )
    date: str | None = option(
        None, "When the images were taken, for the report.", default_is="what --image-times says"
    )
    adjust: AdjustWhen = option(
        "auto",
        "First adjust the cameras with the light bent at the water, as 'pcfix adjust'; auto: where"
        " they have absorbed the refraction, and GNSS or --gcps say where they are.",
    )

    def check(self) -> None:
        """Check what options say together."""
        super().check()
        for one in options_of(DistanceOptions):
            if self.reference is None and getattr(self, one.name) != one.default:
                raise SettingError(
                    f"{one.flag[2:]} is for a comparison with a reference; give --reference too."
                )


_SIGMA = positive("the standard deviation {value:g} must be positive.")


def _water_unknowns(option: str, names: Any) -> str | None:
    wrong = next((name for name in names if name not in WATER_UNKNOWNS), None)
    return wrong and f"free '{wrong}' must be among {', '.join(WATER_UNKNOWNS)}."


def _engine(option: str, name: Any) -> str | None:
    """Refuse an engine that is gone, and warn of an option that says nothing any more."""
    if name not in ("direct", "pcfix"):
        return (
            f"engine '{name}': pcfix 0.1.0 was the last version with COLMAP's engine; leave"
            " --engine out, as there is one engine only."
        )
    warnings.warn(
        "--engine is of no use any more, as there is one engine only; leave it out.",
        PcfixWarning,
        stacklevel=2,
    )
    return None


def _lens_names(option: str, text: str) -> tuple[str, ...]:
    names = one_or_more(str, "f,k1")(option, text)
    return () if names == ("none",) else names


@dataclass(frozen=True, kw_only=True)
class AdjustRules(IndexOptions):
    """How a block is adjusted."""

    panel = Panel.UNKNOWNS

    free: tuple[str, ...] = option(
        (),
        "What of the water moves too: some of level,tilt,index,shape (bent, to the second order),"
        " with commas between; of a port: distance (flat), centre (dome), index.",
        rule=_water_unknowns,
        parse=one_or_more(str, "level,tilt"),
        default_is="nothing",
        metavar="NAMES",
    )
    parallel: tuple[str, ...] = option(
        (),
        "Planes of --gcps that are parallel, as floor,deck; water is one too.",
        parse=one_or_more(str, "water,floor"),
        metavar="NAMES",
    )
    sigma_level: float | None = option(
        None, "Let the level move about its value.", unit="m", rule=_SIGMA, old=("level_sigma_m",)
    )
    sigma_tilt: float | None = option(
        None, "Let the tilt move about its value.", unit="deg", rule=_SIGMA, old=("tilt_sigma_deg",)
    )
    sigma_index: float | None = option(
        None, "Let the refractive index move about its value.", rule=_SIGMA, old=("index_sigma",)
    )
    lens_unknowns: tuple[str, ...] | None = option(
        None,
        "Lens parameters that move: none, or some of f,cx,cy,k1...,p1,p2,b1,b2.",
        parse=_lens_names,
        default_is="those that the block determines",
        metavar="NAMES",
    )
    poses: Poses = option("free", "Whether poses move one by one, not at all, or all together.")
    fixed_images: tuple[str, ...] = option(
        (), "Images that keep their pose.", parse=one_or_more(str, "a.jpg"), metavar="A,B"
    )
    datum: Datum = option(
        "observed",
        "What says where the block is; free: mean place, direction and scale of the old poses.",
        old=("free_network",),
    )
    ties: Ties = option(
        "auto", "Adjust measured tie points, or points of the cloud; auto: as there are."
    )
    gnss_sigma: float | None = option(
        None,
        "Of GNSS positions without one.",
        unit="m",
        rule=_SIGMA,
        default_is="from how they fit",
        old=("gnss_sigma_m",),
    )
    sigma_image: float | None = option(
        None,
        "Of tie points in the images.",
        unit="px",
        rule=_SIGMA,
        default_is="from their residuals",
        old=("sigma_px",),
    )
    outliers: bool = option(True, "Look for outliers and leave them out.")
    engine: str | None = option(None, "There is one only.", rule=_engine, hidden=True)


@dataclass(frozen=True, kw_only=True)
class AdjustOptions(
    OverwriteOption,
    AdjustRules,
    SurveyedOptions,
    ViewOptions,
    CameraFileOptions,
    PortOptions,
    WaterOptions,
    NeededOptions,
):
    """The options of ``pcfix adjust``."""

    panel = Panel.CAMERAS

    cloud: File | None = option(
        None, "The cloud that these poses made; it stands in where there are no tie points."
    )
    gnss_crs: str | None = option(None, "CRS of the GNSS positions.", metavar="CRS")
    gcps_crs: str | None = option(None, "CRS of the control points.", metavar="CRS")
    water_mask: File | None = option(
        None, "Polygons inside which points may be submerged.", default_is="everywhere"
    )

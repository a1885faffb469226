"""The options before a correction, and of a whole run: cameras, water, adjust, run."""

from __future__ import annotations

from typing import Any, Literal, get_args

from pcfix.options.correct import RefractionOptions
from pcfix.options.declare import File, OptionSet, option, words
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
from pcfix.options.steps import DistanceOptions, ReferenceOption

Poses = Literal["free", "fixed", "similarity"]
Datum = Literal["observed", "free"]
Ties = Literal["auto", "measured", "cloud"]
AdjustWhen = Literal["auto", "yes", "no"]
WaterUnknown = Literal["level", "tilt", "index", "shape", "distance", "centre"]
WATER_UNKNOWNS: tuple[str, ...] = get_args(WaterUnknown)


class SurveyedOptions(OptionSet, panel=Panel.CAMERAS):
    """Survey data of the images."""

    gcps: Any = option(
        None,
        "Control and check points with their image points: CSV name,x,y,z,image,u,v[,role,"
        "under_water], ODM's gcp_list.txt, or Metashape's markers.",
        metavar="PATH",
    )
    gnss: File | None = option(
        None,
        "GNSS positions of the images: CSV image,x,y,z[,sx,sy,sz], a geotag list, or a camera"
        " file.",
        default_is="what the cameras have",
    )
    lens: File | None = option(
        None, "Calibrated lens, held fixed: as --sensor, or a Metashape calibration."
    )


class CamerasCheckOptions(
    OverwriteOption,
    SummaryOption,
    SurveyedOptions,
    CameraFileOptions,
    IndexOptions,
    panel=Panel.CAMERAS,
):
    """The options of ``pcfix cameras``."""

    cloud: File | None = option(None, "LAS or LAZ cloud to check against the cameras.")
    water: Any = option(
        None,
        "Water surface, as for 'pcfix correct': for heights and GSD and, with --cloud, for a check"
        " of absorbed refraction.",
        metavar="SPEC",
    )
    reference: File | None = option(
        None, "Survey of land or bed: LiDAR (.las, .laz), grid (.tif) or CSV x,y,z."
    )
    plot: File | None = option(None, "PNG of the block in plan and from the side.")


class WaterCheckOptions(OverwriteOption, SummaryOption, WaterOptions, panel=Panel.OUTPUT):
    """The options of ``pcfix water``."""

    cloud: File | None = option(None, "LAS or LAZ cloud under the water surface.")
    plot: File | None = option(None, "PNG of points and residuals, or of the evidence for auto.")
    shoreline: File | None = option(
        None,
        "GeoPackage (.gpkg) for the shoreline of the cloud, with its standard error.",
        needs="cloud",
    )


class RunOptions(
    ReferenceOption,
    ShorelineOption,
    TileOptions,
    DistanceOptions,
    SurveyedOptions,
    RefractionOptions,
    SubmergedOptions,
    SurveyOptions,
    panel=Panel.OUTPUT,
):
    """The options of ``pcfix run``: everything that its results depend on is in ``run.json``."""

    resolution: float | None = option(
        None,
        "Cell size of the rasters.",
        unit="m",
        above=0,
        default_is="2 to 4 points a cell, or the GSD",
    )
    project: str | None = option(
        None, "Name of the project, the title of the report.", default_is="the name of the cloud"
    )
    date: str | None = option(
        None, "Date of the images, for the report.", default_is="what --image-times says"
    )
    adjust: AdjustWhen = option(
        "auto",
        "First refine the cameras, as 'pcfix adjust'; auto: if they have absorbed refraction, and"
        " there are GNSS positions or --gcps.",
    )


def _lens_names(option: str, text: str) -> tuple[str, ...]:
    names = words(option, text)
    return () if names == ("none",) else names


class AdjustRules(IndexOptions, panel=Panel.UNKNOWNS):
    """How a block is adjusted."""

    free: tuple[WaterUnknown, ...] = option(
        (),
        "Unknowns of the water: some of level,tilt,index,shape (curved, to the second order); of a"
        " port: distance (flat), centre (dome), index.",
        parse=words,
        default_is="nothing",
        metavar="NAMES",
    )
    parallel: tuple[str, ...] = option(
        (),
        "Planes of --gcps that are parallel, such as floor,deck; water is one too.",
        parse=words,
        metavar="NAMES",
    )
    sigma_level: float | None = option(
        None, "Let the level move, with this standard deviation.", unit="m", above=0
    )
    sigma_tilt: float | None = option(
        None, "Let the tilt move, with this standard deviation.", unit="deg", above=0
    )
    sigma_index: float | None = option(
        None, "Let the refractive index move, with this standard deviation.", above=0
    )
    lens_unknowns: tuple[str, ...] | None = option(
        None,
        "Unknowns of the lens: none, or some of f,cx,cy,k1...,p1,p2,b1,b2.",
        parse=_lens_names,
        default_is="those that the block determines",
        metavar="NAMES",
    )
    poses: Poses = option("free", "Adjust poses one by one, not at all, or all together.")
    fixed_images: tuple[str, ...] = option(
        (), "Images that keep their pose.", parse=words, metavar="A,B"
    )
    datum: Datum = option(
        "observed",
        "Datum of the block: from observations, or free: mean position, direction and scale of the"
        " original poses.",
    )
    ties: Ties = option(
        "auto", "Use measured tie points, or points of the cloud; auto: measured if there are any."
    )
    gnss_sigma: float | None = option(
        None,
        "Standard deviation of GNSS positions that have none.",
        unit="m",
        above=0,
        default_is="from their residuals",
    )
    sigma_image: float | None = option(
        None,
        "Standard deviation of tie points in the images.",
        unit="px",
        above=0,
        default_is="from their residuals",
    )
    outliers: bool = option(True, "Search for outliers and exclude them.")


class AdjustOptions(
    OverwriteOption,
    AdjustRules,
    SurveyedOptions,
    ViewOptions,
    CameraFileOptions,
    PortOptions,
    NeededOptions,
    panel=Panel.CAMERAS,
):
    """The options of ``pcfix adjust``."""

    cloud: File | None = option(
        None, "Cloud made with these poses; used if there are no tie points."
    )
    gnss_crs: str | None = option(None, "CRS of the GNSS positions.", metavar="CRS")
    gcps_crs: str | None = option(None, "CRS of the control points.", metavar="CRS")
    water_mask: File | None = option(
        None, "Polygons inside which points may be submerged.", default_is="everywhere"
    )

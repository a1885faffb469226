"""The options before a correction, and of a whole run: cameras, water, adjust, run."""

from __future__ import annotations

from typing import Any, Literal, get_args

from pcfix.options.correct import RefractionOptions
from pcfix.options.declare import File, OptionSet, option, words
from pcfix.options.shared import (
    CameraFileOptions,
    IndexOptions,
    LandRules,
    MaskOption,
    NeededOptions,
    OverwriteOption,
    Panel,
    PortOptions,
    ShorelineOption,
    SummaryOption,
    SurveyOptions,
    TileOptions,
    ViewOptions,
    WaterOptions,
)
from pcfix.options.steps import DistanceOptions, ReferenceOption

WaterUnknown = Literal["level", "tilt", "index", "shape", "distance", "centre"]
LensUnknown = Literal[
    "f", "cx", "cy", "b1", "b2", "p1", "p2", "k1", "k2", "k3", "k4", "k5", "k6", "k7", "k8"
]
WATER_UNKNOWNS: tuple[str, ...] = get_args(WaterUnknown)


class SurveyedOptions(OptionSet, panel=Panel.CAMERAS):
    """Survey data of the images."""

    gcps: Any = option(None, basic=True, metavar="PATH")
    """Control and check points with their image points: CSV
    name,x,y,z,image,u,v[,role,under_water], ODM's gcp_list.txt, or Metashape's markers."""
    gnss: File | None = option(None, basic=True)
    """GNSS positions of the images: CSV image,x,y,z[,sx,sy,sz], a geotag list, or a camera file.
    [default: those of the camera file]"""
    lens: File | None = option(None, basic=True)
    """Calibrated lens, which is held fixed: a file as for --sensor, or a Metashape calibration."""


class CamerasCheckOptions(
    OverwriteOption, SummaryOption, SurveyedOptions, CameraFileOptions, IndexOptions,
    panel=Panel.CAMERAS,
):  # fmt: skip
    """The options of ``pcfix cameras``."""

    cloud: File | None = option(None, basic=True)
    """LAS or LAZ cloud to check against the cameras."""
    water: Any = option(None, basic=True, metavar="SPEC")
    """Water surface, as for 'pcfix correct': for heights and GSD and, with --cloud, for a check of
    absorbed refraction."""
    reference: File | None = option(None, basic=True)
    """Survey of land or bed: LiDAR (.las, .laz), grid (.tif) or CSV x,y,z."""
    plot: File | None = option(None, writes=True, basic=True)
    """PNG of the block in plan and from the side."""


class WaterCheckOptions(OverwriteOption, SummaryOption, WaterOptions, panel=Panel.OUTPUT):
    """The options of ``pcfix water``."""

    cloud: File | None = option(None, basic=True)
    """LAS or LAZ cloud under the water surface."""
    plot: File | None = option(None, writes=True, basic=True)
    """PNG of points and residuals, or of the evidence for auto."""
    shoreline: File | None = option(None, writes=True, basic=True, needs="cloud")
    """GeoPackage (.gpkg) for the shoreline of the cloud, with its standard error."""


class RunOptions(
    ReferenceOption, ShorelineOption, TileOptions, DistanceOptions, SurveyedOptions,
    RefractionOptions, MaskOption, LandRules, SurveyOptions, panel=Panel.OUTPUT,
):  # fmt: skip
    """The options of ``pcfix run``: everything that its results depend on is in ``run.json``."""

    resolution: float | None = option(None, basic=True, above=0)
    """Cell size of the rasters. [m] [default: 2 to 4 points a cell]"""
    project: str | None = option(None, basic=True)
    """Name of the project, the title of the report. [default: the name of the cloud]"""
    date: str | None = option(None)
    """Date of the images, for the report."""
    adjust: Literal["auto", "yes", "no"] = option("auto", basic=True)
    """First refine the cameras, as 'pcfix adjust'; auto: if they have absorbed refraction, and
    there are GNSS positions or --gcps."""


def _lens_names(text: str) -> tuple[str, ...]:
    names = words(text)
    return () if names == ("none",) else names


class AdjustRules(IndexOptions, panel=Panel.UNKNOWNS):
    """How a block is adjusted."""

    free: tuple[WaterUnknown, ...] = option((), basic=True, parse=words, metavar="NAMES")
    """Unknowns of the water: any of level,tilt,index,shape (second-order curvature); of a port:
    distance (flat), centre (dome), index. [default: none]"""
    parallel: tuple[str, ...] = option((), parse=words, metavar="NAMES")
    """Parallel planes of --gcps, such as floor,deck; water may be one of them."""
    sigma_level: float | None = option(None, above=0)
    """Estimate the water level too, with this standard deviation of the given one. [m]"""
    sigma_tilt: float | None = option(None, above=0)
    """Estimate the tilt too, with this standard deviation of the given one. [deg]"""
    sigma_index: float | None = option(None, above=0)
    """Estimate the refractive index too, with this standard deviation of the given one."""
    lens_unknowns: tuple[LensUnknown, ...] | None = option(None, parse=_lens_names, metavar="NAMES")
    """Unknowns of the lens: none, or any of f,cx,cy,k1...,p1,p2,b1,b2. [default: those that the
    block determines]"""
    poses: Literal["free", "fixed", "similarity"] = option("free")
    """Adjust each pose, none, or all together by one similarity transformation."""
    fixed_images: tuple[str, ...] = option((), parse=words, metavar="A,B")
    """Images whose poses are held fixed."""
    datum: Literal["observed", "free"] = option("observed")
    """Datum of the block: from observations, or free: mean position, direction and scale of the
    original poses."""
    ties: Literal["auto", "measured", "cloud"] = option("auto")
    """Use measured tie points, or points of the cloud; auto: measured if there are any."""
    gnss_sigma: float | None = option(None, above=0)
    """Standard deviation of GNSS positions that state none. [m] [default: from their residuals]"""
    sigma_image: float | None = option(None, above=0)
    """Standard deviation of tie points in the images. [px] [default: from their residuals]"""
    outliers: bool = option(True)
    """Search for outliers and exclude them."""


class AdjustOptions(
    OverwriteOption, AdjustRules, SurveyedOptions, ViewOptions, CameraFileOptions, PortOptions,
    NeededOptions, panel=Panel.CAMERAS,
):  # fmt: skip
    """The options of ``pcfix adjust``."""

    cloud: File | None = option(None, basic=True)
    """Cloud reconstructed with these poses; used if there are no tie points."""
    gnss_crs: str | None = option(None, metavar="CRS")
    """CRS of the GNSS positions."""
    gcps_crs: str | None = option(None, metavar="CRS")
    """CRS of the control points."""
    water_mask: File | None = option(None, basic=True)
    """Polygons inside which points may be submerged. [default: everywhere]"""

"""The options of a correction, of what comes before it, and of a whole run."""

from typing import Any, Literal

from pcfix.errors import SettingError
from pcfix.options.declare import File, OptionSet, number_or, option, options_of, words
from pcfix.options.shared import (
    BandOption,
    BudgetOptions,
    CameraFileOptions,
    IndexOptions,
    InputOptions,
    JobOptions,
    LandRules,
    MaskOption,
    NeededOptions,
    OverwriteOption,
    Panel,
    PortOptions,
    SummaryOption,
    SurveyOptions,
    TileOptions,
    ViewOptions,
    WaterOptions,
    WaterPerImageOption,
)
from pcfix.options.steps import DistanceOptions

Dimensions = Literal["all", "minimal", "none"]
Method = Literal[
    "auto", "snell", "consistent", "shan", "butler", "murase", "dietrich", "factor", "regression"
]

Software = Literal[
    "colmap", "metashape", "micmac", "odm", "openmvs", "opensfm", "realitycapture", "sure", "other"
]

WITHOUT_CAMERAS = ("factor", "regression")  # methods that use the apparent depth only
LEVEL_M = 0.02  # assumed standard deviation of a water level


class MethodOptions(IndexOptions, panel=Panel.METHOD):
    """The choice of rays and the method of correction."""

    method: Method = option("auto", basic=True)
    """Correction method. auto: consistent if the cameras have angles and lenses, else snell."""
    camera_set: Literal["auto", "mvs", "all"] = option("auto", with_cameras=True)
    """Cameras used when there is no view list: every visible camera (all) or, with --method
    consistent only, those that a dense matcher would use (mvs); auto: mvs with consistent."""
    matcher: Literal["depth-maps", "single-map", "nearest-map", "pairs"] = option(
        "depth-maps", with_cameras=True
    )
    """Dense matcher of --camera-set mvs. depth-maps: fused (OpenMVS, COLMAP); single-map: one image
    at each place (SURE); nearest-map: that nearest in plan; pairs: median of pairs (MicMac)."""
    software: Software | None = option(None, with_cameras=True)
    """Software that reconstructed the cloud: its usual reconstruction types are more likely, if the
    cloud does not show clearly which it is. [default: as named in the header of the cloud]"""
    max_angle: float | str | None = option(
        "auto", with_cameras=True, basic=True, above=0, most=90, metavar="DEG",
        parse=number_or("auto", "none"),
    )  # fmt: skip
    """Maximum incidence angle of a ray, from the surface normal; none for no limit. auto: no limit,
    but 35 for snell and the formulas if the cloud was clearly reconstructed without rays at larger
    angles. [deg] [default: auto; must be given for poses without a lens]"""
    occlusion: Literal["auto", "on", "off"] = option("auto", with_cameras=True)
    """Skip cameras from which the cloud occludes the point; auto: if there are oblique images."""
    depth_factor: float | str | None = option(
        None, least=1, most=3, needs="method factor", parse=number_or("auto")
    )
    """Ratio of true to apparent depth; auto: from the height, focal length and base of the cameras.
    [default: the refractive index]"""
    index_from: str = ""
    """The water of the index, if it was not given as a number; not an option."""

    def check(self) -> None:
        """Check that a matcher is modelled for `consistent` only."""
        if self.camera_set == "mvs" and self.method not in ("auto", "consistent"):
            sentence = f"camera-set mvs needs method consistent, not {self.method}. For the other"
            sentence += " methods it is worse than all cameras."
            values = {"option": "camera_set", "needs": "method consistent"}
            raise SettingError("option.needs", sentence, **values)

    @property
    def needs_cameras(self) -> bool:
        """Whether the correction uses cameras."""
        return self.method not in WITHOUT_CAMERAS or self.depth_factor == "auto"

    def check_no_cameras(self) -> None:
        """Raise SettingError for methods and options that need cameras."""
        if self.needs_cameras:
            wanted = f"method {self.method}"
            other = f"a method without: {' or '.join(WITHOUT_CAMERAS)}"
            if self.method in WITHOUT_CAMERAS:
                wanted, other = "depth-factor auto", "a number"
            sentence = f"cameras are missing: {wanted} needs them. Give them, or {other}."
            raise SettingError("cameras.missing", sentence)
        for one in options_of(type(self)):
            if one.with_cameras and getattr(self, one.name) not in (one.default, "off"):
                raise one.without("cameras")

    @property
    def limit_deg(self) -> float | None:
        """The maximum incidence angle; None for no limit, or if it is not estimated yet."""
        return None if self.max_angle in (None, "auto") else float(self.max_angle)

    @property
    def models_matcher(self) -> bool:
        """Whether a model of dense matching replaces a view list."""
        return self.camera_set != "all" and self.method in ("auto", "consistent")

    @property
    def chooses_maps(self) -> bool:
        """Whether the base image of a point is the one with which the neighbouring bed agrees."""
        return self.method == "consistent" and self.matcher in ("depth-maps", "single-map")


class RefractionOptions(BudgetOptions, MethodOptions, panel=Panel.OUTPUT):
    """All options that affect the correction of points."""

    deep: bool = option(False, panel=Panel.WATER)
    """Accept depths of more than 60 m, which usually mean a wrong water level."""


class PointsOptions(RefractionOptions, WaterPerImageOption):
    """The options of `pcfix.correct_points`."""


class ScienceOptions(RefractionOptions, panel=Panel.OUTPUT):
    """All options that affect a corrected file; the file records them."""

    dimensions: Dimensions = option("all")
    """Extra dimensions to write; 'pcfix restore' needs all."""


class RasterOutputs(OptionSet, panel=Panel.OUTPUT):
    """Further rasters of a corrected raster, on the same grid."""

    depth: File | None = option(None, writes=True)
    """GeoTIFF for the depth of the bed, if the input is a raster."""
    shift: File | None = option(None, writes=True)
    """GeoTIFF for the shift of each cell of the input along X, Y and Z."""
    uncertainty: File | None = option(None, writes=True)
    """GeoTIFF for the vertical uncertainty at 95 %, with the standard error as second band."""
    outcome: File | None = option(None, writes=True)
    """GeoTIFF for the outcome of each cell: 0 land, 1 corrected, others not corrected."""


class CorrectOptions(
    RasterOutputs, BandOption, TileOptions, SummaryOption, ScienceOptions,
    WaterPerImageOption, MaskOption, LandRules, InputOptions, panel=Panel.OUTPUT,
):  # fmt: skip
    """The options of ``pcfix correct``; in Python they are `pcfix.Options`."""


class LabelOptions(BandOption, TileOptions, SummaryOption, LandRules, MaskOption, NeededOptions):
    """The options of ``pcfix label``."""


WaterUnknown = Literal["level", "tilt", "index", "shape", "distance", "centre"]
LensUnknown = Literal[
    "f", "cx", "cy", "b1", "b2", "p1", "p2", "k1", "k2", "k3", "k4", "k5", "k6", "k7", "k8"
]


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


class WaterCheckOptions(OverwriteOption, SummaryOption, WaterOptions, panel=Panel.OUTPUT):
    """The options of ``pcfix water``."""

    cloud: File | None = option(None, basic=True)
    """LAS or LAZ cloud under the water surface."""


class RunOptions(
    BandOption, TileOptions, DistanceOptions, SurveyedOptions, RefractionOptions, MaskOption,
    LandRules, SurveyOptions, panel=Panel.OUTPUT,
):  # fmt: skip
    """The options of ``pcfix run``; ``run.json`` records all that affect its results."""

    reference: File | None = option(None, basic=True)
    """LiDAR cloud, CSV check points or GeoTIFF to compare with."""
    resolution: float | None = option(None, basic=True, above=0)
    """Cell size of the rasters. [m] [default: 2 to 4 points a cell]"""
    project: str | None = option(None, basic=True)
    """Name of the project, the title of the report. [default: the name of the cloud]"""
    date: str | None = option(None)
    """Date of the images, for the report."""
    adjust: Literal["auto", "yes", "no"] = option("auto", basic=True)
    """First refine the cameras, as 'pcfix adjust'; auto: if they have absorbed refraction, and
    there are GNSS positions or --gcps."""


class AdjustRules(IndexOptions, panel=Panel.UNKNOWNS):
    """The unknowns and weights of an adjustment."""

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
    lens_unknowns: tuple[LensUnknown, ...] | None = option(
        None, metavar="NAMES", parse=lambda text: () if text.strip() == "none" else words(text)
    )
    """Unknowns of the lens: none, or any of f,cx,cy,k1...,p1,p2,b1,b2. [default: those that the
    block determines]"""
    poses: Literal["free", "fixed"] = option("free")
    """Adjust the poses, or hold them fixed."""
    datum: Literal["observed", "free"] = option("observed")
    """Datum: observations, or free: mean position, direction and scale of the original poses."""
    ties: Literal["auto", "cloud"] = option("auto")
    """Use points of the cloud as tie points; auto: only if there are no measured ones."""
    gnss_sigma: float | None = option(None, above=0)
    """Standard deviation of GNSS positions that state none. [m] [default: from their residuals]"""


class AdjustOptions(
    JobOptions, AdjustRules, SurveyedOptions, ViewOptions, CameraFileOptions, PortOptions,
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
    """Polygons where points may be submerged. [default: everywhere]"""


Options = CorrectOptions  # the public name of the options of a correction

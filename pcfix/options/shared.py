"""Options that several commands share: water, cameras, views, files."""

from enum import StrEnum
from typing import Any, Literal

from pcfix.options.declare import File, OptionSet, number_or, numbers, option

IndexFormula = Literal["skarlatos", "quan-fry"]

DEFAULT_REFRACTIVE_INDEX = 1.34


class Panel(StrEnum):
    """The panels of the help, in order."""

    NEED = "What you need"
    INPUT = "Raster input"
    FLIGHT = "Flight"
    CAMERA = "Camera"
    WATER = "Water"
    CAMERAS = "Cameras"
    METHOD = "Rays and method"
    BUDGET = "Error budget"
    TESTS = "Tests"
    RASTER = "Raster"
    FIGURES = "Comparison"
    UNKNOWNS = "Unknowns and weights"
    CLOUDS = "Clouds"
    ROUNDS = "Rounds"
    OUTPUT = "Output"


class IndexOptions(OptionSet, panel=Panel.WATER):
    """The refractive index of the water."""

    index: float | str | None = option(None, basic=True, least=1.0, most=1.5, parse=number_or())
    """Refractive index of the water relative to air: a number, fresh or sea. [default: 1.34]"""
    index_formula: IndexFormula = option("skarlatos")
    """Formula of the index: Skarlatos & Agrafiotis 2018, eq 13, or Quan & Fry 1995."""

    @property
    def refractive_index(self) -> float:
        """The index as a number; `pcfix.water.index.with_index` replaces fresh and sea."""
        return DEFAULT_REFRACTIVE_INDEX if self.index is None else float(self.index)


class WaterOptions(OptionSet, panel=Panel.WATER):
    """The fit of a water surface to shoreline points."""

    water_model: Literal["auto", "level", "plane", "along", "river"] = option("auto", needs="water")
    """Surface fitted to shoreline points: level, plane, plane tilted along the points only, or
    river; auto chooses among the first three."""
    water_crs: str | None = option(None, metavar="CRS", needs="water")
    """CRS of the shoreline points. [default: as stated in their file]"""


class NeededOptions(WaterOptions, panel=Panel.NEED):
    """The water surface."""

    water: Any = option(None, basic=True, metavar="SPEC", needed="needed", instead="port")
    """Water surface: a level (0.37), plane:a,b,c, dim:NAME, a mesh (.obj, .ply), a raster (.tif),
    shoreline points (.csv, .gpkg, .shp, .geojson), or auto."""


class WaterPerImageOption(OptionSet, panel=Panel.WATER):
    """A separate water surface for each image."""

    water_per_image: File | None = option(None, needs="water")
    """Folder of rasters of the water, named as the images; see 'pcfix calm --surface'. --water is
    used for the other images."""


class LandRules(OptionSet, panel=Panel.WATER):
    """Rules by which points below the surface count as land."""

    connected: bool = option(False, basic=True, off=True, needs="water")
    """Correct only the main water body and its connected parts; ignore separate pools."""
    least_pool: float | None = option(None, least=0.0, needs="connected")
    """Also correct pools of at least this area. [m2] [default: a tenth of the largest water]"""
    respect_classes: tuple[int, ...] = option(
        (), least=0, most=255, parse=numbers, metavar="N,N",
        then=lambda found: tuple(sorted({*found})),
    )  # fmt: skip
    """Classes that are never submerged; 2,5,6 are ground, trees and buildings. [default: none]"""


class MaskOption(OptionSet, panel=Panel.WATER):
    """The area in which points may be submerged."""

    water_mask: File | None = option(None, basic=True)
    """Polygons (.gpkg, .shp, .geojson) where points may be submerged. [default: everywhere]"""


class PortOptions(OptionSet, panel=Panel.WATER):
    """The port of an underwater housing."""

    port: Any = option(None, basic=True, metavar="SPEC")
    """Housing port, for images taken under water; replaces --water:
    flat:distance=M[,thickness=M,glass=N,nx=,ny=] or
    dome:radius=M[,thickness=M,glass=N,x=M,y=M,z=M], seen from the projection centre."""


class CameraFileOptions(OptionSet, panel=Panel.CAMERAS):
    """How to read a camera file."""

    sensor: File | None = option(None, with_cameras=True)
    """Interior orientation, if the cameras have none: CSV focal,sensor_x,sensor_y in mm, or a
    Metashape calibration. [default: sensor.csv next to the cameras]"""
    angles: Literal["omega-phi-kappa", "yaw-pitch-roll", "aircraft"] | None = option(
        None, with_cameras=True
    )
    """Angles of a table whose header does not name them; in aircraft, pitch -90 is straight down.
    [default: yaw-pitch-roll]"""
    cameras_crs: str | None = option(None, with_cameras=True, basic=True, metavar="CRS")
    """CRS of the cameras, such as EPSG:25830; 'local' uses the numbers as they are. [default: as
    stated in their file, else that of the cloud]"""
    cameras_offset: tuple[float, float, float] | None = option(
        None, with_cameras=True, parse=numbers, metavar="X,Y,Z"
    )
    """Offset added to the projection centres, for models shifted to the origin. [m]"""


class CamerasOptions(CameraFileOptions, panel=Panel.NEED):
    """The exterior orientation."""

    cameras: Any = option(None, basic=True, metavar="PATH", needed="needed")
    """File or folder of camera poses: Metashape, Pix4D, OPF, ODM, OpenSfM, COLMAP, MicMac, Bundler,
    VisualSFM, BlocksExchange, RealityCapture, or a CSV table."""


class ViewOptions(OptionSet, panel=Panel.CAMERAS):
    """The view list: which images contributed to each point."""

    views: File | None = option(None, with_cameras=True, basic=True)
    """View list: the images that contributed to each point. COLMAP's fused.ply.vis, the dense PLY
    of OpenMVS, or the camera file itself for the tracks of its tie points."""
    views_are: Literal["auto", "tracks", "depth-maps", "pairs"] = option("auto", with_cameras=True)
    """What the images in the view list are: those of a track, of averaged depth maps, or of stereo
    pairs; auto detects it from the cloud."""


class SurveyOptions(ViewOptions, CamerasOptions, NeededOptions, panel=Panel.CAMERAS):
    """Inputs of a correction through a water surface."""

    cameras: Any = option(
        None, basic=True, metavar="PATH", panel=Panel.NEED,
        needed="needed, not with --method factor or regression",
    )  # fmt: skip
    adjusted_from: Any = option(None, with_cameras=True, basic=True, metavar="PATH", needs="water")
    """Original camera file, if --cameras is the output of 'pcfix adjust'. The cloud is first
    transferred to the adjusted poses."""
    check_depths: File | None = option(None, needs="method regression", panel=Panel.METHOD)
    """Measured depths for --method regression: CSV x,y,depth. [m]"""
    tide: File | None = option(None, with_cameras=True, panel=Panel.WATER, needs="water")
    """Tide table, CSV time,level_m: each image gets the water level at its time."""
    image_times: File | None = option(None, with_cameras=True, panel=Panel.WATER, needs="tide")
    """Times of the images, for --tide: CSV label,time, or the folder of the images. [default: as
    stated in the camera file]"""
    salinity: float | None = option(None, panel=Panel.WATER)
    """Salinity of the water, to compute the refractive index. [PSU] [default: 35]"""
    temperature: float | None = option(None, panel=Panel.WATER)
    """Temperature of the water. [deg C] [default: 15]"""
    wavelength: float | None = option(None, panel=Panel.WATER)
    """Wavelength of the light. [um] [default: 0.53]"""


class InputOptions(SurveyOptions, PortOptions):
    """Inputs of any correction: through a water surface, or the port of a housing."""


class BudgetOptions(OptionSet, panel=Panel.BUDGET):
    """Standard deviations of the inputs of a correction; see `pcfix.refract.uncertainty`."""

    sigma_image: float = option(0.5, least=0)
    """Standard deviation of an image coordinate. [px]"""
    sigma_level: float | None = option(None, least=0)
    """Standard deviation of the water level. [m] [default: that of its fit, else 0.02]"""
    sigma_index: float = option(0.002, least=0)
    """Standard deviation of the refractive index."""
    sigma_waves: float = option(0.0, least=0)
    """Standard deviation of the slope of waves, independent for each ray. [deg]"""
    sigma_centre: float = option(0.0, least=0)
    """Standard deviation of a projection centre, along each axis. [m]"""
    sigma_attitude: float = option(0.0, least=0)
    """Standard deviation of the attitude, about each axis. [deg]"""


class BandOption(OptionSet, panel=Panel.INPUT):
    """The band of a raster that has the heights."""

    band: int | None = option(None, least=1)
    """Band with the heights, if the input is a raster with several."""


class OverwriteOption(OptionSet, panel=Panel.OUTPUT):
    """Whether to replace existing files."""

    overwrite: bool = option(False, basic=True)
    """Replace an output that exists."""


class JobOptions(OverwriteOption, panel=Panel.OUTPUT):
    """The number of threads or processes."""

    jobs: int | None = option(None, basic=True, least=1)
    """Number of threads or, for many files, of files processed at once. [default: all cores]"""


class TileOptions(JobOptions, panel=Panel.OUTPUT):
    """The cluster, if the input may be many files."""

    scheduler: str | None = option(None, metavar="ADDRESS")
    """With many files: process them on the cluster of this Dask scheduler, tcp://host:8786."""


class SummaryOption(OptionSet, panel=Panel.OUTPUT):
    """The summary as a file."""

    summary: File | None = option(None, writes=True, basic=True)
    """JSON file for the summary."""

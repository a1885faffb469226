"""Options that several commands share: water, cameras, views, files."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal, TypeAlias

from pcfix.errors import SettingError
from pcfix.options.declare import (
    File,
    OptionSet,
    at_least,
    not_negative,
    one_or_more,
    option,
    positive,
    rule,
    within,
)

ViewsAre = Literal["auto", "tracks", "depth-maps", "pairs"]
Angles = Literal["omega-phi-kappa", "yaw-pitch-roll", "aircraft"]
IndexFormula = Literal["skarlatos", "quan-fry"]
WaterModel = Literal["auto", "level", "plane", "along", "river"]

DEFAULT_REFRACTIVE_INDEX = 1.34


class Panel(StrEnum):
    """The panels of the help, in its order."""

    NEED = "What you need"
    INPUT = "Part of the cloud"
    FLIGHT = "Flight"
    CAMERA = "Camera"
    WATER = "Water"
    CAMERAS = "Cameras"
    METHOD = "Rays and method"
    BUDGET = "Error budget"
    TESTS = "Tests"
    RASTER = "Raster"
    FIGURES = "Figures"
    UNKNOWNS = "What moves, and how much counts"
    CLOUDS = "Clouds"
    ROUNDS = "Rounds"
    EFFECT = "With --refraction-effect"
    OUTPUT = "Output"


_INDEX = within(
    1.0, 1.5, "give the index of water relative to air, about 1.333 for fresh and 1.34 for sea"
    " water", name="refractive index",
)  # fmt: skip


def index_or_name(option: str, text: str) -> float | str:
    """Return a number as one, and the name of a water as it is."""
    try:
        return float(text)
    except ValueError:
        return text


def _three_numbers(option: str, text: str) -> tuple[float, ...]:
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not math.isfinite(x + y + z):
        raise SettingError(
            f"{option} '{text}' must be three numbers X,Y,Z in metres, as 500000,4650000,0."
        )
    return x, y, z


def _classes(option: str, numbers: Any) -> str | None:
    for number in numbers:
        if not 0 <= number <= 255:
            return f"{option}: {number} is no class of LAS; give numbers from 0 to 255."
    return None


Offset: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class IndexOptions(OptionSet):
    """The refractive index of the water."""

    panel = Panel.WATER

    index: float | str | None = option(
        None,
        "Refractive index of the water relative to air: a number, fresh or sea.",
        rule=_INDEX,
        parse=index_or_name,
        default_is=f"{DEFAULT_REFRACTIVE_INDEX:g}",
        metavar="N",
        old=("refractive_index",),
    )
    index_formula: IndexFormula = option(
        "skarlatos",
        "How the index follows from salinity, temperature and wavelength: Skarlatos & Agrafiotis"
        " 2018, eq 13, or Quan & Fry 1995.",
    )

    @property
    def refractive_index(self) -> float:
        """The number; a water's name becomes one by `pcfix.water.index.with_index`."""
        return DEFAULT_REFRACTIVE_INDEX if self.index is None else float(self.index)


@dataclass(frozen=True, kw_only=True)
class WaterOptions(OptionSet):
    """How a water surface is fitted to shoreline points."""

    panel = Panel.WATER

    water_model: WaterModel = option(
        "auto",
        "What is fitted to shoreline points: a level, a plane, one tilted along the points and"
        " level across, or a river; auto chooses among the first three.",
    )
    water_crs: str | None = option(
        None, "CRS of the shoreline points.", default_is="what their file says", metavar="CRS"
    )


@dataclass(frozen=True, kw_only=True)
class WaterPerImageOption(OptionSet):
    """Water that is another for each photograph."""

    panel = Panel.WATER

    water_per_image: File | None = option(
        None,
        "Folder of rasters of the water, each of the name of a photograph, as 'pcfix calm"
        " --surface' writes them; the others go by --water.",
    )


@dataclass(frozen=True, kw_only=True)
class LandRules(OptionSet):
    """Which points below the surface are land all the same."""

    panel = Panel.WATER
    old_units = True

    connected: bool = option(
        False, "Leave out pools that are apart from the water; what was left out is reported."
    )
    least_pool: float | None = option(
        None,
        "With --connected: pools of at least this area stay in.",
        unit="m2",
        rule=not_negative("give square metres"),
        default_is="a tenth of the largest water",
    )
    respect_classes: tuple[int, ...] = option(
        (),
        "Points of these classes are never submerged, as 2,5,6 for ground, trees and buildings.",
        rule=_classes,
        parse=one_or_more(int, "2,5,6"),
        default_is="none",
        metavar="N,N",
    )

    def check(self) -> None:
        """Check what options say together."""
        super().check()
        if self.least_pool is not None and not self.connected:
            raise SettingError("least-pool is of no use without connected; give both, or neither.")
        numbers = tuple(sorted({int(number) for number in self.respect_classes}))
        object.__setattr__(self, "respect_classes", numbers)


@dataclass(frozen=True, kw_only=True)
class SubmergedOptions(LandRules):
    """Where, and which, points may be submerged."""

    panel = Panel.WATER

    water_mask: File | None = option(
        None,
        "Polygons (.gpkg, .shp, .geojson, .wkt) inside which points may be submerged.",
        default_is="everywhere",
    )


@dataclass(frozen=True, kw_only=True)
class CameraFileOptions(OptionSet):
    """How a camera file is read."""

    panel = Panel.CAMERAS
    old_units = True

    sensor: File | None = option(
        None,
        "Interior orientation where the cameras have none: CSV focal,sensor_x,sensor_y in mm, or"
        " a Metashape calibration.",
        default_is="sensor.csv beside the cameras",
    )
    angles: Angles | None = option(
        None,
        "Which angles a table has, where its header cannot say: aircraft means pitch -90 straight"
        " down.",
        default_is="yaw-pitch-roll",
    )
    cameras_crs: str | None = option(
        None,
        "CRS of the cameras, as EPSG:25830; 'local' takes the numbers as they are.",
        default_is="what their file says, else the cloud's",
        metavar="CRS",
    )
    cameras_offset: Offset | None = option(
        None,
        "Added to the projection centres, for models shifted to the origin.",
        unit="m",
        parse=_three_numbers,
        metavar="X,Y,Z",
    )


@dataclass(frozen=True, kw_only=True)
class ViewOptions(OptionSet):
    """Which cameras made each point."""

    panel = Panel.CAMERAS

    views: File | None = option(
        None,
        "Which cameras made each point: COLMAP's fused.ply.vis, the dense PLY of OpenMVS, or the"
        " camera file itself for the tracks of its tie points.",
    )
    views_are: ViewsAre = option(
        "auto",
        "Whether --views lists the images whose rays were intersected, whose depth maps were"
        " averaged, or of whose stereo pairs the median was taken; auto: told by the cloud.",
    )


@dataclass(frozen=True, kw_only=True)
class OverwriteOption(OptionSet):
    """What becomes of files that exist."""

    panel = Panel.OUTPUT

    overwrite: bool = option(False, "Replace an output that exists.")


@dataclass(frozen=True, kw_only=True)
class JobOptions(OverwriteOption):
    """How the work is done."""

    panel = Panel.OUTPUT

    jobs: int | None = option(
        None, "Threads.", rule=at_least(1, "give a number of threads"), default_is="all cores"
    )


def _four_numbers(option: str, text: str) -> tuple[float, ...]:
    try:
        west, south, east, north = (float(word) for word in text.split(","))
    except ValueError:
        west = south = east = north = math.nan
    return west, south, east, north


@dataclass(frozen=True, kw_only=True)
class PartOptions(OptionSet):
    """Which points of a cloud are read; see `pcfix.io.las.part`."""

    panel = Panel.INPUT

    bounds: tuple[float, float, float, float] | None = option(
        None,
        "Read the points within them alone: west, south, east, north. Of COPC no others are"
        " unpacked.",
        unit="m",
        rule=rule(
            lambda box: len(box) == 4 and box[0] <= box[2] and box[1] <= box[3],
            "{option} must be four numbers X0,Y0,X1,Y1 in metres, west and south first, as"
            " 500000,4650000,500100,4650100.",
        ),
        parse=_four_numbers,
        metavar="X,Y,X,Y",
        default_is="all",
    )
    read_resolution: float | None = option(
        None,
        "Of COPC: read its coarse levels alone, with a point in about each square of this side.",
        unit="m",
        rule=positive("read-resolution {value:g} must be above 0: give metres."),
        default_is="all levels",
    )


@dataclass(frozen=True, kw_only=True)
class TileOptions(JobOptions):
    """How the work is done where the input may be many files."""

    panel = Panel.OUTPUT

    jobs: int | None = option(
        None,
        "Threads; of many files so many are worked on at once, each in a process of its own.",
        rule=at_least(1, "give a number of threads"),
        default_is="all cores",
    )
    scheduler: str | None = option(
        None,
        "With many files: work on them on a cluster, by the address of its Dask scheduler, as"
        " tcp://host:8786.",
        metavar="ADDRESS",
    )


@dataclass(frozen=True, kw_only=True)
class SummaryOption(OptionSet):
    """What is told of the work."""

    panel = Panel.OUTPUT

    summary: File | None = option(None, "Write the summary there, as JSON.")


@dataclass(frozen=True, kw_only=True)
class ShorelineOption(OptionSet):
    """Where the line goes at which the water meets the cloud."""

    panel = Panel.OUTPUT

    shoreline: File | None = option(
        None,
        "Write the line where the water meets the cloud there (.gpkg), with its standard error.",
    )


@dataclass(frozen=True, kw_only=True)
class NeededOptions(OptionSet):
    """Where the light bends."""

    panel = Panel.NEED

    water: Any = option(
        None,
        "A level (0.37), plane:a,b,c, dim:NAME, a mesh (.obj, .ply), a raster (.tif), shoreline"
        " points (.csv, .gpkg, .shp, .geojson, .wkt), or auto.",
        metavar="SPEC",
        needed=True,
    )


@dataclass(frozen=True, kw_only=True)
class PortOptions(OptionSet):
    """A housing under water."""

    panel = Panel.WATER

    port: Any = option(
        None,
        "Instead of --water, for a cloud taken under water: the port of the cameras' housing,"
        " flat:distance=M[,thickness=M,glass=N,nx=,ny=] or"
        " dome:radius=M[,thickness=M,glass=N,x=M,y=M,z=M], seen from the projection centre.",
        metavar="SPEC",
    )


_CAMERAS: dict[str, Any] = {
    "help": "File or folder of camera poses: Metashape, Pix4D, OPF, ODM, OpenSfM, COLMAP, MicMac,"
    " Bundler, VisualSFM, BlocksExchange, RealityCapture, or a CSV table.",
    "metavar": "PATH",
    "needed": True,
}


@dataclass(frozen=True, kw_only=True)
class CamerasOptions(OptionSet):
    """The exterior orientation."""

    panel = Panel.NEED

    cameras: Any = option(None, **_CAMERAS)


@dataclass(frozen=True, kw_only=True)
class CamerasOrNoneOptions(OptionSet):
    """The exterior orientation, where the method looks at it."""

    panel = Panel.NEED

    cameras: Any = option(None, default_is="but with --method factor or regression", **_CAMERAS)


@dataclass(frozen=True, kw_only=True)
class TideOptions(OptionSet):
    """Water that moves, and what water it is."""

    panel = Panel.WATER

    tide: File | None = option(
        None, "CSV time,level_m: each image gets the water level of its time."
    )
    image_times: File | None = option(
        None,
        "With --tide: CSV label,time, or the folder of the images.",
        default_is="what the camera file says",
    )
    salinity: float | None = option(None, "Instead of --index.", unit="PSU", default_is="35")
    temperature: float | None = option(None, "Of the water.", unit="deg C", default_is="15")
    wavelength: float | None = option(None, "Of the light.", unit="um", default_is="0.53")


@dataclass(frozen=True, kw_only=True)
class HistoryOptions(OptionSet):
    """What came before the correction."""

    panel = Panel.CAMERAS

    adjusted_from: Any = option(
        None,
        "The cameras that the cloud was made with, where --cameras are the same images adjusted"
        " since: first the whole cloud, land too, is taken from those to these.",
        metavar="PATH",
    )
    check_depths: File | None = option(
        None, "With --method regression: CSV x,y,depth of measured depths, m."
    )
    regression: File | None = option(
        None, "Instead of --check-depths: the line that --save-regression wrote of another cloud."
    )


@dataclass(frozen=True, kw_only=True)
class SurveyOptions(
    HistoryOptions,
    ViewOptions,
    CameraFileOptions,
    TideOptions,
    WaterOptions,
    NeededOptions,
    CamerasOrNoneOptions,
):
    """What a correction through a water surface is made with, as the user names it."""


@dataclass(frozen=True, kw_only=True)
class InputOptions(SurveyOptions, PortOptions):
    """What any correction is made with: through a water surface, or the port of a housing."""

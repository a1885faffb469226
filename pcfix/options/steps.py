"""The options of the steps after a correction, of photographs, and of commands without data."""

import math
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Literal

from pcfix.errors import SettingError
from pcfix.options.declare import File, OptionSet, numbers, option
from pcfix.options.shared import (
    BandOption,
    BudgetOptions,
    CameraFileOptions,
    CamerasOptions,
    IndexOptions,
    JobOptions,
    NeededOptions,
    OverwriteOption,
    Panel,
    SummaryOption,
    TileOptions,
    WaterOptions,
    WaterPerImageOption,
)

LEAST_NEIGHBOURS, MOST_NEIGHBOURS = 6, 500
MAX_HOLE_CELLS = 1000
MIN_RESOLUTION_M = 1e-4

DsmMethod = Literal["mean", "median", "min", "max", "tin"]


class CleanRules(OptionSet, panel=Panel.TESTS):
    """Thresholds of the tests; None switches a test off.

    The fences are those of Tukey (Exploratory Data Analysis, 1977): three interquartile ranges are
    4.7 standard deviations of a normal distribution. Up to a quarter of the neighbours may be noise
    on one side. On a slope, at a wall, or on a rock with a quarter of the neighbours the range is
    as large as the height of the terrain, so no point is flagged there. In a cloud of even spacing,
    the mean distance to the neighbours also flags points at edges and corners.
    """

    statistical: bool = option(True)
    """Test the mean distance to the nearest points in space."""
    neighbours: int = option(20, least=LEAST_NEIGHBOURS, most=MOST_NEIGHBOURS)
    """Number of nearest points in the statistical test, including the point itself."""
    deviations: float | None = option(4.0, above=0)
    """Noise if the mean distance to the neighbours exceeds that of all points by this many standard
    deviations."""
    radius: float | None = option(None, basic=True, above=0)
    """Noise if fewer than --radius-neighbours points are this near. [m] [default: no such test]"""
    radius_neighbours: int = option(3, least=1, most=MOST_NEIGHBOURS)
    """Minimum number of other points within --radius."""
    weak: bool = option(True)
    """Test rays, ray distance and incidence of corrected points."""
    min_rays: int | None = option(3, basic=True, least=2)
    """Noise if a point was corrected from fewer rays."""
    max_ray_miss: float | None = option(0.5, basic=True, above=0)
    """Noise if the ray distance (RayMiss) is larger. [m]"""
    max_incidence: float | None = option(75.0, basic=True, above=0, most=90)
    """Noise if a ray has a larger incidence angle. [deg]"""
    bed_neighbours: int = option(32, least=LEAST_NEIGHBOURS, most=MOST_NEIGHBOURS)
    """Number of nearest submerged points, in plan, from which the bed is estimated."""
    fences: float = option(3.0, above=0)
    """Noise if the height is outside the interquartile range of its neighbours by this many times
    the range, and by more than --below or --floating."""
    below: float | None = option(0.3, off=True, above=0)
    """Minimum distance of noise below the bed. [m]"""
    floating: float | None = option(0.5, basic=True, off=True, above=0)
    """Minimum distance of noise above the bed. [m]"""

    def check(self) -> None:
        """Switch off the limits of tests that are off; at least one test must be on."""
        weak = ("min_rays", "max_ray_miss", "max_incidence")
        for switch, limits in {"statistical": ("deviations",), "weak": weak}.items():
            for name in () if getattr(self, switch) else limits:
                object.__setattr__(self, name, None)
            is_on = any(getattr(self, name) is not None for name in limits)
            object.__setattr__(self, switch, is_on)
        if not (self.statistical or self.radius is not None or self.weak or self.below_or_floating):
            raise SettingError("option.no_test", "All tests are off. Switch at least one on.")

    @property
    def below_or_floating(self) -> bool:
        """Whether any test against the bed runs."""
        return self.below is not None or self.floating is not None

    @property
    def nearest(self) -> int:
        """The number of neighbours in space that are needed, with the point itself; 0 for none."""
        statistical = self.neighbours if self.statistical else 0
        return max(statistical, 0 if self.radius is None else self.radius_neighbours + 1)


class CleanOptions(TileOptions, SummaryOption, CleanRules, panel=Panel.OUTPUT):
    """The options of ``pcfix clean``."""

    water: Any = option(None, basic=True, metavar="SPEC")
    """Water surface, as for 'pcfix correct': points below it are tested against the bed. [default:
    the points that pcfix corrected]"""
    drop: bool = option(False, basic=True)
    """Drop noise instead of giving it class 7 and the withheld flag."""


class DsmRules(OptionSet, panel=Panel.RASTER):
    """How to grid a cloud."""

    resolution: float | None = option(None, basic=True, least=MIN_RESOLUTION_M)
    """Cell size. [m] [default: 2 to 4 points a cell]"""
    what: Literal["height", "depth", "uncertainty"] = option("height")
    """Value of a cell: height; depth (of the bed below the water); or uncertainty (vertical, of the
    bed, at 95 %)."""
    method: DsmMethod = option("mean", basic=True)
    """Gridding method."""
    surface: Literal["all", "bed"] = option("all", basic=True)
    """Grid land and bed without noise, or only the bed (class 40)."""
    fill: float | None = option(None, above=0)
    """Fill holes up to this width; they get count 0. [m]"""

    def check(self) -> None:
        """Check the rules between the value, the surface and the width of holes."""
        if self.what == "uncertainty" and (self.method != "mean" or self.fill is not None):
            sentence = "what uncertainty is the root mean square of the points of a cell. Omit"
            sentence += " --method and --fill."
            raise SettingError("option.excludes", sentence, option="what")
        if self.what in ("depth", "uncertainty"):
            object.__setattr__(self, "surface", "bed")
        most = MAX_HOLE_CELLS * (self.resolution or math.inf)
        if self.fill is not None and self.fill > most:
            sentence = f"fill {self.fill:g} must be at most {most:g}, {MAX_HOLE_CELLS:,} cells."
            sentence += " Use a smaller width, or a coarser resolution."
            values = {"option": "fill", "value": self.fill, "most": most}
            raise SettingError("option.range", sentence, **values)


class DsmOptions(BandOption, OverwriteOption, SummaryOption, DsmRules, panel=Panel.OUTPUT):
    """The options of ``pcfix dsm``."""

    counts: File | None = option(None, writes=True)
    """GeoTIFF for the number of points in each cell, and their spread."""
    style: bool = option(False)
    """Also write a QGIS style (.qml)."""


# Names of the lines of a cross-section; other clouds must have other names.
LAYERS = ("water", "apparent", "corrected", "reference")
_NAME = re.compile(r"[\w .+-]*\w[\w .+-]*")


def _bands(given: Any) -> tuple[tuple[float, ...], ...]:
    """Return the bounds of each share; they may be given as text."""
    bands = list[tuple[float, ...]]()
    for one in given:
        band: tuple[float, ...] = ()
        with suppress(ValueError):
            band = numbers(one) if isinstance(one, str) else tuple(map(float, one))
        if len(band) != 2 or not 0.0 <= band[0] < band[1] < math.inf:
            text = one if isinstance(one, str) else ",".join(map(str, one))
            sentence = f"share '{text}' must be LOW,HIGH: two distances in metres, not negative,"
            sentence += " the lower one first."
            raise SettingError("option.type", sentence, option="share", value=text)
        bands.append(band)
    return tuple(bands)


def _named_clouds(given: Any) -> tuple[tuple[str, str], ...]:
    """Return name and path of each further cloud."""
    found: dict[str, str] = {}
    for one in given.items() if isinstance(given, Mapping) else given:
        text = one if isinstance(one, str) else f"{one[0]}={os.fspath(one[1])}"
        name, _, path = text.partition("=")
        if not (_NAME.fullmatch(name) and path):
            sentence = f"also '{text}' must be NAME=CLOUD. A name has letters, digits, spaces and"
            raise SettingError("option.type", f"{sentence} . + - _", option="also", value=text)
        if name in LAYERS or name in found:
            sentence = f"also '{text}': the name {name} is taken. Give another one."
            raise SettingError("option.name_taken", sentence, option="also", value=name)
        found[name] = path
    return tuple(found.items())


class DistanceOptions(OptionSet, panel=Panel.FIGURES):
    """What a comparison measures in addition to the vertical error.

    `share` has pairs of bounds in metres, and `also` pairs of a name and a path. Both may be given
    as text; `also` may be a dict, too.
    """

    m3c2: bool = option(False, needs="reference")
    """Also compare by M3C2; needs py4dgeo (the extra m3c2)."""
    direction: Literal["to-reference", "from-reference", "both"] | None = option(
        None, needs="reference"
    )
    """C2C from each point of the cloud to the nearest of the reference, the other way round, or
    both. [default: to-reference; from each check point]"""
    share: tuple[Any, ...] = option((), then=_bands, needs="reference", metavar="LOW,HIGH")
    """Report the share of the C2C distances from LOW to HIGH metres; may be repeated."""
    also: tuple[Any, ...] = option(
        (), basic=True, then=_named_clouds, needs="reference", metavar="NAME=CLOUD"
    )
    """Another cloud for the C2C table and the cross-sections; may be repeated."""

    @property
    def from_reference(self) -> bool:
        """Whether C2C is computed from each point of the reference."""
        return self.direction in ("from-reference", "both")


class CompareRules(DistanceOptions, panel=Panel.FIGURES):
    """What a comparison of two clouds measures."""

    submerged: bool = option(False, basic=True)
    """Compare only points of class 40, or below --water."""
    c2c_only: bool = option(False)
    """Compute only distances to the nearest point, no signed differences."""
    neighbours: int = option(8, least=6)
    """Number of reference points in each fitted plane."""
    bin_width: float = option(1.0, above=0)
    """Bin width of the table by depth. [m]"""
    max_gap: float | None = option(None, above=0)
    """Points up to this distance outside the reference are compared. [m] [default: 5 point
    spacings, at least 1]"""
    sections: int = option(0, least=0)
    """Number of automatic cross-sections, down the slope."""
    corridor: float = option(1.0, above=0)
    """Half-width of a cross-section. [m]"""


class CompareOptions(BandOption, OverwriteOption, SummaryOption, CompareRules, panel=Panel.OUTPUT):
    """The options of ``pcfix compare``."""

    out_dir: File | None = option(None, writes=True, basic=True)
    """Folder for compare.json, depth tables and sections (CSV)."""
    water: Any = option(None, basic=True, metavar="SPEC")
    """Water surface, as for 'pcfix correct'. [default: as recorded in the cloud]"""
    section: tuple[Any, ...] = option((), basic=True, metavar="X,Y,X,Y")
    """A cross-section x1,y1,x2,y2; may be repeated."""
    plot: File | None = option(None, writes=True, basic=True)
    """PNG of the C2C histograms, with Gauss curves."""


class ViewerOptions(OverwriteOption, CameraFileOptions, WaterOptions, panel=Panel.OUTPUT):
    """The options of ``pcfix view``."""

    colour: Literal["depth", "shift", "error", "uncertainty", "height"] = option("depth")
    """Value shown by colour; error needs --reference, others need extra dimensions."""
    reference: File | None = option(None, basic=True)
    """LiDAR cloud, CSV check points or GeoTIFF to show, and to compute errors from."""
    cameras: Any = option(None, basic=True, metavar="PATH")
    """Camera poses to show, as for 'pcfix correct'."""
    water: Any = option(None, basic=True, metavar="SPEC")
    """Water surface to show, as for 'pcfix correct'; also for clouds without depths."""
    image: File | None = option(None, writes=True)
    """PNG to draw instead of opening a window."""
    points: int = option(2_000_000, basic=True, least=1)
    """Maximum number of points of each cloud, evenly spread."""


class OrthoOptions(
    JobOptions, SummaryOption, IndexOptions, WaterOptions, CamerasOptions, panel=Panel.NEED
):
    """The options of ``pcfix ortho``."""

    dsm: Any = option(None, basic=True, metavar="PATH", needed="needed")
    """True heights of land and bed: a GeoTIFF, or a corrected cloud (.las, .laz), which is gridded
    to cells twice as wide as those of the orthophoto."""
    resolution: float | None = option(None, basic=True, above=0)
    """Cell size. [m] [default: one ground pixel]"""
    water: Any = option(None, basic=True, metavar="SPEC")
    """Water surface, as for 'pcfix photos'; omit it for photographs without refraction."""


def _command(given: str) -> str:
    """Check that a command has the places for images and cloud."""
    missing = [one for one in ("{images}", "{cloud}") if one not in given]
    if given not in ("stereo", "") and missing:
        sentence = f"rebuild '{given}' has no {' and '.join(missing)}. Use them for the folder that"
        sentence += " the command reads and the cloud that it writes, or give stereo."
        raise SettingError("option.command", sentence, option="rebuild", missing=missing)
    return given


class RebuildOptions(OptionSet, panel=Panel.ROUNDS):
    """Rounds that remove refraction from photographs and reconstruct a cloud from them."""

    rebuild: str | None = option(None, basic=True, then=_command, metavar="COMMAND")
    """Reconstruct the cloud from the photographs, in rounds: stereo (built in), or the command of
    another program. In the command, {images}, {cameras} and {cloud} become the folder of the
    photographs, --cameras and the LAZ file to write."""
    until_gsd: float = option(1.0, above=0)
    """Stop if the mean change of the bed is less than this many ground pixels."""
    most_rounds: int = option(4, least=1)
    """Maximum number of rounds."""


class PhotosOptions(
    WaterPerImageOption, JobOptions, SummaryOption, RebuildOptions, IndexOptions, NeededOptions,
    CamerasOptions, panel=Panel.NEED,
):  # fmt: skip
    """The options of ``pcfix photos``."""

    dsm: Any = option(None, basic=True, metavar="PATH", needed="needed")
    """Heights of land and bed: a GeoTIFF, or a cloud (.las, .laz), which is gridded; corrected for
    --mapping exact, apparent for paper."""
    resolution: float | None = option(None, basic=True, above=0)
    """Cell size to which a cloud is gridded. [m] [default: 2 to 4 points a cell]"""
    mapping: Literal["exact", "paper"] = option("exact", basic=True, panel=Panel.METHOD)
    """exact: trace the light back from the true bed; paper: eq 12 of Skarlatos & Agrafiotis 2018 on
    the apparent bed, one round of their iteration, which ends at too large depths."""


class CalmOptions(JobOptions, SummaryOption, CameraFileOptions, IndexOptions, panel=Panel.WATER):
    """The options of ``pcfix calm``."""

    surface: bool = option(False, basic=True, requires=("depth", "cameras or gsd"))
    """Also estimate the water surface of each frame from the displacement of the bed: rasters in
    OUT_water, for --water-per-image of 'pcfix correct' and 'photos'."""
    depth: Any = option(None, basic=True, metavar="SPEC", needs="surface")
    """With --surface: true depth in metres, or heights of the bed: a GeoTIFF or cloud, which is
    taken as apparent unless pcfix corrected it."""
    level: float = option(0.0)
    """With --surface: height of the calm water. [m]"""
    cameras: Any = option(None, basic=True, metavar="PATH", needs="surface")
    """With --surface: pose of the hovering camera: that of the first frame, or the only one."""
    gsd: float | None = option(None, basic=True, above=0, needs="surface")
    """With --surface, instead of --cameras, for a nadir view: pixel size at the bed. [m]"""
    interval: float | None = option(None, above=0, needs="surface")
    """With --surface: time between frames, before --every. [s] [default: that of a video]"""
    resolution: float | None = option(None, basic=True, above=0)
    """Cell size of the rasters of the water. [m] [default: so that there are 2,000 cells]"""
    every: int = option(1, least=1, most=100_000, panel=Panel.METHOD)
    """Use every Nth frame."""
    still: bool = option(False, panel=Panel.METHOD)
    """The camera did not move, as on a mast: do not align the frames. Otherwise they are aligned
    to the first one by the parts of the image that move least."""


# Commands without data: simulate, demo and plan

BlockKind = Literal["nadir", "oblique"]
BedKind = Literal["shore", "flat", "slope", "steps", "river"]


class FlightOptions(OptionSet, panel=Panel.FLIGHT):
    """The flight."""

    block: BlockKind = option("nadir", basic=True)
    """Only nadir images, or oblique ones too."""
    cameras: int | None = option(None, basic=True, least=9)
    """Approximate number of nadir images; sets the area. [default: as many as the area needs]"""
    flying_height_m: float = option(80.0, least=0.5, most=10_000)
    """Flying height above the water."""
    area_m: tuple[float, float] = option((120.0, 80.0), above=0)
    """Extent along and across the strips."""
    forward_overlap: float = option(0.8, least=0.3, most=0.95)
    """Forward overlap of the images, at the water."""
    side_overlap: float = option(0.7, least=0, most=0.95)
    """Side overlap of the strips, at the water."""
    obliques_deg: float | None = option(None, least=1, most=60)
    """Also fly oblique images, at this angle from nadir. [default: 20 in oblique blocks]"""
    oblique_directions: int = option(4, least=1, most=36)
    """Headings of oblique images, from north."""
    oblique_share: float | None = option(None, least=0.01, most=1)
    """Share of oblique images; 1 for all. [default: each direction a third as dense as nadir]"""
    position_noise_m: float = option(0.0, least=0, most=100)
    """Standard deviation of the given projection centres."""
    attitude_noise_deg: float = option(0.0, least=0, most=5)
    """Standard deviation of the given yaw, pitch and roll."""


class CameraOptions(OptionSet, panel=Panel.CAMERA):
    """The camera and its noise."""

    focal_mm: float = option(8.8, least=0.5, most=2000)
    """Focal length."""
    sensor_mm: tuple[float, float] = option((13.2, 8.8), above=0)
    """Width and height of the sensor; pixels are square."""
    sensor_px: tuple[int, int] = option((5472, 3648), above=0)
    """Width and height of the sensor in pixels."""
    distortion: tuple[float, float, float, float, float] = option((0.0, 0.0, 0.0, 0.0, 0.0))
    """Brown's k1 k2 k3 p1 p2, in Metashape's order; written to the camera file."""
    image_noise: float = option(0.5, least=0, most=100)
    """Standard deviation of image points. [px]"""


class SceneWaterOptions(IndexOptions, panel=Panel.WATER):
    """The water and the ground."""

    water: float = option(0.37, basic=True)
    """Water level in the middle of the area. [m]"""
    tilt_percent: float | None = option(None, least=0, most=20)
    """Slope of the water. [default: 0, for a river 0.3]"""
    tilt_heading_deg: float = option(90.0, least=-360, most=360)
    """Direction in which the water falls, clockwise from north."""
    bed: BedKind = option("shore", basic=True)
    """Shape of the ground."""
    greatest_depth_m: float | None = option(None, least=0.01, most=1000)
    """Greatest depth below the water. [default: shore 12, flat 3, slope 6, steps 6, river 2.5]"""


class SceneCloudOptions(OptionSet, panel=Panel.CLOUDS):
    """The reconstructed cloud and the LiDAR."""

    points: int = option(100_000, basic=True, least=1)
    """Number of points in the cloud."""
    detection: float = option(1.0, least=0.01, most=1)
    """Probability that an image that shows a point contributes to it; at least three do."""
    lidar_per_m2: float = option(2.0, least=0, most=10_000)
    """Number of LiDAR points per m2."""
    lidar_noise_m: float = option(0.05, least=0, most=10)
    """Standard deviation of the LiDAR heights."""
    seed: int = option(1, basic=True, least=0)
    """Seed of the random numbers; each kind of noise has a separate stream."""


class SceneOptions(SceneCloudOptions, SceneWaterOptions, CameraOptions, FlightOptions):
    """The options of a simulated scene."""


class SimulateOptions(OverwriteOption, SceneOptions, panel=Panel.OUTPUT):
    """The options of ``pcfix simulate``."""


class DemoOptions(OverwriteOption, panel=Panel.OUTPUT):
    """The options of ``pcfix demo``."""

    points: int = option(50_000, basic=True)
    """Number of points in each scene."""


class PlanOptions(OverwriteOption, SummaryOption, BudgetOptions, IndexOptions, panel=Panel.FLIGHT):
    """The options of ``pcfix plan``."""

    height: float = option(80.0, least=0.5, most=10_000)
    """Flying height above the water. [m]"""
    overlap: float = option(0.8, least=0.3, most=0.95)
    """Forward overlap of the images, at the water."""
    sidelap: float = option(0.7, least=0, most=0.95)
    """Side overlap of the strips, at the water."""
    obliques: float | None = option(None, least=1, most=60)
    """Also fly oblique images in four directions, this far from nadir. [deg] [default: none]"""
    area: tuple[float, float] = option((120.0, 80.0), above=0, most=1e5)
    """Extent along and across the strips. [m]"""
    lens: tuple[float, float, float, float] = option(
        (8.8, 13.2, 8.8, 5472.0), basic=True, above=0, most=1e6, parse=numbers, metavar="F,W,H,N"
    )
    """Focal length, sensor width and sensor height in mm, and number of pixels along the width."""
    depth: tuple[float, ...] = option(
        (0.5, 1.0, 2.0, 3.0, 5.0), basic=True, above=0, parse=numbers, metavar="M,M"
    )
    """Depths of the bed. [m]"""
    gnss_sigma: float = option(0.03, above=0)
    """Standard deviation of GNSS positions of the images, along each axis. [m]"""

"""The options of commands without data: simulate, demo and plan."""

from __future__ import annotations

from typing import Literal

from pcfix.options.correct import BudgetOptions
from pcfix.options.declare import OptionSet, numbers, option
from pcfix.options.shared import IndexOptions, OverwriteOption, Panel, SummaryOption

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

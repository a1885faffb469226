"""The options of simulated scenes: simulate and demo."""

from __future__ import annotations

import math
from typing import Literal

from pcfix.errors import SettingError
from pcfix.options.declare import OptionSet, numbers, option
from pcfix.options.shared import IndexOptions, OverwriteOption, Panel

BlockKind = Literal["nadir", "oblique"]
BedKind = Literal["shore", "flat", "slope", "steps", "river"]
CloudKind = Literal["tracks", "pairs", "depth-maps"]

_MOST_DEPTHS = 100


class FlightOptions(OptionSet, panel=Panel.FLIGHT):
    """How the block is flown."""

    block: BlockKind = option("nadir", "Only nadir images, or oblique ones too.")
    cameras: int | None = option(
        None,
        "Approximate number of nadir images, from which the area follows.",
        least=9,
        default_is="as the area needs",
    )
    flying_height_m: float = option(80.0, "Flying height above the water.", least=0.5, most=10_000)
    area_m: tuple[float, float] = option(
        (120.0, 80.0), "Extent along and across the strips.", above=0
    )
    forward_overlap: float = option(
        0.8, "Forward overlap of the images, at the water.", least=0.3, most=0.95
    )
    side_overlap: float = option(
        0.7, "Side overlap of the strips, at the water.", least=0, most=0.95
    )
    obliques_deg: float | None = option(
        None,
        "Also fly oblique images, at this angle from nadir.",
        least=1,
        most=60,
        default_is="20 in oblique blocks",
    )
    oblique_directions: int = option(4, "Headings of oblique images, from north.", least=1, most=36)
    oblique_share: float | None = option(
        None,
        "Share of oblique images; 1 for all.",
        least=0.01,
        most=1,
        default_is="each direction a third as dense as the nadir images",
    )
    position_noise_m: float = option(
        0.0, "Standard deviation of the given projection centres.", least=0, most=100
    )
    attitude_noise_deg: float = option(
        0.0, "Standard deviation of the given yaw, pitch and roll.", least=0, most=5
    )


class CameraOptions(OptionSet, panel=Panel.CAMERA):
    """The camera, and how well it measures."""

    focal_mm: float = option(8.8, "Focal length.", least=0.5, most=2000)
    sensor_mm: tuple[float, float] = option(
        (13.2, 8.8), "Width and height of the sensor; pixels are square.", above=0
    )
    sensor_px: tuple[int, int] = option((5472, 3648), "The same in pixels.", above=0)
    distortion: tuple[float, float, float, float, float] = option(
        (0.0, 0.0, 0.0, 0.0, 0.0),
        "Brown's k1 k2 k3 p1 p2, in Metashape's order; all are in the camera file.",
    )
    image_noise: float = option(
        0.5, "Standard deviation of image points.", unit="px", least=0, most=100
    )


class SceneWaterOptions(IndexOptions, panel=Panel.WATER):
    """The water and the ground."""

    water: float = option(0.37, "Water level in the middle of the area.", unit="m")
    wave_slope_deg: float = option(
        0.0, "Standard deviation of the slope of waves, along an axis.", least=0, most=10
    )
    wave_length_m: float = option(1.0, "Length of waves.", least=0.01, most=1000)
    tilt_percent: float | None = option(
        None, "Slope of the water.", least=0, most=20, default_is="0, of a river 0.3"
    )
    tilt_heading_deg: float = option(
        90.0, "Direction in which it falls, clockwise from north.", least=-360, most=360
    )
    bed: BedKind = option("shore", "Shape of the ground.")
    greatest_depth_m: float | None = option(
        None,
        "Greatest depth below the water.",
        least=0.01,
        most=1000,
        default_is="shore 12, flat 3, slope 6, steps 6, river 2.5",
    )


class SceneCloudOptions(OptionSet, panel=Panel.CLOUDS):
    """The cloud that is reconstructed from the images, and the LiDAR."""

    points: int = option(100_000, "Points of the cloud.", least=1)
    cloud: CloudKind = option(
        "tracks", "Reconstruction type: tracks, the median of stereo pairs, or fused depth maps."
    )
    detection: float = option(
        1.0,
        "Probability that an image that shows a point contributes to it; at least three do.",
        least=0.01,
        most=1,
    )
    neighbours: int | None = option(
        None,
        "Images with which each is matched.",
        least=1,
        most=20,
        default_is="pairs 4, depth-maps 5",
    )
    lidar_per_m2: float = option(2.0, "Points of the LiDAR per m2.", least=0, most=10_000)
    lidar_noise_m: float = option(0.05, "Standard deviation of its heights.", least=0, most=10)
    seed: int = option(
        1,
        "Seed of the random numbers. Each kind of noise has its own, so that one more changes"
        " neither terrain nor block.",
        least=0,
    )


class SceneOptions(SceneCloudOptions, SceneWaterOptions, CameraOptions, FlightOptions):
    """The options of a simulated scene."""


def depth_series(option: str, text: str) -> tuple[float, ...]:
    """Return the depths of a list, or of FROM:TO:STEP with TO where a step ends there."""
    if ":" not in text:
        return numbers(option, text)
    try:
        first, last, step = (float(word) for word in text.split(":"))
    except ValueError:
        first = last = step = math.nan
    count = (last - first) / step + 1.0 + 1e-9 if step > 0.0 else math.nan
    if not (first <= last and 1.0 <= count < _MOST_DEPTHS + 1):
        raise SettingError(
            "option.type",
            f"{option} {text} must be FROM:TO:STEP upwards, with at most {_MOST_DEPTHS} depths.",
            option=option.replace("-", "_"),
            value=text,
        )
    return tuple(round(first + i * step, 9) for i in range(int(count)))


class SimulateOptions(OverwriteOption, SceneOptions, panel=Panel.OUTPUT):
    """The options of ``pcfix simulate``."""


class DemoOptions(OverwriteOption, panel=Panel.OUTPUT):
    """The options of ``pcfix demo``."""

    points: int = option(50_000, "Points of each scene.")

"""The options of made-up scenes: simulate, demo, and the effect of refraction on a stereo pair."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from pcfix.errors import SettingError
from pcfix.options.declare import OptionSet, Rule, at_least, option, rule
from pcfix.options.shared import IndexOptions, OverwriteOption, Panel

BlockKind = Literal["nadir", "oblique"]
BedKind = Literal["shore", "flat", "slope", "steps", "river"]
CloudKind = Literal["tracks", "pairs", "depth-maps"]


_MOST_DEPTHS = 100
_UNITS = {"m": " m", "mm": " mm", "deg": " deg", "percent": " %"}


def _range(least: float, most: float, what: str, subject: str = "") -> Rule:
    """Return the rule of a range, and what it is of: the option with its unit, or a `subject`."""

    def check(option: str, value: Any) -> str | None:
        if least <= value <= most:
            return None
        name, _, unit = option.rpartition("-")
        name, unit = (name, _UNITS[unit]) if unit in _UNITS else (option, "")
        found = (subject or name.replace("-", " ") + " {:g}" + unit).format(value)
        if least == 0 and value < 0:
            return f"{found} is negative: give {what}."
        return f"{found} is outside {least:g} to {most:g}: give {what}."

    return check


def _numbers(count: int, *, above_zero: bool = True) -> Rule:
    """Return the rule of so many finite numbers."""

    def rule(option: str, values: Any) -> str | None:
        name = option.replace("-", "_")
        if len(values) != count or not all(abs(value) < float("inf") for value in values):
            return f"{name} {values} must be {count} finite numbers."
        if above_zero and min(values) <= 0:
            return f"{name} {values} must be positive: width and height."
        return None

    return rule


@dataclass(frozen=True, kw_only=True)
class FlightOptions(OptionSet):
    """How the block is flown."""

    panel = Panel.FLIGHT

    block: BlockKind = option("nadir", "Nadir images only, or obliques too.")
    cameras: int | None = option(
        None,
        "About so many nadir images; the area grows or shrinks with it.",
        rule=at_least(9, "a block needs some overlap"),
        default_is="as the area needs",
    )
    flying_height_m: float = option(
        80.0, "Above the water.", rule=_range(0.5, 10_000, "the height above the water")
    )
    area_m: tuple[float, float] = option(
        (120.0, 80.0), "Extent along and across the strips.", rule=_numbers(2)
    )
    forward_overlap: float = option(
        0.8,
        "Share of an image in the next, at the water.",
        rule=_range(0.3, 0.95, "the share of an image in the next"),
    )
    side_overlap: float = option(
        0.7,
        "Share of a strip in the next, at the water.",
        rule=_range(0.0, 0.95, "the share of a strip in the next"),
    )
    obliques_deg: float | None = option(
        None,
        "Fly obliques at this angle from straight down.",
        rule=_range(1, 60, "the angle from straight down"),
        default_is="20 in oblique blocks",
    )
    oblique_directions: int = option(
        4, "Headings of obliques, from north.", rule=_range(1, 36, "how many ways obliques look")
    )
    oblique_share: float | None = option(
        None,
        "Share of the images that are obliques, 1: all.",
        rule=_range(0.01, 1.0, "the share of images that are obliques"),
        default_is="each direction a third as dense as the nadir images",
    )
    position_noise_m: float = option(
        0.0,
        "Error (sd) of the projection centres given.",
        rule=_range(0, 100, "a standard deviation"),
    )
    attitude_noise_deg: float = option(
        0.0, "Error (sd) of the yaw, pitch, roll given.", rule=_range(0, 5, "a standard deviation")
    )


@dataclass(frozen=True, kw_only=True)
class CameraOptions(OptionSet):
    """The camera, and how well it measures."""

    panel = Panel.CAMERA
    old_units = True

    focal_mm: float = option(
        8.8, "Focal length.", rule=_range(0.5, 2000, "that of the lens", "focal length {:g} mm")
    )
    sensor_mm: tuple[float, float] = option(
        (13.2, 8.8), "Width and height of the sensor; pixels are square.", rule=_numbers(2)
    )
    sensor_px: tuple[int, int] = option((5472, 3648), "The same in pixels.", rule=_numbers(2))
    distortion: tuple[float, float, float, float, float] = option(
        (0.0, 0.0, 0.0, 0.0, 0.0),
        "Brown's k1 k2 k3 p1 p2, in Metashape's order; all known to the user.",
        rule=_numbers(5, above_zero=False),
    )
    image_noise: float = option(
        0.5,
        "Noise of image points (sd).",
        unit="px",
        rule=_range(0, 100, "a standard deviation", "image noise {:g} px"),
    )


@dataclass(frozen=True, kw_only=True)
class SceneWaterOptions(IndexOptions):
    """The water and the ground."""

    panel = Panel.WATER

    water: float = option(
        0.37,
        "Water level, mid area.",
        unit="m",
        rule=rule(
            lambda value: abs(value) < math.inf, "water level {value} must be a finite height, m."
        ),
        old=("water_level_m",),
    )
    wave_slope_deg: float = option(
        0.0,
        "Slope (sd, along an axis) of waves.",
        rule=_range(0, 10, "the standard deviation along one axis"),
    )
    wave_length_m: float = option(
        1.0, "Of waves.", rule=_range(0.01, 1000, "from crest to crest", "wavelength {:g} m")
    )
    tilt_percent: float | None = option(
        None,
        "How steeply the water falls.",
        rule=_range(0, 20, "how far the water falls in 100 m"),
        default_is="0, of a river 0.3",
    )
    tilt_heading_deg: float = option(
        90.0,
        "Where it falls to, clockwise from north.",
        rule=_range(-360, 360, "where the water falls to, from north"),
    )
    bed: BedKind = option("shore", "Shape of the ground.")
    greatest_depth_m: float | None = option(
        None,
        "Below the water.",
        rule=_range(0.01, 1000, "metres below the water"),
        default_is="shore 12, flat 3, slope 6, steps 6, river 2.5",
    )


@dataclass(frozen=True, kw_only=True)
class SceneCloudOptions(OptionSet):
    """The cloud that is made of the images, and the LiDAR."""

    panel = Panel.CLOUDS

    points: int = option(
        100_000,
        "Points of the cloud.",
        rule=rule(lambda value: value >= 1, "points {value} is less than 1."),
    )
    cloud: CloudKind = option(
        "tracks", "Of all images at once, the median of stereo pairs, or fused depth maps."
    )
    detection: float = option(
        1.0,
        "Probability that an image that shows a point takes part; three at least do.",
        rule=_range(0.01, 1.0, "a probability"),
    )
    neighbours: int | None = option(
        None,
        "Images that each is matched with.",
        rule=_range(1, 20, "how many images each is matched with"),
        default_is="pairs 4, depth-maps 5",
    )
    lidar_per_m2: float = option(
        2.0,
        "Points of the LiDAR per m2.",
        rule=_range(0, 10_000, "points per square metre", "lidar density {:g} points/m2"),
    )
    lidar_noise_m: float = option(
        0.05, "Error (sd) of its heights.", rule=_range(0, 10, "a standard deviation")
    )
    seed: int = option(
        1,
        "Of the random numbers; each kind of noise has its own, so that switching one on changes"
        " neither terrain nor block.",
        rule=rule(
            lambda value: not value < 0, "seed {value} is negative: give a whole number from 0."
        ),
    )


@dataclass(frozen=True, kw_only=True)
class SceneOptions(SceneCloudOptions, SceneWaterOptions, CameraOptions, FlightOptions):
    """What a simulated scene can be asked for."""


def _effect_numbers(option: str, text: str, most: int = 6) -> tuple[float, ...]:
    try:
        found = tuple(dict.fromkeys(float(word) for word in text.split(",")))
    except ValueError:
        raise SettingError(f"--{option} {text} is not a list of numbers, as 50,100.") from None
    if len(found) > most:
        raise SettingError(f"--{option} {text} has {len(found)} numbers; give {most} at most.")
    return found


def depth_series(option: str, text: str) -> tuple[float, ...]:
    """Return the depths of a list, or of FROM:TO:STEP with TO where a step ends there."""
    if ":" not in text:
        return _effect_numbers(option, text, _MOST_DEPTHS)
    try:
        first, last, step = (float(word) for word in text.split(":"))
    except ValueError:
        first = last = step = math.nan
    if not (-math.inf < first <= last < math.inf and 0.0 < step < math.inf):
        raise SettingError(
            f"--{option} {text} is not FROM:TO:STEP upwards with a step above 0, as 0:15:1."
        )
    count = (last - first) / step + 1.0 + 1e-9
    if count >= _MOST_DEPTHS + 1:
        raise SettingError(
            f"--{option} {text} has {count:.0f} depths; give {_MOST_DEPTHS} at most."
        )
    return tuple(round(first + i * step, 9) for i in range(int(count)))


_SEVERAL = rule(
    lambda value: isinstance(value, tuple), "{option} {value} is no list: give it as ({value},)."
)


def _frame(option: str, text: str) -> tuple[int, int]:
    try:
        width, height = (int(side) for side in text.lower().split("x"))
    except ValueError:
        raise SettingError(
            f"--{option} {text} is not WIDTHxHEIGHT in pixels, as 4000x3000."
        ) from None
    return width, height


@dataclass(frozen=True, kw_only=True)
class EffectOptions(OptionSet):
    """A pair of vertical images, and how far refraction puts its points wrong."""

    panel = Panel.EFFECT

    effect_focal_mm: float | None = option(
        None,
        "Focal length of a camera of your own, with --effect-frame-px and --effect-pixel-um.",
        default_is="the paper's two cameras",
    )
    effect_frame_px: tuple[int, int] | None = option(
        None,
        "Its frame, as 4000x3000; the height is flown along.",
        parse=_frame,
        metavar="WIDTHxHEIGHT",
    )
    effect_pixel_um: float | None = option(None, "Its pixel size.")
    effect_overlap: tuple[float, ...] | None = option(
        None,
        "Overlaps of the two images, 0 to 1.",
        rule=_SEVERAL,
        parse=_effect_numbers,
        default_is="0.8; UltraCamX 0.6,0.8",
        metavar="N,N",
    )
    effect_heights: tuple[float, ...] | None = option(
        None,
        "Above the water, metres.",
        rule=_SEVERAL,
        parse=_effect_numbers,
        default_is="100,200; UltraCamX 1000,3000; your own 50,100,200",
        metavar="M,M",
    )
    effect_depths: tuple[float, ...] | None = option(
        None,
        "Depths that the cloud shows, metres: a list, or FROM:TO:STEP; maps are of the largest.",
        rule=_SEVERAL,
        parse=depth_series,
        default_is="0:15:1",
        metavar="M,M",
    )


@dataclass(frozen=True, kw_only=True)
class SimulateOptions(OverwriteOption, EffectOptions, SceneOptions):
    """The options of ``pcfix simulate``."""

    panel = Panel.OUTPUT

    refraction_effect: bool = option(
        False,
        "No scene, but how far refraction puts points wrong in a pair of vertical images"
        " (Skarlatos & Agrafiotis 2018, Figures 4 to 6): surfaces, maps, tables. Of the paper's"
        " cameras with n = 1.3405, which fits its figures, if no --index is given.",
    )

    def check(self) -> None:
        """Refuse options that say nothing without --refraction-effect."""
        super().check()
        given = [name for name in self.plain() if name.startswith("effect_")]
        if given and not self.refraction_effect:
            flag = given[0].replace("_", "-")
            raise SettingError(f"--{flag} goes with --refraction-effect; add it or leave it out.")


@dataclass(frozen=True, kw_only=True)
class DemoOptions(OverwriteOption):
    """The options of ``pcfix demo``."""

    panel = Panel.OUTPUT

    points: int = option(50_000, "Points of each scene.")

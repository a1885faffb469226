"""The options of what goes before the flight and after the correction: plan, view, the plugin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from pcfix.errors import SettingError
from pcfix.options.correct import BudgetOptions
from pcfix.options.declare import File, OptionSet, at_least, option, positive, rule, within
from pcfix.options.scenes import depth_series
from pcfix.options.shared import (
    CameraFileOptions,
    IndexOptions,
    OverwriteOption,
    Panel,
    SummaryOption,
    WaterOptions,
)

Colour = Literal["depth", "shift", "error", "uncertainty", "height"]


def _lens(name: str, text: str) -> tuple[float, ...]:
    try:
        focal, width, height, pixels = (float(word) for word in text.split(","))
    except ValueError:
        focal = width = height = pixels = -1.0
    if not all(0.0 < value < 1e6 for value in (focal, width, height, pixels)):
        raise SettingError(
            f"{name} '{text}' is not FOCAL,WIDTH,HEIGHT,PIXELS: focal length, width and height of"
            " the sensor in mm, and the pixels along its width, as 8.8,13.2,8.8,5472."
        )
    return focal, width, height, pixels


def _depths(name: str, text: str) -> tuple[float, ...]:
    """Return the depths of a list; a single one is the greatest of five."""
    found = depth_series(name, text)
    if len(found) == 1:
        found = tuple(found[0] * share for share in (0.2, 0.4, 0.6, 0.8, 1.0))
    return found


_DEPTHS = rule(
    lambda value: bool(value) and min(value) > 0.0,
    "{option} {value} must be above 0: give metres below the water.",
)
_AREA = rule(
    lambda value: len(value) == 2 and min(value) > 0.0 and max(value) <= 1e5,
    "{option} {value} must be two numbers above 0 and at most 100000: metres along the strips and"
    " across.",
)


@dataclass(frozen=True, kw_only=True)
class PlannedFlightOptions(OptionSet):
    """A flight to come."""

    panel = Panel.FLIGHT

    height: float = option(
        80.0, "Above the water.", unit="m", rule=within(0.5, 10_000, "give metres above the water")
    )
    overlap: float = option(
        0.8,
        "Share of an image in the next, at the water.",
        rule=within(0.3, 0.95, "give a share, as 0.8"),
    )
    sidelap: float = option(
        0.7,
        "Share of a strip in the next, at the water.",
        rule=within(0.0, 0.95, "give a share, as 0.7"),
    )
    obliques: float | None = option(
        None,
        "Fly obliques too, to four sides, at this angle from straight down.",
        unit="deg",
        rule=within(1, 60, "give degrees from straight down"),
        default_is="none",
    )
    area: tuple[float, float] = option(
        (120.0, 80.0), "Extent along and across the strips.", unit="m", rule=_AREA
    )
    lens: tuple[float, ...] = option(
        (8.8, 13.2, 8.8, 5472.0),
        "Focal length, width and height of the sensor in mm, pixels along its width.",
        parse=_lens,
        default_is="8.8,13.2,8.8,5472",
        metavar="F,W,H,N",
    )
    depth: tuple[float, ...] = option(
        (0.5, 1.0, 2.0, 3.0, 5.0),
        "Of the bed: the greatest, a list, or FROM:TO:STEP.",
        unit="m",
        rule=_DEPTHS,
        parse=_depths,
        default_is="0.5,1,2,3,5",
        metavar="M,M",
    )
    gnss_sigma: float = option(
        0.03,
        "Of GNSS positions of the images, each axis.",
        unit="m",
        rule=positive("gnss-sigma {value:g} must be above 0: give a standard deviation."),
    )


@dataclass(frozen=True, kw_only=True)
class PlanOptions(
    OverwriteOption, SummaryOption, BudgetOptions, IndexOptions, PlannedFlightOptions
):
    """The options of ``pcfix plan``."""

    panel = Panel.OUTPUT

    plot: File | None = option(None, "PNG of the block and of the errors by depth.")


@dataclass(frozen=True, kw_only=True)
class ViewerOptions(OverwriteOption, CameraFileOptions, WaterOptions):
    """The options of ``pcfix view``."""

    panel = Panel.OUTPUT

    colour: Colour = option(
        "depth", "What the colours are; error goes with --reference, the others by dimensions."
    )
    reference: File | None = option(
        None, "LiDAR cloud, CSV check points or GeoTIFF to show beside, and to measure errors from."
    )
    cameras: Any = option(None, "Camera poses to show, as of 'pcfix correct'.", metavar="PATH")
    water: Any = option(
        None,
        "Water to show, as of 'pcfix correct'; depths of clouds that do not have them go by it.",
        metavar="SPEC",
    )
    image: File | None = option(None, "PNG to draw instead of opening a window.")
    points: int = option(
        2_000_000, "Of each cloud at most, evenly spread.", rule=at_least(1, "show some points")
    )


@dataclass(frozen=True, kw_only=True)
class PluginOptions(OverwriteOption):
    """The options of ``pcfix qgis-plugin``."""

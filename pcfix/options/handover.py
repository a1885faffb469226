"""The options of what comes before the flight and after the correction: plan, view, the plugin."""

from __future__ import annotations

from typing import Any, Literal

from pcfix.options.correct import BudgetOptions
from pcfix.options.declare import File, OptionSet, numbers, option
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


def _depths(name: str, text: str) -> tuple[float, ...]:
    """Return the depths of a list; a single one is the greatest of five."""
    found = depth_series(name, text)
    if len(found) == 1:
        found = tuple(found[0] * share for share in (0.2, 0.4, 0.6, 0.8, 1.0))
    return found


class PlannedFlightOptions(OptionSet, panel=Panel.FLIGHT):
    """A planned flight."""

    height: float = option(80.0, "Flying height above the water.", unit="m", least=0.5, most=10_000)
    overlap: float = option(
        0.8, "Forward overlap of the images, at the water.", least=0.3, most=0.95
    )
    sidelap: float = option(0.7, "Side overlap of the strips, at the water.", least=0, most=0.95)
    obliques: float | None = option(
        None,
        "Also fly oblique images, to four sides, at this angle from nadir.",
        unit="deg",
        least=1,
        most=60,
        default_is="none",
    )
    area: tuple[float, float] = option(
        (120.0, 80.0), "Extent along and across the strips.", unit="m", above=0, most=1e5
    )
    lens: tuple[float, float, float, float] = option(
        (8.8, 13.2, 8.8, 5472.0),
        "Focal length, width and height of the sensor in mm, pixels along its width.",
        above=0,
        most=1e6,
        parse=numbers,
        metavar="F,W,H,N",
    )
    depth: tuple[float, ...] = option(
        (0.5, 1.0, 2.0, 3.0, 5.0),
        "Depths of the bed: the greatest, a list, or FROM:TO:STEP.",
        unit="m",
        above=0,
        parse=_depths,
        metavar="M,M",
    )
    gnss_sigma: float = option(
        0.03, "Standard deviation of GNSS positions of the images, each axis.", unit="m", above=0
    )


class PlanOptions(
    OverwriteOption,
    SummaryOption,
    BudgetOptions,
    IndexOptions,
    PlannedFlightOptions,
    panel=Panel.OUTPUT,
):
    """The options of ``pcfix plan``."""

    plot: File | None = option(None, "PNG of the block and of the errors by depth.")


class ViewerOptions(OverwriteOption, CameraFileOptions, WaterOptions, panel=Panel.OUTPUT):
    """The options of ``pcfix view``."""

    colour: Colour = option(
        "depth", "Value shown by colour; error needs --reference, others need extra dimensions."
    )
    reference: File | None = option(
        None, "LiDAR cloud, CSV check points or GeoTIFF to show, and to compute errors from."
    )
    cameras: Any = option(None, "Camera poses to show, as for 'pcfix correct'.", metavar="PATH")
    water: Any = option(
        None,
        "Water surface to show, as for 'pcfix correct'; also for depths of clouds without them.",
        metavar="SPEC",
    )
    image: File | None = option(None, "PNG to draw instead of opening a window.")
    points: int = option(
        2_000_000, "Maximum number of points of each cloud, evenly spread.", least=1
    )


class PluginOptions(OverwriteOption):
    """The options of ``pcfix qgis-plugin``."""

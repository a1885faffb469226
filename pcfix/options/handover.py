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

    height: float = option(80.0, unit="m", least=0.5, most=10_000)
    """Flying height above the water."""
    overlap: float = option(0.8, least=0.3, most=0.95)
    """Forward overlap of the images, at the water."""
    sidelap: float = option(0.7, least=0, most=0.95)
    """Side overlap of the strips, at the water."""
    obliques: float | None = option(None, unit="deg", least=1, most=60, default_is="none")
    """Also fly oblique images, to four sides, at this angle from nadir."""
    area: tuple[float, float] = option((120.0, 80.0), unit="m", above=0, most=1e5)
    """Extent along and across the strips."""
    lens: tuple[float, float, float, float] = option(
        (8.8, 13.2, 8.8, 5472.0), basic=True, above=0, most=1e6, parse=numbers, metavar="F,W,H,N"
    )
    """Focal length, width and height of the sensor in mm, pixels along its width."""
    depth: tuple[float, ...] = option(
        (0.5, 1.0, 2.0, 3.0, 5.0), basic=True, unit="m", above=0, parse=_depths, metavar="M,M"
    )
    """Depths of the bed: the greatest, a list, or FROM:TO:STEP."""
    gnss_sigma: float = option(0.03, unit="m", above=0)
    """Standard deviation of GNSS positions of the images, each axis."""


class PlanOptions(
    OverwriteOption,
    SummaryOption,
    BudgetOptions,
    IndexOptions,
    PlannedFlightOptions,
    panel=Panel.OUTPUT,
):
    """The options of ``pcfix plan``."""

    plot: File | None = option(None, basic=True)
    """PNG of the block and of the errors by depth."""


class ViewerOptions(OverwriteOption, CameraFileOptions, WaterOptions, panel=Panel.OUTPUT):
    """The options of ``pcfix view``."""

    colour: Colour = option("depth")
    """Value shown by colour; error needs --reference, others need extra dimensions."""
    reference: File | None = option(None, basic=True)
    """LiDAR cloud, CSV check points or GeoTIFF to show, and to compute errors from."""
    cameras: Any = option(None, basic=True, metavar="PATH")
    """Camera poses to show, as for 'pcfix correct'."""
    water: Any = option(None, basic=True, metavar="SPEC")
    """Water surface to show, as for 'pcfix correct'; also for depths of clouds without them."""
    image: File | None = option(None)
    """PNG to draw instead of opening a window."""
    points: int = option(2_000_000, basic=True, least=1)
    """Maximum number of points of each cloud, evenly spread."""


class PluginOptions(OverwriteOption):
    """The options of ``pcfix qgis-plugin``."""

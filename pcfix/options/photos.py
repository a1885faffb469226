"""The options of photographs: photos, ortho and calm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from pcfix.options.declare import OptionSet, must_be, option
from pcfix.options.shared import (
    CameraFileOptions,
    CamerasOptions,
    IndexOptions,
    JobOptions,
    NeededOptions,
    Panel,
    SummaryOption,
    WaterOptions,
)
from pcfix.options.steps import METRES

Mapping = Literal["exact", "paper"]
Holes = Literal["fill", "black"]


@dataclass(frozen=True, kw_only=True)
class MappingRules(OptionSet):
    """How a photograph is resampled."""

    panel = Panel.METHOD

    mapping: Mapping = option(
        "exact",
        "exact: light is traced back from the true bed; paper: eq 12 of Skarlatos & Agrafiotis"
        " 2018 on the apparent bed, a round of their iteration.",
    )
    spacing: int | None = option(
        None,
        "Between the nodes of the grid over the photograph.",
        unit="px",
        rule=must_be(1, 512, "give pixels from 1 to 512", whole=True),
        default_is="a cell of the DSM, and 4 px at least",
    )
    holes: Holes = option(
        "fill", "Holes of the DSM: interpolated from around them, or black in the photographs."
    )


@dataclass(frozen=True, kw_only=True)
class GroundOptions(OptionSet):
    """The ground under the photographs."""

    panel = Panel.NEED

    dsm: Any = option(
        None,
        "Heights of land and bed: a GeoTIFF, or a cloud (.las, .laz), which is gridded; corrected"
        " for the mapping exact, as it came for paper.",
        metavar="PATH",
        needed=True,
    )
    resolution: float | None = option(
        None,
        "Of the raster that a cloud is gridded to.",
        unit="m",
        rule=METRES,
        default_is="two ground pixels",
    )


@dataclass(frozen=True, kw_only=True)
class OrthoRules(OptionSet):
    """What an orthophoto is made of."""

    panel = Panel.NEED

    dsm: Any = option(
        None,
        "Heights of land and bed where they are: a GeoTIFF, or a cloud (.las, .laz) that was"
        " corrected, which is gridded to cells twice as wide as those of the orthophoto.",
        metavar="PATH",
        needed=True,
    )
    resolution: float | None = option(
        None, "Side of a cell.", unit="m", rule=METRES, default_is="a ground pixel"
    )
    water: Any = option(
        None,
        "For photographs as they were taken: the water surface, as of 'pcfix photos'; without it"
        " they are photographs without water.",
        metavar="SPEC",
    )


@dataclass(frozen=True, kw_only=True)
class OrthoOptions(
    JobOptions,
    SummaryOption,
    CameraFileOptions,
    IndexOptions,
    WaterOptions,
    OrthoRules,
    CamerasOptions,
):
    """The options of ``pcfix ortho``."""


@dataclass(frozen=True, kw_only=True)
class PhotosOptions(
    JobOptions,
    SummaryOption,
    MappingRules,
    CameraFileOptions,
    IndexOptions,
    WaterOptions,
    GroundOptions,
    NeededOptions,
    CamerasOptions,
):
    """The options of ``pcfix photos``."""

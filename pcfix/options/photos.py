"""The options of photographs: photos, ortho and calm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from pcfix.errors import SettingError
from pcfix.options.declare import File, OptionSet, at_least, must_be, option, positive
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
class RebuildOptions(OptionSet):
    """Rounds of photographs without water and clouds from them."""

    panel = Panel.ROUNDS

    rebuild: str | None = option(
        None,
        "After the photographs the cloud is made again, and so on in rounds: stereo, pairs matched"
        " by pcfix itself, or a command of another program, in which {images}, {cameras} and"
        " {cloud} stand for the folder of the photographs, --cameras and the LAZ file to write.",
        metavar="COMMAND",
    )
    until_gsd: float = option(
        1.0,
        "Stop when the bed moves by less than so many ground pixels, on average.",
        rule=positive("{option} {value:g} is not positive; 1 is usual."),
    )
    most_rounds: int = option(4, "Stop after so many rounds.", rule=at_least(1, "4 are usual"))
    reference: File | None = option(
        None, "With --rebuild: 'pcfix compare' the clouds of all rounds with it, in OUT/compare."
    )

    def check(self) -> None:
        """Check what options say together."""
        super().check()
        if self.rebuild is None and self.reference is not None:
            raise SettingError("reference is of no use without rebuild; give both, or neither.")
        command = self.rebuild or "stereo"
        lacking = [one for one in ("{images}", "{cloud}") if one not in command]
        if command != "stereo" and lacking:
            raise SettingError(
                f"rebuild '{command}' lacks {' and '.join(lacking)}; name the folder that the"
                " command reads and the cloud that it writes so, or give stereo."
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
    RebuildOptions,
    MappingRules,
    CameraFileOptions,
    IndexOptions,
    WaterOptions,
    GroundOptions,
    NeededOptions,
    CamerasOptions,
):
    """The options of ``pcfix photos``."""

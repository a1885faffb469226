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
    WaterPerImageOption,
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
        default_is="a cell of the DSM, and 8 px at least",
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
        default_is="2 to 4 points a cell",
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
    WaterPerImageOption,
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


@dataclass(frozen=True, kw_only=True)
class WavesOptions(OptionSet):
    """The water surface from what waves do to the frames."""

    panel = Panel.WATER

    surface: bool = option(
        False,
        "Also the water surface of each frame, from how far the bed is displaced in it: rasters in"
        " OUT_water, which --water-per-image of 'pcfix correct' and 'photos' takes.",
    )
    depth: Any = option(
        None,
        "With --surface: the true depth in metres, or heights of the bed: a GeoTIFF or cloud, taken"
        " as it appears through the water where pcfix did not correct it.",
        metavar="SPEC",
    )
    level: float = option(0.0, "With --surface: height of the calm water.", unit="m")
    cameras: Any = option(
        None,
        "With --surface: the pose of the hovering camera, that of the first frame by its name, or"
        " the only one in the file.",
        metavar="PATH",
    )
    gsd: float | None = option(
        None,
        "With --surface, instead of --cameras, for a view straight down: the size of a pixel at the"
        " bed.",
        unit="m",
        rule=METRES,
    )
    interval: float | None = option(
        None,
        "With --surface: time between frames, before --every; without it each stands alone.",
        unit="s",
        rule=positive("{option} {value:g} is not positive; give seconds."),
        default_is="what the video says",
    )
    resolution: float | None = option(
        None,
        "Of the rasters of the water.",
        unit="m",
        rule=METRES,
        default_is="so that it has 2,000 cells",
    )


@dataclass(frozen=True, kw_only=True)
class CalmOptions(JobOptions, SummaryOption, CameraFileOptions, IndexOptions, WavesOptions):
    """The options of ``pcfix calm``."""

    panel = Panel.METHOD

    every: int = option(
        1,
        "Take every so many frames.",
        rule=must_be(1, 100_000, "give 2 for every other one", whole=True),
    )

    still: bool = option(
        False,
        "The camera stood still, as on a mast: frames are taken as they are. Else they are laid on"
        " the first by what moves least; without land the waves of the first move the image a bit.",
    )

    def check(self) -> None:
        """Check what options say together."""
        super().check()
        if not self.surface:
            for name in ("depth", "cameras", "gsd", "interval"):
                if getattr(self, name) is not None:
                    raise SettingError(f"{name} is of no use without surface; add it, or leave it.")
            return
        if self.depth is None:
            raise SettingError(
                "surface needs depth, which says how far a slope displaces the bed; give metres, or"
                " heights of the bed."
            )
        if (self.cameras is None) == (self.gsd is None):
            raise SettingError(
                "surface needs either cameras, the pose of the hovering camera, or gsd, the size of"
                " a pixel at the bed in metres."
            )

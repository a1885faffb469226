"""The options of photographs: photos, ortho and calm."""

from __future__ import annotations

from typing import Any, Literal

from pcfix.errors import SettingError
from pcfix.options.declare import File, OptionSet, option
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

Mapping = Literal["exact", "paper"]
Holes = Literal["fill", "black"]


class OrthoOptions(
    JobOptions, SummaryOption, IndexOptions, WaterOptions, CamerasOptions, panel=Panel.NEED
):
    """The options of ``pcfix ortho``."""

    dsm: Any = option(
        None,
        "True heights of land and bed: a GeoTIFF, or a corrected cloud (.las, .laz), which is"
        " gridded to cells twice as wide as those of the orthophoto.",
        metavar="PATH",
        needed=True,
    )
    resolution: float | None = option(
        None, "Cell size.", unit="m", above=0, default_is="a ground pixel"
    )
    water: Any = option(
        None,
        "Water surface, as for 'pcfix photos', for photographs as taken; without it refraction"
        " must have been removed from them.",
        metavar="SPEC",
    )


class MappingRules(OptionSet, panel=Panel.METHOD):
    """How a photograph is resampled."""

    mapping: Mapping = option(
        "exact",
        "exact: trace the light back from the true bed; paper: eq 12 of Skarlatos & Agrafiotis"
        " 2018 on the apparent bed, one round of their iteration.",
    )
    spacing: int | None = option(
        None,
        "Spacing of the grid nodes over the photograph.",
        unit="px",
        least=1,
        most=512,
        default_is="a cell of the DSM, at least 8 px",
    )
    holes: Holes = option("fill", "Interpolate holes of the DSM, or make them black.")


class RebuildOptions(OptionSet, panel=Panel.ROUNDS):
    """Rounds of photographs without refraction and clouds from them."""

    rebuild: str | None = option(
        None,
        "Reconstruct the cloud from the photographs, in rounds: stereo, matching by pcfix, or the"
        " command of another program, with {images}, {cameras} and {cloud} for the folder of the"
        " photographs, --cameras and the LAZ file to write.",
        metavar="COMMAND",
    )
    until_gsd: float = option(
        1.0, "Stop if the mean change of the bed is less than this many ground pixels.", above=0
    )
    most_rounds: int = option(4, "Maximum number of rounds.", least=1)
    reference: File | None = option(
        None,
        "Compare the clouds of all rounds with it, in OUT/compare; see 'pcfix compare'.",
        needs="rebuild",
    )

    def check(self) -> None:
        """Check that the command names what it reads and writes."""
        super().check()
        command = self.rebuild or "stereo"
        missing = [one for one in ("{images}", "{cloud}") if one not in command]
        if command != "stereo" and missing:
            raise SettingError(
                "option.command",
                f"rebuild '{command}' has no {' and '.join(missing)}. Use them for the folder that"
                " the command reads and the cloud that it writes, or give stereo.",
                option="rebuild",
                missing=missing,
            )


class PhotosOptions(
    WaterPerImageOption,
    JobOptions,
    SummaryOption,
    RebuildOptions,
    MappingRules,
    IndexOptions,
    NeededOptions,
    CamerasOptions,
    panel=Panel.NEED,
):
    """The options of ``pcfix photos``."""

    dsm: Any = option(
        None,
        "Heights of land and bed: a GeoTIFF, or a cloud (.las, .laz), which is gridded; corrected"
        " for --mapping exact, apparent for paper.",
        metavar="PATH",
        needed=True,
    )
    resolution: float | None = option(
        None,
        "Cell size to which a cloud is gridded.",
        unit="m",
        above=0,
        default_is="2 to 4 points a cell",
    )


class CalmOptions(JobOptions, SummaryOption, CameraFileOptions, IndexOptions, panel=Panel.WATER):
    """The options of ``pcfix calm``."""

    surface: bool = option(
        False,
        "Also estimate the water surface of each frame from the displacement of the bed: rasters in"
        " OUT_water, for --water-per-image of 'pcfix correct' and 'photos'.",
    )
    depth: Any = option(
        None,
        "With --surface: true depth in metres, or heights of the bed: a GeoTIFF or cloud, which is"
        " apparent unless pcfix corrected it.",
        metavar="SPEC",
        needs="surface",
    )
    level: float = option(0.0, "With --surface: height of the calm water.", unit="m")
    cameras: Any = option(
        None,
        "With --surface: pose of the hovering camera, by the name of the first frame, or the only"
        " one in the file.",
        metavar="PATH",
        needs="surface",
    )
    gsd: float | None = option(
        None,
        "With --surface, instead of --cameras, for a nadir view: pixel size at the bed.",
        unit="m",
        above=0,
        needs="surface",
    )
    interval: float | None = option(
        None,
        "With --surface: time between frames, before --every; without it frames are independent.",
        unit="s",
        above=0,
        needs="surface",
        default_is="what the video says",
    )
    resolution: float | None = option(
        None,
        "Cell size of the rasters of the water.",
        unit="m",
        above=0,
        default_is="that of 2,000 cells",
    )
    every: int = option(1, "Use every Nth frame.", least=1, most=100_000, panel=Panel.METHOD)
    still: bool = option(
        False,
        "The camera did not move, as on a mast: frames are used as they are. Otherwise they are"
        " aligned to the first by what moves least.",
        panel=Panel.METHOD,
    )

    def check(self) -> None:
        """Check that the depth and the scale of the images are known."""
        super().check()
        if self.surface and self.depth is None:
            raise SettingError(
                "option.missing",
                "surface needs depth. Give metres, or heights of the bed.",
                option="depth",
            )
        if self.surface and (self.cameras is None) == (self.gsd is None):
            raise SettingError(
                "option.missing",
                "surface needs either cameras or gsd. Give the pose of the camera, or the pixel"
                " size at the bed in metres.",
                option="cameras",
            )

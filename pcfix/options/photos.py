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


class OrthoOptions(
    JobOptions, SummaryOption, IndexOptions, WaterOptions, CamerasOptions, panel=Panel.NEED
):
    """The options of ``pcfix ortho``."""

    dsm: Any = option(None, basic=True, metavar="PATH", needed="needed")
    """True heights of land and bed: a GeoTIFF, or a corrected cloud (.las, .laz), which is gridded
    to cells twice as wide as those of the orthophoto."""
    resolution: float | None = option(None, basic=True, above=0)
    """Cell size. [m] [default: one ground pixel]"""
    water: Any = option(None, basic=True, metavar="SPEC")
    """Water surface, as for 'pcfix photos'. Omit it if refraction was already removed from the
    photographs."""


def _command(given: str) -> str:
    """Check that a command names what it reads and writes."""
    missing = [one for one in ("{images}", "{cloud}") if one not in given]
    if given not in ("stereo", "") and missing:
        raise SettingError(
            "option.command",
            f"rebuild '{given}' has no {' and '.join(missing)}. Use them for the folder that the"
            " command reads and the cloud that it writes, or give stereo.",
            option="rebuild",
            missing=missing,
        )
    return given


class RebuildOptions(OptionSet, panel=Panel.ROUNDS):
    """Rounds of photographs without refraction and clouds from them."""

    rebuild: str | None = option(None, basic=True, then=_command, metavar="COMMAND")
    """Reconstruct the cloud from the photographs, in rounds: stereo (built in), or the command of
    another program. In the command, {images}, {cameras} and {cloud} become the folder of the
    photographs, --cameras and the LAZ file to write."""
    until_gsd: float = option(1.0, above=0)
    """Stop if the mean change of the bed is less than this many ground pixels."""
    most_rounds: int = option(4, least=1)
    """Maximum number of rounds."""
    reference: File | None = option(None, basic=True, needs="rebuild")
    """Reference to compare the clouds of all rounds with, in OUT/compare; see 'pcfix compare'."""


class PhotosOptions(
    WaterPerImageOption, JobOptions, SummaryOption, RebuildOptions, IndexOptions, NeededOptions,
    CamerasOptions, panel=Panel.NEED,
):  # fmt: skip
    """The options of ``pcfix photos``."""

    dsm: Any = option(None, basic=True, metavar="PATH", needed="needed")
    """Heights of land and bed: a GeoTIFF, or a cloud (.las, .laz), which is gridded; corrected for
    --mapping exact, apparent for paper."""
    resolution: float | None = option(None, basic=True, above=0)
    """Cell size to which a cloud is gridded. [m] [default: 2 to 4 points a cell]"""
    mapping: Literal["exact", "paper"] = option("exact", basic=True, panel=Panel.METHOD)
    """exact: trace the light back from the true bed; paper: eq 12 of Skarlatos & Agrafiotis 2018 on
    the apparent bed, one round of their iteration."""
    spacing: int | None = option(None, least=1, most=512, panel=Panel.METHOD)
    """Spacing of the grid nodes over the photograph. [px] [default: a cell of the DSM, at least 8
    px]"""
    holes: Literal["fill", "black"] = option("fill", panel=Panel.METHOD)
    """Interpolate holes of the DSM, or make them black."""


class CalmOptions(JobOptions, SummaryOption, CameraFileOptions, IndexOptions, panel=Panel.WATER):
    """The options of ``pcfix calm``."""

    surface: bool = option(False, basic=True, requires=("depth", "cameras or gsd"))
    """Also estimate the water surface of each frame from the displacement of the bed: rasters in
    OUT_water, for --water-per-image of 'pcfix correct' and 'photos'."""
    depth: Any = option(None, basic=True, metavar="SPEC", needs="surface")
    """With --surface: true depth in metres, or heights of the bed: a GeoTIFF or cloud, which is
    taken as apparent unless pcfix corrected it."""
    level: float = option(0.0)
    """With --surface: height of the calm water. [m]"""
    cameras: Any = option(None, basic=True, metavar="PATH", needs="surface")
    """With --surface: pose of the hovering camera, by the name of the first frame, or the only one
    in the file."""
    gsd: float | None = option(None, basic=True, above=0, needs="surface")
    """With --surface, instead of --cameras, for a nadir view: pixel size at the bed. [m]"""
    interval: float | None = option(None, above=0, needs="surface")
    """With --surface: time between frames, before --every; without it frames are independent. [s]
    [default: as stated in the video]"""
    resolution: float | None = option(None, basic=True, above=0)
    """Cell size of the rasters of the water. [m] [default: so that there are 2,000 cells]"""
    every: int = option(1, least=1, most=100_000, panel=Panel.METHOD)
    """Use every Nth frame."""
    still: bool = option(False, panel=Panel.METHOD)
    """The camera did not move, as on a mast: do not align the frames. Otherwise they are aligned
    to the first one by the parts of the image that move least."""

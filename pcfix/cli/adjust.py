"""``pcfix adjust``."""

from __future__ import annotations

import sys
import warnings
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pcfix.cli.groups import CameraWords, WaterFitWords, takes
from pcfix.cli.words import (
    Jobs,
    Overwrite,
    PortOption,
    Quiet,
    ViewKinds,
    WaterUnlessPort,
)
from pcfix.errors import PcfixWarning, SettingError
from pcfix.options import DEFAULT_REFRACTIVE_INDEX

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from pcfix.adjust.problem import LogRow


class Poses(str, Enum):  # noqa: UP042
    """How the projection centres and attitudes move."""

    free = "free"
    fixed = "fixed"
    similarity = "similarity"


class Datums(str, Enum):  # noqa: UP042
    """What says where the block is."""

    observed = "observed"
    free = "free"


class TiesWords(str, Enum):  # noqa: UP042
    """Which observations are adjusted."""

    auto = "auto"
    measured = "measured"
    cloud = "cloud"


Model = Annotated[
    Path,
    typer.Argument(
        metavar="MODEL", help="Camera poses, with tie points or beside a cloud.", show_default=False
    ),
]
OutDir = Annotated[
    Path, typer.Argument(metavar="OUT", help="Folder for the adjusted model.", show_default=False)
]
Cloud = Annotated[
    Path | None,
    typer.Option(
        help="The cloud that these poses made; it stands in where there are no tie points."
    ),
]
Gcps = Annotated[
    Path | None,
    typer.Option(
        help="Control and check points with their marks: CSV name,x,y,z,image,u,v"
        " [,role,under_water], ODM's gcp_list.txt, or Metashape's markers."
    ),
]
Gnss = Annotated[
    Path | None,
    typer.Option(
        help="GNSS positions of the images: CSV image,x,y,z[,sx,sy,sz], a geotag list, or a camera"
        " file that has them.",
        show_default="what the model has",
    ),
]
LensFile = Annotated[
    Path | None,
    typer.Option(help="Calibrated lens, held fixed: as --sensor, or a Metashape calibration."),
]


@dataclass(frozen=True)
class AdjustWords(WaterFitWords, CameraWords):
    """What moves, and how observations count."""

    free: Annotated[
        str | None,
        typer.Option(
            metavar="WORDS",
            help="What of the water moves too: some of level,tilt,index, with commas between.",
            show_default="nothing",
        ),
    ] = None
    sigma_level: Annotated[
        float | None, typer.Option(help="Let the level move about its value, m.")
    ] = None
    sigma_tilt: Annotated[
        float | None, typer.Option(help="Let the tilt move about its value, degrees.")
    ] = None
    sigma_index: Annotated[
        float | None, typer.Option(help="Let the refractive index move about its value.")
    ] = None
    lens_unknowns: Annotated[
        str | None,
        typer.Option(
            metavar="WORDS",
            help="Lens parameters that move: none, or some of f,cx,cy,k1...,p1,p2,b1,b2.",
            show_default="those that the block determines",
        ),
    ] = None
    poses: Annotated[
        Poses,
        typer.Option(help="Whether poses move one by one, not at all, or all together."),
    ] = Poses.free
    fixed_images: Annotated[
        str | None, typer.Option(metavar="A,B,...", help="Images that keep their pose.")
    ] = None
    datum: Annotated[
        Datums,
        typer.Option(help="free keeps mean place, direction and scale of the old poses."),
    ] = Datums.observed
    ties: Annotated[
        TiesWords,
        typer.Option(
            help="Adjust measured tie points, or points of the cloud; auto: as there are."
        ),
    ] = TiesWords.auto
    gnss_sigma: Annotated[
        float | None,
        typer.Option(help="Of GNSS positions without one, m.", show_default="from how they fit"),
    ] = None
    gnss_crs: Annotated[
        str | None, typer.Option("--gnss-crs", help="CRS of the GNSS positions.")
    ] = None
    gcps_crs: Annotated[
        str | None, typer.Option("--gcps-crs", help="CRS of the control points.")
    ] = None
    sigma_image: Annotated[
        float | None,
        typer.Option(help="Of tie points in the images, px.", show_default="from their residuals"),
    ] = None
    outliers: Annotated[
        bool, typer.Option("--outliers/--no-outliers", help="Look for outliers and leave them out.")
    ] = True
    engine: Annotated[str | None, typer.Option(hidden=True)] = None
    views: Annotated[
        Path | None, typer.Option(help="View list of --cloud, as of 'pcfix correct'.")
    ] = None
    views_are: Annotated[ViewKinds, typer.Option(help="As of 'pcfix correct'.")] = ViewKinds.auto
    water_mask: Annotated[
        Path | None, typer.Option(help="Polygons inside which points may be submerged.")
    ] = None
    index: Annotated[
        str | None,
        typer.Option(
            help="Refractive index of the water relative to air: a number, fresh or sea.",
            show_default=str(DEFAULT_REFRACTIVE_INDEX),
        ),
    ] = None

    def keywords(self) -> dict[str, Any]:
        """Return them as `pcfix.adjust_cameras` takes them."""
        from pcfix.water.index import index_words

        _check_engine(self.engine)
        lens = None if self.lens_unknowns is None else _words(self.lens_unknowns)
        return {
            **super().keywords(),
            **self.water_keywords(),
            "free": _words(self.free),
            "sigma_level": self.sigma_level,
            "sigma_tilt": self.sigma_tilt,
            "sigma_index": self.sigma_index,
            "lens_unknowns": () if lens == ("none",) else lens,
            "poses": self.poses.value,
            "fixed_images": _words(self.fixed_images),
            "datum": self.datum.value,
            "ties": self.ties.value,
            "gnss_sigma": self.gnss_sigma,
            "gnss_crs": self.gnss_crs,
            "gcps_crs": self.gcps_crs,
            "sigma_image": self.sigma_image,
            "outliers": self.outliers,
            "views": self.views,
            "views_are": self.views_are.value,
            "water_mask": self.water_mask,
            "index": index_words(self.index, None, None, None),
        }


def _check_engine(engine: str | None) -> None:
    """Warn of an option that says nothing any more, or refuse an engine that is gone."""
    if engine is None:
        return
    if engine not in ("direct", "pcfix"):
        raise SettingError(
            f"engine '{engine}': pcfix 0.1.0 was the last version with COLMAP's engine; leave"
            " --engine out, as there is one engine only."
        )
    warnings.warn(
        "--engine is of no use any more, as there is one engine only; leave it out.",
        PcfixWarning,
        stacklevel=2,
    )


def _words(text: str | None) -> tuple[str, ...]:
    return () if text is None else tuple(word.strip() for word in text.split(",") if word.strip())


@takes(AdjustWords)
def adjust(
    words: AdjustWords,
    model: Model,
    out: OutDir,
    water: WaterUnlessPort = None,
    port: PortOption = None,
    cloud: Cloud = None,
    gcps: Gcps = None,
    gnss: Gnss = None,
    lens: LensFile = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Adjust poses, lens and points with the light bent at the water."""
    from pcfix.flow.adjust import adjust_cameras, next_step
    from pcfix.port.shapes import port_of
    from pcfix.report.adjustment import adjustment_text, before_of
    from pcfix.threads import threads

    if (water is None) == (port is None):
        raise typer.BadParameter("give --water, or --port for images taken under water")
    with threads(jobs), _rounds(quiet) as progress:
        found = adjust_cameras(
            model, out, water=water, port=None if port is None else port_of(port), cloud=cloud,
            gcps=gcps, gnss=gnss, lens=lens, overwrite=overwrite, progress=progress,
            **words.keywords(),
        )  # fmt: skip
    if not quiet:
        typer.echo(adjustment_text(found, before_of(found)))
        step = next_step(
            found, str(model), str(out), None if cloud is None else str(cloud), words.cameras_offset
        )
        typer.echo(f"Next: {step}")


@contextmanager
def _rounds(quiet: bool) -> Iterator[Callable[[LogRow], None] | None]:
    """Show the step at work on a terminal; nothing when piped."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console

    with Console(stderr=True).status("Adjusting") as status:
        yield lambda row: status.update(
            f"Adjusting: round {row.round}, step {row.step}, {row.observations:,} observations,"
            f" {row.rms_px:.3f} px"
        )

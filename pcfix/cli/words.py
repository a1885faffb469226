"""Arguments and options that several commands have, and the bar that shows progress."""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


class Uncorrected(str, Enum):  # noqa: UP042 - typer shows the values of a str Enum
    """What becomes of submerged points that cannot be corrected."""

    withhold = "withhold"
    keep = "keep"
    drop = "drop"


class AngleWords(str, Enum):  # noqa: UP042
    """Which angles a table of cameras has."""

    opk = "omega-phi-kappa"
    ypr = "yaw-pitch-roll"
    aircraft = "aircraft"


class WaterModels(str, Enum):  # noqa: UP042
    """What is fitted to shoreline points."""

    auto = "auto"
    level = "level"
    plane = "plane"
    along = "along"
    river = "river"


class Dimensions(str, Enum):  # noqa: UP042
    """Which extra dimensions are written."""

    all = "all"
    minimal = "minimal"
    none = "none"


class Methods(str, Enum):  # noqa: UP042
    """How the true point follows from the apparent one."""

    snell = "snell"
    consistent = "consistent"
    shan = "shan"
    butler = "butler"
    murase = "murase"
    dietrich = "dietrich"
    factor = "factor"
    regression = "regression"


class CameraSets(str, Enum):  # noqa: UP042
    """Which cameras made a point, where no list says it."""

    auto = "auto"
    mvs = "mvs"
    all = "all"


class Matchers(str, Enum):  # noqa: UP042
    """What a dense matcher makes a point of."""

    depth_maps = "depth-maps"
    pairs = "pairs"


class ViewKinds(str, Enum):  # noqa: UP042
    """What a view list lists."""

    auto = "auto"
    tracks = "tracks"
    depth_maps = "depth-maps"


class OnOff(str, Enum):  # noqa: UP042
    """Whether something is done."""

    auto = "auto"
    on = "on"
    off = "off"


Input = Annotated[
    Path, typer.Argument(metavar="INPUT", help="LAS or LAZ cloud.", show_default=False)
]
Output = Annotated[
    Path, typer.Argument(metavar="OUTPUT", help="LAS or LAZ to write.", show_default=False)
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an output that exists.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No summary and no progress.")]
Jobs = Annotated[int | None, typer.Option(help="Threads.", show_default="all cores")]


CamerasOption = Annotated[
    Path,
    typer.Option(
        "--cameras",
        help="File or folder of camera poses: Metashape, Pix4D, ODM, OpenSfM, COLMAP, MicMac,"
        " Bundler, VisualSFM, BlocksExchange, RealityCapture, or a CSV table.",
    ),
]
_WATER = typer.Option(
    "--water",
    help="A level (0.37), plane:a,b,c, dim:NAME, a mesh (.obj, .ply), a raster (.tif),"
    " shoreline points (.csv, .gpkg, .shp, .geojson, .wkt), or auto.",
)
WaterOption = Annotated[str, _WATER]
WaterUnlessPort = Annotated[str | None, _WATER]
PortOption = Annotated[
    str | None,
    typer.Option(
        "--port",
        metavar="SPEC",
        help="Instead of --water, for a cloud taken under water: the port of the cameras' housing,"
        " flat:distance=M[,thickness=M,glass=N,nx=,ny=] or"
        " dome:radius=M[,thickness=M,glass=N,x=M,y=M,z=M], seen from the projection centre.",
    ),
]
UncorrectedOption = Annotated[
    Uncorrected,
    typer.Option("--uncorrected", help="Submerged points with fewer than two usable rays."),
]
DimensionsOption = Annotated[
    Dimensions,
    typer.Option("--dimensions", help="Extra dimensions; 'pcfix restore' needs all."),
]
WithM3c2 = Annotated[
    bool, typer.Option("--m3c2", help="Compare by M3C2 too, with py4dgeo: the extra m3c2.")
]
SummaryOption = Annotated[Path | None, typer.Option("--summary", help="Write the summary as JSON.")]


@contextmanager
def progress_bar(title: str, quiet: bool) -> Iterator[Callable[[int, int], None] | None]:
    """Show a bar with points/s and the time left on a terminal; nothing when piped."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None, rate="")
        started = time.perf_counter()

        def update(done: int, total: int) -> None:
            rate = done / (time.perf_counter() - started)
            bar.update(task, completed=done, total=total, rate=f"{rate:,.0f} points/s")

        yield update

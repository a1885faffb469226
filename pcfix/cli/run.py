"""``pcfix run``."""

from __future__ import annotations

from dataclasses import asdict
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

from pcfix.cli.groups import CorrectionWords, takes
from pcfix.cli.words import (
    Jobs,
    Overwrite,
    Quiet,
    WithM3c2,
    progress_bar,
)
from pcfix.options import ErrorBudget


class Adjusting(str, Enum):  # noqa: UP042 - typer shows the values of a str Enum
    """Whether the cameras are adjusted first."""

    auto = "auto"
    yes = "yes"
    no = "no"


Input = Annotated[
    Path | None, typer.Argument(metavar="INPUT", help="LAS or LAZ cloud.", show_default=False)
]
OutDir = Annotated[
    Path | None,
    typer.Argument(metavar="OUT_DIR", help="Folder for all results.", show_default=False),
]
Cameras = Annotated[Path | None, typer.Option(help="File or folder of camera poses.")]
Water = Annotated[
    str | None, typer.Option(help="A level (0.37), plane:a,b,c, dim:NAME, or a mesh (.obj, .ply).")
]
Reference = Annotated[
    Path | None, typer.Option(help="LiDAR cloud, CSV check points or GeoTIFF to compare with.")
]
Resolution = Annotated[
    float | None, typer.Option(help="Of the rasters, m.", show_default="4 points a cell")
]
Adjust = Annotated[
    Adjusting,
    typer.Option(
        help="First adjust the cameras with the light bent at the water, as 'pcfix adjust'; auto:"
        " where they have absorbed the refraction, and GNSS or --gcps say where they are."
    ),
]
Gcps = Annotated[
    Path | None, typer.Option(help="For --adjust: control points, as of 'pcfix adjust'.")
]
Gnss = Annotated[
    Path | None,
    typer.Option(
        help="For --adjust: GNSS positions of the images, as of 'pcfix adjust'.",
        show_default="what the cameras have",
    ),
]
LensFile = Annotated[
    Path | None, typer.Option(help="For --adjust: calibrated lens, as of 'pcfix adjust'.")
]
Config = Annotated[Path | None, typer.Option(help="run.json of an earlier run, to repeat it.")]


@takes(CorrectionWords)
def run(
    words: CorrectionWords,
    input: Input = None,
    out_dir: OutDir = None,
    cameras: Cameras = None,
    water: Water = None,
    reference: Reference = None,
    resolution: Resolution = None,
    m3c2: WithM3c2 = False,
    adjust: Adjust = Adjusting.auto,
    gcps: Gcps = None,
    gnss: Gnss = None,
    lens: LensFile = None,
    config: Config = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Adjust, correct, clean, grid, compare and report; resumes where it stopped.

    With --config give only the folder: pcfix run OUT_DIR --config run.json.
    """
    from pcfix.flow.run import Request, request_of, run_all

    survey = {"gcps": gcps, "gnss": gnss, "lens": lens}
    if config is not None:
        folder = out_dir or input
        if folder is None or cameras is not None or water is not None:
            raise typer.BadParameter("with --config give OUT_DIR alone")
        request = request_of(config)
    else:
        if input is None or out_dir is None or cameras is None or water is None:
            raise typer.BadParameter("INPUT, OUT_DIR, --cameras and --water are needed")
        folder = out_dir
        request = Request(
            input=str(input),
            cameras=str(cameras),
            water=water,
            reference=None if reference is None else str(reference),
            **{name: _plain(value) for name, value in words.keywords().items()},
            resolution_m=resolution,
            m3c2=m3c2,
            adjust=adjust.value,
            **{name: _plain(path) for name, path in survey.items()},
        )

    def say(text: str) -> None:
        if not quiet:
            typer.echo(text)

    with progress_bar("Correcting", quiet) as progress:
        run_all(request, folder, overwrite=overwrite, jobs=jobs, say=say, progress=progress)


def _plain(value: Any) -> Any:
    """Return a value as the record of a run keeps it: paths as text, a budget by its names."""
    if isinstance(value, ErrorBudget):
        return asdict(value)
    return str(value) if isinstance(value, Path) else value

"""``pcfix cameras``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pcfix.cli.groups import CameraWords, takes
from pcfix.cli.words import Overwrite, SummaryOption  # noqa: TC001 - typer reads them

CamerasPath = Annotated[
    Path,
    typer.Argument(metavar="PATH", help="File or folder of camera poses.", show_default=False),
]
Cloud = Annotated[Path | None, typer.Option(help="LAS or LAZ cloud that they shall fit.")]
Water = Annotated[str | None, typer.Option(help="As of 'pcfix correct': for heights and GSD.")]
Plot = Annotated[Path | None, typer.Option(help="PNG of the block in plan and from the side.")]


@takes(CameraWords)
def cameras(
    words: CameraWords,
    path: CamerasPath,
    cloud: Cloud = None,
    water: Water = None,
    plot: Plot = None,
    summary: SummaryOption = None,
    overwrite: Overwrite = False,
) -> None:
    """Say what a camera file holds, and whether it fits a cloud."""
    import json

    from pcfix.flow.cameras import check_cameras
    from pcfix.io.files import check_output, write_text
    from pcfix.report.cameras import cameras_text

    if summary is not None:
        check_output(summary, overwrite=overwrite, inputs=[path])
    report = check_cameras(
        path, cloud, water=water, plot=plot, overwrite=overwrite, **words.keywords()
    )
    if summary is not None:
        text = json.dumps(report.as_dict(), indent=2, allow_nan=False) + "\n"
        write_text(summary, text, overwrite=overwrite)
    typer.echo(cameras_text(report))

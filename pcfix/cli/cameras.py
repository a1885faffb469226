"""``pcfix cameras``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pcfix.cli.groups import CameraWords, takes
from pcfix.cli.words import Overwrite, SummaryOption  # noqa: TC001 - typer reads them
from pcfix.options import DEFAULT_REFRACTIVE_INDEX

CamerasPath = Annotated[
    Path,
    typer.Argument(metavar="PATH", help="File or folder of camera poses.", show_default=False),
]
Cloud = Annotated[Path | None, typer.Option(help="LAS or LAZ cloud that they shall fit.")]
Water = Annotated[
    str | None,
    typer.Option(
        help="As of 'pcfix correct': for heights and GSD, and, with a cloud, whether the poses have"
        " absorbed the refraction."
    ),
]
Index = Annotated[float, typer.Option(help="Refractive index of the water relative to air.")]
Gnss = Annotated[
    Path | None,
    typer.Option(help="Where the GNSS said that the images were taken, as CSV image,x,y,z."),
]
Gcps = Annotated[
    Path | None,
    typer.Option(help="Control points and their marks in images, as CSV name,x,y,z,image,u,v."),
]
LensFile = Annotated[
    Path | None,
    typer.Option(help="Calibration of the camera: Metashape's, or CSV as of --sensor."),
]
Reference = Annotated[
    Path | None,
    typer.Option(help="Survey of land or bed: LiDAR (.las, .laz), grid (.tif) or CSV x,y,z."),
]
Plot = Annotated[Path | None, typer.Option(help="PNG of the block in plan and from the side.")]


@takes(CameraWords)
def cameras(
    words: CameraWords,
    path: CamerasPath,
    cloud: Cloud = None,
    water: Water = None,
    index: Index = DEFAULT_REFRACTIVE_INDEX,
    gnss: Gnss = None,
    gcps: Gcps = None,
    lens: LensFile = None,
    reference: Reference = None,
    plot: Plot = None,
    summary: SummaryOption = None,
    overwrite: Overwrite = False,
) -> None:
    """Say what a camera file holds, whether it fits a cloud, and whether it absorbed refraction."""
    import json

    from pcfix.flow.checks import check_cameras
    from pcfix.io.files import check_output, write_text
    from pcfix.report.cameras import cameras_text

    if summary is not None:
        check_output(summary, overwrite=overwrite, inputs=[path])
    report = check_cameras(
        path, cloud, water=water, refractive_index=index, gnss=gnss, gcps=gcps, lens=lens,
        reference=reference, plot=plot, overwrite=overwrite, **words.keywords(),
    )  # fmt: skip
    if summary is not None:
        text = json.dumps(report.as_dict(), indent=2, allow_nan=False) + "\n"
        write_text(summary, text, overwrite=overwrite)
    typer.echo(cameras_text(report))

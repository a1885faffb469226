"""``pcfix dsm``."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from pcfix.cli.words import Input, Overwrite, Quiet, SummaryOption, progress_bar


class Method(str, Enum):  # noqa: UP042 - typer shows the values of a str Enum
    """How a cell gets its height."""

    mean = "mean"
    median = "median"
    min = "min"
    max = "max"
    idw = "idw"
    tin = "tin"


class Surface(str, Enum):  # noqa: UP042
    """Which points are gridded."""

    all = "all"
    bed = "bed"


Raster = Annotated[
    Path, typer.Argument(metavar="OUTPUT", help="GeoTIFF to write.", show_default=False)
]
Resolution = Annotated[float, typer.Option("--resolution", help="Side of a cell, metres.")]
MethodOption = Annotated[Method, typer.Option("--method", help="How a cell gets its height.")]
SurfaceOption = Annotated[
    Surface,
    typer.Option("--surface", help="Land and bed without noise, or only the bed (class 40)."),
]
Fill = Annotated[
    float | None,
    typer.Option("--fill", help="Fill holes up to so many metres wide; they get count 0."),
]
Hillshade = Annotated[
    Path | None, typer.Option("--hillshade", help="Write a hillshade there (.tif).")
]
Azimuth = Annotated[
    float, typer.Option("--azimuth", help="Sun of the hillshade, degrees clockwise from north.")
]
Altitude = Annotated[
    float, typer.Option("--altitude", help="Sun of the hillshade, degrees above the horizon.")
]
Cog = Annotated[bool, typer.Option("--cog", help="Write cloud optimised GeoTIFF.")]


def dsm(
    input: Input,
    output: Raster,
    resolution: Resolution,
    method: MethodOption = Method.mean,
    surface: SurfaceOption = Surface.all,
    fill: Fill = None,
    hillshade: Hillshade = None,
    azimuth: Azimuth = 315.0,
    altitude: Altitude = 45.0,
    cog: Cog = False,
    summary: SummaryOption = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Grid a cloud to a GeoTIFF: height, count and spread."""
    from pcfix.flow.dsm import grid_dsm
    from pcfix.report.text import dsm_text

    with progress_bar("Gridding", quiet) as progress:
        result = grid_dsm(
            input,
            output,
            resolution_m=resolution,
            method=method.value,
            surface=surface.value,
            fill_m=fill,
            hillshade=hillshade,
            azimuth_deg=azimuth,
            altitude_deg=altitude,
            cog=cog,
            summary=summary,
            overwrite=overwrite,
            progress=progress,
        )
    if not quiet:
        typer.echo(dsm_text(result))

"""``pcfix compare``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pcfix.cli.words import Overwrite, Quiet, SummaryOption, WithM3c2  # noqa: TC001 - typer reads them

Cloud = Annotated[
    Path, typer.Argument(metavar="CLOUD", help="LAS or LAZ cloud.", show_default=False)
]
ReferenceArgument = Annotated[
    Path,
    typer.Argument(
        metavar="REFERENCE",
        help="LAS or LAZ, CSV check points (x,y,z), or a GeoTIFF of heights.",
        show_default=False,
    ),
]
OutDir = Annotated[
    Path | None, typer.Option(help="Folder for compare.json, depth tables and sections (CSV).")
]
Submerged = Annotated[
    bool, typer.Option("--submerged", help="Only points of class 40, or below --water.")
]
Water = Annotated[
    str | None,
    typer.Option(
        help="A level (0.37), plane:a,b,c, dim:NAME, or a mesh (.obj, .ply).",
        show_default="what the cloud says",
    ),
]
C2cOnly = Annotated[
    bool, typer.Option("--c2c-only", help="Distances to the nearest point, nothing signed.")
]
Neighbours = Annotated[int, typer.Option(help="Reference points of each fitted plane.")]
BinWidth = Annotated[float, typer.Option(help="Of the table by depth, metres.")]
ShoreBinWidth = Annotated[float, typer.Option(help="Of the table by distance from shore, metres.")]
MaxGap = Annotated[
    float | None,
    typer.Option(
        help="How far outside the reference a point counts, metres.",
        show_default="5 point spacings, at least 1",
    ),
]
SectionWords = Annotated[
    list[str] | None,
    typer.Option("--section", help="A cross-section x1,y1,x2,y2; may be repeated."),
]
Sections = Annotated[int, typer.Option(help="So many automatic cross-sections, down the slope.")]
Corridor = Annotated[float, typer.Option(help="Half-width of a cross-section, metres.")]


def compare(
    cloud: Cloud,
    reference: ReferenceArgument,
    out_dir: OutDir = None,
    submerged: Submerged = False,
    water: Water = None,
    c2c_only: C2cOnly = False,
    m3c2: WithM3c2 = False,
    neighbours: Neighbours = 8,
    bin_width: BinWidth = 1.0,
    shore_bin_width: ShoreBinWidth = 10.0,
    max_gap: MaxGap = None,
    section: SectionWords = None,
    sections: Sections = 0,
    corridor: Corridor = 1.0,
    summary: SummaryOption = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Measure how far a cloud is from a reference, before and after correction."""
    from pcfix.flow.compare import compare_clouds
    from pcfix.report.comparison import comparison_text

    result = compare_clouds(
        cloud,
        reference,
        out_dir=out_dir,
        submerged=submerged,
        water=water,
        vertical=not c2c_only,
        m3c2=m3c2,
        neighbours=neighbours,
        bin_width_m=bin_width,
        shore_bin_width_m=shore_bin_width,
        max_gap_m=max_gap,
        section_lines=section or (),
        sections=sections,
        corridor_m=corridor,
        summary=summary,
        overwrite=overwrite,
    )
    if not quiet:
        typer.echo(comparison_text(result))

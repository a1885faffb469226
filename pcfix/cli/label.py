"""``pcfix label``."""

from __future__ import annotations

from typing import Annotated

import typer

from pcfix.cli.groups import LabelWords, takes
from pcfix.cli.words import (
    Input,
    Jobs,
    Output,
    Overwrite,
    Quiet,
    SummaryOption,
    WaterOption,
    progress_bar,
)

Band = Annotated[
    float,
    typer.Option(
        help="Points at most so far from the surface, above or below, become class 41, m.",
        show_default="no class 41",
    ),
]
DeadBand = Annotated[
    float,
    typer.Option(
        help="Points at most so far from the surface take the label of their surroundings, m.",
        show_default="none",
    ),
]
Reset = Annotated[
    bool,
    typer.Option("--reset", help="Points that come as class 40 or 41 and are neither become 1."),
]


@takes(LabelWords)
def label(
    words: LabelWords,
    input: Input,
    output: Output,
    water: WaterOption,
    band: Band = 0.0,
    dead_band: DeadBand = 0.0,
    reset: Reset = False,
    summary: SummaryOption = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Give the points below the water surface class 40, and change nothing else."""
    from pcfix.flow.label import label_file
    from pcfix.report.text import labelling_text

    settings = words.label_settings(band_m=band, dead_band_m=dead_band, reset=reset)
    with progress_bar("Labelling", quiet) as progress:
        result = label_file(
            input,
            output,
            water=water,
            **words.water_keywords(),
            water_mask=words.water_mask,
            settings=settings,
            summary=summary,
            overwrite=overwrite,
            jobs=jobs,
            progress=progress,
        )
    if not quiet:
        typer.echo(labelling_text(result))

"""``pcfix correct`` and the PDAL pipeline of the same."""

from __future__ import annotations

import typer

import pcfix
from pcfix.cli.groups import CorrectionWords, takes
from pcfix.cli.words import (
    CamerasOption,
    Dimensions,
    DimensionsOption,
    Input,
    Jobs,
    Output,
    Overwrite,
    PortOption,
    Quiet,
    SummaryOption,
    Uncorrected,
    UncorrectedOption,
    WaterOption,
    WaterUnlessPort,
    progress_bar,
)


@takes(CorrectionWords)
def correct(
    words: CorrectionWords,
    input: Input,
    output: Output,
    cameras: CamerasOption,
    water: WaterUnlessPort = None,
    port: PortOption = None,
    uncorrected: UncorrectedOption = Uncorrected.withhold,
    dimensions: DimensionsOption = Dimensions.all,
    summary: SummaryOption = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Move the points below the water surface to where they are."""
    if water is None and port is None:
        raise typer.BadParameter("--water is needed, or --port for a cloud taken under water")
    from pcfix.report.text import summary_text

    with progress_bar("Correcting", quiet) as progress:
        result = pcfix.correct_file(
            input,
            output,
            cameras=cameras,
            water=water,
            port=port,
            **words.keywords(),
            uncorrected=uncorrected.value,
            dimensions=dimensions.value,
            summary=summary,
            overwrite=overwrite,
            jobs=jobs,
            progress=progress,
        )
    if not quiet:
        typer.echo(summary_text(result))


@takes(CorrectionWords)
def pipeline(
    words: CorrectionWords,
    input: Input,
    output: Output,
    cameras: CamerasOption,
    water: WaterOption,
    uncorrected: UncorrectedOption = Uncorrected.withhold,
    dimensions: DimensionsOption = Dimensions.all,
    summary: SummaryOption = None,
    overwrite: Overwrite = False,
    jobs: Jobs = None,
) -> None:
    """Print the PDAL pipeline of the same 'pcfix correct', as JSON."""
    import json

    from pcfix.flow.inputs import inputs_of
    from pcfix.flow.pipeline import pipeline_for
    from pcfix.water.index import index_of

    keywords = {"cameras": cameras, "water": water, **words.keywords()}
    settings = pcfix.Settings(
        index_of(words.refractive_index())[0], words.max_angle, words.max_cameras,
        uncorrected.value, dimensions.value, "", words.method.value, words.camera_set.value,
        words.occlusion.value, words.depth_factor, words.least_r2, words.errors(),
        words.matcher.value,
    )  # fmt: skip
    options = {
        "cameras": str(cameras),
        "water": water,
        **words.plain(),
        "uncorrected": uncorrected.value,
        "dimensions": dimensions.value,
        "summary": None if summary is None else str(summary),
        "overwrite": overwrite or None,
        "jobs": jobs,
    }
    stages = pipeline_for(
        input, output, settings, inputs_of(keywords), options, words.label_settings()
    )
    typer.echo(json.dumps(stages, indent=2))

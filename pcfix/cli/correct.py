"""``pcfix correct`` and the PDAL pipeline of the same."""

from __future__ import annotations

import typer

import pcfix
from pcfix.cli.words import (
    CamerasOption,
    Dimensions,
    DimensionsOption,
    Index,
    Input,
    Jobs,
    MaxAngle,
    MaxCameras,
    Output,
    Overwrite,
    Quiet,
    Sensor,
    SummaryOption,
    Uncorrected,
    UncorrectedOption,
    WaterOption,
    progress_bar,
)
from pcfix.model import DEFAULT_REFRACTIVE_INDEX


def correct(
    input: Input,
    output: Output,
    cameras: CamerasOption,
    water: WaterOption,
    sensor: Sensor = None,
    index: Index = DEFAULT_REFRACTIVE_INDEX,
    max_angle: MaxAngle = None,
    max_cameras: MaxCameras = None,
    uncorrected: UncorrectedOption = Uncorrected.withhold,
    dimensions: DimensionsOption = Dimensions.all,
    summary: SummaryOption = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Move the points below the water surface to where they are."""
    from pcfix.report.text import summary_text

    with progress_bar("Correcting", quiet) as progress:
        result = pcfix.correct_file(
            input,
            output,
            cameras=cameras,
            water=water,
            sensor=sensor,
            refractive_index=index,
            max_angle_deg=max_angle,
            max_cameras=max_cameras,
            uncorrected=uncorrected.value,
            dimensions=dimensions.value,
            summary=summary,
            overwrite=overwrite,
            jobs=jobs,
            progress=progress,
        )
    if not quiet:
        typer.echo(summary_text(result))


def pipeline(
    input: Input,
    output: Output,
    cameras: CamerasOption,
    water: WaterOption,
    sensor: Sensor = None,
    index: Index = DEFAULT_REFRACTIVE_INDEX,
    max_angle: MaxAngle = None,
    max_cameras: MaxCameras = None,
    uncorrected: UncorrectedOption = Uncorrected.withhold,
    dimensions: DimensionsOption = Dimensions.all,
    summary: SummaryOption = None,
    overwrite: Overwrite = False,
    jobs: Jobs = None,
) -> None:
    """Print the PDAL pipeline of the same 'pcfix correct', as JSON."""
    import json

    from pcfix.flow.pipeline import pipeline_for

    settings = pcfix.Settings(index, max_angle, max_cameras, uncorrected.value, dimensions.value)
    options = {
        "cameras": str(cameras),
        "water": water,
        "sensor": None if sensor is None else str(sensor),
        "index": index,
        "max_angle": max_angle,
        "max_cameras": max_cameras,
        "uncorrected": uncorrected.value,
        "dimensions": dimensions.value,
        "summary": None if summary is None else str(summary),
        "overwrite": overwrite or None,
        "jobs": jobs,
    }
    typer.echo(json.dumps(pipeline_for(input, output, settings, options), indent=2))

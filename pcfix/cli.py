"""The command line: turns words into one call of `pcfix.flow` or `pcfix.simulate`, no more."""

from __future__ import annotations

import sys
import time
import warnings
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import pcfix
from pcfix.errors import PcfixError, show_warning
from pcfix.model import DEFAULT_REFRACTIVE_INDEX

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

app = typer.Typer(
    name="pcfix",
    help="Refraction correction of through-water photogrammetric point clouds.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


class Uncorrected(str, Enum):  # noqa: UP042 - typer shows the values of a str Enum
    """What becomes of submerged points that cannot be corrected."""

    withhold = "withhold"
    keep = "keep"
    drop = "drop"


class Dimensions(str, Enum):  # noqa: UP042
    """Which extra dimensions are written."""

    all = "all"
    minimal = "minimal"
    none = "none"


class Block(str, Enum):  # noqa: UP042
    """How the simulated cameras fly."""

    nadir = "nadir"
    oblique = "oblique"


Input = Annotated[
    Path, typer.Argument(metavar="INPUT", help="LAS or LAZ cloud.", show_default=False)
]
Output = Annotated[
    Path, typer.Argument(metavar="OUTPUT", help="LAS or LAZ to write.", show_default=False)
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an output that exists.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No summary and no progress.")]
Jobs = Annotated[int | None, typer.Option(help="Threads.", show_default="all cores")]


@app.callback(invoke_without_command=True)
def version(
    show: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    """Refraction correction of through-water photogrammetric point clouds."""
    if show:
        typer.echo(f"pcfix {pcfix.__version__}")
        raise typer.Exit


CamerasOption = Annotated[
    Path,
    typer.Option("--cameras", help="CSV: label,x,y,z and, if known, yaw,pitch,roll (degrees)."),
]
WaterOption = Annotated[
    str,
    typer.Option("--water", help="A level (0.37), plane:a,b,c, dim:NAME, or a mesh (.obj, .ply)."),
]
Sensor = Annotated[
    Path | None,
    typer.Option(
        help="CSV: focal,sensor_x,sensor_y in mm.", show_default="sensor.csv beside the cameras"
    ),
]
Index = Annotated[float, typer.Option(help="Refractive index of the water relative to air.")]
MaxAngle = Annotated[
    float | None, typer.Option(help="Use rays up to this incidence angle, degrees.")
]
MaxCameras = Annotated[int | None, typer.Option(help="Use so many rays a point, the steepest.")]
UncorrectedOption = Annotated[
    Uncorrected,
    typer.Option("--uncorrected", help="Submerged points with fewer than two usable rays."),
]
DimensionsOption = Annotated[
    Dimensions,
    typer.Option("--dimensions", help="Extra dimensions; 'pcfix restore' needs all."),
]
SummaryOption = Annotated[Path | None, typer.Option("--summary", help="Write the summary as JSON.")]


@app.command(no_args_is_help=True)
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

    with _progress("Correcting", quiet) as progress:
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


@app.command(no_args_is_help=True)
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


@app.command(no_args_is_help=True)
def restore(
    input: Input,
    output: Output,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    jobs: Jobs = None,
) -> None:
    """Give back the cloud as it was before 'pcfix correct', bit for bit."""
    with _progress("Restoring", quiet) as progress:
        points = pcfix.restore_file(
            input, output, overwrite=overwrite, jobs=jobs, progress=progress
        )
    if not quiet:
        typer.echo(f"{input} -> {output}: {points:,} points as they were")


@app.command(no_args_is_help=True)
def simulate(
    out_dir: Annotated[
        Path, typer.Argument(metavar="OUT_DIR", help="Folder for the scene.", show_default=False)
    ],
    block: Annotated[Block, typer.Option(help="Nadir images only, or obliques too.")] = Block.nadir,
    points: Annotated[int, typer.Option(help="Points of the cloud.")] = 100_000,
    cameras: Annotated[
        int | None,
        typer.Option(help="About so many nadir images.", show_default="as the area needs"),
    ] = None,
    index: Annotated[
        float, typer.Option(help="Refractive index of the water.")
    ] = DEFAULT_REFRACTIVE_INDEX,
    water: Annotated[float, typer.Option(help="Water level, m.")] = 0.37,
    image_noise: Annotated[float, typer.Option(help="Noise of image points, px (sd).")] = 0.5,
    seed: Annotated[int, typer.Option(help="Of the random numbers.")] = 1,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Make a scene with known truth: cloud, cameras, truth, LiDAR."""
    from pcfix.io.scenes import write_scene

    with _progress("Simulating", quiet) as progress:
        scene = pcfix.simulate_scene(
            points=points,
            block=block.value,
            cameras=cameras,
            refractive_index=index,
            water_level_m=water,
            image_noise_px=image_noise,
            seed=seed,
            progress=progress,
        )
        write_scene(scene, out_dir, overwrite=overwrite)
    if not quiet:
        typer.echo(f"{out_dir}: {scene.description}")


@app.command()
def demo(
    out_dir: Annotated[Path, typer.Argument(metavar="OUT_DIR", help="Folder to make.")] = Path(
        "pcfix-demo"
    ),
    points: Annotated[int, typer.Option(help="Points of each scene.")] = 50_000,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Simulate, correct, and show how far the cloud is from the truth."""
    from pcfix.simulate.demo import run_demo

    with _progress("Simulating and correcting", quiet) as progress:
        table = run_demo(out_dir, points=points, overwrite=overwrite, progress=progress)
    typer.echo(table)


@contextmanager
def _progress(title: str, quiet: bool) -> Iterator[Callable[[int, int], None] | None]:
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


def main() -> None:
    """Run the command line; a user's mistake is one line on stderr and exit code 1."""
    warnings.showwarning = show_warning
    try:
        app()
    except PcfixError as error:
        typer.echo(f"pcfix: {error}", err=True)
        sys.exit(1)
    except BrokenPipeError:
        sys.exit(1)

"""``pcfix simulate`` and ``pcfix demo``."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

import pcfix
from pcfix.cli.words import Overwrite, Quiet, progress_bar
from pcfix.settings import DEFAULT_REFRACTIVE_INDEX


class Block(str, Enum):  # noqa: UP042
    """How the simulated cameras fly."""

    nadir = "nadir"
    oblique = "oblique"


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

    with progress_bar("Simulating", quiet) as progress:
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

    with progress_bar("Simulating and correcting", quiet) as progress:
        table = run_demo(out_dir, points=points, overwrite=overwrite, progress=progress)
    typer.echo(table)

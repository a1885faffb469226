"""``pcfix simulate`` and ``pcfix demo``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

import pcfix
from pcfix.cli.groups import takes
from pcfix.cli.refraction_effect import EffectWords, check_unused, refraction_effect
from pcfix.cli.words import Overwrite, Quiet, progress_bar
from pcfix.options import DEFAULT_REFRACTIVE_INDEX


class Block(str, Enum):  # noqa: UP042
    """How the simulated cameras fly."""

    nadir = "nadir"
    oblique = "oblique"


class Bed(str, Enum):  # noqa: UP042
    """The shape of the simulated ground."""

    shore = "shore"
    flat = "flat"
    slope = "slope"
    steps = "steps"
    river = "river"


class Cloud(str, Enum):  # noqa: UP042
    """How the simulated cloud is made of the images."""

    tracks = "tracks"
    pairs = "pairs"
    depth_maps = "depth-maps"


FLIGHT, CAMERA, WATER, CLOUD = "Flight", "Camera", "Water and ground", "Clouds"


@dataclass(frozen=True)
class SceneWords:
    """Options by the names, and with the defaults, of `pcfix.simulate.settings.SceneSettings`."""

    flying_height_m: Annotated[
        float, typer.Option(help="Above the water.", rich_help_panel=FLIGHT)
    ] = 80.0
    area_m: Annotated[
        tuple[float, float],
        typer.Option(help="Extent along and across the strips.", rich_help_panel=FLIGHT),
    ] = (120.0, 80.0)
    forward_overlap: Annotated[
        float, typer.Option(help="Share of an image in the next.", rich_help_panel=FLIGHT)
    ] = 0.8
    side_overlap: Annotated[
        float, typer.Option(help="Share of a strip in the next.", rich_help_panel=FLIGHT)
    ] = 0.7
    obliques_deg: Annotated[
        float | None,
        typer.Option(
            help="Fly obliques at this angle from straight down.",
            show_default="20 in oblique blocks",
            rich_help_panel=FLIGHT,
        ),
    ] = None
    oblique_directions: Annotated[
        int, typer.Option(help="Headings of obliques, from north.", rich_help_panel=FLIGHT)
    ] = 4
    oblique_share: Annotated[
        float | None,
        typer.Option(
            help="Share of the images that are obliques, 1: all.",
            show_default="each direction a third as dense as the nadir images",
            rich_help_panel=FLIGHT,
        ),
    ] = None
    position_noise_m: Annotated[
        float,
        typer.Option(help="Error (sd) of the projection centres given.", rich_help_panel=FLIGHT),
    ] = 0.0
    attitude_noise_deg: Annotated[
        float,
        typer.Option(help="Error (sd) of the yaw, pitch, roll given.", rich_help_panel=FLIGHT),
    ] = 0.0
    focal_mm: Annotated[float, typer.Option(help="Focal length.", rich_help_panel=CAMERA)] = 8.8
    sensor_mm: Annotated[
        tuple[float, float],
        typer.Option(help="Width and height of the sensor.", rich_help_panel=CAMERA),
    ] = (13.2, 8.8)
    sensor_px: Annotated[
        tuple[int, int], typer.Option(help="The same in pixels.", rich_help_panel=CAMERA)
    ] = (5472, 3648)
    distortion: Annotated[
        tuple[float, float, float, float, float],
        typer.Option(
            help="Brown's k1 k2 k3 p1 p2, in Metashape's order; all known to the user.",
            rich_help_panel=CAMERA,
        ),
    ] = (0.0, 0.0, 0.0, 0.0, 0.0)
    wave_slope_deg: Annotated[
        float,
        typer.Option(help="Slope (sd, along an axis) of waves.", rich_help_panel=WATER),
    ] = 0.0
    wave_length_m: Annotated[float, typer.Option(help="Of waves.", rich_help_panel=WATER)] = 1.0
    tilt_percent: Annotated[
        float | None,
        typer.Option(
            help="How steeply the water falls.",
            show_default="0, of a river 0.3",
            rich_help_panel=WATER,
        ),
    ] = None
    tilt_heading_deg: Annotated[
        float,
        typer.Option(help="Where it falls to, clockwise from north.", rich_help_panel=WATER),
    ] = 90.0
    bed: Annotated[Bed, typer.Option(help="Shape of the ground.", rich_help_panel=WATER)] = (
        Bed.shore
    )
    greatest_depth_m: Annotated[
        float | None,
        typer.Option(
            help="Below the water.",
            show_default="shore 12, flat 3, slope 6, steps 6, river 2.5",
            rich_help_panel=WATER,
        ),
    ] = None
    cloud: Annotated[
        Cloud,
        typer.Option(
            help="Of all images at once, the median of stereo pairs, or fused depth maps.",
            rich_help_panel=CLOUD,
        ),
    ] = Cloud.tracks
    detection: Annotated[
        float,
        typer.Option(
            help="Probability that an image that shows a point takes part.", rich_help_panel=CLOUD
        ),
    ] = 1.0
    neighbours: Annotated[
        int | None,
        typer.Option(
            help="Images that each is matched with.",
            show_default="pairs 4, depth-maps 5",
            rich_help_panel=CLOUD,
        ),
    ] = None
    lidar_per_m2: Annotated[
        float, typer.Option(help="Points of the LiDAR per m2.", rich_help_panel=CLOUD)
    ] = 2.0
    lidar_noise_m: Annotated[
        float, typer.Option(help="Error (sd) of its heights.", rich_help_panel=CLOUD)
    ] = 0.05


@takes(EffectWords)
@takes(SceneWords)
def simulate(
    words: SceneWords,
    effect: EffectWords,
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
    water: Annotated[float, typer.Option(help="Water level, m, mid area.")] = 0.37,
    image_noise: Annotated[float, typer.Option(help="Noise of image points, px (sd).")] = 0.5,
    seed: Annotated[int, typer.Option(help="Of the random numbers.")] = 1,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Make a scene with known truth: cloud, cameras, truth, LiDAR."""
    from pcfix.io.scenes import write_scene

    if effect.refraction_effect:
        told = refraction_effect(effect, out_dir, index=index, seed=seed, overwrite=overwrite)
        if not quiet:
            typer.echo(told)
        return
    check_unused(effect)
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
            **{name: getattr(value, "value", value) for name, value in asdict(words).items()},
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
    from pcfix.flow.demo import run_demo

    with progress_bar("Simulating and correcting", quiet) as progress:
        table = run_demo(out_dir, points=points, overwrite=overwrite, progress=progress)
    typer.echo(table)

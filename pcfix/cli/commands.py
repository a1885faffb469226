"""The commands, each of which turns its flags into one call, no more."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import pcfix
from pcfix.cli.flags import FLAGS, Quiet, UsageError, check_needed, progress_bar, say, status_line
from pcfix.options.correct import CorrectOptions, LabelOptions
from pcfix.options.declare import options_of
from pcfix.options.handover import PlanOptions, PluginOptions, ViewerOptions
from pcfix.options.photos import CalmOptions, OrthoOptions, PhotosOptions
from pcfix.options.scenes import DemoOptions, SimulateOptions
from pcfix.options.shared import TileOptions
from pcfix.options.steps import CleanOptions, CompareOptions, DsmOptions
from pcfix.options.survey import AdjustOptions, CamerasCheckOptions, RunOptions, WaterCheckOptions

Input = Annotated[Path, Parameter(help="LAS or LAZ cloud.")]
TILED = "LAS or LAZ cloud; a folder, glob, list (.txt) or index (.vpc) of tiles."
Inputs = Annotated[str, Parameter(help=TILED)]
Output = Annotated[Path, Parameter(help="LAS or LAZ to write; a folder for tiles.")]


def run(
    input: Annotated[str | None, Parameter(help=TILED)] = None,
    out_dir: Annotated[Path | None, Parameter(help="Folder for all results.")] = None,
    /,
    *,
    options: Annotated[RunOptions, FLAGS] = RunOptions(),
    config: Annotated[
        Path | None, Parameter(help="run.json of an earlier run, to repeat it.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Adjust, correct, clean, grid, compare and report; resumes where it stopped.

    With --config give only the folder: pcfix run OUT_DIR --config run.json.
    """
    from pcfix.flow.request import Request, request_of
    from pcfix.flow.run import run_all

    if config is not None:
        folder = out_dir or input
        if folder is None or options.cameras is not None or options.water is not None:
            raise UsageError("with --config give OUT_DIR alone")
        request = request_of(config)
    else:
        if input is None or out_dir is None:
            raise UsageError("INPUT and OUT_DIR are needed")
        check_needed(options)
        values = {one.name: getattr(options, one.name) for one in options_of(RunOptions)}
        request, folder = Request(input=input, **values), out_dir
    run_all(
        request,
        Path(str(folder)),
        overwrite=options.overwrite,
        jobs=options.jobs,
        say=lambda text: say(text, quiet),
        bar=partial(progress_bar, quiet=quiet),
    )


def correct(
    input: Inputs,
    output: Output,
    /,
    *,
    options: Annotated[CorrectOptions, FLAGS] = CorrectOptions(),
    quiet: Quiet = False,
) -> None:
    """Move the points below the water surface to where they are."""
    check_needed(options, water=False)
    if options.water is None and options.port is None:
        raise UsageError("--water is needed, or --port for a cloud taken under water")
    from pcfix.report.text import summary_text

    with progress_bar("Correcting", quiet) as progress:
        result = pcfix.correct_file(input, output, options=options, progress=progress)
    say(summary_text(result), quiet)


def pipeline(
    input: Input,
    output: Annotated[Path | None, Parameter(help="LAS or LAZ to write.")] = None,
    /,
    *,
    options: Annotated[CorrectOptions, FLAGS] = CorrectOptions(),
    stage: Annotated[
        bool,
        Parameter(
            negative=(), help="Print its stage alone, for a pipeline of one's own.", group="Output"
        ),
    ] = False,
) -> None:
    """Print the PDAL pipeline of the same 'pcfix correct', as JSON."""
    from pcfix.flow.pipeline import pipeline_for, stage_for

    check_needed(options)
    if output is None and not stage:
        raise UsageError("OUTPUT is needed, or --stage for the stage alone")
    job = (
        pipeline_for(input, output, options) if output and not stage else stage_for(input, options)
    )
    say(json.dumps(job, indent=2))


def adjust(
    model: Annotated[Path, Parameter(help="Camera poses, with tie points or beside a cloud.")],
    out: Annotated[Path, Parameter(help="Folder for the adjusted model.")],
    /,
    *,
    options: Annotated[AdjustOptions, FLAGS] = AdjustOptions(),
    quiet: Quiet = False,
    jobs: Annotated[int | None, Parameter(help="Threads.", group="Output")] = None,
) -> None:
    """Adjust poses, lens and points with the light bent at the water."""
    if (options.water is None) == (options.port is None):
        raise UsageError("give --water, or --port for images taken under water")
    from pcfix.flow.next_steps import correct_words
    from pcfix.kernels import threads
    from pcfix.report.adjustment import adjustment_text, before_of

    with threads(jobs), status_line("Adjusting", quiet) as progress:
        found = pcfix.adjust_cameras(model, out, options=options, progress=progress)
    say(adjustment_text(found, before_of(found)), quiet)
    cloud = "" if options.cloud else " (CLOUD.laz is the cloud that the old cameras made)"
    say(f"Next{cloud}: {correct_words(found, model, out, options)}", quiet)


def label(
    input: Inputs,
    output: Output,
    /,
    *,
    options: Annotated[LabelOptions, FLAGS] = LabelOptions(),
    quiet: Quiet = False,
) -> None:
    """Give the points below the water surface class 40, and change nothing else."""
    check_needed(options)
    from pcfix.report.text import labelling_text

    with progress_bar("Labelling", quiet) as progress:
        result = pcfix.label_file(input, output, options=options, progress=progress)
    say(labelling_text(result), quiet)


def clean(
    input: Inputs,
    output: Output,
    /,
    *,
    options: Annotated[CleanOptions, FLAGS] = CleanOptions(),
    quiet: Quiet = False,
) -> None:
    """Flag the noise of a cloud: outliers, weak intersections, points off the bed."""
    from pcfix.report.text import cleaning_text

    with progress_bar("Cleaning", quiet) as progress:
        result = pcfix.clean_file(input, output, options=options, progress=progress)
    say(cleaning_text(result), quiet)


def dsm(
    input: Inputs,
    output: Annotated[Path, Parameter(help="GeoTIFF to write.")],
    /,
    *,
    options: Annotated[DsmOptions, FLAGS] = DsmOptions(),
    quiet: Quiet = False,
) -> None:
    """Grid a cloud to a GeoTIFF: height, count and spread."""
    check_needed(options)
    from pcfix.report.text import dsm_text

    with progress_bar("Gridding", quiet) as progress:
        result = pcfix.grid_dsm(input, output, options=options, progress=progress)
    say(dsm_text(result), quiet)


def photos(
    images: Annotated[Path, Parameter(help="Folder of photographs.")],
    out_dir: Annotated[Path, Parameter(help="Folder for them without water, or for the rounds.")],
    /,
    *,
    options: Annotated[PhotosOptions, FLAGS] = PhotosOptions(),
    quiet: Quiet = False,
) -> None:
    """Take the water out of photographs, and with --rebuild make the cloud anew from them."""
    check_needed(options)
    from pcfix.report.text import photos_text, rounds_text

    with progress_bar("Mapping", quiet, unit="photographs") as progress:
        if options.rebuild is None:
            text = photos_text(
                pcfix.map_photos(images, out_dir, options=options, progress=progress)
            )
        else:
            found = pcfix.rebuild_rounds(
                images, out_dir, options=options, progress=progress, say=lambda t: say(t, quiet)
            )
            text = rounds_text(found)
    say(text, quiet)


def ortho(
    images: Annotated[Path, Parameter(help="Folder of photographs.")],
    output: Annotated[Path, Parameter(help="GeoTIFF to write.")],
    /,
    *,
    options: Annotated[OrthoOptions, FLAGS] = OrthoOptions(),
    quiet: Quiet = False,
) -> None:
    """Lay photographs on the corrected DSM: the orthophoto of land and bed."""
    check_needed(options)
    from pcfix.report.text import ortho_text

    with progress_bar("Laying out", quiet, unit="cells") as progress:
        result = pcfix.ortho_photo(images, output, options=options, progress=progress)
    say(ortho_text(result), quiet)


def compare(
    cloud: Inputs,
    reference: Annotated[
        str,
        Parameter(help="LAS or LAZ, or tiles; CSV check points (x,y,z), or a GeoTIFF of heights."),
    ],
    /,
    *,
    options: Annotated[CompareOptions, FLAGS] = CompareOptions(),
    quiet: Quiet = False,
) -> None:
    """Measure how far a cloud is from a reference, before and after correction."""
    from pcfix.report.comparison import comparison_text

    result = pcfix.compare_clouds(cloud, reference, options=options)
    say(comparison_text(result), quiet)


def calm(
    frames: Annotated[Path, Parameter(help="Folder of photographs, or a video.")],
    out: Annotated[Path, Parameter(help="Image to write, of the frames' format; PNG of a video.")],
    /,
    *,
    options: Annotated[CalmOptions, FLAGS] = CalmOptions(),
    quiet: Quiet = False,
) -> None:
    """Make of a sequence of one place through waves the image through calm water."""
    from pcfix.report.text import calm_text

    with progress_bar("Calming", quiet) as progress:
        result = pcfix.calm_frames(frames, out, options=options, progress=progress)
    say(calm_text(result), quiet)


def cameras(
    path: Annotated[Path, Parameter(help="File or folder of camera poses.")],
    /,
    *,
    options: Annotated[CamerasCheckOptions, FLAGS] = CamerasCheckOptions(),
) -> None:
    """Say what a camera file holds, whether it fits a cloud, and whether it absorbed refraction."""
    from pcfix.flow.checks import check_cameras
    from pcfix.report.cameras import cameras_text

    say(cameras_text(check_cameras(path, options)))


def water(
    spec: Annotated[str, Parameter(help="As --water of 'pcfix correct'.")],
    /,
    *,
    options: Annotated[WaterCheckOptions, FLAGS] = WaterCheckOptions(),
) -> None:
    """Read, fit or find a water surface, and say how well it is known."""
    from pcfix.flow.checks import check_water
    from pcfix.report.water import water_text

    say(water_text(check_water(spec, options)))


def restore(
    input: Inputs,
    output: Output,
    /,
    *,
    options: Annotated[TileOptions, FLAGS] = TileOptions(),
    quiet: Quiet = False,
) -> None:
    """Give back the cloud as it was before 'pcfix correct', bit for bit."""
    with progress_bar("Restoring", quiet) as progress:
        points = pcfix.restore_file(input, output, options=options, progress=progress)
    say(f"{input} -> {output}: {points:,} points as they were", quiet)


def simulate(
    out_dir: Annotated[Path, Parameter(help="Folder for the scene.")],
    /,
    *,
    options: Annotated[SimulateOptions, FLAGS] = SimulateOptions(),
    quiet: Quiet = False,
) -> None:
    """Make a scene with known truth: cloud, cameras, truth, LiDAR."""
    if options.refraction_effect:
        from pcfix.flow.papers import write_refraction_effect

        say(write_refraction_effect(out_dir, options), quiet)
        return
    from pcfix.io.scenes import write_scene

    with progress_bar("Simulating", quiet) as progress:
        scene = pcfix.simulate_scene(options=options, progress=progress)
        write_scene(scene, out_dir, overwrite=options.overwrite)
    say(f"{out_dir}: {scene.description}", quiet)


def plan(*, options: Annotated[PlanOptions, FLAGS] = PlanOptions(), quiet: Quiet = False) -> None:
    """Predict what a flight over water will measure, and say what would make it better."""
    from pcfix.report.plan import plan_text

    with progress_bar("Planning", quiet, unit="beds") as progress:
        found = pcfix.plan_flight(options=options, progress=progress)
    say(plan_text(found), quiet)


def view(
    *clouds: Annotated[Path, Parameter(help="LAS or LAZ clouds.")],
    options: Annotated[ViewerOptions, FLAGS] = ViewerOptions(),
    quiet: Quiet = False,
) -> None:
    """Show clouds in space, before and after, with reference, cameras and water."""
    found = pcfix.view_clouds(clouds, options=options)
    if found:
        say(found, quiet)


def qgis_plugin(
    out: Annotated[Path, Parameter(help="ZIP to write.")],
    /,
    *,
    options: Annotated[PluginOptions, FLAGS] = PluginOptions(),
    quiet: Quiet = False,
) -> None:
    """Pack the plugin of QGIS: pcfix's commands as algorithms of its toolbox.

    In QGIS: Plugins > Manage and Install Plugins > Install from ZIP.
    """
    from pcfix.cli.plugin import plugin_zip
    from pcfix.io.files import write_bytes

    write_bytes(out, plugin_zip(one for one, _ in EXAMPLES), overwrite=options.overwrite)
    say(f"{out}: install it in QGIS by Plugins > Manage and Install Plugins > Install from ZIP;"
        f" its environment of pcfix (Settings > Options > Processing > Providers > pcfix) is"
        f" {Path(sys.prefix)}", quiet)  # fmt: skip


def demo(
    out_dir: Annotated[Path, Parameter(help="Folder to make.")] = Path("pcfix-demo"),
    /,
    *,
    options: Annotated[DemoOptions, FLAGS] = DemoOptions(),
    quiet: Quiet = False,
) -> None:
    """Simulate, correct, and show how far the cloud is from the truth."""
    from pcfix.flow.demo import run_demo

    bar = partial(progress_bar, quiet=quiet)
    say(run_demo(out_dir, points=options.points, overwrite=options.overwrite, bar=bar))


EXAMPLES: tuple[tuple[Callable[..., None], str], ...] = (
    (run, "pcfix run cloud.laz out --cameras cameras.xml --water 0.37 --reference lidar.laz"),
    (correct, "pcfix correct cloud.laz corrected.laz --cameras cameras.csv --water 0.37"),
    (adjust, "pcfix adjust sparse adjusted --water 0.37 --cloud cloud.laz --gnss gnss.csv"),
    (label, "pcfix label cloud.laz labelled.laz --water shore.csv"),
    (clean, "pcfix clean corrected.laz cleaned.laz"),
    (dsm, "pcfix dsm cleaned.laz bed.tif --resolution 0.5 --surface bed"),
    (ortho, "pcfix ortho images bed.tif --cameras cameras.xml --dsm dsm.tif --water 0.37"),
    (compare, "pcfix compare cleaned.laz lidar.laz --submerged"),
    (photos, "pcfix photos images dry --cameras cameras.xml --dsm bed.tif --water 0.37"),
    (calm, "pcfix calm frames calm.jpg --surface --depth 2.5 --gsd 0.01 --interval 0.2"),
    (view, "pcfix view corrected.laz --reference lidar.laz --colour error --image errors.png"),
    (cameras, "pcfix cameras cameras.xml --cloud cloud.laz --water 0.37 --plot block.png"),
    (water, "pcfix water shore.csv --cloud cloud.laz --plot water.png"),
    (restore, "pcfix restore corrected.laz cloud.laz"),
    (simulate, "pcfix simulate scene --points 20000"),
    (pipeline, "pcfix pipeline cloud.laz corrected.laz --cameras cameras.csv --water 0.37"),
    (plan, "pcfix plan --height 60 --overlap 0.8 --sidelap 0.7 --depth 5 --plot plan.png"),
    (qgis_plugin, "pcfix qgis-plugin pcfix.zip"),
    (demo, "pcfix demo"),
)
"""The commands in the order of the help, each with a line that shows it at work."""

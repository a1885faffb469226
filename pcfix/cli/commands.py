"""The commands: each calls one function of the Python interface."""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pcfix
from pcfix.cli.flags import COMMANDS, command, plugin_table, progress_bar, say, status_line
from pcfix.options.correct import (
    AdjustOptions,
    CamerasCheckOptions,
    CorrectOptions,
    LabelOptions,
    RunOptions,
    WaterCheckOptions,
)
from pcfix.options.shared import OverwriteOption, TileOptions
from pcfix.options.steps import (
    CalmOptions,
    CleanOptions,
    CompareOptions,
    DemoOptions,
    DsmOptions,
    OrthoOptions,
    PhotosOptions,
    PlanOptions,
    SimulateOptions,
    ViewerOptions,
)

TILED = "LAS or LAZ cloud; a folder, glob, list (.txt) or index (.vpc) of tiles."
CLOUD = "LAS or LAZ to write; a folder for tiles."


def _summarized(
    title: str, name: str, quiet: bool, work: Callable[..., Any], *given: Any, unit: str = "points"
) -> Any:
    """Call a function of two files and options with a progress bar, print and return its result."""
    from pcfix.report.text import text_of

    with progress_bar(title, quiet, unit=unit) as progress:
        result = work(*given[:2], options=given[2], progress=progress)
    say(text_of(name, result), quiet)
    return result


@command(
    "pcfix run cloud.laz out --cameras cameras.xml --water 0.37 --reference lidar.laz",
    input=TILED,
    out_dir="Folder for all results.",
)
def run(input: str, out_dir: Path, /, *, options: RunOptions, quiet: bool) -> None:
    """Adjust, correct, clean, grid, compare and report; resumes where it stopped."""
    shown: Any = {"say": partial(say, quiet=quiet), "bar": partial(progress_bar, quiet=quiet)}
    pcfix.run(input, out_dir, options=options, **shown)


@command(
    "pcfix correct cloud.laz corrected.laz --cameras cameras.csv --water 0.37",
    input=TILED,
    output=CLOUD,
    verbose="Also print the evidence for the reconstruction type, and the error budget.",
)
def correct(
    input: str, output: Path, /, *, options: CorrectOptions, verbose: bool = False, quiet: bool
) -> None:
    """Correct a point cloud for refraction at the water surface."""
    from pcfix.report.text import details_text

    found = _summarized("Correcting", "correct", quiet, pcfix.correct_file, input, output, options)
    if verbose:
        say(details_text(found), quiet)


@command(
    "pcfix adjust sparse adjusted --water 0.37 --cloud cloud.laz --gnss gnss.csv",
    model="Camera poses with tie points, or without them if --cloud is given.",
    out="Folder for the adjusted model.",
)
def adjust(model: Path, out: Path, /, *, options: AdjustOptions, quiet: bool) -> None:
    """Refine camera poses and lens by a refractive bundle adjustment."""
    from pcfix.adjust.result import adjustment_dict
    from pcfix.flow.adjust import correct_words
    from pcfix.report.adjustment import adjustment_text

    with status_line("Adjusting", quiet) as progress:
        found = pcfix.adjust_cameras(model, out, options=options, progress=progress)
    say(adjustment_text(adjustment_dict(found)), quiet)
    cloud = "" if options.cloud else ", with the cloud of the original cameras as CLOUD.laz"
    say(f"Next step{cloud}:\n  {correct_words(found, model, out, options)}", quiet)


@command("pcfix label cloud.laz labelled.laz --water shore.csv", input=TILED, output=CLOUD)
def label(input: str, output: Path, /, *, options: LabelOptions, quiet: bool) -> None:
    """Classify points below the water surface (class 40)."""
    _summarized("Labelling", "label", quiet, pcfix.label_file, input, output, options)


@command("pcfix clean corrected.laz cleaned.laz", input=TILED, output=CLOUD)
def clean(input: str, output: Path, /, *, options: CleanOptions, quiet: bool) -> None:
    """Flag noise: outliers, weak intersections, points far from the bed."""
    _summarized("Cleaning", "clean", quiet, pcfix.clean_file, input, output, options)


@command(
    "pcfix dsm cleaned.laz bed.tif --resolution 0.5 --surface bed",
    input=TILED,
    output="GeoTIFF to write.",
)
def dsm(input: str, output: Path, /, *, options: DsmOptions, quiet: bool) -> None:
    """Grid a cloud to a GeoTIFF: height, count and spread."""
    _summarized("Gridding", "dsm", quiet, pcfix.grid_dsm, input, output, options)


@command(
    "pcfix ortho images bed.tif --cameras cameras.xml --dsm dsm.tif --water 0.37",
    images="Folder of photographs.",
    output="GeoTIFF to write.",
)
def ortho(images: Path, output: Path, /, *, options: OrthoOptions, quiet: bool) -> None:
    """Make an orthophoto of land and bed from photographs and the corrected DSM."""
    given = images, output, options
    _summarized("Rectifying", "ortho", quiet, pcfix.ortho_photo, *given, unit="cells")


@command(
    "pcfix compare cleaned.laz lidar.laz --submerged",
    cloud=TILED,
    reference="LAS or LAZ, or tiles; CSV check points (x,y,z), or a GeoTIFF of heights.",
)
def compare(cloud: str, reference: str, /, *, options: CompareOptions, quiet: bool) -> None:
    """Compare a cloud with a reference, before and after correction."""
    from pcfix.report.comparison import comparison_text

    result = pcfix.compare_clouds(cloud, reference, options=options)
    say(comparison_text(result.as_dict()), quiet)


@command(
    "pcfix photos images dry --cameras cameras.xml --dsm bed.tif --water 0.37",
    images="Folder of photographs.",
    out_dir="Folder for the results, or for the rounds.",
)
def photos(images: Path, out_dir: Path, /, *, options: PhotosOptions, quiet: bool) -> None:
    """Remove refraction from photographs, for use in any SfM software."""
    given, unit = (images, out_dir, options), "photographs"
    if options.rebuild is None:
        _summarized("Mapping", "photos", quiet, pcfix.map_photos, *given, unit=unit)
    else:
        work = partial(pcfix.rebuild_rounds, say=partial(say, quiet=quiet))
        _summarized("Mapping", "rebuild", quiet, work, *given, unit=unit)


@command(
    "pcfix calm frames calm.jpg --surface --depth 2.5 --gsd 0.01 --interval 0.2",
    frames="Folder of photographs, or a video.",
    out="Image to write, in the format of the frames; PNG for a video.",
)
def calm(frames: Path, out: Path, /, *, options: CalmOptions, quiet: bool) -> None:
    """Combine a burst of frames into one image as seen through calm water."""
    _summarized("Combining", "calm", quiet, pcfix.calm_frames, frames, out, options)


@command(
    "pcfix view corrected.laz --reference lidar.laz --colour error --image errors.png",
    clouds="LAS or LAZ clouds.",
)
def view(*clouds: Path, options: ViewerOptions, quiet: bool) -> None:
    """Show clouds in 3D, before and after, with reference, cameras and water."""
    found = pcfix.view_clouds(clouds, options=options)
    if found:
        say(found, quiet)


@command(
    "pcfix cameras cameras.xml --cloud cloud.laz --water 0.37",
    path="File or folder of camera poses.",
)
def cameras(path: Path, /, *, options: CamerasCheckOptions) -> None:
    """Inspect a camera file: contents, fit to the cloud, absorbed refraction."""
    from pcfix.flow.cameras import cameras_text, check_cameras

    say(cameras_text(check_cameras(path, options)))


@command(
    "pcfix water shore.csv --cloud cloud.laz", spec="Water surface, as --water of 'pcfix correct'."
)
def water(spec: str, /, *, options: WaterCheckOptions) -> None:
    """Read, fit or detect a water surface, with its standard error."""
    from pcfix.flow.water import check_water, water_text

    say(water_text(*check_water(spec, options)))


@command("pcfix restore corrected.laz cloud.laz", input=TILED, output=CLOUD)
def restore(input: str, output: Path, /, *, options: TileOptions, quiet: bool) -> None:
    """Undo a correction exactly."""
    with progress_bar("Restoring", quiet) as progress:
        points = pcfix.restore_file(input, output, options=options, progress=progress)
    say(f"{input} -> {output}: {points:,} points restored", quiet)


@command("pcfix simulate scene --points 20000", out_dir="Folder for the scene.")
def simulate(out_dir: Path, /, *, options: SimulateOptions, quiet: bool) -> None:
    """Simulate a scene with known truth: cloud, cameras, truth, LiDAR."""
    from pcfix.flow.demo import write_scene

    with progress_bar("Simulating", quiet) as progress:
        scene = pcfix.simulate_scene(options=options, progress=progress)
        write_scene(scene, out_dir, overwrite=options.overwrite)
    say(f"{out_dir}: {scene.description}", quiet)


@command("pcfix plan --height 60 --overlap 0.8 --sidelap 0.7 --depth 1,2,5")
def plan(*, options: PlanOptions, quiet: bool) -> None:
    """Predict the accuracy of a planned flight."""
    from pcfix.flow.plan import plan_text

    with progress_bar("Planning", quiet, unit="beds") as progress:
        found = pcfix.plan_flight(options=options, progress=progress)
    say(plan_text(found), quiet)


@command("pcfix qgis-plugin pcfix.zip", out="ZIP to write.")
def qgis_plugin(out: Path, /, *, options: OverwriteOption, quiet: bool) -> None:
    """Write the QGIS plugin: the commands of pcfix as algorithms of its toolbox.

    In QGIS: Plugins > Manage and Install Plugins > Install from ZIP.
    """
    from pcfix.io.files import packed_plugin, write_bytes

    plugin = packed_plugin(plugin_table(COMMANDS), pcfix.__version__)
    write_bytes(out, plugin, overwrite=options.overwrite)
    say(
        f"{out}: install it in QGIS, then set its environment to {Path(sys.prefix)} in"
        " Settings > Options > Processing > Providers > pcfix.", quiet,
    )  # fmt: skip


@command("pcfix demo", out_dir="Folder to create.")
def demo(out_dir: Path = Path("pcfix-demo"), /, *, options: DemoOptions, quiet: bool) -> None:
    """Simulate scenes, correct them, and compare with the truth."""
    from pcfix.flow.demo import run_demo

    bar = partial(progress_bar, quiet=quiet)
    say(run_demo(out_dir, points=options.points, overwrite=options.overwrite, bar=bar))

"""All steps in one call: adjust, correct, clean, grid, compare, draw the map, report."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from pcfix.compare.m3c2 import load_py4dgeo
from pcfix.errors import PcfixWarning, SettingError
from pcfix.flow.clean import clean_file
from pcfix.flow.compare import compare_clouds
from pcfix.flow.correct import correct_file
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.maps import SECTIONS, raster_files, resolution_sentence, write_map, write_rasters
from pcfix.flow.report import report_run
from pcfix.flow.request import Files, Record, Request
from pcfix.flow.run_adjust import adjust_first, figures_of, outputs_of
from pcfix.flow.runner import Bar, Progress, no_bar
from pcfix.flow.shore import check_shoreline
from pcfix.flow.tiles import check_folder
from pcfix.io.clouds import is_cloud
from pcfix.io.rasters import write_dod
from pcfix.io.tiles import Tiles, check_one_file
from pcfix.io.vectors import check_layers
from pcfix.options.correct import CorrectOptions
from pcfix.options.declare import options_of
from pcfix.options.steps import CleanOptions, DistanceOptions
from pcfix.report.adjustment import adjustment_sentence, all_notes

Plain = dict[str, Any]

RECORD = "run.json"

REFERENCE_DSM = "reference_dsm.tif"


def run_all(
    request: Request,
    out_dir: Path,
    *,
    say: Callable[[str], None] = lambda text: None,
    bar: Bar = no_bar,
) -> Path:
    """Do every step that is not done yet, and return the path of the report.

    A run with the same request resumes in its folder; if only options of later steps changed, such
    as the reference, only these steps are done again. The option `overwrite` replaces a cloud that
    was corrected in another way, and what else is in the folder. `say` gets a line for each step,
    `bar` shows its progress.
    """
    inputs = [path for some in request.files().values() for path in some]
    files, asked = Files(out_dir, request.source), request
    if request.m3c2:
        load_py4dgeo()
    check_one_file(request.source, request)
    if isinstance(request.source, Tiles):
        check_folder(files.corrected, request.source)
    record = _opened(request, out_dir)
    check_shoreline(request.shoreline, overwrite=asked.overwrite or record.resumes, inputs=inputs)

    def step(
        name: str, title: str, outputs: list[Path], work: Callable[[Progress | None], Any]
    ) -> tuple[Any, str]:
        """Do a step unless it is done; return its result, and the start of its line."""
        with bar(title) as progress:
            result, was_done = record.step(name, outputs, partial(work, progress))
        return result, f"{name:<9} {'done before' if was_done else 'done'}: "

    outputs = outputs_of(out_dir)
    first, done = step(
        "adjust", "Adjusting", outputs, lambda _: adjust_first(asked, out_dir, inputs)
    )
    if first["adjusted"]:
        figures = figures_of(out_dir)
        say(f"{done}{outputs[0]}")
        for words in (adjustment_sentence(figures), *all_notes(figures)):
            say(f"{'':<9} {words}")
    elif first["is_said"]:
        say(f"{'adjust':<9} not done: {first['why']}")
    request = request.with_adjusted(out_dir, first)

    outputs = files.parts(files.corrected)
    outputs += [] if request.check_depths is None else [files.regression]
    outputs += [] if request.shoreline is None else [Path(request.shoreline)]
    corrected, done = step("correct", "Correcting", outputs, partial(_correct, request, files))
    poses = corrected["poses"]
    if first["is_fine"] and poses is not None and poses["absorbed"] is None:
        # the first step has surveys that the correction has not
        words = "did not absorb the refraction, as the first step found"
        corrected = {**corrected, "poses": {**poses, "absorbed": False, "words": words}}
    if not first["is_said"] and first["why"] and (poses or {}).get("absorbed"):
        first = {**first, "is_said": True}
        say(f"{'adjust':<9} not done: {first['why']}")
    say(f"{done}{files.corrected}")

    # the corrected cloud marks which points are below the water
    how = CleanOptions(overwrite=True, jobs=asked.jobs, scheduler=asked.scheduler)
    _, done = step(
        "clean", "Cleaning", files.parts(files.cleaned),
        lambda progress: clean_file(
            files.corrected_cloud, files.cleaned, options=how, progress=progress
        ).as_dict(),
    )  # fmt: skip
    say(f"{done}{files.cleaned}")

    errors = corrected["uncertainty"] is not None
    outputs = raster_files(out_dir, errors=errors)
    made, done = step(
        "dsm", "Gridding", outputs,
        lambda progress: write_rasters(request, files, errors=errors, progress=progress),
    )  # fmt: skip
    given = request.resolution is not None
    say(f"{done}{outputs[0]}{resolution_sentence(made, given=given)}")

    compared: Plain = {}
    if request.reference is not None:
        outputs = [files.compare / "compare.json"]
        compared, done = step("compare", "Comparing", outputs, lambda _: _compare(request, files))
        say(f"{done}{outputs[0]}")

    try:
        check_layers(files.map)
    except SettingError as error:
        say(f"{'map':<9} not written: {error}")
    else:
        _, done = step(
            "map", "Drawing the map", [files.map],
            lambda _: write_map(request, files, corrected, compared),
        )  # fmt: skip
        say(f"{done}{files.map}")

    page, done = step(
        "report", "Writing the report", [files.report],
        lambda _: report_run(request, files, inputs, first, corrected, compared),
    )  # fmt: skip
    say(f"{done}{files.report}: {page['in_short']}")
    return files.report


def _opened(request: Request, out_dir: Path) -> Record:
    """Return the record of a folder, made where it is missing; refuse one of another run."""
    if not out_dir.parent.is_dir():
        raise SettingError(
            "output.no_folder",
            f"{out_dir}: the folder {out_dir.parent} does not exist. Make it first.",
            path=out_dir,
        )
    out_dir.mkdir(exist_ok=True)
    record = Record(out_dir / RECORD, request.record(), request.watched(out_dir))
    if not (request.overwrite or record.resumes) and any(out_dir.iterdir()):
        changed = ", ".join(record.changed) or "input file, or other files"
        raise SettingError(
            "run.other",
            f"{out_dir}: holds a run with another {changed}. Add --overwrite to replace it, or give"
            " another folder.",
            path=out_dir,
            changed=record.changed,
        )
    return record


def _correct(request: Request, files: Files, progress: Progress | None) -> Plain:
    """Correct the cloud."""
    options = replace(request, overwrite=True).part(CorrectOptions)
    if request.check_depths is not None:
        options = replace(options, save_regression=files.regression)
    files.remove_others()
    return vars(correct_file(request.source, files.corrected, options=options, progress=progress))


def _compare(request: Request, files: Files) -> Plain:
    """Compare the cleaned cloud with the reference, and write a raster of differences."""
    reference = request.surveyed
    result = compare_clouds(
        files.cleaned_cloud, reference, out_dir=files.compare, sections=SECTIONS, overwrite=True,
        **{one.name: getattr(request, one.name) for one in options_of(DistanceOptions)},
    )  # fmt: skip
    if request.has_surface:
        heights = Path(str(reference))
        if is_cloud(reference):
            heights = files.compare / REFERENCE_DSM
            # the cells are those of the cloud, whatever a warning says
            with warnings.catch_warnings(action="ignore", category=PcfixWarning):
                grid_dsm(reference, heights, resolution=files.resolution_m, overwrite=True)
        write_dod(files.surface, heights, files.dod, overwrite=True)
    sections = [
        {
            "distance_m": section.distance_m.tolist(),
            "heights_m": {
                name: [None if math.isnan(value) else value for value in heights_m.tolist()]
                for name, heights_m in section.heights_m.items()
            },
        }
        for section in result.sections
    ]
    points = [] if result.check_points is None else result.check_points.tolist()
    return {"figures": result.as_dict(), "sections": sections, "check_points": points}

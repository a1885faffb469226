"""All steps in one call: adjust, correct, clean, grid, compare, draw the map, report."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from pcfix.adjust.diagnosis import MOST_STATED_M
from pcfix.compare.m3c2 import load_py4dgeo
from pcfix.errors import PcfixError, PcfixWarning, SettingError
from pcfix.flow.adjust import SUMMARY, adjust_into
from pcfix.flow.clean import clean_file
from pcfix.flow.compare import compare_clouds
from pcfix.flow.correct import correct_file
from pcfix.flow.diagnosis import diagnose_inputs, has_datum
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.inputs import Inputs
from pcfix.flow.maps import SECTIONS, raster_files, resolution_sentence, write_map, write_rasters
from pcfix.flow.next_steps import FOLDER, MODELS
from pcfix.flow.report import PAGE, report_run
from pcfix.flow.request import SURFACE, Record, Request, RunFolder
from pcfix.flow.runner import Bar, Progress, check_folder, no_bar
from pcfix.flow.shore import check_shoreline
from pcfix.flow.surfaces import view_of
from pcfix.io.clouds import is_cloud
from pcfix.io.files import read_json
from pcfix.io.gnss_positions import read_gnss
from pcfix.io.members import FILE as MEMBERS
from pcfix.io.rasters import write_dod
from pcfix.io.tiles import Tiles, check_one_file
from pcfix.io.vectors import check_layers
from pcfix.model import WaterDimension
from pcfix.options.correct import CorrectOptions
from pcfix.options.declare import options_of
from pcfix.options.steps import CleanOptions, DistanceOptions
from pcfix.options.survey import AdjustOptions
from pcfix.report.adjustment import adjustment_sentence, all_notes
from pcfix.running import threads
from pcfix.water.index import with_index

Plain = dict[str, Any]

RECORD = "run.json"
REFERENCE_DSM = "reference_dsm.tif"
COLMAP = ("cameras.bin", "images.bin", "points3D.bin", "georeference.json")
ADJUSTED = ("report.html", SUMMARY, MEMBERS, *(f"colmap/{name}" for name in COLMAP), *MODELS[1:])
"""The files that an adjustment may leave, its report first."""


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
    run, asked = RunFolder(out_dir, request), request
    if request.m3c2:
        load_py4dgeo()
    check_one_file(request.source, request)
    if isinstance(request.source, Tiles):
        check_folder(run.corrected, request.source.paths)
    record = _opened(request, out_dir)
    check_shoreline(request.shoreline, overwrite=asked.overwrite or record.resumes, inputs=inputs)

    def step(
        name: str, title: str, outputs: list[Path], work: Callable[[Progress | None], Any]
    ) -> tuple[Any, str]:
        """Do a step unless it is done; return its result, and the start of its line."""
        with bar(title) as progress:
            result, was_done = record.step(name, outputs, partial(work, progress))
        return result, f"{name:<9} {'done before' if was_done else 'done'}: "

    outputs = [out_dir / FOLDER / name for name in ADJUSTED]
    first, done = step(
        "adjust", "Adjusting", outputs, lambda _: adjust_first(asked, out_dir, inputs)
    )
    if first["adjusted"]:
        figures = read_json(out_dir / FOLDER / SUMMARY)
        say(f"{done}{outputs[0]}")
        for words in (adjustment_sentence(figures), *all_notes(figures)):
            say(f"{'':<9} {words}")
    elif first["is_said"]:
        say(f"{'adjust':<9} not done: {first['why']}")
    request = request.with_adjusted(out_dir, first)
    run = RunFolder(out_dir, request)

    outputs = run.files_of(run.corrected)
    outputs += [] if request.check_depths is None else [run.regression]
    outputs += [] if request.shoreline is None else [Path(request.shoreline)]
    corrected, done = step("correct", "Correcting", outputs, partial(_correct, run))
    poses = corrected["poses"]
    if first["is_fine"] and poses is not None and poses["absorbed"] is None:
        # the first step has surveys that the correction has not
        words = "did not absorb the refraction, as the first step found"
        corrected = {**corrected, "poses": {**poses, "absorbed": False, "words": words}}
    if not first["is_said"] and first["why"] and (poses or {}).get("absorbed"):
        first = {**first, "is_said": True}
        say(f"{'adjust':<9} not done: {first['why']}")
    say(f"{done}{run.corrected}")

    # the corrected cloud marks which points are below the water
    how = CleanOptions(overwrite=True, jobs=asked.jobs, scheduler=asked.scheduler)
    _, done = step(
        "clean", "Cleaning", run.files_of(run.cleaned),
        lambda progress: clean_file(
            run.corrected_cloud, run.cleaned, options=how, progress=progress
        ).as_dict(),
    )  # fmt: skip
    say(f"{done}{run.cleaned}")

    errors = corrected["uncertainty"] is not None
    outputs = raster_files(out_dir, errors=errors)
    made, done = step(
        "dsm", "Gridding", outputs,
        lambda progress: write_rasters(run, errors=errors, progress=progress),
    )  # fmt: skip
    given = request.resolution is not None
    say(f"{done}{outputs[0]}{resolution_sentence(made, given=given)}")

    compared: Plain = {}
    if request.reference is not None:
        outputs = [run.compare / "compare.json"]
        compared, done = step("compare", "Comparing", outputs, lambda _: _compare(run))
        say(f"{done}{outputs[0]}")

    layers = out_dir / "map.gpkg"
    try:
        check_layers(layers)
    except SettingError as error:
        say(f"{'map':<9} not written: {error}")
    else:
        draw = partial(write_map, layers, run, corrected, compared)
        _, done = step("map", "Drawing the map", [layers], lambda _: draw())
        say(f"{done}{layers}")

    path = out_dir / PAGE
    page, done = step(
        "report", "Writing the report", [path],
        lambda _: report_run(run, inputs, first, corrected, compared),
    )  # fmt: skip
    say(f"{done}{path}: {page['in_short']}")
    return path


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


def adjust_first(request: Request, folder: Path, files: list[Path]) -> Plain:
    """Adjust the cameras of a run into its folder if asked, or if they need it.

    The files are inputs of the run, which the adjustment must not replace.

    Returns
    -------
    dict
        `adjusted`, a bool; `model`, the file or folder with the cameras in that of the adjustment;
        `why`; `is_said`, whether that is worth a line; `is_fine`, whether the poses are known to be
        right.
    """
    found = {"adjusted": False, "model": None, "why": "", "is_said": False, "is_fine": False}
    try:
        found |= _decide(request)
        if found["adjusted"]:
            found["model"] = _adjust(request, folder / FOLDER, files)
    except PcfixError as error:
        if request.adjust == "yes" or request.only_to_adjust:
            raise
        # a file that cannot be read will stop the correction, with the same message
        found |= {"adjusted": False, "why": str(error), "is_said": found["adjusted"]}
    return found


def _decide(request: Request) -> Plain:
    """Return whether to adjust: if asked, or if the poses absorbed refraction and there is a datum.

    Signs of absorbed refraction do not include the survey with which the result is compared: the
    cloud must not depend on it.
    """
    if request.adjust == "yes":
        return {"adjusted": True, "why": "that was asked for", "is_said": True}
    if request.adjust == "no":
        return {}
    inputs, is_said = request.part(Inputs), bool(request.only_to_adjust)
    if request.why_not_adjust:
        return {"why": request.why_not_adjust, "is_said": is_said}
    view = view_of(request.source)
    # the correction shows the warnings
    with warnings.catch_warnings(action="ignore", category=PcfixWarning):
        cameras = inputs.block(view.crs)[0]
        if request.gnss is not None:
            cameras = read_gnss(request.gnss, cameras)
        elif request.gcps is None and not has_datum(cameras, str(request.cameras)):
            why = (
                "there is no datum: no --gcps, no --gnss, and no GNSS positions better than"
                f" {MOST_STATED_M:g} m in the camera file"
            )
            return {"why": why, "is_said": is_said}
        water = inputs.surface(view).surface
        if isinstance(water, WaterDimension):
            why = f"the water {water} is known at points of the cloud only"
            return {"why": why, "is_said": True}
        index = with_index(request).refractive_index
        sign = diagnose_inputs(
            inputs, cameras, view, water, index, gcps=request.gcps, in_passing=not is_said
        ).decided_by
    if sign is None:
        why = "nothing shows whether the poses absorbed the refraction; --adjust yes adjusts anyway"
        return {"why": why, "is_said": True}
    did = "absorbed" if sign.speaks else "did not absorb"
    why = f"the poses {did} the refraction: {sign.words}"
    return {"adjusted": sign.speaks, "why": why, "is_said": True, "is_fine": not sign.speaks}


def _adjust(request: Request, target: Path, files: list[Path]) -> str:
    """Adjust, and return which of `MODELS` has the cameras."""
    check_folder(target, files, mark=SUMMARY)  # the adjustment replaces it
    given = AdjustOptions(
        gcps=request.gcps, gnss=request.gnss, lens=request.lens,
        index=with_index(request).refractive_index, overwrite=True,
    )  # fmt: skip
    with threads(request.jobs):
        adjust_into(target, request.part(Inputs), given, request.source)
    return next(name for name in MODELS if (target / name).exists())


def _correct(run: RunFolder, progress: Progress | None) -> Plain:
    """Correct the cloud."""
    options = replace(run.request, overwrite=True).part(CorrectOptions)
    if options.check_depths is not None:
        options = replace(options, save_regression=run.regression)
    source = run.request.source
    return vars(correct_file(source, run.corrected, options=options, progress=progress))


def _compare(run: RunFolder) -> Plain:
    """Compare the cleaned cloud with the reference, and write a raster of differences."""
    request = run.request
    reference = request.surveyed
    result = compare_clouds(
        run.cleaned_cloud, reference, out_dir=run.compare, sections=SECTIONS, overwrite=True,
        **{one.name: getattr(request, one.name) for one in options_of(DistanceOptions)},
    )  # fmt: skip
    if request.has_surface:
        heights = Path(str(reference))
        if is_cloud(reference):
            heights = run.compare / REFERENCE_DSM
            # the cells are those of the cloud, whatever a warning says
            with warnings.catch_warnings(action="ignore", category=PcfixWarning):
                grid_dsm(reference, heights, resolution=run.resolution_m, overwrite=True)
        write_dod(run.folder / SURFACE, heights, run.dod, overwrite=True)
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

"""All steps in one call: adjust, correct, clean, grid, compare, report."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from pcfix.compare.m3c2 import load_py4dgeo
from pcfix.errors import PcfixWarning, SettingError
from pcfix.flow.clean import clean_file
from pcfix.flow.compare import compare_clouds
from pcfix.flow.correct import correct_file
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.inputs import Inputs
from pcfix.flow.layers import Drawn, write_map
from pcfix.flow.old_cameras import read_blocks
from pcfix.flow.rasters import raster_files, resolution_sentence, write_rasters
from pcfix.flow.record import Record
from pcfix.flow.report import write_report
from pcfix.flow.request import Files, Request, since
from pcfix.flow.run_adjust import FOLDER, adjust_first, figures_of, is_worth_saying, outputs_of
from pcfix.flow.runner import Bar, Progress, no_bar
from pcfix.flow.shore import check_shoreline
from pcfix.flow.surfaces import view_of
from pcfix.flow.tiles import check_folder
from pcfix.grid.maps import MOST_CELLS
from pcfix.io.clouds import is_cloud, own_water
from pcfix.io.geopackage import check_layers
from pcfix.io.rasters import open_raster, preview, write_dod
from pcfix.io.tiles import Tiles, check_one_file, open_cloud
from pcfix.model import Cameras, WaterSurface
from pcfix.options.correct import CorrectOptions
from pcfix.options.declare import options_of
from pcfix.options.steps import CleanOptions, DistanceOptions
from pcfix.refract.tally import Summary
from pcfix.report.adjustment import (
    adjustment_sentence,
    adjustment_tables,
    all_notes,
    reason_sentence,
)
from pcfix.report.comparison import evaluation, in_a_sentence
from pcfix.report.first_screen import Survey, in_short, is_found
from pcfix.report.page import Picture, Table
from pcfix.report.run import Later
from pcfix.report.text import uncertainty_sentence
from pcfix.report.water import found_picture

RECORD = "run.json"
SECTIONS = 3
DOD, REFERENCE_DSM = "dod.tif", "reference_dsm.tif"
Work: TypeAlias = Callable[[Progress | None], Any]


def run_all(
    request: Request,
    out_dir: Path,
    *,
    overwrite: bool = False,
    jobs: int | None = None,
    say: Callable[[str], None] = lambda text: None,
    bar: Bar = no_bar,
) -> Path:
    """Do every step that is not done yet; what ``pcfix run`` runs.

    Parameters
    ----------
    request : Request
    out_dir : Path
        Made where its parent exists. A run with the same request resumes there; if only options
        of later steps changed, such as the reference, only these steps are done again.
    overwrite : bool
        Replace a cloud that was corrected in another way, and what else lies there.
    jobs : int, optional
        Threads.
    say : callable, optional
        Called with a line on each step.
    bar : callable, optional
        Shows the progress of a step; see `pcfix.flow.runner.Bar`.

    Returns
    -------
    Path
        Of the report.

    Raises
    ------
    PcfixError
        With one sentence on what to do; the steps before it stay done.
    """
    read = request.files()
    inputs = [path for some in read.values() for path in some]
    files = Files(out_dir, request.source)
    if request.m3c2:
        load_py4dgeo()
    check_one_file(request.source, request)
    if isinstance(request.source, Tiles):
        check_folder(files.corrected, request.source)
    record = _opened(request, out_dir, overwrite)
    check_shoreline(request.shoreline, overwrite=overwrite or record.resumes, inputs=inputs)
    shore = [] if request.shoreline is None else [Path(request.shoreline)]

    def do(name: str, outputs: list[Path], work: Work) -> tuple[Any, bool]:
        """Return the result of a step, and whether it was done before."""

        def with_bar() -> Any:
            with bar(_TITLES[name]) as progress:
                return work(progress)

        return record.step(name, outputs, with_bar)

    def step(name: str, outputs: list[Path], work: Work, more: Any = None) -> Any:
        """Do a step that is not done yet, and print a line on it."""
        result, was_done = do(name, outputs, work)
        shown = {"correct": files.corrected, "clean": files.cleaned}.get(name, outputs[0])
        done = "done before" if was_done else "done"
        say(f"{name:<9} {done}: {shown}{more(result) if more else ''}")
        return result

    first, was_done = do(
        "adjust", outputs_of(out_dir), lambda _: adjust_first(request, out_dir, inputs, jobs)
    )
    _say_adjusted(first, out_dir, was_done, say)
    request = request.with_adjusted(out_dir, first)
    line = [] if request.check_depths is None else [files.regression]
    outputs = [*files.parts(files.corrected), *line, *shore]
    corrected = step("correct", outputs, partial(_correct, request, files, jobs))
    corrected = _with_checked(corrected, first)
    absorbed = bool((corrected["poses"] or {}).get("absorbed"))
    if not first["is_said"] and is_worth_saying(first, absorbed):
        first = {**first, "is_said": True}
        _say_adjusted(first, out_dir, was_done, say)
    step("clean", files.parts(files.cleaned), partial(_clean, request, files, jobs))
    errors = corrected["uncertainty"] is not None
    cells = partial(resolution_sentence, given=request.resolution is not None)
    outputs = raster_files(out_dir, errors=errors)
    step("dsm", outputs, partial(_grid, request, files, errors), cells)
    done = {"adjust": first, "correct": corrected, "compare": None}
    if request.reference is not None:
        outputs = [files.compare / "compare.json"]
        done["compare"] = step("compare", outputs, lambda _: _compare(request, files))
    try:
        check_layers(files.map)
    except SettingError as error:
        say(f"{'map':<9} not written: {error}")
    else:
        step("map", [files.map], lambda _: _map(request, files, done))
    step(
        "report",
        [files.report],
        lambda _: _report(request, files, inputs, done),
        lambda result: f": {result['in_short']}",
    )
    return files.report


def _opened(request: Request, out_dir: Path, overwrite: bool) -> Record:
    """Return the record of a folder, made where it is missing; refuse one of another run."""
    if not out_dir.parent.is_dir():
        raise SettingError(
            "output.no_folder",
            f"{out_dir}: the folder {out_dir.parent} does not exist. Make it first.",
            path=out_dir,
        )
    out_dir.mkdir(exist_ok=True)
    record = Record(out_dir / RECORD, request.record(), request.watched(out_dir), since)
    if not (overwrite or record.resumes) and any(out_dir.iterdir()):
        changed = ", ".join(record.changed) or "input file, or other files"
        raise SettingError(
            "run.other",
            f"{out_dir}: holds a run with another {changed}. Add --overwrite to replace it, or give"
            " another folder.",
            path=out_dir,
            changed=record.changed,
        )
    return record


_TITLES = {
    "adjust": "Adjusting", "correct": "Correcting", "clean": "Cleaning", "dsm": "Gridding",
    "compare": "Comparing", "map": "Drawing the map", "report": "Writing the report",
}  # fmt: skip


def _say_adjusted(
    first: dict[str, Any], out_dir: Path, was_done: bool, say: Callable[[str], None]
) -> None:
    """Print the result of the adjustment; nothing if there was no question of one."""
    if first["adjusted"]:
        say(f"{'adjust':<9} {'done before' if was_done else 'done'}: {outputs_of(out_dir)[0]}")
        figures = figures_of(out_dir)
        for line in (adjustment_sentence(figures), *all_notes(figures)):
            say(f"{'':<9} {line}")
    elif first["is_said"]:
        say(f"{'adjust':<9} not done: {first['why']}")


def _correct(
    request: Request, files: Files, jobs: int | None, progress: Progress | None
) -> dict[str, Any]:
    options = replace(request, overwrite=True, jobs=jobs).part(CorrectOptions)
    if request.check_depths is not None:
        options = replace(options, save_regression=files.regression)
    files.remove_others()
    summary = correct_file(request.source, files.corrected, options=options, progress=progress)
    return vars(summary)


def _with_checked(corrected: dict[str, Any], first: dict[str, Any]) -> dict[str, Any]:
    """Return the correction with what the first step found of its poses, by surveys it has not."""
    poses = corrected["poses"]
    if not first.get("is_fine") or poses is None or poses["absorbed"] is not None:
        return corrected
    words = "did not absorb the refraction, as the first step found"
    return {**corrected, "poses": {**poses, "absorbed": False, "words": words}}


def _clean(
    request: Request, files: Files, jobs: int | None, progress: Progress | None
) -> dict[str, Any]:
    # no water is given: the corrected cloud has a surface of a dimension, and marks what is below
    options = CleanOptions(overwrite=True, jobs=jobs, scheduler=request.scheduler)
    cloud = files.corrected_cloud
    return clean_file(cloud, files.cleaned, options=options, progress=progress).as_dict()


def _grid(
    request: Request, files: Files, errors: bool, progress: Progress | None
) -> dict[str, Any]:
    return write_rasters(
        files.cleaned_cloud, files.folder, resolution=request.resolution,
        cameras=_cameras(request, files), errors=errors, progress=progress,
    )  # fmt: skip


def _inputs(request: Request) -> Inputs:
    """Return the inputs of the correction, without the view list."""
    return replace(request, views=None).part(Inputs)


def _cameras(request: Request, files: Files) -> Cameras:
    """Return the cameras in the CRS of the cloud; notes were shown when it was corrected."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PcfixWarning)
        return read_blocks(_inputs(request), view_of(files.corrected_cloud).crs).cameras


def _compare(request: Request, files: Files) -> dict[str, Any]:
    reference = request.surveyed
    asked = {one.name: getattr(request, one.name) for one in options_of(DistanceOptions)}
    result = compare_clouds(
        files.cleaned_cloud,
        reference,
        out_dir=files.compare,
        sections=SECTIONS,
        overwrite=True,
        **asked,
    )
    if _has_dod(request):
        heights = Path(str(reference))
        if is_cloud(reference):
            heights = files.compare / REFERENCE_DSM
            with open_raster(files.surface) as dsm:
                resolution = float(dsm.res[0])
            with warnings.catch_warnings():  # the cells are those of the cloud
                warnings.simplefilter("ignore", PcfixWarning)
                grid_dsm(reference, heights, resolution=resolution, overwrite=True)
        write_dod(files.surface, heights, files.compare / DOD, overwrite=True)
    sections = [
        {
            "distance_m": section.distance_m.tolist(),
            "heights_m": {
                name: [None if math.isnan(value) else value for value in heights.tolist()]
                for name, heights in section.heights_m.items()
            },
        }
        for section in result.sections
    ]
    points = [] if result.check_points is None else result.check_points.tolist()
    return {"figures": result.as_dict(), "sections": sections, "check_points": points}


def _map(request: Request, files: Files, done: dict[str, Any]) -> dict[str, int]:
    """Write the vector layers; the water's height has one standard error for all places."""
    summary, compared = done["correct"], done["compare"] or {}
    fitted = (summary["water_fit"] or {}).get("sigma_level_m")
    drawn = Drawn(
        cloud=files.cleaned_cloud,
        folder=files.folder,
        water=_water(request, files),
        sigma_level_m=request.sigma_level if request.sigma_level is not None else fitted,
        cameras=_cameras(request, files),
        unused=summary["cameras_unused"],
        sections=compared.get("figures", {}).get("sections", []),
        check_points=np.array(compared.get("check_points", [])).reshape(-1, 4),
        check_depths=request.check_depths,
    )
    return write_map(files.map, drawn, view_of(files.cleaned_cloud).crs)


def _water(request: Request, files: Files) -> WaterSurface:
    """Return the surface as the corrected cloud states it, else as it was asked for."""
    with warnings.catch_warnings():  # they were shown when the cloud was corrected
        warnings.simplefilter("ignore", PcfixWarning)
        with open_cloud(files.corrected_cloud) as source:
            stated = own_water(source)
        return stated or _inputs(request).surface(view_of(files.corrected_cloud)).surface


def _has_dod(request: Request) -> bool:
    """Whether the comparison makes a raster of differences: not with check points."""
    suffix = Path(str(request.reference)).suffix.lower()
    return is_cloud(request.surveyed) or suffix in (".tif", ".tiff")


def _report(
    request: Request, files: Files, inputs: list[Path], done: dict[str, Any]
) -> dict[str, Any]:
    pictures: list[Picture] = []
    tables: list[Table] = []
    dod = None
    first, compared = done["adjust"], done["compare"]
    verdict = reason_sentence(first["adjusted"], first["why"]) if first["is_said"] else ""
    if compared is not None:
        dod = preview(files.compare / DOD, MOST_CELLS) if _has_dod(request) else None
        pictures, tables = evaluation(compared["figures"], compared["sections"], dod)
        verdict += in_a_sentence(compared["figures"])
    if first["adjusted"]:
        tables += adjustment_tables(figures_of(files.folder), f"{FOLDER}/report.html")
    summary = Summary(**done["correct"])
    again = _inputs(request)
    cameras = _cameras(request, files)
    if is_found(summary):
        pictures.append(found_picture(again.surface(view_of(request.source))))
    with open_raster(files.surface) as dsm:
        resolution = float(dsm.res[0])
    figures = {} if compared is None else compared["figures"]
    later = Later(pictures, tables, verdict, figures, dod, resolution)
    report = write_report(
        files.cleaned_cloud,
        files.folder,
        summary=summary,
        cameras=cameras,
        water=_water(request, files),
        inputs=inputs,
        survey=Survey(request.project or "", request.date or again.dates(cameras)),
        later=later,
        overwrite=True,
    )
    return {
        "in_short": in_short(report.tiles),
        "uncertainty": uncertainty_sentence(summary, later.tvu),
        "title": report.title,
        "tiles": [asdict(tile) for tile in report.tiles],
        "place": report.place,
    }

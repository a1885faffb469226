"""All steps in one call: adjust, correct, clean, grid, compare, draw the map, report."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.compare.m3c2 import load_py4dgeo
from pcfix.errors import PcfixWarning, SettingError
from pcfix.flow.clean import clean_file
from pcfix.flow.compare import compare_clouds
from pcfix.flow.correct import correct_file
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.inputs import Inputs
from pcfix.flow.maps import SECTIONS, raster_files, resolution_sentence, write_map, write_rasters
from pcfix.flow.next_steps import FOLDER
from pcfix.flow.old_cameras import read_blocks
from pcfix.flow.record import Record
from pcfix.flow.report import write_report
from pcfix.flow.request import Files, Request, since
from pcfix.flow.run_adjust import adjust_first, figures_of, outputs_of
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
from pcfix.report.adjustment import adjustment_sentence, adjustment_tables, all_notes
from pcfix.report.comparison import evaluation, in_a_sentence
from pcfix.report.page import Picture, Table
from pcfix.report.run import Later, Survey, in_short, is_found
from pcfix.report.text import uncertainty_sentence
from pcfix.report.water import found_picture

Plain = dict[str, Any]

RECORD = "run.json"

DOD, REFERENCE_DSM = "dod.tif", "reference_dsm.tif"


def run_all(
    request: Request,
    out_dir: Path,
    *,
    overwrite: bool = False,
    jobs: int | None = None,
    say: Callable[[str], None] = lambda text: None,
    bar: Bar = no_bar,
) -> Path:
    """Do every step that is not done yet, and return the path of the report.

    A run with the same request resumes in its folder; if only options of later steps changed, such
    as the reference, only these steps are done again. `overwrite` replaces a cloud that was
    corrected in another way, and what else is in the folder. `say` gets a line for each step, `bar`
    shows its progress.
    """
    inputs = [path for some in request.files().values() for path in some]
    files, asked = Files(out_dir, request.source), request
    if request.m3c2:
        load_py4dgeo()
    check_one_file(request.source, request)
    if isinstance(request.source, Tiles):
        check_folder(files.corrected, request.source)
    record = _opened(request, out_dir, overwrite)
    check_shoreline(request.shoreline, overwrite=overwrite or record.resumes, inputs=inputs)

    def step(
        name: str, title: str, outputs: list[Path], work: Callable[[Progress | None], Any]
    ) -> tuple[Any, str]:
        """Do a step unless it is done; return its result, and the start of its line."""
        with bar(title) as progress:
            result, was_done = record.step(name, outputs, partial(work, progress))
        return result, f"{name:<9} {'done before' if was_done else 'done'}: "

    outputs = outputs_of(out_dir)
    first, done = step(
        "adjust", "Adjusting", outputs, lambda _: adjust_first(asked, out_dir, inputs, jobs)
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
    corrected, done = step(
        "correct", "Correcting", outputs, partial(_correct, request, files, jobs)
    )
    poses = corrected["poses"]
    if first["is_fine"] and poses is not None and poses["absorbed"] is None:
        # the first step has surveys that the correction has not
        words = "did not absorb the refraction, as the first step found"
        corrected = {**corrected, "poses": {**poses, "absorbed": False, "words": words}}
    if not first["is_said"] and first["why"] and (corrected["poses"] or {}).get("absorbed"):
        first = {**first, "is_said": True}
        say(f"{'adjust':<9} not done: {first['why']}")
    say(f"{done}{files.corrected}")

    _, done = step(
        "clean", "Cleaning", files.parts(files.cleaned),
        partial(_clean, files, CleanOptions(overwrite=True, jobs=jobs, scheduler=asked.scheduler)),
    )  # fmt: skip
    say(f"{done}{files.cleaned}")

    errors = corrected["uncertainty"] is not None
    outputs = raster_files(out_dir, errors=errors)
    made, done = step("dsm", "Gridding", outputs, partial(_grid, request, files, errors))
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
            lambda _: _draw_map(request, files, corrected, compared),
        )  # fmt: skip
        say(f"{done}{files.map}")

    page, done = step(
        "report", "Writing the report", [files.report],
        lambda _: _report(request, files, inputs, first, corrected, compared),
    )  # fmt: skip
    say(f"{done}{files.report}: {page['in_short']}")
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


def _correct(request: Request, files: Files, jobs: int | None, progress: Progress | None) -> Plain:
    """Correct the cloud."""
    options = replace(request, overwrite=True, jobs=jobs).part(CorrectOptions)
    if request.check_depths is not None:
        options = replace(options, save_regression=files.regression)
    files.remove_others()
    return vars(correct_file(request.source, files.corrected, options=options, progress=progress))


def _clean(files: Files, options: CleanOptions, progress: Progress | None) -> Plain:
    """Flag the noise; the corrected cloud marks which points are below the water."""
    cloud, target = files.corrected_cloud, files.cleaned
    return clean_file(cloud, target, options=options, progress=progress).as_dict()


def _grid(request: Request, files: Files, errors: bool, progress: Progress | None) -> Plain:
    """Write all rasters."""
    return write_rasters(
        files.cleaned_cloud, files.folder, resolution=request.resolution,
        cameras=_cameras(request, files), errors=errors, progress=progress,
    )  # fmt: skip


def _compare(request: Request, files: Files) -> Plain:
    """Compare the cleaned cloud with the reference, and write a raster of differences."""
    reference = request.surveyed
    result = compare_clouds(
        files.cleaned_cloud, reference, out_dir=files.compare, sections=SECTIONS, overwrite=True,
        **{one.name: getattr(request, one.name) for one in options_of(DistanceOptions)},
    )  # fmt: skip
    if _has_dod(request):
        heights = Path(str(reference))
        if is_cloud(reference):
            heights = files.compare / REFERENCE_DSM
            with warnings.catch_warnings():  # the cells are those of the cloud
                warnings.simplefilter("ignore", PcfixWarning)
                grid_dsm(reference, heights, resolution=_resolution(files), overwrite=True)
        write_dod(files.surface, heights, files.compare / DOD, overwrite=True)
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


def _has_dod(request: Request) -> bool:
    """Whether the comparison makes a raster of differences: not with check points."""
    suffix = Path(str(request.reference)).suffix.lower()
    return is_cloud(request.surveyed) or suffix in (".tif", ".tiff")


def _draw_map(request: Request, files: Files, corrected: Plain, compared: Plain) -> dict[str, int]:
    """Write the vector layers; the water's height has one standard error for all places."""
    fitted = (corrected["water_fit"] or {}).get("sigma_level_m")
    return write_map(
        files.map, files.cleaned_cloud, files.folder,
        water=_water(request, files),
        sigma_level_m=fitted if request.sigma_level is None else request.sigma_level,
        cameras=_cameras(request, files),
        unused=corrected["cameras_unused"],
        sections=compared.get("figures", {}).get("sections", []),
        check_points=np.array(compared.get("check_points", [])).reshape(-1, 4),
        check_depths=request.check_depths,
    )  # fmt: skip


def _report(
    request: Request, files: Files, inputs: list[Path], first: Plain, corrected: Plain,
    compared: Plain,
) -> Plain:  # fmt: skip
    """Write the page."""
    pictures, tables, dod, verdict = list[Picture](), list[Table](), None, ""
    if first["adjusted"]:
        verdict = f" The cameras were adjusted first, as {first['why']}."
    elif first["is_said"]:
        verdict = f" The cameras were not adjusted: {first['why']}."
    if compared:
        dod = preview(files.compare / DOD, MOST_CELLS) if _has_dod(request) else None
        pictures, tables = evaluation(compared["figures"], compared["sections"], dod)
        verdict += in_a_sentence(compared["figures"])
    if first["adjusted"]:
        tables += adjustment_tables(figures_of(files.folder), f"{FOLDER}/report.html")
    summary, again, cameras = Summary(**corrected), _inputs(request), _cameras(request, files)
    if is_found(summary):
        pictures.append(found_picture(again.surface(view_of(request.source))))
    later = Later(pictures, tables, verdict, compared.get("figures", {}), dod, _resolution(files))
    page = write_report(
        files.cleaned_cloud, files.folder, summary=summary, cameras=cameras,
        water=_water(request, files), inputs=inputs, later=later, overwrite=True,
        survey=Survey(request.project or "", request.date or again.dates(cameras)),
    )  # fmt: skip
    return {
        "in_short": in_short(page.tiles),
        "uncertainty": uncertainty_sentence(summary, later.tvu),
        "title": page.title,
        "tiles": [asdict(tile) for tile in page.tiles],
        "place": page.place,
    }


# What several steps read


def _inputs(request: Request) -> Inputs:
    """Return the inputs of the correction, without the view list."""
    return replace(request, views=None).part(Inputs)


def _cameras(request: Request, files: Files) -> Cameras:
    """Return the cameras in the CRS of the cloud; notes were shown when it was corrected."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PcfixWarning)
        return read_blocks(_inputs(request), view_of(files.corrected_cloud).crs).cameras


def _water(request: Request, files: Files) -> WaterSurface:
    """Return the surface as the corrected cloud states it, else as it was asked for."""
    cloud = files.corrected_cloud
    with warnings.catch_warnings():  # they were shown when the cloud was corrected
        warnings.simplefilter("ignore", PcfixWarning)
        with open_cloud(cloud) as source:
            stated = own_water(source)
        return stated or _inputs(request).surface(view_of(cloud)).surface


def _resolution(files: Files) -> float:
    with open_raster(files.surface) as dsm:
        return float(dsm.res[0])

"""The steps of a run, as functions of what is known when they begin."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.errors import PcfixWarning, SettingError
from pcfix.flow.clean import clean_file
from pcfix.flow.compare import compare_clouds
from pcfix.flow.correct import correct_file
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.inputs import Inputs, read_blocks
from pcfix.flow.layers import Drawn, write_map
from pcfix.flow.next_steps import FOLDER
from pcfix.flow.rasters import raster_files, resolution_sentence, write_rasters
from pcfix.flow.report import write_report
from pcfix.flow.request import Files, Request
from pcfix.flow.run_adjust import adjust_first, figures_of, outputs_of
from pcfix.flow.runner import Progress
from pcfix.flow.surfaces import view_of
from pcfix.grid.maps import MOST_CELLS
from pcfix.io.clouds import is_cloud, own_water
from pcfix.io.geopackage import check_layers
from pcfix.io.rasters import open_raster, preview, write_dod
from pcfix.io.tiles import open_cloud
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

Plain = dict[str, Any]
SECTIONS = 3
DOD, REFERENCE_DSM = "dod.tif", "reference_dsm.tif"


@dataclass(frozen=True)
class Run:
    """What a step knows: the request, its files, and the results of the steps before it."""

    request: Request
    files: Files
    inputs: tuple[Path, ...]
    jobs: int | None = None
    done: Mapping[str, Any] = field(default_factory=dict)

    def after(self, name: str, result: Any) -> Run:
        """Return what is known after a step; an adjustment changes the cameras of the others."""
        request = self.request
        if name == "adjust":
            request = request.with_adjusted(self.files.folder, result)
        elif name == "correct":
            result = _with_checked(result, self.done["adjust"])
        return replace(self, request=request, done={**self.done, name: result})

    @property
    def says_adjusted(self) -> bool:
        """Whether the adjustment, or that there was none, is worth a line."""
        first, corrected = self.done.get("adjust", {}), self.done.get("correct", {})
        absorbed = bool((corrected.get("poses") or {}).get("absorbed"))
        return bool(first.get("is_said") or (first.get("why") and absorbed))


@dataclass(frozen=True)
class Step:
    """A step: its name and title, its work, the files that this leaves, and why it is left out.

    `work` returns what later steps need, as JSON can hold it. `why_not` returns None for a step
    that is wanted.
    """

    name: str
    title: str
    work: Callable[[Run, Progress | None], Any]
    outputs: Callable[[Run], list[Path]]
    why_not: Callable[[Run], str | None] = lambda run: None


def adjust(run: Run, progress: Progress | None) -> Plain:
    """Adjust the cameras, if they need it."""
    return adjust_first(run.request, run.files.folder, list(run.inputs), run.jobs)


def outputs_of_adjust(run: Run) -> list[Path]:
    """Return the files that an adjustment may leave."""
    return outputs_of(run.files.folder)


def adjusted_words(run: Run, was_done: bool) -> list[str]:
    """Return the lines on the first step."""
    first, folder = run.done["adjust"], run.files.folder
    if not first["adjusted"]:
        return [f"{'adjust':<9} not done: {first['why']}"]
    done, figures = "done before" if was_done else "done", figures_of(folder)
    lines = [adjustment_sentence(figures), *all_notes(figures)]
    return [f"{'adjust':<9} {done}: {outputs_of(folder)[0]}", *(f"{'':<9} {one}" for one in lines)]


def correct(run: Run, progress: Progress | None) -> Plain:
    """Correct the cloud."""
    request, files = run.request, run.files
    options = replace(request, overwrite=True, jobs=run.jobs).part(CorrectOptions)
    if request.check_depths is not None:
        options = replace(options, save_regression=files.regression)
    files.remove_others()
    return vars(correct_file(request.source, files.corrected, options=options, progress=progress))


def outputs_of_correct(run: Run) -> list[Path]:
    """Return the corrected cloud, the line of a regression, and the shoreline."""
    request, files = run.request, run.files
    line = [] if request.check_depths is None else [files.regression]
    shore = [] if request.shoreline is None else [Path(request.shoreline)]
    return [*files.parts(files.corrected), *line, *shore]


def _with_checked(corrected: Plain, first: Plain) -> Plain:
    """Return the correction with what the first step found of its poses, by surveys it has not."""
    poses = corrected["poses"]
    if not first.get("is_fine") or poses is None or poses["absorbed"] is not None:
        return corrected
    words = "did not absorb the refraction, as the first step found"
    return {**corrected, "poses": {**poses, "absorbed": False, "words": words}}


def clean(run: Run, progress: Progress | None) -> Plain:
    """Flag the noise; the corrected cloud marks which points are below the water."""
    options = CleanOptions(overwrite=True, jobs=run.jobs, scheduler=run.request.scheduler)
    cloud, target = run.files.corrected_cloud, run.files.cleaned
    return clean_file(cloud, target, options=options, progress=progress).as_dict()


def grid(run: Run, progress: Progress | None) -> Plain:
    """Write all rasters."""
    return write_rasters(
        run.files.cleaned_cloud, run.files.folder, resolution=run.request.resolution,
        cameras=_cameras(run), errors=_has_errors(run), progress=progress,
    )  # fmt: skip


def outputs_of_grid(run: Run) -> list[Path]:
    """Return the rasters and their styles."""
    return raster_files(run.files.folder, errors=_has_errors(run))


def _has_errors(run: Run) -> bool:
    return run.done["correct"]["uncertainty"] is not None


def _inputs(run: Run) -> Inputs:
    """Return the inputs of the correction, without the view list."""
    return replace(run.request, views=None).part(Inputs)


def _cameras(run: Run) -> Cameras:
    """Return the cameras in the CRS of the cloud; notes were shown when it was corrected."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PcfixWarning)
        return read_blocks(_inputs(run), view_of(run.files.corrected_cloud).crs).cameras


def compare(run: Run, progress: Progress | None) -> Plain:
    """Compare the cleaned cloud with the reference, and write a raster of differences."""
    request, files, reference = run.request, run.files, run.request.surveyed
    asked = {one.name: getattr(request, one.name) for one in options_of(DistanceOptions)}
    result = compare_clouds(
        files.cleaned_cloud,
        reference,
        out_dir=files.compare,
        sections=SECTIONS,
        overwrite=True,
        **asked,
    )
    if _has_dod(run):
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


def draw_map(run: Run, progress: Progress | None) -> dict[str, int]:
    """Write the vector layers; the water's height has one standard error for all places."""
    request, files = run.request, run.files
    summary, compared = run.done["correct"], run.done.get("compare", {})
    fitted = (summary["water_fit"] or {}).get("sigma_level_m")
    drawn = Drawn(
        cloud=files.cleaned_cloud,
        folder=files.folder,
        water=_water(run),
        sigma_level_m=request.sigma_level if request.sigma_level is not None else fitted,
        cameras=_cameras(run),
        unused=summary["cameras_unused"],
        sections=compared.get("figures", {}).get("sections", []),
        check_points=np.array(compared.get("check_points", [])).reshape(-1, 4),
        check_depths=request.check_depths,
    )
    return write_map(files.map, drawn, view_of(files.cleaned_cloud).crs)


def why_no_map(run: Run) -> str | None:
    """Return why no vector layers can be written; None if they can."""
    try:
        check_layers(run.files.map)
    except SettingError as error:
        return str(error)
    return None


def _water(run: Run) -> WaterSurface:
    """Return the surface as the corrected cloud states it, else as it was asked for."""
    cloud = run.files.corrected_cloud
    with warnings.catch_warnings():  # they were shown when the cloud was corrected
        warnings.simplefilter("ignore", PcfixWarning)
        with open_cloud(cloud) as source:
            stated = own_water(source)
        return stated or _inputs(run).surface(view_of(cloud)).surface


def _has_dod(run: Run) -> bool:
    """Whether the comparison makes a raster of differences: not with check points."""
    suffix = Path(str(run.request.reference)).suffix.lower()
    return is_cloud(run.request.surveyed) or suffix in (".tif", ".tiff")


def report(run: Run, progress: Progress | None) -> Plain:
    """Write the page."""
    request, files, first = run.request, run.files, run.done["adjust"]
    compared = run.done.get("compare")
    pictures, tables, dod = list[Picture](), list[Table](), None
    verdict = reason_sentence(first["adjusted"], first["why"]) if run.says_adjusted else ""
    if compared is not None:
        dod = preview(files.compare / DOD, MOST_CELLS) if _has_dod(run) else None
        pictures, tables = evaluation(compared["figures"], compared["sections"], dod)
        verdict += in_a_sentence(compared["figures"])
    if first["adjusted"]:
        tables += adjustment_tables(figures_of(files.folder), f"{FOLDER}/report.html")
    summary, again, cameras = Summary(**run.done["correct"]), _inputs(run), _cameras(run)
    if is_found(summary):
        pictures.append(found_picture(again.surface(view_of(request.source))))
    with open_raster(files.surface) as dsm:
        resolution = float(dsm.res[0])
    figures = {} if compared is None else compared["figures"]
    later = Later(pictures, tables, verdict, figures, dod, resolution)
    page = write_report(
        files.cleaned_cloud,
        files.folder,
        summary=summary,
        cameras=cameras,
        water=_water(run),
        inputs=list(run.inputs),
        survey=Survey(request.project or "", request.date or again.dates(cameras)),
        later=later,
        overwrite=True,
    )
    return {
        "in_short": in_short(page.tiles),
        "uncertainty": uncertainty_sentence(summary, later.tvu),
        "title": page.title,
        "tiles": [asdict(tile) for tile in page.tiles],
        "place": page.place,
    }


def words_of(name: str, run: Run) -> str:
    """Return what is said of the result of a step."""
    if name == "dsm":
        return resolution_sentence(run.done[name], given=run.request.resolution is not None)
    return f": {run.done[name]['in_short']}" if name == "report" else ""

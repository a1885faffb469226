"""The whole way in one call: adjust, correct, clean, grid, compare, report."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from pcfix.compare.m3c2 import load_py4dgeo
from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.flow.clean import clean_file
from pcfix.flow.compare import compare_clouds
from pcfix.flow.correct import correct_file
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.inputs import Inputs, paths_in
from pcfix.flow.layers import Drawn, write_map
from pcfix.flow.old_cameras import read_blocks
from pcfix.flow.rasters import SURFACE, raster_files, resolution_sentence, write_rasters
from pcfix.flow.record import VERSION, Record, read_record
from pcfix.flow.report import write_report
from pcfix.flow.run_adjust import (
    FOLDER,
    AdjustStep,
    adjust_first,
    figures_of,
    is_worth_saying,
    outputs_of,
)
from pcfix.flow.runner import Bar, Progress, no_bar
from pcfix.flow.shore import check_shoreline
from pcfix.flow.surfaces import view_of
from pcfix.flow.tiles import HOW, RECORDS
from pcfix.grid.maps import MOST_CELLS
from pcfix.io.clouds import is_cloud, own_water, reference_of
from pcfix.io.files import files_around, files_in
from pcfix.io.geopackage import check_layers
from pcfix.io.rasters import open_raster, preview, write_dod
from pcfix.io.tiles import Tiles, cloud_of, inputs_of, open_cloud, tiles_from, tiles_of
from pcfix.model import Cameras, WaterSurface
from pcfix.options.correct import CorrectOptions
from pcfix.options.declare import named, options_of
from pcfix.options.steps import CleanOptions, DistanceOptions
from pcfix.options.survey import RunOptions
from pcfix.refract.tally import Summary
from pcfix.report.adjustment_text import all_notes
from pcfix.report.comparison import evaluation, in_a_sentence
from pcfix.report.first_screen import Survey, in_short, is_found
from pcfix.report.page import Picture, Table
from pcfix.report.run import Later, adjustment_sentence, adjustment_table, reason_sentence
from pcfix.report.text import uncertainty_sentence
from pcfix.report.water import found_picture
from pcfix.version import __version__
from pcfix.water.index import Water, with_index

RECORD = "run.json"
CLEAN = CleanOptions(overwrite=True)
CLOUDS = ("corrected", "cleaned")
SECTIONS = 3
DOD, REFERENCE_DSM = "dod.tif", "reference_dsm.tif"


@dataclass(frozen=True, kw_only=True)
class Request(RunOptions):
    """Everything that the results of a run depend on; ``run.json`` keeps it."""

    input: str | tuple[str, ...] = ""
    """The cloud; many files as `tiles_of` takes them."""

    @cached_property
    def source(self) -> Path | Tiles:
        """The cloud, in one file or many."""
        return tiles_of(self.input) or Path(str(self.input))

    @cached_property
    def surveyed(self) -> Path | Tiles:
        """The reference, in one file or many."""
        return reference_of(self.reference or "")

    def check(self) -> None:
        """Check what options say together."""
        super().check()
        self.adjust_step()

    def adjust_step(self) -> AdjustStep:
        """Return what the first step is asked for."""
        index = with_index(self.part(RunOptions)).refractive_index
        return AdjustStep(
            self.input, self.part(Inputs), index, self.adjust, self.gcps, self.gnss, self.lens
        )

    def with_adjusted(self, folder: Path, step: dict[str, Any]) -> Request:
        """Return the request of the steps that follow: with the adjusted cameras where they are."""
        if not step["adjusted"]:
            return self
        return replace(
            self,
            cameras=str(folder / FOLDER / step["model"]),
            adjusted_from=self.cameras,
            adjust="no", gcps=None, gnss=None, lens=None,
        )  # fmt: skip

    def record(self) -> dict[str, Any]:
        """Return plain values, without what the results do not depend on."""
        values = self.as_dict()
        kept = {name: values[name] for name in values if name not in HOW}
        return {**kept, VERSION: __version__}

    def files(self) -> dict[str, list[Path]]:
        """Return the input files, each of which exists, by the first step that reads them."""
        names = [*paths_in(self, but=("water",)), self.gcps, self.gnss, self.lens]
        found = [*_files_of(self.source), *(p for n in names if n is not None for p in files_in(n))]
        found += [Path(self.water)] if Path(self.water).is_file() else []
        compared = [] if self.reference is None else _files_of(self.surveyed)
        compared += [path for _, one in self.also for path in _files_of(cloud_of(one))]
        return {"adjust": found, "compare": compared}

    def watched(self, results: Path) -> dict[str, list[Path]]:
        """Return all files that the results may go by; those in the folder of results are none."""
        read = self.files()
        names = paths_in(self, but=("water",))
        around = {path for name in names for path in files_around(name)}
        own = results.resolve()
        more = sorted(one for one in around if own not in one.resolve().parents)
        return {**read, "adjust": list(dict.fromkeys([*read["adjust"], *more]))}


def _files_of(cloud: Path | Tiles) -> list[Path]:
    return inputs_of(cloud) if isinstance(cloud, Tiles) else files_in(cloud)


_CORRECTION = {one.name for one in options_of(CorrectOptions)}.difference(
    ("input", "adjust", "index_formula"), Water._fields, (one.name for one in options_of(Inputs))
) - {"index"}
_LATER = {
    **{one.name: "compare" for one in options_of(DistanceOptions)},
    "reference": "compare", "resolution": "dsm", "project": "report", "date": "report",
}  # fmt: skip


def _since(name: str) -> str:
    """Return the first step that an option of a request matters to."""
    if name in _CORRECTION:
        return "correct"
    return _LATER.get(name, "adjust")


def request_of(record: Path) -> Request:
    """Return what an earlier run was asked for, from its ``run.json``."""
    # runs before there were adjustments did without
    kept = {"adjust": "no", **read_record(record)["request"]}
    input = kept.pop("input", "")
    for name in ("index_from", VERSION):
        kept.pop(name, None)
    try:
        with warnings.catch_warnings():  # a record of old may have old names
            warnings.simplefilter("ignore", PcfixWarning)
            return Request(input=input, **named(kept, options_of(RunOptions), str(record)))
    except (SettingError, TypeError) as error:
        raise InputError(f"{record}: is not the record of a run ({error}).") from error


class Files:
    """Where a run leaves what it makes: of many files a folder of them."""

    def __init__(self, folder: Path, source: Path | Tiles | None = None) -> None:
        self.folder = folder
        self._many = source.paths if isinstance(source, Tiles) else None
        ending = ".laz" if self._many is None else ""
        self.corrected, self.cleaned = (folder / f"{one}{ending}" for one in CLOUDS)
        self.surface, self.map = folder / SURFACE, folder / "map.gpkg"
        self.compare, self.report = folder / "compare", folder / "report.html"
        self.regression = folder / "regression.json"

    def parts(self, target: Path) -> list[Path]:
        """Return the files of a cloud."""
        return [target] if self._many is None else [target / one.name for one in self._many]

    @cached_property
    def corrected_cloud(self) -> Path | Tiles:
        """The corrected cloud, once it is there."""
        return self._cloud(self.corrected)

    @cached_property
    def cleaned_cloud(self) -> Path | Tiles:
        """The cleaned cloud, once it is there."""
        return self._cloud(self.cleaned)

    def _cloud(self, target: Path) -> Path | Tiles:
        with warnings.catch_warnings():  # what is said of the tiles was said of the inputs
            warnings.simplefilter("ignore", PcfixWarning)
            return target if self._many is None else tiles_from(str(target), self.parts(target))

    def remove_others(self) -> None:
        """Remove the clouds that an earlier run made of other files; they would pass for these."""
        kept = {*self.parts(self.corrected), *self.parts(self.cleaned)}
        for one in CLOUDS:
            records = (self.folder / one / RECORDS).glob("*.la[sz].npz")
            made = {self.folder / one / path.stem: path for path in records}
            for path in {self.folder / f"{one}.laz", *made} - kept:
                path.unlink(missing_ok=True)
                made.get(path, path).unlink(missing_ok=True)


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
        Made where its parent exists. A run with the same request resumes there; with other
        options of later steps alone, such as a reference, only these are done anew.
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
        With one sentence on what to mend; the steps before it stay done.
    """
    read = request.files()
    inputs = [path for some in read.values() for path in some]
    if request.m3c2:
        load_py4dgeo()
    record = _begun(request, out_dir, overwrite, say)
    check_shoreline(request.shoreline, overwrite=overwrite or record.resumes, inputs=inputs)
    files = Files(out_dir, request.source)
    shore = [] if request.shoreline is None else [Path(request.shoreline)]

    def step(
        name: str,
        outputs: list[Path],
        work: Callable[[Progress | None], Any],
        more: Callable[[Any], str] = lambda result: "",
        shown: Path | None = None,
    ) -> Any:
        result, was_done = record.step(name, outputs, lambda: _with_bar(bar, name, work))
        done = "done before" if was_done else "done"
        say(f"{name:<9} {done}: {shown or outputs[0]}{more(result)}")
        return result

    first, was_done = record.step(
        "adjust",
        outputs_of(out_dir),
        lambda: _with_bar(
            bar,
            "adjust",
            lambda _: adjust_first(
                replace(request.adjust_step(), cloud=request.source), out_dir, inputs, jobs
            ),
        ),
    )
    _say_adjusted(first, out_dir, was_done, say)
    request = request.with_adjusted(out_dir, first)
    line = [] if request.check_depths is None else [files.regression]
    corrected = step(
        "correct",
        [*files.parts(files.corrected), *line, *shore],
        partial(_correct, request, files, jobs),
        shown=files.corrected,
    )
    corrected = _with_checked(corrected, first)
    if not first["is_said"] and is_worth_saying(first, _is_bent(corrected)):
        first = {**first, "is_said": True}
        _say_adjusted(first, out_dir, was_done, say)
    # the surface of a dimension is still in the cloud, and what was corrected is known anyway
    clean = replace(CLEAN, jobs=jobs, scheduler=request.scheduler)
    step(
        "clean",
        files.parts(files.cleaned),
        lambda progress: clean_file(
            files.corrected_cloud, files.cleaned, options=clean, progress=progress
        ).as_dict(),
        shown=files.cleaned,
    )
    errors = corrected["uncertainty"] is not None
    outputs = raster_files(out_dir, errors=errors)
    cells = partial(resolution_sentence, given=request.resolution is not None)
    step("dsm", outputs, partial(_grid, request, files, errors), cells)
    compared = None
    if request.reference is not None:
        compared = step(
            "compare", [files.compare / "compare.json"], lambda _: _compare(request, files)
        )
    done = {"adjust": first, "correct": corrected, "compare": compared}
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


def _begun(request: Request, out_dir: Path, overwrite: bool, say: Callable[[str], None]) -> Record:
    """Return the record of a folder, made where it is missing; refuse one of another run."""
    if not out_dir.parent.is_dir():
        raise SettingError(f"{out_dir}: the folder {out_dir.parent} does not exist; make it first.")
    out_dir.mkdir(exist_ok=True)
    record = Record(out_dir / RECORD, request.record(), request.watched(out_dir), _since)
    changed = ", ".join(record.changed)
    if not (overwrite or record.resumes) and any(out_dir.iterdir()):
        other = f"a run with another {changed}" if changed else "other files"
        raise SettingError(
            f"{out_dir}: holds {other}; add --overwrite to replace what it has, or give another"
            " folder."
        )
    if changed:
        say(f"{'changed':<9} {changed}: {record.first} and what follows is done"
            " anew, what comes before is kept")  # fmt: skip
    return record


_TITLES = {
    "adjust": "Adjusting", "correct": "Correcting", "clean": "Cleaning", "dsm": "Gridding",
    "compare": "Comparing", "map": "Drawing the map", "report": "Writing the report",
}  # fmt: skip


def _with_bar(bar: Bar, name: str, work: Callable[[Progress | None], Any]) -> Any:
    with bar(_TITLES[name]) as progress:
        return work(progress)


def _say_adjusted(
    first: dict[str, Any], out_dir: Path, was_done: bool, say: Callable[[str], None]
) -> None:
    """Say what came of the adjustment; nothing where there was no question of one."""
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


def _is_bent(corrected: dict[str, Any]) -> bool:
    """Whether the correction found that the poses have absorbed the refraction."""
    return bool((corrected["poses"] or {}).get("absorbed"))


def _grid(
    request: Request, files: Files, errors: bool, progress: Progress | None
) -> dict[str, Any]:
    return write_rasters(
        files.cleaned_cloud, files.folder, resolution=request.resolution,
        cameras=_cameras(request, files), errors=errors, progress=progress,
    )  # fmt: skip


def _cameras(request: Request, files: Files) -> Cameras:
    """Return the cameras in the CRS of the cloud; notes were shown when it was corrected."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PcfixWarning)
        inputs = replace(request, views=None).part(Inputs)
        return read_blocks(inputs, view_of(files.corrected_cloud).crs).cameras


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
    if _rasters(request):
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
    """Write the vectors; of the water's height only its standard error as a whole is known."""
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
        inputs = replace(request, views=None).part(Inputs)
        return stated or inputs.surface(view_of(files.corrected_cloud)).surface


def _rasters(request: Request) -> list[str]:
    """Return the rasters that a comparison leaves: none with check points."""
    if is_cloud(request.surveyed):
        return [DOD, REFERENCE_DSM]
    return [DOD] if Path(str(request.reference)).suffix.lower() in (".tif", ".tiff") else []


def _report(
    request: Request, files: Files, inputs: list[Path], done: dict[str, Any]
) -> dict[str, Any]:
    pictures: list[Picture] = []
    tables: list[Table] = []
    dod = None
    first, compared = done["adjust"], done["compare"]
    verdict = reason_sentence(first["adjusted"], first["why"]) if first["is_said"] else ""
    if compared is not None:
        dod = preview(files.compare / DOD, MOST_CELLS) if _rasters(request) else None
        pictures, tables = evaluation(compared["figures"], compared["sections"], dod)
        verdict += in_a_sentence(compared["figures"])
    if first["adjusted"]:
        tables.append(adjustment_table(figures_of(files.folder), f"{FOLDER}/report.html"))
    summary = Summary(**done["correct"])
    again = replace(request, views=None).part(Inputs)
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

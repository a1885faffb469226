"""All steps in one call: adjust, correct, clean, grid, compare, draw the map, report.

The results are opened as rasters, lines and tables (`RunResults`).
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcfix.adjust.diagnosis import MOST_STATED_M
from pcfix.compare.m3c2 import load_py4dgeo
from pcfix.errors import PcfixError, PcfixWarning, SettingError, bad_file, plain
from pcfix.flow import maps
from pcfix.flow.adjust import FOLDER, MODELS, SUMMARY, adjust_into
from pcfix.flow.clean import clean_file
from pcfix.flow.compare import compare_clouds
from pcfix.flow.correct import correct_file
from pcfix.flow.diagnosis import diagnose_inputs, has_datum
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.inputs import Inputs
from pcfix.flow.report import PAGE, report_run
from pcfix.flow.request import SURFACE, Record, Request, RunFolder, read_record
from pcfix.flow.runner import Bar, Progress, check_folder, no_bar
from pcfix.flow.surfaces import check_shoreline, view_of
from pcfix.io import rasters, vectors
from pcfix.io.clouds import is_cloud
from pcfix.io.files import read_json
from pcfix.io.gnss_positions import read_gnss
from pcfix.io.las.source import CloudPart
from pcfix.io.saved import ENSEMBLE
from pcfix.io.tiles import Tiles, check_one_file
from pcfix.libraries import analysis_library
from pcfix.model import WaterDimension
from pcfix.options.correct import AdjustOptions, CorrectOptions, RunOptions
from pcfix.options.declare import File, options_of, taken
from pcfix.options.steps import CleanOptions, DistanceOptions
from pcfix.report.adjustment import adjustment_sentence, all_notes
from pcfix.report.comparison import signed_statistics
from pcfix.report.text import Summary
from pcfix.running import threads
from pcfix.water.index import with_index

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from pandas import DataFrame
    from xarray import DataArray

Plain = dict[str, Any]

RECORD = "run.json"
REFERENCE_DSM = "reference_dsm.tif"
COLMAP = ("cameras.bin", "images.bin", "points3D.bin", "georeference.json")
ADJUSTED = ("report.html", SUMMARY, ENSEMBLE, *(f"colmap/{name}" for name in COLMAP), *MODELS[1:])
"""The files that an adjustment may leave, its report first."""


def run(
    input: File | Iterable[File],
    out_dir: File,
    *,
    options: RunOptions | None = None,
    say: Callable[[str], None] = lambda text: None,
    bar: Bar = no_bar,
    **keywords: Any,
) -> RunResults:
    """Adjust, correct, clean, grid, compare and report; what ``pcfix run`` runs.

    Parameters
    ----------
    input : path, or list of paths
        LAS or LAZ cloud, of one file or many; see `pcfix.correct_file`.
    out_dir : path
        Folder for all results, made where its parent exists. Called again with the same options it
        resumes, and a finished run is opened at once.
    options
        See `pcfix.correct_file`. Cameras and water are files or text, as ``run.json`` keeps them.
    say : callable, optional
        Called with a line on each step, as ``print``.
    bar : callable, optional
        Shows the progress of a step; see `pcfix.flow.runner.Bar`.

    Raises
    ------
    PcfixError
        The steps before it stay done.

    Examples
    --------
    >>> import pcfix
    >>> result = pcfix.run("cloud.laz", "out", cameras="cameras.csv", water=0.37)  # doctest: +SKIP
    >>> float(result.depth.max())  # doctest: +SKIP
    12.25
    """
    given = taken(RunOptions, options, keywords, "run")
    values = {one.name: getattr(given, one.name) for one in options_of(RunOptions)}
    for name in ("cameras", "water", "adjusted_from", "gcps"):
        if not isinstance(values[name], str | os.PathLike | Real | None):
            raise SettingError(
                "option.type",
                f"run: {name} is a {type(values[name]).__name__}. Give a file or text, which"
                " run.json can keep, or use correct_file.",
                option=name,
            )
        values[name] = None if values[name] is None else str(values[name])
    cloud = str(input) if isinstance(input, str | os.PathLike) else tuple(map(str, input))
    run_all(Request(input=cloud, **values), Path(out_dir), say=say, bar=bar)
    return RunResults(Path(out_dir))


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
        name: str, title: str, result_file: Path, work: Callable[[Progress | None], Any],
        outputs: Sequence[Path] = (), words: Callable[[Any], str] = lambda result: "",
    ) -> Any:  # fmt: skip
        """Do a step unless it is done, and say where its main result is; return its figures.

        `outputs` are all files that it leaves, by default only the main one.
        """
        with bar(title) as progress:
            result, was_done = record.step(name, outputs or [result_file], partial(work, progress))
        if name != "adjust" or result["model"] is not None:
            done = "already done" if was_done else "done"
            say(f"{name:<9} {done}: {result_file}{words(result)}")
        return result

    outputs = [out_dir / FOLDER / name for name in ADJUSTED]
    first = step(
        "adjust", "Adjusting", outputs[0], lambda _: adjust_first(asked, out_dir, inputs), outputs
    )
    if first["model"] is not None:
        figures = read_json(out_dir / FOLDER / SUMMARY)
        for words in (adjustment_sentence(figures), *all_notes(figures)):
            say(f"{'':<9} {words}")
    elif first["why"]:
        say(f"{'adjust':<9} skipped: {first['why']}")
    request = request.with_adjusted(out_dir, first)
    run = RunFolder(out_dir, request)

    outputs = run.files_of(run.corrected)
    outputs += [] if request.check_depths is None else [run.regression]
    outputs += [] if request.shoreline is None else [Path(request.shoreline)]
    corrected = step("correct", "Correcting", run.corrected, partial(_correct, run), outputs)
    poses = corrected["poses"]
    if first["absorbed"] is False and poses is not None and poses["absorbed"] is None:
        # the first step has surveys that the correction has not
        words = "have not absorbed the refraction, as the step adjust found"
        corrected = {**corrected, "poses": {**poses, "absorbed": False, "words": words}}

    # the corrected cloud marks which points are below the water
    how = CleanOptions(overwrite=True, jobs=asked.jobs, scheduler=asked.scheduler)
    step(
        "clean", "Cleaning", run.cleaned,
        lambda progress: clean_file(
            run.corrected_cloud, run.cleaned, options=how, progress=progress
        ).as_dict(),
        run.files_of(run.cleaned),
    )  # fmt: skip
    errors = corrected["uncertainty"] is not None
    cells = isinstance(request.source, CloudPart)
    outputs = maps.raster_files(out_dir, errors=errors, cells=cells)
    step(
        "dsm", "Gridding", outputs[0],
        lambda progress: maps.write_rasters(run, errors=errors, progress=progress), outputs,
        lambda result: f", cells of {result['resolution_m']:g} m",
    )  # fmt: skip
    compared: Plain = {}
    if request.reference is not None:
        found = run.compare / "compare.json"
        compared = step("compare", "Comparing", found, lambda _: _compare(run))
    layers = out_dir / "map.gpkg"
    try:
        vectors.check_layers(layers, overwrite=True)
    except SettingError as error:
        say(f"{'map':<9} not written: {error}")
    else:
        draw = partial(maps.write_map, layers, run, corrected, compared)
        step("map", "Drawing the map", layers, lambda _: draw())
    step(
        "report", "Writing the report", out_dir / PAGE,
        lambda _: report_run(run, inputs, first, corrected, compared),
        words=lambda page: f": {page['in_short']}",
    )  # fmt: skip
    return out_dir / PAGE


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

    Returns `model`, the file or folder with the cameras in that of the adjustment, None without
    one; `why`; and `absorbed`, whether the poses absorbed refraction, None if that is not known.
    """
    model, why, absorbed = None, "", None
    try:
        why, absorbed = _decide(request)
        if absorbed or request.adjust == "yes":
            model = _adjust(request, folder / FOLDER, files)
    except PcfixError as error:
        if request.adjust == "yes" or request.only_to_adjust:
            raise
        why = str(error)  # of a file that cannot be read, which stops the correction too
    return {"model": model, "why": why, "absorbed": absorbed}


def _decide(request: Request) -> tuple[str, bool | None]:
    """Return why the cameras are adjusted, or not; and whether their poses absorbed refraction.

    Without a datum that is not asked. Signs of absorbed refraction do not include the survey with
    which the result is compared: the cloud must not depend on it.
    """
    if request.adjust != "auto" or request.cameras is None:
        return ("set by the user" if request.adjust == "yes" else ""), None
    if request.why_not_adjust:
        return request.why_not_adjust, None
    inputs, view = request.part(Inputs), view_of(request.source)
    # the correction shows the warnings
    with warnings.catch_warnings(action="ignore", category=PcfixWarning):
        cameras = inputs.block(view.crs)[0]
        if request.gnss is not None:
            cameras = read_gnss(request.gnss, cameras)
        elif request.gcps is None and not has_datum(cameras, str(request.cameras)):
            return (
                "the camera file has no GNSS positions better than"
                f" {MOST_STATED_M:g} m, and neither --gnss nor --gcps is given"
            ), None
        water = inputs.surface(view).surface
        if isinstance(water, WaterDimension):
            return f"the water {water} is known at points of the cloud only", None
        sign = diagnose_inputs(
            inputs, cameras, view, water, with_index(request).refractive_index, gcps=request.gcps,
            in_passing=not request.only_to_adjust,
        ).decided_by  # fmt: skip
    if sign is None:
        why = "nothing shows whether the poses have absorbed the refraction (--adjust yes adjusts)"
        return why, None
    have = "have" if sign.speaks else "have not"
    return f"the poses {have} absorbed the refraction: {sign.words}", sign.speaks


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
    request, reference = run.request, run.request.surveyed
    result = compare_clouds(
        run.cleaned_cloud, reference, out_dir=run.compare, sections=maps.SECTIONS,
        overwrite=True, **vars(request.part(DistanceOptions)),
    )  # fmt: skip
    if request.has_surface:
        heights = Path(str(reference))
        if is_cloud(reference):
            heights = run.compare / REFERENCE_DSM
            # the cells are those of the cloud, whatever a warning says
            with warnings.catch_warnings(action="ignore", category=PcfixWarning):
                grid_dsm(reference, heights, resolution=run.resolution_m, overwrite=True)
        rasters.write_dod(run.folder / SURFACE, heights, run.dod, overwrite=True)
    sections = [
        {"distance_m": one.distance_m, "heights_m": one.heights_m} for one in result.sections
    ]
    points = [] if result.check_points is None else result.check_points
    return {"figures": result.as_dict(), **plain({"sections": sections, "check_points": points})}


@dataclass(frozen=True)
class RunResults:
    """The results of a run in its folder.

    Rasters and lines are in the CRS of the cloud, metres. They need the extra ``analysis``, and are
    read from the files each time they are asked for.
    """

    folder: Path

    @cached_property
    def _steps(self) -> dict[str, Plain]:
        """The result of each step, from ``run.json``."""
        steps = read_record(self._file(RECORD))["steps"]
        if "report" not in steps:
            sentence = "the run did not finish. Run it again; it resumes."
            raise bad_file(self.folder, "run.unfinished", sentence)
        return {name: step["result"] for name, step in steps.items()}

    @property
    def report(self) -> Path:
        """The page for clients."""
        return self.folder / PAGE

    @property
    def summary(self) -> Summary:
        """The figures of the correction."""
        return Summary(**self._steps["correct"])

    @property
    def compared(self) -> Plain:
        """All figures of the comparison with the reference; empty where there was none."""
        return dict(self._steps.get("compare", {}).get("figures", {}))

    @property
    def depth(self) -> DataArray:
        """Depth of the bed, shape (y, x), metres below the water, positive down; NaN on land."""
        return rasters.open_array(self._file(maps.DEPTH))

    @property
    def bed(self) -> DataArray:
        """Heights of the bed, shape (y, x), metres; NaN on land."""
        return rasters.open_array(self._file(maps.BED))

    @property
    def surface(self) -> DataArray:
        """Heights of land and bed, shape (y, x), metres."""
        return rasters.open_array(self._file(SURFACE))

    @property
    def uncertainty(self) -> DataArray:
        """Vertical uncertainty of the bed at 95 %, shape (y, x), metres, predicted."""
        return rasters.open_array(self._file(maps.UNCERTAINTY))

    def contours(self, interval: float | None = None) -> GeoDataFrame:
        """Return lines of equal depth, ``depth_m``.

        Parameters
        ----------
        interval : float, optional
            Metres. Default that of ``map.gpkg``, no finer than the depth is known.
        """
        if interval is None:
            return self.layer("depth_contours")
        if not interval > 0.0:
            raise SettingError(
                "option.range", f"interval {interval:g} must be above 0.",
                option="interval", value=interval, above=0,
            )  # fmt: skip
        return vectors.frame_of(maps.contours_layer(self.folder, interval), self.depth.rio.crs)

    @property
    def waterline(self) -> GeoDataFrame:
        """Where the water meets the corrected cloud, with its standard error in plan, metres."""
        return self.layer("waterline")

    def layer(self, name: str) -> GeoDataFrame:
        """Return a layer of ``map.gpkg``: waterline, corrected_area, cross_sections, cameras ..."""
        return vectors.read_frame(self._file("map.gpkg"), name)

    @property
    def tables(self) -> dict[str, DataFrame]:
        """Tables of the comparison by name, metres; empty where there was no reference.

        ``statistics`` of the errors before and after; ``depth_bins``, errors by depth;
        ``section_01`` and so on, heights along a line.
        """
        if not self.compared:
            return {}
        files = sorted((self.folder / "compare").glob("*.csv"))
        rows = [{"of": name, **figures} for name, figures in signed_statistics(self.compared)]
        pandas = analysis_library("pandas")
        statistics = pandas.json_normalize(rows).set_index("of")
        return {"statistics": statistics, **{one.stem: pandas.read_csv(one) for one in files}}

    def _file(self, name: str) -> Path:
        path = self.folder / name
        if not path.is_file():
            raise bad_file(path, "run.no_file", "the run has not written it.")
        return path


def open_run(folder: File) -> RunResults:
    """Open the results of a finished run.

    The folder is the OUT_DIR of ``pcfix run``. An `InputError` if it holds no run, or an unfinished
    one.
    """
    found = RunResults(Path(folder))
    _ = found.summary
    return found

"""All steps in one call: adjust, correct, clean, grid, compare, draw the map, report.

The results are opened as rasters, lines and tables (`RunResults`).
"""

import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcfix.adjust.diagnosis import MOST_STATED_M
from pcfix.compare.statistics import load_py4dgeo
from pcfix.errors import (
    InputError,
    PcfixError,
    SettingError,
    analysis_library,
    bad_file,
    plain,
    silently,
)
from pcfix.flow import run_folder as results
from pcfix.flow.adjust import FOLDER, MODELS, SUMMARY, adjust_into
from pcfix.flow.clean import clean_file
from pcfix.flow.compare import compare_clouds
from pcfix.flow.correct import correct_file
from pcfix.flow.dsm import grid_dsm
from pcfix.flow.inputs import Inputs
from pcfix.flow.poses import diagnose_inputs, has_datum
from pcfix.flow.run_folder import DIFFERENCE, PAGE, RECORD, STEPS, SURFACE, RunFolder, report_run
from pcfix.flow.runner import Bar, Progress, check_folder, json_text, no_bar
from pcfix.flow.surfaces import view_of
from pcfix.io import rasters, vectors
from pcfix.io.clouds import Tiles, is_cloud
from pcfix.io.files import ENSEMBLE, file_state, read_json, refusing, write_text
from pcfix.io.ground_control import read_gnss
from pcfix.model import WaterDimension
from pcfix.options.correct import AdjustOptions, CorrectOptions, RunOptions
from pcfix.options.declare import File, taken
from pcfix.options.steps import CleanOptions, DistanceOptions
from pcfix.report.adjustment import adjustment_sentence, all_notes
from pcfix.report.text import Plain, Summary
from pcfix.running import threads
from pcfix.water.index import with_index

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from pandas import DataFrame
    from xarray import DataArray

COMPARED = "compare"
REFERENCE_DSM = "reference_dsm.tif"
SECTIONS = 3
COLMAP = ("cameras.bin", "images.bin", "points3D.bin", "georeference.json")
# The files that an adjustment may leave, its report first.
ADJUSTED = ("report.html", SUMMARY, ENSEMBLE, *(f"colmap/{name}" for name in COLMAP), *MODELS[1:])


def run(
    input: File | Iterable[File],
    out_dir: File,
    *,
    options: RunOptions | None = None,
    say: Callable[[str], None] = lambda text: None,
    bar: Bar = no_bar,
    **keywords: Any,
) -> "RunResults":
    """Adjust, correct, clean, grid, compare and report; what ``pcfix run`` runs.

    Every step that is not done yet is done. Called again with the same options, a run resumes; if
    only options of later steps changed, such as the reference, only these are done again. The
    option `overwrite` replaces a run with other options, and what else is in the folder.

    Parameters
    ----------
    input : path, or list of paths
        LAS or LAZ cloud, of one file or many; see `pcfix.correct_file`.
    out_dir : path
        Folder for all results, made where its parent exists.
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
    options, folder = _checked(taken(RunOptions, options, keywords, "run")), Path(out_dir)
    cloud = str(input) if isinstance(input, str | os.PathLike) else tuple(map(str, input))
    given = RunFolder(folder, cloud, options)
    inputs = [path for some in given.files.values() for path in some]
    if options.m3c2:
        load_py4dgeo()
    if isinstance(given.source, Tiles):
        check_folder(given.path_of("corrected"), given.source.paths)
    step = Record(given, say, bar).step

    outputs = [folder / FOLDER / name for name in ADJUSTED]
    first = step("adjust", "Adjusting", outputs, lambda _: adjust_first(given, inputs))
    if first["model"] is not None:
        figures = read_json(folder / FOLDER / SUMMARY)
        for words in (adjustment_sentence(figures), *all_notes(figures)):
            say(f"{'':<9} {words}")
    elif first["why"]:
        say(f"{'adjust':<9} skipped: {first['why']}")
    adjusted = given.with_adjusted(first["model"])

    # a cloud in many files is a folder for the user
    main, outputs = adjusted.path_of("corrected"), adjusted.cloud_files("corrected")
    to_correct = replace(adjusted.options, overwrite=True).part(CorrectOptions)
    corrected = step(
        "correct", "Correcting", outputs, main=main,
        work=lambda bar: vars(
            correct_file(adjusted.source, main, options=to_correct, progress=bar)
        ),
    )  # fmt: skip
    poses = corrected["poses"]
    if first["absorbed"] is False and poses is not None and poses["absorbed"] is None:
        # the first step has surveys that the correction has not
        words = "have not absorbed the refraction, as the step adjust found"
        corrected = {**corrected, "poses": {**poses, "absorbed": False, "words": words}}
    cleaned, outputs = adjusted.path_of("cleaned"), adjusted.cloud_files("cleaned")
    to_clean = CleanOptions(overwrite=True, jobs=options.jobs, scheduler=options.scheduler)
    step(
        "clean", "Cleaning", outputs, main=cleaned,
        work=lambda bar: clean_file(
            adjusted.cloud("corrected"), cleaned, options=to_clean, progress=bar
        ).as_dict(),
    )  # fmt: skip

    errors = corrected["uncertainty"] is not None
    gridded = step(
        "dsm", "Gridding", results.raster_files(adjusted, errors),
        partial(results.write_rasters, adjusted, errors), "{main}, cells of {resolution_m:g} m",
    )  # fmt: skip
    compared: Plain = {}
    if options.reference is not None:
        compared = step(
            "compare", "Comparing", [folder / COMPARED / "compare.json"],
            lambda _: _compare(adjusted, gridded["resolution_m"]),
        )  # fmt: skip
    layers = folder / "map.gpkg"
    try:
        vectors.load_pyogrio()
    except InputError as error:  # the extra vector is not installed
        say(f"{'map':<9} not written: {error}")
    else:
        step(
            "map", "Drawing the map", [layers],
            lambda _: results.write_map(layers, adjusted, corrected, compared),
        )  # fmt: skip
    step(
        "report", "Writing the report", [folder / PAGE],
        lambda _: report_run(adjusted, inputs, first, corrected, compared), "{main}: {in_short}",
    )  # fmt: skip
    return RunResults(folder)


def _checked(options: RunOptions) -> RunOptions:
    """Return options that ``run.json`` can hold; SettingError if some exclude each other."""
    texts = dict[str, Any]()
    for name in ("cameras", "water", "adjusted_from", "gcps"):
        value = getattr(options, name)
        if not isinstance(value, str | os.PathLike | Real | None):
            sentence = f"run: {name} is a {type(value).__name__}. Give a file or text, which"
            sentence += " run.json can keep, or use correct_file."
            raise SettingError("option.type", sentence, option=name)
        texts[name] = None if value is None else str(value)
    if options.water is None:
        raise SettingError("water.missing", "water is missing: give the water surface.")
    with_index(options)
    wrong, surveys = "", _surveys(options)
    if options.adjust == "no" and surveys:
        wrong = f"{surveys[0]} is for an adjustment only. Remove it, or use auto."
    elif options.adjust == "yes" and _why_not_adjust(options):
        wrong = f"{_why_not_adjust(options)}. Remove one of the two options."
    if wrong:
        wrong = f"--adjust {options.adjust}: {wrong}"
        raise SettingError("option.conflict", wrong, option="adjust", value=options.adjust)
    return replace(options, **texts)


def _surveys(options: RunOptions) -> list[str]:
    """Return the given options that only an adjustment uses."""
    return [name for name in ("gcps", "gnss", "lens") if getattr(options, name) is not None]


def _why_not_adjust(options: RunOptions) -> str:
    """Return why an adjustment is impossible with the other options; empty if it is possible."""
    if options.cameras is None:
        return "there are no cameras to adjust"
    if options.adjusted_from is not None:
        return "with adjusted-from the cameras are adjusted already"
    if options.tide is not None:
        return "a tide gives each image its own water level, and an adjustment has one"
    return ""


def adjust_first(run: RunFolder, files: list[Path]) -> Plain:
    """Adjust the cameras of a run into its folder if asked, or if they need it.

    The files are inputs of the run, which the adjustment must not replace.

    Returns `model`, the file or folder with the cameras in that of the adjustment, None without
    one; `why`; and `absorbed`, whether the poses absorbed refraction, None if that is not known.
    """
    model, why, absorbed, options = None, "", None, run.options
    try:
        why, absorbed = _decide(run)
        if absorbed or options.adjust == "yes":
            target = run.folder / FOLDER
            check_folder(target, files, mark=SUMMARY)  # the adjustment replaces it
            given = AdjustOptions(
                gcps=options.gcps, gnss=options.gnss, lens=options.lens,
                index=with_index(options).refractive_index, overwrite=True,
            )  # fmt: skip
            with threads(options.jobs):
                adjust_into(target, options.part(Inputs), given, run.source)
            model = next(name for name in MODELS if (target / name).exists())
    except PcfixError as error:
        if options.adjust == "yes" or _surveys(options):
            raise
        why = str(error)  # of a file that cannot be read, which stops the correction too
    return {"model": model, "why": why, "absorbed": absorbed}


def _decide(run: RunFolder) -> tuple[str, bool | None]:
    """Return why the cameras are adjusted, or not; and whether their poses absorbed refraction.

    Without a datum that is not asked. Signs of absorbed refraction do not include the survey with
    which the result is compared: the cloud must not depend on it.
    """
    options = run.options
    if options.adjust != "auto" or options.cameras is None:
        return ("set by the user" if options.adjust == "yes" else ""), None
    if _why_not_adjust(options):
        return _why_not_adjust(options), None
    inputs, view = options.part(Inputs), view_of(run.source)
    # the correction shows the warnings
    with silently():
        cameras = inputs.block(view.crs)[0]
        if options.gnss is not None:
            cameras = read_gnss(options.gnss, cameras)
        elif options.gcps is None and not has_datum(cameras, str(options.cameras)):
            return (
                "the camera file has no GNSS positions better than"
                f" {MOST_STATED_M:g} m, and neither --gnss nor --gcps is given"
            ), None
        water = inputs.surface(view).surface
        if isinstance(water, WaterDimension):
            return f"the water {water} is known at points of the cloud only", None
        sign = diagnose_inputs(
            inputs, cameras, view, water, with_index(options).refractive_index, gcps=options.gcps,
            in_passing=not _surveys(options),
        ).decided_by  # fmt: skip
    if sign is None:
        why = "nothing shows whether the poses have absorbed the refraction (--adjust yes adjusts)"
        return why, None
    have = "have" if sign.absorbed else "have not"
    return f"the poses {have} absorbed the refraction: {sign.words}", sign.absorbed


def _compare(run: RunFolder, resolution_m: float) -> Plain:
    """Compare the cleaned cloud with the reference, and write a raster of differences."""
    folder = run.folder / COMPARED
    result = compare_clouds(
        run.cloud("cleaned"), run.reference, out_dir=folder, sections=SECTIONS, overwrite=True,
        **vars(run.options.part(DistanceOptions)),
    )  # fmt: skip
    if run.has_surface:
        heights = Path(str(run.reference))
        if is_cloud(run.reference):
            heights = folder / REFERENCE_DSM
            # the cells are those of the cloud, whatever a warning says
            with silently():
                grid_dsm(run.reference, heights, resolution=resolution_m, overwrite=True)
        rasters.write_dod(run.folder / SURFACE, heights, run.folder / DIFFERENCE)
    sections = [
        {"distance_m": one.distance_m, "heights_m": one.heights_m} for one in result.sections
    ]
    points = [] if result.check_points is None else result.check_points
    return {"figures": result.as_dict(), **plain({"sections": sections, "check_points": points})}


class Record:
    """The file run.json: the options of a run, and the steps that are done.

    A step is skipped if an earlier run did it with the same key (see `RunFolder.keys`), its outputs
    have not changed, and no step before it is done again. The file is written after each step.
    """

    def __init__(self, run: RunFolder, say: Callable[[str], None], bar: Bar = no_bar) -> None:
        """Make the folder, or refuse one of another run; `say` and `bar` are those of `run`."""
        folder = run.folder
        if not folder.parent.is_dir():
            sentence = f"{folder}: the folder {folder.parent} does not exist. Create it first."
            raise SettingError("output.no_folder", sentence, path=folder)
        folder.mkdir(exist_ok=True)
        self._path, self._keys, self._say, self._bar = folder / RECORD, run.keys(), say, bar
        self._content: dict[str, Any] = {"options": run.settings(), "steps": {}}
        self._earlier = read_steps(self._path) if self._path.exists() else {}
        if not (run.options.overwrite or self._has(STEPS[0])) and any(folder.iterdir()):
            sentence = f"{folder}: holds a run with other options or input files, or other files."
            sentence += " Add --overwrite to replace them, or give another folder."
            raise SettingError("run.other", sentence, path=folder)

    def _has(self, step: str) -> bool:
        return bool(self._earlier.get(step, {}).get("key") == self._keys[step])

    def step(
        self, name: str, title: str, outputs: Sequence[Path],
        work: Callable[[Progress | None], Plain | None], text: str = "{main}",
        main: Path | None = None,
    ) -> Plain:  # fmt: skip
        """Do a step unless it is done, and return its result.

        `outputs` are all files that `work` writes, and `main` is shown to the user, by default the
        first; with the `text`, in which values of the result have their names. The result has what
        later steps need, in the types of JSON.
        """
        done, how = self._earlier.get(name, {}), "already done"
        if not self._has(name) or done["outputs"] != [file_state(one) for one in outputs]:
            self._earlier, how = {}, "done"  # later steps must be done again
            with self._bar(title) as progress:
                found = json.loads(json.dumps(work(progress)))
            states = [file_state(one) for one in outputs]
            done = {"key": self._keys[name], "outputs": states, "result": found}
        self._content["steps"][name] = done
        write_text(self._path, json_text(self._content), overwrite=True)
        result: Plain = done["result"] or {}
        if name != "adjust" or result["model"] is not None:
            self._say(f"{name:<9} {how}: {text.format(main=main or outputs[0], **result)}")
        return result


def read_steps(path: Path) -> dict[str, Any]:
    """Return the steps of a record by name."""
    sentence = "is not the record of a run ({}). Remove it, or give another folder."
    with refusing(path, "run.record", sentence):
        steps: dict[str, Any] = read_json(path)["steps"]
        _ = [(one["key"], one["outputs"], one["result"]) for one in steps.values()]
    return steps


@dataclass(frozen=True)
class RunResults:
    """The results of a run in its folder.

    Rasters and lines are in the CRS of the cloud, metres. They need the extra ``analysis``, and are
    read from the files each time they are asked for.
    """

    folder: Path

    @cached_property
    def _steps(self) -> Plain:
        """The result of each step of a finished run."""
        steps = read_steps(self._file(RECORD))
        if STEPS[-1] not in steps:
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
    def depth(self) -> "DataArray":
        """Depth of the bed, shape (y, x), metres below the water, positive down; NaN on land."""
        return self._raster(results.DEPTH)

    @property
    def bed(self) -> "DataArray":
        """Heights of the bed, shape (y, x), metres; NaN on land."""
        return self._raster(results.BED)

    @property
    def surface(self) -> "DataArray":
        """Heights of land and bed, shape (y, x), metres."""
        return self._raster(SURFACE)

    @property
    def uncertainty(self) -> "DataArray":
        """Vertical uncertainty of the bed at 95 %, shape (y, x), metres, predicted."""
        return self._raster(results.UNCERTAINTY)

    def layer(self, name: str) -> "GeoDataFrame":
        """Return a layer of ``map.gpkg``: depth_contours, waterline, corrected_area, cameras ..."""
        return analysis_library("geopandas").read_file(self._file("map.gpkg"), layer=name)

    @property
    def tables(self) -> "dict[str, DataFrame]":
        """Tables of the comparison by name, metres; empty where there was no reference.

        ``depth_bins``, errors by depth; ``section_01`` and so on, heights along a line.
        """
        files = sorted((self.folder / COMPARED).glob("*.csv")) if self.compared else []
        return {one.stem: analysis_library("pandas").read_csv(one) for one in files}

    def _raster(self, name: str) -> "DataArray":
        array = analysis_library("rioxarray").open_rasterio(self._file(name), masked=True)
        return array.squeeze("band", drop=True).rename(name.partition(".")[0])

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

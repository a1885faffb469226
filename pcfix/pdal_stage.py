"""Door 2: the entry of PDAL's ``filters.python``.

A pipeline imports it and hands over its globals, through which PDAL passes options, metadata and
the report::

    {
      "type": "filters.python",
      "source": "from pcfix.pdal_stage import stages; correct, label = stages(globals())",
      "module": "pcfix_stage",
      "function": "correct",
      "add_dimension": "ShiftX=float,ShiftY=float,...",
      "pdalargs": {"cameras": "cameras.csv", "water": 0.37}
    }

Options have the names of the command line, with underscores, and are checked by the same code.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
import time
import warnings
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from pcfix.errors import PcfixError, SettingError, show_warning
from pcfix.io.pdal import (
    NAME,
    OUTCOME,
    Dimensions,
    Flags,
    Results,
    check_dimensions,
    crs_of,
    dimension,
    metadata_of,
    node,
    scales_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from pcfix.flow.inputs import Inputs
    from pcfix.flow.job import Points
    from pcfix.flow.surfaces import CloudView
    from pcfix.model import FloatArray, Summary, WaterSurface
    from pcfix.options import ErrorBudget, LabelSettings, Settings

    Stage: TypeAlias = Callable[[Dimensions, Dimensions], bool]

_CORRECT_OPTIONS: dict[str, tuple[type, ...]] = {
    "cameras": (str,),
    "water": (str, float),
    "sensor": (str,),
    "angles": (str,),
    "cameras_crs": (str,),
    "cameras_offset": (str,),
    "adjusted_from": (str,),
    "views": (str,),
    "water_mask": (str,),
    "connected": (bool,),
    "least_pool": (float,),
    "respect_classes": (str, int),
    "index": (float, str),
    "salinity": (float,),
    "temperature": (float,),
    "wavelength": (float,),
    "tide": (str,),
    "image_times": (str,),
    "water_model": (str,),
    "water_crs": (str,),
    "max_angle": (float,),
    "max_cameras": (int,),
    "method": (str,),
    "camera_set": (str,),
    "matcher": (str,),
    "views_are": (str,),
    "occlusion": (str,),
    "depth_factor": (float,),
    "check_depths": (str,),
    "least_r2": (float,),
    "sigma_image": (float,),
    "sigma_level": (float,),
    "sigma_tilt": (float,),
    "sigma_index": (float,),
    "sigma_waves": (float,),
    "sigma_centre": (float,),
    "sigma_attitude": (float,),
    "uncorrected": (str,),
    "dimensions": (str,),
    "summary": (str,),
    "overwrite": (bool,),
    "jobs": (int,),
}
_LABEL_OPTIONS: dict[str, tuple[type, ...]] = {
    "water": (str, float),
    "water_model": (str,),
    "water_crs": (str,),
    "water_mask": (str,),
    "band": (float,),
    "dead_band": (float,),
    "connected": (bool,),
    "least_pool": (float,),
    "respect_classes": (str, int),
    "reset": (bool,),
}
_WORD = {str: "a text", float: "a number", int: "a whole number", bool: "true or false"}


def stages(namespace: dict[str, Any]) -> tuple[Stage, Stage]:
    """Return the functions ``correct`` and ``label`` for a stage's globals.

    Parameters
    ----------
    namespace : dict
        ``globals()`` of the stage's source.

    Returns
    -------
    correct, label : callable
        Each takes PDAL's dictionaries of input and output arrays. ``correct`` does what
        ``pcfix correct`` does; ``label`` sets classes as ``pcfix label`` does, and nothing else.
    """

    def correct(ins: Dimensions, outs: Dimensions) -> bool:
        return _run(_correct, namespace, ins, outs)

    def label(ins: Dimensions, outs: Dimensions) -> bool:
        return _run(_label, namespace, ins, outs)

    return correct, label


def _run(
    work: Callable[[dict[str, Any], Dimensions, Dimensions], None],
    namespace: dict[str, Any],
    ins: Dimensions,
    outs: Dimensions,
) -> bool:
    """Work with libraries kept apart from PDAL's, and leave the process usable after a failure."""
    before = sys.getdlopenflags()
    # PDAL links to a PROJ and a GDAL of its own; two of a kind crash the program at its exit
    sys.setdlopenflags(os.RTLD_NOW | getattr(os, "RTLD_DEEPBIND", 0))
    in_program = "pdal" not in sys.modules
    try:
        with warnings.catch_warnings():
            if in_program:
                warnings.showwarning = show_warning
            work(namespace, ins, outs)
        return True
    except PcfixError as error:
        _repair_process(error)
        mistake = error
    except BaseException as error:
        _repair_process(error)
        raise
    finally:
        sys.setdlopenflags(before)
    if in_program:  # which shows the error as a Python repr
        sys.stderr.write(f"pcfix: {mistake}\n")
    raise type(mistake)(str(mistake))  # anew, without the places in pcfix that it came through


def _correct(namespace: dict[str, Any], ins: Dimensions, outs: Dimensions) -> None:
    from pcfix.flow.job import Job
    from pcfix.io.las.columns import columns_for
    from pcfix.threads import threads

    started = time.perf_counter()
    options = _options(namespace, _CORRECT_OPTIONS, needed=("cameras", "water"))
    settings = _settings(options)
    columns = columns_for(settings.dimensions)
    check_dimensions(ins, columns)
    metadata = namespace.get("metadata")
    scales = scales_of(metadata)
    flags = Flags(ins, metadata)
    job = Job(
        NAME,
        settings,
        _inputs(options),
        view=_view(ins, metadata, flags),
        step_m=0.0 if scales is None else float(scales.max()),
        label=_label_settings(options),
    )
    _prepare_summary(options)
    results = Results(ins, columns, flags, scales)
    with threads(options.get("jobs")):
        job.look_around(lambda: (points for _, points in _chunks(ins, job.water, flags)))
        for rows, points in _chunks(ins, job.water, flags):
            correction = job.correct(*points)
            results.add(rows, correction, settings.uncorrected == "withhold")
    job.check_fit()
    outs.update(results.dimensions)
    summary = job.summary(NAME, NAME, time.perf_counter() - started)
    _write_summary(options, summary)
    namespace["out_metadata"] = metadata_of(summary)


def _label(namespace: dict[str, Any], ins: Dimensions, outs: Dimensions) -> None:
    from pcfix.flow.inputs import mask_of
    from pcfix.flow.job import parts_of
    from pcfix.flow.label import Counts
    from pcfix.flow.surfaces import WaterWords, find_surface
    from pcfix.label.labelling import Labelling
    from pcfix.water.checks import check_submerged, check_tilt

    options = _options(namespace, _LABEL_OPTIONS, needed=("water",))
    metadata = namespace.get("metadata")
    flags, counts = Flags(ins, metadata), Counts()
    view = _view(ins, metadata, flags)
    words = WaterWords(
        options["water"], options.get("water_model", "auto"), options.get("water_crs")
    )
    water = find_surface(words, view).surface
    check_tilt(water)
    mask = mask_of(options.get("water_mask"), view.crs, view.low, view.high)
    labelling = Labelling(_label_settings(options), mask)
    classes = flags.classes.copy()
    if labelling.looks_around:
        chunks = partial(_chunks, ins, water, flags)
        labelling.look_around(
            lambda: parts_of((p for _, p in chunks()), water), view.low, view.high
        )
    for rows, points in _chunks(ins, water, flags):
        (part,) = parts_of([points], water)
        labels = labelling.labels(part)
        classes[rows] = labels.classes
        counts.add(part, labels)
    labelling.check(NAME)
    check_submerged(counts.submerged + counts.water_surface, NAME, water)
    outs["Classification"] = classes
    outs.update(flags.dimensions())
    found = {**vars(counts), "labelling": labelling.report()}
    namespace["out_metadata"] = node(
        "pcfix", children=[node(name, value) for name, value in found.items() if value is not None]
    )


def _label_settings(options: dict[str, Any]) -> LabelSettings:
    from pcfix.flow.inputs import classes_of
    from pcfix.options import LabelSettings

    given = options.get("respect_classes")
    return LabelSettings(
        band_m=options.get("band", 0.0),
        dead_band_m=options.get("dead_band", 0.0),
        connected=options.get("connected", False),
        least_pool_m2=options.get("least_pool"),
        respect_classes=classes_of(None if given is None else str(given)),
        reset=options.get("reset", False),
    )


def _options(
    namespace: dict[str, Any], known: dict[str, tuple[type, ...]], needed: tuple[str, ...]
) -> dict[str, Any]:
    """Return the stage's options, of the right types."""
    given = namespace.get("pdalargs") or {}
    if not isinstance(given, dict):
        raise SettingError(f"pdalargs: must be an object of options, not {given!r}.")
    options = {}
    for name, value in given.items():
        if name not in known:
            raise SettingError(
                f"pdalargs: there is no option '{name}'; the options are {', '.join(known)}."
            )
        if value is not None:
            options[name] = _converted(name, value, known[name])
    for name in needed:
        if name not in options:
            raise SettingError(f"pdalargs: the option '{name}' is needed.")
    return options


def _converted(name: str, value: Any, types: tuple[type, ...]) -> Any:
    for kind in types:
        if isinstance(value, kind) and (kind is bool or not isinstance(value, bool)):
            return value
        if kind in (int, float) and isinstance(value, int | float | str):
            try:
                number = float(value)
            except ValueError:
                continue
            if isinstance(value, bool) or (kind is int and not number.is_integer()):
                continue
            return kind(number)
    words = " or ".join(_WORD[kind] for kind in types)
    raise SettingError(f"pdalargs: {name} must be {words}, not {json.dumps(value)}.")


def _settings(options: dict[str, Any]) -> Settings:
    from pcfix.options import Settings
    from pcfix.water.index import index_of, index_words

    if options.get("uncorrected") == "drop":
        raise SettingError(
            "uncorrected 'drop': a stage of PDAL cannot set dimensions and drop points at once;"
            f' use withhold or keep, add "{OUTCOME}=uint8" to add_dimension, and let'
            f' filters.range keep "{OUTCOME}[0:1]".'
        )
    water = (options.get(name) for name in ("salinity", "temperature", "wavelength"))
    index, origin = index_of(index_words(options.get("index"), *water))
    return Settings(
        index,
        options.get("max_angle"),
        options.get("max_cameras"),
        options.get("uncorrected", "withhold"),
        options.get("dimensions", "all"),
        origin,
        errors=_errors(options),
        **{name: options[name] for name in _METHOD_OPTIONS if name in options},
    )


_METHOD_OPTIONS = ("method", "camera_set", "matcher", "occlusion", "depth_factor", "least_r2")
_SIGMAS = {
    "sigma_image": "image_px",
    "sigma_level": "level_m",
    "sigma_tilt": "tilt_deg",
    "sigma_index": "index",
    "sigma_waves": "waves_deg",
    "sigma_centre": "centre_m",
    "sigma_attitude": "attitude_deg",
}


def _errors(options: dict[str, Any]) -> ErrorBudget:
    from pcfix.options import ErrorBudget

    given = {name: options[word] for word, name in _SIGMAS.items() if word in options}
    return ErrorBudget(**given)


def _inputs(options: dict[str, Any]) -> Inputs:
    from pcfix.flow.inputs import inputs_of, offset_of

    offset = offset_of(options.get("cameras_offset"))
    return inputs_of({**options, "cameras_offset_m": offset})


def _heights(water: WaterSurface, ins: Dimensions, rows: slice) -> FloatArray | None:
    from pcfix.model import WaterDimension

    return dimension(ins, water.name)[rows] if isinstance(water, WaterDimension) else None


def _slices(n: int) -> Iterator[slice]:
    from pcfix.flow.points import CHUNK_POINTS

    return (slice(start, start + CHUNK_POINTS) for start in range(0, n, CHUNK_POINTS))


def _chunks(ins: Dimensions, water: WaterSurface, flags: Flags) -> Iterator[tuple[slice, Points]]:
    """Yield the rows of each chunk, and its coordinates, heights of the water and classes."""
    from pcfix.water.checks import checked_points

    for rows in _slices(len(ins["X"])):
        xyz = checked_points(np.column_stack([ins[axis][rows] for axis in "XYZ"]))
        yield rows, (xyz, _heights(water, ins, rows), flags.classes[rows])


def _view(ins: Dimensions, metadata: dict[str, Any] | None, flags: Flags) -> CloudView:
    """Return the cloud as a water surface needs it."""
    from pcfix.flow.surfaces import CloudView, Seen

    def chunks() -> Iterator[Seen]:
        colours = ("Red", "Green", "Blue")
        for rows in _slices(len(ins["X"])):
            xyz = np.column_stack([ins[axis][rows] for axis in "XYZ"])
            rgb = None
            if all(name in ins for name in colours):
                rgb = np.column_stack([ins[name][rows] for name in colours])
            returns = ins["NumberOfReturns"][rows] if "NumberOfReturns" in ins else None
            yield Seen(xyz, rgb, flags.classes[rows], returns)

    return CloudView(NAME, crs_of(metadata), *_corners(ins), len(ins["X"]), chunks)


def _corners(ins: Dimensions) -> tuple[FloatArray, FloatArray]:
    """Return the south-west and north-east corner of the cloud, metres; NaN where it is empty."""
    if not len(ins["X"]):
        return np.full(2, np.nan), np.full(2, np.nan)
    low, high = ([reach(ins[axis]) for axis in "XY"] for reach in (np.min, np.max))
    return np.array(low), np.array(high)


def _prepare_summary(options: dict[str, Any]) -> None:
    from pcfix.io.files import check_output

    if "summary" in options:
        check_output(
            options["summary"],
            overwrite=options.get("overwrite", False),
            inputs=_inputs(options).paths(),
        )


def _write_summary(options: dict[str, Any], summary: Summary) -> None:
    from pcfix.io.files import write_text

    if "summary" in options:
        text = json.dumps(summary.as_dict(), indent=2) + "\n"
        write_text(options["summary"], text, overwrite=options.get("overwrite", False))


def _repair_process(error: BaseException) -> None:
    """Make up for what PDAL's plugin does to a Python process when a stage fails.

    It drops one reference too many to the exception's class, which in the end frees the class;
    and it leaves stdout redirected, which it only undoes after a pipeline that succeeds.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(type(error)))
    pdal = sys.modules.get("pdal")
    if pdal is None or type(sys.stdout).__module__ != "redirector":
        return
    source = "def nothing(ins, outs):\n    return True\n"
    stage = {"type": "filters.python", "source": source, "module": "n", "function": "nothing"}
    point = np.zeros(1, [("X", "f8"), ("Y", "f8"), ("Z", "f8")])
    pdal.Pipeline(json.dumps([stage]), arrays=[point]).execute()

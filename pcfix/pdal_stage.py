"""Door 2: the functions of PDAL's ``filters.python``: correct, label, clean and compare.

A pipeline imports one of them, which belongs to the stage that imported it: PDAL passes options,
metadata and the report through the globals of the stage's source::

    {
      "type": "filters.python",
      "source": "from pcfix.pdal_stage import correct",
      "module": "pcfix_stage",
      "function": "correct",
      "add_dimension": "ShiftX=float,ShiftY=float,...",
      "pdalargs": {"cameras": "cameras.csv", "water": 0.37}
    }

Options have the names of the command line, with underscores or dashes, and are checked by the same
code.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np

from pcfix.errors import PcfixError, SettingError, show_warning
from pcfix.io.pdal import (
    NAME,
    OUTCOME,
    Dimensions,
    Flags,
    Results,
    check_dimensions,
    column_values,
    crs_of,
    dimension,
    metadata_of,
    scales_of,
)
from pcfix.model import LOW_NOISE, WaterDimension, WaterSurface
from pcfix.options.declare import Option, OptionSet, named, options_of
from pcfix.options.shared import PartOptions

Set = TypeVar("Set", bound=OptionSet)

if TYPE_CHECKING:
    from pcfix.compare.match import SurveyCloud
    from pcfix.flow.clean import Tested
    from pcfix.flow.surfaces import CloudView, Points
    from pcfix.model import FloatArray

Stage: TypeAlias = Callable[[Dimensions, Dimensions], bool]
Work: TypeAlias = Callable[[dict[str, Any], Dimensions, Dimensions], None]

_WORD = {str: "a text", float: "a number", int: "a whole number", bool: "true or false"}


def __getattr__(name: str) -> Stage:
    """Return the function of that name for the globals of whoever imports it."""
    work = {"correct": _correct, "label": _label, "clean": _clean, "compare": _compare}.get(name)
    if work is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _stage(work, sys._getframe(1).f_globals)


def stages(namespace: dict[str, Any]) -> tuple[Stage, Stage]:
    """Return ``correct`` and ``label`` for a stage's globals, as pipelines of 0.1.0 ask for them.

    Parameters
    ----------
    namespace : dict
        ``globals()`` of the stage's source.

    Returns
    -------
    correct, label : callable
        Each takes PDAL's dictionaries of input and output arrays.
    """
    return _stage(_correct, namespace), _stage(_label, namespace)


def _stage(work: Work, namespace: dict[str, Any]) -> Stage:
    def function(ins: Dimensions, outs: Dimensions) -> bool:
        return _run(work, namespace, ins, outs)

    return function


def _run(work: Work, namespace: dict[str, Any], ins: Dimensions, outs: Dimensions) -> bool:
    """Work with libraries kept apart from PDAL's, and leave the process usable after a failure."""
    before = sys.getdlopenflags()
    # PDAL links to a PROJ and a GDAL of its own; two of a kind crash the program at its exit
    sys.setdlopenflags(os.RTLD_NOW | getattr(os, "RTLD_DEEPBIND", 0))
    in_program = "redirector" in sys.modules and "pdal" not in sys.modules
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
    if in_program:
        # the program shows an error as the repr of each line of a traceback, and always one: the
        # sentence goes before that, and the traceback is cut down to its last line
        sys.stderr.write(f"pcfix: {mistake}\n")
        sys.tracebacklimit = 0
        raise type(mistake)("refused, as said above")
    raise type(mistake)(str(mistake))  # anew, without the places in pcfix that it came through


def _correct(namespace: dict[str, Any], ins: Dimensions, outs: Dimensions) -> None:
    from pcfix.flow.inputs import paths_in
    from pcfix.flow.job import Job
    from pcfix.flow.runner import check_summary, write_summary
    from pcfix.io.las.columns import columns_for
    from pcfix.kernels import threads
    from pcfix.options.correct import CorrectOptions

    started = time.perf_counter()
    options = _options(namespace, CorrectOptions, needed=("water",))
    if options.cameras is None and options.needs_cameras:
        raise _missing("cameras")
    if options.uncorrected == "drop":
        raise SettingError(
            "uncorrected 'drop': a stage of PDAL cannot set dimensions and drop points at once;"
            f' use withhold or keep, add "{OUTCOME}=uint8" to add_dimension, and let'
            f' filters.range keep "{OUTCOME}[0:1]".'
        )
    columns = columns_for(options.dimensions, options.unsure)
    check_dimensions(ins, columns)
    metadata = namespace.get("metadata")
    scales = scales_of(metadata)
    flags = Flags(ins, metadata)
    step_m = 0.0 if scales is None else float(scales.max())
    job = Job(NAME, options, _view(ins, metadata, flags), step_m)
    check_summary(options, paths_in(options))
    results = Results(ins, columns, flags, scales)
    with threads(options.jobs):
        job.look_around(lambda: (points for _, points in _chunks(ins, job.water, flags)))
        for rows, points in _chunks(ins, job.water, flags):
            results.add(rows, job.correct(points), options.uncorrected == "withhold")
    job.check_fit()
    outs.update(results.dimensions)
    summary = job.summary(NAME, NAME, time.perf_counter() - started)
    job.save_regression()
    write_summary(options, summary.as_dict())
    namespace["out_metadata"] = metadata_of(summary.as_dict(), flags)


def _label(namespace: dict[str, Any], ins: Dimensions, outs: Dimensions) -> None:
    from pcfix.flow.label import LabellingStep
    from pcfix.options.correct import StageLabelOptions

    options = _options(namespace, StageLabelOptions, needed=("water",))
    metadata = namespace.get("metadata")
    flags = Flags(ins, metadata)
    step = LabellingStep(NAME, options, _view(ins, metadata, flags))
    step.look_around(lambda: (points for _, points in _chunks(ins, step.water, flags)))
    classes = flags.classes.copy()
    for rows, points in _chunks(ins, step.water, flags):
        classes[rows] = step.classes(points)
    step.finish()
    outs["Classification"] = classes
    outs.update(flags.dimensions())
    found = {**step.counts, "labelling": step.labelling.report()}
    namespace["out_metadata"] = metadata_of(found, flags)


def _clean(namespace: dict[str, Any], ins: Dimensions, outs: Dimensions) -> None:
    from pcfix.clean.points import Resources
    from pcfix.flow.clean import NoiseSearch
    from pcfix.flow.runner import check_summary, write_summary
    from pcfix.kernels import threads
    from pcfix.options.steps import CleanOptions

    started = time.perf_counter()
    options = _options(namespace, CleanOptions)
    metadata = namespace.get("metadata")
    flags = Flags(ins, metadata)
    search = NoiseSearch(NAME, options, lambda: _view(ins, metadata, flags), ins)
    check_summary(options)
    with threads(options.jobs):
        chunks = _tested(ins, search.water, flags, scales_of(metadata))
        noise = search.run(chunks, len(ins["X"]), Resources(jobs=options.jobs))
    if options.drop:
        outs["Mask"] = ~noise
    else:
        flags.withheld |= noise
        outs["Classification"] = np.where(noise, LOW_NOISE, flags.classes).astype(np.uint8)
        outs.update(flags.dimensions())
    seconds = time.perf_counter() - started
    summary = search.summary(NAME, NAME, drop=options.drop, seconds=seconds).as_dict()
    write_summary(options, summary)
    namespace["out_metadata"] = metadata_of(summary, None if options.drop else flags)


def _tested(
    ins: Dimensions, water: WaterSurface | None, flags: Flags, scales: FloatArray | None
) -> Iterator[Tested]:
    """Yield the points of each chunk as the tests for noise need them."""
    from pcfix.flow.clean import RAY_DIMENSIONS, Tested

    rays = {name: column_values(ins, name, scales) for name in RAY_DIMENSIONS if name in ins}
    for rows, points in _chunks(ins, water, flags):
        yield Tested(points, flags.withheld[rows], {name: rays[name][rows] for name in rays})


def _compare(namespace: dict[str, Any], ins: Dimensions, outs: Dimensions) -> None:
    """Compare, and let all points pass as they are."""
    from pcfix.flow.compare import Held, compare_clouds
    from pcfix.options.steps import StageCompareOptions

    options = _options(namespace, StageCompareOptions, needed=("reference",))
    metadata = namespace.get("metadata")
    flags = Flags(ins, metadata)
    cloud = Held(
        lambda: _view(ins, metadata, flags), lambda water: _surveyed(ins, metadata, flags, water)
    )
    found = compare_clouds(cloud, options.reference or "", options=options)
    namespace["out_metadata"] = metadata_of(found.as_dict())


def _surveyed(
    ins: Dimensions, metadata: dict[str, Any] | None, flags: Flags, water: WaterSurface | None
) -> SurveyCloud:
    """Return the cloud as a comparison needs it."""
    from pcfix.io.clouds import TOLD, Told, survey_cloud
    from pcfix.io.crs import parse_crs

    stated, scales = crs_of(metadata), scales_of(metadata)
    told = {name: column_values(ins, name, scales) for name in TOLD if name in ins}
    chunks = (
        Told(points.xyz, points.classes, flags.withheld[rows], points.heights,
             {name: told[name][rows] for name in told})
        for rows, points in _chunks(ins, water, flags)
    )  # fmt: skip
    crs = None if stated is None else parse_crs(stated, NAME)
    return survey_cloud(NAME, crs, chunks, water, water is not None, len(ins["X"]))


def _options(namespace: dict[str, Any], kind: type[Set], needed: tuple[str, ...] = ()) -> Set:
    """Return the stage's options, of the right types."""
    given = namespace.get("pdalargs") or {}
    if not isinstance(given, dict):
        raise SettingError(f"pdalargs: must be an object of options, not {given!r}.")
    twice = next((name for name in given if "-" in name and name.replace("-", "_") in given), None)
    if twice is not None:
        raise SettingError(f"pdalargs: {twice} is given twice, with dashes and underscores.")
    given = {name.replace("-", "_"): value for name, value in given.items()}
    elsewhere = {"port", *(one.name for one in options_of(PartOptions))}  # readers choose points
    known = {one.name: one for one in options_of(kind) if one.name not in elsewhere}
    values = {
        name: _converted(known[name], value)
        for name, value in named(given, known.values(), "pdalargs").items()
        if value is not None
    }
    for name in needed:
        if name not in values:
            raise _missing(name)
    return kind(**values)


def _missing(name: str) -> SettingError:
    return SettingError(f"pdalargs: the option '{name}' is needed.")


def _converted(one: Option, value: Any) -> Any:
    """Return a value of JSON as what the option takes; numbers may be text."""
    if one.default == () and one.parse is None:  # may be repeated on the command line
        texts = value if isinstance(value, list) else [value]
        if all(isinstance(text, str) for text in texts):
            return tuple(texts)
    kinds = one.plain_kinds
    for kind in kinds:
        if isinstance(value, kind) and (kind is bool or not isinstance(value, bool)):
            return str(value) if kind is int and one.parse is not None else value
        if kind in (int, float) and isinstance(value, int | float | str):
            try:
                number = float(value)
            except ValueError:
                continue
            if isinstance(value, bool) or (kind is int and not number.is_integer()):
                continue
            return kind(number)
    words = " or ".join(_WORD[kind] for kind in kinds)
    raise SettingError(f"pdalargs: {one.name} must be {words}, not {json.dumps(value)}.")


def _slices(n: int) -> Iterator[slice]:
    from pcfix.io.las.source import CHUNK_POINTS

    return (slice(start, start + CHUNK_POINTS) for start in range(0, n, CHUNK_POINTS))


def _chunks(
    ins: Dimensions, water: WaterSurface | None, flags: Flags
) -> Iterator[tuple[slice, Points]]:
    """Yield the rows of each chunk, and its coordinates, heights of the water and classes."""
    from pcfix.flow.surfaces import Points
    from pcfix.water.checks import checked_points

    for rows in _slices(len(ins["X"])):
        xyz = checked_points(np.column_stack([ins[axis][rows] for axis in "XYZ"]))
        heights = dimension(ins, water.name)[rows] if isinstance(water, WaterDimension) else None
        sources = ins["PointSourceId"][rows] if "PointSourceId" in ins else None
        has_colours = all(name in ins for name in ("Red", "Green", "Blue"))
        colours = (
            tuple(ins[name][rows] for name in ("Red", "Green", "Blue")) if has_colours else None
        )
        yield rows, Points(xyz, heights, flags.classes[rows], sources, colours)


def _view(ins: Dimensions, metadata: dict[str, Any] | None, flags: Flags) -> CloudView:
    """Return the cloud as a water surface needs it."""
    from pcfix.flow.surfaces import CloudView, Seen, corners

    def chunks() -> Iterator[Seen]:
        colours = ("Red", "Green", "Blue")
        for rows in _slices(len(ins["X"])):
            xyz = np.column_stack([ins[axis][rows] for axis in "XYZ"])
            rgb = None
            if all(name in ins for name in colours):
                rgb = np.column_stack([ins[name][rows] for name in colours])
            returns = ins["NumberOfReturns"][rows] if "NumberOfReturns" in ins else None
            yield Seen(xyz, rgb, flags.classes[rows], returns)

    return CloudView(NAME, crs_of(metadata), *corners(ins["X"], ins["Y"]), len(ins["X"]), chunks)


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

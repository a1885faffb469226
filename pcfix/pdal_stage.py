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
    crs_of,
    dimension,
    metadata_of,
    node,
    scales_of,
)
from pcfix.model import WaterDimension, WaterSurface
from pcfix.options.declare import Option, OptionSet, named, options_of

Set = TypeVar("Set", bound=OptionSet)

if TYPE_CHECKING:
    from pcfix.flow.surfaces import CloudView, Points

Stage: TypeAlias = Callable[[Dimensions, Dimensions], bool]

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
    namespace["out_metadata"] = metadata_of(summary)


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
    namespace["out_metadata"] = node(
        "pcfix", children=[node(name, value) for name, value in found.items() if value is not None]
    )


def _options(namespace: dict[str, Any], kind: type[Set], needed: tuple[str, ...]) -> Set:
    """Return the stage's options, of the right types."""
    given = namespace.get("pdalargs") or {}
    if not isinstance(given, dict):
        raise SettingError(f"pdalargs: must be an object of options, not {given!r}.")
    known = {one.name: one for one in options_of(kind) if one.name != "port"}
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


def _chunks(ins: Dimensions, water: WaterSurface, flags: Flags) -> Iterator[tuple[slice, Points]]:
    """Yield the rows of each chunk, and its coordinates, heights of the water and classes."""
    from pcfix.flow.surfaces import Points
    from pcfix.water.checks import checked_points

    for rows in _slices(len(ins["X"])):
        xyz = checked_points(np.column_stack([ins[axis][rows] for axis in "XYZ"]))
        heights = dimension(ins, water.name)[rows] if isinstance(water, WaterDimension) else None
        sources = ins["PointSourceId"][rows] if "PointSourceId" in ins else None
        yield rows, Points(xyz, heights, flags.classes[rows], sources)


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

"""The functions of PDAL's ``filters.python``: correct, label and clean.

A pipeline imports one of them. PDAL passes options, metadata and the report through the globals of
the source of the stage::

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

import ctypes
import json
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from pcfix.errors import PcfixError, SettingError, plain, show_warning
from pcfix.io.pdal import NAME, Dimensions, PdalCloud, Results, metadata_of
from pcfix.model import LOW_NOISE, WaterDimension, WaterSurface
from pcfix.options.correct import CorrectOptions, LabelOptions, RasterOutputs
from pcfix.options.declare import OptionSet, named, options_of
from pcfix.options.shared import BandOption
from pcfix.options.steps import CleanOptions

if TYPE_CHECKING:
    from pcfix.flow.runner import FileTask
    from pcfix.flow.surfaces import CloudView, Points

Done: TypeAlias = tuple[Dimensions, dict[str, Any]]  # the changed arrays, and the summary

COLOURS = ("Red", "Green", "Blue")


def __getattr__(name: str) -> Callable[[Dimensions, Dimensions], bool]:
    """Return the stage of this name, bound to the globals of the module that imports it."""
    if name not in STAGES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return partial(_run, name, sys._getframe(1).f_globals)


def _run(name: str, namespace: dict[str, Any], ins: Dimensions, outs: Dimensions) -> bool:
    """Run with libraries separate from PDAL's, and leave the process usable after a failure."""
    before = sys.getdlopenflags()
    # PDAL links to its own PROJ and GDAL; sharing symbols with ours crashes the program at its exit
    sys.setdlopenflags(os.RTLD_NOW | getattr(os, "RTLD_DEEPBIND", 0))
    in_program = "redirector" in sys.modules and "pdal" not in sys.modules
    try:
        with warnings.catch_warnings():
            if in_program:
                warnings.showwarning = show_warning
            _run_stage(name, namespace, ins, outs)
        return True
    except PcfixError as error:
        _repair_process(error)
        mistake = error
    except BaseException as error:
        _repair_process(error)
        raise
    finally:
        sys.setdlopenflags(before)
    sentence = str(mistake)
    if in_program:
        # The program always prints a traceback, each line as a repr. So the sentence is printed
        # before it, and the traceback is reduced to its last line.
        sys.stderr.write(f"pcfix: {mistake}\n")
        sys.tracebacklimit = 0
        sentence = "refused, see the line above"
    # a new error, without the traceback through pcfix
    raise type(mistake)(mistake.code, sentence, **mistake.values)


# All that loads libraries is imported below, within `_run`.


def _run_stage(name: str, namespace: dict[str, Any], ins: Dimensions, outs: Dimensions) -> None:
    """Read options and cloud, run the stage, and report its summary."""
    from pcfix.flow.inputs import paths_in
    from pcfix.flow.runner import FileTask, check_summary, write_summary
    from pcfix.running import threads

    work, kind = STAGES[name]
    options, task = _options(namespace, kind), FileTask(NAME, Path(NAME))
    cloud = PdalCloud(ins, namespace.get("metadata"))
    check_summary(options, paths_in(options))
    with threads(options.jobs):
        arrays, summary = work(options, cloud, task)
    outs.update(arrays)
    write_summary(options, summary)
    namespace["out_metadata"] = metadata_of(summary)


def _correct(options: CorrectOptions, cloud: PdalCloud, task: "FileTask") -> Done:
    from pcfix.flow.correct import finish
    from pcfix.flow.correction import correct_chunk
    from pcfix.flow.planning import plan_correction, read_inputs
    from pcfix.io.las.columns import columns_for

    results = Results(cloud, columns_for(options.dimensions))
    plan = plan_correction(read_inputs(options, _view(cloud)))
    tally: Any = None  # known after the first chunk; PDAL runs no stage on no points
    for rows, points in _chunks(cloud, plan.found.surface):
        correction, one = correct_chunk(plan, points, rows.start)
        results.add(rows, correction)
        tally = one if tally is None else tally + one
    return results.dimensions, finish(plan, task, tally).as_dict()


def _label(options: LabelOptions, cloud: PdalCloud, task: "FileTask") -> Done:
    from pcfix.flow.label import check, label_chunk, plan_labelling

    plan, classes = plan_labelling(options, _view(cloud)), cloud.classes.copy()
    tally: Any = None
    for rows, points in _chunks(cloud, plan.water):
        classes[rows], one = label_chunk(plan, points)
        tally = one if tally is None else tally + one
    check(plan, tally)
    summary = {**tally.of_classes(), "labelling": plan.labelling.report(tally)}
    return {"Classification": classes, **cloud.flags()}, summary


def _clean(options: CleanOptions, cloud: PdalCloud, task: "FileTask") -> Done:
    from pcfix.flow.clean import find_noise

    noise, found = find_noise(options, _view(cloud))
    summary = plain({**found, "input": NAME, "output": NAME, "seconds": task.seconds})
    if options.drop:
        return {"Mask": ~noise}, summary
    cloud.withheld |= noise
    classes = np.where(noise, LOW_NOISE, cloud.classes).astype(np.uint8)
    return {"Classification": classes, **cloud.flags()}, summary


# The function of each stage, and its options.
STAGES: dict[str, tuple[Callable[..., Done], type[OptionSet]]] = {
    "correct": (_correct, CorrectOptions),
    "label": (_label, LabelOptions),
    "clean": (_clean, CleanOptions),
}


def _options(namespace: dict[str, Any], kind: type[OptionSet]) -> Any:
    """Return the options of the stage, checked."""
    given = namespace.get("pdalargs") or {}
    if not isinstance(given, dict):
        sentence = f"pdalargs: must be an object of options, not {given!r}."
        raise SettingError("option.type", sentence, value=given)
    given = {name.replace("-", "_"): value for name, value in given.items()}
    # PDAL reads and writes rasters
    files = (*options_of(BandOption), *options_of(RasterOutputs))
    elsewhere = {"port", *(one.name for one in files)}
    known = {one.name: one for one in options_of(kind) if one.name not in elsewhere}
    values = named(given, known.values(), "pdalargs")
    for name, value in values.items():
        if known[name].type is Any and isinstance(value, list | dict | bool):
            sentence = f"pdalargs: {name} must be a text or a number, not {json.dumps(value)}."
            raise SettingError("option.type", sentence, option=name, value=value)
    options = kind(**{name: value for name, value in values.items() if value is not None})
    if missing := options.missing():
        sentence = f"pdalargs: the option '{missing.name}' is needed."
        raise SettingError("option.missing", sentence, option=missing.name)
    return options


def _chunks(
    cloud: PdalCloud, water: WaterSurface | None, names: Iterable[str] = ()
) -> "Iterator[tuple[slice, Points]]":
    """Yield the rows of each chunk, and its points."""
    from pcfix.flow.surfaces import Points
    from pcfix.io.las.source import CHUNK_POINTS
    from pcfix.water.checks import checked_points

    ins, known = cloud.ins, cloud.columns(tuple(names))
    for first in range(0, len(cloud), CHUNK_POINTS):
        rows = slice(first, first + CHUNK_POINTS)
        xyz = checked_points(cloud.xyz(rows))
        heights = None
        if isinstance(water, WaterDimension):
            heights = cloud.dimension(water.name)[rows]
        has_colours = all(name in ins for name in COLOURS)
        rgb = np.column_stack([ins[name][rows] for name in COLOURS]) if has_colours else None
        yield rows, Points(
            xyz, heights, cloud.classes[rows], rgb, cloud.withheld[rows],
            dimensions={name: values[rows] for name, values in known.items()},
        )  # fmt: skip


def _view(cloud: PdalCloud) -> "CloudView":
    """Return the facts of the cloud, and its points."""
    from pcfix.flow.surfaces import CloudView, corners

    def chunks(water: WaterSurface | None = None, names: Iterable[str] = ()) -> "Iterator[Points]":
        return (points for _, points in _chunks(cloud, water, names))

    low, high = corners(cloud.ins["X"], cloud.ins["Y"])
    step_m = 0.0 if cloud.scales is None else float(cloud.scales.max())
    names = frozenset(cloud.ins)
    return CloudView(NAME, cloud.crs, low, high, len(cloud), chunks, step_m=step_m, names=names)


def _repair_process(error: BaseException) -> None:
    """Undo what PDAL's plugin does to a Python process when a stage fails.

    It releases one reference too many to the class of the exception, which finally frees the class.
    And it leaves stdout redirected until a pipeline succeeds.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(type(error)))
    pdal = sys.modules.get("pdal")
    if pdal is None or type(sys.stdout).__module__ != "redirector":
        return
    source = "def nothing(ins, outs):\n    return True\n"
    stage = {"type": "filters.python", "source": source, "module": "n", "function": "nothing"}
    point = np.zeros(1, [("X", "f8"), ("Y", "f8"), ("Z", "f8")])
    pdal.Pipeline(json.dumps([stage]), arrays=[point]).execute()

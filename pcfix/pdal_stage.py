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
    from pcfix.model import FloatArray, Settings, Summary, WaterSurface

    Stage: TypeAlias = Callable[[Dimensions, Dimensions], bool]

_CORRECT_OPTIONS: dict[str, tuple[type, ...]] = {
    "cameras": (str,),
    "water": (str, float),
    "sensor": (str,),
    "angles": (str,),
    "cameras_crs": (str,),
    "cameras_offset": (str,),
    "views": (str,),
    "index": (float,),
    "max_angle": (float,),
    "max_cameras": (int,),
    "uncorrected": (str,),
    "dimensions": (str,),
    "summary": (str,),
    "overwrite": (bool,),
    "jobs": (int,),
}
_LABEL_OPTIONS: dict[str, tuple[type, ...]] = {"water": (str, float)}
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
        ``pcfix correct`` does; ``label`` sets class 40 below the water and nothing else.
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
    from pcfix.flow.points import checked_points
    from pcfix.io.las.columns import columns_for
    from pcfix.refract.threads import threads

    started = time.perf_counter()
    options = _options(namespace, _CORRECT_OPTIONS, needed=("cameras", "water"))
    settings = _settings(options)
    columns = columns_for(settings.dimensions)
    check_dimensions(ins, columns)
    metadata = namespace.get("metadata")
    scales = scales_of(metadata)
    job = Job(
        NAME,
        settings,
        _inputs(options),
        cloud_crs=crs_of(metadata),
        points=len(ins["X"]),
        step_m=0.0 if scales is None else float(scales.max()),
    )
    _prepare_summary(options)
    flags = Flags(ins, metadata)
    results = Results(ins, columns, flags, scales)
    with threads(options.get("jobs")):
        for rows in _chunks(len(ins["X"])):
            xyz = checked_points(np.column_stack([ins[axis][rows] for axis in "XYZ"]))
            correction = job.correct(xyz, _heights(job.water, ins, rows))
            results.add(rows, correction, settings.uncorrected == "withhold")
    job.check_fit()
    outs.update(results.dimensions)
    summary = job.summary(NAME, NAME, time.perf_counter() - started)
    _write_summary(options, summary)
    namespace["out_metadata"] = metadata_of(summary)


def _label(namespace: dict[str, Any], ins: Dimensions, outs: Dimensions) -> None:
    from pcfix.flow.points import check_submerged, checked_points
    from pcfix.io.las.columns import BATHYMETRIC_POINT
    from pcfix.io.water import read_water
    from pcfix.label.surface import is_submerged, surface_above

    options = _options(namespace, _LABEL_OPTIONS, needed=("water",))
    water = read_water(options["water"])
    flags = Flags(ins, namespace.get("metadata"))
    classes = flags.classes.copy()
    count = 0
    for rows in _chunks(len(ins["X"])):
        xyz = checked_points(np.column_stack([ins[axis][rows] for axis in "XYZ"]))
        surface = surface_above(water, xyz, _heights(water, ins, rows))
        submerged = is_submerged(xyz[:, 2], surface)
        classes[rows][submerged] = BATHYMETRIC_POINT
        count += int(submerged.sum())
    check_submerged(count, NAME, water)
    outs["Classification"] = classes
    outs.update(flags.dimensions())
    namespace["out_metadata"] = node("pcfix", children=[node("submerged", count)])


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
    from pcfix.model import DEFAULT_REFRACTIVE_INDEX, Settings

    if options.get("uncorrected") == "drop":
        raise SettingError(
            "uncorrected 'drop': a stage of PDAL cannot set dimensions and drop points at once;"
            f' use withhold or keep, add "{OUTCOME}=uint8" to add_dimension, and let'
            f' filters.range keep "{OUTCOME}[0:1]".'
        )
    return Settings(
        options.get("index", DEFAULT_REFRACTIVE_INDEX),
        options.get("max_angle"),
        options.get("max_cameras"),
        options.get("uncorrected", "withhold"),
        options.get("dimensions", "all"),
    )


def _inputs(options: dict[str, Any]) -> Inputs:
    from pcfix.flow.inputs import inputs_of, offset_of

    offset = offset_of(options.get("cameras_offset"))
    return inputs_of({**options, "cameras_offset_m": offset})


def _heights(water: WaterSurface, ins: Dimensions, rows: slice) -> FloatArray | None:
    from pcfix.model import WaterDimension

    return dimension(ins, water.name)[rows] if isinstance(water, WaterDimension) else None


def _chunks(n: int) -> Iterator[slice]:
    from pcfix.flow.points import CHUNK_POINTS

    return (slice(start, start + CHUNK_POINTS) for start in range(0, n, CHUNK_POINTS))


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

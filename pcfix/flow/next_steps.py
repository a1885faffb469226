"""Commands that pcfix recommends to run next, ready to paste.

A file that was not given has a name in capitals.
"""

from __future__ import annotations

import shlex
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcfix.flow.inputs import Inputs
from pcfix.model import Cameras, WaterPlane
from pcfix.options.declare import File, OptionSet
from pcfix.options.shared import CameraFileOptions, ViewOptions, WaterOptions
from pcfix.options.survey import AdjustOptions
from pcfix.port.shapes import spec_of

if TYPE_CHECKING:
    from pcfix.adjust.result import Adjusted

MODELS = ("colmap", "cameras.csv")
"""The models that an adjustment writes, the preferred one first."""
FOLDER = "adjusted"
"""The folder of an adjustment in that of a run."""
WATER = "water.tif"
"""The water of an adjustment, where it is not a plane and was adjusted."""
NO_DATUM = " (GNSS.csv has the positions of the images; control points, --gcps, serve as well)"


def adjust_words(
    inputs: Inputs, cloud: str, *, has_datum: bool, **more: File | float | None
) -> tuple[str, str]:
    """Return the command that corrects the poses, and a remark on it.

    Without a datum it asks for GNSS positions; `more` are options of an adjustment only.
    """
    model = "MODEL" if isinstance(inputs.cameras, Cameras) else str(inputs.cameras)
    words = ["pcfix", "adjust", model, "OUT", "--water", _water(inputs.water), "--cloud", cloud]
    words += _flags(inputs)
    if inputs.water_mask is not None:
        words += ["--water-mask", str(inputs.water_mask)]
    remark = "" if has_datum or more.get("gcps") or more.get("gnss") else NO_DATUM
    if remark:
        more["gnss"] = "GNSS.csv"
    for name, value in more.items():
        words += [] if value is None else [f"--{name}", str(value)]
    return shlex.join(words), remark


def correct_words(found: Adjusted, model: File, out_dir: File, options: AdjustOptions) -> str:
    """Return the command that transfers the cloud to the adjusted poses, and corrects it."""
    out = Path(out_dir)
    cameras = next((one for one in MODELS if (out / one).exists()), MODELS[0])
    head = ["pcfix", "correct", str(options.cloud or "CLOUD.laz"), "corrected.laz"]
    words = [*head, "--cameras", str(out / cameras)]
    if options.port is not None:  # before a port no cloud is transferred: it is reconstructed
        moved = found.port if {"distance", "centre"} & set(options.free) else None
        words[2] = "CLOUD.laz"
        return shlex.join([*words, "--port", spec_of(moved) if moved else str(options.port)])
    water = _water(options.water)
    if isinstance(found.water, WaterPlane) or (out / WATER).exists():
        water, plane = str(out / WATER), found.water
        if isinstance(plane, WaterPlane):
            is_level = plane.b == plane.c == 0.0
            tilted = f"plane:{plane.a:.15g},{plane.b:.15g},{plane.c:.15g}"
            water = f"{plane.a:.3f}" if is_level else tilted
        options = replace(options, water_model="auto", water_crs=None)
    words += ["--adjusted-from", str(model), "--water", water]
    if options.water_mask is not None:
        words += ["--water-mask", str(options.water_mask)]
    if "index" in options.free or options.sigma_index is not None:
        words += ["--index", f"{found.refractive_index:.6g}"]
    elif options.index is not None:
        words += ["--index", f"{options.index}"]
    return shlex.join([*words, *_flags(options)])


def _water(given: Any) -> str:
    """Return a water as it was given, or SPEC where an adjustment does not take it."""
    known = isinstance(given, str | PathLike | float | int)
    return f"{given}" if known and not str(given).startswith("dim:") else "SPEC"


def _flags(given: OptionSet) -> list[str]:
    """Return the options that `pcfix correct` and `pcfix adjust` have in common, as given."""
    words = []
    for kind in (WaterOptions, CameraFileOptions, ViewOptions):
        for name, text in given.part(kind).plain().items():
            words += [f"--{name.replace('_', '-')}", str(text)]
    return words

"""The commands that a user is told to run next: lines that work as they are printed.

What was not given and is needed has a name in capitals, and the sentence before the line says why.
"""

from __future__ import annotations

import shlex
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcfix.flow.inputs import Inputs
from pcfix.model import Cameras, WaterPlane
from pcfix.options.declare import File, options_of
from pcfix.options.survey import AdjustOptions
from pcfix.port.shapes import spec_of

if TYPE_CHECKING:
    from pcfix.adjust.result import Adjusted

MODELS = ("colmap", "opensfm/reconstruction.json", "cameras.csv")
"""What an adjustment leaves, in the order in which a next step takes it."""

WATER = "water.tif"
"""The water of an adjustment, where it is no plane and something of it was free."""

READ_ALIKE = (
    "sensor", "angles", "cameras_crs", "cameras_offset", "views", "views_are", "water_model",
    "water_crs",
)  # fmt: skip
"""Options that `pcfix correct` and `pcfix adjust` read alike."""

NO_DATUM = (
    " (nothing given says where the block is: GNSS.csv stands for the positions of the images,"
    " --gcps takes control points instead)"
)


def adjust_words(
    inputs: Inputs, cloud: str, *, has_datum: bool, **more: File | float | None
) -> tuple[str, str]:
    """Return the command that mends the poses, and why it has what was not given.

    Without a datum it has GNSS positions to fill in; `more` are options of an adjustment alone.
    """
    model = "MODEL" if isinstance(inputs.cameras, Cameras) else str(inputs.cameras)
    words = ["pcfix", "adjust", model, "OUT", "--water", _water(inputs.water), "--cloud", cloud]
    words += _flags(inputs)
    if inputs.water_mask is not None:
        words += ["--water-mask", str(inputs.water_mask)]
    because = "" if has_datum or more.get("gcps") or more.get("gnss") else NO_DATUM
    if because:
        more["gnss"] = "GNSS.csv"
    for name, value in more.items():
        if value is not None:
            words += [f"--{name}", str(value)]
    return shlex.join(words), because


def _water(given: Any) -> str:
    """Return a water as it was given; one that an adjustment does not take is left open."""
    known = isinstance(given, str | PathLike | float | int)
    return f"{given}" if known and not str(given).startswith("dim:") else "SPEC"


def _flags(given: Any) -> list[str]:
    """Return the options that were given, of those that are read alike."""
    words = []
    for one in options_of(type(given)):
        value = getattr(given, one.name)
        if one.name in READ_ALIKE and value not in (None, one.default):
            is_offset = one.name == "cameras_offset"
            words += [one.flag, ",".join(f"{v:.12g}" for v in value) if is_offset else str(value)]
    return words


def correct_words(found: Adjusted, model: File, out_dir: File, options: AdjustOptions) -> str:
    """Return the command that takes the cloud over to adjusted cameras, and corrects it."""
    cameras = next((one for one in MODELS if (Path(out_dir) / one).exists()), MODELS[0])
    words = ["pcfix", "correct", str(options.cloud or "CLOUD.laz"), "corrected.laz"]
    words += ["--cameras", str(Path(out_dir) / cameras)]
    if options.port is not None:  # nothing is carried before a port: the cloud is made anew
        moved = found.port if {"distance", "centre"} & set(options.free) else None
        port = str(options.port) if moved is None else spec_of(moved)
        return shlex.join([*words[:2], "CLOUD.laz", *words[3:], "--port", port])
    words += ["--adjusted-from", str(model)]
    raster, water = Path(out_dir) / WATER, _water(options.water)
    if isinstance(found.water, WaterPlane) or raster.exists():
        water = _plane(found.water) if isinstance(found.water, WaterPlane) else str(raster)
        options = replace(options, water_model="auto", water_crs=None)
    words += ["--water", water]
    if options.water_mask is not None:
        words += ["--water-mask", str(options.water_mask)]
    if "index" in options.free or options.sigma_index is not None:
        words += ["--index", f"{found.refractive_index:.6g}"]
    elif options.index is not None:
        words += ["--index", f"{options.index}"]
    return shlex.join([*words, *_flags(options)])


def _plane(water: WaterPlane) -> str:
    """Return a plane as ``--water`` takes it."""
    if water.b == water.c == 0.0:
        return f"{water.a:.3f}"
    return f"plane:{water.a:.15g},{water.b:.15g},{water.c:.15g}"

"""Write the shoreline of a cloud to a file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import shapely

from pcfix.grid.shoreline import NearWater, Shoreline
from pcfix.io.vectors import Layer, check_layers, write_layers
from pcfix.model import FloatArray
from pcfix.options.correct import LEVEL_M
from pcfix.options.declare import File
from pcfix.water.surface import FoundSurface

LAYER = "shoreline"


def check_shoreline(path: File | None, *, overwrite: bool, inputs: Iterable[File] = ()) -> None:
    """Check that the file can be written, before anything is computed."""
    if path is not None:
        check_layers(path, overwrite=overwrite, inputs=inputs)


def write_shoreline(
    path: File, points: NearWater, water: FoundSurface, crs: Any, *, overwrite: bool,
    sigma_level_m: float | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Write the lines of a cloud in its CRS, and return their figures for the summary.

    The standard error of the water's height is `sigma_level_m`, else that of a fit, else `LEVEL_M`.
    """
    stated = LEVEL_M if sigma_level_m is None else sigma_level_m

    def sigma(xy: FloatArray) -> FloatArray:
        fitted = water.sigma_at(xy) if sigma_level_m is None else None
        return np.full(len(xy), stated) if fitted is None else fitted

    lines = points.lines(sigma)
    layer = shoreline_layer(LAYER, lines)
    write_layers(path, [layer], crs, overwrite=overwrite)
    values = layer.values
    length = float(values["length_m"].sum())
    mean = float(np.sqrt(values["sigma_m"] ** 2 @ values["length_m"] / length)) if lines else None
    return {"path": str(path), "lines": len(lines), "length_m": length, "sigma_m": mean}


def shoreline_layer(name: str, lines: Sequence[Shoreline], style: str = "") -> Layer:
    """Return lines as a layer, with level, standard error across the line, and length."""
    values = {
        figure: np.array([getattr(one, figure) for one in lines], np.float64)
        for figure in ("level_m", "sigma_m", "length_m")
    }
    geometries = [shapely.linestrings(one.xy) for one in lines]
    return Layer(name, "LineString", geometries, values, style)

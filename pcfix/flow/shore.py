"""The shoreline of a cloud as a file: gathered with the chunks, written at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import shapely

from pcfix.grid.shoreline import NearWater, Shoreline
from pcfix.io.files import check_output
from pcfix.io.geopackage import Layer, check_layers, write_layers
from pcfix.model import FloatArray
from pcfix.options.correct import LEVEL_M
from pcfix.options.declare import File

LAYER = "shoreline"


def check_shoreline(path: File | None, *, overwrite: bool, inputs: Iterable[File] = ()) -> None:
    """Refuse a file that could not be written, before anything is computed."""
    if path is not None:
        check_layers(check_output(path, overwrite=overwrite, inputs=inputs))


def write_shoreline(
    path: File,
    points: NearWater,
    sigma_level_m: Callable[[FloatArray], FloatArray | None],
    crs: Any,
    *,
    overwrite: bool,
) -> dict[str, Any]:
    """Write the lines of a cloud in its CRS; return what a summary says of them.

    Where `sigma_level_m` knows no standard error of the water's height it is `LEVEL_M`.
    """

    def sigma(xy: FloatArray) -> FloatArray:
        known = sigma_level_m(xy)
        return np.full(len(xy), LEVEL_M) if known is None else known

    lines = points.lines(sigma)
    layer = shoreline_layer(LAYER, lines)
    write_layers(path, [layer], crs, overwrite=overwrite)
    values = layer.values
    length = float(values["length_m"].sum())
    mean = float(np.sqrt(values["sigma_m"] ** 2 @ values["length_m"] / length)) if lines else None
    return {"path": str(path), "lines": len(lines), "length_m": length, "sigma_m": mean}


def shoreline_layer(name: str, lines: Sequence[Shoreline], style: str = "") -> Layer:
    """Return lines as a layer: of each the level, the standard error across it, the length."""
    values = {
        figure: np.array([getattr(one, figure) for one in lines], np.float64)
        for figure in ("level_m", "sigma_m", "length_m")
    }
    geometries = [shapely.linestrings(one.xy) for one in lines]
    return Layer(name, "LineString", geometries, values, style)

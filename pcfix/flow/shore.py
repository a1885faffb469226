"""The shoreline of a cloud as a file: gathered with the chunks, written at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from pcfix.grid.shoreline import NearWater
from pcfix.io.files import check_output
from pcfix.io.vectors import check_lines, write_lines
from pcfix.model import FloatArray
from pcfix.options.correct import LEVEL_M
from pcfix.options.declare import File

LAYER = "shoreline"


def check_shoreline(path: File | None, *, overwrite: bool, inputs: Iterable[File] = ()) -> None:
    """Refuse a file that could not be written, before anything is computed."""
    if path is not None:
        check_lines(check_output(path, overwrite=overwrite, inputs=inputs))


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
    values = {
        name: np.array([getattr(one, name) for one in lines], np.float64)
        for name in ("level_m", "sigma_m", "length_m")
    }
    write_lines(path, LAYER, [one.xy for one in lines], values, crs, overwrite=overwrite)
    length = float(values["length_m"].sum())
    mean = float(np.sqrt(values["sigma_m"] ** 2 @ values["length_m"] / length)) if lines else None
    return {"path": str(path), "lines": len(lines), "length_m": length, "sigma_m": mean}

"""Styles for QGIS (QML) with the colours of the report, of rasters and of layers of a GeoPackage.

QGIS reads the style of a raster from the ``.qml`` file of its name, and those of a GeoPackage from
its table ``layer_styles``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.grid.maps import DEPTH, HEIGHT, UNCERTAINTY, stops_of
from pcfix.io.rasters import preview
from pcfix.model import FloatArray

RAMPS = {"depth": DEPTH, "height": HEIGHT, "uncertainty": UNCERTAINTY}
"""By the contents of a raster."""


def limits_of(values: FloatArray, what: str, percent: float = 0.5) -> tuple[float, float]:
    """Return the values for the first and the last colour of a map; NaN does not count.

    This percentage at either end shares the last colour, so that outliers do not count.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(known, (percent, 100.0 - percent)))
    low = low if what == "height" else 0.0
    return low, max(high, low + 1e-3)


def raster_style(path: Path, what: str) -> str:
    """Return the style of a raster of one band, by what it holds."""
    low, high = limits_of(preview(path)[0], what)
    stops = [
        (f"{value:.6g}", "".join(f"{part:02x}" for part in colour), f"{value:.2f}")
        for share, colour in stops_of(RAMPS[what])
        for value in (low + share * (high - low),)
    ]
    return _style(stops=stops, low=f"{low:.6g}", high=f"{high:.6g}")


class Symbol(NamedTuple):
    """How the features of a layer look: of points the `size`, of lines the width, millimetres."""

    kind: str  # marker, line or fill
    colour: tuple[int, ...]
    size: float
    shape: str = "circle"


def vector_style(symbols: dict[str, Symbol], attribute: str = "", label: str = "") -> str:
    """Return the style of a layer: one symbol, or one for each value of an attribute.

    The label is an expression of QGIS.
    """
    return _style(symbols=symbols, attribute=attribute, label=label)


def _style(**values: Any) -> str:
    from jinja2 import Environment, FileSystemLoader

    loader = FileSystemLoader(Path(__file__).parent)
    rules = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return rules.get_template("style.qml.j2").render(values) + "\n"

"""The page that a surveyor hands to a client: one HTML file with everything inside.

And what all its pictures share; matplotlib is loaded when one is drawn.
"""

from __future__ import annotations

import base64
import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.grid.maps import Maps
from pcfix.model import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_POINTS = 8000
_NO_DATA = -32768
_STEPS = 32_000
"""Of the 16 bits in which the page holds the values of its map."""

BEFORE, AFTER, WATER, REFERENCE = "#b3541e", "#0b5e8a", "#4aa3c7", "#222222"
"""Colours that differ in lightness too, for those who cannot tell the hues apart."""


def new_figure(width_in: float = 8.0, height_in: float = 4.5, **grid: Any) -> tuple[Figure, Any]:
    """Return a figure and its axes, drawn without a screen."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(**grid)


def png_of(figure: Figure) -> bytes:
    """Return a figure as a PNG file."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=130)
    return stream.getvalue()


def new_map(extent_m: tuple[float, float, float, float]) -> tuple[Figure, Any]:
    """Return a figure of the shape of an area: west, east, south and north, metres."""
    west, east, south, north = extent_m
    height_in = float(np.clip(6.5 * (north - south) / (east - west) + 0.8, 2.8, 9.0))
    figure, axes = new_figure(8.0, height_in)
    label_plan(axes)
    return figure, axes


def label_plan(axes: Axes, turned_deg: float = 30.0) -> None:
    """Name the axes of a plan; equal scales, whole coordinates, turned so that they have room."""
    axes.set_aspect("equal")
    axes.ticklabel_format(style="plain", useOffset=False)
    axes.tick_params(axis="x", labelrotation=turned_deg)
    axes.set(xlabel="East (m)", ylabel="North (m)")


def label_side(axes: Axes) -> None:
    """Name the axes of a view from the south."""
    axes.ticklabel_format(style="plain", useOffset=False)
    axes.set(xlabel="East (m)", ylabel="Height (m)")


def draw_cloud(figure: Figure, plan: Axes, xyz: FloatArray, **look: Any) -> FloatArray:
    """Draw points of a cloud in plan, coloured by their heights; return those that are shown."""
    shown = xyz[:: max(1, len(xyz) // MOST_POINTS)]
    if len(shown):
        x, y, z = shown.T
        dots = plan.scatter(x, y, c=z, s=2, cmap="cividis", **look)
        figure.colorbar(dots, ax=plan, label="Height of the cloud (m)", shrink=0.8)
    return shown


@dataclass(frozen=True)
class Picture:
    """A figure with its title, and what it shows in words."""

    name: str
    title: str
    alt: str
    figure: Figure

    def png(self) -> bytes:
        """Return the picture as a file."""
        return png_of(self.figure)

    @property
    def data(self) -> str:
        """The picture for an HTML page."""
        return base64.b64encode(self.png()).decode()


@dataclass(frozen=True)
class Table:
    """Rows of text under a header; the first column names the row."""

    title: str
    header: list[str]
    rows: list[list[str]]


@dataclass(frozen=True)
class Layer:
    """One choice of the map: values per cell, shape (rows, columns), NaN where there are none."""

    name: str
    unit: str
    values: FloatArray


@dataclass(frozen=True)
class Report:
    """All that the page says, in its order."""

    title: str
    lead: str
    facts: Table
    warnings: list[str]
    maps: Maps
    layers: list[Layer]
    pictures: list[Picture]
    tables: list[Table]
    provenance: list[Table] = field(default_factory=list)


def render(report: Report) -> str:
    """Return the page: no address outside it is used, and it works without scripts too."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # no "</script>" can end the data early, as JSON may say "<" in another way
    data = json.dumps(_map_data(report)).replace("<", "\\u003c")
    return environment.get_template("page.html.j2").render(report=report, map_data=Markup(data))


def _map_data(report: Report) -> dict[str, Any]:
    from matplotlib import colormaps

    colours = colormaps["viridis"](np.linspace(0, 1, 64))[:, :3] * 255
    west, _, _, north = report.maps.extent_m
    rows, columns = report.maps.height_m.shape
    return {
        "rows": rows,
        "columns": columns,
        "west": west,
        "north": north,
        "cell": report.maps.cell_m,
        "noData": _NO_DATA,
        "colours": colours.astype(int).tolist(),
        "layers": [_packed(layer) for layer in report.layers],
    }


def _packed(layer: Layer) -> dict[str, Any]:
    """Return a layer as 16-bit whole numbers; its range leaves out a percent at each end."""
    known = layer.values[np.isfinite(layer.values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    step = max(high - low, 1e-9) / _STEPS
    whole = np.where(
        np.isfinite(layer.values), np.rint((layer.values - low) / step), _NO_DATA
    ).astype("<i2")
    shown = np.percentile(known, [1.0, 99.0]) if known.size else np.array([0.0, 1.0])
    return {
        "name": layer.name,
        "unit": layer.unit,
        "offset": low,
        "step": step,
        "low": float(shown[0]),
        "high": float(max(shown[1], shown[0] + 1e-9)),
        "values": base64.b64encode(whole.tobytes()).decode(),
    }

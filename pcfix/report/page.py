"""The report page for a client, one HTML file with everything inside, and what its figures share.

Matplotlib is imported when a figure is drawn.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from glob import has_magic
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.grid.colours import DEPTH, HEIGHT
from pcfix.grid.maps import Maps
from pcfix.model import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pcfix.report.map_data import Layer

MOST_POINTS = 8000
FIGURES = 4
"""Shown; the others are folded."""

BEFORE, AFTER, WATER, REFERENCE = "#b3541e", "#0b5e8a", "#4aa3c7", "#222222"
"""Colours of different lightness, for readers with colour blindness."""


def new_figure(
    width_in: float = 8.0, height_in: float = 4.5, mosaic: Any = None, **grid: Any
) -> tuple[Figure, Any]:
    """Return a figure, drawn without a screen, and its axes: a grid, or a mosaic by name."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    if mosaic is not None:
        return figure, figure.subplot_mosaic(mosaic, **grid)
    return figure, figure.subplots(**grid)


def png_of(figure: Figure) -> bytes:
    """Return a figure as a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    stream = io.BytesIO()
    figure.set_dpi(130)
    canvas = FigureCanvasAgg(figure)
    canvas.print_png(stream)  # type: ignore[no-untyped-call]  # `savefig` would draw it twice
    return stream.getvalue()


def map_figure(
    values: FloatArray,
    extent_m: tuple[float, float, float, float],
    label: str,
    shade: FloatArray | None = None,
    **look: Any,
) -> Figure:
    """Draw a map of values over west, east, south and north, metres; `shade` is its relief.

    Values have the shape (rows, columns).
    """
    west, east, south, north = extent_m
    height_in = float(np.clip(6.5 * (north - south) / (east - west) + 0.8, 2.8, 9.0))
    figure, axes = new_figure(8.0, height_in)
    label_plan(axes)
    if shade is not None:
        axes.imshow(shade, extent=extent_m, cmap="gray", vmin=0.0, vmax=1.0)
        look["alpha"] = 0.75
    image = axes.imshow(values, extent=extent_m, **look)
    figure.colorbar(image, ax=axes, label=label, shrink=0.9)
    return figure


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


def draw_cloud(
    figure: Figure, plan: Axes, xyz: FloatArray, level_m: float | None = None, **look: Any
) -> FloatArray:
    """Draw points of a cloud in plan; return those that are shown.

    They are coloured by their apparent depths below a level, land grey, or else by their heights.
    """
    shown = xyz[:: max(1, len(xyz) // MOST_POINTS)]
    if len(shown) == 0:
        return shown
    x, y, z = shown.T
    wet = np.zeros(len(z), bool) if level_m is None else z < level_m
    if level_m is not None and wet.any():
        plan.plot(x[~wet], y[~wet], ".", color="0.75", markersize=2, markeredgewidth=0)
        dots = plan.scatter(x[wet], y[wet], c=level_m - z[wet], s=2, cmap=DEPTH, vmin=0.0, **look)
        label = "Apparent depth (m)"
    else:
        dots = plan.scatter(x, y, c=z, s=2, cmap=HEIGHT, **look)
        label = "Height of the cloud (m)"
    figure.colorbar(dots, ax=plan, label=label, shrink=0.8)
    return shown


@dataclass(frozen=True)
class Picture:
    """A figure with its title, and what it shows in words."""

    name: str
    title: str
    alt: str
    figure: Figure

    @cached_property
    def png(self) -> bytes:
        """The picture as a file; drawn once, for the page and beside it."""
        return png_of(self.figure)

    @property
    def data(self) -> str:
        """The picture for an HTML page; its "/" are no folders (see `_as_read`)."""
        from markupsafe import Markup

        return Markup(base64.b64encode(self.png).decode())


@dataclass(frozen=True)
class Table:
    """Rows of text under a header; the first column names the row."""

    title: str
    header: list[str]
    rows: list[list[str]]

    def lines(self) -> list[str]:
        """Return the table for the terminal, with its columns aligned to the right."""
        rows = [[self.title if self.header[0] == "" else self.header[0], *self.header[1:]]]
        rows += self.rows
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return [
            "  ".join([f"  {row[0]:<{widths[0]}}", *map(str.rjust, row[1:], widths[1:])]).rstrip()
            for row in rows
        ]


@dataclass(frozen=True)
class Tile:
    """Figures by name with a tag, such as "measured", and notes on them."""

    title: str
    tag: str = ""
    figures: Sequence[tuple[str, str]] = ()
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Report:
    """The contents of the page, in its order."""

    title: str
    lead: str
    head: Table  # beside the map
    warnings: list[str]
    maps: Maps
    layers: list[Layer]
    pictures: list[Picture]  # the first `FIGURES` are shown, the others folded
    tables: list[Table]  # the first is shown, the others folded
    provenance: list[Table] = field(default_factory=list)
    tiles: Sequence[Tile] = ()
    place: str = ""  # CRS and vertical datum of the map
    files: Sequence[tuple[str, str]] = ()  # path from the page, and its contents


_FOLDERS = re.compile(r"(?<![\w.:/~-])(?:[A-Za-z]:)?[/\\](?:[^/\\\s:*?\"<>|]+[/\\])+")
"""The folders of an absolute path, which mean nothing to a reader elsewhere."""


def name_of(path: str) -> str:
    """Return the name of a file, or of the folder where a pattern names many."""
    found = Path(path)
    return found.parent.name if has_magic(found.name) else found.name


def _as_read(value: Any) -> Any:
    """Return a value as a reader sees it: files by their names, and a dash for nothing."""
    if isinstance(value, str) and not hasattr(value, "__html__"):
        return _FOLDERS.sub("", value)
    return "-" if value is None else value


def render(report: Report) -> str:
    """Return the page; it uses no address outside itself, and works without scripts."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    from pcfix.report.map_data import map_json  # not quick to load, and texts do without

    template = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, finalize=_as_read,
    ).get_template("page.html.j2")  # fmt: skip
    data = Markup(map_json(report.maps, report.layers))
    return template.render(report=report, figures=FIGURES, map_data=data)

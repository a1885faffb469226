"""The report page for a client, one HTML file with everything inside; what its figures share.

Styles for QGIS (QML) have the same colours. QGIS reads the style of a raster from the ``.qml`` file
of its name, and those of a GeoPackage from its table ``layer_styles``.

Matplotlib is imported when a figure is drawn.
"""

import base64
import io
import json
import re
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from glob import has_magic
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.grid.lattice import Lattice
from pcfix.grid.maps import (
    DEPTH,
    HEIGHT,
    UNCERTAINTY,
    contours,
    depth_interval,
    hillshade,
    smoothed,
    stops_of,
)
from pcfix.io.rasters import preview
from pcfix.model import FloatArray
from pcfix.sums import nice_step

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Colours of different lightness, for readers with colour blindness.
BEFORE, AFTER, WATER, REFERENCE = "#b3541e", "#0b5e8a", "#4aa3c7", "#222222"


def new_figure(width_in: float = 8.0, height_in: float = 4.5, **grid: Any) -> "tuple[Figure, Any]":
    """Return a figure, drawn without a screen, and its axes, or a grid of them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    return figure, figure.subplots(**grid)


def png_of(figure: "Figure") -> bytes:
    """Return a figure as a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    stream = io.BytesIO()
    figure.set_dpi(130)
    canvas = FigureCanvasAgg(figure)
    canvas.print_png(stream)  # type: ignore[no-untyped-call]  # `savefig` would draw it twice
    return stream.getvalue()


def map_figure(
    values: FloatArray, lattice: Lattice, label: str, shade: FloatArray | None = None, **look: Any
) -> "Figure":
    """Draw a map of values of cells, shape (rows, columns); `shade` is its relief, 0 to 1."""
    west, south, east, north = lattice.bounds_m
    extent_m = west, east, south, north
    height_in = float(np.clip(6.5 * (north - south) / (east - west) + 0.8, 2.8, 9.0))
    figure, axes = new_figure(8.0, height_in)
    axes.set_aspect("equal")
    axes.ticklabel_format(style="plain", useOffset=False)  # whole coordinates,
    axes.tick_params(axis="x", labelrotation=30.0)  # turned so that they have room
    axes.set(xlabel="East (m)", ylabel="North (m)")
    if shade is not None:
        axes.imshow(shade, extent=extent_m, cmap="gray", vmin=0.0, vmax=1.0)
        look["alpha"] = 0.75
    image = axes.imshow(values, extent=extent_m, **look)
    figure.colorbar(image, ax=axes, label=label, shrink=0.9)
    return figure


@dataclass(frozen=True)
class Picture:
    """A figure with its title, and what it shows in words."""

    name: str
    title: str
    alt: str
    figure: "Figure"

    @cached_property
    def png(self) -> bytes:
        """The picture as a file; drawn once, for the page and its own file."""
        return png_of(self.figure)

    @property
    def data(self) -> str:
        """The picture for an HTML page."""
        return base64.b64encode(self.png).decode()


@dataclass(frozen=True)
class Table:
    """Rows of text under a header; the first column names the row."""

    title: str
    header: list[str]
    rows: Sequence[Sequence[str]]

    def lines(self) -> list[str]:
        """Return the table for the terminal, with its columns aligned to the right."""
        rows = [[self.header[0] or self.title, *self.header[1:]], *self.rows]
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
class Layer:
    """One choice of the map: values of cells, shape (rows, columns), NaN where unknown."""

    name: str
    unit: str
    values: FloatArray
    ramp: str = HEIGHT  # of `pcfix.grid.maps`
    plus_minus: str = ""  # name of the layer with the uncertainty of this one at 95 %
    is_centred: bool = False  # whether its colours are centred on zero
    has_contours: bool = False


@dataclass(frozen=True)
class Report:
    """The contents of the page, in its order."""

    title: str
    lead: str
    head: Table  # beside the map
    warnings: list[str]
    tables: list[Table]  # the first is shown, the others folded
    lattice: Lattice | None = None  # the cells of the map; None for a page without a map
    height_m: FloatArray | None = None  # their heights, shape (rows, columns), shown as relief
    layers: Sequence[Layer] = ()
    pictures: Sequence[Picture] = ()  # the first four are shown, the others folded
    provenance: list[Table] = field(default_factory=list)
    tiles: Sequence[Tile] = ()
    files: Sequence[tuple[str, str]] = ()  # path from the page, and its contents


# The folders of an absolute path, which mean nothing to a reader elsewhere.
_FOLDERS = re.compile(r"(?<![\w.:/~-])(?:[A-Za-z]:)?[/\\](?:[^/\\\s:*?\"<>|]+[/\\])+")


def name_of(path: str) -> str:
    """Return the name of a file, or of the folder where a pattern names many."""
    found = Path(path)
    return found.parent.name if has_magic(found.name) else found.name


def _as_read(value: Any) -> Any:
    """Return a value as a reader sees it: files by their names, and a dash for nothing.

    What the template marks as safe are data, whose "/" are no folders.
    """
    if isinstance(value, str) and not hasattr(value, "__html__"):
        return _FOLDERS.sub("", value)
    return "-" if value is None else value


def render(report: Report) -> str:
    """Return the page; it uses no address outside itself, and works without scripts."""
    data = None
    if report.lattice is not None and report.height_m is not None:
        data = map_json(report.lattice, report.height_m, report.layers)
    return _filled("page.html.j2", {"report": report, "map_data": data}, _as_read)


def _filled(template: str, values: dict[str, Any], shown: Callable[[Any], Any] | None) -> str:
    """Fill a template of this folder; `shown` turns each value into the one to show."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, finalize=shown,
    ).get_template(template).render(values)  # fmt: skip


_NO_DATA = -32768


def map_json(lattice: Lattice, height_m: FloatArray, layers: Sequence[Layer]) -> str:
    """Return the data as JSON without "<", so that no text in it can end the script element.

    Layers are differences of 16-bit integers, compressed by zlib, in base 64.
    """
    data: dict[str, Any] = {
        "rows": lattice.height,
        "columns": lattice.width,
        "west": lattice.left_m,
        "north": lattice.top_m,
        "cell": lattice.resolution_m,
        "noData": _NO_DATA,
        "shade": _packed(np.nan_to_num(relief(height_m, lattice.resolution_m) * 254.0)),
        "layers": [_of_layer(layer) for layer in layers],
        "interval": 0,
        "contours": [],
    }
    for layer in layers:
        if layer.has_contours:  # lines whose places count from the corner of the map
            known = (one.values for one in layers if one.name == layer.plus_minus)
            interval = depth_interval(layer.values, next(known, np.zeros(0)))
            data["interval"] = interval
            data["contours"] = [
                {"level": level, "line": np.round(place + 0.5, 1).ravel().tolist()}
                for level, place in contours(layer.values, interval)
            ]
    return json.dumps(data, allow_nan=False).replace("<", "\\u003c")


def relief(height_m: FloatArray, cell_m: float) -> FloatArray:
    """Return the shade of a surface lit from the north-west, 45 degrees up, 0 to 1."""
    smooth = smoothed(height_m, 1.5)  # as single cells are noisy
    return hillshade(np.pad(smooth, 1, constant_values=np.nan), cell_m)


def _of_layer(layer: Layer) -> dict[str, Any]:
    """Return a layer; the range of its colours is round, and leaves out a percent at each end."""
    known = layer.values[np.isfinite(layer.values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    # 16 bits hold 32,000 steps; those below a millimetre would be noise that does not pack
    step = max((high - low) / 32_000, 0.001)
    shown = np.percentile(known, [1.0, 99.0]) if known.size else np.array([0.0, 1.0])
    if layer.is_centred:
        shown = np.abs(shown).max() * np.array([-1.0, 1.0])
    tick = nice_step(max(float(shown[1] - shown[0]), 1e-3) / 7)
    first = np.floor(shown[0] / tick)
    ticks = max(np.ceil(shown[1] / tick) - first, 1.0)
    whole_steps = np.rint((layer.values - low) / step)
    return {
        "name": layer.name,
        "unit": layer.unit,
        "offset": low,
        "step": step,
        "low": float(first * tick),
        "high": float((first + ticks) * tick),
        "ticks": int(ticks),
        "colours": [colour for _, colour in stops_of(layer.ramp, 64)],
        "plusMinus": layer.plus_minus,
        "values": _packed(np.where(np.isfinite(whole_steps), whole_steps, _NO_DATA)),
    }


def _packed(whole_steps: FloatArray) -> str:
    flat = whole_steps.astype("<i2").ravel()
    steps = np.diff(flat, prepend=np.zeros(1, "<i2")).astype("<i2")
    return base64.b64encode(zlib.compress(steps.tobytes(), 9)).decode()


# Styles for QGIS


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
    ramp = {"depth": DEPTH, "height": HEIGHT, "uncertainty": UNCERTAINTY}[what]
    stops = [
        (f"{value:.6g}", "".join(f"{part:02x}" for part in colour), f"{value:.2f}")
        for share, colour in stops_of(ramp)
        for value in (low + share * (high - low),)
    ]
    values = {"stops": stops, "low": f"{low:.6g}", "high": f"{high:.6g}"}
    return _filled("style.qml.j2", values, None) + "\n"


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
    values = {"stops": (), "symbols": symbols, "attribute": attribute, "label": label}
    return _filled("style.qml.j2", values, None) + "\n"

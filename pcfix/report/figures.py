"""The pictures of a report, as matplotlib figures; matplotlib is loaded when one is drawn."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pcfix.model import BoolArray, FloatArray
    from pcfix.report.maps import Maps

BEFORE, AFTER, WATER, REFERENCE = "#b3541e", "#0b5e8a", "#4aa3c7", "#222222"
"""Colours that differ in lightness too, for those who cannot tell the hues apart."""


def new_figure(width_in: float = 8.0, height_in: float = 4.5, **grid: Any) -> tuple[Figure, Any]:
    """Return a figure and its axes, drawn without a screen."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(**grid)


def png_of(figure: Figure, dpi: int = 130) -> bytes:
    """Return a figure as a PNG file."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi)
    return stream.getvalue()


def relief(height_m: FloatArray, cell_m: float) -> FloatArray:
    """Return the shade of a surface lit from the north-west, 45 degrees up, 0 to 1."""
    from pcfix.grid.model import NO_LIGHT, hillshade

    light = hillshade(np.pad(height_m, 1, constant_values=np.nan), cell_m, 315.0, 45.0)
    return np.where(light == NO_LIGHT, np.nan, (light - 1.0) / 254.0)


def map_figure(maps: Maps, values: FloatArray, label: str, colours: str) -> Figure:
    """Draw a map of values over the shaded relief."""
    figure, axes = new_figure(8.0, _map_height_in(maps.extent_m))
    axes.imshow(
        relief(maps.height_m, maps.cell_m), extent=maps.extent_m, cmap="gray", vmin=0.0, vmax=1.0
    )
    image = axes.imshow(values, extent=maps.extent_m, cmap=colours, alpha=0.75)
    figure.colorbar(image, ax=axes, label=label, shrink=0.9)
    _plan(axes)
    return figure


def raster_figure(
    values: FloatArray, extent_m: tuple[float, float, float, float], label: str, reach: float
) -> Figure:
    """Draw signed values from -reach to reach; extent is west, east, south and north."""
    figure, axes = new_figure(8.0, _map_height_in(extent_m))
    image = axes.imshow(values, extent=extent_m, cmap="RdBu_r", vmin=-reach, vmax=reach)
    figure.colorbar(image, ax=axes, label=label, shrink=0.9)
    _plan(axes)
    return figure


def _map_height_in(extent_m: tuple[float, float, float, float]) -> float:
    west, east, south, north = extent_m
    return float(np.clip(6.5 * (north - south) / (east - west) + 0.8, 2.8, 9.0))


def _plan(axes: Axes) -> None:
    axes.set_aspect("equal")
    axes.ticklabel_format(style="plain", useOffset=False)
    axes.tick_params(axis="x", labelrotation=30)
    axes.set_xlabel("East (m)")
    axes.set_ylabel("North (m)")


def cameras_figure(
    maps: Maps, centres: FloatArray, used: BoolArray, water_m: float | None
) -> Figure:
    """Draw the projection centres in plan and in profile, shape (k, 3), over the cloud."""
    figure, (plan, profile) = new_figure(8.0, 7.0, nrows=2, height_ratios=[3, 2])
    plan.imshow(maps.height_m, extent=maps.extent_m, cmap="Greys_r", alpha=0.6)
    marks = (used, "o", AFTER, "used"), (~used, "x", BEFORE, "not used")
    for chosen, mark, colour, name in marks:
        if chosen.any():
            x, y, z = centres[chosen].T
            plan.plot(x, y, mark, color=colour, label=name, markersize=4)
            profile.plot(x, z, mark, color=colour, markersize=4)
    _plan(plan)
    plan.legend(loc="best")
    west, east, _, _ = maps.extent_m
    columns = np.linspace(west, east, maps.height_m.shape[1])
    with np.errstate(all="ignore"):
        low, high = (
            np.nanpercentile(np.where(np.isnan(maps.height_m), np.nan, maps.height_m), q, axis=0)
            for q in (5, 95)
        )
    profile.fill_between(columns, low, high, color="0.6", label="cloud, 5 to 95 %")
    if water_m is not None:
        profile.axhline(water_m, color=WATER, label="water")
    profile.ticklabel_format(style="plain", useOffset=False)
    profile.set_xlabel("East (m)")
    profile.set_ylabel("Height (m)")
    profile.legend(loc="best")
    return figure


def tvu_figure(depth_m: FloatArray, sigma_z_m: FloatArray) -> Figure:
    """Draw TVU at 95 % over depth, and the largest of the orders of IHO S-44 up to one above it.

    Parameters
    ----------
    depth_m, sigma_z_m : array, shape (m,)
        Depths and standard errors of Z of some points.
    """
    from pcfix.report.tvu import COVERAGE_95, ORDERS, largest_tvu_m

    figure, axes = new_figure()
    tvu = COVERAGE_95 * sigma_z_m
    deepest = float(max(depth_m.max(), 1e-3))
    edges = np.linspace(0.0, deepest * (1.0 + 1e-9), 31)
    slot = np.clip(np.digitize(depth_m, edges) - 1, 0, 29)
    filled = [i for i in range(30) if (slot == i).any()]
    low, middle, high = np.array([np.percentile(tvu[slot == i], [5, 50, 95]) for i in filled]).T
    centres = 0.5 * (edges[:-1] + edges[1:])[filled]
    axes.fill_between(
        centres, low, high, color=WATER, alpha=0.6, linewidth=0.0, label="90 % of the points"
    )
    axes.plot(centres, middle, color=AFTER, label="median")
    depths = np.linspace(0.0, deepest, 100)
    for order, style in zip(ORDERS, ("-", "--", "-.", ":"), strict=True):
        largest = largest_tvu_m(order, depths)
        name = order.name if order.name[0].isalpha() else f"order {order.name}"
        axes.plot(depths, largest, style, color=BEFORE, label=f"IHO S-44 {name}")
        if largest[0] > high.max():
            break  # the laxer ones would only press the points down
    axes.set_xlim(0.0, deepest)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("Depth (m)")
    axes.set_ylabel("TVU at 95 % (m)")
    axes.legend(loc="best")
    return figure


def histogram_figure(groups: dict[str, FloatArray], label: str, *, gaussian: bool = True) -> Figure:
    """Draw the distribution of one or two groups of values, each with its Gaussian if asked."""
    figure, axes = new_figure()
    everything = np.concatenate(list(groups.values()))
    low, high = np.percentile(everything, [0.5, 99.5])
    if high <= low:
        low, high = low - 0.5, high + 0.5
    edges = np.linspace(low, high, 81)
    for colour, (name, values) in zip((BEFORE, AFTER), groups.items(), strict=False):
        mean, deviation = float(values.mean()), float(values.std())
        axes.hist(
            values, edges, density=True, color=colour, alpha=0.55,
            label=f"{name}: mean {mean:.3f}, sd {deviation:.3f}",
        )  # fmt: skip
        if gaussian and deviation > 0.0:
            bell = np.exp(-0.5 * ((edges - mean) / deviation) ** 2)
            axes.plot(edges, bell / (deviation * np.sqrt(2.0 * np.pi)), color=colour)
    axes.set_xlabel(label)
    axes.set_ylabel("Density")
    axes.legend(loc="best")
    return figure

"""Papers, remade: the effect of refraction on a pair of vertical images, Shan's iteration, a bowl.

Each as text, as rows for a CSV file, and as pictures.
"""

from __future__ import annotations

import csv
import io
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.report.page import AFTER, BEFORE, REFERENCE, WATER, new_figure
from pcfix.simulate.hsu_wang import EDGES_M, METHODS, PRINTED_RMSE_MM, DepthBins

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pcfix.simulate.refraction_effect import AerialCamera, Effect, Iteration, StereoPair

COLUMNS = (
    "camera", "focal_mm", "flying_height_m", "overlap", "base_m", "refractive_index",
    "apparent_depth_m", "error_centre_m", "error_corner_m", "error_mean_m",
    "true_depth_centre_m", "true_depth_corner_m", "factor_centre", "factor_corner",
    "largest_shift_xy_m",
)  # fmt: skip
"""Of the table; errors are apparent minus true depth, factors true depth over apparent depth."""
LINES = ":", "-", "--", "-."
_COLOURS = {
    "uncorrected": REFERENCE, "I": BEFORE, "II": WATER, "III": "#8a8a8a", "pcfix": AFTER,
}  # fmt: skip


def effect_text(effects: list[Effect]) -> str:
    """Return the errors at the largest depth, a line per camera and flying height."""
    deepest = max(one.apparent_depth_m for one in effects)
    index, overlap = effects[0].refractive_index, effects[0].pair.overlap
    lines = [
        f"apparent minus true depth of a bed that looks {deepest:g} m deep; overlap"
        f" {100.0 * overlap:g} %, refractive index {index:g}",
        f"{'camera':<14}{'flying height':>15}{'base':>11}{'centre':>11}{'corner':>11}{'mean':>11}",
    ]
    for one in effects:
        if one.apparent_depth_m == deepest:
            pair = one.pair
            lines.append(
                f"{pair.camera.name:<14}{pair.flying_height_m:>13g} m{pair.base_m:>9.2f} m"
                f"{one.centre_m:>9.3f} m{one.corner_m:>9.3f} m{one.mean_m:>9.3f} m"
            )
    return "\n".join(lines)


def effect_rows(effects: list[Effect]) -> list[dict[str, Any]]:
    """Return a row of `COLUMNS` per camera, flying height and depth."""
    rows = []
    for one in effects:
        pair, depth = one.pair, one.apparent_depth_m
        centre, corner = depth - one.centre_m, depth - one.corner_m
        metres = (
            one.centre_m, one.corner_m, one.mean_m, centre, corner, centre / depth, corner / depth,
            float(one.shift_m.max()),
        )  # fmt: skip
        facts = (
            pair.camera.name, pair.camera.focal_mm, pair.flying_height_m, pair.overlap,
            round(pair.base_m, 4), one.refractive_index, depth,
        )  # fmt: skip
        rows.append(dict(zip(COLUMNS, [*facts, *(round(m, 5) for m in metres)], strict=True)))
    return rows


def csv_text(rows: list[dict[str, Any]]) -> str:
    """Return a table as CSV, its columns those of the first row."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def error_map_figure(effects: list[Effect]) -> Figure:
    """Draw the error over the model of one camera at one depth, a map per flying height."""
    low = min(float(one.error_m.min()) for one in effects)
    high = max(float(one.error_m.max()) for one in effects)
    levels = _levels(low, high)
    figure, panels = new_figure(1.6 + 2.9 * len(effects), 5.4, ncols=len(effects), squeeze=False)
    for axes, one in zip(panels[0], effects, strict=True):
        filled = axes.contourf(one.x_m, one.y_m, one.error_m, levels, cmap="viridis")
        _draw_contours(axes, one, levels)
        _mark_places(axes, one)
    figure.colorbar(filled, ax=panels[0], label="Apparent minus true depth (m)", shrink=0.9)
    first = effects[0]
    figure.suptitle(
        f"{first.pair.camera.name}, {first.pair.camera.focal_mm:g} mm, overlap"
        f" {100.0 * first.pair.overlap:g} %:\nbed that looks {first.apparent_depth_m:g} m deep,"
        f" n = {first.refractive_index:g}"
    )
    return figure


def _draw_contours(axes: Axes, one: Effect, levels: Any) -> None:
    """Draw white lines with numbers; a dark rim keeps these readable on light colours too."""
    from matplotlib.patheffects import withStroke

    lines = axes.contour(
        one.x_m, one.y_m, one.error_m, levels, colors="white", linewidths=0.7, linestyles="solid"
    )
    for text in axes.clabel(
        lines, fontsize=8, fmt=lambda level: f"{level:g}".replace("-", "\N{MINUS SIGN}")
    ):
        text.set_path_effects([withStroke(linewidth=2.0, foreground=REFERENCE)])


def _levels(low: float, high: float) -> Any:
    """Return round values, about ten, from below `low` to above `high`."""
    rough = max(high - low, 1e-6) / 9.0
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(power * k for k in (1.0, 2.0, 2.5, 5.0, 10.0) if power * k >= rough)
    first = np.floor(low / step)
    return step * np.arange(first, max(np.ceil(high / step), first + 1.0) + 1.0)


def _mark_places(axes: Axes, one: Effect) -> None:
    """Name the values of centre and corner, and the axes."""
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5}
    axes.plot(0.0, 0.0, "+", color=REFERENCE)
    axes.annotate(
        f"{one.centre_m:.2f} m", (0.0, 0.0), xytext=(0, 6), textcoords="offset points",
        ha="center", fontsize=9, bbox=box, zorder=20,
    )  # fmt: skip
    axes.annotate(
        f"{one.corner_m:.2f} m", (one.x_m[-1], one.y_m[-1]), xytext=(-3, -3),
        textcoords="offset points", ha="right", va="top", fontsize=9, bbox=box, zorder=20,
    )  # fmt: skip
    axes.set_title(f"{one.pair.flying_height_m:g} m above the water", fontsize=10)
    axes.set(aspect="equal", xlabel="Along the flight (m)", ylabel="Across the flight (m)")


def depth_figure(effects: list[Effect]) -> Figure:
    """Draw error and correction factor against the apparent depth, centre and corner."""
    figure, panels = new_figure(10.5, 6.0, nrows=1, ncols=2)
    cameras = list(dict.fromkeys(one.pair.camera for one in effects))
    colours = (BEFORE, AFTER, REFERENCE)
    for camera, colour in zip(cameras, colours, strict=False):
        _draw_camera(panels, camera, effects, colour)
    for axes, label in zip(
        panels, ("Apparent minus true depth (m)", "True over apparent depth"), strict=True
    ):
        axes.set(xlabel="Apparent depth (m)", ylabel=label)
        axes.grid(color="0.9")
    index = effects[0].refractive_index
    panels[1].axhline(index, color="0.5", linewidth=1.0)
    panels[1].annotate(
        f"n = {index:g}", (1.0, index), xycoords=("axes fraction", "data"), xytext=(-4, -3),
        textcoords="offset points", ha="right", va="top", fontsize=9,
    )  # fmt: skip
    handles, labels = panels[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(cameras))
    return figure


def _draw_camera(panels: Any, camera: AerialCamera, effects: list[Effect], colour: str) -> None:
    own = [one for one in effects if one.pair.camera == camera]
    heights = list(dict.fromkeys(one.pair.flying_height_m for one in own))
    for i, height in enumerate(heights):
        line = [one for one in own if one.pair.flying_height_m == height]
        depth = np.array([one.apparent_depth_m for one in line])
        order = np.argsort(depth)
        for place, mark in (("centre", "o"), ("corner", "s")):
            error = np.array([getattr(one, f"{place}_m") for one in line])
            style = {
                "linestyle": LINES[i % len(LINES)], "marker": mark, "color": colour,
                "markersize": 4, "markerfacecolor": "white" if place == "centre" else colour,
                "label": f"{camera.name} {height:g} m, {place}",
            }  # fmt: skip
            panels[0].plot(depth[order], error[order], **style)
            panels[1].plot(depth[order], 1.0 - error[order] / depth[order], **style)


def shan_text(pair: StereoPair, table: list[Iteration], depth_m: float) -> str:
    """Return the residuals of Shan's iteration over a bed, a line each."""
    lines = [
        f"Shan's iteration, {pair.camera.name} from {pair.flying_height_m:g} m, bed"
        f" {depth_m:g} m deep: residual of the depth",
        f"{'iteration':>9}{'mean':>16}{'largest':>16}{'change of tan a':>18}",
    ]
    for one in table:
        change = "" if np.isnan(one.change) else f"{one.change:.1e}"
        lines.append(f"{one.number:>9}{one.mean_m:>14.3g} m{one.max_m:>14.3g} m{change:>18}")
    return "\n".join(lines)


def shan_rows(pair: StereoPair, table: list[Iteration]) -> list[dict[str, Any]]:
    """Return the iterations as rows, each with the facts of its pair."""
    return [
        {
            "camera": pair.camera.name,
            "flying_height_m": pair.flying_height_m,
            "iteration": one.number,
            "mean_residual_m": float(f"{one.mean_m:.4g}"),
            "max_residual_m": float(f"{one.max_m:.4g}"),
            "change_tan_a": "" if np.isnan(one.change) else float(f"{one.change:.4g}"),
        }
        for one in table
    ]


def depth_bins_text(bins: DepthBins) -> str:
    """Return the RMSE of the heights by depth, a column per method, and what the paper prints."""
    lines = [
        "RMSE of heights in the simulated bowl of Hsu & Wang, mm, by true depth; III: D ="
        f" {1000 * bins.offset_m:+.2f} mm {bins.slope:+.3f} d, r2 {bins.r2:.4f}",
        f"{'depth, mm':<11}{'points':>7}" + "".join(f"{name:>13}" for name in METHODS),
    ]
    for name, points, row in zip(_bin_names(), bins.points, bins.rmse_m, strict=True):
        lines.append(f"{name:<11}{points:>7}" + "".join(f"{1e3 * v:>13.3f}" for v in row))
    lines.append(
        "as printed; refraction does not explain it, as the uncorrected error falls with depth"
    )
    for name, row in zip(_bin_names(), zip(*PRINTED_RMSE_MM.values(), strict=True), strict=True):
        lines.append(f"{name:<18}" + "".join(f"{v:>13.3f}" for v in row))
    return "\n".join(lines)


def depth_bins_rows(bins: DepthBins) -> list[dict[str, Any]]:
    """Return RMSE and mean error of each bin and method as rows."""
    return [
        {"depth_mm": name, "points": points}
        | {f"rmse_{m}_mm": round(1e3 * v, 3) for m, v in zip(METHODS, rmse, strict=True)}
        | {f"mean_{m}_mm": round(1e3 * v, 3) for m, v in zip(METHODS, mean, strict=True)}
        for name, points, rmse, mean in zip(
            _bin_names(),
            bins.points.tolist(),
            bins.rmse_m.tolist(),
            bins.mean_m.tolist(),
            strict=True,
        )
    ]


def depth_bins_figure(bins: DepthBins) -> Figure:
    """Draw the RMSE of each bin, a bar per method, on a logarithmic scale."""
    figure, axes = new_figure(8.5, 4.8)
    places, width = np.arange(len(EDGES_M) - 1), 0.8 / len(METHODS)
    for i, method in enumerate(METHODS):
        left = places + (i - (len(METHODS) - 1) / 2.0) * width
        axes.bar(left, 1e3 * bins.rmse_m[:-1, i], width, color=_COLOURS[method], label=method)
    axes.set_yscale("log")
    axes.set_xticks(places, _bin_names()[:-1])
    axes.set(xlabel="True depth (mm)", ylabel="RMSE of heights (mm)")
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    figure.legend(loc="outside upper center", ncols=len(METHODS))
    return figure


def _bin_names() -> list[str]:
    edges = 1e3 * EDGES_M
    return [*(f"{low:.0f}-{high:.0f}" for low, high in pairwise(edges)), "overall"]

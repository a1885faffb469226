"""Tables and figures of three papers: refraction in a stereo pair, Shan's iteration, and a bowl."""

from __future__ import annotations

import csv
import io
import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.grid.colours import DEPTH, HEIGHT
from pcfix.model import FloatArray
from pcfix.report.page import AFTER, BEFORE, REFERENCE, WATER, new_figure
from pcfix.simulate.hsu_wang import EDGES_M, METHODS, DepthBins

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pcfix.simulate.refraction_effect import Effect, Iteration, StereoPair

LINES = ":", "-", "--", "-."
_COLOURS = {
    "uncorrected": REFERENCE, "I": BEFORE, "II": WATER, "III": "#8a8a8a", "pcfix": AFTER,
}  # fmt: skip


def effect_text(effects: list[Effect]) -> str:
    """Return the errors at the largest depth, a line for each pair."""
    deepest = max(one.apparent_depth_m for one in effects)
    lines = [
        f"Apparent minus true depth at an apparent depth of {deepest:g} m, refractive index"
        f" {effects[0].refractive_index:g}",
        f"{'camera':<12}{'overlap':>9}{'flying height':>15}{'base':>11}{'centre':>11}{'corner':>11}"
        f"{'mean':>11}",
    ]
    for one in effects:
        if one.apparent_depth_m == deepest:
            pair = one.pair
            lines.append(
                f"{pair.camera.name:<12}{100.0 * pair.overlap:>7g} %{pair.flying_height_m:>13g} m"
                f"{pair.base_m:>9.2f} m{one.centre_m:>9.3f} m{one.corner_m:>9.3f} m"
                f"{one.mean_m:>9.3f} m"
            )
    return "\n".join(lines)


def effect_rows(effects: list[Effect]) -> list[dict[str, Any]]:
    """Return a row per pair and depth; a depth of 0 has no factors.

    Errors are apparent minus true depth, factors true over apparent depth.
    """
    rows = []
    for one in effects:
        pair, depth = one.pair, one.apparent_depth_m
        centre, corner = depth - one.centre_m, depth - one.corner_m
        metres = {
            "error_centre_m": one.centre_m,
            "error_corner_m": one.corner_m,
            "error_mean_m": one.mean_m,
            "true_depth_centre_m": centre,
            "true_depth_corner_m": corner,
            "factor_centre": centre / depth if depth else math.nan,
            "factor_corner": corner / depth if depth else math.nan,
            "largest_shift_xy_m": float(one.shift_m.max()),
        }
        facts = {
            "camera": pair.camera.name,
            "focal_mm": pair.camera.focal_mm,
            "flying_height_m": pair.flying_height_m,
            "overlap": pair.overlap,
            "base_m": round(pair.base_m, 4),
            "refractive_index": one.refractive_index,
            "apparent_depth_m": depth,
        }
        numbers = {k: "" if math.isnan(v) else round(v, 5) + 0.0 for k, v in metres.items()}
        rows.append(facts | numbers)
    return rows


def csv_text(rows: list[dict[str, Any]]) -> str:
    """Return a table as CSV, its columns those of the first row."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def error_map_figure(effects: list[Effect]) -> Figure:
    """Draw the error over the model of one camera at one depth, a map per pair."""
    from matplotlib.patheffects import withStroke

    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5}
    look: dict[str, Any] = {
        "textcoords": "offset points", "fontsize": 9, "bbox": box, "zorder": 20,
    }  # fmt: skip
    low = min(float(one.error_m.min()) for one in effects)
    high = max(float(one.error_m.max()) for one in effects)
    levels = _levels(low, high)
    figure, panels = _panels(effects, 2.9, 4.6)
    for axes, (one,) in panels:
        filled = axes.contourf(one.x_m, one.y_m, one.error_m, levels, cmap=HEIGHT)
        lines = axes.contour(
            one.x_m, one.y_m, one.error_m, levels, colors="white", linewidths=0.7,
            linestyles="solid",
        )  # fmt: skip
        for text in axes.clabel(lines, fontsize=8, fmt="%g"):  # a dark rim, for light colours
            text.set_path_effects([withStroke(linewidth=2.0, foreground=REFERENCE)])
        axes.plot(0.0, 0.0, "+", color=REFERENCE)
        centre, corner = (0.0, 0.0), (one.x_m[-1], one.y_m[-1])
        axes.annotate(f"{one.centre_m:.2f} m", centre, (0, 6), ha="center", **look)
        axes.annotate(f"{one.corner_m:.2f} m", corner, (-3, -3), ha="right", va="top", **look)
        axes.set_aspect("equal")
    figure.colorbar(
        filled, ax=[axes for axes, _ in panels], label="Apparent minus true depth (m)", shrink=0.9
    )
    return figure


def bed_figure(effects: list[Effect]) -> Figure:
    """Draw the apparent bed of one depth, the true one and their difference, after Fig 4."""
    figure, panels = _panels(effects, 4.2, 4.2, subplot_kw={"projection": "3d"})
    for axes, (one,) in panels:
        bed = np.full_like(one.error_m, -one.apparent_depth_m)
        _draw_surface(axes, one, bed + one.error_m, color="tab:blue", label="True bed")
        _draw_surface(axes, one, bed, color="tab:green", label="Apparent bed")
        _draw_surface(axes, one, one.error_m, color="tab:red", label="Difference")
        _label_surfaces(axes, one, "Height (m)")
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def stack_figure(effects: list[Effect]) -> Figure:
    """Draw the error at every depth as a surface, a stack per pair, after Figs 5 and 6."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    depths = [one.apparent_depth_m for one in effects]
    colours = ScalarMappable(Normalize(min(depths), max(depths)), DEPTH)
    shades = dict(zip(depths, colours.to_rgba(np.array(depths)), strict=True))
    figure, panels = _panels(effects, 4.2, 4.2, subplot_kw={"projection": "3d"})
    for axes, stack in panels:
        for one in stack:
            _draw_surface(axes, one, one.error_m, color=shades[one.apparent_depth_m])
        axes.set_zlim(min(-0.01, *(float(one.error_m.min()) for one in effects)), 0.0)
        _label_surfaces(axes, stack[0], "Apparent minus true depth (m)")
    figure.colorbar(
        colours, ax=[axes for axes, _ in panels], label="Apparent depth (m)", shrink=0.6, pad=0.08
    )
    return figure


def _draw_surface(axes: Any, one: Effect, z: FloatArray, **style: Any) -> None:
    axes.plot_surface(
        *np.meshgrid(one.x_m, one.y_m), z, rcount=12, ccount=12, linewidth=0.3,
        edgecolor=(0.0, 0.0, 0.0, 0.25), shade=False, **style,
    )  # fmt: skip


def _label_surfaces(axes: Any, one: Effect, height: str) -> None:
    """Give a panel of surfaces the model's shape in plan, few ticks, and room for its labels."""
    sides = np.array(one.pair.model_m)
    axes.set_box_aspect((*(sides / sides.max()), 0.7), zoom=0.8)
    axes.set_xlabel("Along (m)")
    axes.set_ylabel("Across (m)", labelpad=8.0)
    axes.set_zlabel(height, labelpad=6.0)
    axes.locator_params(nbins=4)


def _panels(
    effects: list[Effect], width_in: float, height_in: float, **grid: Any
) -> tuple[Figure, list[tuple[Any, list[Effect]]]]:
    """Return a panel for each pair with what belongs there; rows are overlaps, columns heights."""
    pairs, first = list(dict.fromkeys(one.pair for one in effects)), effects[0]
    rows, columns = len({p.overlap for p in pairs}), len({p.flying_height_m for p in pairs})
    figure, panels = new_figure(
        1.6 + width_in * columns, 0.8 + height_in * rows, nrows=rows, ncols=columns,
        squeeze=False, **grid,
    )  # fmt: skip
    for axes, pair in zip(panels.flat, pairs, strict=True):
        axes.set_title(
            f"{pair.flying_height_m:g} m, overlap {100.0 * pair.overlap:g} %", fontsize=10
        )
        axes.set(xlabel="Along the flight (m)", ylabel="Across the flight (m)")
    deepest = max(one.apparent_depth_m for one in effects)
    least = min(one.apparent_depth_m for one in effects)
    looks = f"{deepest:g}" if least == deepest else f"{least:g} to {deepest:g}"
    figure.suptitle(
        f"{first.pair.camera.name}, {first.pair.camera.focal_mm:g} mm:\nbed that looks {looks} m"
        f" deep, n = {first.refractive_index:g}"
    )
    own = [[one for one in effects if one.pair == pair] for pair in pairs]
    return figure, list(zip(panels.flat, own, strict=True))


def _levels(low: float, high: float) -> Any:
    """Return round values, about ten, from below `low` to above `high`."""
    rough = max(high - low, 1e-6) / 9.0
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(power * k for k in (1.0, 2.0, 2.5, 5.0, 10.0) if power * k >= rough)
    first = np.floor(low / step)
    return step * np.arange(first, max(np.ceil(high / step), first + 1.0) + 1.0)


def depth_figure(effects: list[Effect]) -> Figure:
    """Draw error and correction factor against the apparent depth, centre and corner."""
    figure, panels = new_figure(10.5, 6.0, nrows=1, ncols=2)
    cameras = list(dict.fromkeys(one.pair.camera for one in effects))
    for camera, colour in zip(cameras, (BEFORE, AFTER, REFERENCE), strict=False):
        own = [one for one in effects if one.pair.camera == camera]
        for i, pair in enumerate(dict.fromkeys(one.pair for one in own)):
            line = [one for one in own if one.pair == pair]
            line.sort(key=lambda one: one.apparent_depth_m)
            depth = np.array([one.apparent_depth_m for one in line])
            wet = depth > 0.0
            flight = f"{camera.name} {pair.flying_height_m:g} m, {100.0 * pair.overlap:g} %"
            for place, mark, fill in (("centre", "o", "white"), ("corner", "s", colour)):
                error = np.array([getattr(one, f"{place}_m") for one in line])
                style = {
                    "linestyle": LINES[i % len(LINES)], "marker": mark, "color": colour,
                    "markersize": 4, "markerfacecolor": fill, "label": f"{flight}, {place}",
                }  # fmt: skip
                panels[0].plot(depth, error, **style)
                panels[1].plot(depth[wet], 1.0 - error[wet] / depth[wet], **style)
    labels = "Apparent minus true depth (m)", "True over apparent depth"
    for axes, label in zip(panels, labels, strict=True):
        axes.set(xlabel="Apparent depth (m)", ylabel=label)
        axes.grid(color="0.9")
    index = effects[0].refractive_index
    panels[1].axhline(index, color="0.5", linewidth=1.0)
    panels[1].annotate(
        f"n = {index:g}", (1.0, index), xycoords=("axes fraction", "data"), xytext=(-4, -3),
        textcoords="offset points", ha="right", va="top", fontsize=9,
    )  # fmt: skip
    handles, names = panels[1].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(cameras))
    return figure


def shan_rows(pair: StereoPair, table: list[Iteration]) -> list[dict[str, Any]]:
    """Return the iterations as rows, each with the facts of its pair."""
    return [
        {
            "camera": pair.camera.name,
            "flying_height_m": pair.flying_height_m,
            "overlap": pair.overlap,
            "iteration": one.number,
            "mean_residual_m": float(f"{one.mean_m:.4g}"),
            "max_residual_m": float(f"{one.max_m:.4g}"),
            "change_tan_a": "" if np.isnan(one.change) else float(f"{one.change:.4g}"),
        }
        for one in table
    ]


def depth_bins_rows(bins: DepthBins) -> list[dict[str, Any]]:
    """Return RMSE and mean error of each bin and method as rows."""
    figures = bins.points.tolist(), bins.rmse_m.tolist(), bins.mean_m.tolist()
    return [
        {"depth_mm": name, "points": points}
        | {f"rmse_{m}_mm": round(1e3 * v, 3) for m, v in zip(METHODS, rmse, strict=True)}
        | {f"mean_{m}_mm": round(1e3 * v, 3) for m, v in zip(METHODS, mean, strict=True)}
        for name, points, rmse, mean in zip(_bin_names(), *figures, strict=True)
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

"""Tables of papers, remade: text, rows for a CSV file, and pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.flow.flume_methods import METHODS
from pcfix.report.figures import AFTER, BEFORE, REFERENCE, WATER, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pcfix.flow.flume_methods import DepthBins
    from pcfix.simulate.refraction_effect import Iteration

_COLOURS = {
    "uncorrected": REFERENCE, "I": BEFORE, "II": WATER, "III": "#8a8a8a", "pcfix": AFTER,
}  # fmt: skip


def shan_text(table: list[Iteration], title: str) -> str:
    """Return the residuals of Shan's iteration, a line each."""
    lines = [
        f"Shan's iteration, {title}: residual of the depth",
        f"{'iteration':>9}{'mean':>16}{'largest':>16}{'change of tan a':>18}",
    ]
    for one in table:
        change = "" if np.isnan(one.change) else f"{one.change:.1e}"
        lines.append(f"{one.number:>9}{one.mean_m:>14.3g} m{one.max_m:>14.3g} m{change:>18}")
    return "\n".join(lines)


def shan_rows(table: list[Iteration], **facts: Any) -> list[dict[str, Any]]:
    """Return the iterations as rows, each with the facts of its pair."""
    return [
        facts
        | {
            "iteration": one.number,
            "mean_residual_m": float(f"{one.mean_m:.4g}"),
            "max_residual_m": float(f"{one.max_m:.4g}"),
            "change_tan_a": "" if np.isnan(one.change) else float(f"{one.change:.4g}"),
        }
        for one in table
    ]


def depth_bins_text(bins: DepthBins) -> str:
    """Return the RMSE of the heights by depth, a column per method."""
    lines = [
        "RMSE of heights on the simulated flume, mm, by true depth; III: D ="
        f" {1000 * bins.offset_m:+.1f} mm {bins.slope:+.3f} d, r2 {bins.r2:.4f}",
        f"{'depth, m':<10}{'points':>7}" + "".join(f"{name:>13}" for name in METHODS),
    ]
    for name, points, row in zip(_bin_names(bins), _counts(bins), bins.rmse_m, strict=True):
        lines.append(f"{name:<10}{points:>7}" + "".join(f"{1e3 * v:>13.2f}" for v in row))
    return "\n".join(lines)


def depth_bins_rows(bins: DepthBins) -> list[dict[str, Any]]:
    """Return RMSE and mean error of each bin and method as rows."""
    return [
        {"depth_m": name, "points": points}
        | {f"rmse_{m}_mm": round(1e3 * v, 3) for m, v in zip(METHODS, rmse, strict=True)}
        | {f"mean_{m}_mm": round(1e3 * v, 3) for m, v in zip(METHODS, mean, strict=True)}
        for name, points, rmse, mean in zip(
            _bin_names(bins), _counts(bins), bins.rmse_m.tolist(), bins.mean_m.tolist(), strict=True
        )
    ]


def depth_bins_figure(bins: DepthBins) -> Figure:
    """Draw the RMSE of each bin, a bar per method, on a logarithmic scale."""
    figure, axes = new_figure(8.5, 4.8)
    places, width = np.arange(len(bins.points)), 0.8 / len(METHODS)
    for i, method in enumerate(METHODS):
        left = places + (i - (len(METHODS) - 1) / 2.0) * width
        axes.bar(left, 1e3 * bins.rmse_m[:-1, i], width, color=_COLOURS[method], label=method)
    axes.set_yscale("log")
    axes.set_xticks(places, _bin_names(bins)[:-1])
    axes.set_xlabel("True depth (m)")
    axes.set_ylabel("RMSE of heights (mm)")
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    figure.legend(loc="outside upper center", ncols=len(METHODS))
    return figure


def _bin_names(bins: DepthBins) -> list[str]:
    pairs = zip(bins.edges_m[:-1], bins.edges_m[1:], strict=True)
    return [*(f"{low:.1f}-{high:.1f}" for low, high in pairs), "all"]


def _counts(bins: DepthBins) -> list[int]:
    return [*bins.points.tolist(), int(bins.points.sum())]

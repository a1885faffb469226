"""The picture of a water surface that was found from the cloud alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.report.figures import AFTER, BEFORE, WATER, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pcfix.model import FloatArray
    from pcfix.water.auto import WaterProposal

WITNESSES = ("brightness", "noise")
"""Cues that do not fix the level are drawn thinly."""
SHOWN_CELLS = 40_000
LEAST_REACH_M, REACH_SIGMAS = 1.5, 8.0
LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)))
COLOURS = (BEFORE, AFTER, "#5b3a8c", "#2f7d4f", "#222222", "#a07c00")


def shoreline_figure(found: WaterProposal) -> Figure:
    """Draw the shoreline in plan, and heights and evidence beside it.

    Parameters
    ----------
    found : WaterProposal

    Returns
    -------
    Figure
    """
    figure, axes = new_figure(
        11.0, 6.5, nrows=2, ncols=2, width_ratios=[3, 2], height_ratios=[2, 3]
    )
    grid = axes[0, 0].get_gridspec()
    for unused in axes[:, 0]:
        unused.remove()
    plan = figure.add_subplot(grid[:, 0])
    _plan(plan, figure, found)
    _histogram(axes[0, 1], found)
    _evidence(axes[1, 1], found)
    figure.suptitle(_title(found))
    return figure


def _title(found: WaterProposal) -> str:
    tilt = 100.0 * float(np.hypot(*found.tilt))
    kind = f", tilt {tilt:.2f} %" if tilt > 0.0 else ""
    return (
        f"Water {found.level_m:.3f} ± {found.sigma_level_m:.3f} m{kind},"
        f" confidence {found.confidence:.2f}"
    )


def _above(found: WaterProposal, xyz: FloatArray) -> FloatArray:
    """Return heights above the surface, metres."""
    return np.asarray(xyz[:, 2] - found.level_m - (xyz[:, :2] - found.centre_xy) @ found.tilt)


def _plan(axes: Axes, figure: Figure, found: WaterProposal) -> None:
    ground = found.ground[:: len(found.ground) // SHOWN_CELLS + 1]
    above_m = _above(found, ground)
    reach = max(float(np.percentile(np.abs(above_m), 95.0)), 0.2)
    corner = np.floor(found.ground[:, :2].min(axis=0))
    x, y = (ground[:, :2] - corner).T
    size = 60.0 * np.sqrt(1_000.0 / len(ground))
    dots = axes.scatter(
        x, y, c=above_m, s=size, cmap="BrBG_r", vmin=-reach, vmax=reach, linewidths=0, marker="s"
    )
    figure.colorbar(
        dots,
        ax=axes,
        label="Apparent height above the surface (m)",
        location="bottom",
        shrink=0.7,
        aspect=30,
    )
    shore_x, shore_y = (found.shoreline[:, :2] - corner).T
    name = f"shoreline, {len(found.shoreline):,} places"
    axes.plot(shore_x, shore_y, ".", color="#c2185b", markersize=3, label=name)
    axes.set_aspect("equal")
    axes.set_xlabel(f"East (m) from {corner[0]:,.0f}")
    axes.set_ylabel(f"North (m) from {corner[1]:,.0f}")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False, borderaxespad=0.0)


def _histogram(axes: Axes, found: WaterProposal) -> None:
    low, high = _limits(found)
    heights = _above(found, found.ground) + found.level_m
    axes.hist(heights, bins=90, range=(low, high), color="0.65")
    _level(axes, found)
    axes.set_xlim(low, high)
    axes.set_xlabel("Apparent height (m)")
    axes.set_ylabel("Cells")
    axes.legend(loc="best")


def _limits(found: WaterProposal) -> tuple[float, float]:
    """Return the heights to show: the ground, but no more than is needed to see the level."""
    heights = _above(found, found.ground)
    low, high = np.percentile(heights, [1.0, 99.0])
    reach = max(LEAST_REACH_M, REACH_SIGMAS * found.sigma_level_m)
    lowest, highest = max(float(low), -4.0 * reach), min(float(high), 4.0 * reach)
    return found.level_m + min(lowest, -0.2), found.level_m + max(highest, 0.2)


def _level(axes: Axes, found: WaterProposal) -> None:
    axes.axvline(found.level_m, color=WATER, label="water")
    reach = 2.0 * found.sigma_level_m
    axes.axvspan(found.level_m - reach, found.level_m + reach, color=WATER, alpha=0.3, linewidth=0)


def _evidence(axes: Axes, found: WaterProposal) -> None:
    low, high = _limits(found)
    shown = (found.curves.height_m >= low) & (found.curves.height_m <= high)
    height = found.curves.height_m[shown]
    for (name, gain), colour, line in zip(found.curves.gain.items(), COLOURS, LINES, strict=False):
        width = 0.9 if name in WITNESSES else 1.8
        values = np.maximum(gain[shown], 0.0)
        axes.plot(height, values, color=colour, linestyle=line, linewidth=width, label=name)
    _level(axes, found)
    axes.set_xlim(low, high)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("Height of the water, if there (m)")
    axes.set_ylabel("Evidence (log likelihood ratio)")
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=3, fontsize="small", frameon=False
    )

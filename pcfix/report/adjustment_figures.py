"""The pictures of an adjustment: the block, its residuals, a section and the rounds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.adjust.block import sensor_groups
from pcfix.adjust.result import Adjusted, Before, Plain, nice_step, rms
from pcfix.grid.colours import DIFFERENCE
from pcfix.model import BoolArray, FloatArray
from pcfix.report.page import AFTER, BEFORE, WATER, Picture, label_plan, new_figure
from pcfix.water.surface import surface_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_POINTS = 6000
COLUMNS = 14
"""Cells over the width of an image, for mean residual vectors."""

LEAST_IN_CELL = 4
ARROW = 0.07
"""Length of a large arrow, as a share of the longer side of the block."""

ARROW_LOOK: Plain = {"angles": "xy", "scale_units": "xy", "zorder": 3}


def pictures_of(d: Plain, adjusted: Adjusted, before: Before | None) -> list[Picture]:
    """Return the pictures of an adjustment."""
    drawn = (
        _block(d, adjusted), _by_depth(d, before), _vectors(d, adjusted, before),
        _section(adjusted, before), _rounds(d, adjusted),
    )  # fmt: skip
    return [picture for picture in drawn if picture is not None]


def _block(d: Plain, a: Adjusted) -> Picture | None:
    moved = a.cameras.centres - a.block.cameras.centres
    known = np.asarray(np.isfinite(a.gnss_residual_m).any(axis=1))
    shown: list[tuple[str, FloatArray, BoolArray]] = []
    if d["poses_are"] != "fixed":
        shown.append(("Movement of the projection centres", moved, np.ones(len(moved), bool)))
    if known.any():
        shown.append(("Adjusted minus GNSS", a.gnss_residual_m, known))
    if not shown:
        return None
    size = np.ptp(a.block.cameras.centres[:, :2], axis=0)
    share = float(np.clip(size[1] / max(size[0], 1e-9), 0.25, 1.2))
    n = len(shown)
    figure, panels = new_figure(8.0, n * (5.2 * share + 1.4), nrows=n, squeeze=False)
    for axes, (title, vectors, rows) in zip(panels.ravel(), shown, strict=True):
        _arrows(figure, axes, a, vectors, rows)
        axes.set_title(title, loc="left", pad=12.0)
    alt = (
        "The block in plan. Enlarged arrows show how far each projection centre moved, and its"
        " difference from the GNSS position; their colour shows the vertical part."
        f" The centres moved by {d['poses']['moved_rms_m']:.3f} m (rms)."
    )
    return Picture("block", "Projection centres", alt, figure)


def _arrows(figure: Figure, axes: Axes, a: Adjusted, vectors: FloatArray, rows: BoolArray) -> None:
    """Draw vectors at the projection centres: in plan as arrows, in height as colour."""
    xyz = a.xyz[a.is_observed]
    xyz = xyz[:: max(1, len(xyz) // MOST_POINTS)]
    axes.plot(*xyz[:, :2].T, ".", color="0.85", markersize=1.5, zorder=1)
    at, by = a.cameras.centres[rows], np.nan_to_num(vectors[rows])
    side = float(max(np.ptp(a.cameras.centres[:, :2], axis=0).max(), 1e-3))
    length = np.hypot(by[:, 0], by[:, 1])
    key = nice_step(max(float(np.percentile(length, 95.0)), 1e-6) / 2.0)
    reach = max(float(np.abs(by[:, 2]).max()), 1e-6)
    arrows = axes.quiver(
        at[:, 0], at[:, 1], by[:, 0], by[:, 1], by[:, 2], cmap=DIFFERENCE,
        scale=key / (ARROW * side), clim=(-reach, reach), edgecolor="0.3", linewidth=0.5,
        width=0.007, **ARROW_LOOK,
    )  # fmt: skip
    axes.plot(at[:, 0], at[:, 1], "o", color="0.2", markersize=1.5, zorder=2)
    figure.colorbar(arrows, ax=axes, label="Up (m)", shrink=0.8)
    axes.quiverkey(arrows, 0.85, 1.05, key, f"{key:g} m", labelpos="E")
    tips = at[:, :2] + by[:, :2] * (ARROW * side / key)
    axes.update_datalim(tips)
    axes.margins(0.05)
    axes.autoscale_view()
    label_plan(axes)


def _by_depth(d: Plain, before: Before | None) -> Picture | None:
    """Return residuals by depth, land first."""
    land = d["residuals"]["land"]
    bins = [("land", land)] if land["observations"] else []
    bins += [(f"{b['from_m']:g} to {b['to_m']:g}", b) for b in d["depth_bins"]]
    if not bins:
        return None
    figure, axes = new_figure(8.0, 3.8)
    place = np.arange(len(bins))
    times = [("before", "rms_before_px", BEFORE)] if before is not None else []
    times.append(("after", "rms_px", AFTER))
    thick = 0.8 / len(times)
    for i, (name, key, colour) in enumerate(times):
        heights = [b[key] if b[key] is not None else np.nan for _, b in bins]
        at = place + (i - (len(times) - 1) / 2.0) * thick
        bars = axes.bar(at, heights, thick, color=colour, label=name)
        labels = ["" if np.isnan(h) else f"{h:.2f}" for h in heights]
        axes.bar_label(bars, labels, fontsize="small", padding=1)
    axes.set_xticks(place, [f"{name}\n{b['observations']:,}" for name, b in bins])
    axes.set_xlabel("Depth below the water (m), and how many observations")
    axes.set_ylabel(f"Rms residual ({d['image_unit']})")
    axes.margins(y=0.12)
    axes.legend(loc="best")
    alt = (
        "Root mean square of the residuals in the images (of a coordinate), of points on land and"
        " by depth below the water."
    )
    if before is not None:
        alt += " Before: original poses and lens, points intersected with refraction."
    return Picture("residuals_by_depth", "Residuals by depth", alt, figure)


def _vectors(d: Plain, a: Adjusted, before: Before | None) -> Picture | None:
    """Return mean residual vectors over the image, of the sensor that sees most."""
    lenses = a.block.cameras.lenses or ()
    group, _ = sensor_groups(lenses)
    of_group = group[a.block.camera]
    main = int(np.bincount(of_group[a.used], minlength=1).argmax())
    lens = lenses[int(np.flatnonzero(group == main)[0])]
    rows = a.used & (of_group == main)
    sets = [("before", before.residual_px, BEFORE)] if before is not None else []
    sets.append(("after", a.residual_px, AFTER))
    cells = [(name, _cell_means(a, r, rows, lens.width, lens.height), c) for name, r, c in sets]
    largest = max((float(np.hypot(*m[2:]).max(initial=0.0)) for _, m, _ in cells), default=0.0)
    if not largest > 0.0:
        return None
    cell = lens.width / COLUMNS
    key = nice_step(largest / 2.0)
    figure, panels = new_figure(
        8.0, 8.0 / len(cells) * lens.height / lens.width + 0.7, ncols=len(cells), squeeze=False,
        sharey=True,
    )  # fmt: skip
    for axes, (name, (u, v, du, dv), colour) in zip(panels.ravel(), cells, strict=True):
        arrows = axes.quiver(
            u, v, du, dv, color=colour, scale=largest / (1.6 * cell), width=0.004, **ARROW_LOOK
        )
        axes.quiverkey(arrows, 0.85, 1.04, key, f"{key:g} {lens.unit}", labelpos="E")
        axes.set_title(name)
        axes.set_xlim(0.0, lens.width)
        axes.set_ylim(lens.height, 0.0)
        axes.set_aspect("equal")
        axes.locator_params(nbins=5)
        axes.set_xlabel(f"u ({lens.unit})")
    panels[0, 0].set_ylabel(f"v ({lens.unit})")
    rest = {name: rms(np.concatenate(m[2:])) for name, m, _ in cells}
    alt = (
        f"Mean residuals (measured minus computed) by place in the image, enlarged alike; sensor"
        f" {lens.sensor or main + 1}. Lens and poses did not absorb these: "
        + ", ".join(f"{name} {value:.3f} {lens.unit} rms" for name, value in rest.items() if value)
        + "."
    )
    return Picture("residual_vectors", "Residuals over the image", alt, figure)


def _cell_means(
    a: Adjusted, residual: FloatArray, rows: BoolArray, width: float, height: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return centres of cells of the image and mean residuals there."""
    from scipy.stats import binned_statistic_2d

    rows = rows & np.asarray(np.isfinite(residual).all(axis=1))
    bins = [COLUMNS, max(1, round(height * COLUMNS / width))]
    (u, v), limits = a.block.image_xy[rows].T, [[0.0, width], [0.0, height]]
    found: Any = binned_statistic_2d
    count = found(u, v, u, "count", bins, limits).statistic
    du, dv = found(u, v, residual[rows].T, "mean", bins, limits).statistic
    column, row = np.nonzero(count >= LEAST_IN_CELL)
    u, v = (column + 0.5) * width / bins[0], (row + 0.5) * height / bins[1]
    return u, v, du[column, row], dv[column, row]


def _section(a: Adjusted, before: Before | None) -> Picture | None:
    """Return the points in a strip along the block, with the water."""
    station, across, line = _strip(a.xyz)
    inside = np.abs(across - np.median(across)) < 0.15 * float(np.ptp(across)) + 1e-9
    rows = np.flatnonzero(inside & a.is_observed)
    rows = rows[:: max(1, len(rows) // MOST_POINTS)]
    if len(rows) < 2:
        return None
    figure, axes = new_figure(8.0, 4.0)
    if before is not None:
        axes.plot(
            station[rows], before.xyz[rows, 2], ".", color=BEFORE, markersize=2.5, label="before"
        )
    for wet, colour, name in ((False, "0.35", "after, land"), (True, AFTER, "after, under water")):
        some = rows[a.is_wet[rows] == wet]
        if len(some):
            axes.plot(station[some], a.xyz[some, 2], ".", color=colour, markersize=2.5, label=name)
    if a.water is not None:
        height = surface_above(a.water, line).height_m
        axes.plot(np.linspace(0.0, station.max(), len(line)), height, color=WATER, label="water")
    low, high = np.percentile(a.xyz[rows, 2], [0.2, 99.8])
    margin = 0.15 * (high - low) + 0.05
    axes.set_ylim(low - margin, high + margin)
    axes.ticklabel_format(style="plain", useOffset=False)
    axes.set_xlabel("Along the block (m)")
    axes.set_ylabel("Height (m)")
    axes.legend(loc="best", markerscale=3.0)
    alt = (
        f"Points of a strip along the middle of the block, {len(rows):,} of them, in section,"
        " and the water."
        + (" Before: intersected with the original poses and lens." if before else "")
    )
    return Picture("section", "Section", alt, figure)


def _strip(xyz: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the positions of points along and across the longest extent of the block.

    The third result are places along its middle, shape (200, 3), for the water; metres.
    """
    middle = xyz.mean(axis=0)
    plan = xyz[:, :2] - middle[:2]
    along, aside = np.linalg.svd(plan, full_matrices=False)[2]
    along = along if along[0] >= 0.0 else -along
    station, across = plan @ along, plan @ aside
    places = np.linspace(station.min(), station.max(), 200)[:, None]
    line = middle[:2] + places * along + np.median(across) * aside
    return station - station.min(), across, np.column_stack([line, np.zeros(200)])


def _rounds(d: Plain, a: Adjusted) -> Picture | None:
    """Return cost and residuals step by step."""
    if len(a.rounds) < 2:
        return None
    figure, (upper, lower) = new_figure(8.0, 4.6, nrows=2, sharex=True)
    step = np.arange(1, len(a.rounds) + 1)
    number, _, cost, _, _, rms_px = np.array(a.rounds).T
    for axes, values in ((upper, cost), (lower, rms_px)):
        for one in np.unique(number):
            of_round = number == one
            axes.plot(step[of_round], values[of_round], "o-", color=AFTER, markersize=3)
        # over several powers of ten, as poor starts have
        if values.min() > 0.0 and values.max() > 20.0 * values.min():
            axes.set_yscale("log")
    for axes in (upper, lower):
        for first in np.flatnonzero(np.diff(number)) + 1.5:
            axes.axvline(first, color="0.6", linewidth=0.8, linestyle="--")
        axes.grid(visible=True, axis="y", color="0.9", linewidth=0.6)
    for one in np.unique(number):
        upper.annotate(
            f"round {one:g}", (step[number == one][0], 1.0), xycoords=("data", "axes fraction"),
            xytext=(2, 3), textcoords="offset points", fontsize="small",
        )  # fmt: skip
    upper.set_ylabel("Cost")
    lower.set_ylabel(f"Rms residual ({d['image_unit']})")
    lower.set_xlabel("Step")
    lower.xaxis.get_major_locator().set_params(integer=True)
    alt = (
        "Cost (sum of weighted squares) and RMS residual after each step. Dashed lines separate"
        " the rounds, whose costs cannot be compared, as outliers are excluded between them."
    )
    return Picture("rounds", "Convergence", alt, figure)

"""The pictures of an adjustment: the block and its residuals."""

from __future__ import annotations

from typing import Any

import numpy as np

from pcfix.adjust.block import sensor_groups
from pcfix.adjust.problem import Intersected
from pcfix.adjust.result import Adjusted, Plain, rms
from pcfix.grid.colours import DIFFERENCE
from pcfix.model import BoolArray, FloatArray
from pcfix.report.page import AFTER, BEFORE, Picture, label_plan, new_figure
from pcfix.sums import nice_step

MOST_POINTS = 6000
COLUMNS = 14
"""Cells over the width of an image, for mean residual vectors."""
LEAST_IN_CELL = 4
ARROW = 0.07
"""Length of a large arrow, as a share of the longer side of the block."""
ARROW_LOOK: Plain = {"angles": "xy", "scale_units": "xy", "zorder": 3}


def pictures_of(d: Plain, adjusted: Adjusted, before: Intersected | None) -> list[Picture]:
    """Return the pictures of an adjustment."""
    drawn = _block(d, adjusted), _by_depth(d, before), _vectors(adjusted, before)
    return [picture for picture in drawn if picture is not None]


def _block(d: Plain, a: Adjusted) -> Picture | None:
    """Draw how far the projection centres moved, and their differences from GNSS, as arrows."""
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
    xyz = a.xyz[a.is_observed]
    xyz = xyz[:: max(1, len(xyz) // MOST_POINTS)]
    side = float(max(np.ptp(a.cameras.centres[:, :2], axis=0).max(), 1e-3))
    for axes, (title, vectors, rows) in zip(panels.ravel(), shown, strict=True):
        # in plan as arrows, in height as colour
        axes.plot(*xyz[:, :2].T, ".", color="0.85", markersize=1.5, zorder=1)
        (x, y, _), (dx, dy, up) = a.cameras.centres[rows].T, np.nan_to_num(vectors[rows]).T
        key = nice_step(max(float(np.percentile(np.hypot(dx, dy), 95.0)), 1e-6) / 2.0)
        longer, reach = ARROW * side / key, max(float(np.abs(up).max()), 1e-6)
        arrows = axes.quiver(
            x, y, dx, dy, up, cmap=DIFFERENCE, scale=1.0 / longer, clim=(-reach, reach),
            edgecolor="0.3", linewidth=0.5, width=0.007, **ARROW_LOOK,
        )  # fmt: skip
        axes.plot(x, y, "o", color="0.2", markersize=1.5, zorder=2)
        figure.colorbar(arrows, ax=axes, label="Up (m)", shrink=0.8)
        axes.quiverkey(arrows, 0.85, 1.05, key, f"{key:g} m", labelpos="E")
        axes.update_datalim(np.column_stack([x + longer * dx, y + longer * dy]))
        axes.margins(0.05)
        axes.autoscale_view()
        label_plan(axes)
        axes.set_title(title, loc="left", pad=12.0)
    alt = (
        "The block in plan. Enlarged arrows show how far each projection centre moved, and its"
        " difference from the GNSS position; their colour shows the vertical part."
        f" The centres moved by {d['poses']['moved_rms_m']:.3f} m (rms)."
    )
    return Picture("block", "Projection centres", alt, figure)


def _by_depth(d: Plain, before: Intersected | None) -> Picture | None:
    """Draw residuals by depth, land first."""
    land = d["residuals"]["land"]
    bins = [("land", land)] if land["observations"] else []
    bins += [(f"{b['from_m']:g} to {b['to_m']:g}", b) for b in d["depth_bins"]]
    if not bins:
        return None
    figure, axes = new_figure(8.0, 3.8)
    times = [("before", "rms_before_px", BEFORE)] if before is not None else []
    times.append(("after", "rms_px", AFTER))
    names = [f"{name}\n{b['observations']:,}" for name, b in bins]
    values = {
        name: [np.nan if b[key] is None else b[key] for _, b in bins] for name, key, _ in times
    }
    thick = 0.8 / len(times)
    for i, (name, _, colour) in enumerate(times):
        at = np.arange(len(bins)) + (i - (len(times) - 1) / 2.0) * thick
        bars = axes.bar(at, values[name], thick, color=colour, label=name)
        axes.bar_label(bars, fmt="%.2f", fontsize="small", padding=1)
    axes.set_xticks(range(len(bins)), names)
    axes.set_xlabel("Depth below the water (m), and number of observations")
    axes.set_ylabel(f"RMS residual ({d['image_unit']})")
    axes.margins(y=0.12)
    axes.legend(loc="best")
    alt = (
        "Root mean square of the residuals in the images (of a coordinate), of points on land and"
        " by depth below the water."
    )
    if before is not None:
        alt += " Before: original poses and lens, points intersected with refraction."
    return Picture("residuals_by_depth", "Residuals by depth", alt, figure)


def _vectors(a: Adjusted, before: Intersected | None) -> Picture | None:
    """Draw mean residual vectors over the image, of the sensor with most observations."""
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
    key, scale = nice_step(largest / 2.0), largest * COLUMNS / (1.6 * lens.width)
    height_in = 8.0 / len(cells) * lens.height / lens.width + 0.7
    figure, panels = new_figure(8.0, height_in, ncols=len(cells), squeeze=False, sharey=True)
    for axes, (name, means, colour) in zip(panels.ravel(), cells, strict=True):
        arrows = axes.quiver(*means, color=colour, scale=scale, width=0.004, **ARROW_LOOK)
        axes.quiverkey(arrows, 0.85, 1.04, key, f"{key:g} {lens.unit}", labelpos="E")
        axes.set(title=name, xlim=(0.0, lens.width), ylim=(lens.height, 0.0), aspect="equal")
        axes.locator_params(nbins=5)
        axes.set_xlabel(f"u ({lens.unit})")
    panels[0, 0].set_ylabel(f"v ({lens.unit})")
    rest = {name: float(rms(np.concatenate(m[2:]))) for name, m, _ in cells if len(m[2])}
    alt = (
        f"Mean residuals (measured minus computed) by place in the image, enlarged alike; sensor"
        f" {lens.sensor or main + 1}. Lens and poses did not absorb these: "
        + ", ".join(
            f"{name} {value:.3f} {lens.unit} rms" for name, value in rest.items() if value > 0.0
        )
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

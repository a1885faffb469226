"""What ``pcfix water`` says of a water surface: in words, and as a picture of its evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.grid.colours import DIFFERENCE
from pcfix.model import BoolArray, FloatArray
from pcfix.report.page import AFTER, BEFORE, WATER, Picture, draw_cloud, label_plan, new_figure
from pcfix.report.text import shoreline_lines
from pcfix.water.auto import WaterProposal
from pcfix.water.fit import WaterFit
from pcfix.water.river import RiverFit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pcfix.water.surface import FoundSurface

MOST_LISTED = 10
WITNESSES = ("brightness", "noise")
"""Cues that do not fix the level are drawn thinly."""
SHOWN_CELLS = 40_000
LEAST_REACH_M, REACH_SIGMAS = 1.5, 8.0
LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)))
COLOURS = (BEFORE, AFTER, "#5b3a8c", "#2f7d4f", "#222222", "#a07c00")


@dataclass(frozen=True, eq=False)
class WaterReport:
    """What ``pcfix water`` says.

    Attributes
    ----------
    spec : str
    found : FoundSurface
    cloud : str or None
    below, unknown : float or None
        Share of the cloud's points below the surface, and of those without a surface above them.
    sample_xyz : array, shape (m, 3)
        Points of the cloud, evenly spread, for a picture.
    shoreline : dict or None
        What was written of it.
    """

    spec: str
    found: FoundSurface
    cloud: str | None
    below: float | None
    unknown: float | None
    sample_xyz: FloatArray
    shoreline: dict[str, Any] | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {
            "water": self.spec,
            "surface": str(self.found.surface),
            "fit": self.found.as_dict(),
            "points": self._points(),
            "cloud": self.cloud,
            "share_below": self.below,
            "share_unknown": self.unknown,
            "shoreline": self.shoreline,
            "notes": list(self.found.notes),
        }

    def _points(self) -> list[dict[str, Any]] | None:
        """Return each fitted point with its residual, None where it has no height."""
        found = self.found
        if found.points is None or not isinstance(found.evidence, WaterFit | RiverFit):
            return None
        fit = found.evidence
        rows = zip(found.points, fit.residual_m, fit.accepted, strict=True)
        return [
            {
                "xyz": [float(v) if np.isfinite(v) else None for v in xyz],
                "residual_m": float(residual) if np.isfinite(residual) else None,
                "accepted": bool(accepted),
            }
            for xyz, residual, accepted in rows
        ]


def water_text(report: WaterReport) -> str:
    """Return what a person wants to know of a water surface."""
    found = report.found
    lines = [f"{report.spec}: {found.surface}"]
    match found.evidence:
        case WaterFit() as fit:
            lines += _fit(fit, found.points)
        case RiverFit() as river:
            lines += _river(river, found.points)
        case WaterProposal() as proposal:
            lines += [
                f"level        {proposal.level_m:.3f} m, standard error"
                f" {proposal.sigma_level_m:.3f} m, confidence {proposal.confidence:.2f}",
                *(f"evidence     {reason}" for reason in proposal.reasons),
            ]
    if report.below is not None and report.unknown is not None:
        lines.append(
            f"cloud        {100.0 * report.below:.1f} % of {report.cloud} lie below it,"
            f" {100.0 * report.unknown:.1f} % have no surface above them"
        )
    lines += shoreline_lines(report.shoreline)
    return "\n".join([*lines, *(f"note         {note}" for note in found.notes)])


def _fit(fit: WaterFit, points: FloatArray | None) -> list[str]:
    x, y = fit.centre_xy
    lines = [
        f"model        {fit.model}, of {int(fit.accepted.sum())} of {len(fit.accepted)} points;"
        f" scatter {fit.sigma_m:.3f} m",
        f"level        {fit.level_m:.3f} m at {x:.1f}, {y:.1f}; standard error"
        f" {fit.sigma_level_m:.3f} m",
    ]
    if fit.tilt.any():
        lines.append(
            f"tilt         {fit.tilt_percent:.3f} %, standard error {fit.sigma_tilt_percent:.3f} %,"
            f" falls towards {fit.downhill_deg:.0f} degrees"
        )
    return [*lines, *_rejected(fit.residual_m, fit.accepted, points)]


def _river(river: RiverFit, points: FloatArray | None) -> list[str]:
    known = int(river.accepted.sum())
    return [
        f"model        river, of {known} of {len(river.accepted)} points; scatter"
        f" {river.sigma_m:.3f} m",
        f"length       {river.length_m:.1f} m, falls {river.drop_m:.3f} m; standard error of the"
        f" level {river.profile.sigma_height_m.mean():.3f} m",
        *_rejected(river.residual_m, river.accepted, points),
    ]


def _rejected(residual_m: FloatArray, accepted: BoolArray, points: FloatArray | None) -> list[str]:
    """Sum up the residuals, and list the points that were not believed, worst first."""
    good = np.abs(residual_m[accepted])
    lines = [
        f"residuals    of the accepted points: rms {np.sqrt(np.mean(good**2)):.3f} m, median"
        f" {np.median(good):.3f} m, largest {good.max():.3f} m"
    ]
    rows = np.flatnonzero(~accepted & np.isfinite(residual_m))
    rows = rows[np.argsort(-np.abs(residual_m[rows]), kind="stable")]
    if points is None or len(rows) == 0:
        return lines
    lines += [
        f"rejected     {points[i, 0]:.2f}, {points[i, 1]:.2f}, {points[i, 2]:.2f}:"
        f" {residual_m[i]:+.3f} m"
        for i in rows[:MOST_LISTED]
    ]
    more = len(rows) - MOST_LISTED
    return [*lines, f"             and {more} more"] if more > 0 else lines


def water_figure(report: WaterReport) -> Figure:
    """Draw the shoreline points in plan and their residuals, or what was found in the cloud."""
    found = report.found
    if isinstance(found.evidence, WaterProposal):
        return shoreline_figure(found.evidence)
    figure, (plan, side) = new_figure(8.0, 7.5, nrows=2, height_ratios=[3, 2])
    draw_cloud(figure, plan, report.sample_xyz, getattr(found.evidence, "level_m", None))
    if found.evidence is not None and found.points is not None:
        _points(plan, side, found.points, found.evidence)
    label_plan(plan, 20.0)
    plan.set_title(str(found.surface))
    return figure


def _points(plan: Axes, side: Axes, points: FloatArray, fit: WaterFit | RiverFit) -> None:
    station = _station(points, fit)
    height = fit.height_at(points[:, :2])
    order = np.argsort(station)
    side.plot(station[order], height[order], color=WATER, label="surface")
    sigma = fit.sigma_at(points[:, :2])[order]
    low, high = height[order] - 2.0 * sigma, height[order] + 2.0 * sigma
    side.fill_between(station[order], low, high, color=WATER, alpha=0.3, label="95 %")
    for rows, mark, colour, name in (
        (fit.accepted, "o", AFTER, "accepted"),
        (~fit.accepted, "x", BEFORE, "rejected"),
    ):
        if rows.any():
            plan.plot(*points[rows, :2].T, mark, color=colour, markersize=5, label=name)
            side.plot(station[rows], points[rows, 2], mark, color=colour, markersize=5)
    side.set_xlabel("Down the flow (m)" if isinstance(fit, RiverFit) else "Along the points (m)")
    side.set_ylabel("Height (m)")
    side.legend(loc="best")
    plan.legend(loc="upper right", bbox_to_anchor=(1.0, 1.0))


def _station(points: FloatArray, fit: WaterFit | RiverFit) -> FloatArray:
    """Return how far down the river or the tilt, or along their longest extent, points lie."""
    if isinstance(fit, RiverFit):
        return np.asarray(fit.axis.locate(points[:, :2])[0])
    centred = points[:, :2] - points[:, :2].mean(axis=0)
    if fit.tilt.any():
        axis = -fit.tilt / np.hypot(*fit.tilt)
    else:
        axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    station = centred @ axis
    return np.asarray(station - station.min())


def found_picture(found: FoundSurface) -> Picture:
    """Return what a level that was found in the cloud rests on, for a page."""
    alt = "How the water was found: the shoreline in plan, the heights, and what speaks for which."
    reasons = found.evidence.reasons if isinstance(found.evidence, WaterProposal) else ()
    alt += "".join(f" {reason[:1].upper()}{reason[1:].rstrip('.')}." for reason in reasons)
    figure = water_figure(WaterReport("auto", found, None, None, None, np.zeros((0, 3))))
    return Picture("water", "The water level found in the cloud", alt, figure)


def shoreline_figure(found: WaterProposal) -> Figure:
    """Draw the shoreline in plan, and heights and evidence beside it."""
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
    tilt = 100.0 * float(np.hypot(*found.tilt))
    kind = f", tilt {tilt:.2f} %" if tilt > 0.0 else ""
    figure.suptitle(
        f"Water {found.level_m:.3f} ± {found.sigma_level_m:.3f} m{kind},"
        f" confidence {found.confidence:.2f}"
    )
    return figure


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
        x, y, c=above_m, s=size, cmap=DIFFERENCE, vmin=-reach, vmax=reach, linewidths=0, marker="s"
    )
    label = "Apparent height above the surface (m)"
    figure.colorbar(dots, ax=axes, label=label, location="bottom", shrink=0.7, aspect=30)
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
    axes.set(xlim=(low, high), xlabel="Apparent height (m)", ylabel="Cells")
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
    shown = (found.curve_height_m >= low) & (found.curve_height_m <= high)
    height = found.curve_height_m[shown]
    for (name, gain), colour, line in zip(found.curves.items(), COLOURS, LINES, strict=False):
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

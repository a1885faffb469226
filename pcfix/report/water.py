"""The report of ``pcfix water`` on a water surface: its summary, and a picture of its evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.grid.colours import DIFFERENCE
from pcfix.model import FloatArray
from pcfix.report.page import AFTER, BEFORE, WATER, Picture, draw_cloud, label_plan, new_figure
from pcfix.report.text import aligned, shoreline_rows
from pcfix.water.auto import WaterProposal
from pcfix.water.fit import WaterFit
from pcfix.water.river import RiverFit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pcfix.water.surface import FoundSurface

MOST_LISTED = 10
WITNESSES = ("brightness", "noise")
"""Evidence that does not fix the level; it is drawn with thin lines."""
SHOWN_CELLS = 40_000
LEAST_REACH_M, REACH_SIGMAS = 1.5, 8.0
LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)))
COLOURS = (BEFORE, AFTER, "#5b3a8c", "#2f7d4f", "#222222", "#a07c00")


@dataclass(frozen=True, eq=False)
class WaterReport:
    """The report of ``pcfix water``.

    Attributes
    ----------
    below, unknown : float or None
        Share of the cloud's points below the surface, and of those without a surface above them.
    sample_xyz : array, shape (m, 3)
        Points of the cloud, evenly spread, for a picture.
    shoreline : dict or None
        File, lines and length of the shoreline that was written.
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
            "points": _residuals(self.found),
            "cloud": self.cloud,
            "share_below": self.below,
            "share_unknown": self.unknown,
            "shoreline": self.shoreline,
            "notes": list(map(str, self.found.notes)),
        }


def _residuals(found: FoundSurface) -> list[dict[str, Any]] | None:
    """Return each fitted point with its residual, None where it has no height."""
    fit = found.evidence
    if found.points is None or not isinstance(fit, WaterFit | RiverFit):
        return None
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
    """Return the summary of a water surface."""
    found, rows = report.found, list[tuple[str, str]]()
    match found.evidence:
        case WaterFit() as fit:
            x, y = fit.centre_xy
            level = f"{fit.level_m:.3f} m at {x:.1f}, {y:.1f}"
            rows = [
                _model_row(fit.model, fit),
                ("Level", f"{level}; standard error {fit.sigma_level_m:.3f} m"),
            ]
            if fit.tilt.any():
                rows.append(("Tilt", f"{fit.tilt_percent:.3f} %, standard error"
                             f" {fit.sigma_tilt_percent:.3f} %, falls towards"
                             f" {fit.downhill_deg:.0f} deg"))  # fmt: skip
            rows += _residual_rows(fit, found.points)
        case RiverFit() as river:
            sigma = river.profile.sigma_height_m.mean()
            rows = [
                _model_row("river", river),
                ("Length", f"{river.length_m:.1f} m, falls {river.drop_m:.3f} m; standard error of"
                 f" the level {sigma:.3f} m"),
                *_residual_rows(river, found.points),
            ]  # fmt: skip
        case WaterProposal() as proposal:
            rows = [
                ("Level", f"{proposal.level_m:.3f} m, standard error {proposal.sigma_level_m:.3f}"
                 f" m, confidence {proposal.confidence:.2f}"),
                *(("Evidence", reason) for reason in proposal.reasons),
            ]  # fmt: skip
    if report.below is not None and report.unknown is not None:
        rows.append(("Cloud", f"{100.0 * report.below:.1f} % of {report.cloud} are below the"
                     f" surface, {100.0 * report.unknown:.1f} % have none above them"))  # fmt: skip
    rows += shoreline_rows(report.shoreline)
    return aligned(f"{report.spec}: {found.surface}", rows, found.notes)


def _model_row(name: str, fit: WaterFit | RiverFit) -> tuple[str, str]:
    used = f"{int(fit.accepted.sum())} of {len(fit.accepted)} points"
    return "Model", f"{name}, {used}; scatter {fit.sigma_m:.3f} m"


def _residual_rows(fit: WaterFit | RiverFit, points: FloatArray | None) -> list[tuple[str, str]]:
    """Return the size of the residuals, and the rejected points, the largest residual first."""
    residual = fit.residual_m
    good = np.abs(residual[fit.accepted])
    rows = [("Residuals", f"of the accepted points: rms {np.sqrt(np.mean(good**2)):.3f} m, median"
             f" {np.median(good):.3f} m, largest {good.max():.3f} m")]  # fmt: skip
    if points is None:
        return rows
    rejected = np.flatnonzero(~fit.accepted & np.isfinite(residual))
    rejected = rejected[np.argsort(-np.abs(residual[rejected]), kind="stable")]
    for i in rejected[:MOST_LISTED]:
        x, y, z = points[i]
        rows.append(("Rejected", f"{x:.2f}, {y:.2f}, {z:.2f}: {residual[i]:+.3f} m"))
    more = len(rejected) - MOST_LISTED
    return [*rows, ("", f"and {more} more")] if more > 0 else rows


def water_figure(report: WaterReport) -> Figure:
    """Draw the shoreline points in plan and their residuals, or the evidence found in the cloud."""
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
    """Return the distance of points along the river, the tilt, or their longest extent."""
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
    """Return the evidence for a level that was found in the cloud, for the page."""
    alt = "How the water was found: shoreline in plan, heights, and the evidence for each height."
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
    _plan(figure.add_subplot(grid[:, 0]), figure, found)
    # heights to show: the ground, but no more than is needed to see the level
    heights = _above(found, found.ground)
    low, high = np.percentile(heights, [1.0, 99.0])
    most = 4.0 * max(LEAST_REACH_M, REACH_SIGMAS * found.sigma_level_m)
    low = found.level_m + min(max(float(low), -most), -0.2)
    high = found.level_m + max(min(float(high), most), 0.2)
    _histogram(axes[0, 1], found, heights, (low, high))
    _evidence(axes[1, 1], found, (low, high))
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


def _histogram(
    axes: Axes, found: WaterProposal, above_m: FloatArray, limits: tuple[float, float]
) -> None:
    axes.hist(above_m + found.level_m, bins=90, range=limits, color="0.65")
    _level(axes, found)
    axes.set(xlim=limits, xlabel="Apparent height (m)", ylabel="Cells")
    axes.legend(loc="best")


def _level(axes: Axes, found: WaterProposal) -> None:
    axes.axvline(found.level_m, color=WATER, label="water")
    reach = 2.0 * found.sigma_level_m
    axes.axvspan(found.level_m - reach, found.level_m + reach, color=WATER, alpha=0.3, linewidth=0)


def _evidence(axes: Axes, found: WaterProposal, limits: tuple[float, float]) -> None:
    low, high = limits
    shown = (found.curve_height_m >= low) & (found.curve_height_m <= high)
    height = found.curve_height_m[shown]
    for (name, gain), colour, line in zip(found.curves.items(), COLOURS, LINES, strict=False):
        width = 0.9 if name in WITNESSES else 1.8
        values = np.maximum(gain[shown], 0.0)
        axes.plot(height, values, color=colour, linestyle=line, linewidth=width, label=name)
    _level(axes, found)
    axes.set(xlim=limits, xlabel="Height of the water, if there (m)")
    axes.set(ylim=(0.0, None), ylabel="Evidence (log likelihood ratio)")
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=3, fontsize="small", frameon=False
    )

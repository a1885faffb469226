"""A water surface in words and as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.report.figures import AFTER, BEFORE, WATER, new_figure
from pcfix.report.shoreline import shoreline_figure
from pcfix.water.auto import WaterProposal
from pcfix.water.fit import WaterFit
from pcfix.water.river import RiverFit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from pcfix.flow.water import WaterReport
    from pcfix.model import BoolArray, FloatArray

MOST_POINTS = 8000
MOST_LISTED = 10


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
    said = [
        f"residuals    of the accepted points: rms {np.sqrt(np.mean(good**2)):.3f} m, median"
        f" {np.median(good):.3f} m, largest {good.max():.3f} m"
    ]
    rows = np.flatnonzero(~accepted & np.isfinite(residual_m))
    rows = rows[np.argsort(-np.abs(residual_m[rows]), kind="stable")]
    if points is None or len(rows) == 0:
        return said
    lines = said + [
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
    sample = report.sample_xyz[:: max(1, len(report.sample_xyz) // MOST_POINTS)]
    if len(sample):
        dots = plan.scatter(*sample[:, :2].T, c=sample[:, 2], s=2, cmap="cividis")
        figure.colorbar(dots, ax=plan, label="Height of the cloud (m)", shrink=0.8)
    if found.evidence is not None and found.points is not None:
        _points(plan, side, found.points, found.evidence)
    plan.set_aspect("equal")
    plan.ticklabel_format(style="plain", useOffset=False)
    plan.tick_params(axis="x", labelrotation=20)
    plan.set_xlabel("East (m)")
    plan.set_ylabel("North (m)")
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

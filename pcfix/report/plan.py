"""What a planned flight will bring, as a table, advice and a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.lens.frames import footprint
from pcfix.model import Cameras
from pcfix.refract.tally import COVERAGE_95, ORDERS, largest_tvu_m
from pcfix.report.cameras import MOST_FOOTPRINTS
from pcfix.report.page import AFTER, BEFORE, REFERENCE, WATER, label_plan, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {
    "image": BEFORE, "level": WATER, "waves": "#7a5195", "index": "#8a8a8a", "poses": "#58a55c",
}  # fmt: skip
USUAL_OVERLAP, USUAL_SIDELAP = 0.75, 0.65
"""Of Mulsow's flights over lakes (2024)."""
LARGE_SHARE = 0.5


@dataclass(frozen=True)
class DepthPlan:
    """What to expect of a flat bed of one depth.

    Attributes
    ----------
    depth_m, apparent_m : float
        True, and as it looks to software that knows of no water.
    rays : float
        A point, on average.
    sigma_m : float
        Standard error of the corrected heights, rms over the bed.
    parts_m : dict
        Of image, level, waves, index and poses, whose squares add up to that of `sigma_m`.
    absorbed : float
        Share of the misfit in the images, 0 to 1, that poses and focal length of an adjustment
        without water take up.
    left_m : float
        True minus corrected height, mean, where the bed is corrected with such poses.
    """

    depth_m: float
    apparent_m: float
    rays: float
    sigma_m: float
    parts_m: dict[str, float]
    absorbed: float
    left_m: float

    @property
    def order(self) -> str:
        """The strictest order of S-44 that the uncertainty at 95 % would keep, or a dash."""
        depth = np.array([self.depth_m])
        kept = (
            one.name for one in ORDERS
            if COVERAGE_95 * self.sigma_m <= float(largest_tvu_m(one, depth)[0])
        )  # fmt: skip
        return next(kept, "-")


@dataclass(frozen=True)
class Alternative:
    """Another flight: what is different, its images, and its standard error of the deepest bed."""

    change: str
    images: int
    sigma_m: float


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned flight and what to expect of it.

    Attributes
    ----------
    cameras : Cameras
        As a drone would fly them: strips along x from the origin, the water at height 0.
    area_m : tuple of float
    height_m, gsd_m, base_m, spacing_m : float
        Above the water, at the water, between images, between strips.
    obliques_deg : float or None
    overlap, sidelap : float
    flattest_deg : float
        From straight down, of the rays in the corners of the frames.
    index : float
    gnss_sigma_m : float
    budget : dict
        The standard deviations by the names of their options.
    depths : tuple of DepthPlan
    alternatives : tuple of Alternative
    """

    cameras: Cameras
    area_m: tuple[float, float]
    height_m: float
    gsd_m: float
    base_m: float
    spacing_m: float
    obliques_deg: float | None
    overlap: float
    sidelap: float
    flattest_deg: float
    index: float
    gnss_sigma_m: float
    budget: dict[str, float | None]
    depths: tuple[DepthPlan, ...]
    alternatives: tuple[Alternative, ...]

    @property
    def deepest(self) -> DepthPlan:
        """The greatest depth."""
        return max(self.depths, key=lambda one: one.depth_m)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        plain = {name: value for name, value in vars(self).items() if name != "cameras"}
        plain["alternatives"] = [vars(one) for one in self.alternatives]
        depths = [vars(one) | {"s44": one.order} for one in self.depths]
        return {**plain, "images": len(self.cameras), "depths": depths, "advice": advice_of(self)}


def plan_text(plan: Plan) -> str:
    """Return the plan as the terminal shows it."""
    obliques = "" if plan.obliques_deg is None else f", with obliques of {plan.obliques_deg:g}°"
    head = [
        f"flight     {plan.height_m:g} m above the water over {plan.area_m[0]:g} x"
        f" {plan.area_m[1]:g} m: {len(plan.cameras):,} images{obliques}",
        f"images     every {plan.base_m:.1f} m in strips {plan.spacing_m:.1f} m apart, GSD"
        f" {100.0 * plan.gsd_m:.2f} cm at the water",
        "",
        "standard error of a corrected bed, cm, and what it comes from"
        f" (n = {plan.index:g}; every image that shows a point takes part):",
        " depth  looks   rays " + "".join(f"{part:>8}" for part in plan.deepest.parts_m)
        + "   total     95 %  TVU of S-44  absorbed  then off",
    ]  # fmt: skip
    rows = [
        f"{one.depth_m:>5.4g} m{one.apparent_m:>6.2f} m{one.rays:>6.1f} "
        + "".join(f"{100.0 * part:>8.2f}" for part in one.parts_m.values())
        + f"{100.0 * one.sigma_m:>8.2f}{100.0 * COVERAGE_95 * one.sigma_m:>9.2f}  {one.order:<13}"
        f"{one.absorbed:>6.0%}{100.0 * one.left_m:>+10.1f}"
        for one in plan.depths
    ]
    legend = [
        "TVU        the strictest order of IHO S-44 whose vertical uncertainty it would keep",
        f"poses      after 'pcfix adjust' with GNSS of {plan.gnss_sigma_m:g} m and a calibrated"
        " lens, unless --sigma-centre or --sigma-attitude say how good they are",
        "absorbed   of the misfit of straight rays, what an adjustment without water hides in poses"
        " and focal length, at worst:",
        "           no land, no control points; then off: true minus corrected height with such"
        " poses, cm",
    ]
    deepest = plan.deepest
    tried = [
        f"           {one.change:<20}{100.0 * one.sigma_m:>6.2f} cm{one.images:>8,} images"
        for one in plan.alternatives
    ]
    others = [
        f"otherwise  {deepest.depth_m:g} m deep, {100.0 * deepest.sigma_m:.2f} cm now",
        *tried,
    ]
    advice = [f"advice     {advice_of(plan)[0]}", *(f"           {a}" for a in advice_of(plan)[1:])]
    return "\n".join([*head, *rows, *legend, "", *others, "", *advice])


def advice_of(plan: Plan) -> list[str]:
    """Return what to mind, a sentence each: the flight first, then the day.

    Skarlatos & Agrafiotis 2018, section 3.3, for sun, wind, water and bed; overlaps after Mulsow.
    """
    deepest, found = plan.deepest, list[str]()
    if plan.overlap < USUAL_OVERLAP or plan.sidelap < USUAL_SIDELAP:
        found.append(
            f"Overlap: fly {USUAL_OVERLAP:.0%} along and {USUAL_SIDELAP:.0%} across or more; a bed"
            f" point is seen by {deepest.rays:.0f} images only."
        )
    most = max(deepest.parts_m, key=lambda part: deepest.parts_m[part])
    if deepest.parts_m[most] ** 2 > LARGE_SHARE * deepest.sigma_m**2:
        found.append(f"Most of the error at {deepest.depth_m:g} m is {_REMEDY[most]}.")
    found.append(
        f"Poses: without land an adjustment without water absorbs {deepest.absorbed:.0%} of the"
        f" misfit, and the bed is then {abs(deepest.left_m):.2f} m off: keep land and control"
        " points in the block, and run 'pcfix adjust'."
    )
    sun = 90.0 - plan.flattest_deg
    found.append(
        "Sun: fly under an overcast sky, or right after dawn or before dusk (60 min in summer, 90"
        " in winter)" + (f"; below {sun:.0f}° its mirror image in calm water is in no frame."
        if sun > 0.0 else "; its mirror image can be in a frame at any height.")
    )  # fmt: skip
    found.append(
        "Wind: wait for a calm day; see what --sigma-waves 1 adds"
        if not plan.budget["sigma_waves"]
        else "Wind: wait for a calmer day; 'pcfix calm' takes sequences through waves"
    )
    found[-1] += ". The water must be clear, and the bed have texture (none on plain sand)."
    return found


_REMEDY = {
    "image": "noise in the images: fly lower, or with more overlap or obliques",
    "level": "the water level: measure it better, at the time of the flight",
    "waves": "waves: wait for calmer water",
    "index": "the refractive index: measure salinity and temperature",
    "poses": "poses: use RTK or more control points",
}


def plan_figure(plan: Plan) -> Figure:
    """Draw the block in plan, and the standard errors over the depth."""
    figure, (block, errors) = new_figure(10.0, 4.6, ncols=2)
    cameras = plan.cameras
    for row in range(0, len(cameras), max(1, len(cameras) // MOST_FOOTPRINTS)):
        border = footprint(cameras, row, 0.0)
        if len(border) and np.isfinite(border).all():
            block.plot(*np.vstack([border, border[:1]]).T, color=WATER, linewidth=0.5, alpha=0.5)
    block.plot(*cameras.centres[:, :2].T, "^", color=AFTER, markersize=4, label="images")
    x, y = plan.area_m
    block.plot([0, x, x, 0, 0], [0, 0, y, y, 0], color=REFERENCE, label="area")
    block.plot([], [], color=WATER, label="footprints at the water")
    label_plan(block)
    block.legend(loc="upper right")
    block.set_title(f"{len(cameras):,} images, GSD {100.0 * plan.gsd_m:.2f} cm")
    _draw_errors(errors, plan)
    return figure


def _draw_errors(axes: Axes, plan: Plan) -> None:
    beds = sorted(plan.depths, key=lambda one: one.depth_m)
    depth = [one.depth_m for one in beds]
    for part, colour in _COLOURS.items():
        values = [100.0 * one.parts_m[part] for one in beds]
        axes.plot(depth, values, ".-", color=colour, label=part)
    total = [100.0 * one.sigma_m for one in beds]
    axes.plot(depth, total, "o-", color=REFERENCE, linewidth=2, label="total")
    axes.set(xlabel="Depth (m)", ylabel="Standard error of Z (cm)", ylim=(0.0, None))
    axes.set_title("Predicted standard error of the bed")
    axes.legend(loc="best")

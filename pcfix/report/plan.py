"""The report of ``pcfix plan`` on a planned flight: a table, advice and a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.model import Cameras
from pcfix.refract.tally import COVERAGE_95, ORDERS, largest_tvu_m
from pcfix.report.cameras import draw_footprints
from pcfix.report.page import AFTER, BEFORE, REFERENCE, WATER, Table, label_plan, new_figure
from pcfix.report.text import aligned

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = {
    "image": BEFORE, "level": WATER, "waves": "#7a5195", "index": "#8a8a8a", "poses": "#58a55c",
}  # fmt: skip
USUAL_OVERLAP, USUAL_SIDELAP = 0.75, 0.65
"""Of Mulsow's flights over lakes (2024)."""
LARGE_SHARE = 0.5


@dataclass(frozen=True)
class DepthPlan:
    """The prediction for a flat bed of one depth."""

    depth_m: float
    apparent_m: float  # depth as reconstructed with straight rays
    rays: float  # per point, on average
    sigma_m: float  # standard error of the corrected heights, rms over the bed
    parts_m: dict[str, float]  # of image, level, waves, index and poses; their squares add up
    absorbed: float  # share of the misfit that poses and focal length of an ordinary block absorb
    left_m: float  # true minus corrected height with such poses, mean

    @property
    def order(self) -> str:
        """The strictest order of S-44 that the uncertainty at 95 % would keep, or a dash."""
        depth, tvu = np.array([self.depth_m]), COVERAGE_95 * self.sigma_m
        return next((one.name for one in ORDERS if tvu <= largest_tvu_m(one, depth)[0]), "-")


@dataclass(frozen=True)
class Alternative:
    """Another flight: the changed option, its images, and its standard error of the deepest bed."""

    change: str
    images: int
    sigma_m: float


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned flight and its prediction."""

    cameras: Cameras  # as a drone would fly them: strips along x from the origin, water at 0
    area_m: tuple[float, float]
    height_m: float  # above the water
    gsd_m: float  # at the water
    base_m: float  # between images
    spacing_m: float  # between strips
    obliques_deg: float | None
    overlap: float
    sidelap: float
    flattest_deg: float  # largest incidence angle of the rays in the corners of the frames
    index: float
    gnss_sigma_m: float
    budget: dict[str, float | None]  # the standard deviations by the names of their options
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
    obliques = "" if plan.obliques_deg is None else f", with obliques of {plan.obliques_deg:g} deg"
    deepest = plan.deepest
    flight = [
        ("Images", f"{len(plan.cameras):,}, every {plan.base_m:.1f} m in strips"
         f" {plan.spacing_m:.1f} m apart{obliques}"),
        ("GSD", f"{100.0 * plan.gsd_m:.2f} cm at the water"),
    ]  # fmt: skip
    head = "Planned {:g} m above the water over {:g} x {:g} m".format(plan.height_m, *plan.area_m)
    header = ["depth", "apparent", "rays", *deepest.parts_m, "total", "95 %", "S-44 order",
              "absorbed", "bias"]  # fmt: skip
    errors = [
        [
            f"{one.depth_m:.4g} m", f"{one.apparent_m:.2f} m", f"{one.rays:.1f}",
            *(f"{100.0 * part:.2f}" for part in one.parts_m.values()),
            f"{100.0 * one.sigma_m:.2f}", f"{100.0 * COVERAGE_95 * one.sigma_m:.2f}", one.order,
            f"{one.absorbed:.0%}", f"{100.0 * one.left_m:+.1f}",
        ]
        for one in plan.depths
    ]  # fmt: skip
    title = f"Standard errors of the corrected bed in cm (refractive index {plan.index:g}):"
    table = ["", title, *Table(title, header, errors).lines()]
    rows = [
        ("poses", f"after 'pcfix adjust' with GNSS of {plan.gnss_sigma_m:g} m and a calibrated"
         " lens, unless --sigma-centre or --sigma-attitude are given"),
        ("absorbed", "the share of the refraction that an ordinary bundle adjustment absorbs, at"
         " worst: no land, no control points"),
        ("bias", "true minus corrected height with such poses"),
        ("Now", f"{100.0 * deepest.sigma_m:.2f} cm at a depth of {deepest.depth_m:g} m"),
        *((one.change, f"{100.0 * one.sigma_m:.2f} cm, {one.images:,} images")
          for one in plan.alternatives),
    ]  # fmt: skip
    notes = [f"  {label:<18} {text}" for label, text in rows]
    return "\n".join([aligned(head, flight), *table, *notes, "", *advice_of(plan)])


def advice_of(plan: Plan) -> list[str]:
    """Return advice on the flight and the day, a sentence or two each.

    Skarlatos & Agrafiotis 2018, section 3.3, for sun, wind, water and bed; overlaps after Mulsow.
    """
    deepest, found = plan.deepest, list[str]()
    if plan.overlap < USUAL_OVERLAP or plan.sidelap < USUAL_SIDELAP:
        found.append(
            f"Overlap: fly {USUAL_OVERLAP:.0%} along and {USUAL_SIDELAP:.0%} across or more. Only"
            f" {deepest.rays:.0f} images see a point of the bed."
        )
    most = max(deepest.parts_m, key=lambda part: deepest.parts_m[part])
    if deepest.parts_m[most] ** 2 > LARGE_SHARE * deepest.sigma_m**2:
        found.append(f"Most of the error at {deepest.depth_m:g} m is {_REMEDY[most]}.")
    found.append(
        "Poses: keep land and control points in the block, and run 'pcfix adjust'. Without them an"
        f" ordinary bundle adjustment absorbs {deepest.absorbed:.0%} of the refraction, and the bed"
        f" is {abs(deepest.left_m):.2f} m off."
    )
    sun = 90.0 - plan.flattest_deg
    mirror = (
        f"Below {sun:.0f} deg, no frame shows its reflection in calm water."
        if sun > 0.0
        else "Frames can show its reflection at any height of the sun."
    )
    found.append(
        "Sun: fly under an overcast sky, or within 60 minutes of dawn or dusk (90 in winter)."
        f" {mirror}"
    )
    wind = (
        "'pcfix calm' combines frames taken through waves"
        if plan.budget["sigma_waves"]
        else "see what --sigma-waves 1 adds"
    )
    found.append(f"Wind: wait for a calm day; {wind}. The water must be clear, the bed textured.")
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
    draw_footprints(block, cameras, 0.0, linewidth=0.5, alpha=0.5)
    block.plot(*cameras.centres[:, :2].T, "^", color=AFTER, markersize=4, label="images")
    x, y = plan.area_m
    block.plot([0, x, x, 0, 0], [0, 0, y, y, 0], color=REFERENCE, label="area")
    block.plot([], [], color=WATER, label="footprints at the water")
    label_plan(block)
    block.legend(loc="upper right")
    block.set_title(f"{len(cameras):,} images, GSD {100.0 * plan.gsd_m:.2f} cm")
    beds = sorted(plan.depths, key=lambda one: one.depth_m)
    depth = [one.depth_m for one in beds]
    for part, colour in _COLOURS.items():
        values = [100.0 * one.parts_m[part] for one in beds]
        errors.plot(depth, values, ".-", color=colour, label=part)
    total = [100.0 * one.sigma_m for one in beds]
    errors.plot(depth, total, "o-", color=REFERENCE, linewidth=2, label="total")
    errors.set(xlabel="Depth (m)", ylabel="Standard error of Z (cm)", ylim=(0.0, None))
    errors.set_title("Predicted standard error of the bed")
    errors.legend(loc="best")
    return figure

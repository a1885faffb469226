"""Predict the accuracy of a planned flight: ``pcfix plan``.

The block is simulated over flat beds without noise, the apparent points are intersected with
straight rays, and `pcfix.correct_points` gives the standard errors of the corrected points for each
part of the error budget. An adjustment through the water gives the errors of the poses.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from pcfix.adjust.block import Block, plain_block, restricted, well_seen
from pcfix.adjust.parameters import Unknowns
from pcfix.adjust.precision import precision_of
from pcfix.adjust.problem import prepare
from pcfix.errors import SettingError, silently
from pcfix.flow.correct import correct_points
from pcfix.flow.poses import pose_errors
from pcfix.flow.runner import check_summary, write_summary
from pcfix.flow.surfaces import Points
from pcfix.model import Correction, FloatArray, GnssPositions, TiePoints, Views, WaterPlane
from pcfix.options.correct import RefractionOptions, ScienceOptions
from pcfix.options.declare import options_of, taken
from pcfix.options.shared import BudgetOptions
from pcfix.options.steps import PlanOptions
from pcfix.refract.batch import Survey
from pcfix.refract.tally import COVERAGE_95, ORDERS, largest_tvu_m
from pcfix.report.page import Table
from pcfix.report.text import aligned
from pcfix.running import threads
from pcfix.simulate.scene import find_visible, lay_out, points_on
from pcfix.simulate.settings import SceneSettings
from pcfix.sums import Figures
from pcfix.water.index import index_of

POINTS = 400  # of each bed; they are also the tie points of the adjustments
MOST_BASES, MOST_SPACINGS = 8, 4  # limits of the simulated block: farther in, it repeats itself
FEWEST_SEEN = 50
# Parts of the error budget, and their options.
PARTS = {
    "image": ("sigma_image",), "level": ("sigma_level",), "waves": ("sigma_waves",),
    "index": ("sigma_index",), "poses": ("sigma_centre", "sigma_attitude"),
}  # fmt: skip


def plan_flight(
    *,
    options: PlanOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    **keywords: Any,
) -> Figures:
    """Predict the accuracy of a planned flight.

    Parameters
    ----------
    options, progress
        See `pcfix.correct_file`; progress is in depths.

    Examples
    --------
    >>> import pcfix
    >>> plan = pcfix.plan_flight(height=60, depth=(2.0,))
    >>> round(plan.gsd_m, 4)
    0.0164
    """
    given = taken(PlanOptions, options, keywords, "plan_flight")
    given = replace(given, index=index_of(given.index, given.index_formula)[0])
    check_summary(given)
    beds = list[Figures]()
    with threads(1):  # for so few points, threads do not pay
        for depth_m in given.depth:
            beds.append(_predicted(given, depth_m))
            if progress is not None:
                progress(len(beds), len(given.depth))
    scene = _scene(given, max(given.depth))
    base_m, spacing_m = scene.base_and_spacing_m
    plan = Figures(
        options=given.as_dict(),
        gsd_m=scene.gsd_m,  # at the water
        base_m=base_m,  # between images
        spacing_m=spacing_m,  # between strips
        depths=beds,
        images=len(lay_out(scene).true),
    )
    write_summary(given, plan)
    return plan


def _predicted(given: PlanOptions, depth_m: float) -> Figures:
    """Return the prediction for a flat bed of one depth.

    If no precision of the poses is given, they are those of an adjustment through the water.
    """
    bed, apparent = _bed(given, depth_m)
    corrected, adjusted_m = _corrected(given, bed, apparent), 0.0
    if given.sigma_centre == given.sigma_attitude == 0.0:
        # what the errors of poses add after `pcfix adjust`, with a calibrated lens
        water, wet = WaterPlane(0.0), np.ones(len(bed.xyz), np.bool_)
        block = replace(bed, water=water, refractive_index=given.refractive_index, wet=wet)
        members, found = precision_of(*prepare(block, Unknowns(lens=()))).members, None
        if members is not None:
            survey = Survey(water, bed.cameras, _refraction(given).part(ScienceOptions))
            classes, views = np.zeros(len(apparent), np.uint8), Views(bed.start, bed.camera)
            found = pose_errors(Points(apparent, None, classes, views=views), survey, members, None)
        adjusted_m = float("nan") if found is None else found.middle_m
    sigma_m = float(np.hypot(_rms(corrected.sigma_z_m), adjusted_m))
    parts_m = {part: _rms(_corrected(given, bed, apparent, part).sigma_z_m) for part in PARTS}
    parts_m["poses"] = float(np.hypot(parts_m["poses"], adjusted_m))
    depth, tvu = np.array([depth_m]), COVERAGE_95 * sigma_m
    return Figures(
        depth_m=depth_m,
        apparent_m=float(-apparent[:, 2].mean()),  # as reconstructed with straight rays
        rays=float(corrected.ray_count.mean()),  # per point
        sigma_m=sigma_m,  # standard error of the corrected heights, rms over the bed
        parts_m=parts_m,  # of it; their squares add up
        # the strictest order that the uncertainty at 95 % would keep
        s44=next((one.name for one in ORDERS if tvu <= largest_tvu_m(one, depth)[0]), "-"),
    )


def _scene(given: PlanOptions, depth_m: float) -> SceneSettings:
    """Return the scene of a flat bed under the flight."""
    focal, width, height, pixels = given.lens
    return SceneSettings(
        flying_height_m=given.height, forward_overlap=given.overlap, side_overlap=given.sidelap,
        obliques_deg=given.obliques, area_m=given.area, focal_mm=focal, sensor_mm=(width, height),
        sensor_px=(round(pixels), round(pixels * height / width)), image_noise=0.0, water=0.0,
        index=given.refractive_index, bed="flat", greatest_depth_m=depth_m,
    )  # fmt: skip


def _bed(given: PlanOptions, depth_m: float) -> tuple[Block, FloatArray]:
    """Return points of a flat bed in three or more images, and its points by straight rays.

    The block has their true places and error-free images.
    """
    scene = _scene(given, depth_m)
    most = (MOST_BASES, MOST_SPACINGS) * np.array(scene.base_and_spacing_m)
    scene = replace(scene, area_m=tuple(np.minimum(scene.area_m, most).tolist()))
    site = lay_out(scene)
    imaged = find_visible(points_on(site.terrain, POINTS, site.rng), site, site.rng)
    seen = np.flatnonzero(imaged.paired)
    if len(seen) < FEWEST_SEEN:
        share = len(seen) / POINTS
        raise SettingError(
            "plan.overlap",
            f"Overlap {given.overlap:g} and sidelap {given.sidelap:g}: only"
            f" {share:.0%} of a bed {depth_m:g} m deep are in three images. Give more overlap.",
            overlap=given.overlap, sidelap=given.sidelap, share=share,
        )  # fmt: skip
    views = Views(imaged.start, imaged.camera).take(seen)
    apparent = imaged.intersected(imaged.ideal)[seen]
    block = plain_block(site.true, TiePoints(imaged.truth[seen], views, imaged.ideal))
    block = restricted(block, well_seen(block))  # without images that hardly see the bed
    return replace(
        block,
        sigma_px=np.full(len(block.camera), max(given.sigma_image, 0.01)),
        gnss=GnssPositions(
            block.cameras.centres, np.full((len(block.cameras), 3), given.gnss_sigma), None
        ),
    ), apparent


def _corrected(given: PlanOptions, bed: Block, apparent: FloatArray, part: str = "") -> Correction:
    """Correct the bed, with standard errors of the whole budget or of one part."""
    off: dict[str, Any] = {}
    if part:
        names = {one.name for one in options_of(BudgetOptions)}
        off = dict.fromkeys(names.difference(PARTS[part]), 0.0)
    views, options = Views(bed.start, bed.camera), replace(_refraction(given), **off)
    with silently():
        return correct_points(apparent, bed.cameras, 0.0, views=views, options=options)


def _refraction(given: PlanOptions) -> RefractionOptions:
    return replace(given.part(RefractionOptions), method="consistent", occlusion="off")


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def plan_text(plan: Figures) -> str:
    """Return the plan as the terminal shows it."""
    given, deepest = plan.options, max(plan.depths, key=lambda one: float(one.depth_m))
    tilt = given["obliques"]
    flight = [
        ("Images", f"{plan.images:,}, every {plan.base_m:.1f} m in strips {plan.spacing_m:.1f} m"
         f" apart{'' if tilt is None else f', with obliques of {tilt:g} deg'}"),
        ("GSD", f"{100.0 * plan.gsd_m:.2f} cm at the water"),
    ]  # fmt: skip
    head = "Planned {:g} m above the water over {:g} x {:g} m".format(
        given["height"], *given["area"]
    )
    header = ["depth", "apparent", "rays", *deepest.parts_m, "total", "95 %", "S-44 order"]
    errors = [
        [
            f"{one.depth_m:.4g} m", f"{one.apparent_m:.2f} m", f"{one.rays:.1f}",
            *(f"{100.0 * part:.2f}" for part in one.parts_m.values()),
            f"{100.0 * one.sigma_m:.2f}", f"{100.0 * COVERAGE_95 * one.sigma_m:.2f}", one.s44,
        ]
        for one in plan.depths
    ]  # fmt: skip
    title = f"Standard errors of the corrected bed in cm (refractive index {given['index']:g}):"
    return "\n".join([
        aligned(head, flight), "", title, *Table(title, header, errors).lines(),
    ])  # fmt: skip

"""Predict the accuracy of a planned flight: ``pcfix plan``.

The block is simulated over flat beds without noise, the apparent points are intersected with
straight rays, and `pcfix.correct_points` gives the standard errors of the corrected points for each
part of the error budget. Poses are adjusted twice: through the water, whose covariance is what
adjusted poses add, and by straight rays, which shows how much of the refraction is absorbed.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from pcfix.adjust.block import Unknowns, plain_block, restricted, well_seen
from pcfix.adjust.normal import residuals
from pcfix.adjust.precision import precision_of
from pcfix.adjust.problem import prepare, solved_cameras
from pcfix.adjust.solve import solve
from pcfix.errors import PcfixWarning, SettingError
from pcfix.flow.correct import correct_points
from pcfix.flow.pose_errors import Adjustment, Sample, pose_errors
from pcfix.flow.runner import check_summary, write_summary
from pcfix.flow.surfaces import Points
from pcfix.io.files import check_output, write_bytes
from pcfix.kernels import threads
from pcfix.model import Cameras, Correction, FloatArray, TiePoints, Views, WaterPlane
from pcfix.options.correct import BudgetOptions, RefractionOptions, ScienceOptions
from pcfix.options.declare import options_of, taken
from pcfix.options.scenes import PlanOptions
from pcfix.refract.batch import Survey
from pcfix.report.page import png_of
from pcfix.report.plan import Alternative, DepthPlan, Plan, plan_figure
from pcfix.simulate.block import Block, fly_block
from pcfix.simulate.scene import Streams, lay_out, points_on
from pcfix.simulate.settings import SceneSettings
from pcfix.simulate.sight import see
from pcfix.water.index import index_of

POINTS = 400
"""Of each bed; they are also the tie points of the adjustments."""
MOST_BASES, MOST_SPACINGS = 8, 4
"""Limits of the simulated block: farther inside, the geometry repeats."""
FEWEST_SEEN, NOTHING_PX = 50, 1e-6
PARTS = {
    "image": ("sigma_image",), "level": ("sigma_level", "sigma_tilt"), "waves": ("sigma_waves",),
    "index": ("sigma_index",), "poses": ("sigma_centre", "sigma_attitude"),
}  # fmt: skip


class _Bed(NamedTuple):
    """The points of a flat bed in three or more images, and their pixels there."""

    truth: FloatArray
    apparent: FloatArray
    views: Views
    image_xy: FloatArray
    cameras: Cameras

    @property
    def ties(self) -> TiePoints:
        return TiePoints(self.apparent, self.views, self.image_xy)


def plan_flight(
    *,
    options: PlanOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    **keywords: Any,
) -> Plan:
    """Predict the accuracy of a planned flight, and what would improve it.

    Parameters
    ----------
    options : PlanOptions, optional
        Or its attributes as keywords, as for ``pcfix plan``: height, overlap, sidelap, obliques,
        lens, area, depth, gnss_sigma, index, and the standard deviations of ``pcfix correct``.
    progress : callable, optional
        Called with (steps done, steps in all).

    Returns
    -------
    Plan

    Examples
    --------
    >>> import pcfix
    >>> plan = pcfix.plan_flight(height=60, depth=(2.0,))
    >>> round(plan.gsd_m, 4)
    0.0164
    """
    given = taken(PlanOptions, options, keywords, "plan_flight")
    check_summary(given)
    if given.plot is not None:
        check_output(given.plot, overwrite=given.overwrite)
    deepest = max(given.depth)
    others = _alternatives(given)
    steps = len(given.depth) + len(others)
    beds: list[DepthPlan] = []
    tried: list[Alternative] = []

    def step() -> None:
        if progress is not None:
            progress(len(beds) + len(tried), steps)

    with threads(1):  # for so few points, threads do not pay
        for depth in given.depth:
            beds.append(_depth_plan(given, depth))
            step()
        for words, other in others:
            sigma_m = _sigma(other, _bed(other, deepest))[1]
            images = len(_flown(other).cameras)
            tried.append(Alternative(words, images, sigma_m))
            step()
    scene = _scene(given, deepest)
    off_nadir = float(np.degrees(np.arctan(scene.optics.reach))) + (given.obliques or 0.0)
    plan = Plan(
        cameras=_flown(given).cameras, area_m=given.area, height_m=given.height,
        gsd_m=scene.gsd_m, base_m=scene.base_and_spacing_m[0],
        spacing_m=scene.base_and_spacing_m[1], obliques_deg=given.obliques,
        overlap=given.overlap, sidelap=given.sidelap, flattest_deg=off_nadir,
        index=scene.refractive_index, gnss_sigma_m=given.gnss_sigma,
        budget=given.part(BudgetOptions).as_dict(), depths=tuple(beds), alternatives=tuple(tried),
    )  # fmt: skip
    if given.plot is not None:
        write_bytes(given.plot, png_of(plan_figure(plan)), overwrite=given.overwrite)
    write_summary(given, plan.as_dict())
    return plan


def _alternatives(given: PlanOptions) -> list[tuple[str, PlanOptions]]:
    """Return other flights, each with its changed option."""
    overlap, height = 0.5 + 0.5 * given.overlap, round(0.7 * given.height, 1)
    found = [(f"--height {height:g}", replace(given, height=height))]
    if overlap <= 0.95:
        found.append((f"--overlap {overlap:g}", replace(given, overlap=overlap)))
    if given.obliques is None:
        found.append(("--obliques 20", replace(given, obliques=20.0)))
    if given.sigma_level is None or given.sigma_level > 0.01:
        found.append(("--sigma-level 0.01", replace(given, sigma_level=0.01)))
    return found


def _scene(given: PlanOptions, depth_m: float) -> SceneSettings:
    """Return the scene of a flat bed under the flight."""
    focal, width, height, pixels = given.lens
    return SceneSettings(
        flying_height_m=given.height, forward_overlap=given.overlap, side_overlap=given.sidelap,
        obliques_deg=given.obliques, area_m=given.area, focal_mm=focal, sensor_mm=(width, height),
        sensor_px=(round(pixels), round(pixels * height / width)), image_noise=0.0, water=0.0,
        index=index_of(given.index, given.index_formula)[0], bed="flat", greatest_depth_m=depth_m,
    )  # fmt: skip


def _flown(given: PlanOptions) -> Block:
    """Return the whole block of the flight."""
    scene = _scene(given, max(given.depth))
    return fly_block(given.area, scene, Streams.of(scene.seed).main)


def _bed(given: PlanOptions, depth_m: float) -> _Bed:
    """Return the image points of a flat bed, and its apparent points by straight rays."""
    scene = _scene(given, depth_m)
    most = (MOST_BASES, MOST_SPACINGS) * np.array(scene.base_and_spacing_m)
    scene = replace(scene, area_m=tuple(np.minimum(scene.area_m, most).tolist()))
    site = lay_out(scene)
    rng = site.streams.main
    sight = see(points_on(site.terrain, POINTS, rng), site.rig, rng)
    seen = np.flatnonzero(sight.paired)
    if len(seen) < FEWEST_SEEN:
        raise SettingError(
            "plan.overlap",
            f"Overlap {given.overlap:g} and sidelap {given.sidelap:g}: three images see only"
            f" {100 * len(seen) / POINTS:.0f} % of a bed {depth_m:g} m deep. Give more overlap.",
            overlap=given.overlap,
            sidelap=given.sidelap,
            share=len(seen) / POINTS,
        )
    views = Views(sight.start, sight.camera).take(seen)
    apparent = sight.intersected(sight.ideal)[seen]
    block = plain_block(site.flown.cameras, TiePoints(sight.truth[seen], views, sight.ideal))
    block = restricted(block, well_seen(block))  # without images that hardly see the bed
    views = Views(block.start, block.camera)
    return _Bed(block.xyz, apparent, views, block.image_xy, block.cameras)


def _budget(given: PlanOptions, bed: _Bed, part: str = "") -> Correction:
    """Correct the bed, with standard errors of the whole budget or of one part."""
    options = _refraction(given)
    if part:
        off: dict[str, Any] = {
            one.name: 0.0 for one in options_of(BudgetOptions) if one.name not in PARTS[part]
        }
        options = replace(options, **off)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PcfixWarning)
        return correct_points(bed.apparent, bed.cameras, 0.0, views=bed.views, options=options)


def _refraction(given: PlanOptions) -> RefractionOptions:
    budget: dict[str, Any] = given.part(BudgetOptions).as_dict()
    index = index_of(given.index, given.index_formula)[0]
    return RefractionOptions(method="consistent", index=index, occlusion="off", **budget)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _depth_plan(given: PlanOptions, depth_m: float) -> DepthPlan:
    bed = _bed(given, depth_m)
    whole, sigma_m, adjusted_m = _sigma(given, bed)
    parts = {part: _rms(_budget(given, bed, part).sigma_z_m) for part in PARTS}
    parts["poses"] = float(np.hypot(parts["poses"], adjusted_m))
    absorbed, left = _absorbed(given, bed)
    return DepthPlan(
        depth_m=depth_m,
        apparent_m=float(-bed.apparent[:, 2].mean()),
        rays=float(whole.ray_count.mean()),
        sigma_m=sigma_m,
        parts_m=parts,
        absorbed=absorbed,
        left_m=left,
    )


def _sigma(given: PlanOptions, bed: _Bed) -> tuple[Correction, float, float]:
    """Return a corrected bed, its standard error, and the part from adjusted poses.

    If no precision of the poses is given, they are those of an adjustment through the water.
    """
    whole, adjusted = _budget(given, bed), 0.0
    if given.sigma_centre == given.sigma_attitude == 0.0:
        adjusted = _of_adjusted_poses(given, bed)
    return whole, float(np.hypot(_rms(whole.sigma_z_m), adjusted)), adjusted


def _of_adjusted_poses(given: PlanOptions, bed: _Bed) -> float:
    """Return what the errors of poses add after `pcfix adjust`, with a calibrated lens."""
    problem, start = _prepared(given, bed, through_water=True)
    members = precision_of(problem, start).members
    if members is None:
        return float("nan")
    survey = Survey(WaterPlane(0.0), bed.cameras, _refraction(given).part(ScienceOptions))
    classes = np.zeros(len(bed.truth), np.uint8)
    sample = Sample(Points(bed.apparent, None, classes), bed.views)
    found = pose_errors(sample, survey, Adjustment(members, np.arange(len(bed.cameras))), None)
    return float("nan") if found is None else found.middle_m


def _absorbed(given: PlanOptions, bed: _Bed) -> tuple[float, float]:
    """Return the absorbed share of the refraction, and the bias of the bed with such poses.

    The share is of the misfit of straight rays at the true poses; the bias, true minus corrected
    height, is of the bed corrected with the adjusted poses.
    """
    problem, start = _prepared(given, bed, through_water=False)
    found = solve(problem, start)
    before, after = (_rms(residuals(one.state, problem.given)) for one in (start, found))
    apparent, cameras = found.state.xyz + problem.origin, solved_cameras(problem, found)
    moved = _budget(given, bed._replace(apparent=apparent, cameras=cameras))
    known = moved.corrected
    off = bed.truth[known, 2] - moved.xyz[known, 2]
    share = 1.0 - after / before if before > NOTHING_PX else 0.0
    return share, float(off.mean())


def _prepared(given: PlanOptions, bed: _Bed, *, through_water: bool) -> Any:
    """Return the adjustment of the block, at the true poses."""
    water = WaterPlane(0.0) if through_water else None
    ties = replace(bed.ties, xyz=bed.truth if through_water else bed.apparent)
    wet = np.full(len(bed.truth), through_water)
    index = _refraction(given).refractive_index if through_water else 1.0
    block = replace(
        plain_block(bed.cameras, ties, water, index, wet),
        sigma_px=np.full(len(ties.image_xy), max(given.sigma_image, 0.01)),
        gnss_xyz=bed.cameras.centres,
        gnss_sigma_m=np.full((len(bed.cameras), 3), given.gnss_sigma),
    )
    return prepare(block, Unknowns(lens=() if through_water else ("f",)))

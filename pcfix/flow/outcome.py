"""Check the statistics of a correction, and summarize them."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import compress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.errors import GeometryError, PcfixWarning, coded
from pcfix.flow.correction import CloudTally, Plan
from pcfix.flow.plausibility import CloudSample, Plausible, plausible
from pcfix.flow.runner import Ends
from pcfix.model import Cameras, Outcome, TiePoints, WaterDimension
from pcfix.options.correct import ScienceOptions
from pcfix.refract.batch import UNLISTED
from pcfix.refract.reconstructions import CAUSES
from pcfix.refract.tally import Tally
from pcfix.report.summary import Summary
from pcfix.version import __version__
from pcfix.water.checks import check_submerged, refuse_under_water

if TYPE_CHECKING:
    from pcfix.flow.diagnosis import Poses
    from pcfix.io.views import ViewReport


class Findings(NamedTuple):
    """What the checks of a whole cloud found."""

    plausible: Plausible | None = None
    poses: Poses | None = None
    shoreline: dict[str, Any] | None = None
    water_notes: tuple[str, ...] = ()


def check(plan: Plan, tally: CloudTally) -> Findings:
    """Refuse a result in which cloud, water and cameras do not fit; warn of what is in doubt.

    Writes the shoreline too, if it is asked for.
    """
    # From the general to the particular: a view list of another cloud, or a mask elsewhere, would
    # also leave points without cameras.
    name, figures = plan.view.name, tally.figures
    report = _view_report(plan, tally)
    if report is not None:
        report.check()
        for note in report.warnings():
            warnings.warn(note, stacklevel=2)
    if plan.transfer is not None and tally.transfer is not None:
        plan.transfer.check(name, tally.transfer)
    plan.labelling.check(name, tally.labels)
    water_notes, water = list[str](), plan.found.surface
    if tally.water is not None:
        check_submerged(tally.water.submerged, name, water, tally.water.heights())
        if isinstance(water, WaterDimension):
            refuse_under_water(plan.cameras, figures.lowest_water_m, str(water))
        water_notes = tally.water.check_reach(name, water, deep=plan.options.deep)
    elif figures.submerged == 0:
        raise GeometryError(
            "cloud.none_submerged", f"{name}: no point is left to correct. Check the mask."
        )
    flat = int(figures.outcomes[Outcome.FLAT_RAYS])
    if figures.outcomes[Outcome.NO_CAMERA] + flat == figures.submerged:
        raise GeometryError(
            "cameras.max_angle" if flat else "cameras.no_overlap",
            f"{name}: {_out_of_sight(plan, figures, flat)}",
            submerged=figures.submerged,
            flat=flat,
        )
    if not figures.corrected and figures.submerged:
        reasons = {why: n for why, n in figures.uncorrected().items() if n}
        listed = "; ".join(f"{n:,}: {why}" for why, n in reasons.items())
        raise GeometryError(
            "cameras.none_corrected",
            f"{name}: none of {figures.submerged:,} submerged points can be corrected ({listed})."
            " Check that cameras and cloud belong together.",
            reasons=reasons,
        )
    if plan.inputs.port is not None:
        return Findings()
    from pcfix.flow.diagnosis import diagnose_in_passing, quick_ties

    ties = quick_ties(plan.inputs, plan.view.crs) if len(plan.cameras) else None
    tested = check_fit(plan, tally, ties)
    poses = diagnose_in_passing(plan, ties)
    shoreline, options = None, plan.options
    if tally.shore is not None and options.shoreline is not None:
        from pcfix.flow.shore import write_shoreline

        shoreline = write_shoreline(
            options.shoreline, tally.shore, plan.found, plan.view.crs,
            overwrite=options.overwrite, sigma_level_m=options.sigma_level,
        )  # fmt: skip
    return Findings(tested, poses, shoreline, tuple(water_notes))


def _view_report(plan: Plan, tally: CloudTally) -> ViewReport | None:
    """Return how the view list fitted, with the notes of reading it."""
    if tally.views is None or plan.match is None:
        return None
    return replace(tally.views, notes=plan.match.notes)


def _out_of_sight(plan: Plan, figures: Tally, flat: int) -> str:
    """Return the sentence for a cloud of which no camera sees a submerged point."""
    limit = plan.survey.limit_deg
    if flat:
        return (
            f"no submerged point has two rays within {limit or 90.0:g} deg of the surface"
            f" normal; {flat:,} points have rays at larger angles. Increase --max-angle."
        )
    from pcfix.io.cameras.mistakes import likely_mistake

    sentence = "no camera has a point in sight. Check that cameras and cloud have the same CRS."
    if plan.inputs.port is None:
        middle = (figures.low + figures.high) / 2.0
        distance = float(np.hypot(*(plan.cameras.centres - middle)[:, :2].T).min())
        away = f"{distance / 1000.0:,.1f} km" if distance >= 10_000.0 else f"{distance:,.1f} m"
        within = f" within {limit:g} degrees" if limit else ""
        sentence = (
            f"no camera has a submerged point in sight{within}; the nearest is {away} in plan from"
            f" the middle of the {figures.submerged:,} submerged points. Check that cameras and"
            " cloud have the same CRS, and that pitch 0 is straight down."
        )
    mistake = likely_mistake(plan.cameras.centres, figures.low, figures.high, plan.view.crs)
    return f"{sentence} {mistake or ''}".strip()


def check_fit(plan: Plan, tally: CloudTally, ties: TiePoints | None = None) -> Plausible:
    """Test cameras, cloud and water against each other; warn of every doubt."""
    sample, given = tally.sample or CloudSample(), plan.inputs.cameras
    sought = (plan.found.as_dict() or {}).get("model") == "auto"
    tested = plausible(
        plan.cameras, sample.xyz, ties, () if sought else sample.level_doubts(),
        file="" if isinstance(given, Cameras) else given or "", water_m=sample.water_m,
        listed=plan.views is not None, every=sample.every,
    )  # fmt: skip
    tested = tested._replace(noted=CAUSES in map(str, _detected(plan, tally)))
    for doubt in tested.doubts:
        warnings.warn(doubt, stacklevel=3)
    return tested


def _detected(plan: Plan, tally: CloudTally) -> list[PcfixWarning]:
    """Return the notes on what was detected from the cloud."""
    verdicts = {str(note): note for one in plan.verdicts for note in one.warnings()}
    beyond, line = list[str](), plan.regression
    if tally.beyond is not None and line is not None:
        from pcfix.refract.regression import LEAST_BEYOND

        least = LEAST_BEYOND if plan.inputs.regression is None else 0.0
        beyond = tally.beyond.notes(line, least)
    corrected, rays = tally.figures.corrected, list[PcfixWarning]()
    if plan.inputs.port is not None and plan.survey.settings.method == "snell" and corrected:
        mean = tally.port_miss_m / corrected
        sentence = (
            "The refracted rays of the apparent points miss each other behind the port by"
            f" {mean:.3f} m on average. --method consistent takes this into account, best with"
            " --views."
        )
        rays.append(PcfixWarning("port.ray_distance", sentence, mean_m=mean))
    unlisted = []
    if UNLISTED in plan.survey.parts:
        so = " ".join(map(str, plan.of_unlisted))
        unlisted = [f"Points in no view list are corrected as without a list. {so}"]
    return [
        *plan.notes,
        *rays,
        *coded("regression.range", beyond),
        *coded("cloud.reconstruction", verdicts.values()),
        *coded("views.unlisted", unlisted),
    ]


def summarize(plan: Plan, tally: CloudTally, findings: Findings, ends: Ends) -> Summary:
    """Return the figures of a correction, and write the line of a regression if asked."""
    path, line, options = plan.options.save_regression, plan.regression, plan.options
    if path is not None and line is not None:
        from pcfix.io.regressions import write_regression

        write_regression(path, line, overwrite=options.overwrite)
    figures, report = tally.figures, _view_report(plan, tally)
    unused = list(compress(plan.cameras.labels, np.logical_not(figures.camera_used)))
    counts = figures.as_dict()
    if options.unsure != "withhold":
        counts["unsure"] = None
    not_moved = sum(counts["uncorrected"].values()) + int(figures.outcomes[Outcome.NOT_CARRIED])
    poses, transfer, moved = findings.poses, plan.transfer, plan.survey.level_offset_m
    made, detected, water = plan.made, _detected(plan, tally), str(plan.found.surface)
    uncertainty = figures.uncertainty(made)
    by_poses = plan.survey.learned.poses
    if plan.inputs.port is not None:  # no depths, and no orders by depth
        counts["depth_m"], uncertainty = {}, None
        water = f"all around, seen through a {plan.inputs.port}"
    if uncertainty is not None and by_poses is not None:
        uncertainty["poses_m"] = round(by_poses.middle_m, 4)
    if moved is not None:
        times = f"{moved.min():+.3f} to {moved.max():+.3f} m at the times of the images"
        water = f"{water}, {times}"
    of_poses = [None if poses is None else poses.warning, plan.no_poses]
    notes = [
        *plan.cameras.notes,
        *([] if report is None else report.warnings()),
        *coded("cloud.labels", plan.labelling.notes),
        *(() if findings.plausible is None else findings.plausible.doubts),
        *detected,
        *coded("water.surface", plan.found.notes),
        *coded("water.images", plan.own_notes),
        *coded("water.extent", findings.water_notes),
        *coded("cameras.poses", filter(None, of_poses)),
    ]
    return Summary(
        input=ends.input,
        output=ends.output,
        pcfix=__version__,
        **counts,
        dropped=not_moved if options.uncorrected == "drop" else 0,
        cameras=len(plan.cameras),
        cameras_used=len(plan.cameras) - len(unused),
        cameras_unused=unused,
        seconds=round(ends.seconds, 3),
        views=None if report is None else report.as_dict(),
        warnings=[one.as_dict() for one in notes],
        labelling=plan.labelling.report(tally.labels),
        settings={**options.part(ScienceOptions).as_dict(), **plan.settings},
        part=ends.part,
        water=water,
        water_fit=plan.found.as_dict(),
        uncertainty=uncertainty,
        carried=transfer.as_dict(tally.transfer) if transfer and tally.transfer else None,
        made=made,
        told=[one for one in map(str, detected) if made is None or one not in made["because"]],
        poses=None if poses is None else poses.as_dict(),
        shoreline=findings.shoreline,
        fit=None if findings.plausible is None else findings.plausible.as_dict(),
    )

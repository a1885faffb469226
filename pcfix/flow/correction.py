"""Plan a correction for a whole cloud, and correct its chunks.

`read_inputs` reads and checks, `plan_correction` resolves every ``auto``; a `Plan` does not change.
`correct_chunk` depends on nothing else, and returns its statistics (`CloudTally`) with the points.
These are added up, and go through `pcfix.flow.outcome`. A housing port is a medium like a water
surface: all points are below it, whatever their height, and have no depth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, astuple, dataclass, field, replace
from functools import partial
from itertools import compress
from typing import Any

import numpy as np

from pcfix.adjust.transfer import CloudTransfer, TransferCounts
from pcfix.errors import PcfixWarning, SettingError, coded
from pcfix.flow.diagnosis import ties_of
from pcfix.flow.inputs import Inputs, labelling_of, paths_in
from pcfix.flow.learning import batch_of, check_regression, learn_of_cloud, regression_of
from pcfix.flow.old_cameras import old_tie_points, read_blocks
from pcfix.flow.plausibility import CloudSample
from pcfix.flow.pose_errors import (
    SAMPLE_POINTS,
    Adjustment,
    adjustment_of,
    pose_errors,
    sample_of,
    with_poses,
)
from pcfix.flow.shore import check_shoreline
from pcfix.flow.surfaces import CloudView, Points, first_points, own_water_of, parts_of
from pcfix.grid.shoreline import NearWater
from pcfix.io.views import ViewMatch, ViewReport
from pcfix.label.labelling import LabelCounts, Labelling
from pcfix.model import (
    BoolArray,
    Cameras,
    Correction,
    FloatArray,
    IntArray,
    Outcome,
    TiePoints,
    ViewKind,
    Views,
    WaterPlane,
)
from pcfix.options.correct import CorrectOptions, LabelRules, ScienceOptions
from pcfix.port.methods import correct_through_port
from pcfix.refract.batch import Batch, Intersection, Survey
from pcfix.refract.learning import as_told, check_method, for_own_water, resolved, weigh_lists
from pcfix.refract.methods import correct, shift_of_land
from pcfix.refract.reconstructions import Verdict, hint_of
from pcfix.refract.regression import BeyondRange, DepthRegression
from pcfix.refract.tally import Tally
from pcfix.sums import Sums
from pcfix.version import __version__
from pcfix.water.checks import WaterMeeting, check_above_water, check_tilt
from pcfix.water.index import with_index
from pcfix.water.surface import FoundSurface, SurfaceAbove, is_submerged

OWN_WATER = "Each image has its own water surface; only snell and consistent can use them."


@dataclass(frozen=True)
class Plan:
    """Everything that the points of a cloud have in common.

    Attributes
    ----------
    options : CorrectOptions
        With a number as refractive index.
    inputs : Inputs
    view : CloudView
    survey : Survey
        Cameras, water, and options without ``auto``.
    found : FoundSurface
        The water surface and its origin; infinitely high in front of a port.
    labelling : Labelling
        Which points may be submerged.
    views : ViewMatch, Views or None
        The view list; `Views` are those of all points, in their order.
    kind : str or None
        Its type.
    transfer : CloudTransfer or None
        From the original to the adjusted cameras.
    adjustment : Adjustment or None
        What the errors of the poses come from.
    settings : dict
        More settings for the summary.
    verdicts, of_unlisted : tuple of Verdict
        On the reconstruction type, and on that of points in no view list.
    notes, own_notes : tuple of str
        What the cloud shows, and what else the user should know.
    """

    options: CorrectOptions
    inputs: Inputs
    view: CloudView
    survey: Survey
    found: FoundSurface
    labelling: Labelling
    views: ViewMatch | Views | None = None
    kind: ViewKind | None = None
    transfer: CloudTransfer | None = None
    adjustment: Adjustment | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    verdicts: tuple[Verdict, ...] = ()
    of_unlisted: tuple[Verdict, ...] = ()
    notes: tuple[PcfixWarning, ...] = ()
    own_notes: tuple[str, ...] = ()
    no_poses: str = ""

    @property
    def cameras(self) -> Cameras:
        """The cameras to correct with."""
        return self.survey.cameras

    @property
    def regression(self) -> DepthRegression | None:
        """The line of the method regression."""
        return self.survey.learned.regression

    @property
    def made(self) -> dict[str, Any] | None:
        """The reconstruction type, and why, if the options leave it open."""
        settings, listed = self.survey.settings, self.views
        own = [] if self.survey.own_water is None else [OWN_WATER]
        if self.inputs.port is not None:
            return None
        if self.verdicts or own:
            because = " ".join([*own, *map(str, self.verdicts)])
        elif self.options.method != "auto":
            return None
        elif settings.method == "snell":
            because = "The cameras have no lenses or no angles: corrected by snell."
        elif listed is not None:
            because = f"The view list is one of {_kind_of(listed)}: corrected as such."
        else:
            because = "Too few points to detect the reconstruction type: tracks assumed."
        return {
            "method": settings.method,
            "camera_set": settings.camera_set,
            "matcher": settings.matcher,
            "views_are": self.kind,
            "because": because,
            **(self.verdicts[-1].as_dict() if self.verdicts else {}),
        }

    def provenance(self) -> dict[str, Any]:
        """Return the record of the correction for the output file."""
        water, labelling = self.found.surface, self.labelling
        mask = None if labelling.mask is None else labelling.mask.name
        rules = {"labelling": {**labelling.settings.as_dict(), "water_mask": mask}}
        plane = list(astuple(water)) if isinstance(water, WaterPlane) else None
        surface = {"water": str(water), "water_plane": plane}
        return {
            "pcfix": __version__,
            "settings": self.options.part(ScienceOptions).as_dict(),
            **(surface if self.inputs.port is None else {}),
            **self.settings,
            **({} if self.made is None else {"made": self.made}),
            **({} if self.transfer is None else self.transfer.provenance()),
            "cameras": len(self.cameras),
            "cameras_source": self.cameras.source,
            "views": _path_of(self.views),
            **({} if labelling.is_plain else rules),
        }


@dataclass(frozen=True)
class CloudTally(Sums):
    """The statistics of corrected points; see the types of its fields."""

    figures: Tally
    labels: LabelCounts
    views: ViewReport | None = None
    water: WaterMeeting | None = None
    sample: CloudSample | None = None
    beyond: BeyondRange | None = None
    shore: NearWater | None = None
    transfer: TransferCounts | None = None
    port_miss_m: float = 0.0


# Plan


def read_inputs(options: CorrectOptions, view: CloudView) -> Plan:
    """Read the inputs of a correction and check them against each other; estimate nothing."""
    options = with_index(options)
    inputs = options.part(Inputs)
    if inputs.port is not None:
        check_port_options(options)
    elif not options.cameras:
        options.check_no_cameras()
    blocks = read_blocks(inputs, view.crs)
    match = None
    if blocks.views is not None:
        match = ViewMatch(blocks.views, blocks.listed, points=view.points, step_m=view.step_m)
    if inputs.port is not None:
        survey, port = _behind_port(blocks.cameras, options), {"port": asdict(inputs.port)}
        found = FoundSurface(survey.water)
        return Plan(options, inputs, view, survey, found, labelling_of(options, view), match,
                    _kind_of(match), settings=port)  # fmt: skip
    check_shoreline(options.shoreline, overwrite=options.overwrite, inputs=paths_in(options))
    found = inputs.surface(view)
    offset = inputs.level_offset_m(blocks.cameras)
    plan = water_plan(options, inputs, view, blocks.cameras, found, match, offset)
    check_tilt(found.surface)
    settings = resolved(plan.survey.settings, blocks.cameras, plan.kind)
    check_method(settings, blocks.cameras)
    check_regression(settings.method, inputs)
    if inputs.regression is not None:
        plan = replace(plan, settings={"regression": str(inputs.regression), **plan.settings})
    adjustment, no_poses = None, ""
    if options.dimensions == "all" and settings.method != "regression" and len(blocks.cameras):
        adjustment, no_poses = adjustment_of(inputs.cameras, blocks.cameras)
    return replace(
        plan,
        labelling=labelling_of(options, view),
        transfer=None if blocks.pair is None else CloudTransfer(blocks.pair),
        adjustment=adjustment,
        no_poses=no_poses,
    )


def water_plan(
    options: CorrectOptions, inputs: Inputs, view: CloudView, cameras: Cameras,
    found: FoundSurface, views: ViewMatch | Views | None, offset: FloatArray | None,
) -> Plan:  # fmt: skip
    """Return the plan of a correction through a water surface, with nothing estimated yet.

    `offset`, shape (k,), is how much higher the water stood when each image was taken.
    """
    check_above_water(cameras, found.surface, offset)
    settings: ScienceOptions = options
    folder, kind = options.water_per_image, _kind_of(views)
    if folder is not None:
        settings = for_own_water(options, cameras, kind)
    place = (view.crs, view.low, view.high)
    own, notes = own_water_of(folder, cameras, found.surface, place, offset)
    return Plan(
        options, inputs, view,
        Survey(found.surface, cameras, settings, offset, own_water=own),
        found, Labelling(LabelRules()), views, kind,
        settings={} if folder is None else {"water_per_image": str(folder)},
        own_notes=notes,
    )  # fmt: skip


_ABOUT_WATER = (
    "tide", "water_per_image", "image_times", "check_depths", "regression", "water_crs",
    "water_model", "connected", "adjusted_from", "unsure", "shoreline",
)  # fmt: skip
_DEFAULTS = CorrectOptions()


def check_port_options(options: CorrectOptions) -> None:
    """Refuse options that need a water surface."""
    excluded = {name: getattr(options, name) != getattr(_DEFAULTS, name) for name in _ABOUT_WATER}
    excluded["camera_set"] = options.camera_set == "mvs"
    excluded["occlusion"] = options.occlusion == "on"
    excluded["method"] = options.method not in ("auto", "snell", "consistent")
    for name in compress(excluded, excluded.values()):
        raise SettingError(
            "port.excludes",
            f"{name.replace('_', '-')} {getattr(options, name)} has no effect with a port."
            " Leave it out; the methods are snell and consistent.",
            option=name,
        )


def _behind_port(cameras: Cameras, options: CorrectOptions) -> Survey:
    """Return the survey of a cloud that was taken under water."""
    if cameras.rotations is None:
        raise SettingError(
            "cameras.no_angles",
            "port: it is fixed to the camera, and these cameras have no angles. Give a camera"
            " file with angles.",
        )
    settings = options
    if settings.method == "auto":
        known = cameras.lenses is not None
        settings = replace(settings, method="consistent" if known else "snell")
    return Survey(WaterPlane(np.inf), cameras, settings)


def plan_correction(plan: Plan, line: DepthRegression | None = None) -> Plan:
    """Return the plan with everything estimated that points have in common; resolve ``auto``.

    The cloud is read a few times: for the surroundings of labels, the surface that occludes points,
    a sample that shows the reconstruction type, and the points of its view list. `line` is that of
    a regression, if it is known.
    """
    if plan.inputs.port is not None:
        return plan
    inputs, view, transfer, match = plan.inputs, plan.view, plan.transfer, plan.views
    water, first = plan.found.surface, None
    if match is not None or transfer is not None:
        first = first_points(view.chunks(water))
    if isinstance(match, ViewMatch) and first is not None:
        match = match.settled(first.xyz)
    if transfer is not None and first is not None:
        transfer.check_models(first.xyz)
    plan = replace(plan, views=match)
    chunks = partial(_transferred, plan)
    labelling = plan.labelling.scanned(lambda: parts_of(chunks(), water), view.low, view.high)
    line_notes: tuple[str, ...] = ()
    if line is None:
        line, line_notes = regression_of(inputs, view, chunks, plan.survey)
    facts = learn_of_cloud(
        plan.survey, view, chunks,
        original=None if transfer is None else transfer.pair.original,
        views=plan.kind,
        all_listed=_are_all_listed(match, view),
        ties=partial(_original_ties, plan),
        hint=hint_of((view.software, plan.cameras.source)),
        regression=line,
    )  # fmt: skip
    survey, settings = facts.survey, plan.settings
    if plan.options.depth_factor == "auto":
        settings = {**settings, "depth_factor": survey.settings.depth_factor}
    if plan.adjustment is not None:
        step = 1 + view.points // SAMPLE_POINTS
        listed = match if isinstance(match, ViewMatch) else None
        sample = sample_of(view.chunks(water), listed, step)
        pair = None if transfer is None else transfer.pair
        survey = with_poses(survey, pose_errors(sample, survey, plan.adjustment, pair))
    plan = replace(plan, survey=survey, labelling=labelling, settings=settings,
                   verdicts=facts.verdicts, of_unlisted=facts.of_unlisted,
                   notes=(*coded("regression.fit", line_notes), *facts.notes))  # fmt: skip
    return plan if first is None else _with_type_of_list(plan, first)


def _transferred(plan: Plan) -> Iterator[Points]:
    """Yield the whole cloud, transferred to the adjusted cameras if there are any."""
    row = 0
    for points in plan.view.chunks(plan.found.surface):
        yield points if plan.transfer is None else _moved(plan, points, row)[0]
        row += len(points.xyz)


def _moved(plan: Plan, points: Points, row: int) -> tuple[Points, Views | None, Any, Any]:
    """Return points after the transfer, their views, the counts of these, and the transfer."""
    views, counts, step = plan.views, None, None
    if isinstance(views, ViewMatch):
        views, counts = views.counted(points.xyz, row)
    elif views is not None and len(views.start) != len(points.xyz) + 1:
        views = views.take(np.arange(row, row + len(points.xyz)))
    if plan.transfer is not None:
        step = plan.transfer.step(points.xyz, views)
        points, views = points._replace(xyz=step.xyz, original_xyz=points.xyz), step.views
    return points, views, counts, step


def _original_ties(plan: Plan) -> TiePoints | None:
    """Return the tie points of the original model, else the adjusted ones moved back."""
    if plan.transfer is None:
        return ties_of(plan.inputs, plan.view.crs)
    ties, are_original = old_tie_points(plan.inputs, plan.transfer.pair, plan.view.crs)
    return ties if ties is None or are_original else plan.transfer.back(ties)


def _with_type_of_list(plan: Plan, first: Points) -> Plan:
    """Return the plan with the type of its view list, as the first points show it."""
    if plan.views is None:
        return plan
    points, views, *_ = _moved(plan, first, 0)
    batch = replace(batch_of(points, plan.survey, _original(plan)), views=views)
    is_open = plan.inputs.views_are == "auto" and plan.kind == "depth-maps"
    rows = np.flatnonzero(is_submerged(batch.xyz[:, 2], batch.surface))
    verdict = weigh_lists(batch.take(rows), is_open=is_open and isinstance(plan.views, ViewMatch))
    if verdict is None:
        return plan
    kind = verdict.chosen.kind or plan.kind
    return replace(plan, survey=as_told(plan.survey, verdict), kind=kind, verdicts=(verdict,))


def _original(plan: Plan) -> Cameras | None:
    return None if plan.transfer is None else plan.transfer.pair.original


def _kind_of(views: ViewMatch | Views | None) -> ViewKind | None:
    if isinstance(views, ViewMatch):
        return views.view_list.kind
    return None if views is None else views.kind


def _path_of(views: ViewMatch | Views | None) -> str | None:
    return str(views.view_list.path) if isinstance(views, ViewMatch) else None


def _are_all_listed(views: ViewMatch | Views | None, view: CloudView) -> bool:
    """Return whether every point of the cloud can have views."""
    if views is None:
        return True
    start = views.view_list.start if isinstance(views, ViewMatch) else views.start
    return len(start) > view.points and bool((np.diff(start) > 0).all())


# Correct


def correct_chunk(
    plan: Plan, points: Points, row: int, *, covariances: bool = False
) -> tuple[Correction, CloudTally]:
    """Correct the points of a chunk that begins at a row of the cloud; return their statistics.

    `covariances` are of all coordinates; files hold the standard error of Z only.
    """
    if plan.inputs.port is not None:
        return _correct_behind_port(plan, points, row)
    points, views, counts, step = _moved(plan, points, row)
    batch = batch_of(points, plan.survey, _original(plan))
    if views is not None:
        batch = replace(batch, views=replace(views, kind=plan.kind or views.kind))
    xyz, above = points.xyz, batch.surface
    submerged, labels = plan.labelling.submerged(xyz, above, points.classes)
    if step is not None:
        submerged &= step.moved
    sigma = plan.found.sigma_level_m
    found = _correct_submerged(batch, submerged, sigma, covariances=covariances)
    apparent_depth = (above.height_m - xyz[:, 2])[found.submerged]
    line = plan.regression
    beyond = None if line is None else BeyondRange.of(apparent_depth, line)
    shore = None
    if plan.options.shoreline is not None:
        higher = xyz[:, 2] + found.shift_m[:, 2] - above.height_m
        height = np.where(found.submerged, -found.depth_m, higher)
        shore = NearWater.of(xyz + found.shift_m, height, found.sigma_z_m)
    correction = found if step is None else step.whole(found)
    return correction, CloudTally(
        figures=Tally.of(correction, row, plan.view.points),
        labels=labels,
        views=counts,
        water=WaterMeeting.of(xyz, correction, plan.found.surface),
        sample=CloudSample.of(points, above.height_m, row, plan.view.points),
        beyond=beyond,
        shore=shore,
        transfer=None if step is None else TransferCounts.of(step, correction),
    )


def _correct_submerged(
    batch: Batch,
    submerged: BoolArray,
    level_sigma_m: Callable[[FloatArray], FloatArray | None],
    *,
    covariances: bool,
) -> Correction:
    """Correct the submerged points of a batch, and spread the result over all rows."""
    xyz, surface = batch.xyz, batch.surface
    rows = np.flatnonzero(submerged)
    wet = batch.take(rows)
    wet = replace(wet, level_sigma_m=level_sigma_m(wet.xyz[:, :2]))
    found = correct(wet)
    if not covariances:
        found = found._replace(covariance_m2=None)
    # depth below the water after the correction, negative above it
    slope, (shift_x, shift_y, shift_z) = wet.surface.slope, found.shift_m.T
    rise = slope[:, 0] * shift_x + slope[:, 1] * shift_y
    below = np.asarray(wet.surface.height_m + rise - (wet.xyz[:, 2] + shift_z))
    if batch.original_model is not None:
        # points whose own images place them above the water after the transfer are land
        bed = (below >= 0.0) | (found.outcome != Outcome.CORRECTED)
        submerged = submerged.copy()
        submerged[rows[~bed]] = False
        rows, found, below = rows[bed], found.take(bed), below[bed]
    depth = np.zeros(len(xyz))
    depth[rows] = below
    values = _spread(found, rows, len(xyz))
    if batch.original_model is not None:
        land = np.flatnonzero(~submerged)
        values["shift_m"] = values["shift_m"].copy()
        values["shift_m"][land] += shift_of_land(batch.take(land))
    known = np.isfinite(surface.height_m)
    return Correction(
        apparent_xyz=xyz,
        depth_m=depth,
        water_known=known,
        lowest_water_m=float(surface.height_m[known].min()) if known.any() else np.inf,
        camera_used=found.camera_used,
        **values,
    )


def _correct_behind_port(plan: Plan, points: Points, row: int) -> tuple[Correction, CloudTally]:
    """Correct the points of a cloud that was taken under water."""
    xyz, n = points.xyz, len(points.xyz)
    above = SurfaceAbove(np.full(n, np.inf), np.zeros((n, 2)))
    submerged, labels = plan.labelling.submerged(xyz, above, points.classes)
    rows = np.flatnonzero(submerged)
    _, views, counts, _ = _moved(plan, points, row)
    listed = None if views is None else views.take(rows)
    settings, port = plan.survey.settings, plan.inputs.port
    found = correct_through_port(xyz[rows], plan.cameras, port, settings, listed)
    correction = Correction(
        apparent_xyz=xyz,
        depth_m=np.zeros(n),
        water_known=np.ones(n, np.bool_),
        lowest_water_m=np.inf,
        camera_used=found.camera_used,
        **_spread(found, rows, n),
    )
    miss_m = float(found.ray_miss_m.sum())
    figures = Tally.of(correction, row, plan.view.points)
    return correction, CloudTally(figures, labels, counts, port_miss_m=miss_m)


_PER_POINT = (
    "shift_m", "outcome", "ray_count", "ray_miss_m", "incidence_deg", "sigma_z_m", "covariance_m2",
    "unsure",
)  # fmt: skip


def _spread(found: Intersection, rows: IntArray, n: int) -> dict[str, Any]:
    """Return the values of some rows as those of n points, zero elsewhere."""
    values: dict[str, Any] = {name: getattr(found, name) for name in _PER_POINT}
    if len(rows) == n:
        return values
    for name, some in values.items():
        if some is not None:
            values[name] = np.zeros((n, *some.shape[1:]), some.dtype)
            values[name][rows] = some
    return values

"""The plan of a correction, and the correction of a chunk.

A `Plan` holds what all points of a cloud have in common; `pcfix.flow.planning` makes it.
`correct_chunk` depends on nothing else, and returns statistics (`CloudTally`) with the points.
These are added up, and `pcfix.flow.correct.finish` summarizes them. A housing port is a medium like
a water surface: all points are below it, whatever their height, and have no depth.
"""

from dataclasses import asdict, astuple, dataclass, fields, replace
from typing import Any

import numpy as np

from pcfix.adjust.transfer import CloudTransfer, TransferCounts, Transferred
from pcfix.errors import PcfixWarning
from pcfix.flow.inputs import Inputs
from pcfix.flow.plausibility import CloudSample
from pcfix.flow.surfaces import CloudView, Points
from pcfix.io.views import ViewMatch, ViewReport
from pcfix.model import (
    BoolArray,
    Cameras,
    Correction,
    FloatArray,
    IntArray,
    Outcome,
    ViewKind,
    WaterPlane,
)
from pcfix.options.correct import CorrectOptions, ScienceOptions
from pcfix.points.labelling import LabelCounts, Labelling
from pcfix.port.methods import correct_through_port
from pcfix.refract.batch import Batch, Intersection, OriginalModel, Survey
from pcfix.refract.methods import correct, shift_of_land
from pcfix.refract.reconstructions import Verdict
from pcfix.refract.tally import Tally
from pcfix.sums import Sums
from pcfix.version import __version__
from pcfix.water.checks import WaterMeeting
from pcfix.water.surface import FoundSurface, surface_above

OWN_WATER = "Each image has its own water surface; only snell and consistent can use them."


@dataclass(frozen=True)
class Plan:
    """Everything that the points of a cloud have in common."""

    options: CorrectOptions  # with a number as refractive index
    inputs: Inputs
    view: CloudView
    survey: Survey  # cameras, water, and options; once planned without ``auto``
    found: FoundSurface  # the water and its origin; infinitely high in front of a port
    labelling: Labelling  # which points may be submerged
    match: ViewMatch | None = None  # the view list of a file
    kind: ViewKind | None = None  # the type of the view list, which the points may have themselves
    some_unlisted: bool = False  # whether points have no images in it
    transfer: CloudTransfer | None = None  # from the original to the adjusted cameras
    verdicts: tuple[Verdict, ...] = ()  # on the reconstruction type
    input_notes: tuple[PcfixWarning, ...] = ()  # what was noted on reading the inputs
    notes: tuple[PcfixWarning, ...] = ()  # what the cloud shows

    @property
    def cameras(self) -> Cameras:
        """The cameras to correct with."""
        return self.survey.cameras

    @property
    def original(self) -> Cameras | None:
        """The cameras that made the cloud, if they were adjusted since."""
        return None if self.transfer is None else self.transfer.original

    @property
    def settings(self) -> dict[str, Any]:
        """What the summary and the output file say of the settings besides the options."""
        options, port = self.options, self.inputs.port
        more: dict[str, Any] = {}
        if options.water_per_image is not None:
            more["water_per_image"] = str(options.water_per_image)
        if port is not None:
            return {"port": asdict(port)}
        if options.depth_factor == "auto":
            more["depth_factor"] = self.survey.settings.depth_factor
        if options.max_angle == "auto":
            more["max_angle"] = self.survey.limit_deg
        return more

    @property
    def reconstruction(self) -> dict[str, Any] | None:
        """The reconstruction type, and why, if the options leave it open."""
        settings = self.survey.settings
        own = [] if self.survey.own_water is None else [OWN_WATER]
        if self.inputs.port is not None:
            return None
        if self.verdicts or own:
            because = " ".join([*own, *map(str, self.verdicts)])
        elif self.options.method != "auto":
            return None
        elif settings.method == "snell":
            because = "Method snell was used, because the cameras have no lenses or no angles."
        elif self.kind is not None:
            because = f"The view list contains the images of {self.kind}."
        else:
            because = "Tracks are assumed; the points are too few to detect the type."
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
        water, labelling, match = self.found.surface, self.labelling, self.match
        mask = None if labelling.mask is None else labelling.mask.name
        rules = {"labelling": {**labelling.settings.as_dict(), "water_mask": mask}}
        plane = list(astuple(water)) if isinstance(water, WaterPlane) else None
        surface = {"water": str(water), "water_plane": plane}
        return {
            "pcfix": __version__,
            "settings": self.options.part(ScienceOptions).as_dict(),
            **(surface if self.inputs.port is None else {}),
            **self.settings,
            **({} if self.reconstruction is None else {"reconstruction": self.reconstruction}),
            **({} if self.transfer is None else self.transfer.provenance()),
            "cameras": len(self.cameras),
            "cameras_source": self.cameras.source,
            "views": None if match is None else str(match.view_list.path),
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
    transfer: TransferCounts | None = None


def transferred(
    plan: Plan, points: Points, row: int
) -> tuple[Points, ViewReport | None, Transferred | None]:
    """Return points that begin at a row of the cloud, with their views, at the adjusted cameras.

    Then the counts of the views of a file, and the transfer; None where there is none.
    """
    counts, step = None, None
    if plan.match is not None:
        views, counts = plan.match.views_of(points.xyz, row)
        points = points._replace(views=views)
    if plan.transfer is not None:
        step = plan.transfer.step(points.xyz, points.views)
        points = points._replace(xyz=step.xyz, original_xyz=points.xyz, views=step.views)
    return points, counts, step


def batch_of(points: Points, survey: Survey, original: Cameras | None) -> Batch:
    """Return points of a cloud, without views, as the methods of correction take them."""
    model = None
    if original is not None and points.original_xyz is not None:
        model = OriginalModel(points.original_xyz, original)
    above = surface_above(survey.water, points.xyz, points.heights)
    return Batch(points.xyz, above, survey, original_model=model)


def correct_chunk(
    plan: Plan, points: Points, row: int, *, covariances: bool = False
) -> tuple[Correction, CloudTally]:
    """Correct the points of a chunk that begins at a row of the cloud; return their statistics.

    `covariances` are of all coordinates; files hold the standard error of Z only.
    """
    points, counts, step = transferred(plan, points, row)
    batch = batch_of(points, plan.survey, plan.original)
    if points.views is not None and plan.kind is not None:
        batch = replace(batch, views=replace(points.views, kind=plan.kind))
    xyz, above = points.xyz, batch.surface
    submerged, labels = plan.labelling.submerged(xyz, above, points.classes)
    if plan.inputs.port is not None:
        rows, settings = np.flatnonzero(submerged), plan.survey.settings
        wet, n = batch.take(rows), len(batch)
        found = correct_through_port(wet.xyz, plan.cameras, plan.inputs.port, settings, wet.views)
        correction = _spread(batch, rows, found, np.zeros(n), np.ones(n, np.bool_))
        return correction, CloudTally(Tally.of(correction), labels, counts)
    if step is not None:
        submerged &= step.moved  # a point without a place in the adjusted block is left where it is
    correction = _through_water(plan, batch, np.flatnonzero(submerged), covariances=covariances)
    moved = None
    if step is not None:
        correction = step.as_original(correction)
        moved = TransferCounts.of(step, correction)
    return correction, CloudTally(
        figures=Tally.of(correction),
        labels=labels,
        views=counts,
        water=WaterMeeting.of(xyz, correction, plan.found.surface),
        sample=CloudSample.of(points, above.height_m, row, plan.view.points),
        transfer=moved,
    )


def _through_water(plan: Plan, batch: Batch, rows: IntArray, *, covariances: bool) -> Correction:
    """Correct the submerged points of a batch; return the result for all of its points."""
    wet = batch.take(rows)
    wet = replace(wet, level_sigma_m=plan.found.sigma_at(wet.xyz[:, :2]))
    found = correct(wet)
    if not covariances:
        found = found._replace(covariance_m2=None)
    # Depth below the water after the correction, negative above it: the corrected point is in
    # another place in plan, where a sloping surface has another height.
    slope, (shift_x, shift_y, shift_z) = wet.surface.slope, found.shift_m.T
    rise = slope[:, 0] * shift_x + slope[:, 1] * shift_y
    below = np.asarray(wet.surface.height_m + rise - (wet.xyz[:, 2] + shift_z))
    if batch.original_model is not None:
        # points whose own images place them above the water after the transfer are land
        bed = (below >= 0.0) | (found.outcome != Outcome.CORRECTED)
        rows, found, below = rows[bed], found.take(bed), below[bed]
    depth = np.zeros(len(batch))
    depth[rows] = below
    correction = _spread(batch, rows, found, depth, np.isfinite(batch.surface.height_m))
    if batch.original_model is None:
        return correction
    is_land, shift = np.ones(len(batch), np.bool_), correction.shift_m.copy()
    is_land[rows] = False
    land = np.flatnonzero(is_land)
    shift[land] += shift_of_land(batch.take(land))
    return replace(correction, shift_m=shift)


# Results for each point, which methods return for the submerged ones.
_PER_POINT = {one.name for one in fields(Correction)} & {*Intersection._fields} - {"camera_used"}


def _spread(
    batch: Batch, rows: IntArray, found: Intersection, depth_m: FloatArray, water_known: BoolArray
) -> Correction:
    """Return the results of some rows for all points of a batch, zero elsewhere."""
    n, height = len(batch), batch.surface.height_m
    values: dict[str, Any] = {name: getattr(found, name) for name in _PER_POINT}
    for name, some in values.items():
        if some is not None and len(rows) < n:
            values[name] = np.zeros((n, *some.shape[1:]), some.dtype)
            values[name][rows] = some
    return Correction(
        apparent_xyz=batch.xyz,
        depth_m=depth_m,
        water_known=water_known,
        lowest_water_m=float(height[water_known].min()) if water_known.any() else np.inf,
        camera_used=found.camera_used,
        **values,
    )

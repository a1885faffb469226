"""A correction through a water surface: the estimates before, the correction, the checks after."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import astuple, replace
from functools import partial
from itertools import compress
from typing import Any, TypeAlias

import numpy as np

from pcfix.adjust.diagnosis import Evidence
from pcfix.adjust.transfer import CloudTransfer
from pcfix.flow.diagnosis import Poses, diagnose_in_passing, quick_ties
from pcfix.flow.inputs import Inputs, paths_in
from pcfix.flow.learning import Learning
from pcfix.flow.old_cameras import Blocks, ListedViews, old_tie_points
from pcfix.flow.plausibility import CloudSample, Flight, Plausible, plausible
from pcfix.flow.pose_errors import SAMPLE_POINTS, adjustment_of, pose_errors, sample_of, with_poses
from pcfix.flow.shore import check_shoreline, write_shoreline
from pcfix.flow.surfaces import CloudView, Points, own_water_of, parts_of
from pcfix.grid.shoreline import NearWater
from pcfix.label.labelling import Labelling
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
    WaterDimension,
    WaterPlane,
)
from pcfix.options.correct import CorrectOptions, ScienceOptions
from pcfix.refract.batch import Batch, Intersection, OriginalModel, Survey
from pcfix.refract.choice import views_in_frame
from pcfix.refract.learning import as_told, for_own_water, weigh_lists
from pcfix.refract.methods import correct, shift_of_land
from pcfix.refract.reconstructions import CAUSES, Verdict
from pcfix.refract.regression import LEAST_BEYOND, BeyondRange, DepthRegression
from pcfix.refract.tally import Tally
from pcfix.sums import Sums
from pcfix.water.checks import WaterMeeting, check_above_water, check_tilt, refuse_under_water
from pcfix.water.surface import SurfaceAbove, is_submerged, surface_above

OWN_WATER = "Each image has its own water surface; only snell and consistent can use them."
Label: TypeAlias = Callable[[FloatArray, SurfaceAbove], BoolArray]


class ThroughWater(Sums):
    """The light is refracted at a water surface; the cloud may come from other camera poses.

    Raises
    ------
    PcfixError
        If the water cannot be read or found, a camera stands under it, or the method lacks
        something that it cannot do without.
    """

    added = ("_meeting", "_sample", "_beyond", "_shore", "carrying")

    def __init__(
        self, options: CorrectOptions, inputs: Inputs, blocks: Blocks, view: CloudView
    ) -> None:
        check_shoreline(options.shoreline, overwrite=options.overwrite, inputs=paths_in(options))
        self._options, self._inputs, self._view = options, inputs, view
        self._cameras = blocks.cameras
        self.carrying = None if blocks.pair is None else CloudTransfer(blocks.pair)
        self.found = inputs.surface(view)
        self.water = self.found.surface
        self.level_offset_m = inputs.level_offset_m(self._cameras)
        check_above_water(self._cameras, self.water, self.level_offset_m)
        check_tilt(self.water)
        self.settings: dict[str, Any] = {}
        if inputs.regression is not None:
            self.settings["regression"] = str(inputs.regression)
        self._listed = None if blocks.views is None else blocks.views.kind
        settings: ScienceOptions = options
        folder, place = options.water_per_image, (view.crs, view.low, view.high)
        if folder is not None:
            settings = for_own_water(options, self._cameras, self._listed)
            self.settings["water_per_image"] = str(folder)
        own, self._own_notes = own_water_of(
            folder, self._cameras, self.water, place, self.level_offset_m
        )
        self._learning = Learning(
            Survey(self.water, self._cameras, settings, self.level_offset_m, own_water=own),
            inputs, view, self._listed,
            None if blocks.pair is None else self._original_ties,
        )  # fmt: skip
        self.survey = self._learning.survey
        self._kind: ViewKind | None = None
        self.verdicts: tuple[Verdict, ...] = ()
        self._poses: Poses | None = None
        self._shoreline: dict[str, Any] | None = None
        self._adjustment, self._no_poses = None, ""
        wanted = options.dimensions == "all" and self.survey.settings.method != "regression"
        if wanted and len(self._cameras):
            self._adjustment, self._no_poses = adjustment_of(inputs.cameras, self._cameras)
        self.restart()

    def restart(self, first_row: int = 0) -> None:
        """Forget the chunks so far."""
        self._meeting = WaterMeeting(self.water, deep=self._options.deep)
        self._sample, self._plausible = CloudSample(self._view.points, first_row), Plausible()
        self._beyond: BeyondRange | None = None
        if self.regression is not None:
            least = LEAST_BEYOND if self._inputs.regression is None else 0.0
            self._beyond = BeyondRange(self.regression, least)
        self._shore = None if self._options.shoreline is None else NearWater()
        if self.carrying is not None:
            self.carrying.restart()

    def look_around(
        self, chunks: Callable[[], Iterable[Points]], labelling: Labelling, views: ListedViews
    ) -> None:
        """Estimate everything that a correction must know about the whole cloud."""
        around, makers, carrying = chunks, None, self.carrying
        if carrying is not None:
            around = partial(_transferred, chunks, carrying, views)

            def makers() -> Iterator[OriginalModel]:
                return (OriginalModel(points.xyz, carrying.pair.original) for points in chunks())

        if labelling.looks_around:
            labelling.look_around(
                lambda: parts_of(around(), self.water), self._view.low, self._view.high
            )
        self.survey = self._learning.of_cloud(around, makers, all_listed=views.are_all)
        if self._options.depth_factor == "auto":
            self.settings["depth_factor"] = self.survey.settings.depth_factor
        self.verdicts = self._learning.verdicts
        if self._adjustment is not None:
            sample = sample_of(chunks(), views, 1 + self._view.points // SAMPLE_POINTS)
            pair = None if carrying is None else carrying.pair
            poses = pose_errors(sample, self.survey, self._adjustment, pair)
            self.survey = with_poses(self.survey, poses)
        self.restart()

    def _original_ties(self) -> TiePoints | None:
        """Return the tie points of the original model, else the adjusted ones moved back."""
        if self.carrying is None:
            return None
        ties, are_original = old_tie_points(self._inputs, self.carrying.pair, self._view.crs)
        return ties if ties is None or are_original else self.carrying.back(ties)

    def correct(self, points: Points, views: Views | None, labelling: Labelling) -> Correction:
        """Correct one chunk; see `pcfix.flow.job.Job.correct`."""
        xyz, classes = points.xyz, points.classes
        label: Label = partial(labelling.submerged, classes=classes)
        step, original_model = None, None
        if self.carrying is not None:
            step, original_model = (
                self.carrying.step(xyz, views),
                OriginalModel(xyz, self.carrying.pair.original),
            )
            xyz, views, label = step.xyz, step.views, step.rule(label)
        above = surface_above(self.water, xyz, points.heights)
        batch = Batch(xyz, above, self.survey, views, original_model, source=points.sources)
        batch = self._of_kind(batch)
        correction = correct_checked(batch, label, self.found.sigma_level_m, heights_only=True)
        if self._beyond is not None:
            self._beyond.add((above.height_m - xyz[:, 2])[correction.submerged])
        if self._shore is not None:
            higher = xyz[:, 2] + correction.shift_m[:, 2] - above.height_m
            height = np.where(correction.submerged, -correction.depth_m, higher)
            self._shore.add(xyz + correction.shift_m, height, correction.sigma_z_m)
        if self.carrying is not None and step is not None:
            correction = step.whole(correction)
            self.carrying.add(step, correction)
        self._meeting.add(xyz, correction)
        self._sample.add(points._replace(xyz=xyz), above.height_m)
        return correction

    @property
    def regression(self) -> DepthRegression | None:
        """The line of the method regression."""
        return self.survey.learned.regression

    def _of_kind(self, batch: Batch) -> Batch:
        """Return a chunk with the type of its view list, which is detected from the first one."""
        if batch.views is None:
            return batch
        if self._kind is None:
            self._kind = batch.views.kind
            is_open = self._inputs.views_are == "auto" and self._kind == "depth-maps"
            rows = np.flatnonzero(is_submerged(batch.xyz[:, 2], batch.surface))
            verdict = weigh_lists(batch.take(rows), is_open=is_open)
            if verdict is not None:
                self.verdicts = (verdict,)
                self._kind = verdict.chosen.kind or self._kind
                self.survey = as_told(self.survey, verdict)
        return replace(batch, survey=self.survey, views=replace(batch.views, kind=self._kind))

    @property
    def made(self) -> dict[str, Any] | None:
        """The reconstruction type, and why, if the options leave it open."""
        settings, views = self.survey.settings, self._listed
        own = [] if self.survey.own_water is None else [OWN_WATER]
        if self.verdicts or own:
            because = " ".join([*own, *map(str, self.verdicts)])
        elif self._options.method != "auto":
            return None
        elif settings.method == "snell":
            because = "The cameras have no lenses or no angles: corrected by snell."
        elif views is not None:
            because = f"The view list is one of {views}: corrected as such."
        else:
            because = "Too few points to detect the reconstruction type: tracks assumed."
        return {
            "method": settings.method,
            "camera_set": settings.camera_set,
            "matcher": settings.matcher,
            "views_are": self._kind or views,
            "because": because,
            **(self.verdicts[-1].as_dict() if self.verdicts else {}),
        }

    def provenance(self) -> dict[str, Any]:
        """Return the record of the water for the output file."""
        plane = list(astuple(self.water)) if isinstance(self.water, WaterPlane) else None
        return {
            "water": str(self.water),
            "water_plane": plane,
            **self.settings,
            **({} if self.made is None else {"made": self.made}),
            **({} if self.carrying is None else self.carrying.provenance()),
        }

    def check(self, name: str, tally: Tally, labelling: Labelling) -> None:
        """Refuse a cloud that could not be transferred, and water apart from the cloud."""
        if self.carrying is not None:
            self.carrying.check(name)
        labelling.check(name)
        self._meeting.check_submerged(name)
        if isinstance(self.water, WaterDimension):
            refuse_under_water(self._cameras, tally.lowest_water_m, str(self.water))
        self._meeting.check_reach(name)

    def out_of_sight(self, tally: Tally) -> str:
        """Return the sentence for a cloud of which no camera sees a submerged point."""
        limit, flat = self.survey.settings.limit_deg, tally.outcomes[Outcome.FLAT_RAYS]
        if flat:
            return (
                f"no submerged point has two rays within {limit or 90.0:g} deg of the surface"
                f" normal; {flat:,} points have rays at larger angles. Increase --max-angle."
            )
        middle = (tally.low + tally.high) / 2.0
        distance = float(np.hypot(*(self._cameras.centres - middle)[:, :2].T).min())
        away = f"{distance / 1000.0:,.1f} km" if distance >= 10_000.0 else f"{distance:,.1f} m"
        within = f" within {limit:g} degrees" if limit else ""
        return (
            f"no camera has a submerged point in sight{within}; the nearest is {away} in plan from"
            f" the middle of the {tally.submerged:,} submerged points. Check that cameras and cloud"
            " have the same CRS, and that pitch 0 is straight down."
        )

    def finish(self) -> None:
        """Check cameras, cloud and water against each other; write the shoreline."""
        given = self._inputs.cameras
        ties = quick_ties(self._inputs, self._view.crs) if len(self._cameras) else None
        sought = (self.found.as_dict() or {}).get("model") == "auto"
        doubts = () if sought else self._sample.level_doubts()
        flight = Flight(
            "" if isinstance(given, Cameras) else given or "", self._sample.water_m,
            self._listed is not None, self._sample.every,
        )  # fmt: skip
        tested = plausible(self._cameras, self._sample.xyz, ties, doubts, flight)
        self._plausible = tested._replace(noted=CAUSES in map(str, self._detected()))
        self._plausible.warn()
        if not len(self._cameras):
            self._poses = Poses(None, "not applicable: no cameras were given")
            return
        name = "cameras" if isinstance(given, Cameras) else str(given)
        n = self._options.refractive_index
        evidence = Evidence(self._cameras, name, self.water, n, ties=ties)
        self._poses = diagnose_in_passing(self._inputs, evidence, self._view, self.verdicts)
        if self._shore is not None:
            self._shoreline = self._written_shoreline(self._shore)

    def _written_shoreline(self, near: NearWater) -> dict[str, Any] | None:
        """Write where the water meets the corrected cloud."""
        path, stated = self._options.shoreline or "", self._options.sigma_level

        def sigma(xy: FloatArray) -> FloatArray | None:
            return self.found.sigma_level_m(xy) if stated is None else np.full(len(xy), stated)

        return write_shoreline(path, near, sigma, self._view.crs, overwrite=self._options.overwrite)

    def _detected(self) -> list[Any]:
        """Return the notes on what was detected from the cloud."""
        verdicts = {str(note): note for one in self.verdicts for note in one.warnings()}
        beyond = [] if self._beyond is None else self._beyond.notes()
        unlisted = self._learning.of_unlisted_notes()
        return [*self._learning.notes, *beyond, *verdicts.values(), *unlisted]

    def notes(self, tally: Tally) -> list[Any]:
        """Return what the user should know of the result."""
        of_poses = [self._poses.warning if self._poses else "", self._no_poses]
        notes = [*self._plausible.doubts, *self._detected(), *self.found.notes, *self._own_notes]
        return [*notes, *self._meeting.notes, *(one for one in of_poses if one)]

    def figures(self, tally: Tally) -> dict[str, Any]:
        """Return the part of the summary about depths, water and cameras."""
        moved, water, made = self.level_offset_m, str(self.water), self.made
        uncertainty, poses = tally.uncertainty(made), self.survey.learned.poses
        if uncertainty is not None and poses is not None:
            uncertainty["poses_m"] = round(poses.middle_m, 4)
        detected = map(str, self._detected())
        if moved is not None:
            times = f"{moved.min():+.3f} to {moved.max():+.3f} m at the times of the images"
            water = f"{water}, {times}"
        return {
            "depth_m": tally.depth_m(),
            "water": water,
            "water_fit": self.found.as_dict(),
            "uncertainty": uncertainty,
            "carried": None if self.carrying is None else self.carrying.as_dict(),
            "made": made,
            "told": [one for one in detected if made is None or one not in made["because"]],
            "poses": None if self._poses is None else self._poses.as_dict(),
            "shoreline": self._shoreline,
            "fit": self._plausible.as_dict(),
            "cameras_left_out": self._left_out(tally),
        }

    def _left_out(self, tally: Tally) -> dict[str, list[str]]:
        """Return the unused cameras whose frames hold corrected points, by the reason."""
        unused = ~tally.camera_used
        if not tally.moved or not unused.any():
            return {}
        xyz, limit = np.vstack(tally.moved), self.survey.settings.limit_deg or 90.0
        seen = views_in_frame(xyz, self._cameras)
        points = np.repeat(np.arange(len(xyz)), np.diff(seen.start))
        across, along, up = (self._cameras.centres[seen.camera] - xyz[points]).T
        steepest = np.full(len(unused), np.inf)
        np.minimum.at(steepest, seen.camera, np.degrees(np.arctan2(np.hypot(across, along), up)))
        beyond, within = unused & np.isfinite(steepest) & (steepest > limit), steepest <= limit
        reasons = {f"beyond {limit:g} degrees alone": beyond, "but are not chosen": unused & within}
        return {
            why: list(compress(self._cameras.labels, rows))
            for why, rows in reasons.items()
            if rows.any()
        }


def _transferred(
    chunks: Callable[[], Iterable[Points]], carrying: CloudTransfer, views: ListedViews
) -> Iterator[Points]:
    """Yield the whole cloud, transferred to the adjusted poses."""
    listed, row = views.all_anew(), 0
    for points in chunks():
        xyz = points.xyz
        yield points._replace(xyz=carrying.step(xyz, listed(xyz, row)).xyz)
        row += len(xyz)


def correct_checked(
    batch: Batch,
    label: Label | None = None,
    level_sigma_m: Callable[[FloatArray], FloatArray | None] | None = None,
    *,
    heights_only: bool = False,
) -> Correction:
    """Label and correct points, and spread the result over all rows: what every door runs.

    Parameters
    ----------
    batch : Batch
        Of n points, land too.
    label : callable, optional
        Says which are submerged. Default: those below the surface.
    level_sigma_m : callable, optional
        Returns the standard deviation of the water's height at places, shape (m, 2).
    heights_only : bool
        Leave the covariances out; files have only the standard error of Z.
    """
    xyz, surface = batch.xyz, batch.surface
    submerged = is_submerged(xyz[:, 2], surface) if label is None else label(xyz, surface)
    rows = np.flatnonzero(submerged)
    wet = batch.take(rows)
    if level_sigma_m is not None:
        wet = replace(wet, level_sigma_m=level_sigma_m(wet.xyz[:, :2]))
    found = correct(wet)
    if heights_only:
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
    values = spread_over(found, rows, len(xyz))
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


_PER_POINT = (
    "shift_m", "outcome", "ray_count", "ray_miss_m", "incidence_deg", "sigma_z_m", "covariance_m2",
    "unsure",
)  # fmt: skip


def spread_over(found: Intersection, rows: IntArray, n: int) -> dict[str, Any]:
    """Return the values of some rows as those of n points, zero elsewhere."""
    full: dict[str, Any] = dict.fromkeys(_PER_POINT)
    if len(rows) == n:
        return {name: getattr(found, name) for name in _PER_POINT}
    for name in _PER_POINT:
        values = getattr(found, name)
        if values is not None:
            full[name] = np.zeros((n, *values.shape[1:]), values.dtype)
            full[name][rows] = values
    return full

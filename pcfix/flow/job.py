"""One correction, whichever door it came through: what was asked for, and what was done so far."""

from __future__ import annotations

import warnings
from dataclasses import asdict, astuple, replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from pcfix.adjust.carry import Carrying
from pcfix.errors import GeometryError, PcfixWarning
from pcfix.flow.diagnosis import diagnose_in_passing
from pcfix.flow.inputs import mask_of
from pcfix.flow.learning import Learning
from pcfix.flow.old_cameras import old_tie_points, read_blocks
from pcfix.flow.points import correct_checked
from pcfix.io.cameras.mistakes import likely_mistake
from pcfix.label.labelling import Labelling, Part
from pcfix.model import Correction, Outcome, Summary, WaterDimension, WaterPlane
from pcfix.options import LabelSettings, Settings
from pcfix.refract.batch import Batch, Survey
from pcfix.refract.learning import kind_of_views
from pcfix.refract.tally import Tally
from pcfix.version import __version__
from pcfix.water.checks import WaterMeeting, check_above_water, check_tilt, refuse_under_water
from pcfix.water.surface import is_submerged, surface_above

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    import numpy.typing as npt

    from pcfix.flow.inputs import Inputs
    from pcfix.flow.points import Label
    from pcfix.flow.surfaces import CloudView
    from pcfix.io.views import ViewMatch
    from pcfix.model import FloatArray, TiePoints, ViewKind, WaterSurface
    from pcfix.refract.batch import MadeWith

    Points: TypeAlias = tuple[FloatArray, FloatArray | None, npt.NDArray[np.uint8]]
    """Some points: coordinates (n, 3), water heights where those are a dimension, classes."""


PLAIN = LabelSettings()


class Job:
    """The settings, cameras and water of a correction, and the tally of its chunks.

    Parameters
    ----------
    name : str
        What is being corrected, for messages.
    settings : Settings
    inputs : Inputs
    view : CloudView
        Of the whole cloud.
    step_m : float
        To which its coordinates are rounded.
    label : LabelSettings
        Without a band or a dead band: a point that is moved lies below the surface.

    Raises
    ------
    PcfixError
        If an input cannot be read or they do not fit, or a camera stands under the water.
    """

    def __init__(
        self,
        name: str,
        settings: Settings,
        inputs: Inputs,
        *,
        view: CloudView,
        step_m: float = 0.0,
        label: LabelSettings = PLAIN,
    ) -> None:
        self.name, self.settings = name, settings
        self.cameras, self._list, self._listed, pair = read_blocks(inputs, view.crs)
        self.carrying = None if pair is None else Carrying(pair)
        self.found = inputs.surface(view)
        self.water = self.found.surface
        self.level_offset_m = inputs.level_offset_m(self.cameras)
        self._points, self._step_m, self._crs = view.points, step_m, view.crs
        self._view, self._bent = view, [""]
        check_above_water(self.cameras, self.water, self.level_offset_m)
        check_tilt(self.water)
        self._low, self._high = view.low, view.high
        mask = mask_of(inputs.water_mask, view.crs, view.low, view.high)
        self.labelling = Labelling(label, mask)
        kind = None if self._list is None else self._list.kind
        self._learning = Learning(
            Survey(self.water, self.cameras, settings, self.level_offset_m),
            inputs,
            view,
            kind,
            None if pair is None else self._old_ties,
        )
        self.survey = self._learning.survey
        self._inputs = inputs
        self._kind: ViewKind | None = None
        self._kind_notes: list[str] = []
        self.restart()

    def restart(self) -> None:
        """Forget the chunks so far."""
        self.tally = Tally(len(self.cameras))
        self.meeting = WaterMeeting(self.water)
        self.labelling.restart()
        if self.carrying is not None:
            self.carrying.restart()
        self._views = self._view_match()

    def _view_match(self) -> ViewMatch | None:
        """Return the view list and the cloud from its first row on."""
        if self._list is None:
            return None
        from pcfix.io.views import ViewMatch

        return ViewMatch(self._list, self._listed, points=self._points, step_m=self._step_m)

    def look_around(self, chunks: Callable[[], Iterable[Points]]) -> None:
        """Learn what must be known of the whole cloud, before the first chunk is corrected."""
        around = chunks if self.carrying is None else partial(self._carried, chunks, self.carrying)
        if self.labelling.looks_around:
            self.labelling.look_around(
                lambda: parts_of(around(), self.water), self._low, self._high
            )
        came = None if self.carrying is None else partial(self._came, chunks, self.carrying)
        self.survey = replace(self.survey, learned=self._learning.of_cloud(around, came))

    def _carried(
        self, chunks: Callable[[], Iterable[Points]], carrying: Carrying
    ) -> Iterator[Points]:
        """Yield the whole cloud as it lies with the adjusted cameras."""
        match, row = self._view_match(), 0
        for xyz, heights, classes in chunks():
            listed = None if match is None else match.for_chunk(xyz, row)
            yield carrying.step(xyz, listed).xyz, heights, classes
            row += len(xyz)

    def _came(
        self, chunks: Callable[[], Iterable[Points]], carrying: Carrying
    ) -> Iterator[MadeWith]:
        """Yield what made the points of the whole cloud."""
        for xyz, _, _ in chunks():
            yield carrying.made_with(xyz)

    def _old_ties(self) -> TiePoints | None:
        """Return the tie points of the old model, else those of the adjusted one taken back."""
        if self.carrying is None:
            return None
        ties, are_old = old_tie_points(self._inputs, self.carrying.pair, self._crs)
        return ties if ties is None or are_old else self.carrying.of_new_ties(ties)

    def correct(
        self, xyz: FloatArray, heights: FloatArray | None, classes: npt.NDArray[np.uint8]
    ) -> Correction:
        """Correct one chunk of n points.

        Parameters
        ----------
        xyz : array, shape (n, 3)
            Metres.
        heights : array, shape (n,), or None
            Where the water is a dimension.
        classes : array, shape (n,)
            That the points come with.
        """
        views = None if self._views is None else self._views.for_chunk(xyz, self.tally.points)
        label: Label = partial(self.labelling.submerged, classes=classes)
        step, made_with = None, None
        if self.carrying is not None:
            step, made_with = self.carrying.step(xyz, views), self.carrying.made_with(xyz)
            xyz, views, label = step.xyz, step.views, step.rule(label)
        above = surface_above(self.water, xyz, heights)
        batch = self._of_kind(Batch(xyz, above, self.survey, views, made_with))
        correction = correct_checked(batch, label, self._level_sigma_m)
        if self.carrying is not None and step is not None:
            correction = step.whole(correction)
            self.carrying.add(step, correction)
        self.tally.add(xyz, correction)
        self.meeting.add(xyz, correction)
        return correction

    def _of_kind(self, batch: Batch) -> Batch:
        """Return a chunk with its views as what they are; the first one tells what they list."""
        if batch.views is None or self.survey.learned.matcher is None:
            return batch
        if self._inputs.views_are != "auto":
            return batch
        if self._kind is None:
            rows = np.flatnonzero(is_submerged(batch.xyz[:, 2], batch.surface))
            found = kind_of_views(batch.take(rows))
            self._kind = batch.views.kind if found is None else found.kind
            self._kind_notes = [] if found is None else [str(found)]
        return replace(batch, views=replace(batch.views, kind=self._kind))

    def _level_sigma_m(self, xy: FloatArray) -> FloatArray | None:
        """Return the standard error of the water's height at places, where its fit says one."""
        found = self.found.evidence
        if found is None:
            return None
        if hasattr(found, "sigma_at"):
            return np.asarray(found.sigma_at(xy))
        sigma = getattr(found, "sigma_level_m", None)
        return None if sigma is None else np.full(len(xy), float(sigma))

    def provenance(self) -> dict[str, Any]:
        """Return what a file shall say of its correction."""
        return {
            "pcfix": __version__,
            "settings": asdict(self.settings),
            "water": str(self.water),
            "water_plane": list(astuple(self.water))
            if isinstance(self.water, WaterPlane)
            else None,
            "cameras": len(self.cameras),
            "cameras_source": self.cameras.source,
            "views": None if self._list is None else str(self._list.raw.path),
            **self._labelling_words(),
            **({} if self.carrying is None else self.carrying.provenance()),
        }

    def _water_words(self) -> str:
        """Return the water surface in words, and how far it moved where it did."""
        moved = self.level_offset_m
        if moved is None:
            return str(self.water)
        return (
            f"{self.water}, {moved.min():+.3f} to {moved.max():+.3f} m at the times of the images"
        )

    def _labelling_words(self) -> dict[str, Any]:
        """Return what a file shall say of the rules by which points were left out, if any."""
        labelling = self.labelling
        if labelling.is_plain:
            return {}
        mask = None if labelling.mask is None else labelling.mask.name
        return {"labelling": {**asdict(labelling.settings), "water_mask": mask}}

    def check_fit(self) -> None:
        """Refuse a result in which cloud, water and cameras did not meet.

        Raises
        ------
        GeometryError
            If no point lies below the water, or no camera sees one that does.
        """
        tally = self.tally
        self._check_views()
        if self.carrying is not None:
            self.carrying.check(self.name)
        self.labelling.check(self.name)
        self.meeting.check_submerged(self.name)
        if isinstance(self.water, WaterDimension):
            refuse_under_water(self.cameras, tally.lowest_water_m, str(self.water))
        self.meeting.check_reach(self.name)
        if tally.outcomes[Outcome.NO_CAMERA] == tally.submerged:
            middle = (tally.low + tally.high) / 2.0
            distance = float(np.hypot(*(self.cameras.centres - middle)[:, :2].T).min())
            limit = self.settings.max_angle_deg
            raise GeometryError(
                f"{self.name}: no camera has a submerged point in sight"
                + (f" within {limit:g} degrees" if limit else "")
                + f"; the nearest stands {_distance(distance)} in plan from the middle of the"
                f" {tally.submerged:,} submerged points; check that cameras and cloud have the"
                " same CRS, and that pitch 0 means straight down." + self._likely_mistake()
            )
        self._bent = [
            diagnose_in_passing(
                self._inputs, self.cameras, self.water, self.settings.refractive_index, self._view
            )
        ]

    def _check_views(self) -> None:
        """Refuse views that do not belong to the cloud, and warn of those that hardly do."""
        if self._views is None:
            return
        self._views.report.check()
        for sentence in self._views.report.warnings():
            warnings.warn(sentence, PcfixWarning, stacklevel=3)

    def _likely_mistake(self) -> str:
        """Return what is likely wrong with cameras that do not see the cloud, as a sentence."""
        tally = self.tally
        found = likely_mistake(self.cameras.centres, tally.low, tally.high, self._crs)
        return f" {found}" if found else ""

    def summary(self, input: str, output: str, seconds: float) -> Summary:
        """Return the numbers of all chunks."""
        notes = [
            *self.labelling.notes,
            *self._learning.notes,
            *self._kind_notes,
            *self.found.notes,
            *self.meeting.notes,
            *filter(None, self._bent),
        ]
        return self._summary(
            input,
            output,
            seconds,
            depth_m=self.tally.depth_m(),
            water=self._water_words(),
            settings=asdict(self.settings),
            notes=notes,
            water_fit=self.found.as_dict(),
            uncertainty=self.tally.uncertainty(),
            carried=None if self.carrying is None else self.carrying.as_dict(),
            absorbed=any(self._bent),
        )

    def _summary(
        self, input: str, output: str, seconds: float, *, notes: list[str], **more: Any
    ) -> Summary:
        """Return what every kind of correction tells of its chunks, and some more."""
        tally = self.tally
        unused = [
            label
            for label, used in zip(self.cameras.labels, tally.camera_used, strict=True)
            if not used
        ]
        uncorrected = tally.uncorrected()
        stuck = sum(uncorrected.values()) + int(tally.outcomes[Outcome.NOT_CARRIED])
        views = None if self._views is None else self._views.report
        return Summary(
            input=input,
            output=output,
            pcfix=__version__,
            points=tally.points,
            submerged=tally.submerged,
            corrected=tally.corrected,
            uncorrected=uncorrected,
            dropped=stuck if self.settings.uncorrected == "drop" else 0,
            water_unknown=tally.water_unknown,
            shift_z_m=tally.shift_z_m(),
            rays=tally.rays,
            cameras=len(self.cameras),
            cameras_used=len(self.cameras) - len(unused),
            cameras_unused=unused,
            seconds=round(seconds, 3),
            views=None if views is None else views.as_dict(),
            warnings=[
                *self.cameras.notes,
                *([] if views is None else views.warnings()),
                *notes,
            ],
            labelling=self.labelling.report(),
            **more,
        )


def parts_of(chunks: Iterable[Points], water: WaterSurface) -> Iterable[Part]:
    """Return chunks with the water above them."""
    return (
        Part(xyz, surface_above(water, xyz, heights), classes) for xyz, heights, classes in chunks
    )


def _distance(metres: float) -> str:
    return f"{metres / 1000.0:,.1f} km" if metres >= 10_000.0 else f"{metres:,.1f} m"

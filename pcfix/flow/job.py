"""One correction, whichever door it came through: what was asked for, and what was done so far."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import compress
from typing import Any

import numpy as np

from pcfix.errors import GeometryError
from pcfix.flow.inputs import Inputs, mask_of
from pcfix.flow.old_cameras import ListedViews, read_blocks
from pcfix.flow.surfaces import CloudView, Points
from pcfix.flow.through_port import ThroughPort
from pcfix.flow.through_water import ThroughWater
from pcfix.io.cameras.mistakes import likely_mistake
from pcfix.io.regressions import write_regression
from pcfix.label.labelling import Labelling
from pcfix.model import Correction, Outcome, WaterSurface
from pcfix.options.correct import CorrectOptions, LabelRules, ScienceOptions
from pcfix.refract.choice import views_in_frame
from pcfix.refract.tally import Summary, Tally
from pcfix.sums import Sums
from pcfix.version import __version__
from pcfix.water.index import with_index


class Job(Sums):
    """A correction: its options, cameras and water or port, and the tally of its chunks.

    Parameters
    ----------
    name : str
        What is being corrected, for messages.
    options : CorrectOptions
    view : CloudView
        Of the whole cloud.
    step_m : float
        To which its coordinates are rounded.

    Raises
    ------
    PcfixError
        If an input cannot be read or they do not fit, or a camera stands under the water.
    """

    added = ("tally", "labelling", "medium", "views")

    def __init__(
        self, name: str, options: CorrectOptions, view: CloudView, step_m: float = 0.0
    ) -> None:
        self.name, self.options, self._view = name, with_index(options), view
        inputs = options.part(Inputs)
        medium = ThroughPort if inputs.port is not None else ThroughWater
        medium.check(self.options)
        blocks = read_blocks(inputs, view.crs)
        self.cameras = blocks.cameras
        self.views = ListedViews(blocks.views, blocks.listed, view.points, step_m)
        self.medium: ThroughWater | ThroughPort = medium(self.options, inputs, blocks, view)
        mask = mask_of(self.options.water_mask, view.crs, view.low, view.high)
        self.labelling = Labelling(self.options.part(LabelRules), mask)
        self.restart()

    @property
    def water(self) -> WaterSurface:
        """The water surface; infinitely high behind a port."""
        return self.medium.water

    def restart(self, first_row: int = 0) -> None:
        """Forget the chunks so far; the next one begins at a row of the whole cloud."""
        self.first_row = first_row
        self.tally = Tally(len(self.cameras), self._view.points, first_row)
        self.labelling.restart()
        self.medium.restart(first_row)
        self.views.restart()

    def look_around(self, chunks: Callable[[], Iterable[Points]]) -> None:
        """Learn what must be known of the whole cloud, before the first chunk is corrected."""
        self.medium.look_around(chunks, self.labelling, self.views)

    def correct(self, points: Points) -> Correction:
        """Correct one chunk."""
        views = self.views.of(points.xyz, self.first_row + self.tally.points)
        correction = self.medium.correct(points, views, self.labelling)
        self.tally.add(correction.apparent_xyz, correction)
        return correction

    def provenance(self) -> dict[str, Any]:
        """Return what a file shall say of its correction."""
        labelling = self.labelling
        mask = None if labelling.mask is None else labelling.mask.name
        rules = {"labelling": {**labelling.settings.as_dict(), "water_mask": mask}}
        return {
            "pcfix": __version__,
            "settings": self.options.part(ScienceOptions).as_dict(),
            **self.medium.provenance(),
            "cameras": len(self.cameras),
            "cameras_source": self.cameras.source,
            "views": self.views.path,
            **({} if labelling.is_plain else rules),
        }

    def check_fit(self) -> None:
        """Refuse a result in which cloud, water and cameras did not meet.

        Raises
        ------
        GeometryError
            If no point is to be corrected, or no camera sees one that is.
        """
        tally = self.tally
        self.views.check()
        self.medium.check_carried(self.name)
        self.labelling.check(self.name)
        self.medium.check_meeting(self.name, tally)
        flat = int(tally.outcomes[Outcome.FLAT_RAYS])
        if tally.outcomes[Outcome.NO_CAMERA] + flat == tally.submerged:
            block = self.cameras.centres, tally.low, tally.high, self._view.crs
            found = None if flat else likely_mistake(*block)
            mistake = f" {found}" if found else ""
            raise GeometryError(f"{self.name}: {self.medium.out_of_sight(tally)}{mistake}")
        if not tally.corrected and tally.submerged:
            reasons = [f"{n:,}: {why}" for why, n in tally.uncorrected().items() if n]
            raise GeometryError(
                f"{self.name}: none of {tally.submerged:,} submerged points can be corrected"
                f" ({'; '.join(reasons)}); check that cameras and cloud belong together."
            )
        self.medium.look_back()

    def save_regression(self) -> None:
        """Write the line that was fitted, where a file was named for it."""
        path, line = self.options.save_regression, self.medium.regression
        if path is not None and line is not None:
            write_regression(path, line, overwrite=self.options.overwrite)

    def summary(self, input: str, output: str, seconds: float) -> Summary:
        """Return the numbers of all chunks."""
        tally, report = self.tally, self.views.report
        unused = list(compress(self.cameras.labels, np.logical_not(tally.camera_used)))
        uncorrected = tally.uncorrected()
        stuck = sum(uncorrected.values()) + int(tally.outcomes[Outcome.NOT_CARRIED])
        return Summary(
            input=input,
            output=output,
            pcfix=__version__,
            points=tally.points,
            submerged=tally.submerged,
            corrected=tally.corrected,
            uncorrected=uncorrected,
            dropped=stuck if self.options.uncorrected == "drop" else 0,
            water_unknown=tally.water_unknown,
            unsure=tally.unsure if self.options.unsure == "withhold" else None,
            shift_z_m=tally.shift_z_m(),
            rays=tally.rays,
            incidence_deg=round(tally.incidence_deg, 2),
            cameras=len(self.cameras),
            cameras_used=len(self.cameras) - len(unused),
            cameras_unused=unused,
            cameras_left_out=self._left_out(),
            seconds=round(seconds, 3),
            views=None if report is None else report.as_dict(),
            warnings=[
                *map(str, self.cameras.notes),
                *([] if report is None else map(str, report.warnings())),
                *self.labelling.notes,
                *self.medium.notes(tally),
            ],
            labelling=self.labelling.report(),
            settings={**self.options.part(ScienceOptions).as_dict(), **self.medium.settings},
            **self.medium.figures(tally),
        )

    def _left_out(self) -> dict[str, list[str]]:
        """Return the unused cameras in whose frame corrected points lie, by what left them out."""
        unused = ~self.tally.camera_used
        if isinstance(self.medium, ThroughPort) or not self.tally.moved or not unused.any():
            return {}
        xyz, limit = np.vstack(self.tally.moved), self.medium.survey.settings.limit_deg or 90.0
        seen = views_in_frame(xyz, self.cameras)
        points = np.repeat(np.arange(len(xyz)), np.diff(seen.start))
        across, along, up = (self.cameras.centres[seen.camera] - xyz[points]).T
        steepest = np.full(len(unused), np.inf)
        np.minimum.at(steepest, seen.camera, np.degrees(np.arctan2(np.hypot(across, along), up)))
        beyond, within = unused & np.isfinite(steepest) & (steepest > limit), steepest <= limit
        reasons = {f"beyond {limit:g} degrees alone": beyond, "but are not chosen": unused & within}
        return {
            why: list(compress(self.cameras.labels, rows))
            for why, rows in reasons.items()
            if rows.any()
        }

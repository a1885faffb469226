"""One correction, whichever door it came through: its options, inputs and statistics so far."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import compress
from typing import Any

import numpy as np

from pcfix.errors import GeometryError, PcfixWarning
from pcfix.flow.inputs import Inputs, mask_of
from pcfix.flow.old_cameras import ListedViews, read_blocks
from pcfix.flow.surfaces import CloudView, Points
from pcfix.flow.through_port import ThroughPort, check_port_options
from pcfix.flow.through_water import ThroughWater
from pcfix.io.cameras.mistakes import likely_mistake
from pcfix.io.regressions import write_regression
from pcfix.label.labelling import Labelling
from pcfix.model import Correction, Outcome
from pcfix.options.correct import CorrectOptions, LabelRules, ScienceOptions
from pcfix.refract.tally import Summary, Tally
from pcfix.sums import Sums
from pcfix.version import __version__
from pcfix.water.index import with_index


class Job(Sums):
    """A correction: its options, cameras and water or port, and the tally of its chunks.

    Parameters
    ----------
    name : str
        Of the cloud, for messages.
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
        if inputs.port is not None:
            check_port_options(self.options)
        elif not options.cameras:
            self.options.check_no_cameras()
        blocks = read_blocks(inputs, view.crs)
        self.cameras = blocks.cameras
        self.views = ListedViews(blocks.views, blocks.listed, view.points, step_m)
        medium = ThroughWater if inputs.port is None else ThroughPort
        self.medium: ThroughWater | ThroughPort = medium(self.options, inputs, blocks, view)
        self.water = self.medium.water
        mask = mask_of(self.options.water_mask, view.crs, view.low, view.high)
        self.labelling = Labelling(self.options.part(LabelRules), mask)
        self.restart()

    def restart(self, first_row: int = 0) -> None:
        """Forget the chunks so far; the next one starts at a row of the whole cloud."""
        self.first_row = first_row
        self.tally = Tally(len(self.cameras), self._view.points, first_row)
        for one in (self.labelling, self.views):
            one.restart()
        self.medium.restart(first_row)

    def look_around(self, chunks: Callable[[], Iterable[Points]]) -> None:
        """Estimate everything that a correction must know about the whole cloud."""
        self.medium.look_around(chunks, self.labelling, self.views)

    def correct(self, points: Points) -> Correction:
        """Correct one chunk."""
        views = self.views.of(points.xyz, self.first_row + self.tally.points)
        correction = self.medium.correct(points, views, self.labelling)
        self.tally.add(correction.apparent_xyz, correction)
        return correction

    def provenance(self) -> dict[str, Any]:
        """Return the record of the correction for the output file."""
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
        """Refuse a result in which cloud, water and cameras do not fit together.

        Raises
        ------
        GeometryError
            If no point was corrected, and why: none is submerged, or no image shows one.
        """
        name, tally = self.name, self.tally
        self.views.check()
        self.medium.check(name, tally, self.labelling)
        flat = int(tally.outcomes[Outcome.FLAT_RAYS])
        if tally.outcomes[Outcome.NO_CAMERA] + flat == tally.submerged:
            block = self.cameras.centres, tally.low, tally.high, self._view.crs
            mistake = (None if flat else likely_mistake(*block)) or ""
            raise GeometryError(
                "cameras.max_angle" if flat else "cameras.no_overlap",
                f"{name}: {self.medium.out_of_sight(tally)} {mistake}".strip(),
                submerged=tally.submerged,
                flat=flat,
            )
        if not tally.corrected and tally.submerged:
            reasons = {why: n for why, n in tally.uncorrected().items() if n}
            listed = "; ".join(f"{n:,}: {why}" for why, n in reasons.items())
            raise GeometryError(
                "cameras.none_corrected",
                f"{name}: none of {tally.submerged:,} submerged points can be corrected ({listed})."
                " Check that cameras and cloud belong together.",
                reasons=reasons,
            )
        self.medium.finish()

    def save_regression(self) -> None:
        """Write the line that was fitted, if a file was named for it."""
        path, line = self.options.save_regression, self.medium.regression
        if path is not None and line is not None:
            write_regression(path, line, overwrite=self.options.overwrite)

    def summary(self, input: str, output: str, seconds: float) -> Summary:
        """Return the figures of all chunks."""
        tally, report = self.tally, self.views.report
        unused = list(compress(self.cameras.labels, np.logical_not(tally.camera_used)))
        uncorrected = tally.uncorrected()
        not_moved = sum(uncorrected.values()) + int(tally.outcomes[Outcome.NOT_CARRIED])
        notes = [
            *self.cameras.notes,
            *([] if report is None else report.warnings()),
            *self.labelling.notes,
            *self.medium.notes(tally),
        ]
        return Summary(
            input=input,
            output=output,
            pcfix=__version__,
            points=tally.points,
            submerged=tally.submerged,
            corrected=tally.corrected,
            uncorrected=uncorrected,
            dropped=not_moved if self.options.uncorrected == "drop" else 0,
            water_unknown=tally.water_unknown,
            unsure=tally.unsure if self.options.unsure == "withhold" else None,
            shift_z_m=tally.shift_z_m(),
            rays=tally.rays,
            incidence_deg=round(tally.incidence_deg, 2),
            cameras=len(self.cameras),
            cameras_used=len(self.cameras) - len(unused),
            cameras_unused=unused,
            seconds=round(seconds, 3),
            views=None if report is None else report.as_dict(),
            warnings=[
                (one if isinstance(one, PcfixWarning) else PcfixWarning(one)).as_dict()
                for one in notes
            ],
            labelling=self.labelling.report(),
            settings={**self.options.part(ScienceOptions).as_dict(), **self.medium.settings},
            **self.medium.figures(tally),
        )

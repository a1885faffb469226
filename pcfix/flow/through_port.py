"""A correction through the port of a housing, for a cloud that was taken under water.

All points are under water, whatever their height, but those outside the mask or of classes to
respect. Without a water surface there is no depth: it is 0, and in a file the least that marks a
submerged point, 1 mm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from pcfix.errors import GeometryError, SettingError
from pcfix.flow.inputs import Inputs
from pcfix.flow.old_cameras import Blocks, ListedViews
from pcfix.flow.surfaces import CloudView, Points
from pcfix.flow.through_water import spread_over
from pcfix.label.labelling import Labelling
from pcfix.model import Correction, Views, WaterPlane
from pcfix.options.correct import CorrectOptions
from pcfix.port.methods import correct_through_port
from pcfix.refract.tally import Tally
from pcfix.sums import Sums
from pcfix.water.surface import SurfaceAbove


class ThroughPort(Sums):
    """The light bends at a port that is fixed to the camera.

    Raises
    ------
    SettingError
        If the cameras have no angles.
    """

    added = ("_miss_sum_m",)

    def __init__(
        self, options: CorrectOptions, inputs: Inputs, blocks: Blocks, view: CloudView
    ) -> None:
        self._options, self._cameras, self._port = options, blocks.cameras, inputs.port
        if self._cameras.rotations is None:
            raise SettingError(
                "port: it is fixed to the camera, and these cameras have no angles; give a camera"
                " file that has them."
            )
        if options.method == "auto":
            known = self._cameras.lenses is not None
            self._options = replace(options, method="consistent" if known else "snell")
        self.water = WaterPlane(np.inf)
        self.settings, self.regression = {"port": asdict(self._port)}, None
        self.restart()

    @staticmethod
    def check(options: CorrectOptions) -> None:
        """Refuse what needs a water surface, or a model of what happens above one."""
        given = {
            "tide": options.tide is not None,
            "water-per-image": options.water_per_image is not None,
            "image-times": options.image_times is not None,
            "check-depths": options.check_depths is not None,
            "regression": options.regression is not None,
            "water-crs": options.water_crs is not None,
            "water-model": options.water_model != "auto",
            "connected": options.connected,
            "camera-set mvs": options.camera_set == "mvs",
            "occlusion on": options.occlusion == "on",
            "adjusted-from": options.adjusted_from is not None,
            "unsure withhold": options.unsure == "withhold",
            "shoreline": options.shoreline is not None,
        }
        for name, is_given in given.items():
            if is_given:
                raise SettingError(f"{name} is of no use with a port; leave it out.")
        if options.method not in ("auto", "snell", "consistent"):
            raise SettingError(
                f"method {options.method} is about a water surface; with a port give snell or"
                " consistent."
            )

    def restart(self, first_row: int = 0) -> None:
        """Forget the chunks so far."""
        del first_row
        self._miss_sum_m = 0.0

    def look_around(
        self, chunks: Callable[[], Iterable[Points]], labelling: Labelling, views: ListedViews
    ) -> None:
        """Learn nothing: no point depends on others."""

    def correct(self, points: Points, views: Views | None, labelling: Labelling) -> Correction:
        """Correct one chunk; see `pcfix.flow.job.Job.correct`."""
        xyz, classes = points.xyz, points.classes
        n = len(xyz)
        above = SurfaceAbove(np.full(n, np.inf), np.zeros((n, 2)))
        rows = np.flatnonzero(labelling.submerged(xyz, above, classes))
        listed = None if views is None else views.take(rows)
        found = correct_through_port(xyz[rows], self._cameras, self._port, self._options, listed)
        self._miss_sum_m += float(found.ray_miss_m.sum())
        return Correction(
            apparent_xyz=xyz,
            depth_m=np.zeros(n),
            water_known=np.ones(n, np.bool_),
            lowest_water_m=np.inf,
            camera_used=found.camera_used,
            **spread_over(found, rows, n),
        )

    def provenance(self) -> dict[str, Any]:
        """Return what a file shall say of the port."""
        return dict(self.settings)

    def check_carried(self, name: str) -> None:
        """Nothing is carried through a port."""

    def check_meeting(self, name: str, tally: Tally) -> None:
        """Refuse a cloud of which nothing is left to correct."""
        if tally.submerged == 0:
            raise GeometryError(f"{name}: no point is left to correct; check the mask.")

    def out_of_sight(self, tally: Tally) -> str:
        """Return what to say where no camera has a point in sight."""
        return "no camera has a point in sight; check that cameras and cloud have the same CRS."

    def look_back(self) -> None:
        """Nothing is known of poses bent by a port, and there is no shoreline."""

    def notes(self, tally: Tally) -> list[str]:
        """Say what forward intersection leaves out, where that was used."""
        if self._options.method != "snell" or not tally.corrected:
            return []
        mean = self._miss_sum_m / tally.corrected
        return [
            f"The rays through the apparent points miss each other behind the port by"
            f" {mean:.3f} m on average; --method consistent takes into account that the straight"
            " ones did, best with the views of each point."
        ]

    def figures(self, tally: Tally) -> dict[str, Any]:
        """Return what the summary says: no depths, and no orders of survey by depth."""
        return {
            "depth_m": {},
            "water": f"all around, seen through a {self._port}",
            "water_fit": None,
            "uncertainty": None,
            "told": self.notes(tally),
        }

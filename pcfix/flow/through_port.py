"""A correction through the port of a housing, for a cloud that was taken under water.

All points are under water, whatever their height, except those outside the mask or of classes to
respect. Without a water surface there is no depth: it is 0, and in a file 1 mm, the least that
marks a submerged point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from pcfix.errors import GeometryError, PcfixWarning, SettingError
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
    for name, is_given in excluded.items():
        if is_given:
            raise SettingError(
                "port.excludes",
                f"{name.replace('_', '-')} {getattr(options, name)} has no effect with a port."
                " Leave it out; the methods are snell and consistent.",
                option=name,
            )


class ThroughPort(Sums):
    """The light is refracted at a port that is fixed to the camera.

    Raises
    ------
    SettingError
        If the cameras have no angles.
    """

    added = ("_miss_sum_m",)
    regression = None

    def __init__(
        self, options: CorrectOptions, inputs: Inputs, blocks: Blocks, view: CloudView
    ) -> None:
        self._options, self._cameras, self._port = options, blocks.cameras, inputs.port
        if self._cameras.rotations is None:
            raise SettingError(
                "cameras.no_angles",
                "port: it is fixed to the camera, and these cameras have no angles. Give a camera"
                " file with angles.",
            )
        if options.method == "auto":
            known = self._cameras.lenses is not None
            self._options = replace(options, method="consistent" if known else "snell")
        self.water = WaterPlane(np.inf)
        self.settings = {"port": asdict(self._port)}
        self.restart()

    def restart(self, first_row: int = 0) -> None:
        """Forget the chunks so far."""
        self._miss_sum_m = 0.0

    def look_around(
        self, chunks: Callable[[], Iterable[Points]], labelling: Labelling, views: ListedViews
    ) -> None:
        """Do nothing: no point depends on others."""

    def correct(self, points: Points, views: Views | None, labelling: Labelling) -> Correction:
        """Correct one chunk; see `pcfix.flow.job.Job.correct`."""
        xyz, n = points.xyz, len(points.xyz)
        above = SurfaceAbove(np.full(n, np.inf), np.zeros((n, 2)))
        rows = np.flatnonzero(labelling.submerged(xyz, above, points.classes))
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
        """Return the record of the port for the output file."""
        return dict(self.settings)

    def check(self, name: str, tally: Tally, labelling: Labelling) -> None:
        """Refuse a cloud that has no point to correct."""
        labelling.check(name)
        if tally.submerged == 0:
            raise GeometryError(
                "cloud.none_submerged", f"{name}: no point is left to correct. Check the mask."
            )

    def out_of_sight(self, tally: Tally) -> str:
        """Return the sentence for a cloud that no image shows."""
        return "no camera has a point in sight. Check that cameras and cloud have the same CRS."

    def finish(self) -> None:
        """Do nothing: absorbed refraction cannot be tested, and there is no shoreline."""

    def notes(self, tally: Tally) -> list[PcfixWarning]:
        """Return what forward intersection leaves out, if it was used."""
        if self._options.method != "snell" or not tally.corrected:
            return []
        mean = self._miss_sum_m / tally.corrected
        note = PcfixWarning(
            "port.ray_distance",
            "The refracted rays of the apparent points miss each other behind the port by"
            f" {mean:.3f} m on average. --method consistent takes this into account, best with"
            " --views.",
            mean_m=mean,
        )
        return [note]

    def figures(self, tally: Tally) -> dict[str, Any]:
        """Return the part of the summary about the port: no depths, and no orders by depth."""
        return {
            "depth_m": {},
            "water": f"all around, seen through a {self._port}",
            "water_fit": None,
            "uncertainty": None,
            "told": list(map(str, self.notes(tally))),
        }

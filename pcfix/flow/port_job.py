"""The correction of a cloud that was taken under water, through the port of a housing.

All points are under water, whatever their height, but those outside the mask or of classes to
respect. Without a water surface there is no depth: it is 0, and in a file the least that marks a
submerged point, 1 mm.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import GeometryError, SettingError
from pcfix.flow.inputs import mask_of
from pcfix.flow.job import PLAIN, Job
from pcfix.label.labelling import Labelling
from pcfix.model import Correction, Outcome, WaterPlane
from pcfix.port.methods import correct_through_port
from pcfix.refract.tally import Tally
from pcfix.version import __version__
from pcfix.water.surface import SurfaceAbove

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    import numpy.typing as npt

    from pcfix.flow.inputs import Inputs
    from pcfix.flow.job import Points
    from pcfix.flow.surfaces import CloudView
    from pcfix.model import FloatArray, Summary
    from pcfix.options import LabelSettings, Settings
    from pcfix.port.shapes import Port


class PortJob(Job):
    """The settings, cameras and port of a correction, and the tally of its chunks.

    The parameters are those of `pcfix.flow.job.Job`; ``inputs.port`` is not None.

    Raises
    ------
    PcfixError
        If an input cannot be read or they do not fit, or an option asks for what only a water
        surface has.
    """

    def __init__(
        self,
        name: str,
        settings: Settings,
        inputs: Inputs,
        port: Port,
        *,
        view: CloudView,
        step_m: float = 0.0,
        label: LabelSettings = PLAIN,
    ) -> None:
        _refuse_surface_options(settings, inputs, label)
        self.name, self.settings, self.port = name, settings, port
        self.cameras, self._list = inputs.block(view.crs)
        self._listed = self.cameras
        self.carrying = None
        if self.cameras.rotations is None:
            raise SettingError(
                "port: it is fixed to the camera, and these cameras have no angles; give a camera"
                " file that has them."
            )
        self.water = WaterPlane(np.inf)
        self._points, self._step_m, self._crs = view.points, step_m, view.crs
        self.labelling = Labelling(label, mask_of(inputs.water_mask, view.crs, view.low, view.high))
        self.restart()

    def restart(self) -> None:
        """Forget the chunks so far."""
        self.tally = Tally(len(self.cameras))
        self._miss_sum_m = 0.0
        self.labelling.restart()
        self._views = self._view_match()

    def look_around(self, chunks: Callable[[], Iterable[Points]]) -> None:
        """Learn nothing: no point depends on others."""

    def correct(
        self, xyz: FloatArray, heights: FloatArray | None, classes: npt.NDArray[np.uint8]
    ) -> Correction:
        """Correct one chunk of n points; see `Job.correct`."""
        n = len(xyz)
        above = SurfaceAbove(np.full(n, np.inf), np.zeros((n, 2)))
        rows = np.flatnonzero(self.labelling.submerged(xyz, above, classes))
        views = None
        if self._views is not None:
            views = self._views.for_chunk(xyz, self.tally.points).take(rows)
        found = correct_through_port(xyz[rows], self.cameras, self.port, self.settings, views)

        def spread(values: npt.NDArray[Any]) -> Any:
            full = np.zeros((n, *values.shape[1:]), values.dtype)
            full[rows] = values
            return full

        correction = Correction(
            apparent_xyz=xyz,
            shift_m=spread(found.shift_m),
            outcome=spread(found.outcome),
            ray_count=spread(found.ray_count),
            ray_miss_m=spread(found.ray_miss_m),
            depth_m=np.zeros(n),
            incidence_deg=spread(found.incidence_deg),
            sigma_z_m=spread(found.sigma_z_m),
            camera_used=found.camera_used,
            water_known=np.ones(n, np.bool_),
            covariance_m2=None if found.covariance_m2 is None else spread(found.covariance_m2),
            lowest_water_m=np.inf,
        )
        self.tally.add(xyz, correction)
        self._miss_sum_m += float(found.ray_miss_m.sum())
        return correction

    def provenance(self) -> dict[str, Any]:
        """Return what a file shall say of its correction."""
        return {
            "pcfix": __version__,
            "settings": asdict(self.settings),
            "port": asdict(self.port),
            "cameras": len(self.cameras),
            "cameras_source": self.cameras.source,
            "views": None if self._list is None else str(self._list.raw.path),
            **self._labelling_words(),
        }

    def check_fit(self) -> None:
        """Refuse a result in which cloud and cameras did not meet.

        Raises
        ------
        GeometryError
            If no camera sees a point, or none was to be corrected.
        """
        self._check_views()
        self.labelling.check(self.name)
        tally = self.tally
        if tally.submerged == 0:
            raise GeometryError(f"{self.name}: no point is left to correct; check the mask.")
        if tally.outcomes[Outcome.NO_CAMERA] == tally.submerged:
            raise GeometryError(
                f"{self.name}: no camera has a point in sight; check that cameras and cloud have"
                " the same CRS." + self._likely_mistake()
            )

    def summary(self, input: str, output: str, seconds: float) -> Summary:
        """Return the numbers of all chunks; no depths, and no orders of survey by depth."""
        return self._summary(
            input,
            output,
            seconds,
            depth_m={},
            water=f"all around, seen through a {self.port}",
            settings={**asdict(self.settings), "port": asdict(self.port)},
            notes=[*self.labelling.notes, *self._miss_note()],
            water_fit=None,
            uncertainty=None,
        )

    def _miss_note(self) -> list[str]:
        """Say what forward intersection leaves out, where that was used."""
        if self.settings.method != "snell" or not self.tally.corrected:
            return []
        mean = self._miss_sum_m / self.tally.corrected
        return [
            f"The rays through the apparent points miss each other behind the port by"
            f" {mean:.3f} m on average; --method consistent takes into account that the straight"
            " ones did, best with the views of each point."
        ]


def _refuse_surface_options(settings: Settings, inputs: Inputs, label: LabelSettings) -> None:
    """Refuse what needs a water surface, or a model of what happens above one."""
    given = {
        "tide": inputs.tide is not None,
        "image-times": inputs.image_times is not None,
        "check-depths": inputs.check_depths is not None,
        "water-crs": inputs.water_crs is not None,
        "water-model": inputs.water_model != "auto",
        "connected": label.connected,
        "camera-set mvs": settings.camera_set == "mvs",
        "occlusion on": settings.occlusion == "on",
        "adjusted-from": inputs.adjusted_from is not None,
    }
    for name, is_given in given.items():
        if is_given:
            raise SettingError(f"{name} is of no use with a port; leave it out.")
    if settings.method not in ("snell", "consistent"):
        raise SettingError(
            f"method {settings.method} is about a water surface; with a port give snell or"
            " consistent."
        )

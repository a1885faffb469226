"""One correction, whichever door it came through: what was asked for, and what was done so far."""

from __future__ import annotations

import warnings
from dataclasses import asdict, astuple
from typing import TYPE_CHECKING, Any

import numpy as np

import pcfix
from pcfix.errors import GeometryError, PcfixWarning
from pcfix.flow.points import (
    check_above_water,
    check_submerged,
    correct_checked,
    refuse_under_water,
)
from pcfix.model import (
    Correction,
    Outcome,
    Settings,
    Summary,
    WaterDimension,
    WaterPlane,
)
from pcfix.report.tally import Tally

if TYPE_CHECKING:
    from pyproj import CRS

    from pcfix.flow.inputs import Inputs
    from pcfix.model import FloatArray


class Job:
    """The settings, cameras and water of a correction, and the tally of its chunks.

    Parameters
    ----------
    name : str
        What is being corrected, for messages.
    settings : Settings
    inputs : Inputs
    cloud_crs : CRS or None
        Projected, metres.
    points : int
        Of the whole cloud.
    step_m : float
        To which its coordinates are rounded.

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
        cloud_crs: CRS | str | None = None,
        points: int = 0,
        step_m: float = 0.0,
    ) -> None:
        self.name, self.settings = name, settings
        self.cameras, self._list = inputs.block(cloud_crs)
        self.water = inputs.surface()
        self._points, self._step_m = points, step_m
        check_above_water(self.cameras, self.water)
        self.restart()

    def restart(self) -> None:
        """Forget the chunks so far."""
        self.tally = Tally(len(self.cameras))
        self._views = None
        if self._list is not None:
            from pcfix.io.views import ViewMatch

            self._views = ViewMatch(
                self._list, self.cameras, points=self._points, step_m=self._step_m
            )

    def correct(self, xyz: FloatArray, heights: FloatArray | None) -> Correction:
        """Correct one chunk, shape (n, 3), metres; `heights` where the water is a dimension."""
        views = None if self._views is None else self._views.for_chunk(xyz, self.tally.points)
        correction = correct_checked(xyz, self.cameras, self.water, self.settings, heights, views)
        self.tally.add(xyz, correction)
        return correction

    def provenance(self) -> dict[str, Any]:
        """Return what a file shall say of its correction."""
        return {
            "pcfix": pcfix.__version__,
            "settings": asdict(self.settings),
            "water": str(self.water),
            "water_plane": list(astuple(self.water))
            if isinstance(self.water, WaterPlane)
            else None,
            "cameras": len(self.cameras),
            "cameras_source": self.cameras.source,
            "views": None if self._list is None else str(self._list.raw.path),
        }

    def check_fit(self) -> None:
        """Refuse a result in which cloud, water and cameras did not meet.

        Raises
        ------
        GeometryError
            If no point lies below the water, or no camera sees one that does.
        """
        tally = self.tally
        if self._views is not None:
            self._views.report.check()
            for sentence in self._views.report.warnings():
                warnings.warn(sentence, PcfixWarning, stacklevel=2)
        check_submerged(tally.submerged, self.name, self.water)
        if isinstance(self.water, WaterDimension):
            refuse_under_water(self.cameras, tally.lowest_water_m, str(self.water))
        if tally.outcomes[Outcome.NO_CAMERA] == tally.submerged:
            middle = (tally.low + tally.high) / 2.0
            distance = float(np.hypot(*(self.cameras.centres - middle)[:, :2].T).min())
            limit = self.settings.max_angle_deg
            raise GeometryError(
                f"{self.name}: no camera has a submerged point in sight"
                + (f" within {limit:g} degrees" if limit else "")
                + f"; the nearest stands {_distance(distance)} in plan from the middle of the"
                f" {tally.submerged:,} submerged points; check that cameras and cloud have the"
                " same CRS, and that pitch 0 means straight down."
            )

    def summary(self, input: str, output: str, seconds: float) -> Summary:
        """Return the numbers of all chunks."""
        tally = self.tally
        unused = [
            label
            for label, used in zip(self.cameras.labels, tally.camera_used, strict=True)
            if not used
        ]
        uncorrected = tally.uncorrected()
        views = None if self._views is None else self._views.report
        return Summary(
            input=input,
            output=output,
            pcfix=pcfix.__version__,
            points=tally.points,
            submerged=tally.submerged,
            corrected=tally.corrected,
            uncorrected=uncorrected,
            dropped=sum(uncorrected.values()) if self.settings.uncorrected == "drop" else 0,
            water_unknown=tally.water_unknown,
            depth_m=tally.depth_m(),
            shift_z_m=tally.shift_z_m(),
            rays=tally.rays,
            cameras=len(self.cameras),
            cameras_used=len(self.cameras) - len(unused),
            cameras_unused=unused,
            water=str(self.water),
            settings=asdict(self.settings),
            seconds=round(seconds, 3),
            views=None if views is None else views.as_dict(),
            warnings=[*self.cameras.notes, *([] if views is None else views.warnings())],
        )


def _distance(metres: float) -> str:
    return f"{metres / 1000.0:,.1f} km" if metres >= 10_000.0 else f"{metres:,.1f} m"

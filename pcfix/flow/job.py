"""One correction, whichever door it came through: what was asked for, and what was done so far."""

from __future__ import annotations

from dataclasses import asdict, astuple
from typing import TYPE_CHECKING, Any

import numpy as np

import pcfix
from pcfix.errors import GeometryError
from pcfix.flow.points import (
    check_above_water,
    check_submerged,
    correct_checked,
    refuse_under_water,
)
from pcfix.io.cameras import read_cameras
from pcfix.io.water import read_water
from pcfix.model import (
    Cameras,
    Correction,
    Outcome,
    Settings,
    Summary,
    WaterDimension,
    WaterMesh,
    WaterPlane,
    WaterSurface,
)
from pcfix.report.tally import Tally

if TYPE_CHECKING:
    import os

    from pcfix.model import FloatArray

    AnyPath = str | os.PathLike[str]


class Job:
    """The settings, cameras and water of a correction, and the tally of its chunks.

    Parameters
    ----------
    name : str
        What is being corrected, for messages.
    settings : Settings
    cameras, water, sensor
        See `pcfix.correct_file`.

    Raises
    ------
    PcfixError
        If cameras or water cannot be read, or a camera stands under the water.
    """

    def __init__(
        self,
        name: str,
        settings: Settings,
        cameras: Cameras | AnyPath,
        water: WaterSurface | float | AnyPath,
        sensor: AnyPath | None = None,
    ) -> None:
        self.name, self.settings = name, settings
        self.cameras = cameras if isinstance(cameras, Cameras) else read_cameras(cameras, sensor)
        self.water: WaterSurface = (
            water
            if isinstance(water, WaterPlane | WaterDimension | WaterMesh)
            else read_water(water)
        )
        check_above_water(self.cameras, self.water)
        self.tally = Tally(len(self.cameras))

    def restart(self) -> None:
        """Forget the chunks so far."""
        self.tally = Tally(len(self.cameras))

    def correct(self, xyz: FloatArray, heights: FloatArray | None) -> Correction:
        """Correct one chunk, shape (n, 3), metres; `heights` where the water is a dimension."""
        correction = correct_checked(xyz, self.cameras, self.water, self.settings, heights)
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
        }

    def check_fit(self) -> None:
        """Refuse a result in which cloud, water and cameras did not meet.

        Raises
        ------
        GeometryError
            If no point lies below the water, or no camera sees one that does.
        """
        tally = self.tally
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
            warnings=list(self.cameras.notes),
        )


def _distance(metres: float) -> str:
    return f"{metres / 1000.0:,.1f} km" if metres >= 10_000.0 else f"{metres:,.1f} m"

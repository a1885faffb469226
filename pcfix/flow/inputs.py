"""What a correction is made with: from the words of its user to cameras, views and water."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import PcfixWarning, SettingError
from pcfix.io.cameras import read_cameras, read_tie_points
from pcfix.io.cameras.georeference import georeference
from pcfix.io.water import read_water
from pcfix.model import Cameras, WaterDimension, WaterMesh, WaterPlane

if TYPE_CHECKING:
    from pyproj import CRS

    from pcfix.io.cameras.formats import Angles
    from pcfix.io.views import ViewList
    from pcfix.model import WaterSurface

    AnyPath = str | PathLike[str]


@dataclass(frozen=True)
class Inputs:
    """Cameras, view lists and water as the user names them.

    Attributes
    ----------
    cameras : Cameras or path
        See `pcfix.read_cameras`. Cameras that are given as such are in the cloud's CRS.
    water : WaterSurface, float, str or path
        See `pcfix.read_water`.
    sensor, angles
        See `pcfix.read_cameras`.
    cameras_crs : str or None
        Of the cameras, instead of what their file says; ``local`` takes the numbers as they are.
    cameras_offset_m : tuple of 3 float, or None
        Added to the projection centres, in the axes of the camera file.
    views : path or None
        See `pcfix.io.views.read_views`; the camera file itself for the tracks of its tie points.
    """

    cameras: Cameras | AnyPath
    water: WaterSurface | float | AnyPath
    sensor: AnyPath | None = None
    angles: Angles | None = None
    cameras_crs: str | None = None
    cameras_offset_m: tuple[float, float, float] | None = None
    views: AnyPath | None = None

    def paths(self) -> list[AnyPath]:
        """Return what may be files, which no output may replace."""
        given = (self.cameras, self.water, self.sensor, self.views)
        return [one for one in given if isinstance(one, str | PathLike)]

    def surface(self) -> WaterSurface:
        """Return the water surface."""
        if isinstance(self.water, WaterPlane | WaterDimension | WaterMesh):
            return self.water
        return read_water(self.water)

    def block(self, cloud_crs: str | CRS | None) -> tuple[Cameras, ViewList | None]:
        """Return the cameras in the cloud's CRS, and the view list where one was named.

        Raises
        ------
        PcfixError
            If a file cannot be read or does not fit, or the CRS cannot be reconciled.
        """
        from pcfix.io.views import read_views, track_views

        if isinstance(self.cameras, Cameras):
            if self.views is None:
                return self.cameras, None
            return self.cameras, read_views(self.views, self.cameras)
        read = read_cameras(self.cameras, self.sensor, angles=self.angles)
        way = georeference(
            read, cloud_crs, cameras_crs=self.cameras_crs, offset_m=self.cameras_offset_m,
            name=str(self.cameras),
        )  # fmt: skip
        cameras = way.cameras(read)
        for note in way.notes:
            warnings.warn(note, PcfixWarning, stacklevel=2)
        if self.views is None:
            return cameras, None
        if Path(self.views) == Path(self.cameras):
            ties = read_tie_points(self.cameras, read)
            return cameras, track_views(Path(self.views), ties, cameras, to_cloud=way.points)
        return cameras, read_views(self.views, cameras, to_cloud=way.points)


def inputs_of(options: dict[str, Any]) -> Inputs:
    """Return the inputs among some options, which have the names of its attributes."""
    names = [field.name for field in fields(Inputs)]
    return Inputs(**{name: options[name] for name in names if name in options})


def offset_of(text: str | None) -> tuple[float, float, float] | None:
    """Return the three numbers of ``X,Y,Z``.

    Raises
    ------
    SettingError
        If they are not three finite numbers.
    """
    if text is None:
        return None
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        x = y = z = np.nan
    if not np.isfinite([x, y, z]).all():
        raise SettingError(
            f"cameras-offset '{text}' must be three numbers X,Y,Z in metres, as 500000,4650000,0."
        )
    return x, y, z

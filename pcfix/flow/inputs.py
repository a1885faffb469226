"""What a correction is made with: from the words of its user to cameras, views and water."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError, PcfixWarning, SettingError
from pcfix.flow.surfaces import WaterWords, find_surface
from pcfix.io.cameras import read_cameras, read_tie_points
from pcfix.io.cameras.georeference import georeference
from pcfix.io.vectors import LAYER_MARK
from pcfix.model import Cameras

if TYPE_CHECKING:
    from pyproj import CRS

    from pcfix.flow.surfaces import CloudView, WaterModel
    from pcfix.io.cameras.formats import Angles
    from pcfix.io.views import ViewList
    from pcfix.label.areas import WaterMask
    from pcfix.model import FloatArray, TiePoints, WaterSurface
    from pcfix.options import ViewsAre
    from pcfix.port.shapes import Port
    from pcfix.water.surface import FoundSurface

    AnyPath = str | PathLike[str]


@dataclass(frozen=True)
class Inputs:
    """Cameras, view lists and water as the user names them.

    Attributes
    ----------
    cameras : Cameras or path
        See `pcfix.read_cameras`. Cameras that are given as such are in the cloud's CRS.
    water, water_model, water_crs
        See `pcfix.flow.surfaces.WaterWords`.
    sensor, angles
        See `pcfix.read_cameras`.
    cameras_crs : str or None
        Of the cameras, instead of what their file says; ``local`` takes the numbers as they are.
    cameras_offset_m : tuple of 3 float, or None
        Added to the projection centres, in the axes of the camera file.
    views : path or None
        See `pcfix.io.views.read_views`; the camera file itself for the tracks of its tie points.
    views_are : {"auto", "tracks", "depth-maps"}
        What the list means; see `pcfix.model.Views`. auto: what its kind of file says.
    check_depths : path or None
        See `pcfix.io.tables.read_check_depths`.
    water_mask : path or None
        See `pcfix.io.vectors.read_water_polygons`.
    tide : path or None
        See `pcfix.io.tides.read_tide`: each image gets its own level, the water shifted along the
        vertical; the water is that of the images' mean level.
    image_times : path or None
        See `pcfix.io.tides.read_image_times`. Default, with a tide: the camera file, of
        two the one that the cloud was made with.
    port : Port or None
        Of the housing of cameras under water, instead of `water`.
    adjusted_from : Cameras, path or None
        Which the cloud was made with, where `cameras` were adjusted since. Views, offset and CRS
        are then told apart by `pcfix.flow.old_cameras`.
    """

    cameras: Cameras | AnyPath
    water: WaterSurface | float | AnyPath | None
    sensor: AnyPath | None = None
    angles: Angles | None = None
    cameras_crs: str | None = None
    cameras_offset_m: tuple[float, float, float] | None = None
    views: AnyPath | None = None
    water_mask: AnyPath | None = None
    tide: AnyPath | None = None
    image_times: AnyPath | None = None
    water_model: WaterModel = "auto"
    water_crs: str | None = None
    views_are: ViewsAre = "auto"
    check_depths: AnyPath | None = None
    port: Port | None = None
    adjusted_from: Cameras | AnyPath | None = None

    def __post_init__(self) -> None:
        """Check that the light bends somewhere, and at one place only."""
        if self.water is None and self.port is None:
            raise SettingError(
                "water is missing: give the water surface, or the port of a cloud that was taken"
                " under water."
            )
        if self.water is not None and self.port is not None:
            raise SettingError(
                "water and port exclude each other: a camera in a housing sees no water surface;"
                " leave out the water for a cloud that was taken under water, else the port."
            )

    def paths(self) -> list[AnyPath]:
        """Return what may be files, which no output may replace."""
        mask = None if self.water_mask is None else file_of(self.water_mask)
        water = file_of(self.water) if isinstance(self.water, str | PathLike) else None
        given = (self.cameras, water, self.sensor, self.views, mask, self.adjusted_from)
        moving = (self.tide, self.image_times, self.check_depths)
        return [one for one in (*given, *moving) if isinstance(one, str | PathLike)]

    def surface(self, view: CloudView | None = None) -> FoundSurface:
        """Return the water surface over a cloud; see `pcfix.flow.surfaces.find_surface`."""
        if self.water is None:
            raise SettingError("there is no water surface before a port.")
        return find_surface(WaterWords(self.water, self.water_model, self.water_crs), view)

    def level_offset_m(self, cameras: Cameras) -> FloatArray | None:
        """Return how much higher the water stood at each image, shape (k,), where it moved.

        Raises
        ------
        PcfixError
            If the tide or the times cannot be read, or do not cover the images.
        """
        if self.tide is None:
            if self.image_times is not None:
                raise SettingError("image-times is of no use without tide; give both, or neither.")
            return None
        from pcfix.io.tides import level_offsets, read_image_times, read_tide

        own = self.cameras if self.adjusted_from is None else self.adjusted_from
        given = own if self.image_times is None else self.image_times
        if isinstance(given, Cameras):
            raise SettingError("a tide needs image-times: when each image was taken.")
        times = read_image_times(given, cameras.labels)
        offset, notes = level_offsets(read_tide(self.tide), times, cameras.labels)
        for note in notes:
            warnings.warn(note, PcfixWarning, stacklevel=2)
        return offset

    def read(self) -> Cameras:
        """Return the cameras in the frame of their file."""
        if isinstance(self.cameras, Cameras):
            return self.cameras
        return read_cameras(self.cameras, self.sensor, angles=self.angles)

    def block(
        self, cloud_crs: str | CRS | None, read: Cameras | None = None
    ) -> tuple[Cameras, ViewList | None]:
        """Return the cameras in the cloud's CRS, and the view list where one was named.

        Parameters
        ----------
        cloud_crs : str, CRS or None
        read : Cameras, optional
            What `read` gave, where that was called before.

        Raises
        ------
        PcfixError
            If a file cannot be read or does not fit, or the CRS cannot be reconciled.
        """
        from pcfix.io.views import read_views, track_views

        if isinstance(self.cameras, Cameras):
            if self.views is None:
                return self.cameras, None
            return self.cameras, self._of_kind(read_views(self.views, self.cameras))
        read = self.read() if read is None else read
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
            tracks = track_views(Path(self.views), ties, cameras, to_cloud=way.points)
            return cameras, self._of_kind(tracks)
        return cameras, self._of_kind(read_views(self.views, cameras, to_cloud=way.points))

    def _of_kind(self, views: ViewList) -> ViewList:
        """Return a view list as what the user says that it is."""
        return views if self.views_are == "auto" else replace(views, kind=self.views_are)

    def tie_points(self, cloud_crs: str | CRS | None, *, placed: bool = True) -> TiePoints | None:
        """Return the tie points of the camera file in the cloud's CRS, where it has any.

        Some formats have their image places only; with `placed` these count as none.
        """
        if isinstance(self.cameras, Cameras):
            return None
        read = self.read()
        try:
            ties = read_tie_points(self.cameras, read)
        except InputError:
            return None
        known = np.isfinite(ties.xyz).all(axis=1)
        if placed and not known.any():
            return None
        way = georeference(
            read, cloud_crs, cameras_crs=self.cameras_crs, offset_m=self.cameras_offset_m,
            name=str(self.cameras),
        )  # fmt: skip
        xyz = np.full((len(ties.xyz), 3), np.nan)
        xyz[known] = way.points(ties.xyz[known])
        return replace(ties, xyz=xyz)


def mask_of(
    path: AnyPath | None, cloud_crs: str | CRS | None, low: FloatArray, high: FloatArray
) -> WaterMask | None:
    """Return the mask in the cloud's CRS, where a file was named, and warn of what was done to it.

    Parameters
    ----------
    path : path or None
        See `pcfix.io.vectors.read_water_polygons`.
    cloud_crs : str, CRS or None
    low, high : array, shape (2,)
        South-west and north-east corner of the cloud, metres.

    Raises
    ------
    InputError
        If it cannot be read, holds no polygon, or cannot be brought to the cloud's CRS.
    """
    if path is None:
        return None
    from pcfix.io.vectors import read_water_polygons
    from pcfix.label.areas import WaterMask

    polygons = read_water_polygons(path, cloud_crs)
    for note in polygons.notes:
        warnings.warn(note, PcfixWarning, stacklevel=2)
    return WaterMask(polygons.area, polygons.name, low, high, polygons.notes)


def file_of(path: AnyPath) -> Path:
    """Return a vector file, which may be named with a layer."""
    return Path(str(path).partition(LAYER_MARK)[0])


def classes_of(text: str | None) -> tuple[int, ...]:
    """Return the class numbers of ``2,5,6``.

    Raises
    ------
    SettingError
        If they are not whole numbers.
    """
    words = [] if text is None else text.split(",")
    try:
        return tuple(int(word) for word in words)
    except ValueError:
        raise SettingError(
            f"respect-classes '{text}' must be whole numbers with commas between, as 2,5,6."
        ) from None


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

"""What a correction is made with: from the words of its user to cameras, views and water."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError, NoTiePointsError, PcfixError, PcfixWarning, SettingError
from pcfix.flow.surfaces import CloudView, find_surface
from pcfix.io.cameras import read_cameras, read_tie_points
from pcfix.io.cameras.georeference import Georeference, georeference
from pcfix.io.vectors import LAYER_MARK
from pcfix.io.views import ViewList
from pcfix.label.areas import WaterMask
from pcfix.model import Cameras, FloatArray, TiePoints, ViewKind
from pcfix.options.declare import File, options_of
from pcfix.options.shared import InputOptions
from pcfix.port.shapes import port_of
from pcfix.water.surface import FoundSurface

if TYPE_CHECKING:
    from pyproj import CRS


TIMED = (".json", ".geojson")
"""Camera files that may say when each image was taken."""


@dataclass(frozen=True, kw_only=True)
class Inputs(InputOptions):
    """Cameras, view lists and water as the user names them, and how they are read.

    `cameras` and `adjusted_from` may be `pcfix.Cameras`, then in the cloud's CRS; `water` may be a
    `pcfix.WaterSurface`, `port` a `Port`. With `adjusted_from`, views, offset and CRS are told
    apart by `pcfix.flow.old_cameras`.
    """

    water_mask: File | None = None

    def check(self) -> None:
        """Check that the light bends somewhere, and at one place only."""
        super().check()
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
        if isinstance(self.port, str):
            object.__setattr__(self, "port", port_of(self.port))

    def paths(self) -> list[File]:
        """Return what may be files, which no output may replace."""
        return paths_in(self)

    def surface(self, view: CloudView | None = None) -> FoundSurface:
        """Return the water surface over a cloud; see `pcfix.flow.surfaces.find_surface`."""
        if self.water is None:
            raise SettingError("there is no water surface before a port.")
        return find_surface(self.water, self, view)

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

    def dates(self, cameras: Cameras) -> str:
        """Return the first and last day of the images; empty where it is not known."""
        from pcfix.io.tides import read_image_times

        given = self.image_times or self.adjusted_from or self.cameras
        if self.image_times is None and Path(str(given)).suffix.lower() not in TIMED:
            return ""
        try:
            days = read_image_times(given, cameras.labels).time_s.astype("datetime64[s]")
        except PcfixError:  # the correction is done without them
            return ""
        first, last = (str(day.astype("datetime64[D]")) for day in (days.min(), days.max()))
        return first if first == last else f"{first} to {last}"

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
        way = self._georeferenced(read, cloud_crs)
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

    def _georeferenced(self, read: Cameras, cloud_crs: str | CRS | None) -> Georeference:
        """Return the way from the frame of the camera file to the cloud's CRS."""
        return georeference(
            read, cloud_crs, cameras_crs=self.cameras_crs, offset_m=self.cameras_offset,
            name=str(self.cameras),
        )  # fmt: skip

    def _of_kind(self, views: ViewList) -> ViewList:
        """Return a view list as what the user says that it is."""
        kind: ViewKind = views.kind
        if self.views_are != "auto":
            kind = "pair-images" if self.views_are == "pairs" else self.views_are
        return replace(views, kind=kind)

    def tie_points(self, cloud_crs: str | CRS | None, *, placed: bool = True) -> TiePoints | None:
        """Return the tie points of the camera file in the cloud's CRS, where it has any.

        Some formats have their image places only; with `placed` these count as none.
        """
        if isinstance(self.cameras, Cameras):
            return None
        read = self.read()
        try:
            ties = read_tie_points(self.cameras, read)
        except NoTiePointsError:
            return None
        except InputError as error:
            warnings.warn(f"{error} Its tie points are left out.", PcfixWarning, stacklevel=2)
            return None
        known = np.isfinite(ties.xyz).all(axis=1)
        if placed and not known.any():
            return None
        way = self._georeferenced(read, cloud_crs)
        xyz = np.full((len(ties.xyz), 3), np.nan)
        xyz[known] = way.points(ties.xyz[known])
        return replace(ties, xyz=xyz)


def mask_of(
    path: File | None, cloud_crs: str | CRS | None, low: FloatArray, high: FloatArray
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

    polygons = read_water_polygons(path, cloud_crs)
    for note in polygons.notes:
        warnings.warn(note, PcfixWarning, stacklevel=2)
    return WaterMask(polygons.area, polygons.name, low, high, polygons.notes)


NO_FILES = ("port", "water_model", "water_crs", "views_are", "angles", "cameras_crs")


def paths_in(options: Any, but: tuple[str, ...] = ()) -> list[File]:
    """Return what among the options of a command, `but` some, may be files that it reads.

    A vector file may be named with a layer, which is left out.
    """
    names = [one.name for one in options_of(InputOptions)] + ["water_mask", "water_per_image"]
    given = [getattr(options, name, None) for name in names if name not in (*NO_FILES, *but)]
    paths = [str(one) for one in given if isinstance(one, str | PathLike)]
    return [Path(path.partition(LAYER_MARK)[0]) for path in paths]

"""Read the inputs of a correction: cameras, view list, water, tide and mask."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import replace
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
from pcfix.label.labelling import Labelling
from pcfix.model import Cameras, FloatArray, TiePoints, ViewKind
from pcfix.options.correct import LabelRules
from pcfix.options.declare import File, options_of
from pcfix.options.shared import InputOptions
from pcfix.port.shapes import port_of
from pcfix.water.surface import FoundSurface

if TYPE_CHECKING:
    from pyproj import CRS


TIMED = (".json", ".geojson")
"""Camera files that may hold the time of each image."""


class Inputs(InputOptions):
    """Cameras, view list and water as the user gives them.

    `cameras` and `adjusted_from` may be `pcfix.Cameras`, then in the cloud's CRS; `water` may be a
    `pcfix.WaterSurface`, `port` a `Port`. `pcfix.flow.old_cameras` decides whether views, offset
    and CRS belong to `cameras` or `adjusted_from`.
    """

    water_mask: File | None = None

    def check(self) -> None:
        """Check that there is either a water surface or a housing port."""
        super().check()
        if self.water is None and self.port is None:
            raise SettingError(
                "water.missing",
                "water is missing: give the water surface, or the port of an underwater camera.",
            )
        if self.water is not None and self.port is not None:
            raise SettingError(
                "option.conflict",
                "water and port exclude each other: give the port for images taken under water,"
                " the water for images taken through it.",
                options=["water", "port"],
            )
        if isinstance(self.port, str):
            object.__setattr__(self, "port", port_of(self.port))

    def paths(self) -> list[File]:
        """Return the options that may be files, which no output may replace."""
        return paths_in(self)

    def surface(self, view: CloudView | None = None) -> FoundSurface:
        """Return the water surface over a cloud; see `pcfix.flow.surfaces.find_surface`."""
        if self.water is None:
            raise SettingError("water.missing", "there is no water surface in front of a port.")
        return find_surface(self.water, self, view)

    def level_offset_m(self, cameras: Cameras) -> FloatArray | None:
        """Return how much higher than on average the water stood at each image, shape (k,)."""
        if self.tide is None:
            if self.image_times is not None:
                sentence = "image-times needs tide: give both, or neither."
                raise SettingError("option.needs", sentence, options=["image_times", "tide"])
            return None
        from pcfix.io.tides import level_offsets, read_image_times, read_tide

        own = self.cameras if self.adjusted_from is None else self.adjusted_from
        given = own if self.image_times is None else self.image_times
        if isinstance(given, Cameras):
            sentence = "tide needs image-times, the time of each image."
            raise SettingError("option.needs", sentence, options=["tide", "image_times"])
        times = read_image_times(given, cameras.labels)
        offset, notes = level_offsets(read_tide(self.tide), times, cameras.labels)
        _warn(notes)
        return offset

    def dates(self, cameras: Cameras) -> str:
        """Return the first and last day of the images; empty if unknown."""
        from pcfix.io.tides import read_image_times

        given = self.image_times or self.adjusted_from or self.cameras
        if self.image_times is None and Path(str(given)).suffix.lower() not in TIMED:
            return ""
        try:
            days = read_image_times(given, cameras.labels).time_s.astype("datetime64[s]")
        except PcfixError:  # only the report shows them
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
        """Return the cameras in the cloud's CRS, and the view list if one is given.

        `read` are the cameras in the frame of their file, if they were read before.
        """
        from pcfix.io.views import read_views, track_views

        if isinstance(self.cameras, Cameras):
            cameras, to_cloud = self.cameras, None
        else:
            read = self.read() if read is None else read
            way = self._georeferenced(read, cloud_crs)
            cameras, to_cloud = way.cameras(read), way.points
            _warn(way.notes)
        if self.views is None:
            return cameras, None
        if read is not None and Path(self.views) == Path(str(self.cameras)):
            ties = read_tie_points(self.views, read)
            views = track_views(Path(self.views), ties, cameras, to_cloud=to_cloud)
        else:
            views = read_views(self.views, cameras, to_cloud=to_cloud)
        if self.views_are == "auto":
            return cameras, views
        kind: ViewKind = "pair-images" if self.views_are == "pairs" else self.views_are
        return cameras, replace(views, kind=kind)

    def _georeferenced(self, read: Cameras, cloud_crs: str | CRS | None) -> Georeference:
        """Return the transformation from the frame of the camera file to the cloud's CRS."""
        return georeference(
            read, cloud_crs, cameras_crs=self.cameras_crs, offset_m=self.cameras_offset,
            name=str(self.cameras),
        )  # fmt: skip

    def tie_points(self, cloud_crs: str | CRS | None, *, placed: bool = True) -> TiePoints | None:
        """Return the tie points of the camera file in the cloud's CRS, if it has any.

        Some formats have image coordinates only; with `placed` these count as none.
        """
        if isinstance(self.cameras, Cameras):
            return None
        read = self.read()
        try:
            ties = read_tie_points(self.cameras, read)
        except NoTiePointsError:
            return None
        except InputError as error:
            sentence = f"{error} Its tie points are ignored."
            warnings.warn(PcfixWarning("cameras.tie_points", sentence), stacklevel=2)
            return None
        known = np.isfinite(ties.xyz).all(axis=1)
        if placed and not known.any():
            return None
        way = self._georeferenced(read, cloud_crs)
        xyz = np.full((len(ties.xyz), 3), np.nan)
        xyz[known] = way.points(ties.xyz[known])
        return replace(ties, xyz=xyz)


def mask_of(path: File | None, cloud_crs: str | CRS | None) -> WaterMask | None:
    """Read the mask in the cloud's CRS, if a file is given."""
    if path is None:
        return None
    from pcfix.io.vectors import read_water_polygons

    polygons = read_water_polygons(path, cloud_crs)
    _warn(polygons.notes)
    return WaterMask(polygons.area, polygons.name, tuple(map(str, polygons.notes)))


def labelling_of(options: Any, view: CloudView) -> Labelling:
    """Return the rules by which points count as submerged, with the mask in the cloud's CRS."""
    mask = mask_of(options.water_mask, view.crs)
    return Labelling(options.part(LabelRules), mask)


def _warn(notes: Iterable[str | PcfixWarning]) -> None:
    for note in notes:
        warnings.warn(note, PcfixWarning, stacklevel=3)


NO_FILES = ("port", "water_model", "water_crs", "views_are", "angles", "cameras_crs")


def paths_in(options: Any, but: tuple[str, ...] = ()) -> list[File]:
    """Return the options of a command, except `but`, that may be files that it reads.

    The layer of a vector file is removed.
    """
    names = [one.name for one in options_of(InputOptions)] + ["water_mask", "water_per_image"]
    given = [getattr(options, name, None) for name in names if name not in (*NO_FILES, *but)]
    paths = [str(one) for one in given if isinstance(one, str | PathLike)]
    return [Path(path.partition(LAYER_MARK)[0]) for path in paths]

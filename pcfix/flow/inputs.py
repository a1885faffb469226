"""Read the inputs of a correction: cameras, view list, water, tide and mask.

A cloud may be corrected with adjusted poses: `adjusted_from` is the original camera file, and
`cameras` has the same images with adjusted poses.
"""

import warnings
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.adjust.transfer import CloudTransfer, transfer_of
from pcfix.errors import GeometryError, InputError, NoTiePointsError, PcfixWarning, SettingError
from pcfix.flow.surfaces import CloudView, find_surface
from pcfix.io.cameras import read_cameras, read_tie_points, takes_sensor
from pcfix.io.cameras.georeference import Georeference, georeference
from pcfix.io.crs import LOCAL
from pcfix.io.photographs import read_image_times
from pcfix.io.tables import match_labels
from pcfix.io.vectors import LAYER_MARK, read_water_polygons
from pcfix.io.views import ViewList, ViewMatch, read_views, track_views
from pcfix.io.water import level_offsets, read_tide
from pcfix.model import NO_CAMERAS, Cameras, FloatArray, IntArray, TiePoints, Views
from pcfix.options.declare import File, OptionSet, options_of
from pcfix.options.shared import InputOptions, LandRules, MaskOption
from pcfix.points.labelling import Labelling, WaterMask
from pcfix.port.housing import port_of
from pcfix.water.surface import FoundSurface

if TYPE_CHECKING:
    from pyproj import CRS


class Inputs(MaskOption, InputOptions):
    """Cameras, view list and water as the user gives them.

    `cameras` and `adjusted_from` may be `pcfix.Cameras` in the CRS of the cloud, `water` a
    `pcfix.WaterSurface`, and `port` a `Port`. `both_models` decides whether views, offset and CRS
    belong to `cameras` or to `adjusted_from`.
    """

    def check(self) -> None:
        """Refuse a water surface together with a housing port."""
        super().check()
        if self.water is not None and self.port is not None:
            raise SettingError(
                "option.conflict",
                "water and port exclude each other: give the port for images taken under water,"
                " the water for images taken through it.",
                options=["water", "port"],
            )
        if isinstance(self.port, str):
            object.__setattr__(self, "port", port_of(self.port))

    def surface(self, view: CloudView | None = None) -> FoundSurface:
        """Return the water surface over a cloud; see `pcfix.flow.surfaces.find_surface`."""
        if self.water is None:
            raise SettingError(
                "water.missing",
                "water is missing: give the water surface, or the port of an underwater camera.",
            )
        return find_surface(self.water, self, view)

    def level_offset_m(self, cameras: Cameras) -> FloatArray | None:
        """Return the water level at each image minus the mean level, shape (k,)."""
        if self.tide is None:
            return None
        given = self.image_times or self.adjusted_from or self.cameras
        if isinstance(given, Cameras):
            sentence = "tide needs image-times, the time of each image."
            raise SettingError("option.needs", sentence, options=["tide", "image_times"])
        times = read_image_times(given, cameras.labels)
        return level_offsets(*read_tide(self.tide), times, cameras.labels)

    def read(self) -> Cameras:
        """Return the cameras in the frame of their file."""
        if isinstance(self.cameras, Cameras):
            return self.cameras
        return read_cameras(self.cameras, self.sensor, angles=self.angles)

    def block(
        self, cloud_crs: "str | CRS | None", read: Cameras | None = None
    ) -> tuple[Cameras, ViewList | None]:
        """Return the cameras in the cloud's CRS, and the view list if one is given.

        `read` are the cameras in the frame of their file, if they were read before.
        """
        if isinstance(self.cameras, Cameras):
            cameras, to_cloud = self.cameras, None
        else:
            read = self.read() if read is None else read
            placement = self._georeferenced(read, cloud_crs)
            cameras, to_cloud = placement.cameras(read), placement.points
            for note in placement.notes:
                warnings.warn(note, stacklevel=2)
        if self.views is None:
            return cameras, None
        if read is not None and Path(self.views) == Path(str(self.cameras)):
            ties = read_tie_points(self.views, read)
            views = track_views(Path(self.views), ties, cameras, to_cloud=to_cloud)
        else:
            views = read_views(self.views, cameras, to_cloud=to_cloud)
        if self.views_are == "auto":
            return cameras, views
        return cameras, replace(views, listed=replace(views.listed, kind=self.views_are))

    def _georeferenced(self, read: Cameras, cloud_crs: "str | CRS | None") -> Georeference:
        """Return the transformation from the frame of the camera file to the cloud's CRS."""
        return georeference(
            read, cloud_crs, cameras_crs=self.cameras_crs, offset_m=self.cameras_offset,
            name=str(self.cameras),
        )  # fmt: skip

    def tie_points(self, cloud_crs: "str | CRS | None", *, placed: bool = True) -> TiePoints | None:
        """Return the tie points of the camera file in the cloud's CRS, if it has any.

        Some formats have image coordinates only; with `placed` these count as none.
        """
        if isinstance(self.cameras, Cameras):
            return None
        with warnings.catch_warnings(action="ignore", category=PcfixWarning):
            read = self.read()  # again: its warnings were shown
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
        xyz = np.full((len(ties.xyz), 3), np.nan)
        xyz[known] = self._georeferenced(read, cloud_crs).points(ties.xyz[known])
        return replace(ties, xyz=xyz)


class CameraInputs(NamedTuple):
    """The k cameras of a correction, in the cloud's CRS, and what refers to them."""

    cameras: Cameras  # for the correction; `NO_CAMERAS` if there are none
    views: Views | None = None  # the view list, with rows of the original cameras
    match: ViewMatch | None = None  # gives the view list of a file to the points of the cloud
    transfer: CloudTransfer | None = None  # from the original to the adjusted cameras
    level_offset_m: FloatArray | None = None  # (k,), how much higher the water stood per image


def read_blocks(inputs: Inputs, view: CloudView) -> CameraInputs:
    """Return cameras in the cloud's CRS and the view list, matched with the original cameras."""
    if not inputs.cameras:
        return CameraInputs(NO_CAMERAS)
    if inputs.adjusted_from is None:
        cameras, listed = inputs.block(view.crs)
        original, transfer = cameras, None
    else:
        of_original, of_adjusted = both_models(inputs)
        cameras, _ = of_adjusted.block(view.crs)
        original, listed = of_original.block(view.crs)
        for one, option in ((original, "adjusted-from"), (cameras, "cameras")):
            if one.rotations is None or one.lenses is None:
                missing = "angles" if one.rotations is None else "lens"
                words = f"--{option}: has no {missing}, without which points have no image. Give"
                words += " the model itself, or --sensor."
                raise SettingError(f"cameras.no_{missing}", words, option=option)
        transfer = transfer_of(original, cameras, _rows(original.labels, cameras.labels))
    if listed is None:
        return CameraInputs(cameras, transfer=transfer)
    match = ViewMatch(listed, original, points=view.points, step_m=view.step_m)
    return CameraInputs(cameras, listed.listed, match, transfer)


def both_models(inputs: Inputs) -> tuple[Inputs, Inputs]:
    """Return the inputs with the original cameras, and those with the adjusted ones.

    The options for CRS and offset apply to the file that states no CRS, or to both if both do. If
    neither does, the offset is applied so that the two files agree best.
    """
    listed, path, old = (
        None if one is None or isinstance(one, Cameras) else Path(one)
        for one in (inputs.views, inputs.cameras, inputs.adjusted_from)
    )
    if listed is not None and listed == path != old:
        words = (
            f"--views: the tie points of {path} are adjusted ones, not those of the cloud. Give"
            " the model of --adjusted-from, or the view list of the cloud."
        )
        raise SettingError("views.adjusted", words, path=path)
    both = [
        replace(inputs, cameras=inputs.adjusted_from, adjusted_from=None),
        replace(inputs, views=None, adjusted_from=None),
    ]
    tables = [not isinstance(one.cameras, Cameras) and takes_sensor(one.cameras) for one in both]
    if inputs.sensor is not None and any(tables):  # a model contains its lens
        both = _for_some(both, tables, "sensor")
    if inputs.cameras_crs is None and inputs.cameras_offset is None:
        return both[0], both[1]
    original, adjusted = read = [one.read() for one in both]
    is_local = [
        not isinstance(one.cameras, Cameras) and cameras.crs in (None, LOCAL)
        for one, cameras in zip(both, read, strict=True)
    ]
    if any(is_local) and not all(is_local):
        both = _for_some(both, is_local, "cameras_crs", "cameras_offset")
    elif inputs.cameras_offset is not None and all(is_local):
        # It is unknown which of the two files is shifted: try the offset on both, and on either.
        difference = adjusted.centres - original.centres[_rows(original.labels, adjusted.labels)]
        offset = np.array(inputs.cameras_offset)
        moves = {
            (True, True): difference,
            (True, False): difference - offset,
            (False, True): difference + offset,
        }
        best = min(moves, key=lambda one: np.median(np.linalg.norm(moves[one], axis=1)))
        both = _for_some(both, best, "cameras_offset")
    return both[0], both[1]


def _for_some(both: list[Inputs], which: Iterable[bool], *names: str) -> list[Inputs]:
    """Return the inputs, with the options of these names only for some of the two."""
    nothing: dict[str, Any] = dict.fromkeys(names)
    return [one if it else replace(one, **nothing) for one, it in zip(both, which, strict=True)]


def _rows(original: tuple[str, ...], adjusted: tuple[str, ...]) -> IntArray:
    """Return the row in the original labels of each adjusted one."""
    if original == adjusted:  # in the same order, even repeated names are unambiguous
        return np.arange(len(adjusted))
    row, unclear = match_labels(adjusted, original)
    repeated = [label for label, count in Counter(adjusted).items() if count > 1]
    if ambiguous := [*repeated, *unclear]:
        words = (
            f"--adjusted-from: image name {ambiguous[0]} is ambiguous. Give every image a unique"
            " name."
        )
        raise GeometryError("adjusted_from.ambiguous", words, image=ambiguous[0])
    if (row < 0).any():
        unknown = [label for label, at in zip(adjusted, row, strict=True) if at < 0]
        words = (
            f"--adjusted-from: has no image {unknown[0]} ({len(unknown)} of {len(adjusted)} images"
            f" of the cameras are missing; its first is {original[0]}). Give the model from which"
            " the cameras were adjusted."
        )
        raise GeometryError("adjusted_from.no_image", words, image=unknown[0], missing=len(unknown))
    return row


def mask_of(path: File | None, cloud_crs: "str | CRS | None") -> WaterMask | None:
    """Read the mask in the cloud's CRS, if a file is given."""
    if path is None:
        return None
    polygons = read_water_polygons(path, cloud_crs)
    return WaterMask(polygons.geometries[0], polygons.name)


def labelling_of(options: Any, view: CloudView) -> Labelling:
    """Return the rules by which points count as submerged, with the mask in the cloud's CRS."""
    return Labelling(options.part(LandRules), mask_of(options.water_mask, view.crs))


def paths_in(options: OptionSet, but: tuple[str, ...] = ()) -> list[Path]:
    """Return the input files that the options of a command name, except the options `but`.

    The layer of a vector file is removed.
    """
    named = [
        getattr(options, one.name)
        for one in options_of(type(options))
        if (one.is_path or one.name == "water") and not one.writes and one.name not in but
    ]
    paths = [str(one) for one in named if isinstance(one, str | PathLike)]
    return [Path(path.partition(LAYER_MARK)[0]) for path in paths]

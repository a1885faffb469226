"""The camera models of OpenSfM as a Lens in pixels, and a block written with them.

Image coordinates are divided by the larger side of the image, the origin is its centre, x right
and y down; so are `focal`, `focal_x`, `focal_y`, `c_x` and `c_y`. The tangential terms follow
OpenCV (p1 with 2 x y in x). Distortion acts on the projected coordinates, which are angles for
the fisheye models.

OpenSfM's world is topocentric. Cameras in a projected CRS are taken to the axes east, north, up at
the middle of the block, at height 0, by the inverse of what `georeference` does on reading: centres
and tie points through PROJ, rotations by the turn of the axes at their own centre. Heights are
taken as ellipsoidal where the CRS does not say what they are, as the reader takes them back.
Cameras in no CRS keep their numbers, and no reference is written. The file of tracks is of version
2: image, track, feature, x, y, scale, red, green, blue, segmentation, instance.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import is_same_lens, json_number
from pcfix.io.cameras.frames import frame_of, is_tied
from pcfix.io.cameras.georeference import georeference
from pcfix.io.crs import (
    GEOCENTRIC_WGS84,
    GEOGRAPHIC_WGS84,
    Topocentric,
    heights_of,
    is_topocentric,
    parse_crs,
    shortened,
)
from pcfix.io.files import check_output, write_text
from pcfix.io.transformations import transformation_in_plan, transformation_in_space
from pcfix.model import Cameras, FloatArray, IntArray, Lens, Projection, TiePoints

PANORAMAS = frozenset({"equirectangular", "spherical"})

_MODELS: dict[str, tuple[Projection, int]] = {
    "perspective": ("perspective", 2),
    "simple_radial": ("perspective", 1),
    "radial": ("perspective", 2),
    "brown": ("perspective", 3),
    "fisheye": ("equidistant", 2),
    "fisheye_opencv": ("equidistant", 4),
    "fisheye62": ("equidistant", 6),
    "fisheye624": ("equidistant", 6),
    "dual": ("dual", 2),
}
_TANGENTIAL = frozenset({"brown", "fisheye62", "fisheye624"})
_SIZE = re.compile(r" (\d{2,6}) (\d{2,6}) [a-z_]+\d* ")


def is_panorama(camera: dict[str, Any]) -> bool:
    """Whether a camera sees all around, which no plane image with a frame can hold."""
    return str(camera.get("projection_type")) in PANORAMAS


def lens(path: Path, name: str, camera: dict[str, Any]) -> Lens:
    """Return the lens of an entry of `cameras`."""
    model = str(camera.get("projection_type", "perspective"))
    if model not in _MODELS:
        raise InputError(
            f"{path}: camera {name}: the projection_type '{model}' is none that pcfix knows"
            f" ({', '.join(_MODELS)})."
        )
    projection, radial = _MODELS[model]
    width, height = _size(path, name, camera)
    scale = max(width, height)
    fx, fy = _focal(path, name, camera)
    cx, cy, p1, p2, *prism = (
        _value(path, name, camera, key)
        for key in ("c_x", "c_y", "p1", "p2", "s0", "s1", "s2", "s3")
    )
    return checks.lens(
        path,
        name,
        Lens(
            focal=fy * scale,
            width=width,
            height=height,
            principal_x=width / 2.0 + cx * scale,
            principal_y=height / 2.0 + cy * scale,
            b1=(fx - fy) * scale,
            projection=projection,
            shape=(_value(path, name, camera, "transition", 0.5),) if model == "dual" else (),
            radial=tuple(_value(path, name, camera, f"k{i + 1}") for i in range(radial)),
            tangential=(p2, p1) if model in _TANGENTIAL else (),
            thin_prism=tuple(prism) if model == "fisheye624" else (),
            sensor=name,
        ),
    )


def _value(
    path: Path, name: str, camera: dict[str, Any], key: str, default: float | None = 0.0
) -> float:
    value = camera.get(key, default)
    if value is None:
        raise InputError(f"{path}: camera {name} lacks {key}.")
    return json_number(path, f"camera {name}, {key}", value)


def _focal(path: Path, name: str, camera: dict[str, Any]) -> tuple[float, float]:
    """Return both focal lengths; models of one focal length have `focal`."""
    if "focal_x" not in camera:
        focal = _value(path, name, camera, "focal", None)
        return focal, focal
    fx = _value(path, name, camera, "focal_x")
    return fx, _value(path, name, camera, "focal_y", fx)


def _size(path: Path, name: str, camera: dict[str, Any]) -> tuple[float, float]:
    """Return width and height; old files have them only in the name of the camera."""
    width, height = (_value(path, name, camera, key) for key in ("width", "height"))
    named = _SIZE.search(name)
    if not (width and height) and named:
        width, height = float(named[1]), float(named[2])
    if not (width and height):
        raise InputError(
            f"{path}: camera {name}: the size of its images is missing; write their width and"
            " height in pixels into this camera's entry."
        )
    return width, height


TRACKS_HEADER = "OPENSFM_TRACKS_VERSION_v2"
GREY = (128, 128, 128)
FEATURE_SCALE = 0.001
"""Of a feature, in units of the larger side; OpenSfM wants some number."""


class World(NamedTuple):
    """A block in the world of the file; `place` is the origin, None where there is none."""

    centres: FloatArray
    rotations: FloatArray
    points: FloatArray
    place: Topocentric | None


def write_opensfm(
    path: str | os.PathLike[str],
    cameras: Cameras,
    tie_points: TiePoints | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a block as an OpenSfM reconstruction.

    Parameters
    ----------
    path : path
        Of the reconstruction, usually ``reconstruction.json``; ``tracks.csv`` (with tie points)
        and ``reference_lla.json`` (with a CRS) go beside it.
    cameras : Cameras
        With rotations, lenses in pixels, and labels that are all different; in a projected CRS,
        topocentric, or in none.
    tie_points : TiePoints, optional
        In the frame of the cameras; those without a position or without a view are left out.
    overwrite : bool

    Raises
    ------
    InputError
        If a lens is none that OpenSfM has, labels repeat, or the CRS cannot be left.
    SettingError
        If a file exists and `overwrite` is not set.
    """
    target = Path(path)
    _check_whole(target, cameras)
    models = {each: opensfm_camera(target, each) for each in dict.fromkeys(cameras.lenses or ())}
    names = {each: f"pcfix {i}" for i, each in enumerate(models, start=1)}
    xyz = np.empty((0, 3)) if tie_points is None else tie_points.xyz
    kept = _kept(tie_points)
    world = _world(cameras, xyz[kept], str(target))
    chosen: dict[str, Any] = {
        "cameras": {names[each]: model for each, model in models.items()},
        "shots": _shots(cameras, world, names),
        "points": {
            str(i): {"color": list(GREY), "coordinates": row}
            for i, row in enumerate(world.points.tolist())
        },
    }
    texts = {}
    if world.place is not None:
        place = world.place
        lla = (place.latitude_deg, place.longitude_deg, place.height_m)
        chosen["reference_lla"] = dict(zip(("latitude", "longitude", "altitude"), lla, strict=True))
        texts["reference_lla.json"] = json.dumps(chosen["reference_lla"], indent=2) + "\n"
    if tie_points is not None:
        texts["tracks.csv"] = "\n".join(_tracks(cameras, tie_points, kept)) + "\n"
    texts[target.name] = json.dumps([chosen]) + "\n"
    for name in texts:
        check_output(target.with_name(name), overwrite=overwrite)
    for name, text in texts.items():
        write_text(target.with_name(name), text, overwrite=overwrite)


def _check_whole(target: Path, cameras: Cameras) -> None:
    """Refuse a block without rotations or lenses, and names that are no keys."""
    if cameras.rotations is None or cameras.lenses is None:
        raise InputError(f"{target}: a reconstruction needs rotations and lenses of all images.")
    if len(set(cameras.labels)) < len(cameras):
        raise InputError(
            f"{target}: images are keys in OpenSfM's files, and"
            f" {len(cameras) - len(set(cameras.labels))} names occur again; take another form."
        )
    for label in cameras.labels:
        if "\t" in label or "\n" in label:
            raise InputError(f"{target}: the image name {label!r} has no place in OpenSfM's files.")


def _kept(tie_points: TiePoints | None) -> IntArray:
    """Return the rows of tie points that have a place and a view."""
    if tie_points is None:
        return np.empty(0, np.int64)
    seen = np.diff(tie_points.views.start) > 0
    return np.flatnonzero(np.isfinite(tie_points.xyz).all(axis=1) & seen)


def opensfm_camera(path: Path, given: Lens) -> dict[str, Any]:
    """Return the simplest entry of `cameras` that is exactly this lens."""
    if given.unit == "px":
        for camera in _candidates(given):
            if is_same_lens(lens(path, "1", camera), given):
                return camera
    raise InputError(
        f"{path}: OpenSfM has no camera model that holds the lens {given.sensor or 'of the images'}"
        f" ({given.projection} in {given.unit}) exactly, so no reconstruction is written; take"
        " another form."
    )


def _candidates(given: Lens) -> Iterator[dict[str, Any]]:
    """Yield the entries that may be the lens, the simplest first."""
    scale = max(given.width, given.height)
    radial = {f"k{i + 1}": value for i, value in enumerate((*given.radial, *(0.0,) * 6)[:6])}
    p2, p1 = (*given.tangential, 0.0, 0.0)[:2]
    one = {"focal": given.focal / scale}
    two: dict[str, Any] = {
        "focal_x": (given.focal + given.b1) / scale,
        "focal_y": given.focal / scale,
        "c_x": (given.principal_x - given.width / 2.0) / scale,
        "c_y": (given.principal_y - given.height / 2.0) / scale,
    }
    bent = {"p1": p1, "p2": p2}
    prism = {f"s{i}": value for i, value in enumerate((*given.thin_prism, *(0.0,) * 4)[:4])}
    for projection, model, more, count in (
        ("perspective", "perspective", one, 2),
        ("perspective", "brown", two | bent, 3),
        ("equidistant", "fisheye", one, 2),
        ("equidistant", "fisheye_opencv", two, 4),
        ("equidistant", "fisheye62", two | bent, 6),
        ("equidistant", "fisheye624", two | bent | prism, 6),
        ("dual", "dual", one | {"transition": given.shape[0] if given.shape else 0.5}, 2),
    ):
        if projection == given.projection:
            yield {
                "projection_type": model,
                "width": int(given.width),
                "height": int(given.height),
                **more,
                **dict(list(radial.items())[:count]),
            }


def _world(cameras: Cameras, points: FloatArray, name: str) -> World:
    """Return the block in the world of the file."""
    rotations = np.asarray(cameras.rotations)
    if cameras.crs is None or not is_tied(cameras.crs, name):
        return World(cameras.centres, rotations, points, None)
    if is_topocentric(cameras.crs):
        place = Topocentric.from_text(cameras.crs, name)
        return World(cameras.centres, rotations, points, place)
    if not parse_crs(cameras.crs, name).is_projected:
        raise InputError(
            f"{name}: the cameras are in {shortened(cameras.crs)}; bring them to a projected CRS"
            " first."
        )
    enter = _Entry(cameras, name)
    centres = enter.points(cameras.centres)
    there = replace(cameras, centres=centres, crs=enter.text, project_crs=None, gnss=None)
    turns = georeference(there, cameras.crs, name=name).turns(centres)
    return World(centres, rotations @ turns, enter.points(points), enter.place)


class _Entry:
    """The way from a projected CRS to axes east, north, up at the middle of a block."""

    def __init__(self, cameras: Cameras, name: str) -> None:
        source = frame_of(cameras.crs or "", name).crs
        geographic = parse_crs(GEOGRAPHIC_WGS84, name)
        stated = heights_of(source) != "unstated"
        way = transformation_in_space if stated else transformation_in_plan
        self._to_degrees = way(source, geographic, cameras.centres, name).forward
        degrees = self._to_degrees(np.median(cameras.centres, axis=0)[None])[0]
        self.place = Topocentric(float(degrees[1]), float(degrees[0]), 0.0)
        place = (self.place.latitude_deg, self.place.longitude_deg, self.place.height_m)
        self.text = "ENU:" + ",".join(map(repr, place))

    def points(self, xyz: FloatArray) -> FloatArray:
        """Return points (n, 3) there, metres."""
        from pyproj import Transformer

        to_geocentric = Transformer.from_crs(GEOGRAPHIC_WGS84, GEOCENTRIC_WGS84, always_xy=True)
        to_axes = Transformer.from_pipeline(
            f"+proj=topocentric +ellps=WGS84 +lat_0={self.place.latitude_deg!r}"
            f" +lon_0={self.place.longitude_deg!r} +h_0={self.place.height_m!r}"
        )
        geocentric = to_geocentric.transform(*self._to_degrees(xyz).T)
        return np.column_stack(to_axes.transform(*geocentric))


def _shots(cameras: Cameras, world: World, names: dict[Lens, str]) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(world.rotations).as_rotvec().tolist()
    shifts = -np.einsum("kij,kj->ki", world.rotations, world.centres)
    return {
        label: {"rotation": turn, "translation": shift, "camera": names[lens]}
        for label, turn, shift, lens in zip(
            cameras.labels, turns, shifts.tolist(), cameras.lenses or (), strict=True
        )
    }


def _tracks(cameras: Cameras, tie_points: TiePoints, kept: IntArray) -> Iterator[str]:
    """Yield the lines of tracks.csv; features count from 0 in each image."""
    views = tie_points.views
    size = np.array([(lens.width, lens.height) for lens in cameras.lenses or ()])[views.camera]
    xy = (tie_points.image_xy - size / 2.0) / size.max(axis=1, initial=1.0)[:, None]
    feature = np.zeros(len(cameras), np.int64)
    rest = "\t".join(map(str, (FEATURE_SCALE, *GREY, -1, -1)))
    yield TRACKS_HEADER
    for track, row in enumerate(kept.tolist()):
        for i in range(views.start[row], views.start[row + 1]):
            camera = views.camera[i]
            x, y = xy[i].tolist()
            yield f"{cameras.labels[camera]}\t{track}\t{feature[camera]}\t{x!r}\t{y!r}\t{rest}"
            feature[camera] += 1

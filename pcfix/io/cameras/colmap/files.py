"""COLMAP's files, and its camera models with the lens that each one is.

Binary files are little-endian, with counts before lists and names that end with a zero byte; text
files have a line per camera and point, two per image, and ``#`` before comments.

The parameters are those of COLMAP's own list, in its order (https://colmap.github.io/cameras.html
and, for models that are not there yet, ``src/colmap/sensor/models`` of COLMAP 4). The image's
origin is the upper left corner of the upper left pixel, as in `pcfix.model.Lens`, so principal
points are taken as they are. p1 and p2 are in OpenCV's order, except in the model of Project
Aria's cameras (RAD_TAN_THIN_PRISM_FISHEYE), where they are in Brown's, and where the tangential
and prism terms are of the radially distorted place.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.checks import damaged, reading, terms, unsupported
from pcfix.model import FloatArray, IntArray, Lens, Projection

_SMALLEST_OMEGA = 1e-6
"""Below, in radians, the FOV model is a perspective one to double precision."""
SHAPES = {"fov": ("omega",), "division": ("k",), "eucm": ("alpha", "beta")}
"""COLMAP's names of the parameters of a projection."""


_TWELVE = "fx fy cx cy k1 k2 k3 k4 k5 k6 p2 p1 s1 s2 s3 s4"
_TABLE: tuple[tuple[str, str, Projection | None], ...] = (
    ("SIMPLE_PINHOLE", "f cx cy", "perspective"),
    ("PINHOLE", "fx fy cx cy", "perspective"),
    ("SIMPLE_RADIAL", "f cx cy k1", "perspective"),
    ("RADIAL", "f cx cy k1 k2", "perspective"),
    ("OPENCV", "fx fy cx cy k1 k2 p1 p2", "perspective"),
    ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4", "equidistant"),
    ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3", "perspective"),
    ("FOV", "fx fy cx cy omega", "fov"),
    ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1", "equidistant"),
    ("RADIAL_FISHEYE", "f cx cy k1 k2", "equidistant"),
    ("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s3", "equidistant"),
    ("RAD_TAN_THIN_PRISM_FISHEYE", _TWELVE, "equidistant"),
    ("SIMPLE_DIVISION", "f cx cy k", "division"),
    ("DIVISION", "fx fy cx cy k", "division"),
    ("SIMPLE_FISHEYE", "f cx cy", "equidistant"),
    ("FISHEYE", "fx fy cx cy", "equidistant"),
    ("EUCM", "fx fy cx cy alpha beta", "eucm"),
    ("EQUIRECTANGULAR", "w h", None),
)
"""In the order of their numbers in binary files, from 0."""
MODELS = tuple(name for name, _, _ in _TABLE)
BY_NAME = {name: (tuple(names.split()), projection) for name, names, projection in _TABLE}
"""The names of the parameters of each model, in the order of the file, and its projection."""


class Camera(NamedTuple):
    """A row of the camera list."""

    model: str
    width: float
    height: float
    values: tuple[float, ...]


def lens(path: Path, identifier: int, camera: Camera) -> Lens:
    """Return the lens of a camera."""
    names, projection = BY_NAME[camera.model]
    if projection is None:
        raise _no_model(path, identifier, camera.model)
    given = dict(zip(names, camera.values, strict=True))
    focal_x, focal = given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0))
    shape = SHAPES.get(projection, ())
    if projection == "fov" and abs(given["omega"]) < _SMALLEST_OMEGA:
        projection, shape = "perspective", ()
    return Lens(
        *(focal, camera.width, camera.height, given["cx"], given["cy"]),
        b1=focal_x - focal,
        projection=projection,
        shape=tuple(given[name] for name in shape),
        radial=terms(given, "k1 k2 k3 k4 k5 k6"),
        denominator=terms(given, "d1 d2 d3"),
        tangential=terms(given, "p2 p1"),
        thin_prism=terms(given, "s1 s2 s3 s4"),
        in_turn=camera.model == "RAD_TAN_THIN_PRISM_FISHEYE",
        sensor=f"{identifier} {camera.model}",
    )


def _no_model(path: Path, camera: object, model: object) -> InputError:
    what, remedy = f"the model {model} of camera {camera}", "Give the undistorted model"
    return unsupported(path, what, remedy, model=model)


class Image(NamedTuple):
    """A row of the image list.

    `pose` is qw, qx, qy, qz, tx, ty, tz. `seen` has the image points that have a point in space,
    and the identifiers of those; it is empty where they were not asked for.
    """

    identifier: int
    pose: tuple[float, ...]
    camera: int
    name: str
    seen: np.ndarray

    @property
    def posed(self) -> bool:
        """Whether it has a pose at all; COLMAP itself writes no others."""
        return bool(np.isfinite(self.pose).all())


OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_COUNT, _CAMERA, _IMAGE = struct.Struct("<Q"), struct.Struct("<IiQQ"), struct.Struct("<I7dI")
_POINT_BYTES, _POINT_TO_COUNT, _POINT_TO_COLOUR, _VIEW_BYTES = 51, 43, 32, 8
_STATED = re.compile(r"^#.*Number of (?:cameras|images|points): (\d{1,15})\b", re.MULTILINE)
_HEAD_CHARACTERS = 4096


class _Bytes:
    """A binary file that is read piece by piece; unmapped when nothing refers to it any more."""

    def __init__(self, path: Path) -> None:
        self.at = 0
        with path.open("rb") as stream:
            self.data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)

    def take(self, form: struct.Struct) -> tuple[Any, ...]:
        """Return the next numbers."""
        values = form.unpack_from(self.data, self.at)
        self.at += form.size
        return values


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file, blank ones too; comments may state how many rows it has."""
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        for line in stream:
            if not line.lstrip().startswith("#"):
                yield line.strip()


def _check_count(path: Path, rows: int) -> None:
    """Refuse a text that has fewer rows than its comments announce."""
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        head = stream.read(_HEAD_CHARACTERS)
    if (stated := _STATED.search(head)) and int(stated[1]) > rows:
        raise damaged(path, f"{rows:,} rows instead of {int(stated[1]):,}")


def read_cameras(path: Path) -> dict[int, Camera]:
    """Read ``cameras``, binary or text: identifier, model, width, height, parameters."""
    cameras: dict[int, Camera] = {}
    with reading(path):
        if path.suffix == ".bin":
            file = _Bytes(path)
            for _ in range(*file.take(_COUNT)):
                identifier, number, width, height = file.take(_CAMERA)
                if not 0 <= number < len(MODELS):
                    raise _no_model(path, identifier, number)
                values = file.take(struct.Struct(f"<{len(BY_NAME[MODELS[number]][0])}d"))
                cameras[identifier] = Camera(MODELS[number], float(width), float(height), values)
            return cameras
        for name, model, *words in filter(None, map(str.split, _lines(path))):
            if model not in BY_NAME:
                raise _no_model(path, name, model)
            width, height, *numbers = map(float, words)
            if len(numbers) != len(BY_NAME[model][0]):
                raise damaged(path, f"camera {name}: {len(numbers)} parameters of {model}")
            cameras[int(name)] = Camera(model, width, height, tuple(numbers))
        _check_count(path, len(cameras))
    return cameras


def read_images(path: Path, *, points: bool) -> list[Image]:
    """Read ``images``; the image points only where they are asked for."""
    with reading(path):
        if path.suffix == ".bin":
            file, images = _Bytes(path), []
            for _ in range(*file.take(_COUNT)):
                identifier, *pose, camera = file.take(_IMAGE)
                end = file.data.find(b"\0", file.at)
                if end < 0:
                    raise ValueError("a name does not end")
                name, file.at = file.data[file.at : end].decode("utf-8", "replace"), end + 1
                (count,) = file.take(_COUNT)
                seen = np.empty(0, OBSERVATION)
                if points and count:
                    seen = np.frombuffer(file.data, OBSERVATION, count, file.at)
                    seen = seen[seen["point"] >= 0]
                file.at += count * OBSERVATION.itemsize
                images.append(Image(identifier, tuple(pose), camera, name, seen))
            if file.at > len(file.data):
                raise damaged(path, "its last image has too few points")
            return images
        images, lines = [], _lines(path)
        for line in filter(None, lines):
            identifier, *pose, camera, name = line.split(None, 9)
            below = next(lines, "")
            if below:
                int(below.rsplit(None, 1)[-1])  # the line of the next image would end with a name
            rows = np.array(below.split() if points else (), float).reshape(-1, 3)
            rows = rows[rows[:, 2] >= 0]
            seen = np.empty(len(rows), OBSERVATION)
            seen["xy"], seen["point"] = rows[:, :2], rows[:, 2]
            images.append(Image(int(identifier), tuple(map(float, pose)), int(camera), name, seen))
        _check_count(path, len(images))
        return images


def read_points(path: Path) -> tuple[IntArray, FloatArray]:
    """Read identifiers and places of ``points3D``; the tracks are in the images too."""
    with reading(path):
        if path.suffix != ".bin":
            lines = [line.split(None, 4)[:4] for line in _lines(path) if line]
            _check_count(path, len(lines))
            values = np.array([line[1:] for line in lines], float).reshape(-1, 3)
            return np.array([int(line[0]) for line in lines], np.int64), values
        file = _Bytes(path)
        (count,) = file.take(_COUNT)
        data, at, starts = file.data, file.at, []
        for _ in range(count):  # millions, so without a function call each
            starts.append(at)
            at += _POINT_BYTES + _VIEW_BYTES * _COUNT.unpack_from(data, at + _POINT_TO_COUNT)[0]
        if at > len(data):
            raise damaged(path, "its last point has too few views")
        if not starts:
            return np.empty(0, np.int64), np.empty((0, 3))
        every_byte = np.frombuffer(data, np.uint8)
        rows = np.lib.stride_tricks.sliding_window_view(every_byte, _POINT_TO_COLOUR)[starts]
        numbers = np.ascontiguousarray(rows).view([("id", "<i8"), ("xyz", "<f8", 3)])[:, 0]
        return numbers["id"].copy(), numbers["xyz"].copy()

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
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.model import FloatArray, IntArray, Lens, Projection

_SMALLEST_OMEGA = 1e-6
"""Below, in radians, the FOV model is a perspective one to double precision."""
SHAPES = {"fov": ("omega",), "division": ("k",), "eucm": ("alpha", "beta")}
"""COLMAP's names of the parameters of a projection."""


class Model(NamedTuple):
    """A camera model; `parameters` are the names in the order of the file."""

    name: str
    parameters: tuple[str, ...]
    projection: Projection | None


def _model(name: str, parameters: str, projection: Projection | None = "perspective") -> Model:
    return Model(name, tuple(parameters.split()), projection)


MODELS = (
    _model("SIMPLE_PINHOLE", "f cx cy"),
    _model("PINHOLE", "fx fy cx cy"),
    _model("SIMPLE_RADIAL", "f cx cy k1"),
    _model("RADIAL", "f cx cy k1 k2"),
    _model("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    _model("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4", "equidistant"),
    _model("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3"),
    _model("FOV", "fx fy cx cy omega", "fov"),
    _model("SIMPLE_RADIAL_FISHEYE", "f cx cy k1", "equidistant"),
    _model("RADIAL_FISHEYE", "f cx cy k1 k2", "equidistant"),
    _model("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s3", "equidistant"),
    _model(
        "RAD_TAN_THIN_PRISM_FISHEYE",
        "fx fy cx cy k1 k2 k3 k4 k5 k6 p2 p1 s1 s2 s3 s4",
        "equidistant",
    ),
    _model("SIMPLE_DIVISION", "f cx cy k", "division"),
    _model("DIVISION", "fx fy cx cy k", "division"),
    _model("SIMPLE_FISHEYE", "f cx cy", "equidistant"),
    _model("FISHEYE", "fx fy cx cy", "equidistant"),
    _model("EUCM", "fx fy cx cy alpha beta", "eucm"),
    _model("EQUIRECTANGULAR", "w h", None),
)
"""In the order of their numbers in binary files, from 0."""

BY_NAME = {model.name: model for model in MODELS}


class Camera(NamedTuple):
    """A row of the camera list."""

    model: Model
    width: float
    height: float
    values: tuple[float, ...]


def lens(path: Path, identifier: int, camera: Camera) -> Lens:
    """Return the lens of a camera."""
    model = camera.model
    if model.projection is None:
        raise InputError(
            f"{path}: camera {identifier}: pcfix has no lens for the model {model.name}; give the"
            " undistorted model (colmap image_undistorter)."
        )
    given = dict(zip(model.parameters, camera.values, strict=True))
    focal_x, focal = given.get("fx", given.get("f", 0.0)), given.get("fy", given.get("f", 0.0))
    projection, shape = _projection(model.projection, given)
    found = Lens(
        *(focal, camera.width, camera.height, given["cx"], given["cy"]),
        b1=focal_x - focal,
        projection=projection,
        shape=shape,
        radial=_coefficients(given, "k1", "k2", "k3", "k4", "k5", "k6"),
        denominator=_coefficients(given, "d1", "d2", "d3"),
        tangential=_coefficients(given, "p2", "p1"),
        thin_prism=_coefficients(given, "s1", "s2", "s3", "s4"),
        in_turn=model.name == "RAD_TAN_THIN_PRISM_FISHEYE",
        sensor=f"{identifier} {model.name}",
    )
    checks.lens(path, str(identifier), found)
    if not focal_x > 0.0:
        raise InputError(
            f"{path}: camera {identifier}: focal length fx {focal_x:g} must be positive; export the"
            " model again."
        )
    return found


def _coefficients(given: dict[str, float], *names: str) -> tuple[float, ...]:
    """Return the values up to the last name that the model has, 0 for those between."""
    there = [i for i, name in enumerate(names) if name in given]
    return tuple(given.get(name, 0.0) for name in names[: there[-1] + 1]) if there else ()


def _projection(
    projection: Projection, given: dict[str, float]
) -> tuple[Projection, tuple[float, ...]]:
    """Return the projection and its parameters."""
    if projection == "fov" and abs(given["omega"]) < _SMALLEST_OMEGA:
        return "perspective", ()
    return projection, tuple(given[name] for name in SHAPES.get(projection, ()))


class Image(NamedTuple):
    """A row of the image list.

    `pose` is qw, qx, qy, qz, tx, ty, tz. `xy` (o, 2) and `points` (o,) are the image points that
    have a point in space, and the identifiers of those; empty where they were not asked for.
    """

    identifier: int
    pose: tuple[float, ...]
    camera: int
    name: str
    xy: FloatArray
    points: IntArray

    @property
    def posed(self) -> bool:
        """Whether it has a pose at all; COLMAP itself writes no others."""
        return bool(np.isfinite(self.pose).all())


class Points(NamedTuple):
    """Identifiers and places of the points in space."""

    identifiers: IntArray
    xyz: FloatArray


NO_XY: FloatArray = np.empty((0, 2))
NO_POINTS: IntArray = np.empty(0, np.int64)


class _Bytes:
    """A binary file that is read piece by piece; unmapped when nothing refers to it any more."""

    def __init__(self, path: Path) -> None:
        self.path, self.at = path, 0
        self.data: bytes | mmap.mmap = b""
        with path.open("rb") as stream:
            if path.stat().st_size:
                self.data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)

    def skip(self, size: int) -> int:
        """Return where the next bytes begin, and go on after them."""
        begin = self.at
        if size > len(self.data) - begin:
            raise self.cut_off()
        self.at += size
        return begin

    def take(self, form: struct.Struct) -> tuple[Any, ...]:
        """Return the next numbers."""
        return form.unpack_from(self.data, self.skip(form.size))

    def name(self) -> str:
        """Return the next text."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.cut_off()
        begin = self.skip(end + 1 - self.at)
        return bytes(self.data[begin:end]).decode("utf-8", "replace")

    def count(self, least_bytes: int) -> int:
        """Return the next count, of rows of at least so many bytes, if they can be there."""
        (count,) = self.take(_COUNT)
        if count * least_bytes > len(self.data) - self.at:
            raise self.cut_off()
        return int(count)

    def cut_off(self) -> InputError:
        """Return the error for a file that ends too early."""
        return InputError(f"{self.path}: is cut off or damaged; export the model again.")


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_POINT_BYTES, _POINT_TO_COUNT, _POINT_TO_COLOUR, _VIEW_BYTES = 51, 43, 32, 8


def _binary_cameras(path: Path) -> dict[int, Camera]:
    file = _Bytes(path)
    cameras: dict[int, Camera] = {}
    for _ in range(file.count(_CAMERA.size)):
        identifier, number, width, height = file.take(_CAMERA)
        if not 0 <= number < len(MODELS):
            raise InputError(
                f"{path}: camera {identifier} has the model number {number}, which pcfix does not"
                " know; give the undistorted model (colmap image_undistorter)."
            )
        values = file.take(struct.Struct(f"<{len(MODELS[number].parameters)}d"))
        cameras[identifier] = Camera(MODELS[number], float(width), float(height), values)
    return cameras


def _binary_images(path: Path, *, points: bool) -> list[Image]:
    file = _Bytes(path)
    images = []
    for _ in range(file.count(_IMAGE.size + 1 + _COUNT.size)):
        identifier, *pose, camera = file.take(_IMAGE)
        name = file.name()
        count = file.count(OBSERVATION.itemsize)
        begin = file.skip(count * OBSERVATION.itemsize)
        xy, seen = NO_XY, NO_POINTS
        if points and count:
            rows = np.frombuffer(file.data, OBSERVATION, count, begin)
            rows = rows[rows["point"] >= 0]
            xy, seen = rows["xy"].astype(np.float64), rows["point"].astype(np.int64)
        images.append(Image(identifier, tuple(pose), camera, name, xy, seen))
    return images


def _binary_points(path: Path) -> Points:
    file = _Bytes(path)
    starts = np.empty(file.count(_POINT_BYTES), np.int64)
    data, at = file.data, file.at
    for i in range(len(starts)):  # of millions, so without a call each
        if at + _POINT_BYTES > len(data):
            raise file.cut_off()
        starts[i] = at
        at += _POINT_BYTES + _VIEW_BYTES * _COUNT.unpack_from(data, at + _POINT_TO_COUNT)[0]
    if at > len(data):
        raise file.cut_off()
    if not len(starts):
        return Points(NO_POINTS, np.empty((0, 3)))
    every_byte = np.frombuffer(data, np.uint8)
    rows = np.lib.stride_tricks.sliding_window_view(every_byte, _POINT_TO_COLOUR)[starts]
    place = np.ascontiguousarray(rows[:, _COUNT.size :]).view("<f8")
    return Points(np.ascontiguousarray(rows[:, : _COUNT.size]).view("<i8")[:, 0], place)


_CAMERA_WORDS = 4
_IMAGE_WORDS = 10
_POINT_WORDS = 4
_STATED = re.compile(r"Number of (cameras|images|points): (\d{1,15})\b")


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield number and text of every line, blank ones too, without comments."""
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        for number, line in enumerate(stream, start=1):
            if not line.lstrip().startswith("#"):
                yield number, line.strip()


def _wrong(path: Path, number: int, rule: str) -> InputError:
    return InputError(f"{path}: line {number} {rule}; export the model again.")


def _check_count(path: Path, found: int) -> None:
    """Refuse a text that has fewer rows than its comments announce."""
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        comments = "".join(takewhile(lambda line: line.lstrip().startswith("#"), stream))
    stated = _STATED.search(comments)
    if stated and int(stated[2]) > found:
        raise InputError(
            f"{path}: is cut short: its header counts {int(stated[2]):,} {stated[1]}, the file has"
            f" {found:,}; export the model again."
        )


def _text_cameras(path: Path) -> dict[int, Camera]:
    cameras: dict[int, Camera] = {}
    for number, line in _lines(path):
        words = line.split()
        if not words:
            continue
        if len(words) < _CAMERA_WORDS:
            raise _wrong(path, number, "must give a camera: number, model, width, height, ...")
        model = BY_NAME.get(words[1])
        if model is None:
            raise InputError(
                f"{path}: line {number}: camera {words[0]} has the model {words[1][:40]}, which"
                " pcfix does not know; give the undistorted model (colmap image_undistorter)."
            )
        if len(words) != _CAMERA_WORDS + len(model.parameters):
            rule = f"must end with the {len(model.parameters)} parameters of {model.name}"
            raise _wrong(path, number, rule)
        try:
            width, height, *values = (float(word) for word in words[2:])
            cameras[int(words[0])] = Camera(model, width, height, tuple(values))
        except ValueError as error:
            raise _wrong(path, number, "has a word that must be a number") from error
    _check_count(path, len(cameras))
    return cameras


def _text_images(path: Path, *, points: bool) -> list[Image]:
    images = []
    lines = _lines(path)
    for number, line in lines:
        if not line:
            continue
        words = line.split(None, _IMAGE_WORDS - 1)
        if len(words) < _IMAGE_WORDS:
            raise _wrong(path, number, "must give an image: number, QW, QX, ... TZ, camera, name")
        try:
            identifier, camera = int(words[0]), int(words[8])
            pose = tuple(float(word) for word in words[1:8])
        except ValueError as error:
            raise _wrong(path, number, "has a word that must be a number") from error
        xy, seen = _image_points(path, *next(lines, (number + 1, "")), points=points)
        images.append(Image(identifier, pose, camera, words[9], xy, seen))
    _check_count(path, len(images))
    return images


def _image_points(
    path: Path, number: int, line: str, *, points: bool
) -> tuple[FloatArray, IntArray]:
    """Read a second line: x, y and identifier of each image point, -1 for none."""
    if not line:
        return NO_XY, NO_POINTS
    try:
        int(line.rsplit(None, 1)[-1])  # a line of the next image ends with a name
        values = np.array(line.split(), float).reshape(-1, 3) if points else np.empty((0, 3))
    except ValueError as error:
        rule = "must give the image points (x, y, number of the point) of the image above, or none"
        raise _wrong(path, number, rule) from error
    values = values[values[:, 2] >= 0]
    return values[:, :2], values[:, 2].astype(np.int64)


def _text_points(path: Path) -> Points:
    rows = []
    for number, line in _lines(path):
        if not line:
            continue
        try:
            identifier, x, y, z = line.split(None, _POINT_WORDS)[:_POINT_WORDS]
            rows.append((int(identifier), float(x), float(y), float(z)))
        except ValueError as error:
            raise _wrong(path, number, "must give a point: number, X, Y, Z, ...") from error
    _check_count(path, len(rows))
    values = np.array(rows, float).reshape(-1, 4)
    return Points(values[:, 0].astype(np.int64), values[:, 1:])


def read_cameras(path: Path) -> dict[int, Camera]:
    """Read ``cameras``, binary or text: identifier, model, width, height, parameters."""
    return _binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path)


def read_images(path: Path, *, points: bool) -> list[Image]:
    """Read ``images``; the image points only where they are asked for."""
    form = _binary_images if path.suffix == ".bin" else _text_images
    return form(path, points=points)


def read_points(path: Path) -> Points:
    """Read identifiers and places of ``points3D``; the tracks are in the images too."""
    return _binary_points(path) if path.suffix == ".bin" else _text_points(path)

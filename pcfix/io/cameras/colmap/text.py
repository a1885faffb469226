"""COLMAP's text files: a line per camera and point, two per image, ``#`` before comments."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.colmap.models import BY_NAME, Camera
from pcfix.io.cameras.colmap.parts import NO_POINTS, NO_XY, Image, Points

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from pcfix.model import FloatArray, IntArray

_CAMERA_WORDS = 4
_IMAGE_WORDS = 10
_POINT_WORDS = 4


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield number and text of every line, blank ones too, without comments."""
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        for number, line in enumerate(stream, start=1):
            if not line.lstrip().startswith("#"):
                yield number, line.strip()


def _wrong(path: Path, number: int, rule: str) -> InputError:
    return InputError(f"{path}: line {number} {rule}; export the model again.")


def read_cameras(path: Path) -> dict[int, Camera]:
    """Read ``cameras.txt``: identifier, name of the model, width, height, parameters."""
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
    return cameras


def read_images(path: Path, *, points: bool) -> list[Image]:
    """Read ``images.txt``; the image points only where they are asked for."""
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


def read_points(path: Path) -> Points:
    """Read identifiers and places of ``points3D.txt``; the tracks are in the images too."""
    rows = []
    for number, line in _lines(path):
        words = line.split(None, _POINT_WORDS)[:_POINT_WORDS]
        if not words:
            continue
        try:
            identifier, x, y, z = words
            rows.append((int(identifier), float(x), float(y), float(z)))
        except ValueError as error:
            raise _wrong(path, number, "must give a point: number, X, Y, Z, ...") from error
    values = np.array(rows, float).reshape(-1, 4)
    return Points(values[:, 0].astype(np.int64), values[:, 1:])

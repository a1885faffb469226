"""COLMAP's binary files: little-endian, counts before lists, names that end with a zero byte."""

from __future__ import annotations

import mmap
import struct
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.colmap.models import MODELS, Camera
from pcfix.io.cameras.colmap.parts import NO_POINTS, NO_XY, Image, Points, cut_off

if TYPE_CHECKING:
    from pathlib import Path

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_POINT_BYTES, _POINT_TO_COUNT, _POINT_TO_COLOUR = 51, 43, 32
_VIEW_BYTES = 8


def read_cameras(path: Path) -> dict[int, Camera]:
    """Read ``cameras.bin``: identifier, number of the model, width, height, parameters."""
    data = _bytes_of(path)
    cameras: dict[int, Camera] = {}
    at = _COUNT.size
    for _ in range(_count(path, data, 0, _CAMERA.size)):
        if at + _CAMERA.size > len(data):
            raise cut_off(path)
        identifier, number, width, height = _CAMERA.unpack_from(data, at)
        if not 0 <= number < len(MODELS):
            raise InputError(
                f"{path}: camera {identifier} has the model number {number}, which pcfix does not"
                " know; give the undistorted model (colmap image_undistorter)."
            )
        values = struct.Struct(f"<{len(MODELS[number].parameters)}d")
        at += _CAMERA.size
        if at + values.size > len(data):
            raise cut_off(path)
        camera = Camera(MODELS[number], float(width), float(height), values.unpack_from(data, at))
        cameras[identifier] = camera
        at += values.size
    return cameras


def read_images(path: Path, *, points: bool) -> list[Image]:
    """Read ``images.bin``; the image points only where they are asked for."""
    data = _bytes_of(path)
    images = []
    at = _COUNT.size
    for _ in range(_count(path, data, 0, _IMAGE.size + 1 + _COUNT.size)):
        if at + _IMAGE.size > len(data):
            raise cut_off(path)
        identifier, *pose, camera = _IMAGE.unpack_from(data, at)
        end = data.find(b"\0", at + _IMAGE.size)
        name = data[at + _IMAGE.size : end].decode("utf-8", "replace")
        observations = _count(path, data, end + 1, _OBSERVATION.itemsize) if end > 0 else -1
        if observations < 0:
            raise cut_off(path)
        xy, seen = NO_XY, NO_POINTS
        if points and observations:
            rows = np.frombuffer(data, _OBSERVATION, observations, end + 1 + _COUNT.size)
            rows = rows[rows["point"] >= 0]
            xy, seen = rows["xy"].astype(np.float64), rows["point"].astype(np.int64)
        images.append(Image(identifier, tuple(pose), camera, name, xy, seen))
        at = end + 1 + _COUNT.size + observations * _OBSERVATION.itemsize
    return images


def read_points(path: Path) -> Points:
    """Read identifiers and places of ``points3D.bin``; the tracks are in the images too."""
    data = _bytes_of(path)
    count = _count(path, data, 0, _POINT_BYTES)
    starts = np.empty(count, np.int64)
    at = _COUNT.size
    for i in range(count):
        if at + _POINT_BYTES > len(data):
            raise cut_off(path)
        starts[i] = at
        at += _POINT_BYTES + _VIEW_BYTES * _COUNT.unpack_from(data, at + _POINT_TO_COUNT)[0]
    if at > len(data):
        raise cut_off(path)
    if not count:
        return Points(NO_POINTS, np.empty((0, 3)))
    every_byte = np.frombuffer(data, np.uint8)
    rows = np.lib.stride_tricks.sliding_window_view(every_byte, _POINT_TO_COLOUR)[starts]
    place = np.ascontiguousarray(rows[:, _COUNT.size :]).view("<f8")
    return Points(np.ascontiguousarray(rows[:, : _COUNT.size]).view("<i8")[:, 0], place)


def _bytes_of(path: Path) -> bytes | mmap.mmap:
    """Return the content without reading it; unmapped when nothing refers to it any more."""
    with path.open("rb") as stream:
        if path.stat().st_size == 0:
            return b""
        return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)


def _count(path: Path, data: bytes | mmap.mmap, at: int, least_bytes: int) -> int:
    """Return the count of a list whose rows have at least so many bytes, if they can be there."""
    if at + _COUNT.size > len(data):
        raise cut_off(path)
    (count,) = _COUNT.unpack_from(data, at)
    if count * least_bytes > len(data) - at - _COUNT.size:
        raise cut_off(path)
    return int(count)

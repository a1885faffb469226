"""The names of the images of a COLMAP model, in the orders in which COLMAP may count them.

Only what that needs is read: names and ids of ``images.bin`` or ``images.txt``, and the images of
``frames.bin`` or ``frames.txt`` where the model has rigs (https://colmap.github.io/format.html).
"""

from __future__ import annotations

import mmap
import struct
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_PLACES = (".", "sparse", "sparse/0")
_CAMERA = ("0", "CAMERA")
"""Type of a sensor, in bytes and in text."""

_IMAGE_HEAD, _OBSERVATION_BYTES = struct.Struct("<I7dI"), 24
_FRAME_HEAD, _DATA = struct.Struct("<II7dI"), struct.Struct("<iIQ")


def model_orders(folder: Path) -> list[tuple[str, list[str]]]:
    """Return the orders of the images of the sparse models of a workspace, and their names.

    A damaged model gives none.
    """
    orders: list[tuple[str, list[str]]] = []
    for place in _PLACES:
        try:
            orders += _orders(folder / place)
        except (OSError, struct.error, ValueError, IndexError, KeyError):
            continue
    return orders


def _orders(model: Path) -> list[tuple[str, list[str]]]:
    images = _images(model)
    if not images:
        return []
    name = dict(images)
    frames = [[i for i in ids if i in name] for ids in _frames(model)]
    by_frame = [name[i] for ids in frames for i in ids]
    orders = [
        (f"the frames of {model}", by_frame if len(by_frame) == len(images) else []),
        (f"the images of {model}", [label for _, label in images]),
        (f"the images of {model} by IMAGE_ID", [name[i] for i in sorted(name)]),
    ]
    return [(what, names) for what, names in orders if names]


def _images(model: Path) -> list[tuple[int, str]]:
    """Return id and name of each image, in the order of the file."""
    if (model / "images.bin").is_file():
        with (
            (model / "images.bin").open("rb") as stream,
            mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            return _binary_images(data)
    if (model / "images.txt").is_file():
        with (model / "images.txt").open(encoding="utf-8", errors="replace") as lines:
            return _text_images(lines)
    return []


def _binary_images(data: mmap.mmap) -> list[tuple[int, str]]:
    images = []
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(count):
        image_id, *_ = _IMAGE_HEAD.unpack_from(data, at)
        at += _IMAGE_HEAD.size
        if (end := data.find(b"\0", at)) < 0:
            raise ValueError("cut short")
        images.append((image_id, data[at:end].decode("utf-8", errors="replace")))
        (observations,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + _OBSERVATION_BYTES * observations
    return images


def _text_images(lines: Iterator[str]) -> list[tuple[int, str]]:
    """Read pairs of lines, of which the second holds observations and may be empty."""
    images = []
    for line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            fields = line.split(maxsplit=9)
            images.append((int(fields[0]), fields[9].strip()))
            next(lines, None)
    return images


def _frames(model: Path) -> list[list[int]]:
    """Return the image ids of each frame, frames and images as COLMAP sorts them."""
    frames: dict[int, list[tuple[int, int]]] = {}
    if (model / "frames.bin").is_file():
        frames = _binary_frames((model / "frames.bin").read_bytes())
    elif (model / "frames.txt").is_file():
        frames = _text_frames((model / "frames.txt").read_text("utf-8", errors="replace"))
    return [[image for _, image in sorted(frames[i])] for i in sorted(frames)]


def _binary_frames(data: bytes) -> dict[int, list[tuple[int, int]]]:
    frames = {}
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(count):
        frame_id, *_, images = _FRAME_HEAD.unpack_from(data, at)
        at += _FRAME_HEAD.size
        end = at + _DATA.size * images
        if end > len(data):
            raise ValueError("cut short")
        taken = (_DATA.unpack_from(data, place) for place in range(at, end, _DATA.size))
        frames[frame_id] = [(sensor, image) for kind, sensor, image in taken if kind == 0]
        at = end
    return frames


def _text_frames(text: str) -> dict[int, list[tuple[int, int]]]:
    frames = {}
    for line in text.splitlines():
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.split()
        taken = zip(fields[10::3], fields[11::3], fields[12::3], strict=False)
        frames[int(fields[0])] = [
            (int(sensor), int(image)) for kind, sensor, image in taken if kind in _CAMERA
        ]
    return frames

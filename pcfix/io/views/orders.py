"""Find the images that the numbers of a view list stand for.

A list does not name its images. A number counts them in the order of the dense matcher:

- COLMAP uses the registered images of its sparse model. Some versions have them in the order of
  ``images.bin`` or ``images.txt``, which is arbitrary; others by ascending IMAGE_ID; those with
  rigs frame by frame, by ascending FRAME_ID (``Reconstruction::RegImageIds``).
- OpenMVS uses the order of its importer, for COLMAP that of ``images.txt``.

So every order that a sparse model beside the list allows is a candidate, then that of the cameras
that are given. Geometry decides: a depth map holds only what its image shows, so nearly every
listed camera must have the apparent point in its frame. With image numbers off by one, a quarter
of the cameras of an ordinary block do not.
"""

from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError, bad_file
from pcfix.io.cameras.colmap.files import read_images
from pcfix.io.labels import match_labels
from pcfix.io.views.lists import ImageOrder, RawList, ViewList
from pcfix.lens.imaging import project
from pcfix.model import Cameras, FloatArray, IntArray

LEAST_SHARE = 0.95
"""Of listed cameras whose frame holds the point: 1.00 on a real dense cloud, 0.75 with image
numbers off by one, 0.4 in a random order."""

MARGIN = 0.02
"""Of the frame's sides: other lens models or adjustments move an edge by less."""

SAMPLE_POINTS = 20_000

_ENOUGH = 1000
"""Entries that are enough to choose the order of the images; with fewer, later chunks decide."""

_PLACES = (".", "sparse", "sparse/0")
_FRAME_HEAD, _DATA = struct.Struct("<II7dI"), struct.Struct("<iIQ")


def image_orders(raw: RawList, cameras: Cameras) -> tuple[ImageOrder, ...]:
    """Return the orders that the image numbers may follow, the most likely first."""
    found = []
    for place in _PLACES:
        with suppress(InputError, OSError, struct.error, ValueError, IndexError, KeyError):
            for what, names in _orders(raw.path.parent / place):  # a damaged model is skipped
                row = match_labels(names, cameras.labels).row.astype(np.int32)
                unposed = tuple(name for name, r in zip(names, row, strict=True) if r < 0)
                found.append(ImageOrder(what, row, unposed))
    found.append(ImageOrder("the cameras as given", np.arange(len(cameras), dtype=np.int32)))
    most = int(raw.image.max()) if raw.image.size else -1
    fitting = [order for order in found if most < len(order.camera)]
    if not fitting:
        largest = max(found, key=lambda order: len(order.camera))
        sentence = f"names image {most} (from 0); {largest.what} has {len(largest.camera)}. Put the"
        sentence += " sparse model beside the list."
        raise bad_file(raw.path, "views.image_number", sentence, value=most)
    known = [order for order in fitting if (order.camera >= 0).any()]
    if not known:
        sentence = f"no image of {fitting[0].what} is among the cameras. Give those of this block."
        raise bad_file(raw.path, "views.other_block", sentence)
    distinct: dict[bytes, ImageOrder] = {}
    for order in known:
        distinct.setdefault(order.camera.tobytes(), order)
    return tuple(distinct.values())


def _orders(model: Path) -> list[tuple[str, list[str]]]:
    """Return the orders of the images of a sparse model, and their names."""
    paths = [model / f"images.{suffix}" for suffix in ("bin", "txt")]
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        return []
    images = read_images(path, points=False)
    name = {image.identifier: image.name for image in images}
    by_frame = [name[i] for ids in _frames(model) for i in ids if i in name]
    orders = [
        (f"the frames of {model}", by_frame if len(by_frame) == len(images) else []),
        (f"the images of {model}", [image.name for image in images]),
        (f"the images of {model} by IMAGE_ID", [name[i] for i in sorted(name)]),
    ]
    return [(what, names) for what, names in orders if names]


def _frames(model: Path) -> list[list[int]]:
    """Return the image ids of each frame of a model with rigs, in the order of COLMAP.

    See https://colmap.github.io/format.html for ``frames.bin``.
    """
    path = model / "frames.bin"
    if not path.is_file():
        return []
    data, at, frames = path.read_bytes(), 8, {}
    for _ in range(*struct.unpack_from("<Q", data)):
        frame_id, *_, images = _FRAME_HEAD.unpack_from(data, at)
        at += _FRAME_HEAD.size
        end = at + _DATA.size * images
        entries = [_DATA.unpack_from(data, place) for place in range(at, end, _DATA.size)]
        frames[frame_id] = sorted((sensor, image) for kind, sensor, image in entries if kind == 0)
        at = end
    return [[image for _, image in frames[i]] for i in sorted(frames)]


def fitted(views: ViewList, cameras: Cameras, xyz: FloatArray, rows: IntArray) -> ViewList:
    """Choose the order of images with which the listed cameras see the points.

    The apparent points, shape (m, 3), are in the frame of the cameras; `rows`, shape (m,), are
    theirs of the list.
    """
    if cameras.rotations is None or cameras.lenses is None:
        return replace(views, orders=views.orders[:1])
    step = max(1, len(rows) // SAMPLE_POINTS)
    ends, entry = entries(views.raw.start, rows[::step])
    image, seen_xyz = views.raw.image[entry], np.repeat(xyz[::step], np.diff(ends), axis=0)
    shares = [share_seen(cameras, order.camera[image], seen_xyz) for order in views.orders]
    known = [(share, i) for i, share in enumerate(shares) if share is not None]
    if not known:
        return views
    share, best = max(known, key=lambda pair: pair[0])
    if share < LEAST_SHARE:
        sentence = f"only {100 * share:.0f} % of the listed cameras have their point in the frame."
        sentence += " Put the sparse model beside the list, or give its offset (--cameras-offset)."
        raise bad_file(views.raw.path, "views.other_images", sentence, share=share)
    others = () if len(image) >= _ENOUGH else views.orders[:best] + views.orders[best + 1 :]
    return replace(views, orders=(views.orders[best], *others), share_seen=share)


def entries(start: IntArray, rows: IntArray) -> tuple[IntArray, slice | IntArray]:
    """Return where the lists of some rows start in a copy, and which entries these are."""
    counts = start[rows + 1] - start[rows]
    ends = np.concatenate([[0], np.cumsum(counts)])
    if len(rows) and rows[-1] - rows[0] == len(rows) - 1 and (np.diff(rows) == 1).all():
        return ends, slice(int(start[rows[0]]), int(start[rows[-1] + 1]))  # without a copy
    return ends, np.repeat(start[rows] - ends[:-1], counts) + np.arange(ends[-1])


def share_seen(cameras: Cameras, camera: npt.NDArray[np.int32], xyz: FloatArray) -> float | None:
    """Return the share of cameras whose frame holds their point, None without any.

    `camera`, shape (m,), has rows of cameras with rotations and lenses, of which negative ones do
    not count; `xyz`, shape (m, 3), the point of each.
    """
    if cameras.rotations is None or cameras.lenses is None:
        return None
    order = np.argsort(camera, kind="stable")
    ends = np.searchsorted(camera[order], np.arange(len(cameras) + 1))
    seen = 0
    for i, lens in enumerate(cameras.lenses):
        some = xyz[order[ends[i] : ends[i + 1]]]
        u, v = project(lens, (some - cameras.centres[i]) @ cameras.rotations[i].T).T
        wide, high = MARGIN * lens.width, MARGIN * lens.height
        inside = (u >= -wide) & (u <= lens.width + wide) & (v >= -high) & (v <= lens.height + high)
        seen += int(np.count_nonzero(inside))
    count = int(ends[-1] - ends[0])
    return seen / count if count else None

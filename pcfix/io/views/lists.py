"""Read view lists: COLMAP's ``fused.ply.vis``, the dense PLY of OpenMVS, or tie points.

``fused.ply.vis``, which COLMAP's stereo fusion writes beside ``fused.ply``, is little-endian: a
uint64 number of points; then for each point, in the order of the vertices of ``fused.ply``, a
uint32 number of images and that many uint32 image numbers. An image number counts the registered
images of the sparse model in the dense workspace, from 0; it is not COLMAP's IMAGE_ID (see
`pcfix.io.views.lists`). Defined by COLMAP's source, mvs/fusion.cc and mvs/model.cc. The images are
those whose depth maps were fused at the point.

The dense cloud of OpenMVS (and so of ODM) is a PLY file with two lists at each vertex:
``view_indices`` names the depth maps that were fused at the point, by the number of their image in
the scene, from 0; ``view_weights`` are their weights. The importers number the images in their
order: InterfaceCOLMAP in that of ``images.txt``, OpenSfM's exporter (ODM) in that of the shots of
the undistorted reconstruction. Defined by OpenMVS's source, libs/MVS/PointCloud.cpp and
apps/InterfaceCOLMAP. The images that a depth map was matched against are not named.

Find the images that the numbers of a view list stand for.

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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError, PcfixWarning, bad_file
from pcfix.io.cameras.colmap import read_images
from pcfix.io.labels import match_labels
from pcfix.io.ply import Records, joined, list_starts, read_header
from pcfix.lens.imaging import project
from pcfix.model import Cameras, FloatArray, IntArray, TiePoints, ViewKind

COLMAP_LIST = "COLMAP view list"
_HEAD = 8
_IMAGES, _WEIGHTS = "view_indices", "view_weights"
_OTHERS = (b"LASF", b"MVSI", b"PK\x03\x04", b"SQLi")
"""The first bytes of files that people give instead: clouds, scenes, archives, databases."""
_REMEDY = "Give COLMAP's fused.ply.vis or OpenMVS's dense PLY, as the software wrote it."


@dataclass(frozen=True, eq=False)
class ImageOrder:
    """One meaning of the image numbers."""

    what: str  # its source
    camera: npt.NDArray[np.int32]  # (images,), rows of `Cameras`, -1 without one
    unposed: tuple[str, ...] = ()  # images without a row


@dataclass(frozen=True, eq=False)
class ViewList:
    """The cameras that contributed to each of n points; `ViewMatch` gives them to a cloud's rows.

    `share_seen` of the listed cameras have the point in their frame; None before it is tested, or
    if the cameras have no frames. A match by position may be off by `default_spacings`.
    """

    path: Path
    what: str  # the kind of file
    start: IntArray  # (n + 1,)
    image: npt.NDArray[np.int32]  # (start[-1],), the file's number of the image
    weight: npt.NDArray[np.float32] | None = None  # (start[-1],)
    xyz: FloatArray | None = None  # (n, 3), frame of the file, then of the cameras
    resolution_m: float = 0.0  # how far off a position can be, from the type of its numbers
    notes: tuple[PcfixWarning, ...] = ()
    orders: tuple[ImageOrder, ...] = ()  # possible meanings of a number, until geometry decides
    share_seen: float | None = None
    spacing_m: float | None = None  # between neighbouring points, if there are positions
    default_spacings: float = 0.0
    kind: ViewKind = "depth-maps"  # see `pcfix.model.Views`

    def __len__(self) -> int:
        return len(self.start) - 1


def read_list(path: Path) -> ViewList:
    """Read the view list of a dense cloud."""
    with path.open("rb") as stream:
        head = stream.read(4)
    if head in _OTHERS:
        raise bad_file(path, "views.not_one", f"is not a view list. {_REMEDY}")
    if not head.startswith(b"ply"):
        return _colmap(path)
    beside = path.with_name(f"{path.name}.vis")
    has_lists = read_header(path).item(_IMAGES, is_list=True)
    return _colmap(beside) if has_lists is None and beside.is_file() else _openmvs(path)


def _colmap(path: Path) -> ViewList:
    """Read ``fused.ply.vis``, and the positions from the PLY file beside it, if there is one."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        count = int.from_bytes(stream.read(_HEAD), "little")
    complete, used, words = 0, 0, np.zeros(1, np.uint32)
    if size % 4 == 0 and 0 < count <= (size - _HEAD) // 4:
        words = np.memmap(path, "<u4", "r", offset=_HEAD)
        one = np.ones(1, np.int64)
        first, length = np.empty((2, count, 1), np.int64)
        complete, used = list_starts(words, one, one, False, first, length)
    if complete < count or used < len(words):
        sentence = f"is no complete COLMAP view list: {complete:,} of {count:,} can be read."
        values = {"points": count, "complete": complete}
        raise bad_file(path, "views.damaged", f"{sentence} {_REMEDY}", **values)
    start, number = joined(words, first[:, 0], length[:, 0], 1)
    raw = ViewList(path, COLMAP_LIST, start, _checked_images(path, number))
    bare = path.with_suffix("")
    ply = bare if bare.suffix.lower() == ".ply" else bare.with_suffix(".ply")
    if not ply.is_file():
        return raw
    vertices = read_header(ply).records
    if vertices == count:
        return replace(raw, **_positions(Records(ply)))
    sentence = f"{ply}: has {vertices:,} points, the list {count:,}. Its positions are not used."
    return replace(raw, notes=(PcfixWarning("views.other_points", sentence, path=ply),))


def _openmvs(path: Path) -> ViewList:
    """Read positions, view lists and, if there are any, weights."""
    header = read_header(path)
    if header.item(_IMAGES, is_list=True) is None:
        raise bad_file(path, "views.no_lists", f"its points have no {_IMAGES}. {_REMEDY}")
    vertices = Records(path)
    start, number = vertices.lists(_IMAGES)
    raw = ViewList(path, "OpenMVS point cloud", start, _checked_images(path, number))
    raw = replace(raw, **_positions(vertices))
    if header.item(_WEIGHTS, is_list=True) is None:
        return raw
    weight_start, weight = vertices.lists(_WEIGHTS)
    if not np.array_equal(weight_start, start) or not ((weight >= 0.0) & (weight < np.inf)).all():
        sentence = f"its {_WEIGHTS} are not one positive number for each image. {_REMEDY}"
        raise bad_file(path, "views.weights", sentence)
    return replace(raw, weight=weight.astype(np.float32))


def _positions(vertices: Records) -> dict[str, Any]:
    """Return the vertices of a PLY file, and how coarse the type of their numbers is, metres."""
    header = vertices.header
    if header.records == 0 or None in (header.item(axis, is_list=False) for axis in "xyz"):
        sentence = f"has no points with x, y and z. {_REMEDY}"
        raise bad_file(header.name, "views.no_positions", sentence)
    xyz = vertices.numbers(*"xyz")
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        sentence = f"vertex {row:,} has no finite position. Export the points again."
        raise bad_file(header.name, "views.not_finite", sentence, row=row)
    single = header.item("x", is_list=False) == "f4"
    step = float(np.spacing(np.float32(np.abs(xyz).max()))) if single else 0.0
    return {"xyz": xyz, "resolution_m": step}


def _checked_images(path: Path, number: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    """Return image numbers as int32, if they are whole and not negative."""
    with np.errstate(invalid="ignore"):  # NaN and infinity of a text
        image = number.astype(np.int32)
    wrong = np.flatnonzero((image < 0) | (image != number))
    if wrong.size:
        value = number[wrong[0]].item()
        sentence = f"names image {value}, which is not a whole number from 0 on. {_REMEDY}"
        raise bad_file(path, "views.image_number", sentence, value=value)
    return image


def tracks_as_list(path: Path, tie_points: TiePoints) -> ViewList:
    """Return the tie points that have a position, each camera once, sorted."""
    rows = np.flatnonzero(np.isfinite(tie_points.xyz).all(axis=1))
    if rows.size == 0:
        sentence = "has no tie points with positions. Give another view list."
        raise bad_file(path, "views.no_positions", sentence)
    views = tie_points.views.take(rows)
    row = np.repeat(np.arange(len(rows)), np.diff(views.start))
    pairs = np.unique(np.column_stack([row, views.camera]), axis=0)  # a track may name one twice
    counts = np.bincount(pairs[:, 0], minlength=len(rows))
    xyz = np.ascontiguousarray(tie_points.xyz[rows], np.float64)
    start, camera = np.concatenate([[0], np.cumsum(counts)]), pairs[:, 1].astype(np.int32)
    return ViewList(path, "tie points", start, camera, None, xyz)


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


def image_orders(raw: ViewList, cameras: Cameras) -> tuple[ImageOrder, ...]:
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
    ends, entry = entries(views.start, rows[::step])
    image, seen_xyz = views.image[entry], np.repeat(xyz[::step], np.diff(ends), axis=0)
    shares = [share_seen(cameras, order.camera[image], seen_xyz) for order in views.orders]
    known = [(share, i) for i, share in enumerate(shares) if share is not None]
    if not known:
        return views
    share, best = max(known, key=lambda pair: pair[0])
    if share < LEAST_SHARE:
        sentence = f"only {100 * share:.0f} % of the listed cameras have their point in the frame."
        sentence += " Put the sparse model beside the list, or give its offset (--cameras-offset)."
        raise bad_file(views.path, "views.other_images", sentence, share=share)
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

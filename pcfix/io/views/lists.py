"""View lists as files have them: COLMAP's ``fused.ply.vis``, the dense PLY of OpenMVS, tie points.

``fused.ply.vis``, which COLMAP's stereo fusion writes beside ``fused.ply``, is little-endian: a
uint64 number of points; then for each point, in the order of the vertices of ``fused.ply``, a
uint32 number of images and that many uint32 image numbers. An image number counts the registered
images of the sparse model in the dense workspace, from 0; it is not COLMAP's IMAGE_ID (see
`pcfix.io.views.orders`). Defined by COLMAP's source, mvs/fusion.cc and mvs/model.cc. The images are
those whose depth maps were fused at the point.

The dense cloud of OpenMVS (and so of ODM) is a PLY file with two lists at each vertex:
``view_indices`` names the depth maps that were fused at the point, by the number of their image in
the scene, from 0; ``view_weights`` says what each counted for. The importers number the images as
they come: InterfaceCOLMAP in the order of ``images.txt``, OpenSfM's exporter (ODM) in the order of
the shots of the undistorted reconstruction. Defined by OpenMVS's source, libs/MVS/PointCloud.cpp
and apps/InterfaceCOLMAP. A depth map was itself matched against other images, which are not named.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError
from pcfix.io.ply import Records, copy_field, list_starts, read_header
from pcfix.model import FloatArray, IntArray, TiePoints, ViewKind

COLMAP_LIST = "COLMAP view list"
_HEAD = 8
_IMAGES, _WEIGHTS = "view_indices", "view_weights"
_OTHERS = {
    b"LASF": "a LAS file: the cloud, not the list of its images",
    b"MVSI": "an OpenMVS scene: give the dense PLY file beside it",
    b"PK\x03\x04": "a ZIP archive or a project",
    b"SQLi": "a database",
}
"""What people give instead, by its first bytes."""


@dataclass(frozen=True, eq=False)
class RawList:
    """The lists of n points as a file has them."""

    path: Path
    what: str  # the kind of file
    start: IntArray  # (n + 1,)
    image: npt.NDArray[np.int32]  # (start[-1],), what the file counts its images by
    weight: npt.NDArray[np.float32] | None = None  # (start[-1],)
    xyz: FloatArray | None = None  # (n, 3), frame of the file
    resolution_m: float = 0.0  # how far off a position can be, from the type of its numbers
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.start) - 1

    @property
    def is_beside(self) -> bool:
        """Whether its positions, if any, are of another file, so that it can do without."""
        return self.what == COLMAP_LIST


@dataclass(frozen=True, eq=False)
class ImageOrder:
    """One meaning of the image numbers."""

    what: str  # where it is from
    camera: npt.NDArray[np.int32]  # (images,), rows of `Cameras`, -1 where there is none
    unposed: tuple[str, ...] = ()  # images without a row


@dataclass(frozen=True, eq=False)
class ViewList:
    """Which cameras made each of n points; `pcfix.io.views.matching` gives it to a cloud's rows.

    `share_seen` of the listed cameras have the point in their frame, None while not looked at, or
    where the cameras have no frames. A match by position may be off by `default_spacings`.
    """

    raw: RawList  # with positions in the frame of the cameras
    orders: tuple[ImageOrder, ...]  # what a number may mean; one, once geometry has told which
    share_seen: float | None
    spacing_m: float | None  # between neighbouring points, where there are positions
    default_spacings: float
    kind: ViewKind  # see `pcfix.model.Views`

    def __len__(self) -> int:
        return len(self.raw)


def read_list(path: Path) -> RawList:
    """Read the view list of a dense cloud, whichever software wrote it."""
    with path.open("rb") as stream:
        head = stream.read(4)
    if head in _OTHERS:
        raise InputError(
            f"{path}: is {_OTHERS[head]}; a view list is the fused.ply.vis of COLMAP or the dense"
            " PLY of OpenMVS."
        )
    if not head.startswith(b"ply"):
        return _colmap(path)
    beside = path.with_name(f"{path.name}.vis")
    has_lists = read_header(path).item(_IMAGES, is_list=True)
    return _colmap(beside) if has_lists is None and beside.is_file() else _openmvs(path)


def _colmap(path: Path) -> RawList:
    """Read ``fused.ply.vis``, and the positions from the PLY file beside it where it has one."""
    size = path.stat().st_size
    if size <= _HEAD or size % 4:
        _complain(path, f"its {size:,} bytes are not one number of 8 bytes and more of 4")
    with path.open("rb") as stream:
        count = int.from_bytes(stream.read(_HEAD), "little")
    if count == 0 or count > (size - _HEAD) // 4:
        _complain(path, f"it would hold {count:,} points in {size:,} bytes")
    words = np.memmap(path, "<u4", "r", offset=_HEAD)
    one, start = np.ones(1, np.int64), np.empty((1, count + 1), np.int64)
    used = list_starts(words, one, one, False, np.zeros(1, np.int64), start)
    if used < 0:
        _complain(path, f"the list of point {-1 - used:,} of {count:,} does not end in the file")
    if used < len(words):
        _complain(path, f"{4 * (len(words) - used):,} bytes follow the lists of {count:,} points")
    number = np.empty(int(start[0, -1]), words.dtype)
    copy_field(words, one, one, False, 0, (0, 0), count, number)
    image = number.view(np.int32)
    if image.size and image.min() < 0:
        _complain(path, f"a point names image {int(image.min()) % 2**32}")
    return RawList(path, COLMAP_LIST, start[0], image, None, *_beside(path, count))


def _complain(path: Path, what: str) -> NoReturn:
    raise InputError(
        f"{path}: is not a whole COLMAP view list ({what}); give the fused.ply.vis of COLMAP or the"
        " dense PLY of OpenMVS, as the software wrote it."
    )


def _beside(path: Path, count: int) -> tuple[FloatArray | None, float, tuple[str, ...]]:
    """Return positions, their resolution and notes from ``fused.ply`` beside ``fused.ply.vis``."""
    bare = path.with_suffix("")
    ply = bare if bare.suffix.lower() == ".ply" else bare.with_suffix(".ply")
    if not ply.is_file():
        return None, 0.0, ()
    vertices = read_header(ply).records
    if vertices != count:
        note = (
            f"{ply}: has {vertices:,} points and {path.name} has {count:,}; its positions are not"
            " used."
        )
        return None, 0.0, (note,)
    return *_positions(_vertices(ply)), ()


def _openmvs(path: Path) -> RawList:
    """Read positions, view lists and, where there are any, weights."""
    header = read_header(path)
    if header.item(_IMAGES, is_list=True) is None:
        names = ", ".join(p.name for p in header.properties)
        raise InputError(
            f"{path}: its points have no {_IMAGES} (they have: {names}); other software drops the"
            " lists on saving, so give the dense PLY as OpenMVS wrote it, or COLMAP's"
            " fused.ply.vis."
        )
    vertices = _vertices(path)
    start, number = vertices.lists(_IMAGES)
    xyz, resolution_m = _positions(vertices)
    image, weight = _images(path, number), _weights(vertices, start)
    return RawList(path, "OpenMVS point cloud", start, image, weight, xyz, resolution_m)


def _vertices(path: Path) -> Records:
    header = read_header(path)
    if header.records == 0 or None in (header.item(axis, is_list=False) for axis in "xyz"):
        raise InputError(
            f"{path}: has no points with x, y and z; give the dense point cloud as the software"
            " wrote it."
        )
    return Records(path)


def _positions(vertices: Records) -> tuple[FloatArray, float]:
    """Return the vertices of a PLY file and how coarse the type of their numbers is, metres."""
    xyz, header = vertices.numbers(*"xyz"), vertices.header
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.all():
        raise InputError(
            f"{header.name}: vertex {int(np.argmin(finite)):,} has no finite position; remove it"
            " or export the points again."
        )
    single = header.item("x", is_list=False) == "f4"
    return xyz, float(np.spacing(np.float32(np.abs(xyz).max()))) if single else 0.0


def _images(path: Path, number: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    """Return image numbers as int32; others than whole ones from 0 to 2147483647 are refused."""
    if number.size == 0:
        return np.zeros(0, np.int32)
    low, high = number.min(), number.max()
    if not (low >= 0 and high <= np.iinfo(np.int32).max):
        wrong = high if low >= 0 else low
        raise InputError(
            f"{path}: names an image {wrong}; image numbers start at 0, the file is damaged or of"
            " another kind."
        )
    whole = number.astype(np.int32)
    if number.dtype.kind == "f" and (whole != number).any():
        raise InputError(f"{path}: names an image by a number that is not whole; export it again.")
    return whole


def _weights(vertices: Records, start: IntArray) -> npt.NDArray[np.float32] | None:
    name = vertices.header.name
    if vertices.header.item(_WEIGHTS, is_list=True) is None:
        return None
    weight_start, weight = vertices.lists(_WEIGHTS)
    if not np.array_equal(weight_start, start):
        row = int(np.argmax(np.diff(weight_start) != np.diff(start)))
        raise InputError(
            f"{name}: vertex {row:,} has not as many {_WEIGHTS} as {_IMAGES}; export it again."
        )
    if weight.size and not (weight.min() >= 0.0 and weight.max() < np.inf):
        raise InputError(f"{name}: a weight is negative or not finite; export it again.")
    return weight.astype(np.float32)


def tracks_as_list(path: Path, tie_points: TiePoints) -> RawList:
    """Return the tie points that have a position, each camera once, sorted."""
    rows = np.flatnonzero(np.isfinite(tie_points.xyz).all(axis=1))
    if rows.size == 0:
        raise InputError(f"{path}: has no tie points with positions; give another view list.")
    views = tie_points.views.take(rows)
    row = np.repeat(np.arange(len(rows)), np.diff(views.start))
    pairs = np.unique(np.column_stack([row, views.camera]), axis=0)  # a track may name one twice
    counts = np.bincount(pairs[:, 0], minlength=len(rows))
    xyz = np.ascontiguousarray(tie_points.xyz[rows], np.float64)
    start, camera = np.concatenate([[0], np.cumsum(counts)]), pairs[:, 1].astype(np.int32)
    return RawList(path, "tie points", start, camera, None, xyz)

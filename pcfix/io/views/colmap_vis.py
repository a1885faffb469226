"""``fused.ply.vis``, which COLMAP's stereo fusion writes beside ``fused.ply``.

Little-endian: a uint64 number of points; then for each point, in the order of the vertices of
``fused.ply``, a uint32 number of images and that many uint32 image numbers. An image number counts
the registered images of the sparse model in the dense workspace, from 0; it is not COLMAP's
IMAGE_ID (see `pcfix.io.views.orders`). Defined by COLMAP's source, mvs/fusion.cc and mvs/model.cc.
The images are those whose depth maps were fused at the point.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.views.lists import RawList
from pcfix.io.views.openmvs import positions
from pcfix.io.views.ply import read_header

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.model import FloatArray

_HEAD = 8
_WHAT = "COLMAP view list"


def read(path: Path) -> RawList:
    """Read a view list, and the positions from the PLY file beside it where it has one.

    Raises
    ------
    InputError
        If the counts do not add up to the file.
    """
    from pcfix.io.views.ragged import split_counted

    count, words = _words(path)
    start = np.empty(count + 1, np.int64)
    image = np.empty(len(words) - count, np.int32)
    used = split_counted(words, start, image)
    if used < 0:
        _complain(path, f"the list of point {-1 - used:,} of {count:,} does not end in the file")
    if used < len(words):
        _complain(path, f"{4 * (len(words) - used):,} bytes follow the lists of {count:,} points")
    if image.size and image.min() < 0:
        _complain(path, f"a point names image {int(image.min()) % 2**32}")
    xyz, resolution_m, notes = _beside(path, count)
    return RawList(path, _WHAT, start, image, None, xyz, resolution_m, notes)


def _words(path: Path) -> tuple[int, np.ndarray[tuple[int], np.dtype[np.uint32]]]:
    size = path.stat().st_size
    if size <= _HEAD or size % 4:
        _complain(path, f"its {size:,} bytes are not one number of 8 bytes and more of 4")
    with path.open("rb") as stream:
        count = int.from_bytes(stream.read(_HEAD), "little")
    if count == 0 or count > (size - _HEAD) // 4:
        _complain(path, f"it would hold {count:,} points in {size:,} bytes")
    return count, np.memmap(path, "<u4", "r", offset=_HEAD)


def _complain(path: Path, what: str) -> None:
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
    header = read_header(ply)
    if header.vertices != count:
        note = (
            f"{ply}: has {header.vertices:,} points and {path.name} has {count:,}; its positions"
            " are not used."
        )
        return None, 0.0, (note,)
    return *positions(header), ()

"""Write cloud optimised point clouds: LAZ whose chunks are the nodes of an octree (COPC 1.0).

A cube around the cloud is halved along its axes again and again. A node takes the points that are
the first of one of its 128 x 128 x 128 cells and in no node above it, or all that are left where
its part of the cube has few. First means first in the order of the curve of Morton, which goes
through all cells of a cube before it leaves it: along the curve a point is the first of a cell
where the point before it lies outside, so one pass along it tells the node of every point.

The points lie in a file beside the target until all are known; runs of them are sorted there by
their place along the curve, and merged leaf by leaf. So memory is bounded by the size of a run.

copclib 2.6.3 would write the octree, not what else a cloud has: it takes no VLR but the WKT, no
EVLR, and no names of extra dimensions.
"""

from __future__ import annotations

import mmap
import os
import struct
import tempfile
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

import laspy
import lazrs
import numpy as np
import numpy.typing as npt
from laspy.vlrs.known import LasZipVlr
from laspy.vlrs.vlr import VLR

from pcfix.errors import SettingError
from pcfix.io.las.source import CHUNK_POINTS, Record, RecordList
from pcfix.model import FloatArray, IntArray

Keys = npt.NDArray[np.uint64]
"""Places along the curve: three bits, of z, y and x, for each halving of the cube."""

SUFFIX = ".copc.laz"
LEAF_POINTS = 50_000
"""A node takes all points where its part of the cube has no more."""
HALVINGS, _CELLS = 21, 7
"""Of the cube, of which keys know; of a node, down to its cells."""
_FORMATS = (6, 7, 8)
_INFO = "<5d2Q2d88x"
_ENTRY = struct.Struct("<4iQ2i")
_EVLR_HEAD = struct.Struct("<2x16sHQ32s")
_PLACES = np.uint64(8) ** np.arange(HALVINGS, dtype=np.uint64)
_SPREAD = [
    (np.uint64(shift), np.uint64(mask))
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    )
]
"""How 21 bits come to stand three apart, step by step."""


def is_copc(path: Path) -> bool:
    """Whether the name of an output asks for COPC."""
    return path.name.lower().endswith(SUFFIX)


def check_copc(path: Path, header: laspy.LasHeader) -> None:
    """Refuse what COPC 1.0 cannot hold; a `SettingError`."""
    number, version = header.point_format.id, str(header.version)
    if number not in _FORMATS:
        wrong = f"point formats 6 to 8, and the output has {number}"
    elif version != "1.4" or header.extra_header_bytes:
        wrong = "the header of LAS 1.4 alone, and the output has another or a longer one"
    else:
        return
    raise SettingError(f"{path}: COPC has {wrong}; give a name without '.copc'.")


class Cube(NamedTuple):
    """The cube that the octree halves, from its lowest corner."""

    header: laspy.LasHeader
    low: IntArray
    """As integers of the file."""
    side: float

    def keys(self, points: npt.NDArray[Any]) -> Keys:
        """Return the places of points along the curve."""
        keys = np.zeros(len(points), np.uint64)
        for axis, name in enumerate("XYZ"):
            cells = self.header.scales[axis] / self.side * 2**HALVINGS
            place = (points[name] - np.float64(self.low[axis])) * cells
            bits = np.minimum(place, 2**HALVINGS - 1).astype(np.uint64)
            for shift, mask in _SPREAD:
                bits = (bits | (bits << shift)) & mask
            keys |= bits << np.uint64(axis)
        return keys

    def info(self, hierarchy: tuple[int, int], gps_time: FloatArray) -> bytes:
        """Return the COPC info VLR's data; `hierarchy` is where its root page is, and its size."""
        half = self.side / 2.0
        centre = self.low * self.header.scales + self.header.offsets + half
        spacing = self.side / 2**_CELLS
        return struct.pack(_INFO, *centre, half, spacing, *hierarchy, *gps_time)


class SortedRuns:
    """Points in a file, brought into runs that are sorted by their places along the curve."""

    def __init__(self, points: BinaryIO, keys: BinaryIO, count: int, cube: Cube) -> None:
        self._points, self._cube = points, cube
        self._dtype = cube.header.point_format.dtype()
        self._firsts = range(0, count, CHUNK_POINTS)
        self.starts = np.zeros(len(self._firsts), np.int64)
        self.stops = np.array([min(CHUNK_POINTS, count - first) for first in self._firsts])
        for first, length in zip(self._firsts, self.stops.tolist(), strict=True):
            rows = self._read(first, length)
            places = cube.keys(rows)
            order = np.argsort(places, kind="stable")
            points.seek(first * self._dtype.itemsize)
            points.write(rows[order].tobytes())
            keys.write(places[order].tobytes())
        keys.flush()
        self._map = mmap.mmap(keys.fileno(), 0, access=mmap.ACCESS_READ)

    def _read(self, first: int, count: int) -> npt.NDArray[Any]:
        self._points.seek(first * self._dtype.itemsize)
        return np.frombuffer(self._points.read(count * self._dtype.itemsize), self._dtype)

    def cuts(self, starts: IntArray, stops: IntArray, keys: Keys) -> IntArray:
        """Return where keys lie between so many places of each run, shape (keys, runs)."""
        whole = np.frombuffer(self._map, np.uint64)
        return np.column_stack(
            [
                start + np.searchsorted(whole[first + start : first + stop], keys)
                for first, start, stop in zip(self._firsts, starts, stops, strict=True)
            ]
        )

    def merged(self, starts: IntArray, stops: IntArray) -> tuple[npt.NDArray[Any], Keys]:
        """Return points of all runs in the order of the curve, and their keys."""
        parts = [
            self._read(first + start, stop - start)
            for first, start, stop in zip(
                self._firsts, starts.tolist(), stops.tolist(), strict=True
            )
            if stop > start
        ]
        points = np.concatenate(parts)
        keys = self._cube.keys(points)
        order = np.argsort(keys, kind="stable")
        return points[order], keys[order]

    def forget(self) -> None:
        """Let go of what was looked at of the keys."""
        if hasattr(mmap, "MADV_DONTNEED"):
            self._map.madvise(mmap.MADV_DONTNEED)


class Nodes:
    """The nodes of an octree on their way into a LAZ file, a chunk each."""

    def __init__(self, stream: BinaryIO, laz: Any, jobs: int | None) -> None:
        self._stream, self._laz, self._start = stream, laz, stream.tell()
        self._single = jobs == 1
        kind = lazrs.LasZipCompressor if self._single else lazrs.ParLasZipCompressor
        self._compressor = kind(stream, laz)
        self._entries: list[tuple[int, ...]] = []
        self._chunks: list[npt.NDArray[np.uint8]] = []
        self._waiting, self._begun = 0, False

    def add(self, level: int, prefix: int, points: npt.NDArray[Any]) -> bool:
        """Take a node by its level and the first bits of its keys; return whether some are out."""
        place = (sum((prefix >> 3 * i + axis & 1) << i for i in range(level)) for axis in range(3))
        self._entries.append((level, *place, len(points)))
        if len(points):
            self._chunks.append(np.ascontiguousarray(points).view(np.uint8))
            self._waiting += len(points)
        if self._waiting < CHUNK_POINTS:
            return False
        self._compress()
        return True

    def _compress(self) -> None:
        if self._single:  # its `compress_chunks` leaves an empty chunk behind
            for chunk in self._chunks:
                if self._begun:
                    self._compressor.finish_current_chunk()
                self._compressor.compress_many(chunk)
                self._begun = True
        elif self._chunks:
            self._compressor.compress_chunks(self._chunks)
        self._chunks, self._waiting = [], 0

    def finish(self) -> bytes:
        """Write what is left, and return the page of the hierarchy; the stream is at its end."""
        self._compress()
        self._compressor.done()
        self._stream.seek(self._start)
        sizes = iter(lazrs.read_chunk_table(self._stream, self._laz))
        offset, page = self._start + 8, []
        for *key, count in self._entries:
            length = next(sizes)[1] if count else 0
            page.append((*key, offset if count else 0, length, count))
            offset += length
        self._stream.seek(0, os.SEEK_END)
        return b"".join(_ENTRY.pack(*entry) for entry in sorted(page))


class Octree:
    """The division of a cube into nodes, in the order of the curve."""

    def __init__(self, runs: SortedRuns, nodes: Nodes) -> None:
        self._runs, self._nodes = runs, nodes
        self._open: list[list[npt.NDArray[Any]]] = [[] for _ in range(HALVINGS)]
        self._last = np.zeros(0, np.uint64)
        self.divide(0, 0, runs.starts, runs.stops)

    def divide(self, level: int, prefix: int, starts: IntArray, stops: IntArray) -> None:
        """Write the nodes of a cube, which has so many places of each run."""
        if (stops - starts).sum() <= LEAF_POINTS or level == HALVINGS:
            points, keys = self._runs.merged(starts, stops)
            levels = self._levels(keys)
            for above in range(level):
                self._open[above].append(points[levels == above])
            rest = points[levels >= level]
            if len(rest):
                self._add(level, prefix, rest)
            return
        bits = np.uint64(3 * (HALVINGS - level - 1))
        first = np.arange(8 * prefix, 8 * prefix + 9, dtype=np.uint64) << bits
        cuts = self._runs.cuts(starts, stops, first)
        for child in range(8):
            if (cuts[child] < cuts[child + 1]).any():
                self.divide(level + 1, 8 * prefix + child, cuts[child], cuts[child + 1])
        self._add(level, prefix, np.concatenate(self._open[level]))
        self._open[level] = []

    def _add(self, level: int, prefix: int, points: npt.NDArray[Any]) -> None:
        if self._nodes.add(level, prefix, points):
            self._runs.forget()

    def _levels(self, keys: Keys) -> IntArray:
        """Return at which level of the octree points are the first of a cell."""
        joined = np.concatenate([self._last, keys])
        self._last = keys[-1:]
        parted = np.searchsorted(_PLACES, joined[1:] ^ joined[:-1], side="right")
        levels = np.where(parted == 0, HALVINGS, np.maximum(HALVINGS + 1 - parted - _CELLS, 0))
        return levels if len(levels) == len(keys) else np.concatenate([[0], levels])


class CopcWriter:
    """What a `laspy.LasWriter` writes points by: a LAZ backend of its own, and its point writer.

    Parameters
    ----------
    folder : path
        Where a temporary file goes, as large as the points are without compression.
    jobs : int, optional
        1 compresses in one thread; the bytes are the same.

    Attributes
    ----------
    hierarchy : Record
        The EVLR that must be the first behind the points, once these are done.
    """

    hierarchy: Record

    def __init__(self, folder: Path, jobs: int | None = None) -> None:
        self._folder, self._jobs = folder, jobs
        self._spill = _scratch(folder)
        self._count, self._ends = 0, np.array([[2**31] * 3, [-(2**31)] * 3])
        self._gps_time = np.array([np.inf, -np.inf])

    def is_available(self) -> bool:
        """Answer laspy."""
        return True

    def create_writer(self, dest: BinaryIO, header: laspy.LasHeader) -> CopcWriter:
        """Take the file to write, and its header, which laspy keeps up to date."""
        self._stream, self._header = dest, header
        form = header.point_format
        self._laz = lazrs.LazVlr.new_for_compression(form.id, form.num_extra_bytes, True)
        return self

    def write_initial_header_and_vlrs(self, header: laspy.LasHeader, encoding_errors: str) -> None:
        """Write the header, with the two records that a COPC file has."""
        self._info = VLR("copc", 1, "COPC info VLR", bytes(struct.calcsize(_INFO)))
        laz = LasZipVlr(self._laz.record_data())
        if not any(vlr.user_id == "LASF_Projection" for vlr in header._vlrs):
            header.global_encoding.wkt = True  # copclib and others read nothing without it
        header._vlrs = RecordList([self._info, *header._vlrs, laz])
        header.write_to(self._stream, encoding_errors=encoding_errors)

    def write_updated_header(self, header: laspy.LasHeader, encoding_errors: str) -> None:
        """Write the header again, once all points are known."""
        self._stream.seek(0)
        header.write_to(self._stream, ensure_same_size=True, encoding_errors=encoding_errors)

    def write_points(self, points: laspy.PackedPointRecord) -> None:
        """Put points aside."""
        rows = points.array
        self._spill.write(rows.tobytes())
        self._count += len(rows)
        for end, least in enumerate((np.min, np.max)):
            ends = [self._ends[end], [int(least(rows[axis])) for axis in "XYZ"]]
            self._ends[end] = least(ends, axis=0)
            self._gps_time[end] = least([self._gps_time[end], least(rows["gps_time"])])

    def forget(self) -> None:
        """Let go of the points that were put aside, however it ended."""
        self._spill.close()

    def done(self) -> None:
        """Sort the points, and write them node by node."""
        if not self._count:
            self._ends[:], self._gps_time[:] = 0, 0.0
        low, high = self._ends
        # no larger than the cloud: copclib takes the header's extent for the side
        side = float((np.maximum(high - low, 1) * self._header.scales).max())
        cube = Cube(self._header, low, side)
        nodes = Nodes(self._stream, self._laz, self._jobs)
        with _scratch(self._folder) as keys:
            if self._count:
                Octree(SortedRuns(self._spill, keys, self._count, cube), nodes)
            else:
                nodes.add(0, 0, np.zeros(0, np.uint8))
        page = nodes.finish()
        self.hierarchy = Record(_EVLR_HEAD.pack(b"copc", 1000, len(page), b"EPT Hierarchy"), page)
        start = self._stream.tell() + _EVLR_HEAD.size
        self._info.record_data = cube.info((start, len(page)), self._gps_time)


def _scratch(folder: Path) -> BinaryIO:
    return cast(BinaryIO, tempfile.TemporaryFile(dir=folder, prefix=".", suffix=".part"))

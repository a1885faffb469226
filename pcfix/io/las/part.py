"""A part of a cloud: points within bounds, read by nodes of COPC, and coarse levels of COPC."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import lazrs
import numpy as np
from laspy.copc import Bounds, CopcReader, OctreeNode, load_octree_for_query

from pcfix.errors import SettingError, bad_file
from pcfix.model import BoolArray, FloatArray

if sys.platform == "win32":
    from pathlib import WindowsPath as AnyPath
else:
    from pathlib import PosixPath as AnyPath

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Part:
    """What is asked for of a cloud."""

    bounds: Box | None = None  # west, south, east, north, metres; points on the edges belong to it
    resolution: float | None = None  # of COPC: levels down to the first with this spacing, metres

    def __str__(self) -> str:
        words = []
        if self.bounds is not None:
            words.append("within " + ",".join(f"{one:.12g}" for one in self.bounds))
        if self.resolution is not None:
            words.append(f"at a resolution of {self.resolution:g} m")
        return " ".join(words)

    def holds(self, points: laspy.ScaleAwarePointRecord) -> BoolArray:
        """Return which points of a chunk are within the bounds."""
        if self.bounds is None:
            return np.ones(len(points), np.bool_)
        steps = (np.reshape(self.bounds, (2, 2)) - points.offsets[:2]) / points.scales[:2]
        (west, south), (east, north) = np.ceil(steps[0] - 1e-4), np.floor(steps[1] + 1e-4)
        x, y = points.array["X"], points.array["Y"]
        return np.asarray((x >= west) & (x <= east) & (y >= south) & (y <= north))


class CloudPart(AnyPath):
    """The path of a part of a cloud.

    Once opened it has its `extent`, the number of points and their lowest and highest coordinates,
    and `held`, the number of all points of the cloud.
    """

    part: Part = Part()
    held: int = 0
    extent: tuple[int, FloatArray, FloatArray] | None = None


def cloud_part(path: Path, options: Any) -> Path:
    """Return a path of the part that the options of a command ask for, if they do."""
    part = Part(getattr(options, "bounds", None), getattr(options, "read_resolution", None))
    if part == Part():
        return path
    west, south, east, north = part.bounds or (0.0, 0.0, 1.0, 1.0)
    if not (west < east and south < north):
        words = f"bounds {west:g},{south:g},{east:g},{north:g} must be west,south,east,north."
        raise SettingError("option.range", words, option="bounds")
    asked = CloudPart(path)
    asked.part = part
    return asked


def part_report(path: Path) -> dict[str, Any] | None:
    """Return what a summary says of the part that was read; None where that was all."""
    if not isinstance(path, CloudPart) or path.extent is None:
        return None
    return {
        "points": path.extent[0],
        "of": path.held,
        "bounds": None if path.part.bounds is None else list(path.part.bounds),
        "read_resolution": path.part.resolution,
    }


def is_copc(header: laspy.LasHeader) -> bool:
    """Whether a cloud that is read is COPC."""
    return bool(len(header.vlrs) and isinstance(header.vlrs[0], laspy.copc.CopcInfoVlr))


def nodes_in(
    path: Path, part: Part, selection: laspy.DecompressionSelection, most: int
) -> Iterator[laspy.ScaleAwarePointRecord]:
    """Yield points of the nodes of a COPC file that a part may touch, at most `most` at a time.

    They come in the order of the file; a node with more points is one batch.
    """
    with CopcReader.open(path) as reader:
        header, info, levels, box = reader.header, reader.copc_info, None, None
        if part.resolution is not None:
            halvings = math.ceil(math.log2(info.spacing / part.resolution))
            levels = range(max(halvings, 0) + 1)
        if part.bounds is not None:
            corners = np.array(part.bounds).reshape(2, 2)
            box = Bounds(*corners).ensure_3d(header.mins, header.maxs)
        found = load_octree_for_query(reader.source, info, reader.root_page, box, levels)
        nodes = sorted((one for one in found if one.point_count), key=lambda one: one.offset)
        if sum(one.point_count for one in nodes) > header.point_count:
            raise ValueError("its octree has more points than its header")
        while nodes:
            counts = np.cumsum([one.point_count for one in nodes])
            count = max(int(np.searchsorted(counts, most, side="right")), 1)
            yield _unpacked(reader, nodes[:count], selection)
            del nodes[:count]


def _unpacked(
    reader: CopcReader, nodes: list[OctreeNode], selection: laspy.DecompressionSelection
) -> laspy.ScaleAwarePointRecord:
    """Return the points of some nodes."""
    header, data = reader.header, bytearray()
    for one in nodes:
        reader.source.seek(one.offset)
        data += reader.source.read(one.byte_size)
    rows = np.zeros(sum(one.point_count for one in nodes), header.point_format.dtype())
    table = [(one.point_count, one.byte_size) for one in nodes]
    lazrs.decompress_points_with_chunk_table(
        data, reader.laszip_vlr.record_data, rows.view(np.uint8), table, selection.to_lazrs()
    )
    return laspy.ScaleAwarePointRecord(rows, header.point_format, header.scales, header.offsets)


def extent_of(
    path: CloudPart, header: laspy.LasHeader, chunks: Iterator[laspy.ScaleAwarePointRecord]
) -> tuple[int, FloatArray, FloatArray]:
    """Return how many points a part has, and where; an `InputError` if it has none."""
    if path.part.resolution is not None and not is_copc(header):
        sentence = f"{path}: is not COPC and has no coarser levels to read. Omit --read-resolution."
        raise SettingError("cloud.not_copc", sentence, path=path)
    if path.extent is None:
        count, ends = 0, []
        for points in chunks:
            count += len(points)
            xyz = [points.array[axis] for axis in "XYZ"]
            ends.append([[one.min() for one in xyz], [one.max() for one in xyz]])
        if not count:
            low, high = header.mins, header.maxs
            reach = ",".join(f"{one:.12g}" for one in (*low[:2], *high[:2]))
            sentence = f"no point lies {path.part}. The cloud reaches over {reach}."
            raise bad_file(path, "cloud.bounds", sentence)
        low, high = np.min(ends, axis=0)[0], np.max(ends, axis=0)[1]
        mins, maxs = (end * header.scales + header.offsets for end in (low, high))
        path.extent, path.held = (count, mins, maxs), int(header.point_count)
    return path.extent

"""A part of a cloud: points within bounds, read by nodes of COPC, and coarse levels of COPC."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import laspy
import lazrs
import numpy as np
from laspy.copc import Bounds, CopcReader, load_octree_for_query

from pcfix.model import BoolArray, FloatArray

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class CloudPart:
    """A part of the cloud in a file; see `pcfix.io.tiles.part_of`, which counts its points."""

    path: Path
    bounds: Box | None = None  # west, south, east, north, metres; points on the edges belong to it
    resolution: float | None = None  # of COPC: levels down to the first with this spacing, metres
    points: int = 0
    points_of_file: int = 0
    # the lowest and highest coordinates of the part, shape (3,), metres
    mins: FloatArray = field(default_factory=lambda: np.zeros(3))
    maxs: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __str__(self) -> str:
        return str(self.path)

    def holds(self, points: laspy.ScaleAwarePointRecord) -> BoolArray:
        """Return which points of a chunk are within the bounds."""
        if self.bounds is None:
            return np.ones(len(points), np.bool_)
        steps = (np.reshape(self.bounds, (2, 2)) - points.offsets[:2]) / points.scales[:2]
        (west, south), (east, north) = np.ceil(steps[0] - 1e-4), np.floor(steps[1] + 1e-4)
        x, y = points.array["X"], points.array["Y"]
        return np.asarray((x >= west) & (x <= east) & (y >= south) & (y <= north))


def part_report(cloud: object) -> dict[str, Any] | None:
    """Return what a summary says of the part that was read; None unless the cloud is a part."""
    if not isinstance(cloud, CloudPart):
        return None
    return {
        "points": cloud.points,
        "of": cloud.points_of_file,
        "bounds": None if cloud.bounds is None else list(cloud.bounds),
        "read_resolution": cloud.resolution,
    }


def is_copc(header: laspy.LasHeader) -> bool:
    """Whether a cloud that is read is COPC."""
    return bool(len(header.vlrs) and isinstance(header.vlrs[0], laspy.copc.CopcInfoVlr))


def nodes_in(part: CloudPart, most: int) -> Iterator[laspy.ScaleAwarePointRecord]:
    """Yield points of the nodes of a COPC file that a part may touch, at most `most` at a time.

    They come in the order of the file; a node with more points is one batch.
    """
    with CopcReader.open(part.path) as reader:
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
            data = bytearray()
            for one in nodes[:count]:
                reader.source.seek(one.offset)
                data += reader.source.read(one.byte_size)
            rows = np.zeros(counts[count - 1], header.point_format.dtype())
            table = [(one.point_count, one.byte_size) for one in nodes[:count]]
            lazrs.decompress_points_with_chunk_table(
                data, reader.laszip_vlr.record_data, rows.view(np.uint8), table,
                laspy.DecompressionSelection.all().to_lazrs(),
            )  # fmt: skip
            yield laspy.ScaleAwarePointRecord(
                rows, header.point_format, header.scales, header.offsets
            )
            del nodes[:count]

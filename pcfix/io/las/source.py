"""Read a LAS or LAZ file chunk by chunk, and keep what laspy would rewrite."""

from __future__ import annotations

import struct
from contextlib import contextmanager
from typing import TYPE_CHECKING

import laspy
import lazrs
import numpy as np

from pcfix.errors import InputError
from pcfix.io.files import check_input
from pcfix.io.las.records import read_records

if TYPE_CHECKING:
    import os
    from collections.abc import Iterator
    from pathlib import Path

    from pcfix.model import FloatArray

IDENTITY_PLACE, _IDENTITY_SIZE = 26, 68
"""Where the header names system, software and date (LAS 1.4 R15, table 3)."""


@contextmanager
def las_errors(path: Path) -> Iterator[None]:
    """Turn whatever the LAS libraries raise into one sentence about the file."""
    try:
        yield
    except (
        laspy.LaspyException,
        lazrs.LazrsError,
        struct.error,
        ValueError,
        IndexError,
        OverflowError,
        OSError,
    ) as error:
        reason = str(error).strip().rstrip(".") or type(error).__name__
        raise InputError(
            f"{path}: is damaged, or is not LAS or LAZ ({reason}); export or copy it again."
        ) from error


class LasSource:
    """An open LAS or LAZ file.

    Use it as a context manager.

    Attributes
    ----------
    path : Path
    header : laspy.LasHeader
    vlrs, evlrs : list of Record
        See `read_records`.
    identity : bytes
        System identifier, generating software and date, as they are in the file: other
        software writes there what laspy would not.
    """

    def __init__(self, path: str | os.PathLike[str], jobs: int | None = None) -> None:
        """Open and check the header.

        Raises
        ------
        InputError
            If the file is missing, damaged or empty, or its scales or offsets are unusable.
        """
        self.path = check_input(path)
        with las_errors(self.path):
            with self.path.open("rb") as stream:
                self.vlrs, self.evlrs = read_records(stream)
                stream.seek(IDENTITY_PLACE)
                self.identity = stream.read(_IDENTITY_SIZE)
            self._reader = laspy.open(self.path, laz_backend=backend(jobs))
        self.header: laspy.LasHeader = self._reader.header
        try:
            self._check_header()
        except BaseException:
            self._reader.close()
            raise

    def __enter__(self) -> LasSource:
        return self

    def __exit__(self, *exception: object) -> None:
        self._reader.close()

    def __len__(self) -> int:
        return int(self.header.point_count)

    def _check_header(self) -> None:
        scales, offsets = self.header.scales, self.header.offsets
        if not (np.isfinite(scales).all() and (scales > 0).all() and np.isfinite(offsets).all()):
            raise InputError(
                f"{self.path}: the header's scales {scales.tolist()} and offsets"
                f" {offsets.tolist()} must be finite and the scales positive; export it again."
            )
        if len(self) == 0:
            raise InputError(f"{self.path}: holds no points.")

    def chunks(self, size: int) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Yield all points, in order, at most `size` at a time.

        Raises
        ------
        InputError
            If the file ends before its last point.
        """
        read = 0
        while read < len(self):
            with las_errors(self.path):
                points = self._reader.read_points(size)
            if len(points) < min(size, len(self) - read):
                raise InputError(
                    f"{self.path}: is cut short: the header promises {len(self):,} points,"
                    f" the file holds {read + len(points):,}; copy it again."
                )
            read += len(points)
            yield points

    def dimension(self, points: laspy.ScaleAwarePointRecord, name: str) -> FloatArray:
        """Return one dimension of a chunk, scaled, as float64.

        Raises
        ------
        InputError
            If the cloud has no such dimension.
        """
        names = list(self.header.point_format.dimension_names)
        if name not in names:
            extra = list(self.header.point_format.extra_dimension_names)
            listing = f"its extra dimensions are {', '.join(extra)}" if extra else "it has no extra"
            raise InputError(f"{self.path}: has no dimension {name}; {listing}.")
        return np.asarray(points[name], dtype=np.float64)


def backend(jobs: int | None) -> laspy.LazBackend:
    """Return the LAZ backend: one thread when asked for one job, else all cores."""
    return laspy.LazBackend.Lazrs if jobs == 1 else laspy.LazBackend.LazrsParallel


def coordinates(points: laspy.ScaleAwarePointRecord) -> FloatArray:
    """Return x, y, z of a chunk, shape (n, 3), metres."""
    xyz = np.empty((len(points), 3))
    for axis, name in enumerate("XYZ"):
        np.multiply(points.array[name], points.scales[axis], out=xyz[:, axis])
        xyz[:, axis] += points.offsets[axis]
    return xyz


def centring_steps(path: str | os.PathLike[str], jobs: int | None = None) -> tuple[int, ...]:
    """Return by how many steps each integer axis must be moved to have its middle at zero."""
    with LasSource(path, jobs) as source:
        bounds = [
            [(int(p.array[axis].min()), int(p.array[axis].max())) for axis in "XYZ"]
            for p in source.chunks(10_000_000)
        ]
    low, high = np.min(bounds, axis=0)[:, 0], np.max(bounds, axis=0)[:, 1]
    return tuple((-(low + high) // 2).tolist())


def read_xyz(path: str | os.PathLike[str]) -> FloatArray:
    """Return all coordinates of a cloud that fits in memory, shape (n, 3), metres."""
    with LasSource(path) as source:
        return np.vstack([coordinates(points) for points in source.chunks(10_000_000)])

"""Point formats: class 40 needs LAS 1.4 formats 6 and up, which hold all that 0 to 5 hold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import laspy
import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

Records: TypeAlias = Any
"""A numpy array of point records, whose dtype has named fields."""

UPGRADE = {0: 6, 1: 6, 2: 7, 3: 7, 4: 9, 5: 10, 6: 6, 7: 7, 8: 8, 9: 9, 10: 10}
"""The format that each one becomes (LAS 1.4 R15, table 6 and on)."""

SCAN_ANGLE_STEP_DEG = 0.006
"""Unit of the scan angle in formats 6 and up; whole degrees before."""

_INT32 = np.iinfo(np.int32)

_PACKED = (
    "return_number",
    "number_of_returns",
    "scan_direction_flag",
    "edge_of_flight_line",
    "classification",
    "synthetic",
    "key_point",
    "withheld",
)


class OutOfRangeError(Exception):
    """A coordinate leaves the 32 bits that LAS has; move the offsets and write again."""


def upgraded(point_format: laspy.PointFormat) -> laspy.PointFormat:
    """Return the output's point format, with the input's extra dimensions."""
    return _with_extra(UPGRADE[point_format.id], point_format)


def _with_extra(format_id: int, like: laspy.PointFormat) -> laspy.PointFormat:
    new = laspy.PointFormat(format_id)
    new.dimensions.extend(like.extra_dimensions)
    return new


def convert(
    points: laspy.ScaleAwarePointRecord, point_format: laspy.PointFormat
) -> laspy.ScaleAwarePointRecord:
    """Return the points in another format, which may have more or fewer extra dimensions.

    Values that both formats have come over bit for bit; dimensions that are new are zero.
    """
    array: Records = np.zeros(len(points), point_format.dtype())
    new = laspy.ScaleAwarePointRecord(array, point_format, points.scales, points.offsets)
    if points.point_format.id == point_format.id and _one_begins_the_other(points.array, array):
        size = min(points.array.itemsize, array.itemsize)
        _bytes(array)[:, :size] = _bytes(points.array)[:, :size]
        return new
    for name in points.array.dtype.names:
        if name in array.dtype.names and name != "bit_fields":
            array[name] = points.array[name]
    if points.point_format.id == point_format.id:
        array["bit_fields"] = points.array["bit_fields"]
        return new
    for name in _PACKED:
        new[name][:] = np.asarray(points[name])
    _convert_scan_angle(points.array, array)
    return new


def _one_begins_the_other(one: Records, other: Records) -> bool:
    layouts = [
        [(name, *array.dtype.fields[name][:2]) for name in array.dtype.names]
        for array in (one, other)
    ]
    return all(a == b for a, b in zip(*layouts, strict=False))


def _bytes(array: Records) -> Records:
    return np.ascontiguousarray(array).view(np.uint8).reshape(len(array), array.itemsize)


def _convert_scan_angle(old: Records, new: Records) -> None:
    if "scan_angle" in new.dtype.names and "scan_angle_rank" in old.dtype.names:
        new["scan_angle"] = np.rint(old["scan_angle_rank"] / SCAN_ANGLE_STEP_DEG)
    elif "scan_angle_rank" in new.dtype.names and "scan_angle" in old.dtype.names:
        new["scan_angle_rank"] = np.rint(old["scan_angle"] * SCAN_ANGLE_STEP_DEG)


def shifted(
    points: laspy.ScaleAwarePointRecord,
    header: laspy.LasHeader,
    steps: npt.NDArray[np.int64],
) -> laspy.ScaleAwarePointRecord:
    """Return points in the header's format, moved by whole steps of its scale, shape (n, 3).

    Raises
    ------
    OutOfRangeError
        If a coordinate does not fit 32 bits.
    """
    new = convert(points, header.point_format)
    for axis, name in enumerate("XYZ"):
        moved = points.array[name].astype(np.int64) + steps[:, axis]
        if moved.size and (moved.min() < _INT32.min or moved.max() > _INT32.max):
            raise OutOfRangeError(name)
        new.array[name] = moved
    new.offsets = header.offsets
    return new

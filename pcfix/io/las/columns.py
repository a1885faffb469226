"""What a point record holds: LAS point formats, and the extra dimensions of a correction.

The extra dimensions are integers with a scale, so that LAZ packs them well. Each has a narrow type,
which nearly every cloud fits, and a wide one; a cloud with a value outside the narrow range is
written again with the wide types. `COLUMNS` and `UNSURE` are all that is said of them: files and
PDAL's stage take name, type and unit from them, and a test holds the documentation to them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError
from pcfix.model import BoolArray, Correction, FloatArray
from pcfix.options.correct import Dimensions, Unsure

if TYPE_CHECKING:
    import laspy


Records: TypeAlias = Any
"""A numpy array of point records, whose dtype has named fields."""


UPGRADE = {0: 6, 1: 6, 2: 7, 3: 7, 4: 9, 5: 10, 6: 6, 7: 7, 8: 8, 9: 9, 10: 10}
"""The format that each one becomes (LAS 1.4 R15, table 6 and on)."""

SCAN_ANGLE_STEP_DEG = 0.006
"""Unit of the scan angle in formats 6 and up; whole degrees before."""

_INT32 = np.iinfo(np.int32)

_PACKED = (
    *("return_number", "number_of_returns", "scan_direction_flag", "edge_of_flight_line"),
    *("classification", "synthetic", "key_point", "withheld"),
)


class OutOfRangeError(Exception):
    """A coordinate leaves the 32 bits that LAS has; move the offsets and write again."""


class TooNarrowError(Exception):
    """A value does not fit the narrow types; write the file again with the wide ones."""


@dataclass(frozen=True, slots=True)
class Column:
    """One extra dimension."""

    name: str
    of: str  # the attribute of `pcfix.Correction` that it holds; empty for the class before
    narrow: str  # types
    wide: str
    scale: float  # 0 means the file's own scale of that axis; 1 means a count
    description: str  # in the file, at most 31 letters
    saturates: bool = False  # the largest value means "or more"
    least: int | None = None  # in steps of the scale

    def dtype(self, *, wide: bool) -> np.dtype[Any]:
        """Return the numpy type."""
        return np.dtype(self.wide if wide else self.narrow)


COLUMNS = (
    *(
        Column(f"Shift{axis}", "shift_m", "int16", "int32", 0.0, f"true minus apparent {axis}")
        for axis in "XYZ"
    ),
    Column(
        *("WaterDepth", "depth_m", "uint16", "uint32", 0.001, "below the water surface, m"),
        least=1,  # a submerged point is never at zero depth
    ),
    Column(
        *("RayMiss", "ray_miss_m", "uint16", "uint32", 0.0001, "rms distance from the rays, m"),
        saturates=True,
    ),
    Column(
        *("SigmaZ", "sigma_z_m", "uint16", "uint32", 0.0001, "formal standard error of Z, m"),
        saturates=True,
    ),
    Column("Incidence", "incidence_deg", "uint16", "uint16", 0.1, "largest angle in air, deg"),
    Column("RayCount", "ray_count", "uint16", "uint16", 1.0, "rays intersected", saturates=True),
    Column("SourceClass", "", "uint8", "uint8", 1.0, "class before the correction"),
)
UNSURE = Column("Unsure", "unsure", "uint8", "uint8", 1.0, "withheld: only flat rays see it")
"""Written where such points are withheld."""
SHIFTS = ("ShiftX", "ShiftY", "ShiftZ")
MINIMAL = ("ShiftZ", "RayCount")


def columns_for(dimensions: Dimensions, unsure: Unsure) -> tuple[Column, ...]:
    """Return the columns that ``--dimensions`` and ``--unsure`` ask for."""
    if dimensions == "none":
        return ()
    some = tuple(c for c in COLUMNS if dimensions == "all" or c.name in MINIMAL)
    return (*some, UNSURE) if unsure == "withhold" else some


def column_scale(column: Column, scales: FloatArray) -> float:
    """Return the scale of a column in a file with the given coordinate scales."""
    return float(scales[SHIFTS.index(column.name)]) if column.scale == 0.0 else column.scale


def shift_steps(correction: Correction, scales: FloatArray) -> npt.NDArray[np.int64]:
    """Return the shift in steps of the file's own scale, shape (n, 3)."""
    return np.rint(correction.shift_m / scales).astype(np.int64)


def filled(
    columns: tuple[Column, ...],
    correction: Correction,
    moved: npt.NDArray[np.int64],
    classes: npt.NDArray[Any],
    changed: BoolArray,
) -> Iterator[tuple[Column, BoolArray, npt.NDArray[Any]]]:
    """Yield each column, the rows that get values, and these as whole numbers of its scale.

    The rows are the `changed` ones, and for shifts all that moved. `moved` is from `shift_steps`,
    shape (n, 3); `classes`, shape (n,), are those before.
    """
    for column in columns:
        rows = changed | correction.moved if column.name in SHIFTS else changed
        if column.scale == 0.0:
            yield column, rows, moved[rows, SHIFTS.index(column.name)]
            continue
        value = (getattr(correction, column.of) if column.of else classes)[rows]
        if column.scale != 1.0:
            value = np.rint(value / column.scale)
        yield column, rows, value if column.least is None else np.maximum(value, column.least)


def fill(
    points: laspy.ScaleAwarePointRecord,
    columns: tuple[Column, ...],
    correction: Correction,
    moved: npt.NDArray[np.int64],
    rows: BoolArray,
) -> None:
    """Write the columns of the given rows, and the shift of all; the others keep zero.

    A `TooNarrowError` if a value does not fit its type and the type may be widened.
    """
    classes = np.array(points["classification"])
    for column, some, value in filled(columns, correction, moved, classes, rows):
        target = points.array[column.name]
        limits = np.iinfo(target.dtype)
        if column.saturates:
            value = np.minimum(value, limits.max)
        if value.size and (value.min() < limits.min or value.max() > limits.max):
            if target.dtype != column.dtype(wide=True):
                raise TooNarrowError
            step = column_scale(column, points.scales)
            reach = float(value.max() * step)
            sentence = f"{column.name} reaches {reach:g} m. Remove points far below the water."
            raise InputError("cloud.too_deep", sentence, dimension=column.name, value=reach)
        target[some] = value


def changed_rows(correction: Correction, withheld: BoolArray, *, withhold: bool) -> BoolArray:
    """Return the rows that get values: corrected ones, and uncorrected ones not yet withheld.

    An uncorrected point that is withheld in the input stays as it is, so that `restore` can
    distinguish it from one that pcfix withheld. Points that are withheld because they could not be
    transferred have the same mark, a depth.
    """
    marked = correction.uncorrected if withhold else correction.submerged
    return correction.corrected | (marked & ~withheld)


def unsure_anew(correction: Correction, withheld: BoolArray) -> Correction:
    """Return a correction in which no point that is withheld in the input is unsure.

    So `restore` can distinguish these from the unsure ones, which are withheld by pcfix.
    """
    if correction.unsure is None:
        return correction
    return replace(correction, unsure=correction.unsure & ~withheld)


def to_withhold(correction: Correction, *, withhold: bool) -> BoolArray:
    """Return the rows to be flagged: the unsure, and the uncorrected where these are withheld."""
    rows = correction.uncorrected if withhold else np.zeros(len(correction.outcome), np.bool_)
    return rows if correction.unsure is None else rows | correction.unsure


def convert(
    points: laspy.ScaleAwarePointRecord, point_format: laspy.PointFormat
) -> laspy.ScaleAwarePointRecord:
    """Return the points in another format, which may have more or fewer extra dimensions.

    Values that both formats have come over bit for bit; dimensions that are new are zero.
    """
    import laspy

    array: Records = np.zeros(len(points), point_format.dtype())
    new = laspy.ScaleAwarePointRecord(array, point_format, points.scales, points.offsets)
    same = points.point_format.id == point_format.id
    before = points.array.dtype
    if before.descr == array.dtype.descr[: len(before)]:  # new dimensions are last: copy whole rows
        new_rows, rows = (a.view((np.uint8, a.itemsize)) for a in (array, points.array))
        new_rows[:, : before.itemsize] = rows
        return new
    for name in before.names:
        if name in array.dtype.names and (same or name != "bit_fields"):
            array[name] = points.array[name]
    if same:
        return new
    for name in _PACKED:
        new[name][:] = np.asarray(points[name])
    old = points.array
    if "scan_angle" in array.dtype.names and "scan_angle_rank" in old.dtype.names:
        array["scan_angle"] = np.rint(old["scan_angle_rank"] / SCAN_ANGLE_STEP_DEG)
    elif "scan_angle_rank" in array.dtype.names and "scan_angle" in old.dtype.names:
        array["scan_angle_rank"] = np.rint(old["scan_angle"] * SCAN_ANGLE_STEP_DEG)
    return new


def move(points: laspy.ScaleAwarePointRecord, steps: npt.NDArray[np.int64]) -> None:
    """Move points by whole steps of their scale, shape (n, 3).

    An `OutOfRangeError` if a coordinate does not fit 32 bits.
    """
    for axis, name in enumerate("XYZ"):
        moved = points.array[name] + steps[:, axis]
        if moved.size and (moved.min() < _INT32.min or moved.max() > _INT32.max):
            raise OutOfRangeError(name)
        points.array[name] = moved

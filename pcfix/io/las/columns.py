"""What a point record holds: LAS point formats, and the extra dimensions of a correction.

The extra dimensions are integers with a scale, so that LAZ packs them well. Files and PDAL's
stage take their names, types and units from `COLUMNS`, and a test compares the documentation.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError, bad_file
from pcfix.model import BoolArray, Correction, FloatArray
from pcfix.options.correct import Dimensions

if TYPE_CHECKING:
    import laspy


# The format that each one becomes (LAS 1.4 R15, table 6 and on).
UPGRADE = {0: 6, 1: 6, 2: 7, 3: 7, 4: 9, 5: 10, 6: 6, 7: 7, 8: 8, 9: 9, 10: 10}

_INT32 = np.iinfo(np.int32)


@dataclass(frozen=True, slots=True)
class Column:
    """One extra dimension."""

    name: str
    of: str  # the attribute of `pcfix.Correction` that it holds; empty for the class before
    dtype: str
    scale: float  # 0 means the file's own scale of that axis; 1 means a count
    description: str  # in the file, at most 31 letters
    saturates: bool = False  # the largest value means "or more"
    least: int | None = None  # in steps of the scale


COLUMNS = (
    Column("ShiftX", "shift_m", "int32", 0.0, "true minus apparent X"),
    Column("ShiftY", "shift_m", "int32", 0.0, "true minus apparent Y"),
    Column("ShiftZ", "shift_m", "int32", 0.0, "true minus apparent Z"),
    # a submerged point is never at zero depth
    Column("WaterDepth", "depth_m", "uint32", 0.001, "below the water surface, m", least=1),
    Column("RayMiss", "ray_miss_m", "uint16", 0.0001, "rms distance from the rays, m", True),
    Column("SigmaZ", "sigma_z_m", "uint16", 0.0001, "formal standard error of Z, m", True),
    Column("Incidence", "incidence_deg", "uint16", 0.1, "largest angle in air, deg"),
    Column("RayCount", "ray_count", "uint16", 1.0, "rays intersected", True),
    Column("SourceClass", "", "uint8", 1.0, "class before the correction"),
)  # fmt: skip
# Written for the cells of rasters; see `pcfix.Outcome`.
OUTCOME = Column("Outcome", "outcome", "uint8", 1.0, "whether and why not corrected")
SHIFTS = ("ShiftX", "ShiftY", "ShiftZ")


def columns_for(dimensions: Dimensions) -> tuple[Column, ...]:
    """Return the columns that ``--dimensions`` asks for."""
    if dimensions == "none":
        return ()
    return tuple(c for c in COLUMNS if dimensions == "all" or c.name in ("ShiftZ", "RayCount"))


def column_scale(column: Column, scales: FloatArray) -> float:
    """Return the scale of a column in a file with the given coordinate scales."""
    return float(scales[SHIFTS.index(column.name)]) if column.scale == 0.0 else column.scale


class Changes(NamedTuple):
    """What a correction changes in n points of a file."""

    steps: npt.NDArray[np.int64]  # (3, n), the shift along each axis in steps of the file's scale
    flagged: BoolArray  # (n,), to be withheld
    values: list[tuple[Column, BoolArray, npt.NDArray[Any]]]  # whole numbers of some rows


def changes_of(
    columns: tuple[Column, ...],
    correction: Correction,
    classes: npt.NDArray[Any],
    withheld: BoolArray,
    scales: FloatArray,
) -> Changes:
    """Return the changes by a correction, and flags for uncorrected points.

    Classes and flags, shape (n,), are those of the input. Points that it withholds are not
    uncorrected here, so that `restore` can distinguish them from those that pcfix withheld. Points
    that are withheld because they could not be transferred have the same mark, a depth.
    """
    # by axis, because numpy is slow along the short one
    steps = np.array([np.rint(a / b) for a, b in zip(correction.shift_m.T, scales, strict=True)])
    steps = steps.astype(np.int64)
    changed = correction.corrected | (correction.uncorrected & ~withheld)
    values: list[tuple[Column, BoolArray, npt.NDArray[Any]]] = []
    for column in columns:
        if column.scale == 0.0:
            rows = changed | correction.moved
            values.append((column, rows, steps[SHIFTS.index(column.name)][rows]))
            continue
        value = (getattr(correction, column.of) if column.of else classes)[changed]
        if column.scale != 1.0:
            value = np.rint(value / column.scale)
        value = value if column.least is None else np.maximum(value, column.least)
        values.append((column, changed, value))
    return Changes(steps, correction.uncorrected, values)


def fill(points: "laspy.ScaleAwarePointRecord", changes: Changes) -> None:
    """Write the columns of the rows that change; the others keep zero."""
    for column, some, value in changes.values:
        target = points.array[column.name]
        limits = np.iinfo(target.dtype)
        if column.saturates:
            value = np.minimum(value, limits.max)
        if value.size and (value.min() < limits.min or value.max() > limits.max):
            step = column_scale(column, points.scales)
            reach = float(value.max() * step)
            sentence = f"{column.name} reaches {reach:g} m. Remove points far below the water."
            raise InputError("cloud.too_deep", sentence, dimension=column.name, value=reach)
        target[some] = value


def convert(
    points: "laspy.ScaleAwarePointRecord", point_format: "laspy.PointFormat"
) -> "laspy.ScaleAwarePointRecord":
    """Return the points in another format, which may have more or fewer extra dimensions.

    Values that both formats have come over bit for bit; dimensions that are new are zero.
    """
    import laspy

    array: Any = np.zeros(len(points), point_format.dtype())
    new = laspy.ScaleAwarePointRecord(array, point_format, points.scales, points.offsets)
    same = points.point_format.id == point_format.id
    old, after = points.array, array.dtype.fields or {}
    names = [name for name in old.dtype.names if name in after and (same or name != "bit_fields")]
    # the first fields, mostly all, have the same places: one copy of their bytes is ten times as
    # fast as one for each field
    size = 0
    while names and after[names[0]] == old.dtype.fields[names[0]] and after[names[0]][1] == size:
        size += after[names.pop(0)][0].itemsize
    bytes_of = [one.view(np.uint8).reshape(len(one), -1) for one in (array, old)]
    bytes_of[0][:, :size] = bytes_of[1][:, :size]
    for name in names:
        array[name] = old[name]
    if same:
        return new
    packed = ("return_number", "number_of_returns", "scan_direction_flag", "edge_of_flight_line")
    for name in (*packed, "classification", "synthetic", "key_point", "withheld"):
        new[name][:] = np.asarray(points[name])
    step_deg = 0.006  # of the scan angle in formats 6 and up; whole degrees before
    if "scan_angle" in array.dtype.names and "scan_angle_rank" in old.dtype.names:
        array["scan_angle"] = np.rint(old["scan_angle_rank"] / step_deg)
    elif "scan_angle_rank" in array.dtype.names and "scan_angle" in old.dtype.names:
        array["scan_angle_rank"] = np.rint(old["scan_angle"] * step_deg)
    return new


def move(points: "laspy.ScaleAwarePointRecord", steps: npt.NDArray[np.int64], path: Path) -> None:
    """Move points of a file by whole steps of their scale, shape (3, n).

    An `InputError` if a coordinate does not fit 32 bits.
    """
    for name, along in zip("XYZ", steps, strict=True):
        moved = points.array[name] + along
        if moved.size and (moved.min() < _INT32.min or moved.max() > _INT32.max):
            sentence = f"the scale of {name} is too fine for the result in 32 bits."
            sentence += " Write the cloud with a coarser scale first."
            raise bad_file(path, "cloud.scale", sentence)
        points.array[name] = moved

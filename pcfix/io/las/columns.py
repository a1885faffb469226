"""The extra dimensions that a correction leaves in the file: what, how wide, in which unit.

All are integers with a scale, so that LAZ packs them well. Each has a narrow type, which nearly
every cloud fits, and a wide one; a cloud with a value outside the narrow range is written again
with the wide types.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError

if TYPE_CHECKING:
    import laspy
    import numpy.typing as npt

    from pcfix.model import BoolArray, Correction, FloatArray
    from pcfix.options import Dimensions


class TooNarrowError(Exception):
    """A value does not fit the narrow types; write the file again with the wide ones."""


@dataclass(frozen=True, slots=True)
class Column:
    """One extra dimension. Scale 0 means the file's own scale of that axis; 1 means a count."""

    name: str
    narrow: str
    wide: str
    scale: float
    description: str
    saturates: bool = False

    def dtype(self, *, wide: bool) -> np.dtype[Any]:
        """Return the numpy type."""
        return np.dtype(self.wide if wide else self.narrow)


COLUMNS = (
    Column("ShiftX", "int16", "int32", 0.0, "true minus apparent X"),
    Column("ShiftY", "int16", "int32", 0.0, "true minus apparent Y"),
    Column("ShiftZ", "int16", "int32", 0.0, "true minus apparent Z"),
    Column("WaterDepth", "uint16", "uint32", 0.001, "below the water surface, m"),
    Column("RayMiss", "uint16", "uint32", 0.0001, "rms distance from the rays, m", True),
    Column("SigmaZ", "uint16", "uint32", 0.0001, "formal standard error of Z, m", True),
    Column("Incidence", "uint16", "uint16", 0.1, "largest angle in air, deg"),
    Column("RayCount", "uint16", "uint16", 1.0, "rays intersected", True),
    Column("SourceClass", "uint8", "uint8", 1.0, "class before the correction"),
)
SHIFTS = ("ShiftX", "ShiftY", "ShiftZ")
MINIMAL = ("ShiftZ", "RayCount")


def columns_for(dimensions: Dimensions) -> tuple[Column, ...]:
    """Return the columns that ``--dimensions`` asks for."""
    if dimensions == "all":
        return COLUMNS
    names = MINIMAL if dimensions == "minimal" else ()
    return tuple(column for column in COLUMNS if column.name in names)


def column_scale(column: Column, scales: FloatArray) -> float:
    """Return the scale of a column in a file with the given coordinate scales."""
    return float(scales[SHIFTS.index(column.name)]) if column.scale == 0.0 else column.scale


def shift_steps(correction: Correction, scales: FloatArray) -> npt.NDArray[np.int64]:
    """Return the shift in steps of the file's own scale, shape (n, 3)."""
    return np.rint(correction.shift_m / scales).astype(np.int64)


def in_steps(
    column: Column,
    correction: Correction,
    moved: npt.NDArray[np.int64],
    classes: npt.NDArray[Any],
    rows: BoolArray,
) -> npt.NDArray[Any]:
    """Return a column's values of the given rows, whole numbers of its scale.

    Parameters
    ----------
    column : Column
    correction : Correction
        Of n points.
    moved : array, shape (n, 3)
        See `shift_steps`.
    classes : array, shape (n,)
        Before the correction.
    rows : array of bool, shape (n,)
    """
    values: dict[str, npt.NDArray[Any]] = {
        "ShiftX": moved[:, 0],
        "ShiftY": moved[:, 1],
        "ShiftZ": moved[:, 2],
        "WaterDepth": correction.depth_m,
        "RayMiss": correction.ray_miss_m,
        "SigmaZ": correction.sigma_z_m,
        "Incidence": correction.incidence_deg,
        "RayCount": correction.ray_count,
        "SourceClass": classes,
    }
    value = values[column.name][rows]
    if column.scale not in (0.0, 1.0):
        value = np.rint(value / column.scale)
    if column.name == "WaterDepth":
        value = np.maximum(value, 1)  # a submerged point is never at zero depth
    return value


def fill(
    points: laspy.ScaleAwarePointRecord,
    columns: tuple[Column, ...],
    correction: Correction,
    moved: npt.NDArray[np.int64],
    rows: BoolArray,
) -> None:
    """Write the columns of the given rows, and the shift of all; the others keep zero.

    Raises
    ------
    TooNarrowError
        If a value does not fit its type and the type may be widened.
    """
    classes = np.array(points["classification"])
    for column in columns:
        target = points.array[column.name]
        limits = np.iinfo(target.dtype)
        mine = rows_of(column, correction, rows)
        value = in_steps(column, correction, moved, classes, mine)
        if column.saturates:
            value = np.minimum(value, limits.max)
        if value.size and (value.min() < limits.min or value.max() > limits.max):
            if target.dtype != column.dtype(wide=True):
                raise TooNarrowError
            step = column_scale(column, points.scales)
            raise InputError(
                f"{column.name} reaches {value.max() * step:g} m, more than {target.dtype} holds:"
                " the cloud has points far below the water; remove them, or write it with a"
                " coarser scale."
            )
        target[mine] = value


def rows_of(column: Column, correction: Correction, changed: BoolArray) -> BoolArray:
    """Return the rows that get values of a column: the changed ones, and for shifts all moved."""
    return changed | correction.moved if column.name in SHIFTS else changed


def changed_rows(correction: Correction, withheld: BoolArray, *, withhold: bool) -> BoolArray:
    """Return the rows that get values: corrected ones, and uncorrected ones not yet withheld.

    An uncorrected point that came withheld is left wholly as it was, so that `restore` can tell
    it from one that pcfix withheld; by the same mark, a depth, it tells those that are withheld
    because they could not be carried over.
    """
    marked = correction.uncorrected if withhold else correction.submerged
    return correction.corrected | (marked & ~withheld)


def is_corrected(points: laspy.ScaleAwarePointRecord) -> BoolArray:
    """Return which rows of an output file refraction was taken out of."""
    return np.asarray(points.array["RayCount"] > 0)


def is_marked_uncorrected(points: laspy.ScaleAwarePointRecord) -> BoolArray:
    """Return which rows of an output file pcfix should have moved and could not."""
    return np.asarray((points.array["RayCount"] == 0) & (points.array["WaterDepth"] > 0))

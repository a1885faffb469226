"""Check depths: places where the true depth, or the height of the bed, was measured."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.files import check_input
from pcfix.io.tables import Table, read_table

if TYPE_CHECKING:
    import os

    from pcfix.model import FloatArray

SPELLINGS = {
    "x": ("x", "easting", "east"),
    "y": ("y", "northing", "north"),
    "depth": ("depth", "true_depth", "water_depth", "measured_depth"),
    "z": ("z", "height", "elevation", "elev", "altitude"),
}
_UNIT = re.compile(r"^(.*?)[ _]*[\[(]([^\])]*)[\])]$|^(.*)_(m|cm|mm|ft)$")
_METRES = ("", "m", "metre", "metres", "meter", "meters")


@dataclass(frozen=True, eq=False)
class CheckDepths:
    """Places with a known depth, or a known height of the bed; p of them.

    Attributes
    ----------
    name : str
        Of the file, for messages.
    xy : array, shape (p, 2)
        Metres, the cloud's CRS.
    value_m : array, shape (p,)
        Depth below the water, positive down; or world Z, see `are_heights`.
    are_heights : bool
    line : list of int
        Of each place in the file.
    """

    name: str
    xy: FloatArray
    value_m: FloatArray
    are_heights: bool
    line: list[int]

    def __len__(self) -> int:
        return len(self.line)

    def where(self, row: int) -> str:
        """Return file, line and place, for messages."""
        return f"{self.name}: line {self.line[row]} ({self.xy[row, 0]:.2f}, {self.xy[row, 1]:.2f})"


def read_check_depths(path: str | os.PathLike[str]) -> CheckDepths:
    """Read check depths from a table with a header line.

    Parameters
    ----------
    path : path
        Columns in any order, separated by comma, semicolon, tab or space: ``x`` and ``y`` (or
        easting and northing) in the cloud's CRS, and ``depth``, metres below the water surface
        that the correction is given, positive down, or ``z``, the height of the bed in the
        cloud's heights. Where both are there the depth counts. Other columns are passed over,
        a standard error too: all check depths count alike.

    Raises
    ------
    InputError
        If there is no such file, a column is missing, not in metres or there twice, a field is
        not a finite number, or a depth is negative.
    """
    source = check_input(path)
    table = read_table(source, ())
    names, units = zip(*(_split_unit(name) for name in table.header), strict=True)
    place = {role: _place(table, names, role) for role in SPELLINGS}
    what = "z" if place["depth"] is None else "depth"
    missing = [role for role in ("x", "y", what) if place[role] is None]
    if missing:
        raise InputError(
            f"{source}: line 1 must name the columns x, y and depth (or z);"
            f" {', '.join('depth or z' if m == 'z' else m for m in missing)} missing (it has:"
            f" {', '.join(table.header)})."
        )
    values = []
    for role in ("x", "y", what):
        column = place[role] or 0
        if units[column] not in _METRES:
            raise InputError(
                f"{source}: column {table.header[column]} is in '{units[column]}'; give metres."
            )
        values.append(np.array(table.numbers(table.header[column]), np.float64))
    found = CheckDepths(
        str(source), np.column_stack(values[:2]), values[2], what == "z", table.line
    )
    _refuse_negative(found)
    return found


def _split_unit(name: str) -> tuple[str, str]:
    """Return the name of a column and its unit: depth_m, Depth (m), x [m]."""
    match = _UNIT.match(name)
    if not match:
        return name.replace(" ", "_"), ""
    name, unit = (match[1], match[2]) if match[3] is None else (match[3], match[4])
    return name.strip().replace(" ", "_"), unit.strip()


def _place(table: Table, names: tuple[str, ...], role: str) -> int | None:
    """Return the number of a column; easting beside x is refused."""
    there = [i for i, name in enumerate(names) if name in SPELLINGS[role]]
    if len(there) > 1:
        twice = ", ".join(table.header[i] for i in there)
        raise InputError(
            f"{table.path}: line 1: the columns {twice} may all be {role}; take out all but one."
        )
    return there[0] if there else None


def _refuse_negative(found: CheckDepths) -> None:
    negative = np.flatnonzero(found.value_m < 0.0)
    if found.are_heights or not len(negative):
        return
    first = int(negative[0])
    raise InputError(
        f"{found.where(first)}: the depth {found.value_m[first]:g} is negative, as are"
        f" {len(negative)} of {len(found)}; depths count positive down, and heights of the bed"
        " belong in a column z."
    )

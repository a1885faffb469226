"""A cloud as PDAL hands it to ``filters.python``: dictionaries of arrays and of metadata.

PDAL checks neither the length nor the strides of the arrays that it gets back; those made here
have its own types, are C-contiguous, and are as long as its own.
"""

from __future__ import annotations

import json
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError
from pcfix.io.las.columns import (
    COLUMNS,
    Column,
    changed_rows,
    column_scale,
    in_steps,
    rows_of,
    shift_steps,
    to_withhold,
    unsure_anew,
)
from pcfix.model import BATHYMETRIC_POINT, Correction, FloatArray

Dimensions: TypeAlias = "dict[str, npt.NDArray[Any]]"

NAME = "the pipeline's cloud"
OUTCOME = "Outcome"
"""A dimension that is filled where ``add_dimension`` asks for it: `pcfix.Outcome`."""

STAGE_SOURCE = "from pcfix.pdal_stage import {}"
"""What a pipeline says to have one of the stage's functions."""

CLASS_FLAGS = "ClassFlags=uint8"
"""To be added for PDAL 2.2, where point formats 0 to 5 have no such dimension."""

TAKEN_APART = "flags_taken_apart"
"""In the metadata of a stage that took the flags out of packed classes."""

_WITHHELD_FLAG = 4
"""Bit of ClassFlags, which older PDAL has in place of the dimension Withheld."""


def add_dimension(columns: tuple[Column, ...]) -> str:
    """Return the value of a stage's ``add_dimension`` for these columns."""
    return ",".join(f"{c.name}={c.narrow if c.scale == 1.0 else 'float'}" for c in columns)


def check_dimensions(ins: Dimensions, columns: tuple[Column, ...]) -> None:
    """Refuse a cloud without the dimensions to be filled; say what ``add_dimension`` should be."""
    missing = [c.name for c in columns if c.name not in ins]
    if missing:
        raise SettingError(
            f"add_dimension: {', '.join(missing)} missing; give"
            f' "{add_dimension(columns)}", or set dimensions to minimal or none.'
        )
    for column in columns:
        if column.scale != 1.0 and ins[column.name].dtype.kind != "f":
            raise SettingError(f"add_dimension: {column.name} must be float.")


def column_values(ins: Dimensions, name: str, scales: FloatArray | None) -> FloatArray:
    """Return a dimension of a correction as a file has it: whole steps, which a float rounds."""
    column = next(one for one in COLUMNS if one.name == name)
    values = dimension(ins, name)
    if column.scale == 0.0 and scales is None:
        return values
    step = column_scale(column, np.ones(3) if scales is None else scales)
    return np.asarray(np.rint(values / step) * step)


def dimension(ins: Dimensions, name: str) -> FloatArray:
    """Return one dimension as float64; a `SettingError` if the cloud has none such."""
    if name not in ins:
        raise SettingError(f"{NAME}: has no dimension {name}; it has {', '.join(ins)}.")
    values: FloatArray = ins[name].astype(np.float64)
    return values


class Results:
    """The output arrays: C-contiguous, of PDAL's own types and length, as nobody checks them."""

    def __init__(
        self, ins: Dimensions, columns: tuple[Column, ...], flags: Flags, scales: FloatArray | None
    ) -> None:
        self._columns, self._flags, self._scales = columns, flags, scales
        names = [*"XYZ", *(column.name for column in columns), *{OUTCOME}.intersection(ins)]
        # PDAL's own arrays are written to and given back: they are copies of its points
        self._added: Dimensions = {name: np.ascontiguousarray(ins[name]) for name in names}
        for name in names[3:]:
            self._added[name].fill(0)
        self._added["Classification"] = flags.classes.copy()

    def add(self, rows: slice, correction: Correction, withhold: bool) -> None:
        """Add one chunk."""
        out, classes = self._added, self._flags.classes[rows]
        # without one known scale, a step so fine that it is far below any
        scales = np.full(3, 2.0**-20) if self._scales is None else self._scales
        moved = shift_steps(correction, scales)
        for i, axis in enumerate("XYZ"):
            # land keeps its bits, negative zero included
            out[axis][rows][correction.moved] += moved[correction.moved, i] * scales[i]
        withheld = self._flags.withheld[rows]
        correction = unsure_anew(correction, withheld)
        changed = changed_rows(correction, withheld, withhold=withhold)
        for column in self._columns:
            filled = rows_of(column, correction, changed)
            values = in_steps(column, correction, moved, classes, filled)
            out[column.name][rows][filled] = values * column_scale(column, scales)
        out["Classification"][rows][correction.corrected] = BATHYMETRIC_POINT
        if OUTCOME in out:
            out[OUTCOME][rows] = correction.outcome
        self._flags.withheld[rows] |= to_withhold(correction, withhold=withhold)

    @property
    def dimensions(self) -> Dimensions:
        """What PDAL takes over."""
        return self._added | self._flags.dimensions()


class Flags:
    """Classes and withheld flags, wherever this PDAL keeps them.

    PDAL 2.2 has the flags in ClassFlags, and those of point formats 0 to 5 in the upper bits of
    Classification; later versions have a dimension Withheld.
    """

    def __init__(self, ins: Dimensions, metadata: dict[str, Any] | None) -> None:
        if "Classification" not in ins:
            raise SettingError(
                f'{NAME}: has no Classification; add "Classification=uint8" to add_dimension.'
            )
        self._ins = ins
        self.classes = np.array(ins["Classification"], order="C")
        self._class_flags = np.array(ins["ClassFlags"]) if "ClassFlags" in ins else None
        formats = _reader_values(metadata, "dataformat_id")
        self.taken_apart = _mentions(_nodes(metadata, "filters.python"), TAKEN_APART)
        if (
            "Withheld" not in ins
            and not self.taken_apart
            and any(int(format_id) < 6 for format_id in formats)
        ):
            packed = self.classes >> 5
            self.classes &= 31
            if self._class_flags is None:
                raise SettingError(
                    f"{NAME}: this PDAL keeps the flags of point formats 0 to 5 in Classification,"
                    ' where class 40 has no room; add "ClassFlags=uint8" to add_dimension.'
                )
            self._class_flags |= packed.astype(self._class_flags.dtype)
            self.taken_apart = True
        if "Withheld" in ins:
            self.withheld = ins["Withheld"] != 0
        elif self._class_flags is not None:
            self.withheld = (self._class_flags & _WITHHELD_FLAG) != 0
        else:
            self.withheld = np.zeros(len(self.classes), np.bool_)

    def dimensions(self) -> Dimensions:
        """Return the flags as PDAL has them."""
        out: Dimensions = {}
        if "Withheld" in self._ins:
            out["Withheld"] = self.withheld.astype(self._ins["Withheld"].dtype)
        if self._class_flags is not None:
            out["ClassFlags"] = np.where(
                self.withheld, self._class_flags | _WITHHELD_FLAG, self._class_flags
            ).astype(self._class_flags.dtype)
        return out


def scales_of(metadata: dict[str, Any] | None) -> FloatArray | None:
    """Return the scale of all input files, where they have one."""
    found = [set(_reader_values(metadata, f"scale_{axis}")) for axis in "xyz"]
    if any(len(values) != 1 for values in found):
        return None
    return np.array([float(next(iter(values))) for values in found])


def crs_of(metadata: dict[str, Any] | None) -> str | None:
    """Return the CRS that all input files state, as WKT, where they have one."""
    stated = set(_reader_values(metadata, "comp_spatialreference"))
    return stated.pop() or None if len(stated) == 1 else None


def _reader_values(metadata: dict[str, Any] | None, name: str) -> list[str]:
    """Return what the readers' metadata say under a name."""
    return [
        child["value"]
        for reader in _nodes(metadata, "readers.")
        for child in reader.get("children", [])
        if child["name"] == name
    ]


def _nodes(metadata: dict[str, Any] | None, kind: str) -> list[dict[str, Any]]:
    """Return the metadata of the stages of a kind."""
    return [one for one in (metadata or {}).get("children", []) if one["name"].startswith(kind)]


def _mentions(nodes: list[dict[str, Any]], name: str) -> bool:
    """Whether a name stands anywhere below some nodes."""
    return any(
        child["name"] == name or _mentions([child], name)
        for node in nodes
        for child in node.get("children", [])
    )


def metadata_of(figures: dict[str, Any], flags: Flags | None = None) -> dict[str, Any]:
    """Return a summary as PDAL's metadata, and for later stages what became of packed `flags`."""
    values = {k: v for k, v in figures.items() if k not in ("input", "output") and v is not None}
    if flags is not None and flags.taken_apart:
        values[TAKEN_APART] = True
    return node("pcfix", children=[node(name, value) for name, value in values.items()])


def node(
    name: str, value: Any = "", children: list[dict[str, Any]] | None = None
) -> dict[str, Any]:
    """Return a node of PDAL's metadata; a nested value as JSON text, with a type in any case."""
    kinds = {bool: "boolean", int: "integer", float: "double"}
    text = json.dumps(value) if isinstance(value, dict | list) else value
    kind = kinds.get(type(value), "string")
    return {"name": name, "value": text, "type": kind, "children": children or []}

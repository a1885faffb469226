"""Exchange a cloud with PDAL's ``filters.python``: dictionaries of arrays and of metadata.

PDAL checks neither the length nor the strides of the arrays that it gets back. Those of this module
have PDAL's own types, are C-contiguous, and are as long as its own.
"""

import json
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError
from pcfix.io.las.columns import COLUMNS, Column, changes_of, column_scale
from pcfix.model import BATHYMETRIC_POINT, Correction, FloatArray

Dimensions: TypeAlias = dict[str, npt.NDArray[Any]]
Metadata: TypeAlias = dict[str, Any]

NAME = "the pipeline's cloud"
OUTCOME = "Outcome"  # a dimension with `pcfix.Outcome`, if ``add_dimension`` adds it
CLASS_FLAGS = "ClassFlags=uint8"  # added for PDAL 2.2, where formats 0 to 5 have no such dimension
_WITHHELD_FLAG = 4  # bit of ClassFlags, which older PDAL has in place of the dimension Withheld


def add_dimension(columns: tuple[Column, ...]) -> str:
    """Return the value of a stage's ``add_dimension`` for these columns."""
    return ",".join(f"{c.name}={c.dtype if c.scale == 1.0 else 'float'}" for c in columns)


class PdalCloud:
    """The arrays and the metadata of a cloud, with copies of its `classes` and `withheld` flags.

    `scales`, shape (3,), and `crs`, as WKT, are those that all input files share, else None.
    PDAL 2.2 has the flags in ClassFlags, later versions have a dimension Withheld.
    """

    def __init__(self, ins: Dimensions, metadata: Metadata | None) -> None:
        self.ins = ins
        stages = (metadata or {}).get("children", [])
        readers = [one for one in stages if one["name"].startswith("readers.")]
        facts = [fact for one in readers for fact in one.get("children", [])]

        def values(name: str) -> set[Any]:
            return {fact["value"] for fact in facts if fact["name"] == name}

        scales, crs = [values(f"scale_{axis}") for axis in "xyz"], values("comp_spatialreference")
        is_one = all(len(found) == 1 for found in scales)
        self.scales = np.array([float(*found) for found in scales]) if is_one else None
        self.crs: str | None = (crs.pop() or None) if len(crs) == 1 else None
        if "Classification" not in ins:
            raise _missing("Classification", "uint8")
        self.classes = np.array(ins["Classification"], order="C")
        self._class_flags = np.array(ins["ClassFlags"]) if "ClassFlags" in ins else None
        if "Withheld" not in ins and any(int(form) < 6 for form in values("dataformat_id")):
            if self._class_flags is None:
                raise _missing(*CLASS_FLAGS.split("="))
            # classes from 64 on are the key point and withheld flags of point formats 0 to 5
            if len(self.classes) and self.classes.max() >= 64:
                words = "has flags in Classification, where PDAL before 2.5 leaves those of point"
                words += " formats 0 to 5. Convert the cloud to format 6 first."
                raise SettingError("cloud.packed", f"{NAME}: {words}")
        if "Withheld" in ins:
            self.withheld = ins["Withheld"] != 0
        elif self._class_flags is not None:
            self.withheld = (self._class_flags & _WITHHELD_FLAG) != 0
        else:
            self.withheld = np.zeros(len(self.classes), np.bool_)

    def __len__(self) -> int:
        return len(self.ins["X"])

    def xyz(self, rows: slice) -> FloatArray:
        """Return coordinates, shape (n, 3)."""
        return np.column_stack([self.ins[axis][rows] for axis in "XYZ"])

    def dimension(self, name: str) -> FloatArray:
        """Return one dimension as float64."""
        if name not in self.ins:
            sentence = f"{NAME}: has no dimension {name}; it has {', '.join(self.ins)}."
            raise SettingError("cloud.dimension_missing", sentence, dimension=name)
        values: FloatArray = self.ins[name].astype(np.float64)
        return values

    def columns(self, names: tuple[str, ...]) -> dict[str, FloatArray]:
        """Return those dimensions of an earlier correction that are there, as a file has them.

        A file stores integer steps, which PDAL's floats round.
        """
        found = {}
        for column in COLUMNS:
            if column.name in names and column.name in self.ins:
                values = self.dimension(column.name)
                if column.scale != 0.0 or self.scales is not None:
                    step = column_scale(column, np.ones(3) if self.scales is None else self.scales)
                    values = np.asarray(np.rint(values / step) * step)
                found[column.name] = values
        return found

    def flags(self) -> Dimensions:
        """Return the withheld flags as PDAL has them."""
        out: Dimensions = {}
        if "Withheld" in self.ins:
            out["Withheld"] = self.withheld.astype(self.ins["Withheld"].dtype)
        if self._class_flags is not None:
            flags = self._class_flags
            with_bit = np.where(self.withheld, flags | _WITHHELD_FLAG, flags)
            out["ClassFlags"] = with_bit.astype(flags.dtype)
        return out


def _missing(dimension: str, kind: str) -> SettingError:
    sentence = f'{NAME}: has no {dimension}. Add "{dimension}={kind}" to add_dimension.'
    return SettingError("cloud.dimension_missing", sentence, dimension=dimension)


class Results:
    """The output arrays of a correction: C-contiguous, of PDAL's own types and length."""

    def __init__(self, cloud: PdalCloud, columns: tuple[Column, ...]) -> None:
        """Check that the pipeline added the columns."""
        ins = cloud.ins
        if missing := [c.name for c in columns if c.name not in ins]:
            sentence = f"add_dimension: {', '.join(missing)} missing. Give"
            sentence += f' "{add_dimension(columns)}", or set dimensions to minimal or none.'
            raise SettingError("cloud.dimension_missing", sentence, dimension=missing[0])
        for column in columns:
            if column.scale != 1.0 and ins[column.name].dtype.kind != "f":
                sentence = f"add_dimension: {column.name} must be float."
                raise SettingError("cloud.dimension_type", sentence, dimension=column.name)
        self._columns, self._cloud = columns, cloud
        # without one known scale, steps that are far finer than any
        self._scales = np.full(3, 2.0**-20) if cloud.scales is None else cloud.scales
        names = [*"XYZ", *(column.name for column in columns), *{OUTCOME}.intersection(ins)]
        # PDAL's own arrays are changed and returned: they are copies of its points
        self._added: Dimensions = {name: np.ascontiguousarray(ins[name]) for name in names}
        for name in names[3:]:
            self._added[name].fill(0)
        self._added["Classification"] = cloud.classes.copy()

    def add(self, rows: slice, correction: Correction) -> None:
        """Add one chunk."""
        out, cloud, scales, moved = self._added, self._cloud, self._scales, correction.moved
        before = cloud.classes[rows], cloud.withheld[rows]
        changes = changes_of(self._columns, correction, *before, scales)
        for i, axis in enumerate("XYZ"):
            # land keeps its bits, negative zero included
            out[axis][rows][moved] += changes.steps[i][moved] * scales[i]
        for column, some, values in changes.values:
            out[column.name][rows][some] = values * column_scale(column, scales)
        out["Classification"][rows][correction.corrected] = BATHYMETRIC_POINT
        if OUTCOME in out:
            out[OUTCOME][rows] = correction.outcome
        cloud.withheld[rows] |= changes.flagged

    @property
    def dimensions(self) -> Dimensions:
        """The arrays that PDAL gets back."""
        return self._added | self._cloud.flags()


def metadata_of(figures: Metadata) -> Metadata:
    """Return a summary as PDAL's metadata."""
    values = {k: v for k, v in figures.items() if k not in ("input", "output") and v is not None}
    return node("pcfix", children=[node(name, value) for name, value in values.items()])


def node(name: str, value: Any = "", children: list[Metadata] | None = None) -> Metadata:
    """Return a node of PDAL's metadata; a nested value as JSON text."""
    kinds = {bool: "boolean", int: "integer", float: "double"}
    text = json.dumps(value) if isinstance(value, dict | list) else value
    kind = kinds.get(type(value), "string")
    return {"name": name, "value": text, "type": kind, "children": children or []}

"""The vertices of a PLY file, the only element that tie points need."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from pcfix.errors import InputError

if TYPE_CHECKING:
    import numpy.typing as npt

HEADER = re.compile(
    rb"ply\r?\n(?:comment[^\n]*\n)*format binary_(little|big)_endian 1\.0\r?\n(.*?)end_header\r?\n",
    re.DOTALL,
)
MOST_HEADER_BYTES = 4096
TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"},
    **{"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "float": "f4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}


def read_vertices(name: str, data: bytes, needed: tuple[str, ...]) -> npt.NDArray[Any]:
    """Return the vertices of a binary PLY as a structured array.

    Parameters
    ----------
    name : str
        For messages.
    data : bytes
    needed : tuple of str
        Properties that must be there.

    Raises
    ------
    InputError
        If the header is not one, lacks a property, or promises more than follows it.
    """
    header = HEADER.match(data[:MOST_HEADER_BYTES])
    if header is None:
        raise InputError(f"{name}: is not a binary PLY; save the project again.")
    order = "<" if header[1] == b"little" else ">"
    count, fields = _fields(name, header[2].decode("ascii", errors="replace"), order)
    missing = [field for field in needed if field not in dict(fields)]
    if missing:
        raise InputError(f"{name}: has no property {', '.join(missing)}; save the project again.")
    dtype = np.dtype(fields)
    if count * dtype.itemsize > len(data) - header.end():
        raise InputError(
            f"{name}: says {count} vertices but is cut off after"
            f" {(len(data) - header.end()) // dtype.itemsize}; save the project again."
        )
    return np.frombuffer(data, dtype, count, header.end())


def _fields(name: str, text: str, order: str) -> tuple[int, list[tuple[str, str]]]:
    """Return how many vertices there are and what each has; vertices must come first."""
    count = -1
    fields: list[tuple[str, str]] = []
    for words in (line.split() for line in text.splitlines()):
        if words[:1] == ["element"] and count >= 0:
            break
        if words[:2] == ["element", "vertex"] and len(words) == 3 and words[2].isdecimal():
            count = int(words[2])
        elif words[:1] == ["property"] and len(words) == 3 and words[1] in TYPES and count >= 0:
            fields.append((words[2], order + TYPES[words[1]]))
        elif words[:1] not in ([], ["comment"], ["obj_info"]):
            raise InputError(f"{name}: line '{' '.join(words)}' of its header is not understood.")
    if count < 0 or len(dict(fields)) != len(fields) or not fields:
        raise InputError(f"{name}: its header names no vertices, or a property twice.")
    return count, fields

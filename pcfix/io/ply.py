"""What the header of a PLY file says of its vertices.

The format is Greg Turk's (The PLY Polygon File Format, 1994): a header of lines names elements and
their properties, ``property TYPE NAME`` or ``property list COUNT_TYPE ITEM_TYPE NAME``; the records
follow as text or as bytes without padding. `pcfix.io.views.vertices` reads them.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from pcfix.errors import InputError

_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1"},
    **{"short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2"},
    **{"int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "int64": "i8", "uint64": "u8"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MOST_HEADER_BYTES = 1 << 20


class Property(NamedTuple):
    """A field of a record; `length` is the type of a list's length, empty for a single number."""

    name: str
    item: str
    length: str = ""


class Header(NamedTuple):
    """What a PLY file says of its vertices."""

    name: str  # of the file, for messages
    order: str  # of the bytes, "<" or ">"; empty for text
    vertices: int  # promised, not checked
    properties: tuple[Property, ...]  # of a vertex
    skipped: tuple[tuple[int, tuple[Property, ...]], ...]  # elements that come before the vertices
    end: int  # bytes of the header

    def item(self, name: str, *, is_list: bool) -> str | None:
        """Return the type of a number, or of a list's items; None without such a property."""
        found = [p.item for p in self.properties if p.name == name and bool(p.length) == is_list]
        return found[0] if found else None

    def size(self, kind: str) -> int:
        """Return the units of a type."""
        return int(kind[1]) if self.order else 1


def parse_header(name: str, head: bytes) -> Header:
    """Return what the first bytes of a PLY file say of its vertices.

    An `InputError` if it is not one, or has no vertices.
    """
    end = re.search(rb"end_header[ \t]*\r?\n", head)
    if not head.startswith(b"ply") or end is None:
        raise InputError(f"{name}: is not a PLY file with a whole header; export it again.")
    lines = [line.split() for line in head[: end.start()].decode("latin-1").splitlines()]
    try:
        order, elements = _elements(lines)
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(
            f"{name}: the PLY header is damaged ({error}); export it again."
        ) from error
    names = [element for element, _, _ in elements]
    if "vertex" not in names:
        raise InputError(f"{name}: the PLY file has no vertices; give a point cloud.")
    at = names.index("vertex")
    skipped = tuple((count, tuple(p)) for _, count, p in elements[:at])
    return Header(name, order, elements[at][1], tuple(elements[at][2]), skipped, end.end())


def read_header(path: Path) -> Header:
    """Return `parse_header` of a file."""
    with path.open("rb") as stream:
        return parse_header(str(path), stream.read(_MOST_HEADER_BYTES))


def _elements(lines: list[list[str]]) -> tuple[str, list[tuple[str, int, list[Property]]]]:
    order: str | None = None
    elements: list[tuple[str, int, list[Property]]] = []
    for key, *fields in filter(None, lines):
        if key == "format":
            order = _FORMATS[fields[0]]
        elif key == "element":
            count = int(fields[1])
            if count < 0:
                raise ValueError(f"{count} records of {fields[0]}")
            elements.append((fields[0], count, []))
        elif key == "property" and fields[0] == "list":
            if (count_type := _TYPES[fields[1]])[0] == "f":
                raise ValueError(f"a list counted in {fields[1]}")
            elements[-1][2].append(Property(fields[3], _TYPES[fields[2]], count_type))
        elif key == "property":
            elements[-1][2].append(Property(fields[1], _TYPES[fields[0]]))
    if order is None:
        raise ValueError("no format")
    return order, elements

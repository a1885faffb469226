"""Vertices of PLY files, with the lists that other readers refuse.

The format is Greg Turk's (The PLY Polygon File Format, 1994): a header of lines names elements and
their properties, ``property TYPE NAME`` or ``property list COUNT_TYPE ITEM_TYPE NAME``; the records
follow as text or as bytes without padding.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcfix.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt

    from pcfix.model import FloatArray, IntArray

_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1"},
    **{"short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2"},
    **{"int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MOST_HEADER_BYTES = 1 << 20


class Property(NamedTuple):
    """A field of a record; `length` is the type of a list's length, empty for a single number."""

    name: str
    item: str
    length: str = ""


@dataclass(frozen=True)
class Header:
    """What a PLY file says of its vertices.

    Attributes
    ----------
    path : Path
    order : {"", "<", ">"}
        Text, or the order of the bytes.
    vertices : int
        Promised, not checked.
    properties : tuple of Property
        Of a vertex.
    skipped : tuple of (int, tuple of Property)
        The elements that come before the vertices.
    end : int
        Bytes of the header.
    """

    path: Path
    order: str
    vertices: int
    properties: tuple[Property, ...]
    skipped: tuple[tuple[int, tuple[Property, ...]], ...]
    end: int

    def has(self, *names: str) -> bool:
        """Whether a vertex has all these properties."""
        return set(names) <= {p.name for p in self.properties}


def read_header(path: Path) -> Header:
    """Read the header of a PLY file.

    Raises
    ------
    InputError
        If it is not one, or has no vertices.
    """
    with path.open("rb") as stream:
        head = stream.read(_MOST_HEADER_BYTES)
    end = re.search(rb"end_header[ \t]*\r?\n", head)
    if not head.startswith(b"ply") or end is None:
        raise InputError(f"{path}: is not a PLY file with a whole header; export it again.")
    lines = [line.split() for line in head[: end.start()].decode("latin-1").splitlines()]
    try:
        order, elements = _elements(lines)
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(
            f"{path}: the PLY header is damaged ({error}); export it again."
        ) from error
    names = [name for name, _, _ in elements]
    if "vertex" not in names:
        raise InputError(f"{path}: the PLY file has no vertices; give a point cloud.")
    at = names.index("vertex")
    skipped = tuple((count, tuple(p)) for _, count, p in elements[:at])
    return Header(path, order, elements[at][1], tuple(elements[at][2]), skipped, end.end())


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


class Vertices:
    """The records of the vertices, walked over once, so that every count in them holds."""

    def __init__(self, header: Header) -> None:
        """Open and walk over the file.

        Raises
        ------
        InputError
            If it ends early.
        """
        from pcfix.io.views.ragged import list_starts

        self.header = header
        self._layout = layout = _layout(header)
        self._units = _units(header)
        if header.vertices * int((layout.prefix + layout.item * (layout.prefix == 0)).sum()) > len(
            self._units
        ):
            self._complain(header.vertices)
        starts = np.zeros((len(layout.lists), header.vertices + 1), np.int64)
        which = np.array(list(layout.lists.values()), np.int64)
        end = list_starts(
            self._units, layout.item, layout.prefix, header.order == ">", which, starts
        )
        if end < 0:
            self._complain(-1 - end)
        self._starts = dict(zip(layout.lists, starts, strict=True))

    def _complain(self, row: int) -> None:
        raise InputError(
            f"{self.header.path}: is cut short or damaged: the header promises"
            f" {self.header.vertices:,} vertices, number {row:,} is not whole; copy it again."
        )

    def xyz(self) -> FloatArray:
        """Return the positions, shape (n, 3)."""
        xyz = np.empty((self.header.vertices, 3))
        for axis, name in enumerate("xyz"):
            xyz[:, axis] = self._copy(name, *self._layout.scalars[name], self.header.vertices)
        return xyz

    def ragged(self, name: str) -> tuple[IntArray, npt.NDArray[Any]]:
        """Return where the lists of a property start, shape (n + 1,), and their items."""
        start = self._starts[name]
        return start, self._copy(name, self._layout.lists[name], (0, 0), int(start[-1]))

    def _copy(self, name: str, field: int, part: tuple[int, int], count: int) -> npt.NDArray[Any]:
        from pcfix.io.views.ragged import copy_field

        header, layout = self.header, self._layout
        item = next(p.item for p in header.properties if p.name == name)
        out = np.empty(count * _size(header, item), self._units.dtype)
        copy_field(
            *(self._units, layout.item, layout.prefix, header.order == ">", field),
            *(part, header.vertices, out),
        )
        return out.view(header.order + item) if header.order else out


class _Layout(NamedTuple):
    """A record, with neighbouring numbers taken as one field; a unit is a byte or a text's number.

    `item` and `prefix` have the units of each field's items and of its list's length, `lists` the
    field of each list, `scalars` the field of each number and its first and last unit in that.
    """

    item: IntArray
    prefix: IntArray
    lists: dict[str, int]
    scalars: dict[str, tuple[int, tuple[int, int]]]


def _layout(header: Header) -> _Layout:
    fields: list[list[int]] = []
    lists: dict[str, int] = {}
    scalars: dict[str, tuple[int, tuple[int, int]]] = {}
    for p in header.properties:
        size = _size(header, p.item)
        if p.length:
            lists[p.name] = len(fields)
            fields.append([size, _size(header, p.length)])
            continue
        if not fields or fields[-1][1]:
            fields.append([0, 0])
        scalars[p.name] = len(fields) - 1, (fields[-1][0], fields[-1][0] + size)
        fields[-1][0] += size
    item, prefix = np.array(fields, np.int64).reshape(-1, 2).T.copy()
    return _Layout(item, prefix, lists, scalars)


def _units(header: Header) -> npt.NDArray[Any]:
    """Return the bytes of the vertices, or the numbers of a text, to the end of the file."""
    skip = 0
    for count, properties in header.skipped:
        if count and any(p.length for p in properties):
            raise InputError(
                f"{header.path}: lists come before the vertices, which pcfix does not read; export"
                " the points alone."
            )
        skip += count * sum(_size(header, p.item) for p in properties)
    units = _numbers(header) if header.order == "" else _bytes(header)
    return units[skip:]


def _size(header: Header, kind: str) -> int:
    return int(kind[1]) if header.order else 1


def _bytes(header: Header) -> npt.NDArray[np.uint8]:
    if header.path.stat().st_size == header.end:
        return np.zeros(0, np.uint8)
    return np.memmap(header.path, np.uint8, "r", offset=header.end)


def _numbers(header: Header) -> FloatArray:
    with header.path.open("rb") as stream:
        stream.seek(header.end)
        text = stream.read()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            return np.fromstring(text.decode("latin-1"), np.float64, sep=" ")
    except (DeprecationWarning, ValueError) as error:
        raise InputError(
            f"{header.path}: says that it is text, but not all of it is numbers; export it again."
        ) from error

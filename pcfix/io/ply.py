"""The vertices and faces of PLY files, with the lists that other readers refuse.

The format is Greg Turk's (The PLY Polygon File Format, 1994): a header of lines names elements and
their properties, ``property TYPE NAME`` or ``property list COUNT_TYPE ITEM_TYPE NAME``; the records
follow as text or as bytes without padding. A unit, below, is a byte, or a number of a text.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from pcfix.errors import InputError
from pcfix.kernels import device, kernel
from pcfix.model import FloatArray, IntArray

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
    """What a PLY file says of its vertices, or of another element."""

    name: str  # of the file, for messages
    order: str  # of the bytes, "<" or ">"; empty for text
    kind: str  # of the records, in the plural, for messages
    records: int  # promised, not checked
    properties: tuple[Property, ...]  # of a record
    skipped: tuple[tuple[int, tuple[Property, ...]], ...]  # elements that come before these
    end: int  # bytes of the header

    def item(self, name: str, *, is_list: bool) -> str | None:
        """Return the type of a number, or of a list's items; None without such a property."""
        found = [p.item for p in self.properties if p.name == name and bool(p.length) == is_list]
        return found[0] if found else None

    def size(self, kind: str) -> int:
        """Return the units of a type."""
        return int(kind[1]) if self.order else 1


_KINDS = {"vertex": "vertices", "face": "faces"}


def parse_header(name: str, head: bytes, element: str = "vertex") -> Header:
    """Return what the first bytes of a PLY file say of its vertices, or faces.

    An `InputError` if it is not one, or has none.
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
    names, kind = [one for one, _, _ in elements], _KINDS[element]
    if element not in names:
        raise InputError(f"{name}: the PLY file has no {kind}; export it again with them.")
    at = names.index(element)
    skipped = tuple((count, tuple(p)) for _, count, p in elements[:at])
    return Header(name, order, kind, elements[at][1], tuple(elements[at][2]), skipped, end.end())


def read_header(path: Path, element: str = "vertex") -> Header:
    """Return `parse_header` of a file."""
    with path.open("rb") as stream:
        return parse_header(str(path), stream.read(_MOST_HEADER_BYTES), element)


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


Places: TypeAlias = dict[tuple[str, bool], tuple[int, tuple[int, int]]]


class Records:
    """The records of the vertices or faces, walked over once, so that every count in them holds."""

    def __init__(self, path: Path, element: str = "vertex") -> None:
        """Walk over the file; one without such or that ends early is an `InputError`."""
        self.header = header = read_header(path, element)
        self._units = _units(path, header)
        self._item, self._prefix, self._field = _layout(header)
        least = int((self._prefix + self._item * (self._prefix == 0)).sum())
        if header.records * max(least, 1) > len(self._units):
            self._complain(header.records)
        names = [p.name for p in header.properties if p.length]
        starts = np.zeros((len(names), header.records + 1), np.int64)
        which = np.array([self._field[name, True][0] for name in names], np.int64)
        big = header.order == ">"
        end = list_starts(self._units, self._item, self._prefix, big, which, starts)
        if end < 0:
            self._complain(-1 - end)
        self._starts = dict(zip(names, starts, strict=True))

    def _complain(self, row: int) -> None:
        raise InputError(
            f"{self.header.name}: is cut short or damaged: the header promises"
            f" {self.header.records:,} {self.header.kind}, number {row:,} is not whole; copy it"
            " again."
        )

    def numbers(self, *names: str) -> FloatArray:
        """Return properties that are no lists as columns, shape (n, names)."""
        count = self.header.records
        columns = [self._copy(name, count, is_list=False) for name in names]
        return np.column_stack(columns).astype(np.float64)

    def lists(self, name: str) -> tuple[IntArray, npt.NDArray[Any]]:
        """Return where the lists of a property start, shape (n + 1,), and their items."""
        start = self._starts[name]
        return start, self._copy(name, int(start[-1]), is_list=True)

    def _copy(self, name: str, count: int, *, is_list: bool) -> npt.NDArray[Any]:
        header, (field, part) = self.header, self._field[name, is_list]
        item = header.item(name, is_list=is_list) or ""
        out = np.empty(count * header.size(item), self._units.dtype)
        copy_field(
            *(self._units, self._item, self._prefix, header.order == ">", field),
            *(part, header.records, out),
        )
        return out.view(header.order + item) if header.order else out


def _layout(header: Header) -> tuple[IntArray, IntArray, Places]:
    """Return the fields of a record, with neighbouring numbers taken as one.

    The units of each field's items; those of its list's length, 0 for numbers; and by name, and
    whether it is a list, the field of each property and its first and last unit among the numbers.
    """
    fields: list[list[int]] = []
    places: Places = {}
    for p in header.properties:
        size = header.size(p.item)
        if p.length:
            places[p.name, True] = len(fields), (0, 0)
            fields.append([size, header.size(p.length)])
            continue
        if not fields or fields[-1][1]:
            fields.append([0, 0])
        places[p.name, False] = len(fields) - 1, (fields[-1][0], fields[-1][0] + size)
        fields[-1][0] += size
    item, prefix = np.array(fields, np.int64).reshape(-1, 2).T.copy()
    return item, prefix, places


def _units(path: Path, header: Header) -> npt.NDArray[Any]:
    """Return the bytes of the records, or the numbers of a text, to the end of the file."""
    skip = 0
    for count, properties in header.skipped:
        if count and any(p.length for p in properties):
            raise InputError(
                f"{path}: lists come before the {header.kind}, which pcfix does not read; export"
                f" the {header.kind} first."
            )
        skip += count * sum(header.size(p.item) for p in properties)
    if header.order == "":
        return _text_numbers(path, header.end)[skip:]
    if path.stat().st_size == header.end:  # nothing cannot be mapped
        return np.zeros(0, np.uint8)
    return np.memmap(path, np.uint8, "r", offset=header.end)[skip:]


def _text_numbers(path: Path, start: int) -> FloatArray:
    text = path.read_bytes()[start:].decode("latin-1")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            return np.fromstring(text, np.float64, sep=" ")
    except (DeprecationWarning, ValueError) as error:
        raise InputError(
            f"{path}: says that it is text, but not all of it is numbers; export it again."
        ) from error


@device
def _length(units: npt.NDArray[Any], at: int, size: int, big: bool) -> int:
    """Return a list's count from its bytes, or from its one number where the file is text."""
    count = 0
    for j in range(size):
        count = count * 256 + int(units[at + (j if big else size - 1 - j)])
    return count


@kernel
def list_starts(
    units: npt.NDArray[Any], item: IntArray, prefix: IntArray, big: bool, which: IntArray,
    start: IntArray,
) -> int:  # fmt: skip
    """Walk over records and note where the lists of the fields `which` start.

    A unit is a byte, or a number of a text. Field f of a record has items of ``item[f]`` units;
    it is a list when ``prefix[f]``, the units of its count, is not zero. `start` has a row per
    field of `which`, and one place more than there are records. Return the end, or -1 - i where
    record i does not end within the units.
    """
    at = 0
    start[:, 0] = 0
    for i in range(start.shape[1] - 1):
        for f in range(item.size):
            count = 1
            if prefix[f]:
                if prefix[f] > units.size - at:
                    return -1 - i
                count = _length(units, at, prefix[f], big)
                at += prefix[f]
            if count < 0 or count > (units.size - at) // item[f]:
                return -1 - i
            at += count * item[f]
            for k in range(which.size):
                if which[k] == f:
                    start[k, i + 1] = start[k, i] + count
    return at


@kernel
def copy_field(
    units: npt.NDArray[Any], item: IntArray, prefix: IntArray, big: bool, field: int,
    part: tuple[int, int], records: int, out: npt.NDArray[Any],
) -> None:  # fmt: skip
    """Copy one field of records that `list_starts` has walked over without complaint.

    Of a list, all items; of a field that is none, the units from ``part[0]`` to ``part[1]``.
    """
    at = 0
    filled = 0
    for _ in range(records):
        for f in range(item.size):
            width = item[f]
            if prefix[f]:
                width *= _length(units, at, prefix[f], big)
                at += prefix[f]
            if f == field:
                first, last = (0, width) if prefix[f] else part
                for j in range(first, last):
                    out[filled] = units[at + j]
                    filled += 1
            at += width

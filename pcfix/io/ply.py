"""Read the vertices and faces of PLY files, with lists, which other readers refuse.

The format is Greg Turk's (The PLY Polygon File Format, 1994): a header of lines names elements and
their properties, ``property TYPE NAME`` or ``property list COUNT_TYPE ITEM_TYPE NAME``; the records
follow as bytes without padding. Records that follow as text are refused.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pcfix.errors import bad_file
from pcfix.kernels import kernel
from pcfix.model import FloatArray, IntArray

_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1"},
    **{"short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2"},
    **{"int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "int64": "i8", "uint64": "u8"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_MOST_HEADER_BYTES = 1 << 20
_KINDS = {"vertex": "vertices", "face": "faces"}
_ROWS_AT_ONCE = 1_000_000
"""Of lists that are copied at a time, which bounds the memory."""


class Property(NamedTuple):
    """A field of a record; `length` is the type of a list's length, empty for a single number."""

    name: str
    item: str
    length: str = ""


class Header(NamedTuple):
    """The header of a PLY file, for its vertices or another element."""

    name: str  # of the file, for messages
    order: str  # of the bytes, "<" or ">"
    kind: str  # of the records, in the plural, for messages
    records: int  # stated, not checked
    properties: tuple[Property, ...]  # of a record
    skipped: tuple[tuple[int, tuple[Property, ...]], ...]  # elements that come before these
    end: int  # bytes of the header

    def item(self, name: str, *, is_list: bool) -> str | None:
        """Return the type of a number, or of a list's items; None without such a property."""
        found = [p.item for p in self.properties if p.name == name and bool(p.length) == is_list]
        return found[0] if found else None


def parse_header(name: str, head: bytes, element: str = "vertex") -> Header:
    """Parse the first bytes of a PLY file, for its vertices or faces."""
    end = re.search(rb"end_header[ \t]*\r?\n", head)
    if not head.startswith(b"ply") or end is None:
        raise bad_file(name, "ply.header", "is not a PLY file with a complete header.")
    order: str | None = None
    elements: list[tuple[str, int, list[Property]]] = []
    lines = [line.split() for line in head[: end.start()].decode("latin-1").splitlines()]
    try:
        for key, *fields in filter(None, lines):
            if [key, *fields[:1]] == ["format", "ascii"]:
                raise bad_file(name, "ply.text", "is a PLY of text. Export it as binary PLY.")
            if key == "format":
                order = _FORMATS[fields[0]]
            elif key == "element":
                elements.append((fields[0], int(fields[1]), []))
            elif key == "property" and fields[0] == "list":
                elements[-1][2].append(Property(fields[3], _TYPES[fields[2]], _TYPES[fields[1]]))
            elif key == "property":
                elements[-1][2].append(Property(fields[1], _TYPES[fields[0]]))
        if order is None or any(count < 0 for _, count, _ in elements):
            raise ValueError("no format, or a negative number of records")
        if any(p.length.startswith("f") for _, _, properties in elements for p in properties):
            raise ValueError("a list counted by a fraction")
    except (KeyError, ValueError, IndexError) as error:
        sentence = f"the PLY header is damaged ({error}). Export it again."
        raise bad_file(name, "ply.header", sentence) from error
    names, kind = [one for one, _, _ in elements], _KINDS[element]
    if element not in names:
        raise bad_file(name, "ply.element_missing", f"has no {kind}. Export it again with them.")
    at = names.index(element)
    skipped = tuple((count, tuple(p)) for _, count, p in elements[:at])
    return Header(name, order, kind, elements[at][1], tuple(elements[at][2]), skipped, end.end())


def read_header(path: Path, element: str = "vertex") -> Header:
    """Return `parse_header` of a file."""
    with path.open("rb") as stream:
        return parse_header(str(path), stream.read(_MOST_HEADER_BYTES), element)


class Records:
    """The records of a file; it is checked that all are there."""

    def __init__(self, path: Path, header: Header) -> None:
        self.header = header
        self._units = _units(path, header)
        # neighbouring numbers are one field, whose count is 1: units of an item and of a count
        fields: list[tuple[int, int]] = []
        self._place: dict[tuple[str, bool], tuple[int, int]] = {}
        for p in header.properties:
            size, is_list = int(p.item[1]), bool(p.length)
            if is_list or not fields or fields[-1][1]:
                fields.append((0, int(p.length[1]) if is_list else 0))
            before, count = fields[-1]
            self._place[p.name, is_list] = len(fields) - 1, before
            fields[-1] = before + size, count
        self._item, prefix = np.array(fields, np.int64).reshape(-1, 2).T.copy()
        least = int((prefix + self._item * (prefix == 0)).sum())
        complete = len(self._units) // max(least, 1)
        if header.records <= complete:
            shape = header.records, len(fields)
            self._start, self._count = np.empty(shape, np.int64), np.empty(shape, np.int64)
            complete, self.end = _list_starts(
                self._units, self._item, prefix, header.order == ">", self._start, self._count
            )
        if complete < header.records:
            sentence = f"is cut short: {complete:,} of {header.records:,} {header.kind} are there."
            raise bad_file(header.name, "ply.cut_short", sentence, records=header.records)

    def numbers(self, *names: str) -> FloatArray:
        """Return properties that are not lists as columns, shape (n, names)."""
        columns = []
        for name in names:
            field, offset = self._place[name, False]
            kind = self.header.item(name, is_list=False)
            items = _items_at(self._units, self.header.order, kind)
            columns.append(items[self._start[:, field] + offset])
        return np.column_stack(columns).astype(np.float64)

    def lists(self, name: str) -> tuple[IntArray, npt.NDArray[Any]]:
        """Return where the lists of a property start, shape (n + 1,), and their items."""
        field, _ = self._place[name, True]
        items = _items_at(self._units, self.header.order, self.header.item(name, is_list=True))
        first, count, size = self._start[:, field], self._count[:, field], int(self._item[field])
        start = np.concatenate([[0], np.cumsum(count)])
        values = np.empty(start[-1], items.dtype)
        for at in range(0, len(count), _ROWS_AT_ONCE):
            rows = slice(at, at + _ROWS_AT_ONCE)
            low, high = start[at], start[min(at + _ROWS_AT_ONCE, len(count))]
            unit = np.repeat(first[rows] - size * start[:-1][rows], count[rows])
            values[low:high] = items[unit + size * np.arange(low, high)]
        return start, values


def _items_at(units: npt.NDArray[Any], order: str, item: str | None) -> npt.NDArray[Any]:
    """View bytes as the item of a type that begins at each of them."""
    kind = np.dtype(f"{order}{item}")
    return np.ndarray(max(len(units) - kind.itemsize + 1, 0), kind, units, strides=(1,))


def _units(path: Path, header: Header) -> npt.NDArray[Any]:
    """Return the bytes of the records, to the end of the file."""
    skip = 0
    for count, properties in header.skipped:
        if count and any(p.length for p in properties):
            sentence = f"has lists before the {header.kind}. Export the {header.kind} first."
            raise bad_file(path, "ply.order", sentence)
        skip += count * sum(int(p.item[1]) for p in properties)
    if path.stat().st_size <= header.end:  # an empty map is not allowed
        return np.zeros(0, np.uint8)
    return np.memmap(path, np.uint8, "r", offset=header.end)[skip:]


@kernel
def _list_starts(
    units: npt.NDArray[Any], item: IntArray, prefix: IntArray, big: bool, start: IntArray,
    count: IntArray,
) -> tuple[int, int]:  # fmt: skip
    """Walk over records, and fill in where each of their fields starts and how many items it has.

    Field f of a record has items of ``item[f]`` units; it is a list if ``prefix[f]``, the units of
    its count, is not zero. `start` and `count` have a row per record and a column per field.
    Return how many records are complete, and the unit where they end.
    """
    at = 0
    for i in range(start.shape[0]):
        for f in range(item.size):
            length = 1
            if prefix[f]:
                if prefix[f] > units.size - at:
                    return i, at
                length = 0  # from the bytes of the count, or its one number in a text
                for j in range(prefix[f]):
                    length = length * 256 + int(units[at + (j if big else prefix[f] - 1 - j)])
                at += prefix[f]
            # divided, not multiplied: a damaged count times the item would overflow
            if length < 0 or length > (units.size - at) // item[f]:
                return i, at
            start[i, f] = at
            count[i, f] = length
            at += length * item[f]
    return start.shape[0], at

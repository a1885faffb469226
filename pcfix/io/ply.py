"""Read the vertices and faces of PLY files, with lists, which other readers refuse.

The format is Greg Turk's (The PLY Polygon File Format, 1994): a header of lines names elements and
their properties, ``property TYPE NAME`` or ``property list COUNT_TYPE ITEM_TYPE NAME``; the records
follow as bytes without padding. Records that follow as text are refused.
"""

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
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8", "": ""},
}
_FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_MOST_HEADER_BYTES = 1 << 20
_KINDS = {"vertex": "vertices", "face": "faces"}
_ROWS_AT_ONCE = 1_000_000  # records that are read at a time, which bounds the memory


class Element(NamedTuple):
    """The vertices or the faces of a PLY file, as its header describes them."""

    name: str  # of the file, for messages
    kind: str  # of the records, in the plural, for messages
    order: str  # of the bytes, "<" or ">"
    records: int  # stated, not checked
    properties: dict[str, tuple[str, str]]  # type of a number, and of a list's length or empty
    first: int  # byte of the file where the records begin

    def has(self, *names: str, lists: bool = False) -> bool:
        """Whether a record has numbers, or lists, of these names."""
        return all(n in self.properties and bool(self.properties[n][1]) == lists for n in names)


class Column(NamedTuple):
    """A property of all n records: those of record i are ``items[start[i]:start[i + 1]]``."""

    start: IntArray  # (n + 1,)
    items: npt.NDArray[Any]  # (n,) of a number


def parse_header(name: str, head: bytes, element: str = "vertex") -> Element:
    """Parse the first bytes of a PLY file, for its vertices or faces."""
    end = re.search(rb"end_header[ \t]*\r?\n", head)
    if not head.startswith(b"ply") or end is None:
        raise bad_file(name, "ply.header", "is not a PLY file with a complete header.")
    order, elements = "", list[tuple[str, int, dict[str, tuple[str, str]]]]()
    lines = [line.split() for line in head[: end.start()].decode("latin-1").splitlines()]
    try:
        for key, *fields in filter(None, lines):
            if [key, *fields[:1]] == ["format", "ascii"]:
                raise bad_file(name, "ply.text", "is a PLY of text. Export it as binary PLY.")
            if key == "format":
                order = _FORMATS[fields[0]]
            elif key == "element":
                elements.append((fields[0], int(fields[1]), {}))
            elif key == "property":
                length, item, own = fields[1:4] if fields[0] == "list" else ("", *fields[:2])
                if own in elements[-1][2] or length.startswith(("f", "d")):
                    raise ValueError(f"property {own} twice, or counted by a fraction")
                elements[-1][2][own] = _TYPES[item], _TYPES[length]
        if not order or any(count < 0 for _, count, _ in elements):
            raise ValueError("no format, or a negative number of records")
    except (KeyError, ValueError, IndexError) as error:
        sentence = f"the PLY header is damaged ({error}). Export it again."
        raise bad_file(name, "ply.header", sentence) from error
    kind, first = _KINDS[element], end.end()
    names = [own for own, _, _ in elements]
    if element not in names:
        raise bad_file(name, "ply.element_missing", f"has no {kind}. Export it again with them.")
    at = names.index(element)
    for _, count, properties in elements[:at]:
        if count and any(length for _, length in properties.values()):
            sentence = f"has lists before the {kind}. Export the {kind} first."
            raise bad_file(name, "ply.order", sentence)
        first += count * sum(int(item[1]) for item, _ in properties.values())
    return Element(name, kind, order, *elements[at][1:], first)


def read_header(path: Path, element: str = "vertex") -> Element:
    """Return `parse_header` of a file."""
    with path.open("rb") as stream:
        return parse_header(str(path), stream.read(_MOST_HEADER_BYTES), element)


def read_columns(path: Path, element: Element, *names: str) -> dict[str, Column]:
    """Return properties of all records by name; refuse a file that lacks records."""
    data = np.memmap(path, np.uint8, "r")[element.first :]
    # Neighbouring numbers are one field, whose count is 1; a list is a field too. Of each field the
    # bytes of an item and of the list's length, of each property its field and the offset in it.
    fields, place = list[tuple[int, int]](), dict[str, tuple[int, int]]()
    for name, (kind, length) in element.properties.items():
        if length or not fields or fields[-1][1]:
            fields.append((0, int(length[1:] or 0)))
        size, prefix = fields[-1]
        place[name] = len(fields) - 1, size
        fields[-1] = size + int(kind[1]), prefix
    sizes = np.array(fields, np.int64)
    shape = 2, min(element.records, _ROWS_AT_ONCE), len(fields)
    begin, count = np.empty(shape, np.int64)
    kinds = {name: element.order + element.properties[name][0] for name in names}
    found = {name: ([np.zeros(1, np.int64)], [np.zeros(0, kind)]) for name, kind in kinds.items()}
    at = 0
    for first in range(0, element.records, _ROWS_AT_ONCE):
        rows = slice(min(element.records - first, _ROWS_AT_ONCE))
        at = _list_starts(data, at, sizes, element.order == ">", begin[rows], count[rows])
        if at < 0:
            sentence = f"is cut short: not all of its {element.records:,} {element.kind} are there."
            raise bad_file(element.name, "ply.cut_short", sentence, records=element.records)
        for name, (counts, parts) in found.items():
            (field, offset), number = place[name], parts[0].dtype
            # a view whose item i is the number of this type that begins at byte i
            items = np.ndarray(max(len(data) - number.itemsize + 1, 0), number, data, strides=(1,))
            many, step = count[rows, field].copy(), sizes[field, 0]
            # items are numbered through all lists; each is at the start of its list plus its steps
            first_of_all = begin[rows, field] + offset - step * (np.cumsum(many) - many)
            parts.append(items[np.repeat(first_of_all, many) + step * np.arange(many.sum())])
            counts.append(many)
    return {
        name: Column(np.cumsum(np.concatenate(counts)), np.concatenate(parts))
        for name, (counts, parts) in found.items()
    }


def positions(path: Path, vertices: Element) -> FloatArray:
    """Return x, y and z of all vertices, shape (n, 3)."""
    columns = read_columns(path, vertices, *"xyz")
    return np.column_stack([columns[axis].items for axis in "xyz"]).astype(np.float64)


@kernel
def _list_starts(
    data: npt.NDArray[Any], at: int, sizes: IntArray, big: bool, start: IntArray, count: IntArray
) -> int:
    """Walk over records, and fill in where each of their fields starts and how many items it has.

    The first record begins at the byte `at` of `data`. Field f of a record has items of
    ``sizes[f, 0]`` bytes; it is a list if ``sizes[f, 1]``, the bytes of its length, is not zero.
    `start` and `count` have a row per record and a column per field. Return the byte where the
    records end, -1 if the last ones are not complete.
    """
    for i in range(start.shape[0]):
        for f in range(sizes.shape[0]):
            item, prefix = sizes[f]
            length = 1
            if prefix:
                if prefix > data.size - at:
                    return -1
                length = 0  # its bytes, the highest first
                for j in range(prefix):
                    length = length * 256 + int(data[at + (j if big else prefix - 1 - j)])
                at += prefix
            # divided, not multiplied: a damaged length times the item would overflow
            if length < 0 or length > (data.size - at) // item:
                return -1
            start[i, f] = at
            count[i, f] = length
            at += length * item
    return at

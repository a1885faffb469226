"""Vertices of PLY files, with the lists that other readers refuse.

A unit is a byte, or a number of a text; see `pcfix.io.ply` for the format.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from numba import njit

from pcfix.errors import InputError
from pcfix.io.ply import Header, read_header
from pcfix.model import FloatArray, IntArray

Places: TypeAlias = dict[tuple[str, bool], tuple[int, tuple[int, int]]]


class Vertices:
    """The records of the vertices, walked over once, so that every count in them holds."""

    def __init__(self, path: Path) -> None:
        """Walk over the file; one without vertices or that ends early is an `InputError`."""
        self.header = header = read_header(path)
        self._units = _units(path, header)
        self._item, self._prefix, self._field = _layout(header)
        least = int((self._prefix + self._item * (self._prefix == 0)).sum())
        if header.vertices * least > len(self._units):
            self._complain(header.vertices)
        names = [p.name for p in header.properties if p.length]
        starts = np.zeros((len(names), header.vertices + 1), np.int64)
        which = np.array([self._field[name, True][0] for name in names], np.int64)
        big = header.order == ">"
        end = list_starts(self._units, self._item, self._prefix, big, which, starts)
        if end < 0:
            self._complain(-1 - end)
        self._starts = dict(zip(names, starts, strict=True))

    def _complain(self, row: int) -> None:
        raise InputError(
            f"{self.header.name}: is cut short or damaged: the header promises"
            f" {self.header.vertices:,} vertices, number {row:,} is not whole; copy it again."
        )

    def numbers(self, *names: str) -> FloatArray:
        """Return properties that are no lists as columns, shape (n, names)."""
        count = self.header.vertices
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
            *(part, header.vertices, out),
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
    """Return the bytes of the vertices, or the numbers of a text, to the end of the file."""
    skip = 0
    for count, properties in header.skipped:
        if count and any(p.length for p in properties):
            raise InputError(
                f"{path}: lists come before the vertices, which pcfix does not read; export the"
                " points alone."
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


@njit(cache=True, error_model="numpy", nogil=True)
def _length(units: npt.NDArray[Any], at: int, size: int, big: bool) -> int:
    """Return a list's count from its bytes, or from its one number where the file is text."""
    count = 0
    for j in range(size):
        count = count * 256 + int(units[at + (j if big else size - 1 - j)])
    return count


@njit(cache=True, error_model="numpy", nogil=True)
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


@njit(cache=True, error_model="numpy", nogil=True)
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

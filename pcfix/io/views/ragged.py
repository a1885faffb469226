"""Lists of different lengths, one after another: found and copied without trusting a count."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

if TYPE_CHECKING:
    import numpy.typing as npt

    from pcfix.model import IntArray


@njit(cache=True, error_model="numpy", nogil=True)
def split_counted(
    words: npt.NDArray[np.uint32], start: IntArray, items: npt.NDArray[np.int32]
) -> int:
    """Split ``count, item, item, ..., count, item, ...`` into `start` and `items`.

    There is one list less than places in `start`. Return how many words were used, or -1 - i
    where list i does not end within the words.
    """
    at = 0
    start[0] = 0
    for i in range(start.size - 1):
        if at >= words.size:
            return -1 - i
        count = int(words[at])
        at += 1
        if count > words.size - at or start[i] + count > items.size:
            return -1 - i
        for j in range(count):
            items[start[i] + j] = words[at + j]
        start[i + 1] = start[i] + count
        at += count
    return at


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


@njit(cache=True, error_model="numpy", nogil=True)
def posed_starts(
    row: IntArray, start: IntArray, image: npt.NDArray[np.int32], camera: npt.NDArray[np.int32]
) -> tuple[IntArray, int]:
    """Return where the lists of some rows start once images without a camera are left out.

    Row -1 has no list. Also return how many entries are left out.
    """
    begin = np.zeros(row.size + 1, np.int64)
    left_out = 0
    for k in range(row.size):
        begin[k + 1] = begin[k]
        if row[k] >= 0:
            for j in range(start[row[k]], start[row[k] + 1]):
                if camera[image[j]] >= 0:
                    begin[k + 1] += 1
                else:
                    left_out += 1
    return begin, left_out


@njit(cache=True, error_model="numpy", nogil=True)
def copy_posed(
    row: IntArray, start: IntArray, image: npt.NDArray[np.int32], camera: npt.NDArray[np.int32],
    weight: npt.NDArray[np.float32], out: IntArray, out_weight: npt.NDArray[np.float32],
) -> None:  # fmt: skip
    """Fill what `posed_starts` has measured; weights only where there are any."""
    filled = 0
    for k in range(row.size):
        if row[k] < 0:
            continue
        for j in range(start[row[k]], start[row[k] + 1]):
            if camera[image[j]] >= 0:
                out[filled] = camera[image[j]]
                if weight.size:
                    out_weight[filled] = weight[j]
                filled += 1

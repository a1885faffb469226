"""Settings of a running command: threads, progress, and where large arrays are stored.

`running` sets them, as one value `Run`, for the current thread. So no kernel or search needs them
as arguments. No result depends on them. Other threads start with the defaults.

Arrays larger than memory are stored in files, and processed in blocks of rows in the order of the
file. So results depend neither on tiles nor on threads. An array of one block is plain numpy.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[Any]
# Creates an array with undefined values: `numpy.empty`, or an array on disk.
Empty: TypeAlias = Callable[[tuple[int, ...], npt.DTypeLike], Array]


def _nothing(*given: object) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class Run:
    """Settings of a running command."""

    threads: int  # for kernels and searches
    report: Callable[[float], None] = _nothing  # takes how many points have just been corrected
    say: Callable[[str], None] | None = None  # takes a line of text after a step of an adjustment
    empty: Empty = np.empty  # `pcfix.io.files.scratch_arrays` gives one for arrays on disk
    release: Callable[[], None] = _nothing  # frees the memory of arrays on disk
    clouds: dict[Path, list[Any]] | None = None  # points of small clouds that are read repeatedly


# The cores that this process may use.
_CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_RUN = ContextVar("pcfix_run", default=Run(_CORES))  # noqa: B039 (frozen)


def current() -> Run:
    """Return the settings of the current thread."""
    return _RUN.get()


@contextmanager
def running(**changes: Any) -> Iterator[None]:
    """Change fields of the current `Run` until the block ends."""
    token = _RUN.set(replace(_RUN.get(), **changes))
    try:
        yield
    finally:
        _RUN.reset(token)


def threads(jobs: int | None) -> AbstractContextManager[None]:
    """Run with this number of threads until the block ends; None changes nothing."""
    return running(threads=jobs or current().threads)


# Large arrays

ROWS = 1_000_000
FEW_ROWS = 65_536  # rows of a block whose intermediate arrays fit into the processor's cache
LARGE = 2_000_000  # an array with more rows is stored on disk, if there is a folder for it


def empty(shape: tuple[int, ...], dtype: npt.DTypeLike = np.float64) -> Array:
    """Return an array with undefined values, on disk if it is large."""
    return current().empty(shape, dtype) if shape[0] > LARGE else np.empty(shape, dtype)


def release() -> None:
    """Free the memory of arrays on disk; they are read again when they are used."""
    current().release()


def blocks(count: int, most: int = ROWS) -> Iterator[slice]:
    """Yield slices of all rows, of at most `most` each."""
    for first in range(0, count, most):
        yield slice(first, min(first + most, count))
        release()


def mapped(function: Callable[..., Any], *arrays: Array) -> Array:
    """Apply a function that works row by row to arrays, (n, ...), block by block."""
    count, result = len(arrays[0]), None
    if count <= ROWS:
        return np.asarray(function(*arrays))
    for rows in blocks(count):
        part = function(*(one[rows] for one in arrays))
        if result is None:
            result = empty((count, *part.shape[1:]), part.dtype)
        result[rows] = part
    return np.asarray(result)


def subset(mask: Array, array: Array) -> Array:
    """Return the rows of an array, (n, ...), where a mask, (n,), is true."""
    count, done = int(np.count_nonzero(mask)), 0
    if count == len(mask):
        return array
    result = empty((count, *array.shape[1:]), array.dtype)
    for rows in blocks(len(mask)):
        part = array[rows][mask[rows]]
        result[done : done + len(part)] = part
        done += len(part)
    return result


def bounds(points: Array) -> tuple[Array, Array]:
    """Return the minimum and maximum of each column of points, (n, d), both of shape (d,)."""
    ends = [
        [(column.min(), column.max()) for column in points[rows].T] for rows in blocks(len(points))
    ]
    return np.min(ends, axis=0)[:, 0], np.max(ends, axis=0)[:, 1]


def row_numbers(count: int) -> Array:
    """Return 0 to count - 1."""
    result = empty((count,), np.int64)
    for rows in blocks(count):
        result[rows] = np.arange(rows.start, rows.stop)
    return result


def grouped(number: Array, groups: int, *columns: Array) -> tuple[Array, list[Array]]:
    """Sort columns, (n, ...), by the group number of their rows, (n,), in a stable order.

    Return `start`, shape (groups + 1,), and the sorted columns, of which group i has the rows
    ``start[i]`` to ``start[i + 1]``.
    """
    count = len(number)
    counts = np.zeros(groups, np.int64)
    for rows in blocks(count):
        counts += np.bincount(number[rows], minlength=groups)
    place = np.cumsum(counts) - counts
    start = np.append(place, count)
    result = [empty(one.shape, one.dtype) for one in columns]
    for rows in blocks(count):
        order = np.argsort(number[rows], kind="stable")
        some = np.bincount(number[rows], minlength=groups)
        ends = np.cumsum(some)
        for one, into in zip(columns, result, strict=True):
            # `take` gathers rows three times as fast as an index
            part = one[rows].take(order, axis=0)
            for group in np.flatnonzero(some):
                first, end = ends[group] - some[group], ends[group]
                into[place[group] : place[group] + some[group]] = part[first:end]
        place += some
    return start, result


def distinct(values: Array) -> Array:
    """Return each value once, ascending; `numpy.unique` takes fifty times as long for millions."""
    values = np.sort(values, axis=None)
    return values[np.append(True, values[1:] != values[:-1])[: len(values)]]

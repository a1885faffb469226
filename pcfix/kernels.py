"""How kernels are compiled, and how their rows are shared out among threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from typing import Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from pcfix import parts
from pcfix.errors import SettingError

_Function = TypeVar("_Function", bound=Callable[..., Any])

kernel: Callable[[_Function], _Function] = parts.kernel(error_model="numpy", nogil=True)
"""Compile a kernel: Python calls it."""

part: Callable[[_Function], _Function] = parts.part(error_model="numpy", nogil=True)
"""Compile a part of kernels: only they call it, and other parts."""

lean_kernel: Callable[[_Function], _Function] = parts.kernel(
    error_model="numpy", nogil=True, _nrt=False
)
"""Compile a kernel that makes no array and calls nothing that does.

References to arrays are not counted in it. Counting takes two locked operations for each array of
each argument, which was two thirds of the time of kernels that are handed tuples of arrays.
"""

lean: Callable[[_Function], _Function] = parts.part(error_model="numpy", nogil=True, _nrt=False)
"""Compile a part that makes no array and calls none that does; see `lean_kernel`."""

inlined: Callable[[_Function], _Function] = parts.part(
    error_model="numpy", nogil=True, forceinline=True, _nrt=False
)
"""Compile a small lean part into those that call it."""

summed: Callable[[_Function], _Function] = parts.part(
    error_model="numpy", nogil=True, forceinline=True, _nrt=False,
    fastmath={"reassoc", "contract"},
)  # fmt: skip
"""Compile a small lean part of long sums into those that call it; their order is left open."""

Span: TypeAlias = tuple[int, int]
"""The first of the rows of a tile, and the one after its last."""

TILES_A_THREAD = 8
"""So many pieces of work wait for each thread, as some take longer than others."""

_most_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


@contextmanager
def threads(jobs: int | None) -> Iterator[None]:
    """Run with so many threads, all cores where None; the result does not depend on it."""
    global _most_threads
    if jobs is not None and jobs < 1:
        raise SettingError(f"jobs {jobs} is less than 1: give a number of threads.")
    before = _most_threads
    _most_threads = jobs or before
    try:
        yield
    finally:
        _most_threads = before


def cores() -> int:
    """Return on how many threads kernels run."""
    return _most_threads or 1


def _tell(points: float) -> None:
    """Tell that so many more points are done; `telling` replaces it for a while."""


@contextmanager
def telling(report: Callable[[int], None]) -> Iterator[None]:
    """Report how many points the methods of correction have done so far, while they run."""
    global _tell
    before, done = _tell, 0.0

    def tell(points: float) -> None:
        nonlocal done
        done += points
        report(round(done))

    _tell = tell
    try:
        yield
    finally:
        _tell = before


def in_tiles(run: Callable[..., Any], rows: int, *given: Any, points: int = 0) -> None:
    """Call ``run((first, last), *given)`` for all rows, a tile of them at a time in each thread.

    No row may depend on another one: which share a tile depends on the number of threads. Of
    `points`, where there are so many in all rows, each tile is told to be done; see `telling`.
    """
    count = min(cores(), rows)
    if not rows:
        return
    tiles = min(rows, TILES_A_THREAD * count) if count > 1 or points else 1
    edges = [rows * i // tiles for i in range(tiles + 1)]

    def one(i: int) -> None:
        run((edges[i], edges[i + 1]), *given)

    with ThreadPoolExecutor(count) if count > 1 else nullcontext() as pool:
        for _ in map(one, range(tiles)) if pool is None else pool.map(one, range(tiles)):
            _tell(points / tiles)


@lean
def most_between(span: Span, start: npt.NDArray[np.int64]) -> int:
    """Return how many entries, ``start[i]`` to ``start[i + 1]``, a row of a tile has at most."""
    most = 0
    for i in range(*span):
        most = max(most, start[i + 1] - start[i])
    return most

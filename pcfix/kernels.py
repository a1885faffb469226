"""How kernels are compiled, and how their rows are shared out among threads."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from operator import length_hint
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

ALONE_S = 2e-4
"""About as long as a thread takes to begin."""

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

    No row may depend on another one: which share a tile depends on the number of threads. Other
    threads help where there is work for more than `ALONE_S`, or so few rows that each is a tile.
    Of `points`, where there are so many in all rows, those done are told; see `telling`.
    """
    count = min(cores(), rows)
    if not rows:
        return
    tiles = min(rows, TILES_A_THREAD * count) if count > 1 or points else 1
    edges = [rows * i // tiles for i in range(tiles + 1)]
    if tiles > 1 and edges[1] > 1:
        edges.insert(1, -(-edges[1] // TILES_A_THREAD))  # it tells how long the others take
    left, done, told, helpers = iter([*pairwise(edges)]), [0], 0, list[Future[None]]()

    def work(then: Callable[[], None] = lambda: None) -> None:
        try:
            for span in left:
                run(span, *given)
                done.append(span[1] - span[0])
                then()
        finally:
            deque(left, 0)  # after an error nobody goes on

    def tell_and_ask() -> None:
        nonlocal told
        before, told = told, sum(done)
        _tell(points * (told - before) / rows)
        if length_hint(left) and not helpers and time.perf_counter() > busy_from:
            helpers.extend(pool.submit(work) for _ in range(count - 1))

    busy_from = time.perf_counter() + ALONE_S if tiles < rows else 0.0
    with ThreadPoolExecutor(count) as pool:
        tell_and_ask()
        work(tell_and_ask)
        for helper in helpers:
            helper.result()
    tell_and_ask()


@lean
def most_between(span: Span, start: npt.NDArray[np.int64]) -> int:
    """Return how many entries, ``start[i]`` to ``start[i + 1]``, a row of a tile has at most."""
    most = 0
    for i in range(*span):
        most = max(most, start[i + 1] - start[i])
    return most

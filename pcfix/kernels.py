"""Numba settings, and threads over tiles of rows."""

import hashlib
import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, overload

import numba

from pcfix.errors import PcfixWarning
from pcfix.running import current, running
from pcfix.version import __version__

_Function = TypeVar("_Function", bound=Callable[..., Any])
_Value = TypeVar("_Value")
_Result = TypeVar("_Result")

# Files with kernels, and those whose constants are compiled into them.
KERNEL_SOURCES = (
    "kernels.py", "model.py", "io/ply.py", "adjust/*.py", "lens/*.py", "port/*.py", "refract/*.py",
    "water/*.py",
)  # fmt: skip
MOST_CACHES = 5  # maximum number of folders of compiled kernels, of this and of older versions


@cache
def cache_folder() -> Path | None:
    """Return the folder of the compiled kernels, created if necessary.

    If it cannot be created, warn once and return None.

    numba compares a cached kernel with its own source file only, and does not see edits of the
    files that it imports. So the name of the folder has the version and a hash of the sources.
    """
    package, sources = Path(__file__).parent, hashlib.blake2b(digest_size=8)
    for path in sorted(path for part in KERNEL_SOURCES for path in package.glob(part)):
        sources.update(path.read_bytes())
    given = os.environ.get("NUMBA_CACHE_DIR")
    try:
        user = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        root = Path(given) if given else Path(user, "pcfix")
        folder = root / f"kernels-{__version__}-{sources.hexdigest()}"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError):  # a user without a home
        words = (
            "Compiled kernels cannot be cached, because the user's cache folder cannot be written:"
            " each start compiles them again (about a minute). Set NUMBA_CACHE_DIR to a folder"
            " that can be written."
        )
        warnings.warn(PcfixWarning("kernels.no_cache", words), stacklevel=2)
        return None
    older = sorted(root.glob("kernels-*"), key=lambda path: path.stat().st_mtime)
    for path in older[:-MOST_CACHES]:
        shutil.rmtree(path, ignore_errors=True)
    return folder


@overload
def kernel(function: _Function, *, allocates: bool = False) -> _Function: ...
@overload
def kernel(*, allocates: bool) -> Callable[[_Function], _Function]: ...
def kernel(function: Any = None, *, allocates: bool = False) -> Any:
    """Compile a function that Python calls, and cache the result.

    With `allocates` the function may create arrays. Without it, numba does not count references to
    arrays. Counting takes two locked operations for every array of every argument: a third of the
    time of a correction.
    """
    if function is None:
        return partial(kernel, allocates=allocates)
    options = {"nogil": True, "error_model": "numpy", "_nrt": allocates}
    folder = cache_folder()
    if folder is None:
        return numba.njit(**options)(function)
    # numba reads its setting when a function is declared; those of other packages keep theirs
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
    try:
        return numba.njit(cache=True, **options)(function)
    finally:
        numba.config.CACHE_DIR = before


@overload
def device(function: _Function) -> _Function: ...
@overload
def device(*, allocates: bool = False, **options: Any) -> Callable[[_Function], _Function]: ...
def device(function: Any = None, *, allocates: bool = False, **options: Any) -> Any:
    """Compile a function that only kernels call; it becomes part of their cached code.

    It has no wrappers for Python and C, whose compilation would take a third of the first run.
    Therefore a call from Python ends the process; tests use ``tests.utils.compiled``.
    `allocates` is as for `kernel`; `options` are further options of ``numba.njit``.
    """
    decorator = numba.njit(
        nogil=True, error_model="numpy", _nrt=allocates,
        no_cpython_wrapper=True, no_cfunc_wrapper=True, **options,
    )  # fmt: skip
    return decorator if function is None else decorator(function)


Span: TypeAlias = tuple[int, int]  # the first row of a tile, and the row after its last
TILES_A_THREAD = 8  # number of tiles for each thread, because some take longer than others
THREAD_START_S = 2e-4  # approximate time that a thread takes to start


def in_tiles(run: Callable[..., Any], rows: int, *given: Any, points: int = 0) -> None:
    """Call ``run((first, last), *given)`` for tiles of rows, in several threads.

    The result of a row must not depend on other rows, because the tiles depend on the number of
    threads. Further threads start after `THREAD_START_S`, or at once if each row is a tile.
    `pcfix.running.Run.report` gets the progress in points; `points` are those of all rows.
    """
    if not rows:
        return
    how = current()
    count = min(how.threads, rows)
    tiles = min(rows, TILES_A_THREAD * count) if count > 1 or points else 1
    edges = [rows * i // tiles for i in range(tiles + 1)]
    if tiles > 1 and edges[1] > 1:
        edges.insert(1, -(-edges[1] // TILES_A_THREAD))  # a small tile first, to measure the time
    spans = iter(pairwise(edges))

    def report(span: Span) -> None:
        how.report(points * (span[1] - span[0]) / rows)

    busy_from = time.perf_counter() + THREAD_START_S
    if tiles < rows or count == 1:
        for span in spans:
            run(span, *given)
            report(span)
            if count > 1 and time.perf_counter() > busy_from:
                break
    rest = [*spans]
    if rest:
        with ThreadPoolExecutor(count) as pool:  # after an error no further tile starts
            done = pool.map(lambda span: run(span, *given), rest)
            for span, _ in zip(rest, done, strict=True):
                report(span)


def in_threads(run: Callable[[_Value], _Result], values: Sequence[_Value]) -> list[_Result]:
    """Return ``[run(value) for value in values]``, computed at the same time.

    Much of `run` is numpy, which has one thread; its kernels share the other threads.
    """
    with running(threads=-(-current().threads // len(values))):
        contexts = [copy_context() for _ in values]
    with ThreadPoolExecutor(current().threads) as pool:
        return list(pool.map(lambda there, value: there.run(run, value), contexts, values))

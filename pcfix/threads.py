"""The threads of the kernels: how many, and one caller at a time."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from pcfix.errors import SettingError


@contextmanager
def threads(jobs: int | None) -> Iterator[None]:
    """Run with so many threads; the result does not depend on it."""
    if jobs is not None and jobs < 1:
        raise SettingError(f"jobs {jobs} is less than 1: give a number of threads.")
    import numba

    with one_caller():
        before = numba.get_num_threads()
    if jobs is not None:
        numba.set_num_threads(min(jobs, numba.config.NUMBA_NUM_THREADS))
    try:
        yield
    finally:
        numba.set_num_threads(before)


_LOCK = threading.Lock()


@contextmanager
def one_caller() -> Iterator[None]:
    """Enter numba's pool of threads, some kinds of which abort when two callers are in it."""
    with _LOCK, warnings.catch_warnings():
        # where an old TBB lies about, numba says so and takes another library
        warnings.filterwarnings("ignore", "The TBB threading layer")
        yield

"""How many threads the kernels use."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from pcfix.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def threads(jobs: int | None) -> Iterator[None]:
    """Run with so many threads; the result does not depend on it."""
    if jobs is not None and jobs < 1:
        raise SettingError(f"jobs {jobs} is less than 1: give a number of threads.")
    import numba

    before = numba.get_num_threads()
    if jobs is not None:
        numba.set_num_threads(min(jobs, numba.config.NUMBA_NUM_THREADS))
    try:
        yield
    finally:
        numba.set_num_threads(before)

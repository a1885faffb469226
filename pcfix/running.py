"""Settings of a running command: threads, progress, and where large arrays are stored.

`running` sets them, as one value `Run`, for the current thread. So no kernel or search needs them
as arguments. No result depends on them. Other threads start with the defaults.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from pcfix.errors import SettingError

Empty: TypeAlias = Callable[[tuple[int, ...], npt.DTypeLike], npt.NDArray[Any]]
"""Creates an array with undefined values: `numpy.empty`, or an array on disk."""


def _nothing(*given: object) -> None:
    """Do nothing."""


def _available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass(frozen=True)
class Run:
    """Settings of a running command.

    Attributes
    ----------
    threads : int
        Number of threads for kernels and searches.
    report : callable
        Called with the number of points that have just been corrected.
    say : callable, optional
        Called with a line of text after each step of an adjustment.
    empty : callable
        Creates large arrays; `pcfix.io.files.scratch_arrays` creates them on disk.
    release : callable
        Frees the memory of arrays on disk.
    clouds : dict, optional
        Points of small clouds by path, for commands that read them more than once.
    """

    threads: int
    report: Callable[[float], None] = _nothing
    say: Callable[[str], None] | None = None
    empty: Empty = np.empty
    release: Callable[[], None] = _nothing
    clouds: dict[Path, list[Any]] | None = None


_RUN = ContextVar("pcfix_run", default=Run(_available_cores()))  # noqa: B039 (frozen)


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


@contextmanager
def threads(jobs: int | None) -> Iterator[None]:
    """Run with this number of threads; None changes nothing. Raises SettingError below 1."""
    if jobs is not None and jobs < 1:
        raise SettingError(
            "option.range", f"jobs {jobs} is less than 1.", option="jobs", value=jobs
        )
    with running(threads=jobs or current().threads):
        yield

"""Two processes compile kernels at once where none is kept yet.

numba compiles one function at a time, and keeps it in a file for the next process. So a second
process compiles what will be needed later, and the first one finds it there. Who comes to a kernel
first compiles it; who comes second meanwhile takes another one.

The second process is a fork, so that it begins at once: on Linux, from the main thread, with no
others but those that a progress bar has.
"""

from __future__ import annotations

import importlib
import mmap
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple


class Rehearsal(NamedTuple):
    """What compiles kernels.

    Attributes
    ----------
    kernels : tuple of str
        Their full names.
    run : callable
        Runs them, on next to nothing, with arguments of the types that they will have.
    """

    kernels: tuple[str, ...]
    run: Callable[[], object]


def is_kept(kernel: str) -> bool:
    """Whether a kernel was compiled once, for any types of arguments."""
    module, _, name = kernel.rpartition(".")
    function = getattr(importlib.import_module(module), name)
    folders = getattr(function._cache, "places", [function.stats.cache_path])
    return any(any(Path(one).glob(f"*.{name}-*.nbi")) for one in folders)


@contextmanager
def compiling_ahead(rehearsals: Sequence[Rehearsal], cores: int) -> Iterator[None]:
    """Let another process compile kernels, those that are not kept, while this one goes on."""
    global _team
    others = [one for one in threading.enumerate() if not one.daemon]
    may_fork = sys.platform == "linux" and others == [threading.current_thread()]
    if cores < 2 or not may_fork or _team is not None:
        yield
        return
    cold = [one for one in rehearsals if not all(map(is_kept, one.kernels))]
    _team = _Team(cold) if cold else None
    try:
        yield
    finally:
        if _team is not None:
            _team.part()
        _team = None


def wait_for(kernel: str) -> None:
    """Return when a kernel may be compiled by this process, or be loaded."""
    if _team is not None:
        _team.wait_for(kernel)


announce: list[Callable[[], object]] = []
"""Called once, and taken out, when this process begins to compile a kernel that is not kept."""


def compiles() -> None:
    """Say so; numba calls this by way of `pcfix.parts`."""
    while announce:
        announce.pop()()


FREE, HERE, THERE, DONE = range(4)
"""Who compiles."""


class _Team:
    """Two processes and what each is at, in memory that they share."""

    def __init__(self, rehearsals: Sequence[Rehearsal]) -> None:
        self._rehearsals = rehearsals
        self._place = {name: i for i, one in enumerate(rehearsals) for name in one.kernels}
        self._state = mmap.mmap(-1, len(rehearsals))
        self._other = os.fork()
        if self._other == 0:
            self._compile_all()

    def _compile_all(self) -> None:
        """Be the second process; it says nothing, and ends here whatever happens."""
        global _team
        try:
            _team = None
            announce.clear()  # another thread may hold the lock of the terminal
            nothing = os.open(os.devnull, os.O_WRONLY)
            for stream in (1, 2):
                os.dup2(nothing, stream)
            while self._take(THERE):
                pass
        finally:
            os._exit(0)

    def _take(self, who: int) -> bool:
        """Run the next rehearsal that nobody has; where it fails, the kernel's turn will come."""
        i = self._state[:].find(FREE)
        if i < 0:
            return False
        self._state[i] = who
        with suppress(Exception), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._rehearsals[i].run()
        self._state[i] = DONE
        return True

    def wait_for(self, kernel: str) -> None:
        i = self._place.get(kernel)
        if i is None:
            return
        if self._state[i] == FREE:
            self._state[i] = HERE
        while self._state[i] == THERE and self._other_runs():
            if not self._take(HERE):
                time.sleep(0.01)

    def _other_runs(self) -> bool:
        if self._other:
            with suppress(ChildProcessError):
                if os.waitpid(self._other, os.WNOHANG) == (0, 0):
                    return True
            self._other = 0
        return False

    def part(self) -> None:
        """End the other process."""
        if self._other_runs():
            os.kill(self._other, signal.SIGKILL)
            os.waitpid(self._other, 0)


_team: _Team | None = None

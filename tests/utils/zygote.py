"""Starts commands of pcfix at once: a process that has all loaded forks for each of them.

As a program: each line of stdin is the arguments of a command, as JSON; the process answers with
the number of the process that runs it, and once it has ended with how.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import traceback
from pathlib import Path

ENDING = (signal.SIGINT, signal.SIGTERM)


class Zygote:
    """The process; use it as a context manager.

    It runs the `first` commands itself, so that those that follow find all loaded. They must not
    use threads of libraries, which no process has that was forked: give them one job.
    """

    def __init__(self, log: Path, *first: list[str]) -> None:
        self._log, self._first = str(log), first

    @property
    def said(self) -> str:
        """What the last command wrote to stderr."""
        return Path(self._log).read_text()

    def __enter__(self) -> Zygote:
        words = [sys.executable, "-m", "tests.utils.zygote", json.dumps(self._first), self._log]
        self._process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        return self

    def __exit__(self, *exception: object) -> None:
        self._process.communicate()

    def start(self, arguments: list[str]) -> int:
        """Run a command, of which nothing is shown; return the number of its process."""
        self._process.stdin.write(json.dumps(arguments) + "\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def wait(self) -> int:
        """Return the exit code of the last command, the signal as a negative number."""
        return int(self._process.stdout.readline())


def _run(arguments: list[str]) -> None:
    from pcfix.cli import main

    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 0)
    os.dup2(nothing, 1)
    os.dup2(os.open(sys.argv[2], os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    code = 0
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
    except KeyboardInterrupt:
        os._exit(128 + signal.SIGINT)
    try:
        main(arguments)
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:  # a traceback is a defect
        traceback.print_exc()
        code = 99
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    gc.collect()  # as at the end of a process: what was cut off between two steps is closed
    os._exit(code)


def _serve() -> None:
    from pcfix.cli import main

    for arguments in json.loads(sys.argv[1]):
        main(arguments)
    gc.collect()
    gc.freeze()  # what is loaded is not searched again at the end of each child
    # a child is not stopped before it runs the command
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    for number in ENDING:
        ended = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, ended)
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            _run(json.loads(line))
        print(child, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    _serve()

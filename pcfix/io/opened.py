"""Which files are read, as Python itself tells: no reader has to say, and no list is kept."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

CODE = (".py", ".pyc", ".so", ".nbi", ".nbc")
_listening: list[set[str]] = []


@contextmanager
def files_opened() -> Iterator[set[str]]:
    """Give a set to which the paths of files that are opened to read, in any thread, are added."""
    _listen()
    names: set[str] = set()
    _listening.append(names)
    try:
        yield names
    finally:
        _listening.remove(names)


def of_inputs(names: Iterable[str], inputs: Iterable[Path], results: Path) -> list[Path]:
    """Return what was opened in the folders of inputs, or in folders of these, but results.

    Hidden files and programs are left out; paths are absolute, links followed.
    """
    own, roots = results.resolve(), {path.resolve().parent for path in inputs}
    found = []
    for path in sorted({Path(name).resolve() for name in names}):
        within = next((path.relative_to(one) for one in roots if path.is_relative_to(one)), None)
        is_data = within is not None and not any(part[0] == "." for part in within.parts)
        if is_data and path.suffix not in CODE and own not in path.parents and path.is_file():
            found.append(path)
    return found


@cache
def _listen() -> None:
    sys.addaudithook(_hear)


def _hear(event: str, arguments: tuple[Any, ...]) -> None:
    if event != "open" or not _listening or not isinstance(arguments[0], str):
        return
    if not arguments[2] & (os.O_WRONLY | os.O_RDWR):
        path = str(Path(arguments[0]).absolute())
        for names in tuple(_listening):
            names.add(path)

"""The input of every module of a camera format."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from pcfix.io.files import check_input

Angles = Literal["omega-phi-kappa", "yaw-pitch-roll", "aircraft"]

_HEAD_BYTES = 4096


@dataclass(frozen=True)
class Source:
    """A file or folder that may hold cameras, and what the user said about it.

    `sensor` is the ``--sensor`` file, `angles` the kind of angles of a table whose header does not
    say it.
    """

    path: Path
    sensor: Path | None = None
    angles: Angles | None = None

    @cached_property
    def head(self) -> bytes:
        """The first bytes of a file; nothing of a folder."""
        if self.path.is_dir():
            return b""
        with check_input(self.path).open("rb") as stream:
            return stream.read(_HEAD_BYTES)

    @cached_property
    def text(self) -> str:
        """The first bytes as text, without a byte order mark."""
        return self.head.decode("utf-8-sig", errors="replace")

    @cached_property
    def names(self) -> frozenset[str]:
        """Names of what lies in a folder; nothing for a file."""
        return frozenset(p.name for p in self.path.iterdir()) if self.path.is_dir() else frozenset()

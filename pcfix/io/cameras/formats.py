"""The input of every module of a camera format, and its entry in the table of formats."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple, Protocol, runtime_checkable

from pcfix.io.files import check_input
from pcfix.model import Cameras, TiePoints

Angles = Literal["omega-phi-kappa", "yaw-pitch-roll", "aircraft"]

_HEAD_BYTES = 4096


@dataclass(frozen=True)
class Source:
    """A file or folder that may hold cameras, and what the user said about it.

    Attributes
    ----------
    path : Path
    sensor : Path or None
        The ``--sensor`` file.
    angles : Angles or None
        Which angles a table has, where its header cannot say.
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


class Reader(Protocol):
    """A module of this folder.

    `read_cameras` turns what damaged contents raise into an `InputError`, and checks the rotations
    and lenses. A reader itself raises an `InputError` where it can say more than "damaged".
    """

    def recognises(self, source: Source) -> bool:
        """Whether the content is of this format; cheap."""
        ...

    def read(self, source: Source) -> Cameras:
        """Read poses and lenses, in the frame of the file."""
        ...


@runtime_checkable
class SparseReader(Reader, Protocol):
    """One whose format has tie points too."""

    def tie_points(self, source: Source, cameras: Cameras) -> TiePoints:
        """Read points and observations; `cameras` is what `read` gave for the same source."""
        ...


class CameraFormat(NamedTuple):
    """An entry of the table of formats.

    software : str
        Whose it is, for messages and the documentation.
    give : str
        What to give ``--cameras``, for the documentation; empty where it says nothing.
    reader : Reader
    """

    software: str
    give: str
    reader: Reader

"""The zip archives of a project, read without trusting what their directories say."""

from __future__ import annotations

import io
import lzma
import struct
import zipfile
import zlib
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pcfix.errors import InputError
from pcfix.io.cameras.xml import read_xml

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from xml.etree.ElementTree import Element

MOST_BYTES = 2**30
MOST_RATIO = 200
"""Documents shrink to a tenth, points hardly; an archive made to burst a thousandfold."""
FREE_BYTES = 2**24
"""Below this the ratio is not asked for."""

DAMAGES = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error),
    *(EOFError, OSError, RuntimeError, ValueError),
)


class Archive:
    """An open zip; `path` is for messages."""

    def __init__(self, path: Path, opened: zipfile.ZipFile) -> None:
        self.path = path
        self._zip = opened
        self._names = frozenset(opened.namelist())

    def __contains__(self, name: str) -> bool:
        return name in self._names

    def read(self, name: str) -> bytes:
        """Return the content of an entry.

        Raises
        ------
        InputError
            If it is not there, damaged, or absurdly large.
        """
        if name not in self._names:
            raise InputError(
                f"{self.path}: has no {name}; the project is incomplete, save it again."
            )
        entry = self._zip.getinfo(name)
        if entry.file_size > min(MOST_BYTES, FREE_BYTES + MOST_RATIO * entry.compress_size):
            raise InputError(
                f"{self.path}: {name} would unpack to {entry.file_size / 1e6:.0f} MB from"
                f" {entry.compress_size / 1e6:.3f} MB, which no project does; it is not read."
            )
        with _damage(self.path):
            return self._zip.read(name)

    def document(self) -> Element:
        """Return the root of the document that every archive of a project has."""
        return read_xml(self.path, io.BytesIO(self.read("doc.xml")))


@contextmanager
def opened(path: Path) -> Iterator[Archive]:
    """Open an archive.

    Raises
    ------
    InputError
        If it is missing or not a zip.
    """
    if not path.is_file():
        raise InputError(f"{path}: is missing; keep all files of the project together.")
    with _damage(path):
        archive = zipfile.ZipFile(path)
    with archive:
        yield Archive(path, archive)


def head_of_document(path: Path, count: int) -> bytes:
    """Return the first bytes of ``doc.xml`` of a zip, or nothing where there is none."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open("doc.xml") as stream:
            return stream.read(count)
    except (*DAMAGES, KeyError):
        return b""


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    try:
        yield
    except DAMAGES as error:
        raise InputError(
            f"{path}: the archive is damaged or cut off ({error}); save the project again."
        ) from error

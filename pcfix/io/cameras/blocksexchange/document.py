"""The document itself: plain or in a zip archive, and its spatial reference systems."""

from __future__ import annotations

import io
import re
import zipfile
import zlib
from typing import TYPE_CHECKING, NamedTuple

from pcfix.errors import InputError
from pcfix.io.cameras import checks
from pcfix.io.cameras.xml import read_xml

if TYPE_CHECKING:
    from pathlib import Path
    from xml.etree.ElementTree import Element

    from pcfix.io.cameras.formats import Source

COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
TIE_POINTS = re.compile(rb"<TiePoints>(.*?)</TiePoints>", re.DOTALL)
LARGEST_RATIO = 200
"""Of an archive: XML packs 10 to 30 times smaller, a bomb a thousand times."""


def is_archive_of_block(source: Source) -> bool:
    """Whether a file is a zip archive with a BlocksExchange document; never an error."""
    if not source.head.startswith(b"PK\x03\x04"):
        return False
    try:
        with zipfile.ZipFile(source.path) as archive:
            stream = archive.open(_document_name(source.path, archive))
            return b"<BlocksExchange" in stream.read(4096)
    except (InputError, OSError, zipfile.BadZipFile, zlib.error, RuntimeError, ValueError):
        return False


class TieText(NamedTuple):
    """The inside of an element TiePoints, and the number of its block."""

    block: int
    text: bytes


def read_document(path: Path) -> tuple[Element, list[TieText]]:
    """Return the root element without its tie points, and those as text.

    There can be millions of measurements, which a tree of elements would take minutes for.
    """
    data = read_bytes(path)
    found = [
        TieText(data.count(b"<Block>", 0, match.start()) - 1, match[1])
        for match in TIE_POINTS.finditer(data)
    ]
    return read_xml(path, io.BytesIO(TIE_POINTS.sub(b"", data))), found


def read_bytes(path: Path) -> bytes:
    """Return a file, or the XML document in a zip archive, without comments."""
    return COMMENT.sub(b"", _unpacked(path))


def _unpacked(path: Path) -> bytes:
    with path.open("rb") as stream:
        packed = stream.read(4) == b"PK\x03\x04"
    if not packed:
        return path.read_bytes()
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.read(_document_name(path, archive))
    except (OSError, zipfile.BadZipFile, zlib.error, RuntimeError, ValueError) as error:
        raise InputError(f"{path}: the archive is damaged ({error}); export it again.") from error


def _document_name(path: Path, archive: zipfile.ZipFile) -> str:
    for entry in archive.infolist():
        if entry.filename.lower().endswith(".xml"):
            if entry.file_size > LARGEST_RATIO * (entry.compress_size + 1):
                raise InputError(f"{path}: the archive unpacks to far too much; it is not read.")
            return entry.filename
    raise InputError(f"{path}: the archive has no XML document.")


class ReferenceSystems:
    """The spatial reference systems of a document by their ids."""

    def __init__(self, path: Path, root: Element) -> None:
        self._path = path
        self._definitions = {_text(srs, "Id"): _text(srs, "Definition") for srs in root.iter("SRS")}

    def of(self, srs_id: str) -> str:
        """Return the CRS of an id as `Cameras` has it; without an id the frame is local.

        Raises
        ------
        InputError
            If there is no such id, or its definition is not understood.
        """
        if not srs_id:
            return "local"
        if srs_id not in self._definitions:
            raise InputError(
                f"{self._path}: there is no spatial reference system with the id {srs_id}; export"
                " the block again."
            )
        definition = self._definitions[srs_id]
        if definition.upper().startswith("ENU:"):
            return self._local_frame(definition)
        return checks.crs(self._path, definition)

    def _local_frame(self, definition: str) -> str:
        """Return ENU:latitude,longitude,height; the height is 0 where none is given."""
        words = definition[4:].split(",")
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            numbers = []
        if len(numbers) not in (2, 3) or not abs(numbers[0]) <= 90 or not abs(numbers[1]) <= 360:
            raise InputError(
                f"{self._path}: '{definition[:80]}' is not ENU:latitude,longitude in degrees."
            )
        return "ENU:" + ",".join(word.strip() for word in [*words, "0"][:3])


def _text(element: Element, name: str) -> str:
    return (element.findtext(name) or "").strip()

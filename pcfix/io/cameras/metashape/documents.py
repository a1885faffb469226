"""From what the user named to the one chunk that is read.

The zip archives of a project are read without trusting what their directories say.
"""

from __future__ import annotations

import io
import lzma
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

from pcfix.errors import InputError
from pcfix.io.cameras.checks import read_xml
from pcfix.io.cameras.formats import Source

ZIP_MAGIC = b"PK\x03\x04"
ROOT = re.compile(r"\s*(?:<\?.*?\?>\s*|<!--.*?-->\s*)*<(\w+)", re.DOTALL)
OF_CHUNKS = re.compile(r"<chunks?\b|\bpath=")
INSIDE = {
    "document": OF_CHUNKS,
    "collection": OF_CHUNKS,  # read as a document: no file of such a PhotoScan was at hand
    "chunk": re.compile(r"<sensors\b"),
}


@dataclass(frozen=True)
class Document:
    """An element, and the file or archive it stands in."""

    root: Element
    path: Path

    def follow(self, element: Element) -> Document:
        """Return what an element stands for: itself, or the document its path leads to."""
        relative = element.get("path")
        if relative is None:
            return Document(element, self.path)
        return _from_archive(self._file(relative))

    def leads_to_a_file(self, element: Element) -> bool:
        """Whether what an element stands for is there: in the same document, or as a file."""
        relative = element.get("path")
        return relative is None or self._file(relative).is_file()

    def _file(self, relative: str) -> Path:
        return self.path.parent / relative.replace("\\", "/")


class Chunk(NamedTuple):
    """The chunk that is read; `path` is what the user named, for messages."""

    path: Path
    document: Document
    software: str
    notes: tuple[str, ...]

    @property
    def element(self) -> Element:
        """The ``chunk`` element."""
        return self.document.root


def recognises(source: Source) -> bool:
    """Whether the content is a project, a chunk, or an archive of one."""
    if source.path.is_dir():
        return "project.zip" in source.names
    text = source.text
    if source.head.startswith(ZIP_MAGIC):
        try:
            with zipfile.ZipFile(source.path) as archive, archive.open("doc.xml") as stream:
                text = stream.read(len(source.head)).decode("utf-8", errors="replace")
        except (*DAMAGES, KeyError):
            return False
    root = ROOT.match(text)
    inside = INSIDE.get(root[1]) if root else None
    return bool(root and inside and inside.search(text, root.end()))


def open_chunk(path: Path) -> Chunk:
    """Return the active chunk, or the first that has aligned images where that one has none."""
    top = _top(path)
    if top.root.tag == "chunk":
        return Chunk(path, top, _software(top.root, top.root), ())
    candidates = top.root.findall("chunk") or top.root.findall("chunks/chunk")
    if not candidates:
        raise InputError(f"{path}: has no chunk; save the project again with its chunks.")
    chunks = top.root.find("chunks")
    active = None if chunks is None else chunks.get("active_id")
    candidates.sort(key=lambda chunk: chunk.get("id") != active)
    chosen, *others = _with_poses(top, candidates)
    name, *names = (each.root.get("label") or "without a name" for each in (chosen, *others))
    note = (
        f"{path}: {len(others) + 1} chunks have aligned images; read is {name}, not"
        f" {', '.join(names[:10])}{', ...' if len(names) > 10 else ''}: make another chunk the"
        " active one, or export its cameras, to read that."
    )
    return Chunk(path, chosen, _software(chosen.root, top.root), (note,) if others else ())


def _top(path: Path) -> Document:
    """Return the outermost document; that of a .psx lies in the folder beside it."""
    if path.is_dir():
        return _from_archive(path / "project.zip")
    with path.open("rb") as stream:
        if stream.read(len(ZIP_MAGIC)) == ZIP_MAGIC:
            return _from_archive(path)
    root = read_xml(path)
    inside = root.get("path")
    if root.tag == "document" and inside is not None:
        archive = Path(inside.replace("{projectname}", path.stem))
        if archive.is_absolute():
            raise InputError(f"{path}: its path '{inside}' leads out of its folder; mend it.")
        return _from_archive(path.parent / archive)
    return Document(root, path)


def _from_archive(path: Path) -> Document:
    with opened(path) as archive:
        return Document(read_xml(path, io.BytesIO(read_entry(archive, "doc.xml"))), path)


def _with_poses(top: Document, candidates: list[Element]) -> list[Document]:
    """Return the chunks with poses, or the first where none has some."""
    posed: list[Document] = []
    empty: list[Document] = []
    missing: list[InputError] = []
    for candidate in candidates:
        try:
            chunk = top.follow(candidate)
        except InputError as error:
            missing.append(error)
            continue
        cameras = chunk.root.iterfind("cameras//camera")
        (posed if any(c.find("transform") is not None for c in cameras) else empty).append(chunk)
    if not posed and missing:
        raise missing[0]
    return posed or empty[:1]


def _software(chunk: Element, top: Element) -> str:
    """Return program and version, or that of the document where the file names no program."""
    entries = (*top.iterfind("meta/property"), *chunk.iterfind("meta/property"))
    about = {entry.get("name"): entry.get("value", "") for entry in entries}
    version = about.get("Info/LastSavedSoftwareVersion")
    version = version or about.get("Info/OriginalSoftwareVersion")
    if version:
        return f"{about.get('Info/OriginalSoftwareName') or 'Agisoft Metashape'} {version}"
    document = top.get("version") or chunk.get("version")
    return f"Agisoft Metashape, document {document}" if document else "Agisoft Metashape"


MOST_BYTES = 2**30
MOST_RATIO = 200
"""Documents shrink to a tenth, points hardly; an archive made to burst a thousandfold."""
FREE_BYTES = 2**24
"""Below this the ratio is not asked for."""

DAMAGES = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error),
    *(EOFError, OSError, RuntimeError, ValueError),
)


@contextmanager
def opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive."""
    with _damage(path):  # a name may be longer than the system allows
        is_there = path.is_file()
    if not is_there:
        raise InputError(f"{path}: is missing; keep all files of the project together.")
    with _damage(path):
        archive = zipfile.ZipFile(path)
    with archive:
        yield archive


def read_entry(archive: zipfile.ZipFile, name: str) -> bytes:
    """Return the content of an entry, unless it is made to burst."""
    path = archive.filename
    if name not in archive.NameToInfo:
        raise InputError(f"{path}: has no {name}; the project is incomplete, save it again.")
    entry = archive.getinfo(name)
    if entry.file_size > min(MOST_BYTES, FREE_BYTES + MOST_RATIO * entry.compress_size):
        raise InputError(
            f"{path}: {name} would unpack to {entry.file_size / 1e6:.0f} MB from"
            f" {entry.compress_size / 1e6:.3f} MB, which no project does; it is not read."
        )
    with _damage(path):
        return archive.read(name)


@contextmanager
def _damage(path: Path | str | None) -> Iterator[None]:
    try:
        yield
    except DAMAGES as error:
        raise InputError(
            f"{path}: the archive is damaged or cut off ({error}); save the project again."
        ) from error

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
INSIDE = {"document": re.compile(r"<chunks?\b|\bpath="), "chunk": re.compile(r"<sensors\b")}


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
        text = head_of_document(source.path, len(source.head)).decode("utf-8", errors="replace")
    root = ROOT.match(text)
    return (
        root is not None
        and root[1] in INSIDE
        and INSIDE[root[1]].search(text, root.end()) is not None
    )


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
    chosen, others = _choose(top, candidates)
    return Chunk(path, chosen, _software(chosen.root, top.root), _chunk_notes(path, chosen, others))


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
        return _from_archive(path.parent / inside.replace("{projectname}", path.stem))
    return Document(root, path)


def _from_archive(path: Path) -> Document:
    with opened(path) as archive:
        return Document(archive.document(), path)


def _choose(top: Document, candidates: list[Element]) -> tuple[Document, list[str]]:
    """Return the first chunk with poses, and the labels of the others that have some."""
    posed: list[Document] = []
    empty: list[Document] = []
    missing: list[InputError] = []
    for candidate in candidates:
        try:
            chunk = top.follow(candidate)
        except InputError as error:
            missing.append(error)
            continue
        has_poses = any(
            c.find("transform") is not None for c in chunk.root.iterfind("cameras//camera")
        )
        (posed if has_poses else empty).append(chunk)
    if not posed and missing:
        raise missing[0]
    first, *others = posed or empty[:1]
    return first, [_label(other.root) for other in others]


def _label(chunk: Element) -> str:
    return chunk.get("label") or "without a name"


def _chunk_notes(path: Path, chosen: Document, others: list[str]) -> tuple[str, ...]:
    if not others:
        return ()
    return (
        f"{path}: {len(others) + 1} chunks have aligned images; read is {_label(chosen.root)}, not"
        f" {', '.join(others[:10])}{', ...' if len(others) > 10 else ''}: make another chunk the"
        " active one, or export its cameras, to read that.",
    )


def _software(chunk: Element, top: Element) -> str:
    """Return program and version, or that of the document where the file names no program."""
    about = {
        entry.get("name"): entry.get("value", "")
        for element in (top, chunk)
        for entry in element.iterfind("meta/property")
    }
    version = about.get("Info/LastSavedSoftwareVersion") or about.get(
        "Info/OriginalSoftwareVersion"
    )
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


class Archive:
    """An open zip; `path` is for messages."""

    def __init__(self, path: Path, opened: zipfile.ZipFile) -> None:
        self.path = path
        self._zip = opened
        self._names = frozenset(opened.namelist())

    def __contains__(self, name: str) -> bool:
        return name in self._names

    def read(self, name: str) -> bytes:
        """Return the content of an entry."""
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
    """Open an archive."""
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

"""From what the user named to the one chunk that is read."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pcfix.errors import InputError
from pcfix.io.cameras.metashape.archives import head_of_document, opened
from pcfix.io.cameras.xml import read_xml

if TYPE_CHECKING:
    from pathlib import Path
    from xml.etree.ElementTree import Element

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


@dataclass(frozen=True)
class Chunk:
    """The chunk that is read.

    Attributes
    ----------
    path : Path
        What the user named, for messages.
    document : Document
    software : str
    notes : tuple of str
    """

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
    """Return the active chunk, or the first that has aligned images where that one has none.

    Raises
    ------
    InputError
        If a document is missing or damaged, or there is no chunk.
    """
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
    return Chunk(path, chosen, _software(chosen.root, top.root), _told(path, chosen, others))


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
        (posed if _has_poses(chunk.root) else empty).append(chunk)
    if not posed and missing:
        raise missing[0]
    first, *others = posed or empty[:1]
    return first, [_label(other.root) for other in others]


def _has_poses(chunk: Element) -> bool:
    return any(camera.find("transform") is not None for camera in chunk.iterfind("cameras//camera"))


def _label(chunk: Element) -> str:
    return chunk.get("label") or "without a name"


def _told(path: Path, chosen: Document, others: list[str]) -> tuple[str, ...]:
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

"""Find the chunk to read in a project or an exported document."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

from pcfix.errors import InputError, PcfixWarning
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import ZIP_MAGIC, Source, damaged, note, number, read_xml

ROOT = re.compile(r"\s*(?:<\?.*?\?>\s*|<!--.*?-->\s*)*<(\w+)", re.DOTALL)
OF_CHUNKS = re.compile(r"<chunks?\b|\bpath=")
INSIDE = {"document": OF_CHUNKS, "collection": OF_CHUNKS, "chunk": re.compile(r"<sensors\b")}


@dataclass(frozen=True)
class Document:
    """An element, and the file or archive that contains it."""

    root: Element
    path: Path

    def follow(self, element: Element) -> Document:
        """Return the document that an element refers to by its path, or the element itself."""
        path = self.leads_to(element)
        return Document(element, self.path) if path is None else read_entry(path)

    def leads_to(self, element: Element) -> Path | None:
        """Return the file that an element refers to; None if it has no path."""
        relative = element.get("path")
        return None if relative is None else self.path.parent / relative.replace("\\", "/")


class Chunk(NamedTuple):
    """The chunk that is read; `path` is what the user named, for messages."""

    path: Path
    document: Document
    software: str
    notes: tuple[PcfixWarning, ...]

    @property
    def element(self) -> Element:
        """The ``chunk`` element."""
        return self.document.root

    @property
    def settings(self) -> dict[str, str]:
        """The settings of the chunk by their names."""
        entries = self.element.iterfind("settings/property")
        return {entry.get("name") or "": entry.get("value") or "" for entry in entries}

    @property
    def frame(self) -> Document | None:
        """The first frame, which has the images of every marker and the tie points."""
        first = self.element.find("frames/frame")
        return None if first is None else self.document.follow(first)


def recognises(source: Source) -> bool:
    """Whether the content is a project, a chunk, or an archive of one."""
    if source.path.is_dir():
        return "project.zip" in source.names
    text = source.text
    if source.head.startswith(ZIP_MAGIC):
        try:
            with zipfile.ZipFile(source.path) as archive, archive.open("doc.xml") as stream:
                text = stream.read(len(source.head)).decode("utf-8", errors="replace")
        except checks.DAMAGES:
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
    chunks = top.root.find("chunks")
    active = None if chunks is None else chunks.get("active_id")
    candidates.sort(key=lambda chunk: chunk.get("id") != active)
    found, lost = [], []
    for candidate in candidates:
        try:
            found.append(top.follow(candidate))
        except InputError as error:
            lost.append(error)
    posed = [one for one in found if one.root.find("cameras//camera/transform") is not None]
    if not posed and lost:
        raise lost[0]
    if not found:
        raise checks.no_pose(path, "has no chunk")
    chosen, *others = posed or found[:1]
    names = [each.root.get("label") or "without a name" for each in (chosen, *others)]
    sentence = f"several chunks have aligned images; {names[0]} is read. Activate another for that."
    said = note(path, "cameras.several_chunks", sentence, chunk=names[0], others=names[1:])
    return Chunk(path, chosen, _software(chosen.root, top.root), (said,) if others else ())


def measured_marks(frame: Document) -> Iterator[tuple[str, str, tuple[float, float]]]:
    """Yield marker, camera and image coordinates of what was measured, not computed."""
    for marker in frame.root.iterfind("markers//marker"):
        for mark in marker.iterfind("location"):
            if "false" not in (mark.get("pinned"), mark.get("valid")):
                name, camera = marker.get("marker_id") or "", mark.get("camera_id") or ""
                where = f"marker {name}, camera {camera}"
                u, v = (number(frame.path, where, mark.get(axis)) for axis in "xy")
                yield name, camera, (u, v)


def _top(path: Path) -> Document:
    """Return the outermost document; that of a .psx is in the folder beside it."""
    if path.is_dir():
        return read_entry(path / "project.zip")
    with path.open("rb") as stream:
        if stream.read(len(ZIP_MAGIC)) == ZIP_MAGIC:
            return read_entry(path)
    root = read_xml(path)
    inside = root.get("path")
    if root.tag == "document" and inside is not None:
        archive = Path(inside.replace("{projectname}", path.stem))
        if archive.is_absolute():
            raise damaged(path, f"its path '{inside}' leads out of its folder")
        return read_entry(path.parent / archive)
    return Document(root, path)


def _software(chunk: Element, top: Element) -> str:
    """Return program and version, or that of the document where the file names no program."""
    entries = (*top.iterfind("meta/property"), *chunk.iterfind("meta/property"))
    about = {entry.get("name"): entry.get("value", "") for entry in entries}
    last, first = (about.get(f"Info/{one}SoftwareVersion") for one in ("LastSaved", "Original"))
    if last or first:
        return f"{about.get('Info/OriginalSoftwareName') or 'Agisoft Metashape'} {last or first}"
    document = top.get("version") or chunk.get("version")
    return f"Agisoft Metashape, document {document}" if document else "Agisoft Metashape"


def read_entry(path: Path) -> Document:
    """Return the document in an archive."""
    with checks.open_archive(path) as archive:
        return Document(read_xml(path, io.BytesIO(checks.unpacked(archive, "doc.xml"))), path)

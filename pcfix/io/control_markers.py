"""The markers of a Metashape project or of its *Export Markers*, as marks of surveyed points.

A ``marker`` of the chunk has a label and a ``reference``: x, y, z in ``marker_reference`` (else in
the ``reference`` of the chunk) and, where stated, accuracies sxyz, or sxy, or sx, sy, sz; for the
others the chunk's settings ``accuracy_markers`` (m) and ``accuracy_projections`` (px) hold. A
reference that is unticked (``enabled="false"``) makes a check point. The first frame has where the
images show each marker, in pixels from the upper left corner; a ``location`` that is not pinned was
computed by Metashape and is no measurement.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.metashape import documents
from pcfix.io.cameras.metashape.positions import SPREADS
from pcfix.io.cameras.xml import number, numbers
from pcfix.io.control_marks import Marks
from pcfix.io.crs import is_local, parse_crs

if TYPE_CHECKING:
    from pathlib import Path
    from xml.etree.ElementTree import Element

    from pcfix.io.cameras.metashape.documents import Chunk
    from pcfix.model import FloatArray

LOCAL = "local"


def has_markers(path: Path) -> bool:
    """Whether a file is a document or project of Metashape."""
    return documents.recognises(Source(path))


def read_markers(path: Path) -> Marks:
    """Read the markers that have a surveyed place and were measured.

    Raises
    ------
    InputError
        If there are none, or a number cannot be right.
    """
    chunk = documents.open_chunk(path)
    surveyed = {
        marker.get("id") or "": marker
        for marker in chunk.element.iterfind("markers//marker")
        if _has_place(marker)
    }
    marks = [mark for mark in _locations(chunk) if mark[0] in surveyed]
    if not marks:
        raise InputError(
            f"{path}: has no marker with surveyed coordinates that was measured in an image; give"
            " the project, or export the markers."
        )
    of = [surveyed[marker] for marker, _, _ in marks]
    references = [_reference(marker) for marker in of]
    image = _images(chunk)
    default = _setting(chunk, "accuracy_markers")
    return Marks(
        path=path,
        point=[_label(marker) for marker in of],
        image=[image.get(camera, f"camera {camera}") for _, camera, _ in marks],
        xyz=np.array([_xyz(path, marker) for marker in of]),
        sigma_m=np.array([_sigma(path, marker, default) for marker in of]),
        uv=np.array([uv for _, _, uv in marks]),
        sigma_px=np.full(len(marks), _setting(chunk, "accuracy_projections")),
        is_check=np.array([each.get("enabled") in ("false", "0") for each in references]),
        under_water=np.zeros(len(marks), bool),
        where=[f"marker {_label(marker)}" for marker in of],
        crs=_crs(chunk),
    )


def _has_place(marker: Element) -> bool:
    reference = marker.find("reference")
    return reference is not None and all(reference.get(axis) for axis in "xyz")


def _reference(marker: Element) -> Element:
    found = marker.find("reference")
    return marker if found is None else found


def _label(marker: Element) -> str:
    return marker.get("label") or f"number {marker.get('id')}"


def _images(chunk: Chunk) -> dict[str, str]:
    """Return the labels of images by their numbers in the document."""
    cameras = chunk.element.iterfind("cameras//camera")
    return {
        number_: camera.get("label") or f"number {number_}"
        for camera in cameras
        if (number_ := camera.get("id")) is not None
    }


def _locations(chunk: Chunk) -> list[tuple[str, str, tuple[float, float]]]:
    """Return marker, camera and place of every measured location of the first frame."""
    first = chunk.element.find("frames/frame")
    if first is None:
        return []
    frame = chunk.document.follow(first)
    found = []
    for marker in frame.root.iterfind("markers//marker"):
        name = marker.get("marker_id") or ""
        for mark in marker.iterfind("location"):
            if mark.get("pinned") == "false" or mark.get("valid") == "false":
                continue
            camera = mark.get("camera_id") or ""
            where = f"marker {name}, camera {camera}"
            u, v = (number(frame.path, where, mark.get(axis)) for axis in "xy")
            found.append((name, camera, (u, v)))
    return found


def _xyz(path: Path, marker: Element) -> list[float]:
    where = f"marker {_label(marker)}, reference"
    return [number(path, where, _reference(marker).get(axis)) for axis in "xyz"]


def _sigma(path: Path, marker: Element, default: float) -> FloatArray:
    """Return the stated standard deviations, from the widest statement to the narrowest."""
    sigma = np.full(3, default)
    for name, axes in SPREADS:
        if text := _reference(marker).get(name):
            count = 1 if len(text.split()) == 1 else len(axes)
            where = f"marker {_label(marker)}, {name}"
            sigma[list(axes)] = numbers(path, where, text, count)
    return np.where(sigma > 0.0, sigma, np.nan)


def _setting(chunk: Chunk, name: str) -> float:
    """Return a positive number of the chunk's settings, NaN where it is not there."""
    for entry in chunk.element.iterfind("settings/property"):
        if entry.get("name") == name:
            value = number(chunk.path, f"setting {name}", entry.get("value"))
            return value if value > 0.0 else np.nan
    return np.nan


def _crs(chunk: Chunk) -> str:
    own = (chunk.element.findtext("marker_reference") or "").strip()
    text = own or (chunk.element.findtext("reference") or "").strip() or LOCAL
    if text.lower() == LOCAL or is_local(parse_crs(text, str(chunk.path))):
        return LOCAL
    return text

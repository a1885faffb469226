"""Tie points and markers, and where the images saw them.

Convention. The tie points of a frame are PLY files in one archive: ``points`` has x, y, z in the
frame of the component and the id of the track, ``projections`` of each camera have x and y in
pixels from the corner of the image and the id of the track. A project of one file has them beside
its document. Markers stand in the document of the frame, as ``location`` with x and y; only the
pinned ones were measured, the others Metashape computed from the poses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.metashape.archives import opened
from pcfix.io.cameras.metashape.ply import read_vertices
from pcfix.io.cameras.xml import number
from pcfix.model import TiePoints, Views

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from pcfix.io.cameras.metashape.archives import Archive
    from pcfix.io.cameras.metashape.block import Block
    from pcfix.io.cameras.metashape.documents import Chunk, Document
    from pcfix.model import FloatArray, IntArray

POINTS = ("x", "y", "z", "id")
PROJECTIONS = ("x", "y", "id")


class Seen(NamedTuple):
    """Points, and observations of them, camera by camera: row of both, u and v."""

    xyz: FloatArray
    point: IntArray
    camera: IntArray
    uv: FloatArray


NOTHING = Seen(np.empty((0, 3)), np.empty(0, int), np.empty(0, int), np.empty((0, 2)))


def read(chunk: Chunk, block: Block, count: int) -> TiePoints:
    """Read what the first frame of a chunk has; see `pcfix.io.cameras.metashape.tie_points`."""
    if len(block.images) != count:
        raise InputError(
            f"{chunk.path}: has {len(block.images)} aligned images, but the cameras are {count};"
            " read the cameras from the same file."
        )
    frames = chunk.element.find("frames/frame")
    seen = NOTHING
    if frames is not None:
        frame = chunk.document.follow(frames)
        seen = _joined(_tie_points(frame, block), _markers(frame, block))
    if not len(seen.point):
        raise InputError(
            f"{chunk.path}: has neither tie points nor markers that were measured in aligned"
            " images; give the project (.psx with its .files folder), or export the markers."
        )
    order = np.argsort(seen.point, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(seen.point, minlength=len(seen.xyz)))])
    return TiePoints(seen.xyz, Views(start, seen.camera[order]), seen.uv[order])


def _joined(one: Seen, other: Seen) -> Seen:
    return Seen(
        np.vstack([one.xyz, other.xyz]),
        np.concatenate([one.point, other.point + len(one.xyz)]),
        np.concatenate([one.camera, other.camera]),
        np.vstack([one.uv, other.uv]),
    )


def _tie_points(frame: Document, block: Block) -> Seen:
    """Return the points of every component that has a place; their archive may be left out."""
    for element in (*frame.root.iterfind("point_cloud"), *frame.root.iterfind("tie_points")):
        if not frame.leads_to_a_file(element):
            continue
        document = frame.follow(element)
        if document.root.find("projections") is not None:
            with opened(document.path) as archive:
                return _from_archive(archive, document.root, block)
    return NOTHING


def _from_archive(archive: Archive, root: Element, block: Block) -> Seen:
    files = {p.get("camera_id") or "": p.get("path") or "" for p in root.iterfind("projections")}
    seen = NOTHING
    for points in root.iterfind("points"):
        component = points.get("component_id")
        rows = [
            i
            for i, image in enumerate(block.images)
            if image.id in files
            and (component == image.component or None in (component, image.component))
        ]
        if rows:
            seen = _joined(seen, _component(archive, points.get("path") or "", rows, files, block))
    return seen


def _component(
    archive: Archive, points: str, rows: list[int], files: dict[str, str], block: Block
) -> Seen:
    """Return the points of one component and where the images in `rows` saw them."""
    vertices = _vertices(archive, points, POINTS)
    xyz = block.places[rows[0]].points(
        np.column_stack([vertices[axis] for axis in "xyz"]).astype(np.float64)
    )
    order = np.argsort(vertices["id"], kind="stable")
    ids = vertices["id"][order].astype(np.int64)
    point, camera, uv = [], [], []
    for row in rows:
        marks = _vertices(archive, files[block.images[row].id], PROJECTIONS)
        found = np.minimum(np.searchsorted(ids, marks["id"].astype(np.int64)), max(len(ids) - 1, 0))
        known = (ids[found] == marks["id"]) if len(ids) else np.zeros(len(marks), bool)
        point.append(order[found[known]])
        camera.append(np.full(int(known.sum()), row))
        uv.append(np.column_stack([marks["x"], marks["y"]])[known].astype(np.float64))
    return Seen(xyz, np.concatenate(point), np.concatenate(camera), np.concatenate(uv))


def _vertices(archive: Archive, name: str, needed: tuple[str, ...]) -> np.ndarray:
    vertices = read_vertices(f"{archive.path}: {name}", archive.read(name), needed)
    if vertices["id"].dtype.kind not in "iu":
        raise InputError(f"{archive.path}: the id of {name} is not a whole number.")
    return vertices


def _markers(frame: Document, block: Block) -> Seen:
    """Return the markers that were measured; they have no position."""
    row_of = {image.id: i for i, image in enumerate(block.images)}
    point, camera, uv = [], [], []
    count = 0
    for marker in frame.root.iterfind("markers//marker"):
        marks = [
            m
            for m in marker.iterfind("location")
            if _is_measured(m) and m.get("camera_id") in row_of
        ]
        for mark in marks:
            where = f"marker {marker.get('marker_id')}, camera {mark.get('camera_id')}"
            point.append(count)
            camera.append(row_of[mark.get("camera_id") or ""])
            uv.append([number(frame.path, where, mark.get(axis)) for axis in "xy"])
        count += bool(marks)
    return Seen(
        np.full((count, 3), np.nan),
        np.array(point, dtype=np.int64),
        np.array(camera, dtype=np.int64),
        np.array(uv, dtype=np.float64).reshape(-1, 2),
    )


def _is_measured(location: Element) -> bool:
    return location.get("pinned") != "false" and location.get("valid") != "false"

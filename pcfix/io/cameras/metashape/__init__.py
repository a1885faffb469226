"""Agisoft Metashape and PhotoScan: exported cameras or markers, and whole projects.

Read are the XML of *Export Cameras* and *Export Markers*, projects of one file (.psz, a zip) and
projects with a folder (.psx, whose documents lie in zips in ``<name>.files``).

Convention. ``camera/transform`` is a 4x4 matrix from the camera (x right, y down, z forward) to the
chunk, whose origin, axes and scale mean nothing. The ``transform`` of the camera's component, or of
the chunk, leads on to the world as s R X + t. With a CRS in ``reference`` the world is geocentric,
on the datum of that CRS, whatever its kind; heights there are ellipsoidal, and only the export to
that CRS brings a geoid in. With ``LOCAL_CS``, or no transform, the world is local. The image of a
slave camera (``master_id``) has the pose T_master [R, t], with the rotation and location of its
sensor in the master's frame, t in the unit of the chunk. EXIF orientations turn only what is
displayed: matrices and pixels are those of the image as stored.

The tie points of a frame are PLY files in one archive: ``points`` has x, y, z in the frame of the
component and the id of the track, ``projections`` of each camera have x and y in pixels from the
corner of the image and the id of the track. A project of one file has them beside its document.
Markers stand in the document of the frame, as ``location`` with x and y; only the pinned ones were
measured, the others Metashape computed from the poses. Where the GNSS put the cameras is their
``reference``, in the CRS of the cameras or of the chunk. The formulas of a calibration stand in
`sensors`.

References: "Agisoft Metashape User Manual, Professional Edition", appendix "Camera models";
"Metashape Python Reference", Chunk.transform, Sensor.location, CoordinateSystem.geoccs;
``save_estimated_reference.py`` in github.com/agisoft-llc/metashape-scripts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias
from xml.etree.ElementTree import Element
from zipfile import ZipFile

import numpy as np

from pcfix.errors import PcfixWarning
from pcfix.io.cameras.checks import damaged, number, numbers, reading
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.metashape import documents
from pcfix.io.cameras.metashape.block import Block, read_block
from pcfix.io.cameras.metashape.documents import Chunk, Document, open_archive, recognises, unpacked
from pcfix.io.cameras.metashape.sensors import read_calibration
from pcfix.io.cameras.tracks import Seen, no_tie_points
from pcfix.io.cameras.tracks import tie_points as gathered
from pcfix.io.crs import is_local, parse_crs
from pcfix.io.ply import parse_header
from pcfix.model import Cameras, FloatArray, GnssPositions, TiePoints

__all__ = ["read", "read_calibration", "recognises", "tie_points"]


def read(source: Source) -> Cameras:
    """Read the aligned images of a chunk: geocentric, or in a ``local`` frame."""
    chunk = documents.open_chunk(source.path)
    block = read_block(chunk)
    gnss, notes = gnss_positions(chunk, block)
    return replace(block.cameras, gnss=gnss, notes=(*chunk.notes, *block.cameras.notes, *notes))


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tie points of a project, then the markers, with what was measured of them.

    A marker has no position (NaN), as the file tells only where the survey put it. Projections
    that Metashape itself computed are left out.
    """
    chunk = documents.open_chunk(source.path)
    block = read_block(chunk)
    if len(block.images) != len(cameras):
        raise damaged(chunk.path, f"{len(block.images)} aligned images, {len(cameras)} cameras")
    first = chunk.element.find("frames/frame")
    frame = None if first is None else chunk.document.follow(first)
    seen = [] if frame is None else [*_tie_points(frame, block), _markers(frame, block)]
    if not any(len(part.point) for part in seen):
        why = "only a project (.psx with its .files folder) or exported markers have them"
        raise no_tie_points(chunk.path, why)
    return gathered(*seen)


Spreads: TypeAlias = tuple[tuple[str, tuple[int, ...]], ...]
"""Names of statements and the axes that they speak of."""

SPREADS: Spreads = (
    *(("sxyz", (0, 1, 2)), ("sxy", (0, 1))),
    *(("sx", (0,)), ("sy", (1,)), ("sz", (2,))),
)
DEFAULTS: Spreads = (
    ("accuracy_cameras", (0, 1, 2)),
    ("accuracy_cameras_xy", (0, 1)),
    ("accuracy_cameras_z", (2,)),
)
LOCAL = "LOCAL"


def gnss_positions(
    chunk: Chunk, block: Block
) -> tuple[GnssPositions | None, tuple[PcfixWarning, ...]]:
    """Return the reference positions of the images of a block, and notes on them.

    Positions that the user unticked are no measurement and left out, unless all are, as is usual
    when control points alone hold the block.
    """
    path = chunk.path
    given = [image.element.find("reference") for image in block.images]
    ticked = [None if r is None or r.get("enabled") == "false" else r for r in given]
    used = given if all(reference is None for reference in ticked) else ticked
    stated = [{} if reference is None else reference.attrib for reference in used]
    places = [f"image {image.label}, reference" for image in block.images]
    xyz = np.array(
        [
            [number(path, where, given[axis]) if axis in given else np.nan for axis in "xyz"]
            for where, given in zip(places, stated, strict=True)
        ]
    )
    if not np.isfinite(xyz[:, :2]).all(axis=1).any():
        return None, ()
    settings = {
        (entry.get("name") or "").replace("/", "_"): entry.get("value") or ""
        for entry in chunk.element.iterfind("settings/property")
    }
    nothing = np.full(3, np.nan)
    start = _sigma(path, "settings of the chunk", settings, DEFAULTS, nothing)
    rows = [_sigma(path, *row, SPREADS, start) for row in zip(places, stated, strict=True)]
    sigma = np.where(np.isfinite(xyz) & (np.array(rows) > 0.0), np.array(rows), np.nan)
    crs, notes = _crs(path, chunk.element, xyz)
    return GnssPositions(xyz, sigma, crs), (*notes, *_antenna_notes(path, block))


def _sigma(
    path: Path, where: str, stated: dict[str, str], spreads: Spreads, start: FloatArray
) -> FloatArray:
    """Return `start` with what is stated, the widest first: one number for its axes, or each."""
    sigma = start.copy()
    for name, axes in spreads:
        if text := stated.get(name):
            count = 1 if len(text.split()) == 1 else len(axes)
            sigma[list(axes)] = numbers(path, f"{where}, {name}", text, count)
    return sigma


def _crs(path: Path, chunk: Element, xyz: FloatArray) -> tuple[str, tuple[PcfixWarning, ...]]:
    """Return the CRS of the positions; that of the cameras may differ from that of the chunk."""
    own = (chunk.findtext("camera_reference") or "").strip()
    text = own or (chunk.findtext("reference") or "").strip() or LOCAL
    if text.upper() == LOCAL or is_local(crs := parse_crs(text, str(path))):
        return "local", ()
    are_degrees = (np.nanmax(np.abs(xyz[:, :2]), axis=0) <= [180.0, 90.0]).all()
    if not own and not crs.is_geographic and are_degrees:
        sentence = (
            f"{path}: the reference positions of the cameras are degrees, although the CRS of the"
            " chunk is in metres. They are taken as WGS 84."
        )
        return "EPSG:4979", (PcfixWarning("cameras.gnss_in_degrees", sentence),)
    return text, ()


def _antenna_notes(path: Path, block: Block) -> tuple[PcfixWarning, ...]:
    notes = []
    for sensor in dict.fromkeys(image.sensor for image in block.images):
        antenna = None if sensor is None else sensor.find("antenna")
        if sensor is None or antenna is None:
            continue
        words = (antenna.findtext("location") or "").split()
        if (reference := antenna.find("reference")) is not None:
            words += [reference.get(axis) or "0" for axis in "xyz"]
            words += (reference.get("location") or "").split()
        if any(number(path, "GNSS antenna", word) != 0.0 for word in words):
            label = sensor.get("label")
            sentence = (
                f"{path}: the GNSS antenna of sensor {label} has an offset from the camera. The"
                " GNSS positions are those of the antenna."
            )
            notes.append(PcfixWarning("cameras.antenna_offset", sentence, sensor=label))
    return tuple(notes)


POINTS = ("x", "y", "z", "id")
PROJECTIONS = ("x", "y", "id")


def _tie_points(frame: Document, block: Block) -> Iterator[Seen]:
    """Yield the points of every component that has a place; their archive may be left out."""
    clouds = (*frame.root.iterfind("point_cloud"), *frame.root.iterfind("tie_points"))
    found = (frame.follow(cloud) for cloud in clouds if frame.leads_to_a_file(cloud))
    document = next((d for d in found if d.root.find("projections") is not None), None)
    if document is None:
        return
    listed = document.root.iterfind("projections")
    files = {entry.get("camera_id") or "": entry.get("path") or "" for entry in listed}
    with open_archive(document.path) as archive:
        for points in document.root.iterfind("points"):
            component = points.get("component_id")
            rows = [
                i
                for i, image in enumerate(block.images)
                if image.id in files
                and (component == image.component or None in (component, image.component))
            ]
            if rows:
                yield _component(archive, points.get("path") or "", rows, files, block)


def _component(
    archive: ZipFile, points: str, rows: list[int], files: dict[str, str], block: Block
) -> Seen:
    """Return the points of one component and where the images in `rows` saw them."""
    vertices = _vertices(archive, points, POINTS)
    place = block.places[rows[0]]
    xyz = np.column_stack([vertices[axis] for axis in "xyz"]).astype(np.float64)
    xyz = xyz @ place[:3, :3].T + place[:3, 3]
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


def _vertices(archive: ZipFile, name: str, needed: tuple[str, ...]) -> np.ndarray:
    """Return the vertices of a binary PLY in an archive, with the properties that are needed."""
    where, data = f"{archive.filename}: {name}", unpacked(archive, name)
    header = parse_header(where, data)
    kinds = [(p.name, header.order + p.item) for p in header.properties if not p.length]
    if not header.order or header.skipped or not {*needed} <= dict(kinds).keys():
        raise damaged(where, f"it is not a binary PLY of vertices with {', '.join(needed)}")
    with reading(where):
        vertices = np.frombuffer(data, np.dtype(kinds), header.records, header.end)
        if vertices["id"].dtype.kind not in "iu":
            raise damaged(where, "the id is not a whole number")
    return vertices


def _markers(frame: Document, block: Block) -> Seen:
    """Return the markers that were measured; they have no position."""
    row_of = {image.id: i for i, image in enumerate(block.images)}
    point: list[int] = []
    camera, uv, count = [], [], 0
    for marker in frame.root.iterfind("markers//marker"):
        before = len(point)
        for mark in marker.iterfind("location"):
            row = row_of.get(mark.get("camera_id") or "")
            if row is None or "false" in (mark.get("pinned"), mark.get("valid")):
                continue
            where = f"marker {marker.get('marker_id')}, camera {mark.get('camera_id')}"
            point.append(count)
            camera.append(row)
            uv.append([number(frame.path, where, mark.get(axis)) for axis in "xy"])
        count += len(point) > before
    return Seen(
        np.full((count, 3), np.nan),
        np.array(point, dtype=np.int64),
        np.array(camera, dtype=np.int64),
        np.array(uv, dtype=np.float64).reshape(-1, 2),
    )

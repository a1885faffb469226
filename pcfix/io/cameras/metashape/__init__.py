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
from xml.etree.ElementTree import Element
from zipfile import ZipFile

import numpy as np

from pcfix.errors import PcfixWarning
from pcfix.io.cameras.checks import damaged, note, number, numbers, reading, text_of
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.metashape import documents
from pcfix.io.cameras.metashape.block import Block, read_block
from pcfix.io.cameras.metashape.documents import Chunk, Document, open_archive, recognises, unpacked
from pcfix.io.cameras.metashape.sensors import name_of, read_calibration
from pcfix.io.cameras.tracks import Seen, no_tie_points
from pcfix.io.cameras.tracks import tie_points as gathered
from pcfix.io.crs import is_local, parse_crs
from pcfix.io.ply import parse_header
from pcfix.model import Cameras, FloatArray, GnssPositions, TiePoints

__all__ = ["read", "read_calibration", "recognises", "tie_points"]

SPREADS: tuple[tuple[str, tuple[int, ...]], ...] = (
    *(("sxyz", (0, 1, 2)), ("sxy", (0, 1))),
    *(("sx", (0,)), ("sy", (1,)), ("sz", (2,))),
)
"""Names of stated standard deviations and the axes that they are of."""
DEFAULTS = (
    ("accuracy_cameras", (0, 1, 2)),
    ("accuracy_cameras_xy", (0, 1)),
    ("accuracy_cameras_z", (2,)),
)
POINTS, PROJECTIONS = ("x", "y", "z", "id"), ("x", "y", "id")


def read(source: Source) -> Cameras:
    """Read the aligned images of a chunk: geocentric, or in a ``local`` frame."""
    chunk = documents.open_chunk(source.path)
    block = read_block(chunk)
    gnss, notes = gnss_positions(chunk, block)
    return replace(block.cameras, gnss=gnss, notes=(*chunk.notes, *block.cameras.notes, *notes))


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
    settings = {
        (entry.get("name") or "").replace("/", "_"): entry.get("value") or ""
        for entry in chunk.element.iterfind("settings/property")
    }
    start = _sigma(path, "settings of the chunk", settings, DEFAULTS, np.full(3, np.nan))
    xyz, sigma = np.full((2, len(used), 3), np.nan)
    for i, (image, reference) in enumerate(zip(block.images, used, strict=True)):
        where, stated = (
            f"image {image.label}, reference",
            {} if reference is None else reference.attrib,
        )
        for j, axis in enumerate("xyz"):
            if axis in stated:
                xyz[i, j] = number(path, where, stated[axis])
        sigma[i] = _sigma(path, where, stated, SPREADS, start)
    if not np.isfinite(xyz[:, :2]).all(axis=1).any():
        return None, ()
    sigma = np.where(np.isfinite(xyz) & (sigma > 0.0), sigma, np.nan)
    crs, notes = _crs(path, chunk.element, xyz)
    for sensor in dict.fromkeys(image.sensor for image in block.images):
        if sensor is not None and _has_antenna_offset(path, sensor):
            label = name_of(sensor)
            sentence = (
                f"the GNSS antenna of sensor {label} has an offset from the camera. The GNSS"
                " positions are those of the antenna."
            )
            notes.append(note(path, "cameras.antenna_offset", sentence, sensor=label))
    return GnssPositions(xyz, sigma, crs), tuple(notes)


def _sigma(
    path: Path,
    where: str,
    stated: dict[str, str],
    spreads: tuple[tuple[str, tuple[int, ...]], ...],
    start: FloatArray,
) -> FloatArray:
    """Return `start` with what is stated, the widest first: one number for its axes, or each."""
    sigma = start.copy()
    for name, axes in spreads:
        if text := stated.get(name):
            count = 1 if len(text.split()) == 1 else len(axes)
            sigma[list(axes)] = numbers(path, f"{where}, {name}", text, count)
    return sigma


def _crs(path: Path, chunk: Element, xyz: FloatArray) -> tuple[str, list[PcfixWarning]]:
    """Return the CRS of the positions; that of the cameras may differ from that of the chunk."""
    own = text_of(chunk, "camera_reference")
    text = own or text_of(chunk, "reference") or "LOCAL"
    if text.upper() == "LOCAL" or is_local(crs := parse_crs(text, str(path))):
        return "local", []
    are_degrees = (np.nanmax(np.abs(xyz[:, :2]), axis=0) <= [180.0, 90.0]).all()
    if not own and not crs.is_geographic and are_degrees:
        sentence = (
            "the reference positions of the cameras are degrees, although the CRS of the chunk is"
            " in metres. They are taken as WGS 84."
        )
        return "EPSG:4979", [note(path, "cameras.gnss_in_degrees", sentence)]
    return text, []


def _has_antenna_offset(path: Path, sensor: Element) -> bool:
    words = text_of(sensor, "antenna/location").split()
    for reference in sensor.iterfind("antenna/reference"):
        words += [reference.get(axis) or "0" for axis in "xyz"]
        words += (reference.get("location") or "").split()
    return any(number(path, "GNSS antenna", word) != 0.0 for word in words)


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
            if not rows:
                continue
            vertices, place = (
                _vertices(archive, points.get("path") or "", POINTS),
                block.places[rows[0]],
            )
            xyz = np.column_stack([vertices[axis] for axis in "xyz"]).astype(np.float64)
            order = np.argsort(vertices["id"], kind="stable")
            ids = vertices["id"][order].astype(np.int64)
            point, camera, uv = [], [], []
            for row in rows:
                marks = _vertices(archive, files[block.images[row].id], PROJECTIONS)
                track = marks["id"].astype(np.int64)
                found_at = np.searchsorted(ids, track).clip(max=max(len(ids) - 1, 0))
                known = ids[found_at] == track if len(ids) else np.zeros(len(marks), bool)
                point.append(order[found_at[known]])
                camera.append(np.full(int(known.sum()), row))
                uv.append(np.column_stack([marks["x"], marks["y"]])[known].astype(np.float64))
            xyz = xyz @ place[:3, :3].T + place[:3, 3]
            yield Seen(xyz, np.concatenate(point), np.concatenate(camera), np.concatenate(uv))


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

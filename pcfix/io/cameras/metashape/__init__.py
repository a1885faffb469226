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
`block`.

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
from pcfix.io.cameras.checks import damaged, note, number, numbers, reading, text_of
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.metashape import documents
from pcfix.io.cameras.metashape.block import Block, name_of, read_block, read_calibration
from pcfix.io.cameras.metashape.documents import Chunk, Document, open_archive, recognises, unpacked
from pcfix.io.cameras.tracks import Seen, no_tie_points
from pcfix.io.cameras.tracks import tie_points as gathered
from pcfix.io.crs import is_local, parse_crs
from pcfix.io.ply import parse_header
from pcfix.model import Cameras, FloatArray, GnssPositions, TiePoints

__all__ = ["read", "read_calibration", "recognises", "tie_points"]

Spreads: TypeAlias = "tuple[tuple[str, tuple[int, ...]], ...]"
"""Names of stated standard deviations and the axes that they are of."""
SPREADS: Spreads = (
    *(("sxyz", (0, 1, 2)), ("sxy", (0, 1))),
    *(("sx", (0,)), ("sy", (1,)), ("sz", (2,))),
)
DEFAULTS: Spreads = (
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
    start = spreads(path, "settings of the chunk", settings, DEFAULTS, np.full(3, np.nan))
    xyz, sigma = np.full((2, len(used), 3), np.nan)
    for i, (image, reference) in enumerate(zip(block.images, used, strict=True)):
        where = f"image {image.label}, reference"
        stated = {} if reference is None else reference.attrib
        for j, axis in enumerate("xyz"):
            if axis in stated:
                xyz[i, j] = number(path, where, stated[axis])
        sigma[i] = spreads(path, where, stated, SPREADS, start)
    if not np.isfinite(xyz[:, :2]).all(axis=1).any():
        return None, ()
    sigma = np.where(np.isfinite(xyz) & (sigma > 0.0), sigma, np.nan)
    crs, notes = _crs(path, chunk.element, xyz)
    for sensor in dict.fromkeys(image.sensor for image in block.images):
        antenna = [] if sensor is None else text_of(sensor, "antenna/location").split()
        for shift in () if sensor is None else sensor.iterfind("antenna/reference"):
            antenna += [shift.get(axis) or "0" for axis in "xyz"]
            antenna += (shift.get("location") or "").split()
        if sensor is not None and any(number(path, "GNSS antenna", one) for one in antenna):
            label = name_of(sensor)
            sentence = f"the GNSS positions are those of the antenna (sensor {label}), not offset."
            notes.append(note(path, "cameras.antenna_offset", sentence, sensor=label))
    return GnssPositions(xyz, sigma, crs), tuple(notes)


def spreads(
    path: Path, where: str, stated: dict[str, str], names: Spreads, start: FloatArray
) -> FloatArray:
    """Return `start` with what is stated, the widest first: one number for its axes, or each."""
    sigma = start.copy()
    for name, axes in names:
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
        sentence = "the camera positions are degrees in a CRS in metres; WGS 84 is assumed."
        return "EPSG:4979", [note(path, "cameras.gnss_in_degrees", sentence)]
    return text, []


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tie points of a project, then the markers, with what was measured of them.

    A marker has no position (NaN), as the file tells only where the survey put it. Projections
    that Metashape itself computed are left out.
    """
    chunk = documents.open_chunk(source.path)
    block = read_block(chunk)
    if len(block.images) != len(cameras):
        raise damaged(chunk.path, f"{len(block.images)} aligned images, {len(cameras)} cameras")
    frame = chunk.frame
    seen = [] if frame is None else [*_tie_points(frame, block), _markers(frame, block)]
    if not any(len(part.point) for part in seen):
        raise no_tie_points(chunk.path, "only a project (.psx with its folder) or markers have any")
    return gathered(*seen)


def _tie_points(frame: Document, block: Block) -> Iterator[Seen]:
    """Yield the points of every component that has a place; their archive may be left out."""
    clouds = (*frame.root.iterfind("point_cloud"), *frame.root.iterfind("tie_points"))
    found = [
        frame.follow(cloud)
        for cloud in clouds
        if (path := frame.leads_to(cloud)) is None or path.is_file()
    ]
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
            vertices = _vertices(archive, points.get("path") or "", POINTS)
            place = block.places[rows[0]]
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
    marks = [mark for mark in documents.measured_marks(frame) if mark[1] in row_of]
    names = {name: i for i, name in enumerate(dict.fromkeys(name for name, _, _ in marks))}
    return Seen(
        np.full((len(names), 3), np.nan),
        np.array([names[name] for name, _, _ in marks], np.int64),
        np.array([row_of[camera] for _, camera, _ in marks], np.int64),
        np.array([uv for _, _, uv in marks], np.float64).reshape(-1, 2),
    )

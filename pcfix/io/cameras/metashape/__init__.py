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

from pathlib import Path
from typing import NamedTuple, TypeAlias
from xml.etree.ElementTree import Element

import numpy as np

from pcfix.errors import InputError
from pcfix.io.cameras.checks import number, numbers
from pcfix.io.cameras.formats import Source
from pcfix.io.cameras.metashape import documents
from pcfix.io.cameras.metashape.block import Block, Image, read_block
from pcfix.io.cameras.metashape.documents import Archive, Chunk, Document, opened
from pcfix.io.cameras.metashape.sensors import read_calibration
from pcfix.io.cameras.tracks import tie_points as gathered
from pcfix.io.crs import is_local, parse_crs
from pcfix.io.ply import parse_header
from pcfix.model import Cameras, FloatArray, GnssPositions, IntArray, TiePoints

__all__ = ["read", "read_calibration", "recognises", "tie_points"]


def recognises(source: Source) -> bool:
    """Whether it is a document with a chunk, or a project that holds one."""
    return documents.recognises(source)


def read(source: Source) -> Cameras:
    """Read the aligned images of a chunk: geocentric, or in a ``local`` frame."""
    chunk = documents.open_chunk(source.path)
    block = read_block(chunk)
    gnss, notes = gnss_positions(chunk, block)
    return Cameras(
        labels=tuple(image.label for image in block.images),
        centres=block.centres,
        rotations=block.rotations,
        lenses=block.lenses,
        crs=block.world.crs,
        project_crs=block.world.project_crs,
        gnss=gnss,
        unposed=block.unposed,
        notes=(*chunk.notes, *block.notes, *notes),
        source=chunk.software,
    )


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tie points of a project, then the markers, with what was measured of them.

    A marker has no position (NaN), as the file tells only where the survey put it. Projections
    that Metashape itself computed are left out.
    """
    chunk = documents.open_chunk(source.path)
    return read_ties(chunk, read_block(chunk), len(cameras))


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


def gnss_positions(chunk: Chunk, block: Block) -> tuple[GnssPositions | None, tuple[str, ...]]:
    """Return the reference positions of the images of a block, and notes on them.

    Positions that the user unticked are no measurement and left out, unless all are, as is usual
    when control points alone hold the block.
    """
    path = chunk.path
    given = [image.element.find("reference") for image in block.images]
    ticked = [None if r is None or r.get("enabled") == "false" else r for r in given]
    used = given if all(reference is None for reference in ticked) else ticked
    xyz = np.array([_xyz(path, i, r) for i, r in zip(block.images, used, strict=True)])
    if not np.isfinite(xyz[:, :2]).all(axis=1).any():
        return None, ()
    start = _defaults(path, chunk.element)
    rows = [_sigma(path, i, r, start) for i, r in zip(block.images, used, strict=True)]
    sigma = np.where(np.isfinite(xyz), np.array(rows), np.nan)
    crs, notes = _crs(path, chunk.element, xyz)
    return GnssPositions(xyz, sigma, crs), (*notes, *_antenna_notes(path, block))


def _xyz(path: Path, image: Image, reference: Element | None) -> list[float]:
    if reference is None:
        return [np.nan] * 3
    where = f"image {image.label}, reference"
    words = (reference.get(axis) for axis in "xyz")
    return [np.nan if word is None else number(path, where, word) for word in words]


def _sigma(path: Path, image: Image, reference: Element | None, start: FloatArray) -> FloatArray:
    """Return the stated standard deviations, from the widest statement to the narrowest."""
    stated = {} if reference is None else reference.attrib
    sigma = _stated(path, f"image {image.label}, reference", stated, SPREADS, start)
    return np.where(sigma > 0.0, sigma, np.nan)


def _defaults(path: Path, chunk: Element) -> FloatArray:
    """Return what the settings of the chunk state for every camera."""
    settings = {
        (entry.get("name") or "").replace("/", "_"): entry.get("value") or ""
        for entry in chunk.iterfind("settings/property")
    }
    return _stated(path, "settings of the chunk", settings, DEFAULTS, np.full(3, np.nan))


def _stated(
    path: Path, where: str, given: dict[str, str], spreads: Spreads, start: FloatArray
) -> FloatArray:
    """Return `start` with what is given: one number for its axes, or one for each."""
    sigma = start.copy()
    for name, axes in spreads:
        if text := given.get(name):
            count = 1 if len(text.split()) == 1 else len(axes)
            sigma[list(axes)] = numbers(path, f"{where}, {name}", text, count)
    return sigma


def _crs(path: Path, chunk: Element, xyz: FloatArray) -> tuple[str, tuple[str, ...]]:
    """Return the CRS of the positions; that of the cameras may differ from that of the chunk."""
    own = (chunk.findtext("camera_reference") or "").strip()
    text = own or (chunk.findtext("reference") or "").strip() or LOCAL
    if text.upper() == LOCAL or is_local(crs := parse_crs(text, str(path))):
        return "local", ()
    are_degrees = (np.nanmax(np.abs(xyz[:, :2]), axis=0) <= [180.0, 90.0]).all()
    if not own and not crs.is_geographic and are_degrees:
        return "EPSG:4979", (
            f"{path}: the reference positions of the cameras are degrees, although the CRS of the"
            " chunk is in metres; taken as WGS 84.",
        )
    return text, ()


def _antenna_notes(path: Path, block: Block) -> tuple[str, ...]:
    found = {id(image.sensor): image.sensor for image in block.images}
    return tuple(
        f"{path}: sensor {sensor.get('label')}: its GNSS antenna has an offset from the camera; the"
        " GNSS positions are those of the antenna."
        for sensor in found.values()
        if sensor is not None and _has_antenna_offset(path, sensor)
    )


def _has_antenna_offset(path: Path, sensor: Element) -> bool:
    antenna = sensor.find("antenna")
    if antenna is None:
        return False
    reference = antenna.find("reference")
    words = (antenna.findtext("location") or "").split()
    if reference is not None:
        words += [reference.get(axis) or "0" for axis in "xyz"]
        words += (reference.get("location") or "").split()
    return any(number(path, "GNSS antenna", word) != 0.0 for word in words)


POINTS = ("x", "y", "z", "id")
PROJECTIONS = ("x", "y", "id")


class Seen(NamedTuple):
    """Points, and observations of them, camera by camera: row of both, u and v."""

    xyz: FloatArray
    point: IntArray
    camera: IntArray
    uv: FloatArray


NOTHING = Seen(np.empty((0, 3)), np.empty(0, int), np.empty(0, int), np.empty((0, 2)))


def read_ties(chunk: Chunk, block: Block, count: int) -> TiePoints:
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
    return gathered(*seen)


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
    """Return the vertices of a binary PLY in an archive, with the properties that are needed."""
    where, data = f"{archive.path}: {name}", archive.read(name)
    header = parse_header(where, data)
    kinds = [(p.name, header.order + p.item) for p in header.properties if not p.length]
    if not header.order or header.skipped or len({*kinds}) < len(header.properties):
        raise InputError(f"{where}: is not a binary PLY of vertices; save the project again.")
    missing = [field for field in needed if field not in dict(kinds)]
    if missing:
        raise InputError(f"{where}: has no property {', '.join(missing)}; save the project again.")
    kind = np.dtype(kinds)
    whole = (len(data) - header.end) // kind.itemsize
    if header.vertices > whole:
        raise InputError(
            f"{where}: says {header.vertices} vertices but is cut off after {whole}; save the"
            " project again."
        )
    vertices = np.frombuffer(data, kind, header.vertices, header.end)
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
            if "false" not in (m.get("pinned"), m.get("valid")) and m.get("camera_id") in row_of
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

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
``reference``, in the CRS of the cameras or of the chunk.

Calibration. The formula is that of `pcfix.model.Lens`, with cx and cy from the centre of the image.
A fisheye is equidistant, and since version 2.3 can be equisolid. Files of PhotoScan up to 1.2 can
have fx and fy instead of f; there cx and cy count from the corner, and p1 and p2 change places.
The element decides this, as the version of the document does not.

References: "Agisoft Metashape User Manual, Professional Edition", appendix "Camera models";
"Metashape Python Reference", Chunk.transform, Sensor.location, CoordinateSystem.geoccs;
``save_estimated_reference.py`` in github.com/agisoft-llc/metashape-scripts.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeAlias
from xml.etree.ElementTree import Element
from zipfile import ZipFile

import numpy as np

from pcfix.errors import PcfixWarning, bad_file
from pcfix.io.cameras import checks
from pcfix.io.cameras.checks import Source, damaged, note, number, numbers, read_xml, text_of
from pcfix.io.cameras.lenses import lens_by_name
from pcfix.io.cameras.metashape import documents
from pcfix.io.cameras.metashape.documents import Chunk, Document, recognises
from pcfix.io.crs import LOCAL, METRES, crs_text, is_local, parse_crs, shortened, unbound
from pcfix.io.ply import parse_header
from pcfix.model import Cameras, FloatArray, GnssPositions, Lens, Projection, TiePoints

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
POINTS, MARKS = ("x", "y", "z", "id"), ("x", "y", "id")
PARAMETERS = {
    *("f", "fx", "fy", "cx", "cy", "b1", "b2", "skew"),
    *("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"),
}
PROJECTIONS: dict[str, Projection] = {
    "frame": "perspective",
    "fisheye": "equidistant",
    "equidistant_fisheye": "equidistant",
    "equisolid_fisheye": "equisolid",
}
"""Kinds of sensors that a lens can describe: not spherical, cylindrical or RPC."""


def read(source: Source) -> Cameras:
    """Read the aligned images of a chunk: geocentric, or in a ``local`` frame."""
    chunk = documents.open_chunk(source.path)
    block = read_block(chunk)
    gnss, notes = gnss_positions(chunk, block)
    return replace(block.cameras, gnss=gnss, notes=(*chunk.notes, *block.cameras.notes, *notes))


class Image(NamedTuple):
    """An image and the elements that speak of it; `component` is where its pose is at home."""

    id: str
    label: str
    element: Element
    sensor: Element | None
    component: str | None


class Block(NamedTuple):
    """The images with a pose, in the order of the file, and their matrices from chunk to world."""

    images: list[Image]
    places: list[FloatArray]
    cameras: Cameras


def read_block(chunk: Chunk) -> Block:
    """Read the images of a chunk.

    Left out are images that are not aligned, disabled (they took no part in the dense cloud), not
    of a central projection, or in a component without a place in the frame of the others.
    """
    path, element = chunk.path, chunk.element
    images = _images(element)
    poses = _poses(path, images)
    of_components, has_place = _places(path, element)
    kept, places, why = list[Image](), list[FloatArray](), Counter[str]()
    for image in images:
        kind = "frame" if image.sensor is None else kind_of(image.sensor)
        place = of_components.get(image.component, of_components[None])
        if image.id not in poses:
            continue
        if image.element.get("enabled") == "false":
            why["aligned but disabled"] += 1
        elif kind not in PROJECTIONS:
            why[f"of a {kind} sensor, for which there is no lens"] += 1
        elif place is None:
            why["in a component that has no transform to the frame of the others"] += 1
        else:
            kept.append(image)
            places.append(place)
    said = [f"{count} images are {reason}" for reason, count in why.items()]
    if not kept:
        chunk_name = element.get("label") or "without a name"
        rest = ", ".join([f"{len(images) - len(poses)} are not aligned", *said])
        raise checks.no_pose(path, f"of the {len(images)} images of chunk {chunk_name} {rest}")
    notes = [note(path, "cameras.left_out", f"{one}; left out.") for one in said]
    crs, project_crs, of_world = _world(path, element) if has_place else (LOCAL, None, ())
    in_world = np.array(places) @ np.array([poses[image.id] for image in kept])
    scales = np.cbrt(np.linalg.det(in_world[:, :3, :3]))[:, None, None]
    lenses: dict[Element, Lens] = {}
    for image in kept:
        if image.sensor is None:
            raise damaged(path, f"sensor {image.element.get('sensor_id')} is missing")
        if image.sensor not in lenses:
            lenses[image.sensor], of_lens = lens_of(path, image.sensor, image.label)
            notes += of_lens
    chosen = {image.id for image in kept}
    cameras = Cameras(
        labels=tuple(image.label for image in kept),
        centres=in_world[:, :3, 3],
        rotations=np.ascontiguousarray((in_world[:, :3, :3] / scales).transpose(0, 2, 1)),
        lenses=tuple(lenses[image.sensor] for image in kept if image.sensor is not None),
        crs=crs,
        project_crs=project_crs,
        unposed=tuple(image.label for image in images if image.id not in chosen),
        notes=(*notes, *of_world),
        source=chunk.software,
    )
    return Block(kept, places, cameras)


def _images(chunk: Element) -> list[Image]:
    """Return the photos of a chunk, also those in groups; keyframes of animations are none."""
    found = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    listed = {
        number: component.get("id")
        for component in chunk.iterfind("components/component")
        for ids in component.iter("camera_ids")
        for number in (ids.text or "").split()
    }
    homes: dict[str, str | None] = {}
    images: list[Image] = []
    for camera in chunk.iterfind("cameras//camera"):
        if camera.get("type", "regular") == "regular":
            number = camera.get("id") or f"#{len(images)}"
            label = camera.get("label") or f"number {number}"
            home = camera.get("component_id") or listed.get(number)
            homes[number] = home or homes.get(camera.get("master_id") or "")
            sensor = found.get(camera.get("sensor_id"))
            images.append(Image(number, label, camera, sensor, homes[number]))
    return images


def _poses(path: Path, images: list[Image]) -> dict[str, FloatArray]:
    """Return camera to chunk, 4x4, of each image that is aligned or whose master is."""
    aligned = [image for image in images if text_of(image.element, "transform")]
    labels = [image.label for image in aligned]
    rows = [
        numbers(path, f"image {image.label}, transform", image.element.findtext("transform"), 16)
        for image in aligned
    ]
    matrices = np.array(rows).reshape(-1, 4, 4)
    matrices[:, :3, :3] = checks.rotations(path, labels, matrices[:, :3, :3])
    masters = dict(zip((image.id for image in aligned), matrices, strict=True))
    poses = dict(masters)
    for image in images:
        master = masters.get(image.element.get("master_id") or "")
        if image.id not in masters and master is not None and image.sensor is not None:
            where, offset = f"sensor {name_of(image.sensor)}", np.eye(4)  # in the unit of the chunk
            if rotation := text_of(image.sensor, "rotation"):
                matrix = numbers(path, f"{where}, rotation", rotation, 9)
                offset[:3, :3] = checks.rotations(path, [where], matrix)[0]
            if location := text_of(image.sensor, "location"):
                offset[:3, 3] = numbers(path, f"{where}, location", location, 3)
            poses[image.id] = master @ offset
    return poses


def _places(path: Path, chunk: Element) -> tuple[dict[str | None, FloatArray | None], bool]:
    """Return the matrix of each component to the world, or None, and whether any has one.

    The key None is for images in no component. Every component has its own frame. One with a
    transform has a place in the world; one without has that of the chunk when it is the active or
    only one, as the chunk's transform is that of its active component. Where none has a place, the
    world is the frame of the chunk.
    """
    of_chunk = _similarity(path, chunk.find("transform"))
    components = chunk.findall("components/component")
    own = {c.get("id"): _similarity(path, c.find("transform")) for c in components}
    parent = chunk.find("components")
    active = None if parent is None else parent.get("active_id")
    main = active if active in own else next(iter(own), None)
    has_place = of_chunk is not None or any(place is not None for place in own.values())
    of_main = of_chunk if has_place else np.eye(4)
    if own.get(main) is None:
        own[main] = of_main
    own[None] = of_main
    return own, has_place


def _similarity(path: Path, element: Element | None) -> FloatArray | None:
    """Return the 4x4 matrix of a transform that is one matrix, or has up to three parts."""
    if element is None:
        return None
    where, matrix = "transform of the chunk", np.eye(4)
    scale, rotation, translation = map(element.findtext, ("scale", "rotation", "translation"))
    if (element.text or "").strip():
        matrix = numbers(path, where, element.text, 16).reshape(4, 4)
    elif scale is None and rotation is None and translation is None:
        return None
    if rotation is not None:
        matrix[:3, :3] = numbers(path, where, rotation, 9).reshape(3, 3)
    if translation is not None:
        matrix[:3, 3] = numbers(path, where, translation, 3)
    inside = float(np.cbrt(np.linalg.det(matrix[:3, :3]))) if scale is None else 1.0
    size = inside if scale is None else number(path, where, scale)
    if not size > 0.0:
        raise damaged(path, f"{where}: the scale {size:g} is not positive")
    matrix[:3, :3] = size * checks.rotations(path, [where], matrix[:3, :3] / inside)[0]
    return matrix


def _world(path: Path, chunk: Element) -> tuple[str, str | None, tuple[PcfixWarning, ...]]:
    """Return the frame that a chunk's transforms lead to, its CRS if another, and notes on them."""
    text = text_of(chunk, "reference")
    if not text or text.upper() == "LOCAL":
        return LOCAL, None, ()
    crs = parse_crs(text, str(path))
    if is_local(crs):
        unit = crs.axis_info[0].unit_name
        sentence = f"the local coordinates of the chunk are in {unit}, its transform in metres."
        said = note(path, "cameras.local_unit", sentence, unit=unit)
        return LOCAL, None, () if unit in METRES else (said,)
    if crs.geodetic_crs is None:
        remedy = "Set it again in Metashape's reference settings"
        raise checks.unsupported(path, f"the CRS {shortened(text)}, which has no datum,", remedy)
    base = unbound(crs.geodetic_crs).to_json_dict()
    axes = [
        {"name": f"Geocentric {a}", "abbreviation": a, "direction": f"geocentric{a}"}
        | {"unit": "metre"}
        for a in "XYZ"
    ]
    geocentric = {  # on the datum of the CRS, as PROJJSON
        **{key: base[key] for key in ("$schema", "name", "datum", "datum_ensemble") if key in base},
        "type": "GeodeticCRS",
        "coordinate_system": {"subtype": "Cartesian", "axis": axes},
    }
    frame = crs_text(type(crs).from_json_dict(geocentric))
    return frame, frame if crs.is_geocentric else text, ()


def read_calibration(path: Path) -> Lens:
    """Read a calibration that Metashape saved on its own (root element ``calibration``), pixels."""
    root = read_xml(path)
    if root.tag != "calibration":
        sentence = f"is not a calibration of Metashape ({root.tag}). Save one from its Tools menu."
        raise bad_file(path, "cameras.no_calibration", sentence)
    kind = (root.findtext("projection") or "frame").strip()
    if kind not in PROJECTIONS:
        remedy = f"Use a lens of type {', '.join(PROJECTIONS)}"
        raise checks.unsupported(path, f"the projection '{kind}'", remedy, model=kind)
    width, height = (number(path, side, root.findtext(side)) for side in ("width", "height"))
    lens = _lens_of_calibration(path, path.stem, kind, root, (width, height))
    return checks.lens(path, path.stem, lens)


def _lens_of_calibration(
    path: Path, sensor: str, kind: str, calibration: Element, size: tuple[float, float]
) -> Lens:
    """Return the lens of a calibration of a known kind, for an image of a size in pixels."""
    given = {
        entry.tag: number(path, f"sensor {sensor}, {entry.tag}", entry.text)
        for entry in calibration
        if entry.tag in PARAMETERS
    }
    if not given.keys() & {"f", "fx", "fy"}:
        raise damaged(path, f"the calibration of sensor {sensor} has no focal length")
    (width, height), value = size, defaultdict(float, given)
    if "f" in given:
        given |= {"fx": value["f"] + value["b1"], "fy": value["f"], "skew": value["b2"]}
        given |= {"cx": width / 2.0 + value["cx"], "cy": height / 2.0 + value["cy"]}
    else:  # PhotoScan's
        focal = given.get("fy", value["fx"])
        given |= {"fx": given.get("fx", focal), "fy": focal}
        given |= {"p1": value["p2"], "p2": value["p1"]}
    return lens_by_name(given, *size, projection=PROJECTIONS[kind], sensor=sensor)


def name_of(sensor: Element) -> str:
    """Return the label of a sensor, or its number."""
    return sensor.get("label") or f"number {sensor.get('id')}"


def kind_of(sensor: Element) -> str:
    """Return the type of a sensor, which may be none of `PROJECTIONS`."""
    found = _calibration(sensor)
    return (found is not None and found.get("type")) or sensor.get("type") or "frame"


def lens_of(path: Path, sensor: Element, image: str) -> tuple[Lens, tuple[PcfixWarning, ...]]:
    """Return the adjusted calibration, else the initial one, else the data sheet; and notes."""
    label, found = name_of(sensor), _calibration(sensor)
    sizes = [one.find("resolution") for one in (found, sensor) if one is not None]
    resolution = next((one for one in sizes if one is not None), None)
    stated = {entry.get("name"): entry.get("value") for entry in sensor.iterfind("property")}
    pixel_mm, focal_mm = (
        number(path, f"sensor {label}, {name}", stated.get(name, "0"))
        for name in ("pixel_width", "focal_length")
    )
    notes = []
    if resolution is not None and (found is not None or min(pixel_mm, focal_mm) > 0.0):
        sides = (resolution.get(side) for side in ("width", "height"))
        width, height = (number(path, f"sensor {label}, resolution", side) for side in sides)
    else:
        sentence = f"sensor {label} of {image} has no calibration or no size. Align the images."
        raise bad_file(path, "cameras.no_calibration", sentence, sensor=label)
    if found is not None:
        lens = _lens_of_calibration(path, label, kind_of(sensor), found, (width, height))
        if coefficients := found.findtext("corrections/coeffs"):
            where, count = f"sensor {label}, corrections", len(coefficients.split())
            rms_px = float(np.linalg.norm(numbers(path, where, coefficients, count)) / 2.0**0.5)
            sentence = f"the additional corrections of {label} are ignored ({rms_px:.2f} px rms)."
            notes.append(note(path, "cameras.corrections", sentence, sensor=label, rms_px=rms_px))
    else:
        given = {"f": focal_mm / pixel_mm}  # what Metashape itself starts from
        projection = PROJECTIONS[kind_of(sensor)]
        lens = lens_by_name(given, width, height, projection=projection, sensor=label)
        sentence = f"sensor {label} has no calibration; the lens of its data sheet is used."
        notes.append(note(path, "cameras.data_sheet_lens", sentence, sensor=label))
    return replace(lens, pixel_size_mm=pixel_mm if pixel_mm > 0.0 else None), tuple(notes)


def _calibration(sensor: Element) -> Element | None:
    """Return the last adjusted calibration, else the last one."""
    found = sensor.findall("calibration")
    chosen = [one for one in found if one.get("class") == "adjusted"] or found
    return chosen[-1] if chosen else None


def gnss_positions(
    chunk: Chunk, block: Block
) -> tuple[GnssPositions | None, tuple[PcfixWarning, ...]]:
    """Return the reference positions of the images of a block, and notes on them.

    Positions that the user unticked are no measurement and left out, unless all are, as is usual
    when only control points determine the block.
    """
    path, images = chunk.path, block.images
    given = [image.element.find("reference") for image in images]
    ticked = [None if r is None or r.get("enabled") == "false" else r for r in given]
    used = given if all(reference is None for reference in ticked) else ticked
    settings = {name.replace("/", "_"): value for name, value in chunk.settings.items()}
    start = spreads(path, "settings of the chunk", settings, DEFAULTS, np.full(3, np.nan))
    xyz, sigma = np.full((2, len(used), 3), np.nan)
    for i, (image, reference) in enumerate(zip(images, used, strict=True)):
        where = f"image {image.label}, reference"
        stated = {} if reference is None else reference.attrib
        for j, axis in enumerate("xyz"):
            if axis in stated:
                xyz[i, j] = number(path, where, stated[axis])
        sigma[i] = spreads(path, where, stated, SPREADS, start)
    if not np.isfinite(xyz[:, :2]).all(axis=1).any():
        return None, ()
    sigma = np.where(np.isfinite(xyz) & (sigma > 0.0), sigma, np.nan)
    # the CRS of the cameras may differ from that of the chunk
    own, notes = text_of(chunk.element, "camera_reference"), []
    crs = own or text_of(chunk.element, "reference") or "LOCAL"
    are_degrees = bool((np.nanmax(np.abs(xyz[:, :2]), axis=0) <= [180.0, 90.0]).all())
    if crs.upper() == "LOCAL" or is_local(parsed := parse_crs(crs, str(path))):
        crs = LOCAL
    elif are_degrees and not own and not parsed.is_geographic:
        sentence = "the camera positions are degrees in a CRS in metres; WGS 84 is assumed."
        crs, notes = "EPSG:4979", [note(path, "cameras.gnss_in_degrees", sentence)]
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


def tie_points(source: Source, cameras: Cameras) -> TiePoints:
    """Read the tie points of a project, then the markers, with what was measured of them.

    A marker has no position (NaN), as the file has only its surveyed coordinates. Projections
    that Metashape itself computed are left out.
    """
    chunk = documents.open_chunk(source.path)
    block = read_block(chunk)
    if len(block.images) != len(cameras):
        raise damaged(chunk.path, f"{len(block.images)} aligned images, {len(cameras)} cameras")
    frame = chunk.frame
    seen = []
    if frame is not None:
        row_of = {image.id: i for i, image in enumerate(block.images)}
        marks = [mark for mark in documents.measured_marks(frame) if mark[1] in row_of]
        names = {name: i for i, name in enumerate(dict.fromkeys(name for name, _, _ in marks))}
        markers = checks.Seen(
            np.full((len(names), 3), np.nan),
            np.array([names[name] for name, _, _ in marks], np.int64),
            np.array([row_of[camera] for _, camera, _ in marks], np.int64),
            np.array([uv for _, _, uv in marks], np.float64).reshape(-1, 2),
        )
        seen = [*_tie_points(frame, block), markers]
    if not any(len(part.point) for part in seen):
        why = "only a project (.psx with its folder) or markers have any"
        raise checks.no_tie_points(chunk.path, why)
    return checks.tie_points(*seen)


def _tie_points(frame: Document, block: Block) -> Iterator[checks.Seen]:
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
    with checks.open_archive(document.path) as archive:
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
            vertices, place = _vertices(archive, points.get("path"), POINTS), block.places[rows[0]]
            xyz = _columns(vertices, "xyz") @ place[:3, :3].T + place[:3, 3]
            marks = [_vertices(archive, files[block.images[row].id], MARKS) for row in rows]
            tracks = np.concatenate([one["id"].astype(np.int64) for one in marks])
            point = checks.rows_of(tracks, vertices["id"].astype(np.int64))
            camera = np.repeat(rows, [len(one) for one in marks])
            uv = np.concatenate([_columns(one, "xy") for one in marks])
            yield checks.Seen(xyz, point, camera, uv)


def _columns(vertices: np.ndarray, names: str) -> FloatArray:
    return np.column_stack([vertices[name] for name in names]).astype(np.float64)


def _vertices(archive: ZipFile, name: str | None, needed: tuple[str, ...]) -> np.ndarray:
    """Return the vertices of a binary PLY in an archive, with the properties that are needed."""
    where, data = f"{archive.filename}: {name}", checks.unpacked(archive, name or "")
    header = parse_header(where, data)
    kinds = [(p.name, header.order + p.item) for p in header.properties if not p.length]
    if not header.order or header.skipped or not {*needed} <= dict(kinds).keys():
        raise damaged(where, f"it is not a binary PLY of vertices with {', '.join(needed)}")
    with checks.reading(where):
        vertices = np.frombuffer(data, np.dtype(kinds), header.records, header.end)
        if vertices["id"].dtype.kind not in "iu":
            raise damaged(where, "the id is not a whole number")
    return vertices
